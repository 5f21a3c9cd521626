"""Which effects are tried in place of another one."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from bench.diagnosis.fitting.levenberg_marquardt import FitStart
from bench.diagnosis.prediction_error import competing_models
from bench.diagnosis.prediction_error.effects_at_joints import list_joint_model_effects
from bench.diagnosis.search import fit_starts
from sims.effects.drag import LinearDrag
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log

PENDULUM = """<mujoco model="pendulum">
<option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="link">
  <joint name="hinge" axis="0 1 0" damping="0.02" armature="0.001"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.8"/>
</body></worldbody>
</mujoco>"""
JOINT_LAWS = ("drag.linear", "friction.coulomb", "inertia.armature")


@pytest.mark.parametrize(
    ("effect", "joint"),
    [
        ("drag.linear@elbow", "elbow"),
        ("input.gain@m_shoulder", "shoulder"),
        # The inertia of a body and the armature of its joint may be one number.
        ("inertia.scale@forearm", "elbow"),
        ("mass.scale@upper_arm", "shoulder"),
    ],
)
def test_laws_of_the_same_joint_compete_with_an_effect(example_arm, effect, joint):
    assert list_joint_model_effects(example_arm, effect) == {f"{law}@{joint}" for law in JOINT_LAWS}


@pytest.mark.parametrize(("lowest_cost", "expected"), [(250.0, [1.25]), (450.0, [])])
def test_a_competing_effect_is_simulated_at_several_coefficients(
    monkeypatch, lowest_cost, expected
):
    """Its best coefficient is a start, unless it leaves 30 % of the squared residual.

    Then coefficients between the neighbours of the best one are tried.
    """
    rounds = [[0.5, 0.8, 1.0, 1.25, 2.0], np.geomspace(1.0, 2.0, 7)[1:-1]]

    def simulate(_context, starts):
        factors = [float(start.theta[0]) for start in starts]
        assert factors == pytest.approx(rounds.pop(0))
        return [(lowest_cost, starts[3])]

    monkeypatch.setattr(competing_models, "is_explained", lambda *_: True)
    monkeypatch.setattr(competing_models, "select_lowest_of_each", simulate)
    monkeypatch.setattr(fit_starts, "compute_coefficient_bounds", lambda *_: [(-np.inf, np.inf)])
    base, best = (SimpleNamespace(fit=SimpleNamespace(cost=cost)) for cost in (1000.0, 100.0))
    context = SimpleNamespace(
        search=SimpleNamespace(base_model=base),
        evaluator=SimpleNamespace(
            get_coefficient_indices=lambda _: [0],
            available_effects={"drag.linear@elbow": LinearDrag()},
        ),
    )
    competing = competing_models._CompetingEffect("drag.linear@elbow", np.ones(1), 1e6)
    start = FitStart(("drag.linear@elbow",), np.ones(1), np.zeros((1, 2)))
    confirmed = competing_models._confirm(context, best, competing, start)
    assert [start.theta[0] for start in (confirmed,) if start] == expected
    assert len(rounds) == len(expected), "a second round only if the first one found none"


def test_a_comparison_ends_between_a_family_and_its_only_acting_member(monkeypatch):
    """The family is likelier, its member needs fewer coefficients, and each leads to the other."""
    member, family = (
        SimpleNamespace(effects=(name,), fit=SimpleNamespace(cost=1.0))
        for name in ("inertia.scale@link", "inertia.scale@*")
    )
    for name in ("_find_competing_effects", "_fit_at_related_places", "_refine_near"):
        monkeypatch.setattr(competing_models, name, lambda *_: [])
    monkeypatch.setattr(competing_models, "has_series", lambda *_: False)
    monkeypatch.setattr(competing_models, "_replace_two_effects", lambda *_: None)
    monkeypatch.setattr(competing_models, "remove_idle_effects", lambda *_: member)
    context = SimpleNamespace(
        search=SimpleNamespace(get_best=lambda _: family),
        evaluator=None,
        filters=SimpleNamespace(
            base=SimpleNamespace(runs=SimpleNamespace(jumps=np.zeros(1, dtype=bool)))
        ),
    )
    assert competing_models.fit_competing_models(context, member) is member


@pytest.mark.parametrize(("loss", "steps"), [(146.0, 2), (5000.0, 0)])
def test_many_coefficients_are_improved_where_the_regression_cannot_decide(loss, steps):
    """The linear regression is wrong by up to 3 % of the gain of the best model, here 20,000."""
    given = []

    def follow_with_effects(theta, names, number=0):
        given.append(number)
        return SimpleNamespace(log_likelihood=10_000.0, theta=theta), names

    best_filter = SimpleNamespace(log_likelihood=10_000.0)
    filters = SimpleNamespace(
        base=SimpleNamespace(log_likelihood=0.0),
        log_likelihood=lambda _: 9_900.0,
        get_filter=lambda _: best_filter,
        compute_gain=lambda followed: 2.0 * followed.log_likelihood,
        follow_with_effects=follow_with_effects,
    )
    competing = competing_models._CompetingEffect("drag.linear@*", np.ones(7), loss)
    start = FitStart(("drag.linear@*", "mass.scale@link"), np.ones(8), np.zeros((1, 14)))
    context = SimpleNamespace(filters=filters)
    assert competing_models._confirm_by_filter(context, None, competing, start) is not None
    assert given == [steps]


def test_one_effect_replaces_two_that_imitate_it(tmp_path):
    """More armature and more damping of a free pendulum are exactly less gravity."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.opt.gravity[2] = -9.3
    rng, times, runs = np.random.default_rng(11), 0.01 * np.arange(300), []
    for start in (0.7, 1.0, 1.3):
        readings = follow(model, np.zeros((300, 0)), 5, start=start)
        noise = rng.normal(0.0, 1e-3, readings.shape)
        runs.append((times, np.zeros((300, 0)), readings + noise))
    description = describe({"q.hinge": "rad"}, 0.001)
    log = write_log(tmp_path, description, "q.hinge", runs, arm=PENDULUM)
    (cause,) = explain(log).answer.causes
    assert {cause.effect, *cause.alternatives} == {"gravity.scale", "gravity.compensation@link"}


