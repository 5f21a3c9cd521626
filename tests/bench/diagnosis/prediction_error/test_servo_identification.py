"""Tests of the identification of all servos of an arm at once."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bench.diagnosis.explain import explain
from bench.diagnosis.fitting.levenberg_marquardt import solve_damped
from bench.diagnosis.prediction_error.servo_identification import (
    ServoModel,
    _estimate_gain,
    _ServoFitter,
    _Trial,
    has_unknown_servos,
)
from tests.bench.diagnosis.simulated_logs import describe, follow, write_log
from tests.exams.robots.robot_signals import profiled

ACCELERATIONS = (15.0, 20.0, 12.0, 25.0)
"""Limits of the set points' accelerations, in rad/s²."""
FRICTION = 0.12
"""Dry friction of every joint, in N·m."""
ENCODER_STEP = 0.00153
"""Step of the encoders, in rad."""
RUNS, SECONDS, RATE = 4, 4.0, 50
"""Number of runs, and duration in seconds and samples per second of each."""


def arm(stiffness, damping, friction):
    """Return the MJCF of an arm with four servos."""
    links = "".join(
        f'<body pos="{0.1 if i else 0.0} 0 {0.0 if i else 0.1}">'
        f'<joint name="j{i}" axis="{"0 1 0" if i else "0 0 1"}" armature="0.01" damping="0.05"'
        f' {friction}/><geom type="capsule" size="0.015" fromto="0 0 0 0.1 0 0" mass="0.1"/>'
        for i in range(4)
    )
    servos = "".join(
        f'<position name="m{i}" joint="j{i}" kp="{stiffness}" kv="{damping}"/>' for i in range(4)
    )
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/><default><geom contype="0"'
        f' conaffinity="0"/></default><worldbody>{links}{"</body>" * 4}</worldbody>'
        f"<actuator>{servos}</actuator></mujoco>"
    )


def steps_of(rng, times):
    """Return commands that step to another angle about once a second."""
    changes = np.cumsum(rng.uniform(0.6, 1.2, 20))
    angles = rng.uniform(-0.6, 0.6, 21)
    return angles[np.searchsorted(changes, times, side="right")]


