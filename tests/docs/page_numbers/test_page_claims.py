"""Tests of claims on pages that are not numbers: for example which tuner is best."""

import subprocess
import sys
from pkgutil import resolve_name

import pytest

from bench.diagnosis.search.verdict_rules import FAULTY, OPEN, VERDICT_MEANINGS
from tests.docs.documentation_pages import ROOT, blocks, quoted, section, tables, text_of
from tests.docs.page_numbers.inserted_numbers import NUMBER, agrees
from tests.docs.page_numbers.page_values import (
    BOUND,
    REFERENCE,
    SEVERAL,
    SIX,
    answers,
    at_bound,
    document,
    error,
    estimates,
    frame,
    grade,
    history,
    median,
    missing,
    rows,
    so101_errors,
)
from tests.exams import exam_report
from tests.exams.__main__ import EXAMS
from tests.exams.exam import read_table


def names_below(table, tuner, threshold=0.05):
    """Return the tuners whose p-value against a tuner is below a threshold."""
    return set(table.index[table[tuner] < threshold])


@pytest.mark.parametrize(
    ("folder", "exam"), [("exam", "systems"), ("robots", "robots"), ("conventions", "conventions")]
)
def test_pages_of_exams_have_the_present_results(folder, exam):
    path = REFERENCE / folder / "README.md"
    page = exam_report.format_page(resolve_name(EXAMS[exam]), read_table(path.parent / "items.csv"))
    results = path.read_text("utf-8").partition(exam_report.BEGIN)[2].partition(exam_report.END)[0]
    assert results.strip() == page.strip()


def test_hybrid_is_never_behind_on_the_published_ball():
    pairs = frame("ball-drop/behind.csv")
    assert not pairs.behind.any()
    level = pairs[~pairs.ahead]
    assert set(level.rival) == {"tunenet", "least_squares"}
    assert set(level[level.rival == "tunenet"].simulations) == {1, 2, 3, 5, 10}
    assert set(level[level.rival == "least_squares"].simulations) == {10, 20, 50}
    tuners = set(frame("ball-drop/table.csv").tuner)
    for simulations in (1, 2, 3):
        errors = {t: median("ball-drop", t, "in", simulations, "param_abs_error") for t in tuners}
        assert {"hybrid", "tunenet"} == set(sorted(errors, key=errors.get)[:2])
    mean, middle = (
        error("ball-drop", "tunenet", "wide", 50, statistic=s) for s in ("mean", "median")
    )
    assert middle < 1e-11
    assert 7e-4 < mean < 9e-4


def test_the_comparison_distinguishes_the_tuners_of_the_page():
    for problem in SIX:
        assert set(frame(f"comparison/{problem}/status.csv").status) <= {"done", "converged"}
    nemenyi = frame("comparison/all/nemenyi.csv").set_index("tuner")
    distinguished = {"random", "cma_es", "bayes", "regressor"}
    assert names_below(nemenyi, "least_squares") == distinguished
    assert names_below(nemenyi, "tunenet") == {"random"}


def test_hybrid_is_best_with_several_parameters():
    for problem in SEVERAL:
        assert set(frame(f"multi/{problem}/status.csv").status) <= {"done", "converged"}
    assert frame("multi/all/ranks.csv").drop(columns="problem").mean().idxmin() == "hybrid"
    nemenyi = frame("multi/all/nemenyi.csv").set_index("tuner")
    for tuner in ("hybrid", "least_squares"):
        assert names_below(nemenyi, tuner) == {"bayes", "random", "tunenet-published"}
        assert names_below(nemenyi, tuner, 0.04) == {"bayes", "random", "tunenet-published"}


@pytest.mark.slow
def test_tables_of_several_parameters_are_those_of_their_program():
    command = [sys.executable, "-m", "tests.benchmarks.multi_problem_tables", REFERENCE / "multi"]
    made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    stored = (REFERENCE / "multi" / "tables.md").read_text(encoding="utf-8")
    assert sorted(stored.splitlines()) == sorted(made.splitlines())


def test_films_cost_a_factor_of_two():
    assert frame("ball-drop-video/status.csv").status.isin(["done", "converged"]).all()
    assert error("ball-drop-video", "tunenet-vision", "in", 1) < 0.005
    plain, vision = (
        median("ball-drop-video", tuner, "in", 3, "param_abs_error")
        for tuner in ("tunenet", "tunenet-vision")
    )
    assert 1.5 < vision / plain < 2.5


def test_shots_miss_as_the_page_lists():
    text = (REFERENCE / "bounce-shot" / "README.md").read_text(encoding="utf-8")
    listed = text[text.index("misses (") :].partition(")")[0]
    missed = rows("bounce-shot/shots.csv", method="tunenet-vision", hit=False)
    assert [shot for shot in missed.shot if shot.rpartition("-")[2] not in listed] == []
    for tuner, count in (("tunenet", 3), ("least_squares", 4)):
        others = rows("bounce-shot/shots.csv", method=tuner, hit=False)
        assert len(others) == count
        assert set(others.shot) <= set(missed.shot)


