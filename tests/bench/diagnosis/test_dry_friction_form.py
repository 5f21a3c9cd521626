"""Tests that explain distinguishes MuJoCo's soft dry friction from the stiff form and writes it.

Plain MuJoCo makes the motion, from a model file with `frictionloss` at the elbow.
"""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bench.diagnosis.dry_friction_form import (
    get_friction_form,
    has_dry_friction,
    make_soft_kind,
)
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.explain import explain
from bench.diagnosis.fitting.base_fit import fit_base_model
from bench.diagnosis.fitting.fitted_models import ModelSet
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.pipeline import cause_search
from bench.diagnosis.prediction_error import dry_friction_fits
from bench.diagnosis.prediction_error.dry_friction_fits import (
    SoftFrictionError,
    choose_friction_form,
)
from bench.diagnosis.score_extended import score_model
from bench.diagnosis.search.alternative_causes import CauseEvidence
from bench.diagnosis.search.diagnose import DiagnosisResult
from bench.diagnosis.search.lack_of_fit import assess_lack_of_fit
from bench.diagnosis.search.verdict_rules import INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO
from bench.logs.recording_joining import load_joined
from sims.extended_simulator import read_extended
from tests.bench.diagnosis.explained_samples import white
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log
from tests.bench.diagnosis.verdict_schema import check
from tests.sims.robot.test_dry_friction import ARM

NOISE, PLANTED = 1e-3, 0.06
FORMS = {
    "soft": "",
    # Parameters of the stiff form for 2 ms steps of `implicitfast`.
    "stiff": 'solreffriction="0.004 1" solimpfriction="0.9999 0.9999 0.001"',
}
UNITS = {"u.m1": "N*m", "u.m2": "N*m", "q.shoulder": "rad", "q.elbow": "rad"}


def recorded(folder, form, friction=PLANTED, seconds=2.0):
    """Write a log of three runs, with a model file without friction; return its path."""
    rng, runs = np.random.default_rng(8), []
    loss = f'frictionloss="{friction}" {FORMS[form]}'
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator="implicitfast", elbow=loss))
    times = 0.01 * np.arange(round(100 * seconds) + 1)
    for _ in range(3):
        rates, phases = rng.uniform(3, 9, 2), rng.uniform(0, 6, 2)
        torques = np.array([0.8, 0.3]) * np.sin(times[:, None] * rates + phases)
        readings = follow(model, torques, 5, start=rng.uniform(-0.5, 0.5, 2))
        runs.append((times, torques, readings + NOISE * rng.standard_normal(readings.shape)))
    description = describe(UNITS, NOISE, "[runs.3]\nheld_out = true\n")
    known = ARM.format(integrator="implicitfast", elbow="")
    return write_log(folder, description, ",".join(UNITS), runs, arm=known)


def fitted(path, name):
    """Return the models with stiff friction, that with this effect, and the soft run evaluator."""
    recording, kind = load_joined([path], None, None, ())

    def evaluator(of):
        return RunEvaluator(of, recording, recording.training(), None, candidates=CANDIDATES)

    stiff = evaluator(kind)
    noise = white(stiff, NOISE)
    base = fit_base_model(stiff, noise)
    rng = np.random.default_rng(0)
    models = ModelSet(stiff, noise, base.fixed_parameters, rng, np.ones(2, dtype=bool))
    models.refit_models(
        [FitStart((name,), base.fit.theta, base.fit.initial_states)], is_racing=False
    )
    return models, models.models[frozenset([name])], evaluator(make_soft_kind(kind))


CANDIDATES = ["drag.linear@elbow", "friction.coulomb@elbow", "friction.hysteresis@elbow"]


@pytest.mark.parametrize("form", FORMS)
def test_the_form_that_was_planted_fits_better(tmp_path, form):
    name = "friction.coulomb@elbow"
    models, stiff, other = fitted(recorded(tmp_path, form), name)
    soft = choose_friction_form(models, stiff, other, INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO)
    assert (soft is not None) == (form == "soft")
    best, evaluator = (stiff, models.evaluator) if soft is None else (soft, other)
    assert best.effects == (name,)
    assert best.fit.theta[evaluator.get_coefficient_indices(name)[0]] == pytest.approx(
        PLANTED, rel=0.03
    )
    assert abs(models.compute_excess_residual(best)) < 0.1
    assert get_friction_form(evaluator, name) == ("soft" if form == "soft" else None)
    assert get_friction_form(other, "drag.linear@elbow") is None


