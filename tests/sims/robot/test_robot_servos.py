"""Tests of the servo law in a robot: dead zone, D term on the error, rate limit, motion profile."""

import numpy as np
import pytest

from sims.core.simulator import Scenario
from tests.sims.robot.test_robot_motion import kind_of

MASS, LENGTH, KP, KV = 0.8, 0.3, 20.0, 2.0
ARM = f"""
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0"/>
      <inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="0.001 0.001 0.001"/>
    </body>
  </worldbody>
  <actuator>
    <position name="m" joint="hinge" kp="{KP}" kv="{KV}" gear="2"/>
  </actuator>
</mujoco>
"""
FREE = ARM.replace("<option ", '<option gravity="0 0 0" ')
TIMES = np.arange(0, 3, 0.01)


def seen(effects, command, text=ARM, **initial):
    """Simulate effects, given by coefficients; return the joint's angle, (T,)."""
    kind = kind_of(text)
    placed = [kind.system.effect(name) for name in effects]
    simulator = kind(observe=["q.hinge"], effects=placed)
    theta = np.concatenate([[], *(np.ravel(c) for c in effects.values())])[None]
    given = {c.name: np.zeros(TIMES.size) for c in simulator.inputs}
    given["u.m"] = np.broadcast_to(command, TIMES.shape)
    begin = {f"{key}.hinge": value for key, value in initial.items()}
    return simulator.simulate(theta, Scenario(TIMES, begin, given))[0][:, 0]


@pytest.mark.parametrize("begin", [0.0, 0.03, -0.049])
def test_within_its_dead_zone_a_servo_leaves_the_joint_where_it_is(begin):
    # the control is the length of the transmission with gear 2: q is half of it
    q = seen({"servo.deadband@m": 0.1}, 0.0, FREE, q=begin)
    assert q == pytest.approx(begin, abs=1e-9)
    assert seen({"servo.deadband@m": 0.0}, 0.0, FREE, q=begin)[-1] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("stiffer", [0.0, 0.6])
def test_an_arm_hangs_lower_by_the_dead_zone_with_the_gain_that_the_servo_has(stiffer):
    width = 0.06
    effects = {"servo.deadband@m": width, "actuator.stiffness@m": stiffer}
    q = seen(effects, 1.6, q=0.7)[-1]
    pulled = 2 * KP * (1 + stiffer) * (1.6 - 2 * q - width)
    assert pulled == pytest.approx(MASS * 9.81 * LENGTH * np.sin(q), rel=1e-3)


def test_a_d_term_on_the_error_takes_the_lag_of_a_ramp_away():
    """A servo lags a ramp by the time kv / kp; the lead compensates it."""
    ramp = 0.5 * TIMES
    plain, led = (seen({"servo.derivative@m": c}, ramp, FREE)[-50:] for c in (0.0, KV / KP))
    # a zero-order hold delays by half a sample
    held = 0.25 * 0.005
    assert ramp[-50:] / 2 - plain == pytest.approx(0.25 * KV / KP + held, rel=1e-2)
    assert ramp[-50:] / 2 - led == pytest.approx(held, abs=2e-4)


def test_a_limit_of_the_rate_makes_the_servo_follow_a_ramp():
    step = np.where(TIMES >= 0.5, 1.0, 0.0)
    ramp = np.clip(TIMES - 0.5, 0.0, 0.5) * 2.0
    limited = seen({"input.rate@m": 2.0}, step, FREE)
    # the command of the ramp is held from sample to sample: a delay of half a sample
    assert limited == pytest.approx(seen({"input.delay@m": -0.005}, ramp, FREE), abs=2e-4)


def test_a_motion_profile_makes_the_servo_follow_a_ramp_that_bends():
    """A jump of 1 at 4 per s^2: 0.5 s to speed up, 0.5 s to brake."""
    begun = np.clip(TIMES - 0.5, 0.0, 1.0)
    bent = np.where(begun < 0.5, 2 * begun**2, 1 - 2 * (1 - begun) ** 2)
    profiled = seen({"servo.profile@m": 4.0}, np.where(TIMES >= 0.5, 1.0, 0.0), FREE)
    assert profiled == pytest.approx(seen({"input.delay@m": -0.005}, bent, FREE), abs=2e-4)


WAVE = 0.9 * np.sin(2.5 * TIMES)
PUSHED = ARM.replace(f'<position name="m" joint="hinge" kp="{KP}" kv="{KV}" gear="2"/>',
                     '<motor name="m" joint="hinge" gear="2"/>')  # fmt: skip
