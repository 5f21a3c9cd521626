"""Tests of ranges for domain randomisation: their content, exclusions and generated code."""

import csv
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import patch

import jsonschema
import mujoco
import numpy as np
import pytest

from bench.core.plugin_registries import make_robot_simulator
from bench.diagnosis.explanation import Explanation
from bench.diagnosis.randomization_files import COLUMNS, build_range_files
from bench.diagnosis.report import explanation_figures
from bench.diagnosis.verdict import Verdict
from bench.schemas import load_schema
from sims.core.toml_validation import tomllib
from sims.extended_simulator import ExtendedSimulator, FittedValue, get_robot_reference
from tests.bench.diagnosis.sample_report_data import answer, make_report
from tests.command_output import run_command
from tests.sims.robot.sample_arms import ARM

EXAMPLE = Path(__file__).parents[3] / "examples" / "robot"
NAMES = ("ranges.toml", "ranges.csv", "ranges_isaac_lab.py", "ranges_mujoco_playground.py")
RANGES_SCHEMA = load_schema("explain")["anyOf"][0]["properties"]["ranges"]
ALL_FRICTION = "friction.coulomb@*"


def number(value, half=None, unit="1", **changes):
    """Return a fitted value with a symmetric interval."""
    ends = (None, None) if half is None else (value - half, value + half)
    return FittedValue(value, unit, *ends, **changes)


def one(value, half):
    """Return the coefficients of an effect with one coefficient."""
    return {"coefficient": number(value, half)}


EFFECTS = {
    ALL_FRICTION: {
        "coefficient@shoulder": number(0.1, 0.02, "N*m"),
        "coefficient@elbow": number(-0.03, 0.01, "N*m"),
    },
    "drag.linear@shoulder": one(0.3, 0.1),
    "drag.quadratic@shoulder": one(0.05, 0.01),
    "inertia.armature@shoulder": one(0.02, 0.01),
    "spring.linear@elbow": one(0.5, 0.1),
    "mass.scale@fore": one(0.25, 0.05),
    "inertia.scale@fore": one(0.1, 0.05),
    "mass.offset@fore": {"x": number(0.01, 0.005, "m"), "y": number(0.0), "z": number(-0.02, 0.01)},
    "actuator.stiffness@m_shoulder": one(-0.1, 0.05),
    "actuator.damping@m_shoulder": one(0.5, 0.1),
    "actuator.damping@m_spin": one(1.0, 0.2),
    "actuator.limit@m_elbow": one(0.8, 0.1),
    "gravity.scale": one(-0.02, 0.01),
    "gravity.tilt": {"x": number(0.03, 0.01), "y": number(0.0, 0.01)},
    "input.delay@m_elbow": {"coefficient": number(0.02, 0.002, "s")},
}


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return make_robot_simulator(path)


def explanation_of(kind, effects, free=None, verdict="named", alternatives=(), title="a log"):
    """Return an explanation with these causes; the first one has the alternatives."""
    observed = [channel.name for channel in kind.channels] if kind else ["q"]
    extended = ExtendedSimulator(
        "arm_extended", "arm", None, title, free or {}, effects, {}, observed, kind,
        get_robot_reference(kind) if kind else None,
    )  # fmt: skip
    causes = [
        {
            "effect": name, "alternatives": list(alternatives) if k == 0 else [], "says": "x",
            "p_value": 0.0, "coefficients": {
                c: {"value": n.value, "unit": n.unit, "low": n.low, "high": n.high}
                for c, n in own.items()
            },
        }
        for k, (name, own) in enumerate(effects.items())
    ]  # fmt: skip
    found = Verdict.from_document({**answer(verdict), "causes": causes})
    return Explanation(found, replace(make_report(), verdict=found), extended)


def files_of(explanation):
    """Return the text of the files of ranges by name."""
    return build_range_files(explanation.ranges, explanation.extended)


def by_name(explanation):
    """Return the ranges by cause and coefficient."""
    return {(r.cause, r.coefficient): r for r in explanation.ranges.ranges}


@pytest.fixture(scope="module")
def everything(arm):
    return explanation_of(arm, EFFECTS)