def test_what_imitates_soft_friction_is_fitted_as_soft_friction(tmp_path):
    """Hysteresis contains dry friction, and its force is equal in both forms."""
    models, hysteresis, other = fitted(recorded(tmp_path, "soft"), "friction.hysteresis@elbow")
    soft = choose_friction_form(models, hysteresis, other, INDISTINGUISHABLE_LOG_LIKELIHOOD_RATIO)
    assert soft is not None
    assert soft.effects == ("friction.coulomb@elbow",)
    assert soft.fit.theta[other.get_coefficient_indices(soft.effects[0])[0]] == pytest.approx(
        PLANTED, rel=0.03
    )
    assert has_dry_friction(models.evaluator, ["friction.hysteresis@elbow"])
    assert not has_dry_friction(models.evaluator, ["drag.linear@elbow"])


def names_friction_alone(search, held_out):
    """Replace the search: return the planted effect without the time of a search."""
    effect = "friction.coulomb@elbow"
    base = search.base_model
    search.refit_models([replace(base.fit.make_start(), effects=(effect,))], is_racing=False)
    model = search.models[frozenset([effect])]
    thetas = [base.fit.theta, model.fit.theta]
    measured = dict(zip([(), (effect,)], held_out.fit_initial_states(thetas), strict=True))
    gain = model.likelihood.value - base.likelihood.value
    causes = (CauseEvidence(effect, (), 0.0, gain),)
    return DiagnosisResult(
        "named", model, base, causes, assess_lack_of_fit(search, model), (), measured
    )


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_explain_says_the_form_and_its_files_reproduce_it(tmp_path, monkeypatch, form):
    monkeypatch.setattr(cause_search, "diagnose", names_friction_alone)
    path = recorded(tmp_path, form)
    found = explain(path)
    (cause,) = found.causes
    assert cause.effect == "friction.coulomb@elbow"
    assert cause.coefficients["coefficient"].value == pytest.approx(PLANTED, rel=0.03)
    paths = {one.name: one for one in found.write(tmp_path / "out")}
    (stated,) = check(paths["verdict.json"].read_text())["causes"]
    assert stated.get("form") == cause.form == ("soft" if form == "soft" else None)
    words = "in MuJoCo's soft form (solreffriction 0.02 1)"
    assert (words in found.story.verdict.causes[0].says) == (form == "soft")
    assert read_extended(paths["extended.toml"]).robot.friction_form == form
    xml = paths["extended.xml"].read_text()
    assert ("solreffriction=" in xml) == (form == "stiff")
    errors = [score_model(paths[f"extended.{kind}"], path) for kind in ("toml", "xml")]
    assert errors[0]["normalised_rmse"] == pytest.approx(errors[1]["normalised_rmse"], rel=1e-6)
    assert errors[0]["normalised_rmse"] < 1.1


@pytest.mark.long
def test_the_form_of_friction_that_is_free_is_chosen_too(tmp_path, monkeypatch):
    """The form is a parameter, not a cause: the files contain it and the user is informed."""

    def names_nothing(search, _):
        return DiagnosisResult(
            "adequate",
            search.base_model,
            search.base_model,
            (),
            assess_lack_of_fit(search, search.base_model),
        )

    monkeypatch.setattr(cause_search, "diagnose", names_nothing)
    said = []
    path = recorded(tmp_path, "soft")
    found = explain(path, free=["frictionloss@elbow"], say=said.append)
    number = found.answer.parameters["friction.coulomb@elbow"]
    assert number.value == pytest.approx(PLANTED, rel=0.03)
    assert cause_search.SOFT_FRICTION in said
    paths = {one.name: one for one in found.write(tmp_path / "out")}
    assert read_extended(paths["extended.toml"]).robot.friction_form == "soft"
    assert "solreffriction=" not in paths["extended.xml"].read_text()
    assert score_model(paths["extended.xml"], path)["normalised_rmse"] < 1.1


@pytest.mark.parametrize(("soft_cost", "is_soft"), [(90.0, True), (110.0, False)])
def test_a_soft_form_that_is_likelier_must_leave_a_smaller_residual(
    monkeypatch, soft_cost, is_soft
):
    """With autocorrelated noise, a smoother residual may be likelier although it is larger."""

    def make_model(cost, log_likelihood):
        return SimpleNamespace(
            fit=SimpleNamespace(cost=cost), likelihood=SimpleNamespace(value=log_likelihood)
        )

    soft = make_model(soft_cost, 50.0)
    monkeypatch.setattr(dry_friction_fits, "_refit_with_other_form", lambda *_: soft)
    chosen = dry_friction_fits.choose_friction_form(None, make_model(100.0, 0.0), None, 10.0)
    assert (chosen is soft) == is_soft


