"""Tests of the bounce shot: the planner against closed forms without air, the world against an
independent integrator.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.bounce_shot.shot_config import BALL_KINDS, get_ball_kind
from bench.bounce_shot.shot_geometry import ShotGeometry, compute_hoop_crossings
from bench.bounce_shot.shot_planner import PlanningModel, plan_shot
from bench.bounce_shot.true_world import (
    AIR_DENSITY,
    CONTACT_SECONDS,
    GRAVITY,
    InclinedGround,
    simulate_shot,
)
from sims.core.simulator import InputError, Scenario
from sims.systems.bounce_shot import BounceShot

ANGLE, RADIUS, E = 0.35, 0.03, 0.75
HEIGHTS = (0.2, 3.0)
FINE = 1e-5  # the crossing is on a chord of 1/240 s, whose sag is g / 8 / 240^2


def launch(height, restitution=E, kept=1.0, angle=ANGLE):
    """Return the velocity (vx, vz) after a fall from `height`: normal speed times -e, tangential
    speed times `kept`.
    """
    v = math.sqrt(2 * GRAVITY * height)
    away, along = restitution * v * math.cos(angle), kept * v * math.sin(angle)
    return along * math.cos(angle) + away * math.sin(angle), away * math.cos(
        angle
    ) - along * math.sin(angle)


def landing(height, drop, kept=1.0, restitution=E):
    """Return x at which the centre is `drop` below its height at contact."""
    vx, vz = launch(height, restitution, kept)
    return vx * (vz + math.sqrt(vz**2 + 2 * GRAVITY * drop)) / GRAVITY


def path(height, friction=0.0, inertia=0.4, effects=None, seconds=0.9, rate=1000):
    times = np.arange(round(seconds * rate)) / rate
    known = {"drop_height": height, "incline_angle": ANGLE, "radius": RADIUS, "friction": friction}
    scenario = Scenario(times, constants={**known, "inertia_ratio": inertia})
    return times, BounceShot(fixed=effects or {}).simulate(np.array([[E]]), scenario)[0]


def test_drop_without_friction_leaves_the_incline_as_in_closed_form():
    times, seen = path(1.2)
    fall = math.sqrt(2 * 1.2 / GRAVITY)
    t = times[times > fall + 1e-9] - fall
    vx, vz = launch(1.2)
    expected = np.stack(
        [vx * t, 0 * t, RADIUS / math.cos(ANGLE) + vz * t - GRAVITY / 2 * t**2], axis=1
    )
    ahead = expected[:, 2] > -expected[:, 0] * math.tan(ANGLE) + RADIUS / math.cos(
        ANGLE
    )  # still in the air
    assert ahead.sum() > 300
    np.testing.assert_allclose(seen[times > fall + 1e-9][ahead], expected[ahead], atol=1e-9)
    assert seen[0].tolist() == [0.0, 0.0, pytest.approx(1.2 + RADIUS / math.cos(ANGLE))]


@pytest.mark.parametrize(("friction", "inertia", "kept"), [
    (1.0, 0.4, 5 / 7),  # rolls: a solid sphere keeps 5/7 of its tangential speed, a shell 3/5
    (1.0, 2 / 3, 3 / 5),
    (0.02, 0.4, 1 - 0.02 * (1 + E) / math.tan(ANGLE)),  # slides during the whole impact
])  # fmt: skip
def test_friction_takes_tangential_speed_until_the_ball_grips(friction, inertia, kept):
    times, seen = path(1.2, friction, inertia)
    fall = math.sqrt(2 * 1.2 / GRAVITY)
    k = int(np.searchsorted(times, fall + 0.1))
    vx, _ = launch(1.2, kept=kept)
    assert seen[k, 0] == pytest.approx(vx * (times[k] - fall), abs=1e-9)


def test_drag_acts_against_the_velocity_in_the_rooms_frame():
    """The reference integrator uses room coordinates, not those of the incline."""
    c = 0.2
    times, seen = path(1.2, effects={"drag.quadratic": c}, seconds=0.7)

    def motion(_, y):
        speed = math.hypot(y[2], y[3])
        return [y[2], y[3], -c * speed * y[2], -GRAVITY - c * speed * y[3]]

    def touches(_, y):
        return y[0] * math.sin(ANGLE) + y[1] * math.cos(ANGLE) - RADIUS

    touches.terminal, touches.direction = True, -1
    exact = {"rtol": 1e-10, "atol": 1e-12, "events": touches, "dense_output": True}
    fall = solve_ivp(motion, (0, 0.7), [0, 1.2 + RADIUS / math.cos(ANGLE), 0, 0], **exact)
    x, z, vx, vz = fall.y[:, -1]
    n = np.array([math.sin(ANGLE), math.cos(ANGLE)])
    v = np.array([vx, vz]) - (1 + E) * (np.array([vx, vz]) @ n) * n
    flight = solve_ivp(motion, (fall.t[-1], 0.7), [x, z, *v], **exact)
    late = times > fall.t[-1]
    np.testing.assert_allclose(seen[late][:, [0, 2]], flight.sol(times[late])[:2].T, atol=2e-6)


def scene_at(height, drop=0.1, kept=1.0, radius=0.15):
    touching = RADIUS / math.cos(ANGLE)
    return ShotGeometry(ANGLE, landing(height, drop, kept), touching - drop, radius)


def planned(restitution=E, friction=0.0):
    known = {"radius": RADIUS, "friction": friction}
    return PlanningModel(BounceShot(), np.array([restitution]), known)


@pytest.mark.parametrize("height", [0.6, 1.3, 2.4])
def test_planner_finds_the_height_of_the_closed_form(height):
    found = plan_shot(planned(), scene_at(height), HEIGHTS)
    assert found.height == pytest.approx(height, abs=1e-3)
    assert found.rim_margin == pytest.approx(0.15, abs=1e-3)


def test_level_launch_and_landing_need_a_height_in_proportion_to_the_distance():
    """Landing at the height of launch: x = 4 a b h with vx = a v, vz = b v."""
    vx, vz = launch(1.0, kept=5 / 7)
    x = 4 * vx * vz / (2 * GRAVITY)
    scene = ShotGeometry(ANGLE, 1.1, RADIUS / math.cos(ANGLE), 0.1)
    found = plan_shot(planned(friction=1.0), scene, HEIGHTS)
    assert found.height == pytest.approx(1.1 / x, abs=1e-3)


def test_hoop_out_of_reach_is_a_plan_that_expects_to_miss_and_dead_ball_none():
    far = ShotGeometry(ANGLE, 9.0, -0.1, 0.15)
    found = plan_shot(planned(), far, HEIGHTS)
    assert found.is_found
    assert found.height == pytest.approx(3.0, abs=1e-9)
    assert found.rim_margin == pytest.approx(
        0.15 - (9.0 - landing(3.0, 0.1 + RADIUS / math.cos(ANGLE))), abs=1e-3
    )
    dead = plan_shot(planned(0.0), ShotGeometry(ANGLE, 1.0, 0.2, 0.15), HEIGHTS)
    assert not dead.is_found
    assert math.isnan(dead.rim_margin)
    with pytest.raises(InputError, match="drop heights above 0"):
        plan_shot(planned(), far, (2.0, 1.0))


def test_where_a_path_comes_through_the_hoop_counts_after_its_bounce():
    scene = ShotGeometry(ANGLE, 1.0, 0.5, 0.2)
    falls = [(0, 0, 1), (0, 0, 0.2), (0.4, 0, 0.6), (0.8, 0.06, 0.7), (1.0, 0.12, 0.3)]
    low = [(0, 0, 1), (0, 0, 0.2), (0.4, 0, 0.45), (0.8, 0, 0.4), (1.0, 0, 0.3)]
    where = compute_hoop_crossings(np.array([falls, low], dtype=float), scene)
    twice = [(0, 0, 1), (0, 0, 0.2), (0.4, 0, 0.8), (0.6, 0, 0.55), (0.9, 0, 0.7), (1.0, 0, 0.3)]
    assert np.isnan(
        compute_hoop_crossings(np.array([twice], dtype=float), scene)
    ).all()  # it hit something before the hoop
    np.testing.assert_allclose(where[0], [0.9, 0.09])
    assert np.isnan(where[1]).all()


def drag_of(ball):
    return 0.5 * AIR_DENSITY * ball.drag * math.pi * ball.radius**2 / ball.mass


def test_world_falls_as_scipy_integrates():
    ball = BALL_KINDS["table-tennis"]
    times = np.arange(0, 0.6, 1 / 60)
    c = drag_of(ball)
    exact = solve_ivp(
        lambda _, y: [y[1], -GRAVITY - c * abs(y[1]) * y[1]],
        (0, 0.6),
        [3, 0],
        t_eval=times,
        rtol=1e-10,
        atol=1e-12,
    )
    seen = simulate_shot(ball, InclinedGround(), (0.0, 0.0, 3.0), times)
    assert (3 - exact.y[0]).max() < 1.75 - 0.03  # a fall without air: 1.766 m
    np.testing.assert_allclose(seen[:, 2], exact.y[0], atol=6e-5)  # drag is constant within a step


@pytest.mark.parametrize("restitution", [0.4, 0.75, 0.95])
def test_world_gives_the_restitution_asked_for(restitution):
    """The height of the first bounce without air gives the restitution; it includes the depth of
    the contact, about v CONTACT / pi.
    """
    ball = replace(BALL_KINDS["tennis"], restitution=restitution, exponent=0.0)
    times = np.arange(0, 1.2, 1e-3)
    z = (
        simulate_shot(ball, InclinedGround(), (0, 0, 1.0 + ball.radius), times, air=0.0)[:, 2]
        - ball.radius
    )
    fall = math.sqrt(2 / GRAVITY)
    rebound = z[times > fall + CONTACT_SECONDS].max()
    assert math.sqrt(rebound) == pytest.approx(restitution, abs=0.004)
    assert times[np.argmax(np.where(times > fall + CONTACT_SECONDS, z, 0))] == pytest.approx(
        fall + CONTACT_SECONDS + restitution * fall, abs=3e-3
    )


def test_world_restitution_falls_with_speed_as_its_exponent_says():
    ball = replace(BALL_KINDS["tennis"], restitution=0.8, speed=4.0, exponent=-0.2)
    times = np.arange(0, 1.4, 1e-3)
    rebounds = []
    for height in (0.3, 1.5):
        z = (
            simulate_shot(ball, InclinedGround(), (0, 0, height + ball.radius), times, air=0.0)[
                :, 2
            ]
            - ball.radius
        )
        fall = math.sqrt(2 * height / GRAVITY)
        rebounds.append(
            math.sqrt(z[(times > fall + CONTACT_SECONDS) & (times < fall * 2.8)].max() / height)
        )
    assert rebounds[0] / rebounds[1] == pytest.approx((1.5 / 0.3) ** 0.1, abs=0.01)
    assert rebounds[1] == pytest.approx(
        0.8 * (math.sqrt(2 * GRAVITY * 1.5) / 4.0) ** -0.2, abs=0.005
    )


@pytest.mark.parametrize(
    ("friction", "inertia", "kept"), [(0.0, 0.4, 1.0), (0.5, 0.4, 5 / 7), (0.5, 2 / 3, 3 / 5)]
)
def test_world_bounces_off_the_incline_as_an_impact_would(friction, inertia, kept):
    ball = replace(BALL_KINDS["golf"], restitution=E, exponent=0.0, inertia_ratio=inertia)
    height, touching = 1.2, ball.radius / math.cos(ANGLE)
    times = np.arange(0, 1.6, 1 / 240)
    seen = simulate_shot(
        ball, InclinedGround(ANGLE, friction), (0, 0, height + touching), times, air=0.0
    )
    place = compute_hoop_crossings(seen[None], ShotGeometry(ANGLE, 1.0, touching, 0.2))[0]
    vx, vz = launch(height, kept=kept)
    assert place[0] == pytest.approx(
        2 * vx * vz / GRAVITY, rel=0.012
    )  # the impact takes 3 ms, 1.5 cm at 5 m/s
    assert place[1] == pytest.approx(0.0, abs=1e-12)


def test_world_spin_bends_the_path_downward_as_lift_of_topspin():
    """A topspin ball that rolls at impact has w = v_t / r; its lift, integrated by SciPy from the
    launch, shortens the flight.
    """
    ball = replace(BALL_KINDS["table-tennis"], restitution=E, exponent=0.0)
    touching = ball.radius / math.cos(ANGLE)
    times, scene = np.arange(0, 1.6, 1 / 240), ShotGeometry(ANGLE, 1.0, touching, 0.2)
    seen = simulate_shot(ball, InclinedGround(ANGLE, 0.5), (0, 0, 1.2 + touching), times)
    fall_speed = math.sqrt(GRAVITY / drag_of(ball) * (1 - math.exp(-2 * drag_of(ball) * 1.2)))
    kept = 1 / (1 + ball.inertia_ratio)
    vx, vz = (v * fall_speed / math.sqrt(2 * GRAVITY * 1.2) for v in launch(1.2, kept=kept))
    spin = kept * fall_speed * math.sin(ANGLE) / ball.radius
    c, lift = drag_of(ball), 0.5 * AIR_DENSITY * math.pi * ball.radius**3 / ball.mass * spin

    def motion(_, y):
        pull = c * math.hypot(y[2], y[3])
        return [y[2], y[3], -pull * y[2] + lift * y[3], -GRAVITY - pull * y[3] - lift * y[2]]

    def lands(_, y):
        return y[1]

    lands.terminal, lands.direction = True, -1
    flown = solve_ivp(motion, (0, 2), [0, 1e-9, vx, vz], events=lands, rtol=1e-9, atol=1e-12)
    assert compute_hoop_crossings(seen[None], scene)[0, 0] == pytest.approx(
        flown.y[0, -1], rel=0.015
    )
    without = 2 * vx * vz / GRAVITY
    assert flown.y[0, -1] < 0.95 * without


def test_every_ball_states_its_source_and_bounces_within_the_heights_of_its_rules():
    rules = {
        "table-tennis": (0.305, 0.240, 0.260),
        "tennis": (2.54, 1.35, 1.47),
        "basketball": (1.8, 0.96, 1.16),
    }
    for name, (drop, low, high) in rules.items():
        ball = get_ball_kind(name)
        assert low <= ball.restitution**2 * drop <= high
        assert ball.speed == pytest.approx(math.sqrt(2 * GRAVITY * drop), rel=0.01)
    assert len(BALL_KINDS) == 6
    assert all(len(ball.source) > 20 for ball in BALL_KINDS.values())
    one = get_ball_kind("squash").draw_ball(np.random.default_rng(0))
    assert abs(one.restitution - 0.543) <= 0.031
    with pytest.raises(InputError, match="unknown ball 'moon'; there are: basketball"):
        get_ball_kind("moon")
