"""A robot's model file as a simulator that any tuner tunes and explain explains.

MuJoCo steps at the model's own time step and with its own integrator. Samples of a log lie where
they lie: between two steps a position is the cubic through both ends with both velocities, other
readings are linear. What an actuator is given over a step is the mean of its command over the step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.base import Array, InputError, Scenario, unknown
from sims.plan import Plan, Runs, felt_inputs, make_runs
from sims.robot.forces import OVER_TIME, Forces, over_time
from sims.robot.lanes import LANES, SIZES, Addresses, Bench, Places
from sims.robot.model import Robot
from sims.robot.native import FIELDS
from sims.robot.sampling import sampled
from sims.robot.system import RobotSystem, system_of
from sims.simulated import Simulated
from sims.system import Acting, Effect, Engine, Input, Lanes, Motion, Sensor, System
from sims.user_toml import shown

INTEGRATORS = {"Euler": 0, "RK4": 1, "implicit": 2, "implicitfast": 3}
"""MuJoCo's integrators, by their names in a model file."""
SHARE = 1e-6
"""Of a step by which a run may exceed a whole number of them."""


Mask = NDArray[np.bool_]


class Numerics(NamedTuple):
    """How MuJoCo steps: seconds, and the integrator's name."""

    timestep: float
    integrator: str

    def settings(self) -> dict[str, float]:
        """As options of a model."""
        return {"timestep": self.timestep, "integrator": INTEGRATORS[self.integrator]}


class RobotEngine:
    """MuJoCo at the model's own step; `RobotSimulator` steps it."""

    name = "mujoco"
    requires: tuple[str, ...] = ("mujoco",)

    def __init__(self, numerics: Numerics) -> None:
        self.numerics = numerics
        self.largest_step = numerics.timestep

    def integrate(self, lanes: Lanes) -> Motion:
        """Not for anything but robots."""
        raise NotImplementedError

    def refuses(self, system: type[System]) -> str:
        """Everything that has no model file."""
        return "" if system.has_model else "it has no model file"

    def close(self) -> None:
        """Nothing to give back."""


