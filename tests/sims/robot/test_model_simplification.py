"""Tests of the simulated model without elements that do not affect the motion: it moves
bit-identically.
"""

import multiprocessing
import resource
import sys

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from bench.core.plugin_registries import make_robot_simulator as simulator_of
from sims.core.simulator import Scenario
from sims.robot.dynamics.mujoco_batch import BatchCache, MujocoBatch, get_batch_cache
from sims.robot.dynamics.series_joints import add_series_joints
from sims.robot.integrator_settings import read_integrator_settings
from sims.robot.model_simplification import strip_assets, strip_shapes
from sims.robot.parsing.read_model_file import read_robot
from tests.sims.robot.sample_arms import ARM
from tests.sims.robot.test_public_model_collections import described


def bumps(count, seed):
    """Return the vertices of a stone, as text; some of them are not on its convex hull."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= (rng.uniform(0.05, 0.08, count) / np.linalg.norm(points, axis=1))[:, None]
    return " ".join(f"{x:.5f}" for x in points.ravel())


STONES = f"""<mujoco><compiler {{compiler}}/><option timestep="0.002" integrator="implicitfast"/>
<asset>
  <mesh name="stone" vertex="{bumps(900, 0)}"/><mesh name="other" vertex="{bumps(700, 1)}"/>
  <mesh name="seen" vertex="{bumps(900, 2)}"/>
  <texture name="sky" type="2d" builtin="checker" width="256" height="256"/>
  <material name="sky" texture="sky"/>
</asset>
<worldbody><geom type="mesh" mesh="other" pos="0.25 0 -0.05"/>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.05"/>
    <geom type="mesh" mesh="stone" pos="0.1 0 0" euler="10 20 30"/>
    <geom type="mesh" mesh="seen" contype="0" conaffinity="0" material="sky"/>
    <body name="fore" pos="0.2 0 0"><joint name="elbow" axis="0 1 0" damping="0.02"/>
      <frame euler="0 15 5"><geom type="mesh" mesh="stone" pos="0.1 0 0"/></frame>
      <geom type="box" mesh="other" pos="0.05 0 0.02"/><site name="tip" pos="0.2 0 0"/>
    </body>
  </body>
  <body name="link" pos="0 0 -0.3"><joint name="crank" axis="0 1 0"/>
    <geom type="mesh" mesh="stone" pos="0.1 0 0"/><site name="end" pos="0.2 0 0"/></body>
</worldbody>
{{equality}}
<actuator><position name="m" joint="shoulder" kp="20" kv="1"/></actuator>
<sensor><accelerometer site="tip"/></sensor></mujoco>"""
LOOP = '<equality><connect name="loop" site1="tip" site2="end" solref="0.05 1"/></equality>'


@pytest.fixture
def stones(tmp_path):
    def stones(compiler="", equality=""):
        path = tmp_path / "stones.xml"
        path.write_text(STONES.format(compiler=compiler, equality=equality))
        return read_robot(path)

    return stones


def moved(robot, derived=False, series=()):
    """Return the motion of eight batch elements from random states, driven by noise."""
    robot = add_series_joints(robot, series) if series else robot
    mujoco_batch = MujocoBatch(
        robot, derived, read_integrator_settings(robot).to_model_options(), 8
    )
    rng = np.random.default_rng(1)
    mujoco_batch.write_effects(())
    mujoco_batch.batch.reset(stage=0)
    state = 0.5 * rng.normal(size=(8, 2, mujoco_batch.file_joints.positions.size))
    mujoco_batch.batch.bind("qpos")[:, mujoco_batch.file_joints.positions] = state[:, 0]
    mujoco_batch.batch.bind("qvel")[:, mujoco_batch.file_joints.velocities] = state[:, 1]
    controls = 0.5 * rng.normal(size=(8, 150, mujoco_batch.model.nu))
    done = mujoco_batch.step(
        controls, np.zeros((8, 150, mujoco_batch.model.nv)), ["qpos", "qvel", "sensordata"]
    )
    assert not mujoco_batch.failed.any()
    return done


CASES = {
    "inertias from meshes": ('inertiafromgeom="true"', ""),
    "a total mass": ('settotalmass="2.5"', ""),
    "a closed loop": ("", LOOP),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("series", [(), (("elbow", "joint.backlash"),)])
def test_stones_move_alike_to_the_last_bit(stones, case, series):
    whole = stones(*CASES[case])
    small = strip_assets(whole)
    assert small.compiled.nbuffer < 0.3 * whole.compiled.nbuffer
    for derived in (False, True):
        one, other = (moved(robot, derived, series) for robot in (whole, small))
        for name, values in one.items():
            np.testing.assert_array_equal(values, other[name])
        assert np.ptp(one["qpos"], axis=1).max() > 0.3


def test_what_is_compared_touches(stones):
    model, found = stones().compiled, 0
    data = mujoco.MjData(model)
    for angle in np.linspace(-2, 2, 40):
        data.qpos[:2] = angle, 0.5 * angle
        mujoco.mj_fwdPosition(model, data)
        found += data.ncon
    assert found > 10


ROBOTS = ("so_arm_description/urdf/so101.urdf", "solo_description/robots/solo12.urdf")


@pytest.mark.slow
@pytest.mark.parametrize("path", ROBOTS)
def test_robots_of_others_move_alike_to_the_last_bit(path):
    whole = described(path)
    small = strip_assets(whole)
    assert small is not whole
    assert small.compiled.nbuffer < 0.25 * whole.compiled.nbuffer
    one, other = (moved(robot) for robot in (whole, small))
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name])


def test_shapes_that_a_sensor_measures_stay(tmp_path):
    ray = '<sensor><rangefinder site="tip"/>'
    (tmp_path / "ray.xml").write_text(
        STONES.format(compiler="", equality="").replace("<sensor>", ray)
    )
    robot = read_robot(tmp_path / "ray.xml")
    assert strip_assets(robot) is robot


def test_without_shapes_a_robot_has_no_geom_left(stones):
    assert strip_shapes(stones()).compiled.ngeom == 0


def resident():
    """Return the resident memory of this process, MB."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20


