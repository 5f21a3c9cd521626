"""Tests of `simgap diff`: differences are reported, but differences within the noise are not."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import tomli_w

from bench.benchmark.storage.result_folder import read_configuration
from bench.schemas import find_violations
from bench.studies import result_diff
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.sample_experiments import SPRING
from tests.without_drawing import undrawn

PLUGIN = ["--plugin", str(PLUGINS / "spring.py")]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Comparison with enough targets for small p-values."""
    folder = tmp_path_factory.mktemp("diff")
    document = {
        **SPRING, "ranges": ["in"], "targets": 14, "seeds": 2, "budget": 4,
        "identifiability": False, "tuners": ["random", "least_squares"],
    }  # fmt: skip
    (folder / "small.toml").write_text(tomli_w.dumps(document))
    command = ["compare", str(folder / "small.toml"), *PLUGIN, "--jobs", "0", "--salt", "public"]
    with undrawn():
        run_command(*command, "--out", folder / "run")
    return folder / "run"


def copied(run, place, change=None, name="b"):
    """Copy the comparison and change its rows."""
    shutil.copytree(run, place / name)
    if change:
        path = place / name / "runs.parquet"
        rows = change(pd.read_parquet(path))
        rows.to_parquet(path, index=False)
    return place / name


def differ(a, b, *options, code=0):
    """Return the document that the comparison of two folders prints."""
    found = json.loads(run_command("diff", a, b, "--json", *options, code=code).out)
    if "error" not in found:
        assert find_violations(found, "diff") == []
    return found


def scaled(factor, tuner="random", which=slice(None)):
    """Multiply the errors of a tuner by a factor that varies slightly between targets.

    Equal differences would be ties, for which the signed-rank test has no exact p-value.
    """

    def change(rows):
        targets = sorted(rows["target"].unique())[which]
        for number, target in enumerate(targets):
            mine = (rows["tuner"] == tuner) & (rows["target"] == target) & (rows["k"] > 0)
            for column in ("param_error", "param_abs_error", "stiff_error", "sloppy_error"):
                if column in rows:
                    rows.loc[mine, column] *= factor ** (1 + 0.001 * number)
        return rows

    return change


def test_a_comparison_does_not_differ_from_itself(run, tmp_path):
    found = differ(run, copied(run, tmp_path), "--fail-on", "change")
    assert (found["changed"], found["worse"]) == (False, False)
    assert {line["ratio"] for line in found["errors"]} == {1.0}
    assert all(line["paired"] and line["targets"] == 14 for line in found["errors"])
    assert (found["configuration"], found["environment"], found["statuses"]) == ([], [], [])


@pytest.mark.parametrize(("factor", "worse"), [(1.1, True), (0.9, False)])
def test_a_small_shift_on_every_target_is_significant_as_pairs(run, tmp_path, factor, worse):
    """A change of 10 % is far smaller than the differences between targets."""
    other = copied(run, tmp_path, scaled(factor))
    found = differ(run, other, "--fail-on", "worse", code=int(worse))
    assert (found["changed"], found["worse"]) == (True, worse)
    moved = [line for line in found["errors"] if line["significant"]]
    assert {line["tuner"] for line in moved} == {"random"}
    assert {line["simulations"] for line in moved} == {3, 4}
    assert [line["ratio"] for line in moved] == pytest.approx([factor] * 2, rel=0.01)
    # Wilcoxon p-value of 14 differences of one sign: 2 / 2**14. Holm multiplies by 4, then by 3.
    assert sorted(line["p_value"] for line in moved) == pytest.approx([2 / 2**14] * 2)
    assert max(line["p_holm"] for line in moved) == pytest.approx(8 / 2**14)


def test_a_shift_on_some_targets_is_chance(run, tmp_path):
    other = copied(run, tmp_path, scaled(1.5, which=slice(0, 3)))
    found = differ(run, other, "--fail-on", "change")
    assert not found["changed"]
    assert min(line["p_value"] for line in found["errors"]) == pytest.approx(0.25)


def test_other_targets_of_the_same_names_are_not_paired(run, tmp_path):
    """With another salt, in-000 is another target."""

    def elsewhere(rows):
        rows["true_rate"] *= 1.01
        return scaled(1.1)(rows)

    found = differ(run, copied(run, tmp_path, elsewhere), "--fail-on", "change")
    assert not found["changed"], "as two samples ten per cent is chance"
    assert not any(line["paired"] for line in found["errors"])
    assert any("not paired" in note for note in found["notes"])


def test_only_seeds_that_both_have_are_compared(run, tmp_path):
    def fewer(rows):
        return rows[~((rows["tuner"] == "random") & (rows["seed"] == 1))]

    other = copied(run, tmp_path, fewer)
    text = (other / "experiment.toml").read_text()
    asked = text.replace(
        '[tuners.random]\ntuner = "random"', '[tuners.random]\nseeds = 1\ntuner = "random"'
    )
    assert asked != text
    (other / "experiment.toml").write_text(asked)
    statuses = pd.read_csv(other / "status.csv", keep_default_na=False)
    kept = ~((statuses["tuner"] == "random") & (statuses["seed"] == 1))
    statuses[kept].to_csv(other / "status.csv", index=False)
    found = result_diff.diff_comparisons(run, other)
    assert set(found.errors["ratio"]) == {1.0}
    assert not found.has_changed, "fewer runs are no failures"