class RobotSimulator(Simulated):
    """Base of the simulators of robots; `robot_simulator` makes one of a model file.

    Attributes:
        robot: whose.
        numerics: the file's own step and integrator, or others.
    """

    system: ClassVar[type[RobotSystem]] = RobotSystem
    default_engine = "mujoco"
    own_engine = True
    has_model = True
    requires = ("mujoco",)
    robot: ClassVar[Robot]
    numerics: ClassVar[Numerics]
    free: ClassVar[tuple[str, ...]] = ()

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        freed = self.system.freed_effects
        self._freed: list[Effect] = [effect() for effect in freed]
        self._robotic = self.system()
        self._addresses = Addresses(self.robot)
        self._benches: dict[tuple[bool, int], Bench] = {}

    def _engine(self, name: str | None, settings: Mapping[str, Any]) -> Engine:
        if name not in (None, "mujoco"):
            raise InputError(f"robot {self.name} steps in MuJoCo; it has no engine '{name}'")
        for setting in settings:
            if setting not in Numerics._fields:
                raise unknown("setting of engine mujoco", setting, Numerics._fields)
        numerics = self.numerics._replace(**settings)
        if numerics.integrator not in INTEGRATORS:
            raise unknown("integrator", str(numerics.integrator), list(INTEGRATORS))
        if not (isinstance(numerics.timestep, float) and numerics.timestep > 0):
            found = shown(numerics.timestep)
            raise InputError(f"timestep must be a positive number of seconds, found {found}")
        return RobotEngine(numerics)

    @property
    def step(self) -> float:
        """Seconds of a step."""
        return self.engine.largest_step

    def _acting(self, theta: Array) -> Acting:
        """See `Simulated`; freed numbers come first, and families in their parts."""
        acting: list[tuple[Effect, Array]] = []
        place = 0
        for effect in self._freed:
            count = len(effect.coefficients)
            acting.append((effect, theta[:, place : place + count].T[:, :, None]))
            place += count
        acting += super()._acting(theta)
        parts = [part for effect, c in acting if c.any() for part in effect.parts(c)]
        return tuple((effect, c) for effect, c in parts if c.any())

    def simulate_lanes(
        self,
        theta: Array,
        scenarios: Sequence[Scenario],
        initial: Mapping[str, Array] | None = None,
    ) -> Array:
        """See `Simulated.simulate_lanes`."""
        theta = np.asarray(theta, dtype=np.float64)
        if theta.ndim != 2 or theta.shape != (len(scenarios), len(self.parameters)):
            expected = (len(scenarios), len(self.parameters))
            raise InputError(f"theta must have shape {expected}, found {theta.shape}")
        if not len(theta):
            return np.empty((0, 0, len(self.channels)))
        acting = self._acting(theta)
        runs = make_runs(scenarios)
        commands = [self.run_inputs(s) for s in runs.distinct]
        _, x, v = self._known(scenarios, initial or {})
        longest = max(s.times.size for s in runs.distinct)
        result = np.full((len(theta), longest, len(self.channels)), np.nan)
        derived = _lanes_with(acting, len(theta), lambda e: _native(e) and FIELDS[e.of].derived)
        asked = _lanes_with(acting, len(theta), _is_asked)
        with np.errstate(all="ignore"):  # a lane whose numbers overflow is NaN in the end
            for run, scenario in enumerate(runs.distinct):
                size = scenario.times.size
                for kind in range(4):
                    of_kind = (derived == bool(kind & 1)) & (asked == bool(kind & 2))
                    lanes = np.flatnonzero((runs.of == run) & of_kind)
                    for part in np.array_split(lanes, max(-(-lanes.size // LANES), 1)):
                        if not part.size:
                            continue
                        work = Work(scenario, commands[run], _part(acting, part), x[part], v[part])
                        done = self._simulate(work, bool(kind & 1), bool(kind & 2))
                        result[part, :size] = done
        result += 0.0  # no zero is negative: whatever made it, it is the same zero
        return result

    def _simulate(self, work: Work, derived: bool, asked: bool) -> Array:
        """Observations (n, T, C) of lanes of one run and kind."""
        times = work.scenario.times - work.scenario.times[0]
        steps = max(int(np.ceil(times[-1] / self.step - SHARE)), 1)
        # What is felt now is read in the step that begins now.
        felt = self._feels()
        made = self._stepped(work, steps + felt, derived, asked)
        return self._shown(made, work, times, steps)

    def _feels(self) -> bool:
        """Whether a channel is recorded that MuJoCo computes within a step."""
        return any(c.name.startswith(("tau.", "s.")) for c in self.channels)

    def controls(self, work: Work, steps: int) -> tuple[Array, Array, dict[str, Array]]:
        """Controls (n, S, nu) and generalised forces (n, S, nv) that are known beforehand, and what
        each input is felt as, (n, S) by name.
        """
        n = len(work.x)
        ends: Array = self.step * np.arange(1.0, steps + 1.0)
        lengths = np.full((n, steps), self.step)
        rows = np.zeros((n, 1), dtype=np.intp)
        whole = np.broadcast_to(ends, (n, steps))
        plan = Plan(lengths, whole, 1, rows, alike=True)
        shifted = Plan(lengths, whole, 1, rows, alike=False)
        runs = Runs((work.scenario,), np.zeros(n, dtype=np.intp))
        felt = {}
        for name, signal in work.commands.items():
            passed = tuple(
                (e, c) for e, c in work.acting if isinstance(e, Input) and e.signal == name
            )
            there = shifted if passed else plan
            felt[name] = felt_inputs(there, runs, [{name: signal}], passed)[name]
        model = self.robot.compiled
        controls = np.zeros((n, steps, model.nu))
        forces = np.zeros((n, steps, model.nv))
        for actuator in self.robot.actuators:
            controls[:, :, actuator.id] = felt[f"u.{actuator.name}"]
        for joint in self.robot.joints:
            if joint.single:
                forces[:, :, joint.velocity] = felt[f"force.{joint.name}"]
        forces[:, :, self._addresses.velocities] += over_time(
            self._robotic, work.acting, ends - self.step, len(self._addresses.velocities), n
        )
        return controls, forces, felt

    def _stepped(self, work: Work, steps: int, derived: bool, asked: bool) -> Made:
        controls, forces, felt = self.controls(work, steps)
        n = len(work.x)
        bench = self._bench(derived, n)
        bench.load(_filled(_natives(work.acting), n, bench.count))
        bench.begin(work.x, work.v, self._addresses)
        bench.settle(controls[:, 0])
        record = ["qpos", "qvel"]
        if any(c.name.startswith("tau.") for c in self.channels):
            record.append("qfrc_actuator")
        if any(c.name.startswith("s.") for c in self.channels):
            record.append("sensordata")
        if asked:
            asking = Forces(self._robotic, work.acting, n, self._addresses)
            done = bench.ask(controls, forces, felt, asking, self.step, tuple(record))
        else:
            done = bench.run(controls, forces, tuple(record))
        places = self._addresses
        x = np.concatenate([work.x[:, None], done["qpos"][:, :, places.positions]], axis=1)
        v = np.concatenate([work.v[:, None], done["qvel"][:, :, places.velocities]], axis=1)
        x[bench.failed] = np.nan
        return Made(x, v, done.get("qfrc_actuator"), done.get("sensordata"), bench.failed)

    def _bench(self, derived: bool, lanes: int) -> Bench:
        # A tuner asks for one lane at a time: it shall not pay for all the others.
        count = next(size for size in SIZES if size >= lanes)
        if (derived, count) not in self._benches:
            engine = self.engine
            assert isinstance(engine, RobotEngine)
            settings = engine.numerics.settings()
            self._benches[derived, count] = Bench(self.robot, derived, settings, count)
        return self._benches[derived, count]

    def _shown(self, made: Made, work: Work, times: Array, steps: int) -> Array:
        """What the sensors record: (n, T, C)."""
        columns = []
        for channel in self.channels:
            values, slopes = self._signal(made, channel.name, steps)
            sensors = tuple(
                (e, c)
                for e, c in work.acting
                if isinstance(e, Sensor) and e.signal in ("", channel.name)
            )
            columns.append(sampled(values, slopes, self.step, times, sensors))
        result = np.stack(columns, axis=2)
        result[made.failed] = np.nan
        return result

    def _signal(self, made: Made, name: str, steps: int) -> tuple[Array, Array | None]:
        """Values of a channel at the beginning of every step and at the end, (n, S + 1), and their
        slopes where they are known.
        """
        kind, _, of = name.partition(".")
        upto = slice(steps + 1)
        if kind in ("q", "qd"):
            number = self.system.coordinates.index(f"q.{of}")
            if kind == "q":
                return made.x[:, upto, number], made.v[:, upto, number]
            return made.v[:, upto, number], None
        if kind == "tau":
            assert made.drive is not None
            return made.drive[:, upto, self.robot.joint(of).velocity], None
        assert made.sensors is not None
        row = next(s for s in self.robot.sensors if s.name == of)
        return made.sensors[:, upto, row.address], None

    def close(self) -> None:
        """Give back the batches."""
        self._benches.clear()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_benches": {}}


class Work(NamedTuple):
    """Lanes of one run.

    Attributes:
        scenario: theirs.
        commands: its inputs (T,) by name.
        acting: effects at one place each, with coefficients (K, n, 1).
        x, v: (n, D) initial positions and velocities.
    """

    scenario: Scenario
    commands: Mapping[str, Array]
    acting: Acting
    x: Array
    v: Array


class Made(NamedTuple):
    """What MuJoCo made of n lanes.

    Attributes:
        x, v: (n, S + 1, D) at the beginning and after every step.
        drive: (n, S, nv) forces of actuators in each step; None where nobody asked.
        sensors: (n, S, k) sensor data likewise.
        failed: (n,) which lanes did.
    """

    x: Array
    v: Array
    drive: Array | None
    sensors: Array | None
    failed: Mask


def _native(effect: Effect) -> bool:
    return (effect.of or effect.name) in FIELDS and effect.hook in ("value", "force")


def _natives(acting: Acting) -> Acting:
    return tuple((e, c) for e, c in acting if _native(e))


def _is_asked(effect: Effect) -> bool:
    """Whether its force is known only when the robot is there."""
    return effect.hook == "force" and not _native(effect) and effect.of not in OVER_TIME


def _lanes_with(acting: Acting, count: int, which: Callable[[Effect], bool]) -> Mask:
    """(L,) in which lanes an effect acts of those that `which` says."""
    there = np.zeros(count, dtype=bool)
    for effect, c in acting:
        if which(effect):
            there |= (c != 0).any(axis=0)[:, 0]
    return there


def _part(acting: Acting, lanes: Places) -> Acting:
    parts = tuple((e, c[:, lanes]) for e, c in acting)
    return tuple((e, c) for e, c in parts if c.any())


def _filled(acting: Acting, n: int, count: int) -> Acting:
    """Coefficients for all lanes of a batch, zero behind the first n."""
    return tuple(
        (e, np.concatenate([c, np.zeros((len(c), count - n, 1))], axis=1)) for e, c in acting
    )


def robot_simulator(
    robot: Robot, free: Sequence[str] = (), numerics: Numerics | None = None
) -> type[RobotSimulator]:
    """The simulator of a robot.

    Args:
        robot: that was read.
        free: numbers of the file to tune, as ``damping@*`` or ``mass@forearm``.
        numerics: other than those of the file.

    Raises:
        InputError: it has no joint that can be explained, or a name in `free` does not exist.
    """
    option = robot.compiled.opt
    names = {number: name for name, number in INTEGRATORS.items()}
    own = Numerics(float(option.timestep), names[int(option.integrator)])
    declared = {
        "system": system_of(robot, free),
        "robot": robot,
        "numerics": numerics or own,
        "free": tuple(free),
        "__module__": __name__,
        "__doc__": f"The robot of {robot.path.name}.",
    }
    return type("RobotOfFile", (RobotSimulator,), declared)
