"""Cases of robots: recordings with a hidden cause, drawn from a seed.

`draw_robot_case` chooses the cause, its place and its size. Everything that is drawn follows from
the name of the case. A case is a specification and contains no data. Pinocchio and the integrator
of this folder make the recordings, not MuJoCo, which explains them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import lru_cache

import numpy as np

from bench.diagnosis_benchmark.case_generation.benchmark_case import (
    MIN_DISTINCT_SIZE,
    MIN_SIMPLER_RESIDUAL,
)
from tests.exams.exam import (
    Case,
    Exam,
    Question,
    Target,
    UndrawableError,
    conditions_text,
    hidden_text,
    number,
)
from tests.exams.marking import HiddenCause, Standard, mark_answer
from tests.exams.robot_files import signal_unit, write_robot_recording
from tests.exams.robots import (
    cause_sizing,
    exam_settings,
    floating_robots,
    planted_effects,
    reference_plant,
)
from tests.exams.robots.cause_sizing import CompetingCauses, Gauge
from tests.exams.robots.reference_world import World
from tests.exams.robots.robot_models import NAMES
from tests.exams.robots.robot_signals import observed

KINDS = ("clean", "single", "family", "double", "foreign", "numerics")
CLEAN, DOUBLE, FOREIGN, FAMILY, NUMERICS = 24, 4, 2, 2, 2
"""Questions for each robot and drive: clean, double, each unmodelled cause, each family, numerics.
"""
FLOATING_CLEAN = 40  # Clean questions for each robot with a floating base.
ATTEMPTS = 6  # Maximum number of drawings of a question whose cause is not visible.
MAX_COMPETING_CAUSES = 6  # Maximum number of other causes of a set that are refitted.
QUICK = (
    ("clean", "arm2-motor", "any"), ("single", "arm2-motor", "friction.coulomb"),
    ("single", "arm2-motor", "mass.scale"), ("clean", "arm2-servo", "any"),
    ("single", "arm2-servo", "drag.linear"), ("single", "arm2-servo", "input.delay"),
)  # fmt: skip
STANDARD = Standard(max_set=4, equal_below=1.05)


@dataclass(frozen=True)
class RobotQuestion(Question):
    """Specification of a case; `index` distinguishes questions of the same kind."""

    kind: str
    system: str
    effect: str
    index: int

    @property
    def name(self):
        return f"{self.kind}/{self.system}/{self.effect}/{self.index}"

    def draw(self, seed=0):
        """Return the first drawing whose cause is visible."""
        first = 1000 * seed + 10 * self.index
        for attempt in range(ATTEMPTS):
            case = draw_robot_case(self.kind, self.system, self.effect, first + attempt)
            if case is not None:
                return case
        raise UndrawableError("these commands and this machine do not show the cause")

    def restore(self, saved):
        effects = {name: tuple(values) for name, values in saved["effects"].items()}
        return RobotCase(**saved | {"effects": effects, "channels": tuple(saved["channels"])})


@dataclass(frozen=True)
class RobotCase(Case):
    """One case of a robot.

    Attributes:
        name: kind, robot, requested effect and seed.
        kind: one of `KINDS`.
        robot: one of `robot_models.NAMES` or `floating_robots.NAMES`.
        effects: hidden coefficients by effect@place; for an unmodelled cause, its own numbers.
        family: whether all effects are one family with one coefficient per place.
        size: RMS discrepancy in the fitted runs with refitted initial states, in units of the
            noise. For two causes it is the smaller one; for backlash and joint flexibility, the
            effect of the drive inertia alone is subtracted.
        noise: white, ar1 or quantised.
        channels: names of the recorded channels.
        beyond: residual in units of the noise with the nearest tested alternatives, to first order;
            None if none were tested.
        numerics: error of MuJoCo's numerics in units of the noise.
        step, integrator: MuJoCo settings that the recording specifies.
    """

    name: str
    kind: str
    robot: str
    effects: dict[str, tuple[float, ...]]
    family: bool
    size: float
    noise: str
    channels: tuple[str, ...]
    beyond: float | None
    numerics: float
    step: float
    integrator: str

    def save(self):
        return asdict(self)

    def write(self, folder):
        return write_setting(self, setting_of(self.name), folder)

    def describe(self):
        conditions = conditions_text(
            drive=self.robot.partition("-")[2], beyond=number(self.beyond),
            numerics=number(self.numerics), step=f"{self.integrator} {self.step}",
            channels=" ".join(self.channels), case=self.name,
        )  # fmt: skip
        hidden, size = hidden_text(self.effects), number(self.size)
        return {"hidden": hidden, "size": size, "noise": self.noise, "conditions": conditions}

    def mark(self, outcome):
        hidden_cause = HiddenCause(self.kind, self.effects)
        return mark_answer(hidden_cause, outcome.verdict, STANDARD, self._held_out_ratios)

    def _held_out_ratios(self, sets):
        """Return held-out error ratios of the other members of the sets that hold the cause."""
        if self.robot in floating_robots.NAMES:
            return {}
        setting, hidden = setting_of(self.name), set(self.effects)
        rivals = CompetingCauses(setting, self.effects, record(self, setting))
        ratios = {}
        for names in sets:
            beside = hidden - set(names) if not self.family else ()
            for name in [n for n in names if n not in hidden][:MAX_COMPETING_CAUSES]:
                ratios[name] = rivals.ratio(name, beside)
        return ratios


def rng_of(name, purpose):
    return np.random.default_rng(list(f"{name} {purpose}".encode()))


@lru_cache(maxsize=4)
def setting_of(name):
    """Return the setting in which the case of this name was drawn."""
    kind, robot, *_ = name.split("/")
    return exam_settings.setting(robot, rng_of(name, "setting"), coarse=kind == "numerics")


@lru_cache(maxsize=2)
def gauge_of(name):
    return Gauge(setting_of(name))


def bare_case(name, effects):
    """Return the case of a name with given effects; no size is measured."""
    kind, robot, *_ = name.split("/")
    setting = setting_of(name)
    machine = setting.machine
    return RobotCase(
        name, kind, robot, effects, False, 0.0, setting.noise.kind, setting.channels, None,
        setting.numerics, machine.step, machine.integrator,
    )  # fmt: skip


def record(case, setting):
    """Return the recorded channels of every run, (T, C)."""
    rng, world = rng_of(case.name, "noise"), World(setting.machine, case.effects)
    values = []
    for number_of_run, run in enumerate(setting.runs):
        slips = planted_effects.slips_of(case.effects, number_of_run)
        values.append(setting.noise.add_to(observed(world, run, setting.channels, slips), rng))
    return values


def write_setting(case, setting, folder):
    """Write recording.csv, recording.toml and the model file; return the path of the first."""
    machine, first_held_out = setting.machine, len(setting.runs) - setting.held_out
    inputs = {
        f"u.{d.name}": signal_unit("u", machine.unit(d.joint), not d.kp) for d in machine.drives
    }
    channels = {
        name: (signal_unit(name, machine.unit(name.partition(".")[2])), setting.noise.sigma[name])
        for name in setting.channels
    }
    readings = record(case, setting)
    runs = {
        str(k): (
            k >= first_held_out, run.times, np.column_stack(list(run.commands.values())),
            readings[k], machine.stated_initial_state(run),
        )
        for k, run in enumerate(setting.runs)
    }  # fmt: skip
    return write_robot_recording(
        folder, "recording", inputs, channels, runs, machine.model_file, **machine.description
    )


def draw_robot_case(kind, robot, effect, seed):
    """Draw a case, or return None if these commands and this machine cannot show the cause.

    Args:
        kind: one of `KINDS`.
        robot: one of `robot_models.NAMES`.
        effect: effect to hide (the first of two); "any" to draw it.
        seed: seed of everything else.
    """
    name = f"{kind}/{robot}/{effect}/{seed}"
    try:
        case = bare_case(name, {})
    except ValueError:
        return None
    if kind == "numerics":
        return replace(case, size=case.numerics)
    setting, rng = setting_of(name), rng_of(name, "cause")
    return case if kind == "clean" else DRAW[kind](case, setting, effect, rng)


def draw_size(rng):
    """Draw a size in units of the noise."""
    return float(np.exp(rng.uniform(np.log(3.0), np.log(10.0))))


def simpler_changes(hidden, gauge):
    """Return the changes that the simpler form of an effect causes, if there is one."""
    ((name, c),) = hidden.items()
    effect, _, place = name.partition("@")
    if effect not in planted_effects.SIMPLER:
        return []
    other = f"{planted_effects.SIMPLER[effect]}@{place}"
    sizes = [share * (c[0] + abs(c[1])) for share in (0.3, 0.6)]
    return [gauge.change({other: (size,)}) for size in sizes]


def _drawn_effect(item, effect, rng):
    return str(rng.choice(planted_effects.effects(item.robot))) if effect == "any" else effect


def _sized(item, effect, setting, rng, taken=()):
    """Return ({effect@place: coefficients}, size) at a drawn place; None if it is not visible."""
    places = [p for p in planted_effects.places(setting.machine, effect) if p not in taken]
    if not places:
        return None
    wanted = draw_size(rng)
    place = str(rng.choice(places))
    of, name = (
        planted_effects.shape(effect, place, setting, rng),
        planted_effects.named(effect, place),
    )
    gauge, beyond = gauge_of(item.name), 0.0
    if effect in planted_effects.WITH_ROTOR:
        # The drive inertia is there even if the joint is nearly rigid, so its change is subtracted.
        beyond = gauge.change(reference_plant.stiff(setting.machine, place, of(0.0)[-1]))
    found = cause_sizing.sized(lambda s: gauge.gap({name: of(s)}, beyond), wanted)
    return found and ({name: of(found[0])}, found[1])


def _single(item, setting, effect, rng):
    effect = _drawn_effect(item, effect, rng)
    found = _sized(item, effect, setting, rng)
    if found is None:
        return None
    hidden, size = found
    gauge, beyond = gauge_of(item.name), None
    if simpler := simpler_changes(hidden, gauge):
        beyond = cause_sizing.left(gauge.change(hidden), simpler)
        if beyond < MIN_SIMPLER_RESIDUAL:
            return None
    return replace(item, effects=hidden, size=size, beyond=beyond)


def _family(item, setting, effect, rng):
    effect = str(rng.choice(planted_effects.FAMILIES)) if effect == "any" else effect
    of = planted_effects.family(effect, setting, rng)
    found = cause_sizing.sized(lambda s: gauge_of(item.name).gap(of(s)), draw_size(rng))
    return found and replace(item, effects=of(found[0]), family=True, size=found[1])


def _double(item, setting, effect, rng):
    """Draw two causes at different places; one cause alone must not explain both."""
    first = _sized(item, _drawn_effect(item, effect, rng), setting, rng)
    if first is None:
        return None
    name = next(iter(first[0]))
    taken = (name.partition("@")[2],)
    pool = [e for e in planted_effects.effects(item.robot) if e != name.partition("@")[0]]
    second_effect = str(rng.choice(pool))
    if not [p for p in planted_effects.places(setting.machine, second_effect) if p not in taken]:
        return None
    second = _sized(item, second_effect, setting, rng, taken)
    if second is None:
        return None
    gauge, both = gauge_of(item.name), first[0] | second[0]
    if not np.isfinite(gauge.gap(both)):
        return None
    whole = gauge.change(both)
    alone = [gauge.change(part[0]) for part in (first, second)]
    beyond = min(cause_sizing.left(whole, [part]) for part in alone)
    size = min(first[1], second[1])
    return (
        replace(item, effects=both, size=size, beyond=beyond)
        if beyond >= MIN_DISTINCT_SIZE
        else None
    )


def _foreign(item, setting, effect, rng):
    """Draw an unmodelled cause that no effect at the same joint explains completely."""
    cause = str(rng.choice(planted_effects.FOREIGN)) if effect == "any" else effect
    joint = int(rng.choice(setting.machine.driven))
    of, gauge = planted_effects.drawn(cause, joint, setting, rng), gauge_of(item.name)
    found = cause_sizing.sized(lambda s: gauge.gap(of(s)), draw_size(rng))
    if found is None:
        return None
    hidden = of(found[0])
    change = gauge.change(hidden)
    others = _near(item.robot, setting, joint, gauge, rng)
    beyond = min(cause_sizing.left(change, [other]) for other in others)
    shown = replace(item, effects=hidden, size=found[1], beyond=beyond)
    return shown if beyond >= MIN_DISTINCT_SIZE else None


def _near(robot, setting, joint, gauge, rng):
    """Yield the changes (N,) that effects at one joint cause."""
    machine = setting.machine
    at = {machine.joints[joint], machine.bodies[joint], f"q.{machine.joints[joint]}"}
    at |= {d.name for d in machine.drives if d.joint == machine.joints[joint]} | {""}
    for effect in planted_effects.effects(robot):
        for place in sorted(at & set(planted_effects.places(machine, effect))):
            c = planted_effects.shape(effect, place, setting, rng)(0.05)
            yield gauge.change({planted_effects.named(effect, place): c})


DRAW = {"single": _single, "family": _family, "double": _double, "foreign": _foreign}


def questions(seed=0):
    """Return all questions, ordered by index and then by robot."""
    return [q for index in range(CLEAN) for robot in NAMES for q in _round(robot, index)]


def _round(robot, index):
    """Yield the questions of one index for a robot."""
    yield RobotQuestion("clean", robot, "any", index)
    if index < 1:
        for effect in planted_effects.effects(robot):
            yield RobotQuestion("single", robot, effect, index)
    if index < FAMILY:
        for effect in planted_effects.FAMILIES:
            yield RobotQuestion("family", robot, effect, index)
    if index < FOREIGN:
        for cause in planted_effects.FOREIGN:
            yield RobotQuestion("foreign", robot, cause, index)
    if index < DOUBLE:
        yield RobotQuestion("double", robot, "any", index)
    if index < NUMERICS and robot.endswith("servo"):
        yield RobotQuestion("numerics", robot, "any", index)


def floating_questions(seed=0):
    """Return all questions about robots with a floating base."""
    sheet = []
    for robot in floating_robots.NAMES:
        sheet += [RobotQuestion("clean", robot, "any", index) for index in range(FLOATING_CLEAN)]
        sheet += [RobotQuestion("single", robot, e, 0) for e in planted_effects.effects(robot)]
        sheet += [RobotQuestion("foreign", robot, cause, 0) for cause in planted_effects.FOREIGN]
    return sheet


def quick():
    """Return a few questions about two robots."""
    # Index 1 gives clean cases that end after the first test, as nine out of ten do.
    return [RobotQuestion(kind, robot, e, int(kind == "clean")) for kind, robot, e in QUICK]


def spread():
    """Return one question per effect, with the robots in turn; it takes one to two hours."""
    chosen = []
    for drive in ("motor", "servo"):
        robots = [name for name in NAMES if name.endswith(drive)]
        for place, effect in enumerate(planted_effects.effects(robots[0])):
            chosen.append(RobotQuestion("single", robots[place % len(robots)], effect, 0))
        for place, robot in enumerate(robots):
            chosen += [RobotQuestion(kind, robot, "any", 0) for kind in ("clean", "double")]
            cause = planted_effects.FOREIGN[place % len(planted_effects.FOREIGN)]
            chosen.append(RobotQuestion("foreign", robot, cause, 0))
            chosen.append(RobotQuestion("family", robot, planted_effects.FAMILIES[place % 2], 0))
    return chosen + [RobotQuestion("numerics", r, "any", 0) for r in ("arm2-servo", "iiwa-servo")]


TARGETS = (
    Target("a single cause: effect and place, alone", "single", "strict"),
    Target("the same, or in a set of at most 4", "single", "few"),
    Target("the same, or in a set whose other members fit equally well", "single", "fair", 0.95),
    Target("the same, or in any set", "single", "any"),
    Target("a family", "family", "any"),
    Target("two causes: both found", "double", "any", 0.80),
    Target("a cause outside the library: unknown or partial", "foreign", "strict", 0.95),
    Target("numerics that are too coarse: named", "numerics", "strict"),
)
EXAM = Exam(
    "Causes hidden in robots",
    "Recordings of robots of 2 to 7 joints, driven by forces or by position servos, made by "
    "Pinocchio and the integrator of `tests/exams/robots`: in each one hidden cause, a family, "
    "two, one that the library does not have, a time step that is too coarse, or none.",
    questions, TARGETS, quick, spread, ("effect", "system", "noise"), cpu_limit=900.0,
)  # fmt: skip
FLOATING_EXAM = Exam(
    "Causes hidden in robots with a floating base",
    "Hulls in space with an arm, falling trunks with two legs, and bodies on a ball joint, "
    "simulated by Pinocchio and the integrator of `tests/exams/robots`.",
    floating_questions, (TARGETS[0], TARGETS[3], replace(TARGETS[6], min_share=None)),
    groups=("effect", "system", "noise"), cpu_limit=900.0,
)  # fmt: skip