@pytest.mark.parametrize(
    ("effects", "soft_searches"),
    [
        (("friction.coulomb@elbow",), 1),
        (("friction.coulomb@shoulder",), 2),
        (None, 1),
    ],
)
def test_a_soft_search_is_repeated_only_for_a_model_that_it_did_not_fit(
    monkeypatch, effects, soft_searches
):
    """Filters and then fits find the soft form; the soft search in between explains nothing."""
    start = None if effects is None else FitStart(effects, np.zeros(1), np.zeros((1, 2)))
    errors = [SoftFrictionError(start, is_preliminary=True), SoftFrictionError(start)]
    fitted_models = {frozenset(["friction.coulomb@elbow"]): None}
    results, said = [], []

    def find_soft_form(*_):
        raise errors.pop(0)

    def search_with_soft_friction(*_):
        said.append(cause_search.SOFT_FRICTION)
        search = SimpleNamespace(models=fitted_models)
        results.append(SimpleNamespace(search=search, is_explained=False))
        return results[-1]

    monkeypatch.setattr(cause_search.CauseSearch, "_find_causes", find_soft_form)
    monkeypatch.setattr(
        cause_search.CauseSearch, "_search_with_soft_friction", search_with_soft_friction
    )
    context = SimpleNamespace(
        say=said.append, search_control=SimpleNamespace(is_over=lambda: False)
    )
    runs = SimpleNamespace(
        context=context,
        kind=SimpleNamespace(has_model=True),
        make_rng=lambda: None,
        create_search=lambda *_, **__: SimpleNamespace(),
    )
    base = SimpleNamespace(runs=runs, fit=None)
    assert cause_search.CauseSearch(None).search(base) is results[-1]
    assert (len(results), errors) == (soft_searches, [])
    # The last message is that of the returned result.
    assert said[-2:] == [cause_search.STIFF_FRICTION, cause_search.SOFT_FRICTION]


@pytest.mark.parametrize(
    ("verdict", "soft_verdict", "is_incomplete", "chosen"),
    [
        ("partial", "named", False, "soft"),
        ("partial", "partial", False, "stiff"),
        # Nothing is left to explain, or far more than the other form could change.
        ("named", None, False, "stiff"),
        ("partial", None, True, "stiff"),
    ],
)
def test_forms_are_compared_if_friction_leaves_more_than_noise(
    monkeypatch, verdict, soft_verdict, is_incomplete, chosen
):
    """The search does not compare them if stiff friction nearly explains the runs."""

    def make_result(verdict):
        model = SimpleNamespace(effects=("friction.coulomb@elbow",))
        finding = SimpleNamespace(verdict=verdict, model=model, is_incomplete=is_incomplete)
        is_explained = verdict == "named"
        return SimpleNamespace(finding=finding, errors=(), is_explained=is_explained)

    def search_with_soft_friction(_, base, search, start):
        assert (base.fit, search, start) == ("base fit", "search", "soft start")
        said.append(cause_search.SOFT_FRICTION)
        return results["soft"]

    said, results = [], {"stiff": make_result(verdict), "soft": make_result(soft_verdict)}
    soft_model = SimpleNamespace(fit=SimpleNamespace(make_start=lambda: "soft start"))
    monkeypatch.setattr(cause_search, "has_dry_friction", lambda _, names: bool(names))
    monkeypatch.setattr(dry_friction_fits, "refit_if_likelier_soft", lambda *_: soft_model)
    monkeypatch.setattr(cause_search.CauseSearch, "_find_causes", lambda *_: results["stiff"])
    monkeypatch.setattr(
        cause_search.CauseSearch, "_search_with_soft_friction", search_with_soft_friction
    )
    control = SimpleNamespace(is_over=lambda: False)
    runs = SimpleNamespace(
        context=SimpleNamespace(say=said.append, search_control=control),
        kind=SimpleNamespace(has_model=True),
        fitting=None,
        make_rng=lambda: None,
        create_search=lambda *_: "search",
    )
    base = SimpleNamespace(runs=runs, fit="base fit")
    assert cause_search.CauseSearch(None).search(base) is results[chosen]
    messages = [cause_search.SOFT_FRICTION, cause_search.STIFF_FRICTION]
    assert said == messages[: 0 if soft_verdict is None else 1 if chosen == "soft" else 2]
