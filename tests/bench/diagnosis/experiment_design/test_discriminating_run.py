import re

import numpy as np
import pytest

from bench.diagnosis.experiment_design.discriminating_run import (
    MIN_DISCRIMINATION_SIGMAS,
    propose_discriminating_run,
)
from sims.core.simulator import Scenario
from sims.systems.pendulum import Pendulum
from tests.bench.diagnosis.explained_samples import fit_model, recording, searched


def fit_each_effect(simulated, sigma, effects, **options):
    """Return a search and one fitted model per effect."""
    search, base = searched(simulated, sigma, candidates=list(effects), **options)
    start = base.fit.theta, base.fit.initial_states
    fits = [fit_model(search.evaluator, search.noise, (name,), *start) for name in effects]
    return search, *map(search.add_fit, fits)


def small_swing(**changes):
    changes = {"noise": ["q=0.003", "qd=0.02"], **changes}
    return recording(runs=1, seconds=1, rate=60, initial=["q=0.3"], **changes)


@pytest.mark.parametrize("free", [(), ("length",)])
def test_the_run_that_differs_most_is_proposed_and_does_tell_them_apart(free):
    effects = ("drag.linear", "drag.quadratic")
    made = small_swing(effects=["drag.quadratic=2e-4"])
    search, model, rival = fit_each_effect(made, [0.003, 0.02], effects, free=free)
    found = propose_discriminating_run(search, model, rival)
    assert found.apart > MIN_DISCRIMINATION_SIGMAS
    assert found.change
    said = re.fullmatch(
        r"(.*): in it the predictions with drag.linear and drag.quadratic differ by (.*) times "
        "the noise",
        found.says,
    )
    assert float(said[2]) == pytest.approx(found.apart, rel=0.01)
    if free:
        return
    track = search.evaluator.prepared_runs[0]
    initial = dict(zip(("q", "qd"), track.initial_state_guess.tolist(), strict=True)) | {
        k: v for k, v in found.change.items() if k in ("q", "qd")
    }
    times = track.scenario.times
    if "seconds" in found.change:
        times = np.arange(2 * times.size - 1) / 60
        assert found.change["seconds"] == pytest.approx(times[-1])
    seen = [
        Pendulum(
            fixed={name: m.fit.theta[search.evaluator.coefficient_slices[name]].tolist()},
            time_step=1e-3,
        ).simulate(m.fit.theta[None, :1], Scenario(times, initial))[0]
        for name, m in zip(effects, (model, rival), strict=True)
    ]
    apart = np.sqrt(np.square((seen[0] - seen[1]) / [0.003, 0.02]).mean())
    assert apart == pytest.approx(found.apart, rel=0.05)


def test_equal_models_are_not_distinguished_by_any_run():
    made = small_swing()
    search, model, _ = fit_each_effect(made, [0.003, 0.02], ("drag.linear", "drag.quadratic"))
    found = propose_discriminating_run(search, model, model)
    assert found.apart == 0
    assert found.change == {}
    assert found.says.startswith("No run of this kind would distinguish")
    assert found.says.endswith("measure one of the causes directly")


def test_what_is_not_recorded_is_proposed_where_no_run_would_do():
    search, model, _ = fit_each_effect(
        small_swing(observe=["q"], noise=["0.003"]), 0.003, ("drag.linear", "drag.quadratic")
    )
    assert propose_discriminating_run(search, model, model).says.endswith("also record qd")


def test_an_input_is_made_smaller_or_larger():
    made = recording("slider", runs=1, seconds=1, rate=50, inputs=["u=square:1:1"], noise=["0.003"],
                     effects=["input.gain=0.2"])  # fmt: skip
    search, model, rival = fit_each_effect(made, 0.003, ("input.deadband", "friction.coulomb"))
    before = search.evaluator.simulation_count
    found = propose_discriminating_run(search, model, rival)
    assert np.isfinite(found.apart)
    assert search.evaluator.simulation_count - before == 2 * (1 + 6 + 2), (
        "twice as long, each state three ways, the input two"
    )
