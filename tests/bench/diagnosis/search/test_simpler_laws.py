"""Tests that a simpler law replaces a richer one that does not fit the data better."""

import numpy as np
import pytest

from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from sims.systems.slider import Slider
from tests.bench.diagnosis.explained_samples import recorded, searched

TIMES = np.arange(200) / 50.0
MASS, NOISE = 1.4, 1e-3


def search(effects, seed=0):
    """Return a search without fits, for a driven slider with these effects."""
    names = list(effects)
    simulator = Slider(observe=["x"], effects=names)
    theta = [MASS, *np.concatenate([np.ravel(c) for c in effects.values()])]
    rng, starts = np.random.default_rng(seed), []
    for number in range(3):
        force = 4 * np.sin(2.3 * TIMES + number) + 2 * np.sin(5.1 * TIMES + rng.uniform(0, 6))
        starts.append(({"x": 0.1}, {"u": force}))
    made, _ = searched(recorded(simulator, theta, starts, TIMES, NOISE), NOISE)
    return made


def fitted(search, names, values):
    """Return the model with these effects, fitted from these coefficients."""
    theta = search.evaluator.get_nominal_theta()
    for name in names:
        theta[search.evaluator.coefficient_slices[name]] = values[name]
    search.refit_models([FitStart(names, theta, search.evaluator.initial_state_guesses)])
    return search.models[frozenset(names)]


@pytest.mark.parametrize(
    ("true_effects", "richer", "kept"),
    [
        ({"friction.coulomb": 0.7}, "friction.stribeck", "friction.coulomb"),
        ({"friction.stribeck": (0.5, 0.9, 0.3)}, "friction.stribeck", "friction.stribeck"),
        ({"drag.linear": 0.6}, "friction.direction", "drag.linear"),
        ({"friction.direction": (0.2, 0.9)}, "friction.direction", "friction.direction"),
    ],
)
def test_the_richer_law_stands_where_it_comes_nearer(true_effects, richer, kept):
    made = search({**true_effects, "force.bias": 0.4})
    values = {"friction.stribeck": (0.5, 0.5, 0.2), "friction.direction": (0.5, 0.4)}
    model = fitted(made, ("force.bias", richer), {**values, "force.bias": 0.3})
    plainer = made.simplify_laws(model)
    assert set(plainer.effects) == {"force.bias", kept}
    if kept != richer:
        place = made.evaluator.coefficient_slices[kept].start
        assert plainer.fit.theta[place] == pytest.approx(true_effects[kept], rel=0.05)


@pytest.mark.parametrize(
    ("true_effects", "kept"),
    [
        ({"friction.coulomb": 0.7, "drag.linear": 0.6}, {"friction.coulomb", "drag.linear"}),
        ({"friction.warming": (0.7, 0.6, 2.0)}, {"friction.warming"}),
    ],
    ids=["far longer than the run", "within it"],
)
def test_a_law_whose_time_the_data_do_not_show_gives_way_to_the_sum_of_its_parts(
    true_effects, kept
):
    """Over 4 s, friction with a time constant of 300 s equals dry plus viscous friction."""
    made = search({**true_effects, "force.bias": 0.4})
    values = {"friction.warming": (0.7, 0.6, 2.0 if len(kept) == 1 else 300.0), "force.bias": 0.3}
    plainer = made.simplify_laws(fitted(made, ("force.bias", "friction.warming"), values))
    assert set(plainer.effects) == {"force.bias", *kept}
    for name in true_effects:
        c = plainer.fit.theta[made.evaluator.coefficient_slices[name]]
        np.testing.assert_allclose(c, true_effects[name], rtol=0.05)


def test_data_far_from_the_model_are_explained_by_the_smaller_model(monkeypatch):
    """With lack of fit, likelihoods mislead: a richer law must reduce the residual clearly."""
    made = search({"friction.coulomb": 0.7, "force.bias": 0.4})
    model = fitted(made, ("friction.stribeck",), {"friction.stribeck": (0.5, 0.5, 0.2)})
    part = fitted(made, ("friction.coulomb",), {"friction.coulomb": 0.5})
    for share, names in ((0.94, model.effects), (0.96, part.effects)):
        excess = {model.effects: share, part.effects: 1.0}
        monkeypatch.setattr(
            made, "compute_excess_residual", lambda m, excess=excess: excess[m.effects]
        )
        better = type(model)(model.fit, model.likelihood, part.penalised_log_likelihood + 5.0)
        assert made.simplify_laws(better).effects == names


def test_a_simpler_law_that_is_known_and_caught_is_fitted_from_the_richer_one():
    """The fit of the simpler law may end where a joint sticks one sample too long."""
    made = search({"friction.coulomb": 0.7, "force.bias": 0.4})
    values = {"friction.coulomb": 0.5, "friction.stribeck": (0.7, 0.0, 0.2), "force.bias": 0.4}
    part = fitted(made, ("force.bias", "friction.coulomb"), values)
    caught = type(part)(part.fit, part.likelihood, part.penalised_log_likelihood - 50.0)
    made.models[frozenset(part.effects)] = caught
    richer = fitted(made, ("force.bias", "friction.stribeck"), values)
    plainer = made.simplify_laws(richer)
    assert set(plainer.effects) == {"force.bias", "friction.coulomb"}
    assert plainer.penalised_log_likelihood > caught.penalised_log_likelihood + 45.0


def test_a_removed_law_continues_in_a_richer_one_that_contains_it(monkeypatch):
    """Without its coefficient, the richer law would begin with far too little friction."""
    made = search({"friction.stribeck": (0.5, 0.9, 0.3), "force.bias": 0.4})
    names = ("friction.coulomb", "friction.stribeck", "force.bias")
    values = {"friction.coulomb": 0.3, "friction.stribeck": (0.2, 0.9, 0.3), "force.bias": 0.4}
    model, starts, refit = fitted(made, names, values), [], made.refit_models
    split = model.fit.theta[[made.evaluator.coefficient_slices[name].start for name in names[:2]]]
    monkeypatch.setattr(made, "refit_models", lambda new: (starts.extend(new), refit(new)))
    kept = made.drop_unneeded_effects(model)
    (start,) = (start for start in starts if start.effects == names[1:])
    first = made.evaluator.coefficient_slices["friction.stribeck"].start
    assert start.theta[first] == pytest.approx(split.sum())
    assert start.theta[made.evaluator.coefficient_slices["friction.coulomb"]] == 0.0
    assert set(kept.effects) == {"friction.stribeck", "force.bias"}
    np.testing.assert_allclose(kept.fit.theta[first : first + 2], (0.5, 0.9), rtol=0.1)