def test_more_failures_are_a_change_for_the_worse_and_fewer_are_not(run, tmp_path):
    other = copied(run, tmp_path)
    statuses = pd.read_csv(other / "status.csv", keep_default_na=False)
    place = statuses.index[statuses["tuner"] == "random"][:2]
    statuses.loc[place, ["status", "reason"]] = ["crashed", "by hand"]
    statuses.to_csv(other / "status.csv", index=False)
    found = differ(run, other, "--fail-on", "worse", code=1)
    assert found["worse"]
    assert {"tuner": "random", "status": "crashed", "a": 0, "b": 2} in found["statuses"]
    assert max(line["failures_b"] for line in found["errors"]) == 2
    found = differ(other, run, "--fail-on", "worse")
    assert (found["changed"], found["worse"]) == (True, False)


def test_configuration_and_environment_that_changed_are_named(run, tmp_path):
    other = copied(run, tmp_path)
    path = other / "experiment.toml"
    before = read_configuration(other).experiment.timeout
    path.write_text(path.read_text().replace(f"timeout = {before}", "timeout = 61.0"))
    made = json.loads((other / "environment.json").read_text())
    made["packages"]["numpy"] = "1.0"
    (other / "environment.json").write_text(json.dumps(made))
    found = differ(run, other)
    assert found["configuration"] == [{"what": "timeout", "a": before, "b": 61.0}]
    (package,) = found["environment"]
    assert (package["what"], package["a"], package["b"]) == (
        "packages.numpy", np.__version__, "1.0"
    )  # fmt: skip


def test_the_table_is_written_once_and_errors_are_reported(run, tmp_path):
    other, out = copied(run, tmp_path, scaled(1.1)), tmp_path / "out.csv"
    found = differ(run, other, "--out", str(out))
    rows = pd.read_csv(out)
    assert list(rows["ratio"]) == pytest.approx([line["ratio"] for line in found["errors"]])
    found = differ(run, other, "--out", str(out), code=2)
    assert "exists" in found["error"]["message"]
    found = differ(run, tmp_path / "none", code=2)
    assert found["error"]["kind"] == "input"


def verdict(**changes):
    """Return a verdict document as written by explain."""

    def estimate(value, half, unit="N*m*s/rad"):
        return {"value": value, "unit": unit, "low": value - half, "high": value + half}

    value, half = changes.pop("coefficient", (4.0e-4, 0.2e-4))
    cause = {
        "effect": changes.pop("effect", "drag.linear"),
        "alternatives": ["friction.coulomb"],
        "says": "the hinge resists in proportion to speed",
        "coefficients": {"coefficient": estimate(value, half)},
        "p_value": 1e-9,
    }
    candidate = {"effect": "drag.linear", "score": 90.0, "p_value": 1e-9, "heldout_gain": 0.9}
    return {
        "verdict": "named", "system": "pendulum", "engine": "batch", "causes": [cause],
        "parameters": {"inertia": estimate(3.3e-3, 1e-5, "kg*m^2")},
        "heldout": None, "candidates": [candidate], "next_experiment": None, "simulations": 9,
        "seconds": 1.0, "cut": None, **changes,
    }  # fmt: skip


def explained(folder, **changes):
    folder.mkdir()
    (folder / "verdict.json").write_text(json.dumps(verdict(**changes)))
    (folder / "extended.toml").write_text('title = "a swing"\n')
    return folder


@pytest.mark.parametrize(
    ("coefficient", "moved"),
    # Half-widths of 0.2 allow a difference of 0.28; with Holm's correction for two numbers, 0.32.
    [((4.2e-4, 0.2e-4), False), ((4.3e-4, 0.2e-4), False), ((4.4e-4, 0.2e-4), True)],
)
def test_a_coefficient_has_moved_where_both_intervals_do_not_allow_it(tmp_path, coefficient, moved):
    a, b = explained(tmp_path / "a"), explained(tmp_path / "b", coefficient=coefficient)
    found = differ(a, b, "--fail-on", "change", code=int(moved))
    assert found["changed"] == moved
    (row,) = found["coefficients"]
    assert (row["name"], row["significant"]) == ("drag.linear coefficient", moved)
    assert found["parameters"][0]["significant"] is False


def test_another_verdict_or_cause_is_a_change(tmp_path):
    a = explained(tmp_path / "a")
    found = differ(a, explained(tmp_path / "b", verdict="ambiguous"))
    assert (found["changed"], found["verdict"]) == (True, {"a": "named", "b": "ambiguous"})
    found = differ(a, explained(tmp_path / "c", effect="drag.quadratic"))
    assert found["changed"]
    assert {"effect": "drag.linear", "in_a": "cause", "in_b": "no"} in found["causes"]
    assert found["coefficients"][0]["significant"] is None, "one of them lacks it"


def test_two_kinds_and_what_is_damaged_are_refused(run, tmp_path):
    a = explained(tmp_path / "a")
    found = differ(a, run, code=2)
    assert "two comparisons or two explanations" in found["error"]["message"]
    found = differ(a, explained(tmp_path / "b", causes=3), code=2)
    assert "expected a verdict" in found["error"]["message"]
    found = differ(a, a, "--fail-on", "worse", code=2)
    assert "for explanations use change" in found["error"]["message"]
