"""Effects on commands, and the actuator forces that result."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

SIGNALS = (
    "input.gain", "input.bias", "input.deadband", "input.saturation", "input.delay", "input.lag",
    "input.rate", "servo.derivative", "servo.profile", "input.power",
)  # fmt: skip
COUPLING = "joint.coupling@"


@dataclass
class AppliedSignal:
    """A command on its way to an actuator.

    The order of the effects is: gain, power, bias, dead band, saturation, rate limit, delay, motion
    profile of a servo, its D term, lag. The command is constant between time stamps; before the
    first stamp it has its first value.
    """

    times: np.ndarray
    command: np.ndarray
    gain: float = 0.0
    bias: float = 0.0
    deadband: float = 0.0
    saturation: float = 0.0
    delay: float = 0.0
    lag: float = 0.0
    rate: float = 0.0
    derivative: float = 0.0
    profile: float = 0.0
    power: tuple = (0.0, 0.0)
    values: np.ndarray = field(init=False)
    begins: np.ndarray = field(init=False)

    def __post_init__(self):
        values = self.command * (1 + self.gain)
        scale, more = self.power
        values = (1 + scale) * np.sign(values) * np.abs(values) ** (1 + more) + self.bias
        values = np.sign(values) * np.maximum(np.abs(values) - self.deadband, 0.0)
        if self.saturation:
            values = np.clip(values, -self.saturation, self.saturation)
        begins = self.times
        if self.rate:
            values, begins = _slewed(values, begins, self.rate)
        begins = begins + self.delay
        if self.profile:
            values, begins = profiled(values, begins, self.profile)
        if self.derivative:
            # The D term takes a rate over `derivative` seconds, so a jump acts for that time.
            both = np.unique(np.concatenate([begins, begins + self.derivative]))
            now, before = (_held(begins, values, both - late) for late in (0.0, self.derivative))
            values, begins = 2 * now - before, both
        self.values, self.begins = values, begins

    def at(self, t):
        """Return the signal at time t before the lag (zero-order hold)."""
        place = np.searchsorted(self.begins, t + 1e-9, side="right") - 1
        return self.values[max(place, 0)]


def _held(begins, values, t):
    """Return zero-order-hold values at given times; before the first stamp, the first value."""
    return values[np.maximum(np.searchsorted(begins, t + 1e-9, side="right") - 1, 0)]


def _slewed(values, times, limit):
    """Limit the rate of a signal to `limit` per second; results are held for 1 ms each."""
    fine = np.arange(times[0], times[-1] + 1e-3, 1e-3)
    wanted, state, risen = _held(times, values, fine), values[0], []
    for level in wanted.tolist():
        moved = min(max(level - state, -limit * 1e-3), limit * 1e-3)
        risen.append(state + moved - 0.5 * abs(moved) / (limit * 1e-3) * moved)
        state += moved
    return np.array(risen), fine


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
    signals = {}
    for drive in machine.drives:
        numbers = {}
        for name, c in effects.items():
            effect, _, place = name.partition("@")
            if effect in SIGNALS and place == drive.name:
                numbers[effect.partition(".")[2]] = c[0] if len(c) == 1 else c
        signals[drive.name] = AppliedSignal(times, commands[drive.name], **numbers)
    return signals


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