TENTH, FIFTH = 1.1, 1.1**2 - 1


@pytest.mark.parametrize(
    ("text", "other", "effects"),
    [
        # a gear ratio larger by 10 %: of a motor, and of a servo with a geared set point
        (PUSHED.replace('gear="2"', 'gear="2.2"'), PUSHED, {"input.gain@m": 0.1}),
        (
            ARM.replace('gear="2"', 'gear="2.2"'),
            ARM,
            {
                "input.gain@m": 1 / TENTH - 1,
                "actuator.stiffness@m": FIFTH,
                "actuator.damping@m": FIFTH,
            },
        ),
        # a D term on the velocity
        (ARM.replace(f'kv="{KV}"', f'kv="{1.5 * KV}"'), ARM, {"drag.linear@hinge": 0.5 * KV * 4}),
    ],
)
def test_what_needs_no_effect_of_its_own(text, other, effects):
    wanted, plain = seen({}, WAVE, text), seen({}, WAVE, other)
    np.testing.assert_allclose(seen(effects, WAVE, other), wanted, atol=1e-9)
    assert np.abs(wanted - plain).max() > 1e-2


def test_a_speed_limit_of_back_emf_is_a_limit_of_force_and_a_drag():
    """Voltage clip(kp e, -V, V) minus back EMF: stall force S, no-load speed S / drag."""
    from scipy.integrate import solve_ivp

    stall, speed, inertia = 1.5, 2.0, 0.001 + MASS * LENGTH**2
    text = FREE.replace(f' kv="{KV}" gear="2"', "")
    command = np.where(TIMES >= 0.1, 3.0, 0.0)
    found = seen({"actuator.limit@m": stall, "drag.linear@hinge": stall / speed}, command, text)

    def rate(t, y):
        duty = np.clip(KP * (3.0 - y[0]) / stall, -1.0, 1.0)
        return y[1], stall * (duty - y[1] / speed) / inertia

    late = TIMES[TIMES >= 0.1]
    expected = solve_ivp(rate, (0.1, TIMES[-1]), (0.0, 0.0), t_eval=late, rtol=1e-9, atol=1e-9,
                         max_step=1e-3)  # fmt: skip
    np.testing.assert_allclose(found[TIMES >= 0.1], expected.y[0], atol=3e-3)
    assert np.gradient(found, TIMES).max() == pytest.approx(speed, rel=1e-2)


@pytest.mark.parametrize("phase", [0, 1, 3])
def test_a_set_point_that_is_taken_in_now_and_then_is_a_delay_on_average(phase):
    """The set point is read every 40 ms from a command that changes every 10 ms, so it is 0 to 30
    ms old.
    """
    taken = np.maximum((np.arange(TIMES.size) - phase) // 4 * 4 + phase, 0)
    seldom, plain = seen({}, WAVE[taken]), seen({}, WAVE)
    delayed = seen({"input.delay@m": 0.015}, WAVE)
    rest = np.abs(seldom - delayed)[20:].max()
    assert np.abs(seldom - plain)[20:].max() == pytest.approx(0.0164, rel=1e-2)
    assert rest < 6e-4


@pytest.mark.parametrize(
    ("effects", "within"),
    [({}, 1e-3), ({"servo.deadband@m": 0.06}, 1e-3), ({"supply.sag@m": 0.05}, 1e-3)],
)
def test_a_sensor_of_the_drive_shows_what_it_exerts_and_not_what_it_would(effects, within):
    """A dead zone or a weak supply reduces the measured torque: at rest it equals the arm's
    weight.
    """
    kind = kind_of(ARM)
    placed = [kind.system.effect(name) for name in effects]
    simulator = kind(observe=["q.hinge", "tau.hinge"], effects=placed)
    given = {c.name: np.zeros(TIMES.size) for c in simulator.inputs}
    given["u.m"] = np.full(TIMES.size, 1.6)
    theta = np.array([[*effects.values()], [0.0] * len(effects)])
    q, tau = simulator.simulate(theta, Scenario(TIMES, {"q.hinge": 0.7}, given))[0, -1]
    assert tau == pytest.approx(MASS * 9.81 * LENGTH * np.sin(q), rel=within)
    # the law without the effects gives another number
    plain = 2 * KP * (1.6 - 2 * q)
    assert (plain == pytest.approx(tau, rel=0.01)) == (not effects)
