"""A servo and an arm of two joints, by equations of their own: they move as simgap's simulators do
with each effect, as mechanics says, and hide what they say they hide.
"""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnoser import Case, library_of
from bench.diagnosers.evidence import Evidence
from bench.diagnosis.marks import _classes, marked
from bench.diagnosis.worlds.item import Item
from bench.diagnosis.worlds.machines.causes import EFFECTS, places
from bench.diagnosis.worlds.machines.files import NAME, model_file
from bench.diagnosis.worlds.machines.items import draw, setting_of, written
from bench.diagnosis.worlds.machines.motion import Runs, moved, read
from bench.diagnosis.worlds.machines.plants import PLANTS, Arm, Servo
from bench.diagnosis.worlds.questions import coefficients_of, texts_of
from bench.diagnosis.worlds.settings import Circumstances
from bench.recordings.inspection import load, robot
from sims.base import Scenario
from sims.servo.simulator import Servo as ServoSimulator

ARM = {
    "mass1": 1.2, "centre1": 0.18, "inertia1": 0.018, "damping1": 0.3, "armature1": 0.01,
    "length": 0.4, "mass2": 0.8, "centre2": 0.15, "inertia2": 0.009, "damping2": 0.1,
    "armature2": 0.005,
}  # fmt: skip
SERVO = {"torque_constant": 0.5, "resistance": 4.0, "armature": 2e-3}
CONSTANTS = {c.name: c.value for c in ServoSimulator.constants}
TIMES = np.arange(40) / 50
SOMEWHERE = {
    "drag.linear": (0.1,), "drag.quadratic": (0.1,), "force.bias": (0.06,),
    "force.ripple": (0.08, 0.08, 0.3), "friction.coulomb": (0.05,),
    "friction.stribeck": (0.03, 0.05, 0.5), "spring.linear": (0.2,), "input.bias": (0.2,),
    "input.deadband": (0.1,), "input.delay": (0.031,), "input.gain": (0.2,),
    "input.lag": (0.05,), "input.saturation": (0.35,), "sensor.bias": (0.1,),
    "sensor.delay": (0.021,), "sensor.drift": (0.05,), "sensor.gain": (0.2,),
    "gravity.scale": (0.1,), "gravity.tilt": (0.1, 0.0), "inertia.armature": (0.01,),
    "mass.scale": (0.2,), "servo.deadband": (0.05,),
}  # fmt: skip
SOFT = 1e-3
"""rad: MuJoCo's dry friction and drives bend no sharper than its step; see docs/engines.md."""


def commands(plant):
    rng = np.random.default_rng(4)
    sizes = (0.7,) if len(plant.joints) == 1 else (3.0, 0.8)
    return np.stack([s * np.repeat(rng.uniform(-1, 1, 4), 10) for s in sizes], axis=1)


def seen(system, effects, foreign=None):
    plant = PLANTS[system](ARM if system == "arm2" else CONSTANTS | SERVO, effects, foreign or {})
    count = len(plant.joints)
    begun = np.array([[0.3, -0.2][:count]])
    runs = Runs(TIMES, commands(plant)[None], begun, 0.5 * begun)
    return read(moved(plant, runs), plant, TIMES)[0]


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / NAME
    path.write_text(model_file(ARM))
    return robot(path)


def by_simgap(system, effects, arm):
    fixed = {name: list(c) for name, c in effects.items()}
    u = commands(PLANTS[system])
    if system == "servo":
        made = ServoSimulator(CONSTANTS, ["q"], engine="batch", fixed=fixed)
        inputs = {"goal": u[:, 0], "torque_enable": np.ones(len(TIMES))}
        theta, begun = np.array([[*SERVO.values()]]), {"q": 0.3, "qd": 0.15}
    else:
        made = arm({}, ["q.shoulder", "q.elbow"], fixed=fixed)
        inputs = {"u.m_shoulder": u[:, 0], "u.m_elbow": u[:, 1]}
        begun = {"q.shoulder": 0.3, "q.elbow": -0.2, "qd.shoulder": 0.15, "qd.elbow": -0.1}
        theta = np.zeros((1, 0))
    return made.simulate(theta, Scenario(TIMES, begun, inputs))[0]


ASKED = [
    (system, name)
    for system, effects in EFFECTS.items()
    for effect in effects
    for name in places(system, effect)
]


@pytest.mark.slow
@pytest.mark.parametrize(("system", "name"), ASKED)
def test_each_effect_does_what_the_library_says(system, name, arm):
    c = SOMEWHERE[name.partition("@")[0]]
    if name == "gravity.tilt" and system == "servo":
        c = c[:1]
    own, other = seen(system, {name: c}), by_simgap(system, {name: c}, arm)
    change = np.abs(own - seen(system, {})).max()
    tolerance = SOFT if system == "arm2" else 2e-4
    assert np.abs(own - other).max() < tolerance
    assert change > 10 * tolerance  # or else the agreement says nothing
    assert len(coefficients_of(system, name)) == len(c)


