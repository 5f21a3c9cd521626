"""Cases of floating-base robots, drawn from their name."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tests.exams.exam import Exam, Target, UndrawableError
from tests.exams.floating import floating_robots
from tests.exams.robots import cause_sizing, planted_effects, unmodelled_causes
from tests.exams.robots.cause_sizing import Gauge
from tests.exams.robots.robot_cases import (
    MIN_RESIDUAL_WITHOUT_CAUSE,
    TELLING,
    RobotQuestion,
    bare_case,
    draw_size,
    rng_of,
    setting_of,
    simpler_changes,
)

SHARED = (
    "friction.coulomb", "friction.stribeck", "drag.linear", "spring.linear", "force.bias",
    "inertia.armature", "mass.scale", "mass.offset", "inertia.scale", "input.gain", "input.bias",
    "input.delay", "input.lag", "sensor.gain", "sensor.delay",
)  # fmt: skip
OWN = {
    "satellite-motor": ("input.deadband",),
    "dropped-servo": ("actuator.stiffness", "actuator.damping"),
    "hung-motor": ("gravity.scale", "input.deadband"),
}
CLEAN = 40
"""Count of clean questions per robot."""
ATTEMPTS = 4  # Maximum number of drawings of a question whose cause is not visible.


@dataclass(frozen=True)
class FloatingQuestion(RobotQuestion):
    """Specification of a case of a floating-base robot."""

    def draw(self, seed=0):
        """Return the first drawing whose cause is visible."""
        for attempt in range(ATTEMPTS):
            number = 1000 * seed + 10 * self.index + attempt
            case = _draw(f"{self.kind}/{self.system}/{self.effect}/{number}", self.effect)
            if case is not None:
                return case
        raise UndrawableError("these commands and this robot do not show the cause")


def questions(seed=0):
    """Return all questions."""
    sheet = []
    for robot in floating_robots.NAMES:
        sheet += [FloatingQuestion("clean", robot, "any", index) for index in range(CLEAN)]
        sheet += [FloatingQuestion("single", robot, effect, 0) for effect in SHARED + OWN[robot]]
        sheet += [FloatingQuestion("foreign", robot, c, 0) for c in planted_effects.FOREIGN]
    return sheet


def _draw(name, effect):
    case, setting, rng = bare_case(name, {}), setting_of(name), rng_of(name, "cause")
    if case.kind == "clean":
        return case
    gauge, machine = Gauge(setting), setting.machine
    if case.kind == "foreign":
        of = unmodelled_causes.drawn(effect, int(rng.choice(machine.driven)), setting, rng)
    else:
        places = [p for p in planted_effects.places(machine, effect) if "~" not in p]
        place = str(rng.choice(list(dict.fromkeys(places))))
        coefficients = planted_effects.shape(effect, place, setting, rng)

        def of(strength):
            return {planted_effects.named(effect, place): coefficients(strength)}

    found = cause_sizing.sized(lambda strength: gauge.gap(of(strength)), draw_size(rng))
    if found is None:
        return None
    hidden, beyond = of(found[0]), None
    change = np.concatenate(gauge.change(hidden))
    is_foreign = case.kind == "foreign"
    rivals = _near(setting, hidden, gauge, rng) if is_foreign else simpler_changes(hidden, gauge)
    if rivals:
        beyond = min(cause_sizing.left(change, [rival]) for rival in rivals)
        if beyond < (MIN_RESIDUAL_WITHOUT_CAUSE if is_foreign else TELLING):
            return None
    return replace(case, effects=hidden, size=found[1], beyond=beyond)


def _near(setting, hidden, gauge, rng):
    """Return the changes that single effects at the joint of an unmodelled cause make."""
    ((_, c),) = hidden.items()
    joint = setting.machine.joints[int(c[0])]
    changes = []
    for effect in ("friction.coulomb", "drag.linear", "spring.linear", "force.bias"):
        size = planted_effects.shape(effect, joint, setting, rng)(0.05)
        changes.append(np.concatenate(gauge.change({f"{effect}@{joint}": size})))
    return changes


EXAM = Exam(
    "Causes hidden in robots with a floating base",
    "Hulls in space with an arm, falling trunks with two legs, and bodies on a ball joint, "
    "simulated by Pinocchio and the integrator of `tests/exams/robots`.",
    questions,
    (
        Target("a single cause: effect and place, alone", "single", "strict"),
        Target("the same, or in any set", "single", "any"),
        Target("a cause outside the library: unknown or partial", "foreign", "strict"),
    ),
    groups=("effect", "system", "noise"), cpu_limit=900.0,
)  # fmt: skip
