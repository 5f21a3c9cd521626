"""Signals of robots: commands, effects on them, forces of actuators, and sensor readings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.diagnosis_benchmark.case_generation.input_and_sensor_effects import (
    SENSOR_EFFECTS,
    apply_input_effects,
)
from bench.diagnosis_benchmark.machine_cases.machine_simulation import select_signal_effects

FORMS = ("multisine", "ramps", "steps", "chirp")


def wave(form, times, rng):
    """Return a signal (T,) whose largest amplitude is 1."""
    signal = SIGNALS[form](times, rng)
    eased = np.clip(times / 0.4, 0.0, 1.0)
    return signal / max(np.abs(signal).max(), 1e-12) * eased**2 * (3 - 2 * eased)


def _multisine(times, rng):
    tones = np.exp(rng.uniform(np.log(0.25), np.log(2.5), 5))
    phases, heights = rng.uniform(0, 2 * np.pi, 5), rng.uniform(0.3, 1.0, 5) / tones**0.5
    return np.sin(2 * np.pi * tones * times[:, None] + phases) @ heights


def _levels(times, rng):
    """Draw random levels: (start times, levels)."""
    count = int(rng.integers(4, 8))
    begins = np.sort(rng.uniform(0.1, times[-1] - 0.3, count))
    return begins, rng.uniform(-1.0, 1.0, count)


def _ramps(times, rng):
    """Return ramps of constant rate between random levels, with a hold after each."""
    begins, levels = _levels(times, rng)
    ends = np.minimum(begins + rng.uniform(0.2, 0.8, begins.size), [*begins[1:], times[-1]])
    knots = np.column_stack([begins, ends]).ravel()
    heights = np.column_stack([[0.0, *levels[:-1]], levels]).ravel()
    return np.interp(times, knots, heights)


def _steps(times, rng):
    begins, levels = _levels(times, rng)
    return np.array([0.0, *levels])[np.searchsorted(begins, times, side="right")]


def _chirp(times, rng):
    low, high = rng.uniform(0.15, 0.4), rng.uniform(1.5, 3.0)
    phase = 2 * np.pi * (low * times + (high - low) * times**2 / (2 * times[-1]))
    return np.sin(phase + rng.uniform(0, 2 * np.pi))


SIGNALS = {"multisine": _multisine, "ramps": _ramps, "steps": _steps, "chirp": _chirp}


COUPLING = "joint.coupling@"
INPUTS = ("input.", "servo.derivative", "servo.profile")
CONTROL_PERIOD = 0.002
"""Period of a servo's controller, s."""


class AppliedSignal:
    """A command on its way to an actuator.

    Effects on inputs act in their order, then the motion profile of a servo, its D term, and a lag.
    The command is constant between time stamps; before the first stamp it has its first value.

    Args:
        times: time stamps, s, (T,).
        command: command, (T,).
        effects: coefficients by name.
    """

    def __init__(self, times, command, effects):
        values, begins, self.lag = apply_input_effects(command, times, effects)
        if "servo.profile" in effects:
            values, begins = profiled(values, begins, effects["servo.profile"][0])
        if "servo.derivative" in effects:
            # The D term takes the rate over a period of the controller, so a jump acts that long.
            (lead,) = effects["servo.derivative"]
            both = np.unique(np.concatenate([begins, begins + CONTROL_PERIOD]))
            now, before = (_held(begins, values, both - late) for late in (0.0, CONTROL_PERIOD))
            values, begins = now + lead / CONTROL_PERIOD * (now - before), both
        self.values, self.begins = values, begins

    def at(self, t):
        """Return the signal at time t before the lag (zero-order hold)."""
        return _held(self.begins, self.values, t)


def _held(begins, values, t):
    """Return zero-order-hold values at given times; before the first stamp, the first value."""
    return values[np.maximum(np.searchsorted(begins, t + 1e-9, side="right") - 1, 0)]


def profiled(values, times, limit):
    """Return time-optimal moves to each value with acceleration limit `limit`.

    Moves arrive at rest. Each result is held for 1 ms and is the value at the middle of this time.
    """
    fine = np.arange(times[0], times[-1] + 1.0, 1e-3)
    place, speed, went = values[0], 0.0, []
    ends = [*times[1:].tolist(), times[-1] + 1.0]
    for value, begin, end in zip(values.tolist(), times.tolist(), ends, strict=True):
        middles = fine[(fine >= begin - 1e-9) & (fine < end - 1e-9)] + 5e-4
        t = np.append(middles, end) - begin
        x, v = _shortest(place - value, speed, limit, t)
        went.extend((value + x[:-1]).tolist())
        place, speed = value + x[-1], v[-1]
    return np.array(went), fine[: len(went)]


def _shortest(x, v, limit, t):
    """Return position and speed of a double integrator on its time-optimal way to rest at zero.

    Args:
        x, v: initial position and speed.
        limit: largest acceleration.
        t: times.
    """
    way = -np.sign(x + v * abs(v) / (2 * limit)) or -np.sign(v) or 1.0
    x, v = way * x, way * v
    peak = np.sqrt(max(v**2 / 2 - limit * x, 0.0))
    first, last = (peak - v) / limit, (2 * peak - v) / limit
    left = np.maximum(last - t, 0.0)
    gaining = t < first
    where = np.where(gaining, x + v * t + limit * t**2 / 2, -limit * left**2 / 2)
    return way * where, way * np.where(gaining, v + limit * t, limit * left)