def test_another_coefficient_would_not_agree(arm):
    own = seen("arm2", {"mass.scale@forearm": (0.22,)})
    other = by_simgap("arm2", {"mass.scale@forearm": (0.2,)}, arm)
    assert np.abs(own - other).max() > SOFT


def test_a_wheel_with_dry_friction_stops_where_mechanics_says():
    free = CONSTANTS | SERVO | {"kp": 0.0, "gravity": 0.0, "torque_constant": 0.0}
    plant = Servo(free, {"friction.coulomb": (0.02,)}, {})
    inertia = float(plant.inertia(np.zeros((1, 1)))[0, 0, 0])
    speed, slows = 1.5, 0.02 / inertia
    runs = Runs(TIMES, np.zeros((1, 40, 1)), np.zeros((1, 1)), np.array([[speed]]))
    motion = moved(plant, runs)
    assert TIMES[-1] > speed / slows
    assert motion.q[-1, 0, 0] == pytest.approx(speed**2 / (2 * slows), rel=1e-4)
    assert motion.v[-1, 0, 0] == 0.0


def test_an_arm_is_held_until_a_motor_exceeds_its_friction():
    plant = Arm(ARM, {"friction.coulomb@shoulder": (1.0,), "friction.coulomb@elbow": (9.0,)}, {})
    told = np.zeros((1, 40, 2))
    told[0, 20:, 0] = 1.05
    motion = moved(plant, Runs(TIMES, told, np.zeros((1, 2)), np.zeros((1, 2))))
    before = motion.times <= TIMES[20]
    assert np.abs(motion.q[before]).max() == 0.0
    assert motion.q[-1, 0, 0] > 1e-3
    assert np.abs(motion.q[:, 0, 1]).max() == 0.0


def test_foreign_causes_push_where_and_when_they_say():
    bare = seen("arm2", {})
    gust = seen("arm2", {}, {"gust@elbow": (0.5, 0.61, 0.2)})
    assert np.abs(gust - bare)[TIMES <= 0.6].max() == 0.0
    assert np.abs(gust - bare).max() > 0.01
    patch = seen("arm2", {}, {"patch@shoulder": (0.5, 5.0, 0.1)})
    assert np.abs(patch - bare).max() < 1e-6  # it never goes there


def case_of(item, folder):
    path = written(item, folder)
    recording, kind = load(path)
    rng = np.random.default_rng(0)
    return Case(path, recording, kind, library_of(kind, recording), rng, 10**6, 60.0)


@pytest.mark.parametrize(
    ("system", "effect"), [("servo", "friction.coulomb"), ("arm2", "input.delay")]
)
def test_what_is_hidden_leaves_its_size(system, effect, tmp_path):
    item = draw("single", system, 11, effect, 6.0, Circumstances(50, 3))
    case = case_of(item, tmp_path)
    assert item.size == 6.0
    evidence = Evidence(case, every=False)
    sigma = setting_of(item.name, system, item.asked).sigma
    left = np.sqrt(np.mean(np.square(evidence.residual[evidence.seen] / sigma)))
    evidence.close()
    assert left == pytest.approx(np.sqrt(1 + 6.0**2), rel=0.08)


def test_texts_say_nothing_of_what_is_hidden():
    clean = draw("clean", "arm2", 3)
    item = replace(clean, kind="single", effects={"mass.scale@forearm": (0.1,)})
    texts = texts_of(item)
    assert set(texts.beside) == {NAME}
    stated = setting_of(item.name, "arm2", item.asked).numbers
    assert f'mass="{stated["mass1"]!r}"' in texts.beside[NAME]
    whole = "".join([texts.description, *texts.beside.values()])
    assert "scale" not in whole
    assert item.name not in whole


def test_an_item_is_a_recipe():
    item = draw("clean", "servo", 5)
    assert Item.of(item.json()) == item
    assert texts_of(item) == texts_of(Item.of(item.json()))
    assert texts_of(item) != texts_of(draw("clean", "servo", 6))


def test_a_family_beside_one_of_its_places_is_one_answer():
    item = draw("clean", "arm2", 5)
    names = ["friction.coulomb@*", "friction.coulomb@elbow", "friction.stribeck@elbow"]
    assert _classes(item, names) == 2
    assert _classes(item, ["friction.coulomb@*", "friction.stribeck@elbow"]) == 2
    hidden = replace(item, kind="single", effects={"friction.coulomb@elbow": (1.0,)})
    cause = {"effect": "friction.coulomb@*", "alternatives": [], "coefficients": {}}
    verdict = {"verdict": "named", "causes": [cause], "parameters": {}}
    assert marked(hidden, verdict).outcome == "wrong"  # it says that the shoulder rubs too
    cause["alternatives"] = ["friction.coulomb@elbow"]
    assert marked(hidden, verdict).class_size == 1