def test_vision_ends_at_its_bound_where_two_effects_act():
    table = frame("bounce-shot/vision.csv")
    assert set(table.groupby("trained").size()) == {60}
    both = table[table.effects == "drag.quadratic restitution.speed"]
    published = both[both.trained == "as published"]
    assert (published.restitution >= BOUND).sum() == at_bound("as published") > 0
    assert at_bound("in the extended simulator, range to 1") == 0


def test_networks_without_randomisation_are_never_covered():
    assert (rows("misspecified/learned.csv", randomised=False).covered == 0).all()


def test_the_history_network_wins_as_the_page_says():
    for experiment in ("ball-drop", "pendulum-swing"):
        for kind in ("in", "wide"):
            one_step = {t: history(experiment, kind, 1, t) for t in ("in_context", "tunenet")}
            last = {
                t: history(experiment, kind, 20, t) for t in ("in_context", "hybrid", "tunenet")
            }
            assert min(last, key=last.get) == ("tunenet" if "drop" in experiment else "hybrid")
            if (experiment, kind) != ("ball-drop", "wide"):
                assert min(one_step, key=one_step.get) == "in_context"
            # The effect of the history is smaller than the difference between two trainings.
            windows = [history(experiment, kind, 3, t) for t in ("window-1", "in_context")]
            assert 0.5 < windows[0] / windows[1] < 2.0
            assert history(experiment, kind, 20, "published-3") > 6 * last["in_context"]
    for system in ("ball", "shot"):
        errors = {
            t: missing(system, t, "extended") for t in ("in_context", "least_squares", "hybrid")
        }
        assert errors["in_context"] > max(errors["least_squares"], errors["hybrid"])


def test_exams_of_systems_have_no_alarm_and_two_foreign_causes_get_a_name():
    count, total, *_ = grade("exam/items.csv", "clean", "strict")
    assert count == total
    foreign = answers("exam/items.csv", kind="foreign", outcome="wrong")
    assert dict(zip(foreign.hidden.str.partition("=")[0], foreign.causes, strict=True)) == {
        "gust": "wind + force.ripple",
        "updraft": "force.periodic",
    }
    assert (answers("robots/items.csv", kind="clean").outcome == "right").all()
    assert len(answers("robots/items.csv", outcome="failed")) == 1
    assert (frame("robots/transmission.csv").outcome == "not drawn").sum() == 1


def test_sets_of_floating_bases_are_those_of_the_page():
    sets = answers("robots/afloat.csv", outcome="set").causes
    assert sets.str.contains("sensor.bias").sum() == 1
    rest = sets[~sets.str.contains("input.bias") & ~sets.str.contains("actuator.damping")]
    assert rest.tolist() == ["sensor.gain@q.elbow|sensor.eccentricity@q.elbow"]


def test_all_fresh_predictions_of_design_came_true():
    fresh = frame("next-recording/fresh.csv")
    predicted = fresh[fresh.groups.str.contains("|", regex=False)]
    assert (predicted.kept & (predicted.outcome == "settled")).all()


def test_the_means_of_the_so101_are_those_of_its_motions():
    cells = so101_errors()
    motions = {motion for motion, *_ in cells} - {"all six"}
    assert len(cells) == 14 * 6
    for (motion, model, joint), cell in cells.items():
        if motion == "all six":
            squares = [float(cells[name, model, joint]) ** 2 for name in motions]
            mean = (sum(squares) / len(squares)) ** 0.5
            # The cells are rounded, so the mean agrees only to within one digit.
            assert abs(mean - float(cell)) < 0.06 + 0.005 * mean


def test_friction_of_the_so101_has_one_alternative():
    causes = document("real/datasheets/so101-base/slow/verdict.json")["causes"]
    (dry,) = (c for c in causes if c["effect"] == "friction.coulomb@shoulder_pan")
    assert dry["alternatives"] == ["servo.deadband@m_shoulder_pan"]


def test_the_printed_example_of_a_robot_is_the_stored_one():
    held_out = document("robot-example/verdict.json")["heldout"]
    estimate = estimates("robot-example", "friction.coulomb@elbow")["coefficient"]
    part = section(text_of("robots.md"), "## The example")
    (_, printed), *_ = [block for block in blocks(part, "text") if "closes" in block[1]]
    values = [100 * held_out[key] for key in ("gap_closed", "low", "high")]
    values += [held_out[key] for key in ("rmse_base", "rmse_extended", "noise_floor")]
    values += [estimate[key] for key in ("value", "low", "high")]
    numbers = [number[0] for number in NUMBER.finditer(printed)]
    assert [v for v in values if not any(agrees(number, v) for number in numbers)] == []
    (_, lines), *_ = blocks(part, "xml")
    stored = (REFERENCE / "robot-example" / "extended.xml").read_text(encoding="utf-8")
    assert len(lines.splitlines()) == 2
    assert [line for line in lines.splitlines() if line not in stored] == []


def test_meanings_of_verdicts_are_those_of_the_rules():
    first, second = tables(section(text_of("verdicts.md"), "## The six verdicts"))
    assert {quoted(verdict)[0]: says for verdict, says, _ in first[1:]} == VERDICT_MEANINGS
    meanings = {quoted(verdict)[0]: says for verdict, says, _ in second[1:]}
    assert meanings == {"partial": OPEN, "unknown": FAULTY}
