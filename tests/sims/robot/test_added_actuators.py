"""Tests of actuators that a recording adds, and of its time step and integrator."""

import pytest

from sims.core.simulator import InputError
from sims.robot.parsing.read_model_file import read_robot

ARM = """<mujoco><option timestep="0.002"/><worldbody>
  <body name="a"><joint name="elbow" axis="0 1 0"/>
  <geom size="0.1" pos="0 0 -1" mass="1"/></body></worldbody>
  <actuator><motor name="old" joint="elbow"/></actuator></mujoco>"""
Q, V, U, STATE = 0.3, 0.7, 1.1, 0.25


def force(robot, rate=None):
    """Return the force of the added actuator on the joint at Q, V with the control U, N m."""
    import mujoco

    model = robot.compiled
    data = mujoco.MjData(model)
    actuator = robot.actuator("m")
    data.qpos[0], data.qvel[0] = Q, V
    data.ctrl[actuator.control] = U
    if rate is not None:
        data.ctrl[actuator.control + 1] = rate
    if model.na:
        data.act[0] = STATE
    mujoco.mj_forward(model, data)
    return data.qfrc_actuator[0]


def added(write, **table):
    return read_robot(write(ARM), actuators={"m": {"joint": "elbow", **table}})


@pytest.mark.parametrize(
    ("table", "torque"),
    [
        ({"kind": "motor", "gear": 4}, 4 * U),
        ({"kind": "position", "kp": 20, "kv": 3, "gear": 2}, 2 * (20 * (U - 2 * Q) - 3 * 2 * V)),
        ({"kind": "velocity", "kv": 3}, 3 * (U - V)),
        # The damping of this PID acts on the joint.
        ({"kind": "pid", "kp": 20, "ki": 5, "kv": 3}, 20 * (U - Q) - 3 * V + 5 * STATE),
    ],
    ids=lambda table: table["kind"] if isinstance(table, dict) else "",
)
def test_an_actuator_exerts_what_its_kind_says(write, table, torque):
    robot = added(write, **table)
    actuator = robot.actuator("m")
    assert (actuator.kind, actuator.control, actuator.controls) == (table["kind"], 1, 1)
    assert robot.rate_controlled_actuators == ()
    assert force(robot) == pytest.approx(torque)


def test_a_pid_whose_derivative_acts_on_the_error(write):
    robot = added(write, kind="pid", kp=20, ki=5, kd=3)
    actuator = robot.actuator("m")
    assert (actuator.control, actuator.controls, robot.rate_controlled_actuators) == (1, 2, ("m",))
    assert force(robot, rate=0.4) == pytest.approx(20 * (U - Q) + 3 * (0.4 - V) + 5 * STATE)


def test_the_integral_of_a_pid_is_that_of_the_error(write):
    import mujoco

    model = added(write, kind="pid", kp=20, ki=5).compiled
    data = mujoco.MjData(model)
    data.qpos[0], data.ctrl[1] = Q, U
    mujoco.mj_step(model, data)
    assert data.act[0] == pytest.approx((U - Q) * 0.002)


def test_ranges(write):
    robot = added(write, kind="position", kp=20, control_range=[-1, 0.5], force_range=[-2, 2])
    actuator = robot.actuator("m")
    assert (actuator.range, actuator.force) == ((-1, 0.5), (-2, 2))
    assert force(robot) == pytest.approx(2)


INVALID_ACTUATORS = {
    "no joint": ({"kind": "motor"}, "PATH: actuators.m states no joint"),
    "no kind": ({"joint": "elbow"}, "PATH: actuators.m states no kind"),
    "joint": (
        {"joint": "knee", "kind": "motor"},
        "PATH: actuators.m: unknown joint 'knee'; there are: elbow",
    ),
    "kind": (
        {"joint": "elbow", "kind": "muscle"},
        "PATH: actuators.m: unknown kind 'muscle'; there are: motor, pid, position, velocity",
    ),
    "key": (
        {"joint": "elbow", "kind": "motor", "kq": 1},
        "unknown entry of [actuators.m] in PATH 'kq'; there are: control_range, disable, "
        "enable, force_range, gear, joint, kd, ki, kind, kp, kv",
    ),
    "key of another kind": (
        {"joint": "elbow", "kind": "position", "kp": 1, "kd": 1},
        "unknown entry of [actuators.m], of kind position 'kd'; there are: control_range, "
        "force_range, gear, joint, kind, kp, kv",
    ),
    "gain": (
        {"joint": "elbow", "kind": "pid"},
        "PATH: actuators.m: kind pid needs kp; free it if it is a guess",
    ),
    "negative": (
        {"joint": "elbow", "kind": "velocity", "kv": -1},
        "PATH: actuators.m.kv: expected 0 or more, found -1.0",
    ),
    "not finite": (
        {"joint": "elbow", "kind": "motor", "gear": float("nan")},
        "PATH: actuators.m.gear: expected a number, found nan",
    ),
    "both": (
        {"joint": "elbow", "kind": "pid", "kp": 1, "kd": 1, "kv": 1},
        "PATH: actuators.m: kd acts on the error's rate, kv on the joint's: give one",
    ),
    "range": (
        {"joint": "elbow", "kind": "motor", "force_range": [1, 1]},
        "PATH: actuators.m.force_range: expected low < high, found [1, 1]",
    ),
    "text": (
        {"joint": "elbow", "kind": "motor", "gear": "2"},
        "PATH: actuators.m.gear: expected a number, found '2'",
    ),
}


@pytest.mark.parametrize(("table", "message"), INVALID_ACTUATORS.values(), ids=INVALID_ACTUATORS)
def test_faults_of_a_table(write, table, message):
    path = write(ARM)
    with pytest.raises(InputError) as caught:
        read_robot(path, actuators={"m": table})
    assert str(caught.value) == message.replace("PATH", str(path))


def test_a_name_that_the_model_has(write):
    path = write(ARM)
    with pytest.raises(InputError, match=r"actuators\.old: the model has an actuator old already"):
        read_robot(path, actuators={"old": {"joint": "elbow", "kind": "motor"}})


def test_the_engine_is_what_the_recording_says(write):
    option = read_robot(
        write(ARM), engine={"timestep": 5e-4, "integrator": "implicit"}
    ).compiled.opt
    assert (option.timestep, option.integrator) == (5e-4, 2)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"timestep": 0}, "engine.timestep: expected 1e-09 to 1 s, found 0.0"),
        (
            {"integrator": "Heun"},
            "unknown integrator 'Heun'; there are: Euler, RK4, implicit, impl",
        ),
        ({"step": 1}, "'step'; there are: fix_base, integrator, recorded_bases, timestep"),
    ],
)
def test_faults_of_the_engine(write, table, message):
    with pytest.raises(InputError) as caught:
        read_robot(write(ARM), engine=table)
    assert message in str(caught.value)
