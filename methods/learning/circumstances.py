"""What networks are told of a scenario beside what its observation shows, where training scenarios
differ in it.

Initial values that no channel shows are inputs as they are. Input signals are not: appended to the
observation they were measured to be worth next to nothing, since what a sample means depends on all
inputs before it (docs/tunenet.md). The network reads how the observation responds to them
(`methods.learning.responses`), much the same whatever they were; and then that alone, since samples
whose meaning changes from scenario to scenario only mislead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from methods.base import Array, Scene
from methods.learning.responses import responses

_ROUNDING = 1e-9
"""Numbers that differ by less than this share of their size are alike."""
_NORMAL = 1.4826
"""Standard deviations of a normal distribution in one median distance from its median."""


@dataclass(frozen=True)
class Circumstances:
    """A map from scenes and observations to network inputs.

    Attributes:
        centre: (K,) medians in training: of the initial values, then of the responses' coefficients
            where inputs vary.
        spread: (K,) median distances from them; 0 where a number says nothing.
        initial: how many of the K are initial values.
    """

    centre: Array
    spread: Array
    initial: int

    @classmethod
    def learned(
        cls, scenes: Sequence[Scene], observations: Array, lengths: tuple[int, ...]
    ) -> Circumstances | None:
        """The map for training scenarios, or None where they are alike.

        Args:
            scenes: of each scenario.
            observations: (scenarios, each, T, C).
            lengths: samples of each run.
        """
        initial = np.array([scene.initial for scene in scenes])
        driven = _vary(np.array([scene.inputs for scene in scenes]))
        # where scenarios are alike nothing is to be told, and every input would be a constant
        if not driven and not _vary(initial):
            return None
        count = initial.shape[1]
        # stands for the map to be: one number beyond the initial values says that it is driven
        unscaled = cls(np.empty(count + driven), np.empty(0), count)
        table = np.concatenate(
            [
                unscaled.numbers(observation, lengths, scene)
                for observation, scene in zip(observations, scenes, strict=True)
            ]
        )
        # medians: a fitted coefficient is far off where a run hardly moves
        centre = np.median(table, axis=0)
        distances = np.abs(table - centre)
        return cls(centre, _NORMAL * np.median(distances, axis=0), count)

    @property
    def driven(self) -> bool:
        """Whether inputs vary, so that responses are read."""
        return self.initial < len(self.centre)

    def numbers(self, observations: Array, lengths: tuple[int, ...], scene: Scene) -> Array:
        """What is read (n, K) of observations (n, T, C) in one scene, SI units and samples."""
        shape = len(observations), len(scene.initial)
        initial = np.broadcast_to(scene.initial, shape)
        if not self.driven:
            return initial
        coefficients = responses(observations, scene.inputs, lengths)
        return np.concatenate([initial, coefficients], axis=1)

    def __call__(self, observations: Array, lengths: tuple[int, ...], scene: Scene) -> Array:
        """Network inputs (n, K) of observations (n, T, C); far from what training saw they grow as
        a logarithm.

        Raises:
            ValueError: a scene of another kind than the network was trained in.
        """
        numbers = self.numbers(observations, lengths, scene)
        if len(scene.initial) != self.initial or numbers.shape[1] != len(self.centre):
            raise ValueError(
                f"the network is told {len(self.centre)} numbers of a scenario, "
                f"this one gives {numbers.shape[1]}; "
                "train on scenarios with the same inputs and channels"
            )
        says = self.spread > 0
        # a number that never varied in training gets no weight, whatever it is now
        scale = np.where(says, 1.0 / np.where(says, self.spread, 1.0), 0.0)
        # arcsinh is the identity near zero and a logarithm far out: outliers do not saturate units
        return np.asarray(np.arcsinh((numbers - self.centre) * scale), dtype=np.float64)


def _vary(numbers: Array) -> bool:
    """Whether any number (scenarios, ...) differs between scenarios."""
    if not numbers.size:
        return False
    sizes = np.abs(numbers).max(axis=0)
    return bool(np.any(np.ptp(numbers, axis=0) > _ROUNDING * sizes))