def write_recording(folder):
    """Write the log of an arm whose servos have motion profiles, and its model file without them.

    The servos of the model file also have a lower stiffness, and its joints no dry friction.
    """
    stiff = f'frictionloss="{FRICTION}" solreffriction="0.004 1"'
    model = mujoco.MjModel.from_xml_string(arm(12, 0.5, stiff))
    model.opt.timestep = 0.001
    rng, times, runs = np.random.default_rng(3), np.arange(0.0, SECONDS, 1.0 / RATE), []
    for _ in range(RUNS):
        commands = np.stack([steps_of(rng, times) for _ in range(4)], axis=1)
        limits = zip(commands.T, ACCELERATIONS, strict=True)
        followed = np.stack([profiled(column, times, limit)[0] for column, limit in limits], axis=1)
        positions = follow(model, followed, 1, start=commands[0], settle=3000)
        readings = np.round(positions[:: 1000 // RATE] / ENCODER_STEP) * ENCODER_STEP
        runs.append((times, readings[: times.size], commands))
    units = dict.fromkeys([f"{name}{i}" for name in ("q.j", "u.m") for i in range(4)], "rad")
    free = 'free = ["actuator.stiffness@*", "actuator.damping@*"]\n'
    description = free + describe(units, more="[runs.4]\nheld_out = true\n")
    return write_log(folder, description, ",".join(units), runs, arm=arm(8, 0.3, ""))


@pytest.mark.long
def test_profiles_friction_and_stiffness_of_all_servos_are_found(tmp_path):
    """The model lacks two laws at each of four joints, and its stiffness is wrong."""
    answer = explain(write_recording(tmp_path)).answer
    found = {cause.effect: cause.coefficients["coefficient"].value for cause in answer.causes}
    assert found.keys() == {
        *(f"servo.profile@m{i}" for i in range(4)),
        *(f"friction.coulomb@j{i}" for i in range(4)),
    }
    for i, limit in enumerate(ACCELERATIONS):
        assert found[f"servo.profile@m{i}"] == pytest.approx(limit, rel=0.05)
        assert found[f"friction.coulomb@j{i}"] == pytest.approx(FRICTION, abs=0.03)
        stiffness = 8.0 * (1.0 + answer.parameters[f"actuator.stiffness@m{i}"].value)
        assert stiffness == pytest.approx(12.0, rel=0.05)
    assert answer.heldout.rmse_extended < 2.0 * ENCODER_STEP
    assert answer.heldout.rmse_extended < 0.1 * answer.heldout.rmse_base


def test_the_estimated_gain_is_that_of_least_squares():
    rng = np.random.default_rng(1)
    block, change = rng.normal(size=(200, 3)), rng.normal(size=200)
    residual = block @ [1.0, -2.0, 0.5] + 0.7 * change + 0.1 * rng.normal(size=200)

    def remaining(columns):
        return float(np.linalg.lstsq(columns, residual, rcond=None)[1][0])

    both = remaining(np.column_stack([block, change]))
    expected = (remaining(block) - both) / float(residual @ residual)
    assert _estimate_gain(block, change, residual) == pytest.approx(expected, rel=1e-9)
    # A law that would need another sign, or is far too large, gains nothing.
    assert _estimate_gain(block, -change, residual) == 0.0
    assert _estimate_gain(block, 100.0 * change, residual) == 0.0


def test_each_joint_starts_from_the_parameters_that_simulate_it_better(monkeypatch):
    """The parameters estimated with a law help the first of two joints, and not the second."""
    slices = {"friction.coulomb@a": slice(2, 3), "friction.coulomb@b": slice(3, 4)}
    evaluator = SimpleNamespace(
        coefficient_slices=slices, search_control=SimpleNamespace(is_over=lambda: False)
    )
    trials = {
        joint: [_Trial(gain=0.5, name=name, coefficients=np.array([0.1]), parameters=estimated)]
        for joint, (name, estimated) in enumerate(
            zip(slices, (np.array([2.0]), np.array([3.0])), strict=True)
        )
    }
    starts = []

    def simulate(_, theta, laws):
        """The stiffness of the first joint is 2, that of the second 1."""
        return ServoModel(theta, tuple(laws), None, np.abs(theta[:2] - [2.0, 1.0]))

    def fit(_, start, *_arguments):
        starts.append(start.theta)
        return start

    def list_parameters(_, joint, laws):
        return [joint, *(index for name in laws for index in range(4)[slices[name]])]

    for name, value in {
        "_evaluator": evaluator, "_estimate_gains": lambda *_: trials, "simulate": simulate,
        "fit": fit, "_list_parameters": list_parameters, "_helps": lambda *_: False,
    }.items():  # fmt: skip
        monkeypatch.setattr(_ServoFitter, name, value)
    model = ServoModel(np.array([1.0, 1.0, 0.0, 0.0]), ((), ()), None, np.array([1.0, 0.0]))
    assert _ServoFitter.__new__(_ServoFitter).add_laws(model, [0, 1]) is model
    np.testing.assert_array_equal(starts, [[2.0, 1.0, 0.1, 0.1]])


def test_a_step_without_damping_solves_the_least_squares_problem():
    block = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    np.testing.assert_allclose(solve_damped(block, block @ [2.0, -3.0], 0.0), [2.0, -3.0])
    # The damping adds its share of the diagonal: (3 + 3) x = 6 for one unknown.
    np.testing.assert_allclose(solve_damped(block[:, :1], np.full(3, 2.0), 1.0), [1.0])


@pytest.mark.parametrize(
    ("servos", "channels", "free", "expected"),
    [
        ("mmmm", "abcd", "mmmm", True),
        ("mmm-", "abcd", "mmmm", False),
        ("mmmm", "abc", "mmmm", False),
        ("mmm", "abc", "mmm", False),
        ("mnop", "abcd", "mno", False),
        ("mnop", "abcd", "mnop", True),
    ],
)
def test_only_arms_with_unknown_servos_and_encoders_at_every_joint_are_identified(
    servos, channels, free, expected
):
    coordinates = [f"q.{name}" for name in "abcd"[: len(servos)]]
    system = SimpleNamespace(
        coordinates=coordinates,
        servos={i: f"u.{name}" for i, name in enumerate(servos) if name != "-"},
    )
    gains = [f"actuator.{law}@{name}" for name in free for law in ("stiffness", "damping")]
    evaluator = SimpleNamespace(
        simulator=SimpleNamespace(system=system),
        channels=[f"q.{name}" for name in channels],
        parameters=[SimpleNamespace(name=name) for name in gains],
        base_indices=np.arange(len(gains)),
    )
    assert has_unknown_servos(SimpleNamespace(evaluator=evaluator)) is expected
