"""What learned tuners read: from observations, and what is known of their scenarios, to a network's
input rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from methods.base import Array, Scene
from methods.learning.circumstances import Circumstances
from methods.learning.pair_inputs import Inputs, raw_inputs, weighed_inputs
from methods.learning.rehearsal import Rehearsal

_SEEN = ("chosen", "centre", "gain")
"""Arrays of `Inputs` that are stored."""
_TOLD = ("centre", "spread", "initial")
"""Arrays of `Circumstances` that are stored."""
_NONE = np.empty(0)
"""Stands for an array that is not there."""


@dataclass(frozen=True)
class Reading:
    """What networks read of an observation, and the noise that they prepare for.

    Attributes:
        points: points to which each run is resampled; L in Algorithm 1.
        inputs: inputs kept of those an observation offers.
        strictness: see `methods.learning.pair_inputs.weighed_inputs`.
        noise: sensor noise that a second network is trained with, 1 sigma, in units of each
            channel's standard deviation in training; 0 for no second network.
        raw: the resampled series in SI units as they are, as published; the other settings say
            nothing then.
        told: read what is known of a scenario too, where scenarios differ in it
            (`methods.learning.circumstances`).
        channels: the first and the last of the channels that are read, by number; None for all.
        clean: whether targets may be as clean as simulations; else one network is trained, with the
            noise.
        proposed: what the network's proposed side reads, where that is something else.
    """

    points: int = 400
    inputs: int = 400
    strictness: float = 1000.0
    noise: float = 0.01
    raw: bool = False
    told: bool = True
    channels: tuple[int, int] | None = None
    clean: bool = True
    proposed: Reading | None = None

    def part(self, observations: Array) -> Array:
        """The channels (..., c) that are read of observations (..., C); the last one if there are
        too few.
        """
        if self.channels is None:
            return observations
        most = observations.shape[-1] - 1
        first, last = (min(channel, most) for channel in self.channels)
        return observations[..., first : last + 1]


@dataclass(frozen=True)
class Reader:
    """A map to input rows, chosen and scaled by the training simulations.

    Attributes:
        reading: how it was chosen.
        seen: observations to input rows.
        told: what is known of scenarios to further inputs; None where they were alike in training.
    """

    reading: Reading
    seen: Inputs
    told: Circumstances | None = None

    @classmethod
    def learned(cls, data: Rehearsal, reading: Reading) -> Reader:
        """Choose what to read."""
        data = data._replace(observations=reading.part(data.observations))
        if reading.raw:
            return cls(reading, raw_inputs(data.flat, data.lengths, reading.points))
        told = None
        if reading.told:
            told = Circumstances.learned(data.scenes, data.observations, data.lengths)
        # where inputs vary, samples mean something else in each scenario: responses alone are read
        driven = told is not None and told.driven
        most = 0 if driven else reading.inputs
        seen = weighed_inputs(data, reading.points, most, reading.strictness)
        return cls(reading, seen, told)

    @property
    def size(self) -> int:
        """Numbers in a row."""
        told = 0 if self.told is None else self.told.centre.size
        return self.seen.chosen.size + told

    def __call__(
        self,
        observations: Array,
        lengths: tuple[int, ...],
        scene: Scene,
        missing: Array | None = None,
    ) -> Array:
        """Input rows (n, D) of observations (n, T, C) made in one scene.

        Args:
            observations: SI units; NaN where a sample is missing.
            lengths: samples of each run.
            scene: what is known of the scenario.
            missing: (T, C) samples to be treated as missing as well: those of the target, so that a
                simulation of the true parameters gives the target's own row.

        Raises:
            ValueError: the observation or the scene is of another kind than in training.
        """
        if missing is not None and missing.any():
            observations = np.where(missing, np.nan, observations)
        observations = self.reading.part(observations)
        rows = self.seen(observations, lengths)
        if self.told is None:
            return rows
        further = self.told(observations, lengths, scene)
        return np.concatenate([rows, further], axis=1)

    def table(self, data: Rehearsal) -> Array:
        """Input rows (scenarios, each, D) of training simulations."""
        if self.told is None:
            # all scenarios in one call: nothing depends on which a simulation was made in
            rows = self.seen(self.reading.part(data.flat), data.lengths)
            return rows.reshape(*data.parameters.shape[:2], -1)
        each = zip(data.observations, data.scenes, strict=True)
        return np.array([self(observations, data.lengths, scene) for observations, scene in each])

    def state(self) -> dict[str, Array]:
        """Everything as plain arrays."""
        state: dict[str, Array] = {}
        for name in _SEEN:
            state[f"inputs.{name}"] = np.asarray(getattr(self.seen, name))
        if self.told is not None:
            for name in _TOLD:
                state[f"told.{name}"] = np.asarray(getattr(self.told, name), dtype=np.float64)
        return state

    @classmethod
    def restored(cls, state: dict[str, Array], reading: Reading) -> tuple[Reader, dict[str, Array]]:
        """The inverse of `state`, and the arrays of other names.

        Raises:
            ValueError: arrays that are missing or of other shapes, or numbers that are not finite.
        """
        rest = {name: np.array(array, dtype=np.float64) for name, array in state.items()}
        names = [f"inputs.{name}" for name in _SEEN]
        if any(name.startswith("told.") for name in rest):
            names += [f"told.{name}" for name in _TOLD]
        # one array of each part says how long the others must be
        sizes = {part: rest.get(f"{part}.centre", _NONE).shape for part in ("inputs", "told")}
        for name in names:
            shape = () if name == "told.initial" else sizes[name.partition(".")[0]]
            if name not in rest:
                raise ValueError(f"expected array {name}, found {sorted(state)[:4]}")
            array = rest[name]
            if array.shape != shape or len(shape) > 1 or not np.isfinite(array).all():
                raise ValueError(
                    f"array {name}: expected finite numbers of shape {shape}, found {array.shape}"
                )
        if not sizes["inputs"][0] + sum(sizes["told"]):
            raise ValueError("expected a network that reads something, found one without inputs")
        chosen, centre, gain, *own = (rest.pop(name) for name in names)
        seen = Inputs(reading.points, reading.raw, chosen, centre, gain)
        told = Circumstances(own[0], own[1], int(own[2])) if own else None
        return cls(reading, seen, told), rest
