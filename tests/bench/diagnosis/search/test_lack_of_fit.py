import numpy as np
import pytest

from bench.diagnosis.evaluation.noise_model import compute_sigma_standard_error
from bench.diagnosis.search.lack_of_fit import (
    HatForce,
    assess_lack_of_fit,
    compute_hat_directions,
)
from bench.diagnosis.search.verdict_rules import (
    MAX_AUTOCORRELATED_NOISE_RATIO,
    STRUCTURE_P_VALUE_THRESHOLD,
    STRUCTURE_P_VALUE_THRESHOLD_ESTIMATED_NOISE,
)
from sims.core.effect import Coefficient, Force
from sims.systems.pendulum import Pendulum
from sims.systems.slider import Slider
from tests.bench.diagnosis.explained_samples import recorded, searched

TIMES = np.arange(100) / 50


class Gust(Force):
    """A temporary push that no effect of the library describes."""

    name, says, source = "test.gust", "something pushes for a while", "this test"
    coefficients = (Coefficient("force", ("m/s^2", "N", "N*m"), ((-1, 1), (-1, 1), (-1, 1))),)

    def force(self, c, moment):
        return c[0] * ((moment.t > 0.8) & (moment.t < 1.2)) * np.ones_like(moment.v)


class Patch(Force):
    """Drag in one region of position."""

    name, says, source = "test.patch", "it is rough in one place", "this test"
    coefficients = (Coefficient("drag", ("1/s", "N*s/m", "N*m*s/rad"), ((0, 1), (0, 1), (0, 1))),)

    def force(self, c, moment):
        return -c[0] * moment.v * (np.abs(moment.x - 0.5) < 0.15)


def left(kind, effect, size, starts, seed=0, stated=True, sigma=(0.003, 0.02)):
    simulator = kind(effects=[effect]) if effect else kind()
    theta = [simulator.parameters[0].nominal, *([size] if effect else [])]
    made = recorded(simulator, theta, starts, TIMES, sigma, seed, stated)
    return assess_lack_of_fit(*searched(made, sigma, seed, stated, extra=[HatForce]))


SWINGS = [{"q": 0.8}, {"q": -1.1}, {"q": 0.4, "qd": 2.0}]


@pytest.mark.parametrize("stated", [True, False])
def test_a_gust_is_caught(stated):
    found = left(Pendulum, Gust, 0.02, SWINGS, stated=stated)
    assert found.has_structure
    assert found.p_value < STRUCTURE_P_VALUE_THRESHOLD
    assert found.where == "time, along q"
    assert (found.excess > 2).all()
    assert found.channels_above_noise == ("q", "qd")
    assert (found.excess > MAX_AUTOCORRELATED_NOISE_RATIO).all(), (
        "so much that even an estimated noise is exceeded"
    )


def test_a_rough_place_is_caught():
    found = left(Pendulum, Patch, 1.5e-3, SWINGS)
    assert found.p_value < STRUCTURE_P_VALUE_THRESHOLD
    assert found.where.startswith("position q")


def test_clean_recordings_are_quiet():
    p, excess = [], []
    for seed in range(12):
        found = left(Pendulum, None, 0.0, SWINGS, seed=seed)
        assert not found.has_structure
        assert found.channels_above_noise == ()
        p.append(found.p_value)
        excess.append(found.excess)
    assert np.median(p) > 0.15
    np.testing.assert_allclose(np.mean(excess, axis=0), 1.0, atol=0.02)


def test_noise_that_is_larger_than_stated_is_structure():
    made = recorded(Pendulum(), [3.3e-3], SWINGS, TIMES, (0.003, 0.02), seed=3)
    quiet, loud = (
        searched(made, sigma, extra=[HatForce]) for sigma in ((0.003, 0.02), (0.002, 0.02))
    )
    assert assess_lack_of_fit(*quiet).channels_above_noise == ()
    found = assess_lack_of_fit(*loud)
    assert found.channels_above_noise == ("q",)
    assert found.has_structure
    assert found.excess[0] == pytest.approx(1.5, rel=0.08)
    loud[0].is_noise_stated = np.array([False, True])
    found = assess_lack_of_fit(*loud)
    assert not found.has_structure, "1.5 times an estimated noise is not significant"
    assert (found.p_value_threshold, assess_lack_of_fit(*quiet).p_value_threshold) == (
        STRUCTURE_P_VALUE_THRESHOLD_ESTIMATED_NOISE,
        STRUCTURE_P_VALUE_THRESHOLD,
    ), "one that is not stated"


@pytest.mark.parametrize(("phi", "samples"), [(0.0, 1.0), (0.6, 0.64 / 1.36), (-0.6, 0.64 / 1.36)])
def test_autocorrelated_noise_is_estimated_less_precisely(phi, samples):
    """AR(1) noise reduces the effective number of samples (Bartlett's formula)."""
    assert compute_sigma_standard_error(phi, 200) == pytest.approx(
        1 / np.sqrt(2 * 200 * samples), rel=1e-12
    )


def test_hats_cover_time_position_and_speed():
    made = recorded(Slider(), [1.0], [({}, {"u": np.sin(4 * TIMES)})], TIMES, 0.003)
    search, model = searched(made, 0.003, extra=[HatForce])
    found = compute_hat_directions(search.evaluator, model)
    labels = {probe.effect for probe in found.candidates}
    assert {
        "time, along x",
        "position x, against the motion",
        "speed, against the motion",
        "speed, dry",
    } <= labels
    centres = sorted(p.coefficients[2] for p in found.candidates if p.effect == "time, along x")
    assert centres[0] == pytest.approx(0.0)
    assert centres[-1] <= TIMES[-1] + 1e-9
    np.testing.assert_allclose(np.diff(centres), TIMES[-1] / 6)
    first = next(
        i
        for i, p in enumerate(found.candidates)
        if p.effect == "time, along x" and p.coefficients[2] == centres[2]
    )
    x = found.responses[0, :, search.evaluator.channels.index("x"), first]
    begins = TIMES[np.flatnonzero(np.abs(x) > 1e-6)[0]]
    assert begins == pytest.approx(centres[1], abs=0.06), "nothing moves before the hat does"
    v = found.responses[0, -1, search.evaluator.channels.index("v"), first]
    assert v == pytest.approx(TIMES[-1] / 6, rel=0.02), "impulse of a unit triangle on 1 kg"


def test_without_hats_only_the_stated_noise_speaks():
    made = recorded(Pendulum(), [3.3e-3], SWINGS, TIMES, (0.003, 0.02), seed=4)
    search, model = searched(made, (0.003, 0.02))
    found = assess_lack_of_fit(search, model)
    assert (found.p_value, found.where, found.has_structure) == (1.0, "", False)
