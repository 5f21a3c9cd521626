"""Commands as the actuators feel them, and the forces that they make of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass
class Felt:
    """A command on its way to an actuator.

    It passes gain, bias, dead band, saturation, delay and lag, in this order; it is constant from
    one stamp to the next, and before the first it has the first value.
    """

    times: np.ndarray
    command: np.ndarray
    gain: float = 0.0
    bias: float = 0.0
    deadband: float = 0.0
    saturation: float = 0.0
    delay: float = 0.0
    lag: float = 0.0
    values: np.ndarray = field(init=False)
    begins: np.ndarray = field(init=False)

    def __post_init__(self):
        values = self.command * (1 + self.gain) + self.bias
        values = np.sign(values) * np.maximum(np.abs(values) - self.deadband, 0.0)
        if self.saturation:
            values = np.clip(values, -self.saturation, self.saturation)
        self.values, self.begins = values, self.times + self.delay

    def at(self, t):
        """What arrives at t, before the lag; a value holds from its stamp on."""
        place = np.searchsorted(self.begins, t + 1e-9, side="right") - 1
        return self.values[max(place, 0)]


def felt(machine, times, commands, effects):
    """The signal of every actuator of a machine, by its name."""
    signals = {}
    for drive in machine.drives:
        numbers = {}
        for name, c in effects.items():
            effect, _, place = name.partition("@")
            if effect.startswith("input.") and place == drive.name:
                numbers[effect.removeprefix("input.")] = c[0]
        signals[drive.name] = Felt(times, commands[drive.name], **numbers)
    return signals


@dataclass
class Drives:
    """Forces of all actuators: clip(gain u - kp q - kv v, within +-limit) by joint, (N,)."""

    gain: np.ndarray
    kp: np.ndarray
    kv: np.ndarray
    limit: np.ndarray

    @classmethod
    def of(cls, machine, effects=None):
        """Of a machine, with what is hidden in its servos."""
        count = len(machine.joints)
        gain, kp, kv, limit = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count)
        for joint, drive in zip(machine.driven, machine.drives, strict=True):
            change = {
                name.partition("@")[0]: c[0]
                for name, c in (effects or {}).items()
                if name.partition("@")[2] == drive.name
            }
            limit[joint] = drive.force
            if drive.kind == "motor":
                gain[joint] = 1.0
                continue
            kp[joint] = drive.kp * (1 + change.get("actuator.stiffness", 0.0))
            kv[joint] = drive.kv * (1 + change.get("actuator.damping", 0.0))
            gain[joint] = kp[joint]
        return cls(gain, kp, kv, limit)

    def forces(self, u, q, v):
        """For commands u by joint."""
        wanted = self.gain * u - self.kp * q - self.kv * v
        return np.minimum(np.maximum(wanted, -self.limit), self.limit)  # np.clip takes three times