def test_a_range_is_the_interval_of_the_number_in_the_model_file(everything):
    found = by_name(everything)
    rubs = found["friction.coulomb@elbow", "coefficient"]
    assert (rubs.kind, rubs.name, rubs.field, rubs.fields[0].address) == (
        "joint", "elbow", "dof_frictionloss", (1,)
    )  # fmt: skip
    assert (rubs.nominal, rubs.unit, rubs.operation) == (0.05, "N*m", "abs")
    assert [rubs.value, rubs.low, rubs.high] == pytest.approx([0.02, 0.01, 0.03])
    mass = found["mass.scale@fore", "coefficient"]
    assert [mass.nominal, mass.value, mass.low, mass.high] == pytest.approx([0.8, 1.0, 0.96, 1.04])
    assert (mass.field, mass.unit) == ("body_mass", "kg")
    moved = found["mass.offset@fore", "z"]
    assert (moved.field, moved.operation) == ("body_ipos", "add")
    ends = [moved.nominal, moved.value, moved.low, moved.high, moved.minimum, moved.maximum]
    assert ends == pytest.approx([0.01, -0.01, -0.02, 0.0, -0.03, -0.01])
    stiffness = found["actuator.stiffness@m_shoulder", "coefficient"]
    assert [f.name for f in stiffness.fields] == ["actuator_gainprm", "actuator_biasprm"]
    assert [stiffness.low, stiffness.high] == pytest.approx([51.0, 57.0])
    inertia = found["inertia.scale@fore", "coefficient"]
    # The scale of the body's mass also scales its inertia.
    assert inertia.value == pytest.approx(0.009 * 1.25 * 1.1)
    assert [inertia.minimum, inertia.maximum] == pytest.approx([1.25 * 1.05, 1.25 * 1.15])
    late = found["input.delay@m_elbow", "coefficient"]
    assert (late.field, late.nominal, late.unit, late.low) == ("", None, "s", 0.02 - 0.002)
    assert ("mass.offset@fore", "y") not in found
    assert everything.ranges.left_out == ()


