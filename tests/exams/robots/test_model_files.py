"""Tests of `explain` with unchanged model files of packages and no user code."""

import math
from pathlib import Path

import pytest

pytest.importorskip("pinocchio", reason="pin has no wheel here")
pytest.importorskip("gymnasium", reason="gymnasium is not installed")
pytest.importorskip("pybullet_data", reason="pybullet has no wheel here")

from bench.diagnosis.explain import explain
from tests.exams.robots.exam_robots import Drive
from tests.exams.robots.model_files import Case, motor, write_case

ROBOTS_FOLDER = Path(__file__).parents[4] / "shared" / "robots"
FINE = {"integrator": "RK4", "timestep": 0.002}
SO101 = ("gripper", "wrist_roll", "wrist_flex", "elbow_flex", "shoulder_lift", "shoulder_pan")
IIWA = tuple(f"lbr_iiwa_joint_{k + 1}" for k in range(7))
CASES = {
    "gymnasium inverted_pendulum.xml, that falls": Case(
        "gymnasium", "envs/mujoco/assets/inverted_pendulum.xml", (motor("slide", "slider"),),
        (0.0, 0.0), (15.0,), {"drag.linear@hinge": (0.5,)}, seconds=0.7, runs=10, gears=(100.0,),
    ),
    "gymnasium inverted_double_pendulum.xml, hanging": Case(
        "gymnasium", "envs/mujoco/assets/inverted_double_pendulum.xml",
        (motor("slide", "slider"),), (0.0, math.pi, 0.0), (5.0,),
        {"friction.coulomb@hinge2": (0.02,)}, gears=(500.0,),
    ),
    "gymnasium reacher.xml": Case(
        "gymnasium", "envs/mujoco/assets/reacher.xml",
        (motor("actuator0", "joint0"), motor("actuator1", "joint1")), (0.1, 0.8), (2.0, 2.0),
        {"inertia.armature@joint1": (0.05,)}, gears=(200.0, 200.0),
    ),
    "pybullet_data cartpole.urdf": Case(
        "pybullet_data", "cartpole.urdf", (motor("m_slider_to_cart", "slider_to_cart"),),
        (0.0, math.pi), (4.0,), {"drag.linear@cart_to_pole": (0.2,)}, seconds=3.0, runs=4,
        engine=FINE,
    ),
    "pybullet_data kuka_iiwa": Case(
        "pybullet_data", "kuka_iiwa/model.urdf",
        tuple(Drive(name, "position", kp, 0.1 * kp, 300.0)
              for name, kp in zip(IIWA, (900, 900, 400, 400, 60, 60, 8), strict=True)),
        (0.0, 0.5, 0.0, -1.2, 0.0, 0.8, 0.0), (0.5,) * 7, {"input.delay@m_" + IIWA[3]: (0.006,)},
        seconds=0.8, runs=3, engine=FINE,
    ),
    "example-robot-data double pendulum": Case(
        "pinocchio", "double_pendulum_description/urdf/double_pendulum_simple.urdf",
        (motor("m_joint1", "joint1"),), (math.pi, 0.0), (0.2,), {"mass.scale@link2": (0.05,)},
        engine=FINE,
    ),
    "so101.urdf": Case(
        str(ROBOTS_FOLDER / "so101"), "so101.urdf",
        tuple(Drive(name, "position", kp, 0.08 * kp, 10.0)
              for name, kp in zip(SO101, (0.08, 0.15, 0.5, 2.0, 6.0, 4.0), strict=True)),
        (0.0, -0.4, 0.4, 0.3, 0.2, 0.3), (0.4,) * 6, {"friction.coulomb@elbow_flex": (0.02,)},
        seconds=1.5, runs=3, engine=FINE,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long) if "kuka" in name else name  # seven joints
        for name in CASES
    ],
)
def test_a_cause_hidden_in_an_unchanged_model_file_is_found(name, tmp_path):
    case = CASES[name]
    if not case.path.exists():
        pytest.skip(f"{case.path} is missing")
    explained = explain(write_case(case, tmp_path))
    (hidden, truth), found = *case.hidden.items(), explained.causes
    sets = [{c.effect, *c.alternatives} for c in found]
    assert any(hidden in names for names in sets), (explained.verdict, sets)
    held_out = explained.answer.heldout
    assert held_out.rmse_extended < 1.05 * held_out.noise_floor
    (named,) = [c for c in found if hidden in {c.effect, *c.alternatives}]
    if named.effect == hidden:
        (number,) = named.coefficients.values()
        assert number.value == pytest.approx(truth[0], rel=0.05)