def hold_candidates():
    whole = described("so_arm_description/urdf/so101.urdf")
    small = strip_assets(whole)
    before = resident()
    held = [whole.spec.copy()]
    settings = read_integrator_settings(whole).to_model_options()
    for joint in whole.joints:
        held.append(
            MujocoBatch(add_series_joints(small, ((joint.name, "joint.backlash"),)), True, settings)
        )
    assert resident() - before < 150, "once 320 MB for each"


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_candidates_of_a_robot_with_large_meshes_take_little_memory():
    """The test needs a separate process, because memory freed by other tests would be reused."""
    described("so_arm_description/urdf/so101.urdf")
    process = multiprocessing.get_context("spawn").Process(target=hold_candidates)
    process.start()
    process.join(120.0)
    assert process.exitcode == 0


def test_simulators_of_a_robot_share_their_batches(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    kind = simulator_of(tmp_path / "arm.xml")
    times = np.arange(20) / 100.0
    for observe in (["q.shoulder"], ["q.elbow"]):
        made = kind(observe=observe)
        made.simulate(np.zeros((1, len(made.parameters))), Scenario(times, {}, {}))
        made.close()
    assert len(get_batch_cache(kind.robot).batches) == 1


def test_batches_in_series_that_take_too_much_are_dropped(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    robot = read_robot(tmp_path / "arm.xml")
    settings = read_integrator_settings(robot).to_model_options()
    cache = BatchCache(robot, limit=1)
    own = cache.get_batch((), False, 8, settings)
    first, second = ((("elbow", f"joint.{kind}"),) for kind in ("backlash", "flexibility"))
    one = cache.get_batch(first, True, 8, settings)
    assert cache.get_batch(first, True, 8, settings) is one
    assert one in cache.batches
    other = cache.get_batch(second, True, 8, settings)
    assert cache.batches == [own, other]


@pytest.mark.skipif(not hasattr(Batch, "expanded"), reason="MuJoCo before 4.0 has one way only")
def test_constants_of_equal_elements_are_computed_once(tmp_path, monkeypatch):
    """MuJoCo before 4.0, on Python 3.10, computes those of each element."""
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    kind = simulator_of(path)
    robot, (effect,) = kind.robot, kind(effects=["mass.scale@fore"]).effects
    settings = read_integrator_settings(robot).to_model_options()
    constants = []
    for _ in range(2):
        mujoco_batch = MujocoBatch(robot, True, settings, 3)
        mujoco_batch.write_effects(((effect, np.full((1, 3, 1), 0.4)),))
        constants.append(mujoco_batch.batch.expand("dof_invweight0").copy())
        monkeypatch.delattr(Batch, "expanded", raising=False)
    np.testing.assert_array_equal(*constants)
    assert (constants[0] != robot.compiled.dof_invweight0).any()