def test_free_numbers_have_ranges_without_causes(arm, tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    kind = make_robot_simulator(path, free=["damping@elbow", "mass@fore"])
    free = {
        "drag.linear@elbow": number(0.02, 0.01, "N*m*s/rad"),
        "mass.scale@fore": number(0.4, None),
    }
    assert list(free) == [p.name for p in kind.parameters]
    found = explanation_of(kind, {}, free, "adequate")
    (damping,) = found.ranges.ranges
    assert damping.is_free
    assert [damping.nominal, damping.low, damping.high] == pytest.approx([0.1, 0.11, 0.13])
    assert found.ranges.left_out == (
        "mass.scale@fore is not in the ranges: its value, 0.4, has no finite interval",
    )


def test_what_is_no_result_is_left_out_and_said(arm):
    effects = {
        "drag.linear@elbow": one(0.1, 0.01),
        "friction.coulomb@elbow": {"coefficient": number(9.0, None, "N*m", at_bound="high")},
        "input.lag@m_elbow": {"coefficient": number(0.1, None, "s")},
    }
    found = explanation_of(arm, effects, alternatives=["drag.quadratic@elbow"])
    assert found.ranges.ranges == ()
    assert found.ranges.left_out == (
        "drag.linear@elbow is not in the ranges: these data cannot distinguish it from "
        "drag.quadratic@elbow",
        "friction.coulomb@elbow is not in the ranges: its value, 9 N·m, is at the upper bound of "
        "its range",
        "input.lag@m_elbow is not in the ranges: its value, 0.1 s, has no finite interval",
        "no ranges are written: the verdict is named, and neither a named cause nor a free number "
        "has a finite interval",
    )


def test_numbers_do_not_go_below_what_physics_allows(arm):
    found = explanation_of(arm, {"friction.coulomb@elbow": one(-0.045, 0.02)})
    (rubs,) = found.ranges.ranges
    assert rubs.low == 0.0
    assert rubs.high == pytest.approx(0.025)


def test_compensated_gravity_has_no_range(arm):
    found = explanation_of(arm, {"gravity.scale": one(-1.0, 0.001)})
    assert found.ranges.ranges == ()
    assert "gravcomp" in found.ranges.left_out[0]


def test_numbers_without_a_field_are_a_table_without_code(arm):
    found = explanation_of(arm, {"input.delay@m_elbow": one(0.02, 0.002)})
    assert list(files_of(found)) == ["ranges.toml", "ranges.csv"]
    (line,) = found.ranges.left_out
    assert line.startswith("no code for Isaac Lab and MuJoCo Playground is written")


@pytest.mark.parametrize("effect", [name for name in EFFECTS if name != "input.delay@m_elbow"])
def test_the_code_of_each_effect_alone_runs(arm, effect):
    found = explanation_of(arm, {effect: EFFECTS[effect]})
    files = files_of(found)
    model, axes = randomized(files["ranges_mujoco_playground.py"], arm.robot.compiled)
    assert model._values
    assert set(axes._values) == set(model._values)
    events(files["ranges_isaac_lab.py"])


def test_a_system_without_a_model_file_is_said():
    found = explanation_of(None, {"drag.linear": one(0.1, 0.01)})
    assert found.ranges.ranges == ()
    (line,) = found.ranges.left_out
    assert line == (
        "no ranges are written: system arm has no model file whose numbers could be randomised"
    )


def test_files_are_written_together(everything, tmp_path, monkeypatch):
    monkeypatch.setattr(explanation_figures, "render_figures", lambda _: {})
    paths = everything.write(tmp_path / "out", ranges=True)
    names = [path.name for path in paths]
    assert [name for name in names if name.startswith("ranges")] == list(NAMES)
    document = tomllib.loads((tmp_path / "out" / "ranges.toml").read_text())
    assert document["format"] == 1
    assert (tmp_path / "out" / document["model"]).resolve().name == "arm.xml"
    assert len(document["ranges"]) == len(everything.ranges.ranges)
    with (tmp_path / "out" / "ranges.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert tuple(rows[0]) == COLUMNS
    for row, entry in zip(rows, document["ranges"], strict=True):
        assert row["field"] == entry["field"]
        assert float(row["low"]) == entry["low"]
        assert row["address"] == " ".join(map(str, entry.get("address", [])))
    without = everything.write(tmp_path / "plain")
    assert not [path for path in without if path.name.startswith("ranges")]


def execute(code, stubs):
    """Run a generated file with stub modules; return its definitions."""
    space = {}
    with patch.dict(sys.modules, stubs):
        exec(compile(code, "ranges.py", "exec"), space)
    return space


# -- code for MuJoCo Playground, run with NumPy instead of JAX


class _Array(np.ndarray):
    """Array with JAX's method to set elements."""

    @property
    def at(self):
        whole = self

        class At:
            def __getitem__(self, index):
                def put(value):
                    changed = np.array(whole).view(_Array)
                    changed[index] = value
                    return changed

                return SimpleNamespace(set=put)

        return At()


class _Model:
    """Model with the methods of mjx.Model that a randomiser calls."""

    def __init__(self, model, values=None):
        self._model, self._values = model, dict(values or {})

    def __getattr__(self, name):
        if name == "opt":
            return SimpleNamespace(gravity=np.array(self._model.opt.gravity).view(_Array))
        if name in self._values:
            return self._values[name]
        return np.array(getattr(self._model, name)).view(_Array)

    def tree_replace(self, values):
        return _Model(self._model, {**self._values, **values})


def randomized(code, model):
    """Run the generated function on a model; return the lower ends, then the upper ends."""
    jax = ModuleType("jax")
    jax.numpy = SimpleNamespace(
        array=lambda values: np.array(values).view(_Array), clip=np.clip, max=np.max
    )
    jax.Array = np.ndarray
    jax.tree_util = SimpleNamespace(tree_map=lambda _f, model: _Model(model._model))
    jax.random = SimpleNamespace(
        split=lambda key: (key, key),
        uniform=lambda key, minval, maxval: (minval, maxval)[key],
    )
    jax.vmap = lambda f: (
        lambda keys: tuple(np.stack(parts) for parts in zip(*map(f, keys), strict=True))
    )
    mjx = ModuleType("mujoco.mjx")
    mjx.Model = _Model
    mjx.name2id = lambda model, kind, name: mujoco.mj_name2id(model._model, kind, name)
    stubs = {"jax": jax, "jax.numpy": jax.numpy, "mujoco.mjx": mjx}
    return execute(code, stubs)["domain_randomize"](_Model(model), [0, 1])


def test_the_function_for_mujoco_playground_sets_the_fields(arm, everything):
    code = files_of(everything)["ranges_mujoco_playground.py"]
    model, axes = randomized(code, arm.robot.compiled)
    fields = model._values
    assert dict.fromkeys(fields, 0) == axes._values
    found = by_name(everything)

    def ends(cause, coefficient="coefficient"):
        one = found[cause, coefficient]
        return pytest.approx([one.low, one.high], rel=1e-8)

    assert fields["dof_frictionloss"][:, 0] == ends("friction.coulomb@shoulder")
    assert fields["dof_frictionloss"][:, 1] == ends("friction.coulomb@elbow")
    assert fields["dof_damping"][:, 0] == ends("drag.linear@shoulder")
    assert fields["dof_dampingpoly"][:, 0, 0] == ends("drag.quadratic@shoulder")
    assert fields["jnt_stiffness"][:, 1] == ends("spring.linear@elbow")
    assert fields["dof_armature"][:, 0] == ends("inertia.armature@shoulder")
    fore = arm.robot.body("fore").id
    assert fields["body_mass"][:, fore] == ends("mass.scale@fore")
    assert fields["body_inertia"][:, fore].max(axis=1) == ends("inertia.scale@fore")
    assert fields["body_ipos"][:, fore, 0] == ends("mass.offset@fore", "x")
    assert fields["body_ipos"][:, fore, 1].tolist() == [0.0, 0.0]
    servo, spin = (arm.robot.actuator(name).id for name in ("m_shoulder", "m_spin"))
    assert fields["actuator_gainprm"][:, servo, 0] == ends("actuator.stiffness@m_shoulder")
    assert -fields["actuator_biasprm"][:, servo, 1] == ends("actuator.stiffness@m_shoulder")
    assert -fields["actuator_biasprm"][:, servo, 2] == ends("actuator.damping@m_shoulder")
    assert fields["actuator_gainprm"][:, spin, 0] == ends("actuator.damping@m_spin")
    limits = fields["actuator_forcerange"][:, arm.robot.actuator("m_elbow").id]
    np.testing.assert_allclose(limits, [[-0.7, 0.7], [-0.9, 0.9]])
    assert fields["opt.gravity"][:, 0] == ends("gravity.tilt", "x")
    assert -fields["opt.gravity"][:, 2] == ends("gravity.scale")
    assert "input.delay" in code.split("return model, in_axes")[1]


def test_another_model_is_refused_by_the_function(everything):
    code = files_of(everything)["ranges_mujoco_playground.py"]
    other = mujoco.MjModel.from_xml_string(ARM.replace("elbow", "knee"))
    with pytest.raises(ValueError, match="the model has no mjOBJ_JOINT 'elbow'"):
        randomized(code, other)


# -- code for Isaac Lab, run with stub modules that record calls


def events(code):
    """Return function and parameters of the event terms of a file, by name."""
    names = (
        "isaaclab",
        "isaaclab.envs",
        "isaaclab.envs.mdp",
        "isaaclab.managers",
        "isaaclab.utils",
    )
    stubs = {name: ModuleType(name) for name in names}
    stubs["isaaclab.envs.mdp"].__getattr__ = lambda name: name
    stubs["isaaclab.managers"].EventTermCfg = lambda **given: given
    stubs["isaaclab.managers"].SceneEntityCfg = lambda name, **given: (name, given)
    stubs["isaaclab.utils"].configclass = lambda decorated: decorated
    own = vars(execute(code, stubs)["SimgapEventCfg"])
    return {name: term for name, term in own.items() if isinstance(term, dict)}


def test_the_event_terms_for_isaac_lab_have_the_ranges(everything):
    code = files_of(everything)["ranges_isaac_lab.py"]
    found = events(code)
    assert {term["mode"] for term in found.values()} == {"startup"}
    rubs = found["dof_frictionloss_elbow"]
    assert rubs["func"] == "randomize_joint_parameters"
    assert rubs["params"] == {
        "asset_cfg": ("robot", {"joint_names": ["elbow"]}),
        "friction_distribution_params": pytest.approx((0.01, 0.03)),
        "operation": "abs",
        "distribution": "uniform",
    }
    stiffness = found["stiffness_shoulder"]["params"]["stiffness_distribution_params"]
    assert stiffness == pytest.approx((51.0, 57.0))
    # The file has 0.2 of the joint and 3 of its servo; the range adds 0.3 and scales by 1.5.
    damping = found["damping_shoulder"]["params"]["damping_distribution_params"]
    assert damping == pytest.approx((0.4 + 4.2, 0.6 + 4.8))
    spin = found["damping_spin"]["params"]["damping_distribution_params"]
    assert spin == pytest.approx((0.05 * 1.8, 0.05 * 2.2))
    mass = found["body_mass_fore"]
    assert mass["func"] == "randomize_rigid_body_mass"
    assert mass["params"]["mass_distribution_params"] == pytest.approx((0.96, 1.04))
    assert "# body_ipos (x) of body fore: 0.15 in the model file" in code
    assert found["body_ipos_fore"]["params"]["com_range"] == {
        "x": pytest.approx((0.005, 0.015)),
        "z": pytest.approx((-0.03, -0.01)),
    }
    inertia = found["body_inertia_fore"]["params"]
    assert mass["params"]["recompute_inertia"] is False
    assert inertia["inertia_distribution_params"] == pytest.approx((1.3125, 1.4375))
    gravity = found["gravity"]["params"]["gravity_distribution_params"]
    size = 9.81
    np.testing.assert_allclose(gravity[0], [0.02 * size, -0.01 * size, -0.99 * size])
    np.testing.assert_allclose(gravity[1], [0.04 * size, 0.01 * size, -0.97 * size])
    missing = code.split("no event term for:")[1]
    for name in ("drag.quadratic", "spring.linear", "actuator.limit", "input.delay"):
        assert name in missing


EVIL = 'a\nimport os  # """ \\ \' <b>'


def test_names_from_files_do_not_become_code(tmp_path):
    path = tmp_path / "arm.xml"
    joint = EVIL.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    path.write_text(ARM.replace("elbow", joint.replace("\n", "&#10;")))
    kind = make_robot_simulator(path)
    name = kind.robot.joints[1].name
    found = explanation_of(kind, {f"friction.coulomb@{name}": one(0.1, 0.01)}, title=EVIL)
    files = files_of(found)
    (term,) = events(files["ranges_isaac_lab.py"]).values()
    (pattern,) = term["params"]["asset_cfg"][1]["joint_names"]
    assert re.fullmatch(pattern, name)
    model, _ = randomized(files["ranges_mujoco_playground.py"], kind.robot.compiled)
    assert model._values["dof_frictionloss"][:, 1] == pytest.approx([0.14, 0.16])
    assert tomllib.loads(files["ranges.toml"])["recording"] == EVIL
    for line in files["ranges_isaac_lab.py"].splitlines():
        assert not line.startswith("import os")


# -- command


@pytest.mark.slow
def test_the_command_writes_ranges_of_the_example(tmp_path):
    out = tmp_path / "out"
    log = str(EXAMPLE / "log.csv")
    arguments = ["explain", log, "--out", str(out), "--ranges", "--jobs", "1", "--json"]
    said = json.loads(run_command(*arguments).out)
    for name in NAMES:
        assert str(out / name) in said["files"]
        assert (out / name).exists()
    jsonschema.validate(said["ranges"], RANGES_SCHEMA)
    assert said["ranges_left_out"] == []
    (found,) = tomllib.loads((out / "ranges.toml").read_text())["ranges"]
    assert [found] == said["ranges"]
    assert (found["cause"], found["field"]) == ("friction.coulomb@elbow", "dof_frictionloss")
    assert found["low"] < 0.03 < found["high"]
    model = mujoco.MjModel.from_xml_path(str(out / "extended.xml"))
    (address,) = found["address"]
    assert model.dof_frictionloss[address] == pytest.approx(found["value"], rel=1e-6)


def test_without_a_model_file_a_line_and_no_file(tmp_path):
    log = str(tmp_path / "swing.csv")
    run_command("simulate", "pendulum", "--noise", "0.01", "--runs", "2", "--out", log)
    out = tmp_path / "out"
    assert (
        "no ranges are written: system pendulum has no model file"
        in run_command("explain", log, "--out", out, "--ranges", "--jobs", "1").out
    )
    assert not list(out.glob("ranges*"))


def test_ranges_and_each_do_not_go_together(tmp_path):
    log = str(EXAMPLE / "log.csv")
    assert (
        "--ranges: not possible together with --each"
        in run_command("explain", log, "--each", "--ranges", "--out", tmp_path / "out", code=2).err
    )
    assert not (tmp_path / "out").exists()
