"""Effects on commands, and the actuator forces that result."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.diagnosis_benchmark.case_generation.reference_signals import apply_input_effects
from bench.diagnosis_benchmark.machine_cases.reference_motion import select_signal_effects

COUPLING = "joint.coupling@"
INPUTS = ("input.", "servo.derivative", "servo.profile")


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
            # The D term takes a rate over `span` seconds, so a jump acts for that time.
            (span,) = effects["servo.derivative"]
            both = np.unique(np.concatenate([begins, begins + span]))
            now, before = (_held(begins, values, both - late) for late in (0.0, span))
            values, begins = 2 * now - before, both
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