def compute_applied_signals(machine, times, commands, effects):
    """Return the applied signal of every actuator of a machine, by name."""
    return {
        drive.name: AppliedSignal(
            times, commands[drive.name], select_signal_effects(effects, INPUTS, drive.name)
        )
        for drive in machine.drives
    }


@dataclass
class Drives:
    """Forces of all actuators by joint, (N,).

    The force is clip(gain u - kp q - kv v, within +-limit). A servo does not react to an error u -
    q smaller than `dead`. A supply of its own reduces a force U to U / (1 + sag |U|); a shared
    battery reduces it to U_i / (1 + battery (|U_1| + |U_2| + ...)). With coupling, the shaft of a
    drive turns with q_i + sum of `shafts`_ij q_j and exerts its force on those joints by the same
    factors.
    """

    gain: np.ndarray
    kp: np.ndarray
    kv: np.ndarray
    limit: np.ndarray
    dead: np.ndarray
    sag: np.ndarray
    lost: np.ndarray
    battery: float = 0.0
    shafts: np.ndarray | None = None

    @classmethod
    def of(cls, machine, effects=None):
        """Build the drives of a machine, with the hidden effects of its actuators."""
        count, effects = len(machine.joints), effects or {}
        gain, kp, kv, limit, dead, sag, lost = np.zeros((7, count))
        for joint, drive in zip(machine.driven, machine.drives, strict=True):
            change = {
                name.partition("@")[0]: c[0]
                for name, c in effects.items()
                if name.partition("@")[2] == drive.name
            }
            limit[joint] = drive.force
            sag[joint] = change.get("supply.sag", 0.0)
            lost[joint] = change.get("supply.braking", 0.0)
            if drive.kind == "motor":
                gain[joint] = 1.0
                continue
            kp[joint] = drive.kp * (1 + change.get("actuator.stiffness", 0.0))
            kv[joint] = drive.kv * (1 + change.get("actuator.damping", 0.0))
            gain[joint] = kp[joint]
            dead[joint] = change.get("servo.deadband", 0.0)
        (battery,) = effects.get("supply.sag", (0.0,))
        return cls(gain, kp, kv, limit, dead, sag, lost, battery, _shafts(machine, effects))

    # These properties are read in every stage of every step, therefore they are cached.
    @cached_property
    def dull(self):
        return bool(self.dead.any())

    @cached_property
    def sags(self):
        return bool(self.sag.any() or self.battery)

    @cached_property
    def loses(self):
        return bool(self.lost.any())

    def forces(self, u, q, v):
        """Return the forces for commands u by joint."""
        if self.shafts is not None:
            q, v = q + q @ self.shafts.T, v + v @ self.shafts.T
        wanted = self.gain * u - self.kp * q - self.kv * v
        if self.dull:
            wanted -= self.kp * np.clip(u - q, -self.dead, self.dead)
        # np.clip takes three times as long.
        force = np.minimum(np.maximum(wanted, -self.limit), self.limit)
        if self.sags:
            drawn = np.abs(force)
            force = force / (1 + self.sag * drawn + self.battery * drawn.sum(-1, keepdims=True))
        if self.loses:
            force = force * (1 - self.lost * (force * v < 0))
        return force if self.shafts is None else force + force @ self.shafts


def _shafts(machine, effects):
    """Return the coupling (N, N) of each drive (row) to other joints; None without coupling."""
    pairs = {n.partition("@")[2]: c for n, (c, *_) in effects.items() if n.startswith(COUPLING)}
    if not pairs:
        return None
    above = machine.model()
    shafts = np.zeros((above.nv, above.nv))
    for joint, c in pairs.items():
        row = machine.joints.index(joint)
        shafts[row, above.parents[row + 1] - 1] = c
    return shafts


NOISES = ("white", "ar1", "quantised")


def observed(world, run, channels, slips=()):
    """Return noise-free sensor readings of a run, (T, C).

    Args:
        world: `reference_world.World`.
        run: `reference_world.Run`.
        channels: names such as q.elbow.
        slips: (joint, time, jump) of a slipping encoder, an unmodelled cause.
    """
    skew = world.effects.get("clock.skew", (0.0,))[0]
    effects = {name: select_signal_effects(world.effects, "sensor.", name) for name in channels}
    instants = {}
    for name in channels:
        late = effects[name].get("sensor.delay", (0.0,))[0]
        instants[name] = np.maximum(run.times * (1 + skew) - late, 0.0)
    grid = np.unique(np.concatenate(list(instants.values())))
    motion = world.move(run, grid)
    columns = []
    for name in channels:
        kind, _, joint = name.partition(".")
        source = {"q": motion.q, "qd": motion.v, "tau": motion.force}[kind]
        index = world.machine.joints.index(joint)
        column = source[np.searchsorted(grid, instants[name]), index]
        for slipping, instant, jump in slips if kind == "q" else ():
            if slipping == index:
                column = column + jump * (run.times >= instant)
        for effect, c in effects[name].items():
            if effect in SENSOR_EFFECTS:
                column = SENSOR_EFFECTS[effect](column, c, run.times, run.times)
        columns.append(column)
    return np.column_stack(columns)