@pytest.mark.parametrize(("loss", "is_replaced"), [(-40.0, True), (0.03, True), (5.0, False)])
def test_one_effect_that_acts_like_two_is_preferred(monkeypatch, loss, is_replaced):
    """A tilt of gravity acts like an offset of the first encoder and a gain of gravity."""
    single = SimpleNamespace(effects=("gravity.tilt",), penalised_log_likelihood=1000.0 - loss)
    both = ("sensor.bias@q.upper", "gravity.scale")
    best = SimpleNamespace(effects=both, penalised_log_likelihood=1000.0)
    monkeypatch.setattr(competing_models, "is_nearly_explained", lambda *_: True)
    monkeypatch.setattr(competing_models, "has_series", lambda *_: False)
    monkeypatch.setattr(competing_models, "fit_competing_models", lambda _, model: model)
    context = SimpleNamespace(
        search=SimpleNamespace(models={frozenset(single.effects): single}),
        filters=None,
        proposals=SimpleNamespace(list_alone=lambda: [single]),
        evaluator=SimpleNamespace(search_control=SimpleNamespace(is_over=lambda: False)),
    )
    chosen = competing_models.fit_single_in_place(context, best)
    assert chosen is (single if is_replaced else best)


def test_families_take_no_place_of_effects_at_one_place(monkeypatch):
    """A heavier hip acts nearly like an offset of its servo, and so do offsets of all servos."""
    losses = {
        "input.bias@*": 1.0,
        "sensor.bias@*": 2.0,
        **{f"force.bias@joint{number}": 3.0 + number for number in range(4)},
        "gravity.compensation@*": 9.0,
        "mass.scale@hip": 10.0,
        "mass.scale@thigh": 11.0,
    }
    groups = [SimpleNamespace(effect=name) for name in losses]
    remaining = SimpleNamespace(
        compute_gain=lambda _: 100.0,
        rank_effects=lambda: [(g, 100.0 - losses[g.effect]) for g in groups],
    )
    regression = SimpleNamespace(make_regression_without=lambda _: remaining)
    own = {"sensor.eccentricity@hip": [0]}
    columns = SimpleNamespace(
        regression=lambda _: (regression, own), solve_alone=lambda *_: np.ones(1)
    )
    effects = {name: SimpleNamespace(contains=()) for name in losses}
    evaluator = SimpleNamespace(
        library=list(losses),
        available_effects=effects,
        coefficient_slices={"sensor.eccentricity@hip": slice(0, 1)},
    )
    filters = SimpleNamespace(penalty=lambda _: 0.0)
    context = SimpleNamespace(evaluator=evaluator, columns=columns, filters=filters)
    monkeypatch.setattr(competing_models, "list_joint_model_effects", lambda *_: set())
    monkeypatch.setattr(competing_models, "list_similar_shifts", lambda *_: [])
    fit = SimpleNamespace(theta=np.ones(1))
    model = SimpleNamespace(effects=("sensor.eccentricity@hip",), fit=fit)
    found = competing_models._find_competing_effects(context, model, "sensor.eccentricity@hip")
    # Five effects at one place, and the families that come before the fifth.
    assert [one.effect for one in found] == list(losses)[:-1]
