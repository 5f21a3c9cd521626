import numpy as np
import pytest

from bench.benchmark.runner.standalone_tuning import StandaloneProblem, run_tuner
from sims.core.simulator import InputError, Parameter

TRUE_PARAMETERS = np.array([3.0, 2e-3])
PARAMETERS = [
    Parameter("stiffness", "N/m", 5.0, (1.0, 9.0)),
    Parameter("inertia", "kg m^2", 1e-3, (1e-4, 1e-2), log=True),
]


def problem(evaluated):
    """Fit a line with intercept and slope TRUE_PARAMETERS; append each evaluated point to
    `evaluated`."""
    times = np.linspace(0.0, 1.0, 8)

    def line(theta):
        return theta[..., :1] + 1e3 * theta[..., 1:] * times

    observed = line(TRUE_PARAMETERS)[:, None]

    def evaluate(theta):
        evaluated.extend(theta.tolist())
        simulated = line(theta)[:, :, None]
        return simulated, np.sqrt(np.square(simulated - observed).mean(axis=(1, 2)))

    start = np.array([p.nominal for p in PARAMETERS])
    return StandaloneProblem(PARAMETERS, start, observed, np.ones(1), (8,), evaluate)


def rng():
    return np.random.default_rng(1)


def test_a_registered_tuner_works_in_physical_units_from_the_start_within_its_budget():
    evaluated = []
    best = run_tuner("least_squares", problem(evaluated), 40, 60.0, rng())
    assert best == pytest.approx(TRUE_PARAMETERS, rel=1e-3)
    assert evaluated[0] == pytest.approx([5.0, 1e-3]), "the first simulation is that of the start"
    assert 5 < len(evaluated) <= 40
    lows, highs = zip(*(p.bounds for p in PARAMETERS), strict=True)
    # log-scaled bounds are converted to logarithms and back
    assert (np.array(evaluated) >= np.array(lows) * (1.0 - 1e-12)).all()
    assert (np.array(evaluated) <= np.array(highs) * (1.0 + 1e-12)).all()


def test_the_same_seed_gives_the_same_recommendation():
    one, two = (run_tuner("random", problem([]), 12, 60.0, rng()) for _ in range(2))
    assert one.tolist() == two.tolist()


def test_a_tuner_that_must_be_trained_is_refused():
    with pytest.raises(InputError, match="tuner tunenet must be trained first; expected one that"):
        run_tuner("tunenet", problem([]), 12, 60.0, rng())
