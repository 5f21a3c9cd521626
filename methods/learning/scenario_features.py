"""Network inputs that describe a scenario, where training scenarios differ in them.

Initial values that no channel shows are inputs as they are. Input signals are not: appended to the
observation they were measured to be worth next to nothing, since what a sample means depends on all
inputs before it (docs/tunenet.md). The network reads how the observation responds to them
(`learning.input_response`), much the same whatever they were; and then that alone, since samples
whose meaning changes from scenario to scenario only mislead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from methods.learning.input_response import compute_response_coefficients
from methods.tuner import Array, ScenarioInfo

_EQUALITY_TOLERANCE = 1e-9
"""Relative difference below which numbers count as equal."""
_STD_PER_MAD = 1.4826
"""Standard deviations of a normal distribution per median absolute deviation."""


@dataclass(frozen=True)
class ScenarioFeatures:
    """Map from scenarios and observations to network inputs that describe the scenario.

    Attributes:
        centre: (K,) medians of the training data: first the initial values, then the response
            coefficients if inputs vary.
        spread: (K,) scaled median absolute deviations from them; 0 for a constant number.
        initial: number of initial values among the K numbers.
    """

    centre: Array
    spread: Array
    initial: int

    @classmethod
    def fit(
        cls, scenes: Sequence[ScenarioInfo], observations: Array, lengths: tuple[int, ...]
    ) -> ScenarioFeatures | None:
        """Compute the map from training scenarios.

        Args:
            scenes: scenario information of each scenario.
            observations: (scenarios, m, T, C) observations of m simulations per scenario.
            lengths: number of samples of each run.

        Returns:
            The map; None if all scenarios are equal.
        """
        initial = np.array([scene.initial for scene in scenes])
        driven = _differs_between_scenarios(np.array([scene.inputs for scene in scenes]))
        # Equal scenarios give constant inputs, which carry no information.
        if not driven and not _differs_between_scenarios(initial):
            return None
        count = initial.shape[1]
        # A preliminary map for the raw numbers: one number beyond the initial values marks varying
        # inputs.
        unscaled = cls(np.empty(count + driven), np.empty(0), count)
        table = np.concatenate(
            [
                unscaled.compute(observation, lengths, scene)
                for observation, scene in zip(observations, scenes, strict=True)
            ]
        )
        # Medians are used, because a fitted coefficient can be far off if a run hardly moves.
        centre = np.median(table, axis=0)
        distances = np.abs(table - centre)
        return cls(centre, _STD_PER_MAD * np.median(distances, axis=0), count)

    @property
    def has_varying_inputs(self) -> bool:
        """True if inputs vary between scenarios, so that response coefficients are computed."""
        return self.initial < len(self.centre)

    def compute(self, observations: Array, lengths: tuple[int, ...], scene: ScenarioInfo) -> Array:
        """Compute the unscaled numbers of observations in one scenario.

        Args:
            observations: (n, T, C) observations in SI units.
            lengths: number of samples of each run.
            scene: scenario information.

        Returns:
            (n, K) numbers.
        """
        shape = len(observations), len(scene.initial)
        initial = np.broadcast_to(scene.initial, shape)
        if not self.has_varying_inputs:
            return initial
        coefficients = compute_response_coefficients(observations, scene.inputs, lengths)
        return np.concatenate([initial, coefficients], axis=1)

    def __call__(self, observations: Array, lengths: tuple[int, ...], scene: ScenarioInfo) -> Array:
        """Compute network inputs, which grow logarithmically far from the training data.

        Args:
            observations: (n, T, C) observations in SI units.
            lengths: number of samples of each run.
            scene: scenario information.

        Returns:
            (n, K) network inputs.

        Raises:
            ValueError: the scenario has another number of values than those of the training.
        """
        numbers = self.compute(observations, lengths, scene)
        if len(scene.initial) != self.initial or numbers.shape[1] != len(self.centre):
            raise ValueError(
                f"the network expects {len(self.centre)} numbers of a scenario, "
                f"this one has {numbers.shape[1]}; "
                "train on scenarios with the same inputs and channels"
            )
        is_varying = self.spread > 0
        # A number that was constant in training gets no weight.
        scale = np.where(is_varying, 1.0 / np.where(is_varying, self.spread, 1.0), 0.0)
        # arcsinh is the identity near zero and logarithmic far out, so outliers do not saturate
        # units.
        return np.asarray(np.arcsinh((numbers - self.centre) * scale), dtype=np.float64)


def _differs_between_scenarios(numbers: Array) -> bool:
    """Return whether any number of an array (scenarios, ...) differs between scenarios."""
    if not numbers.size:
        return False
    sizes = np.abs(numbers).max(axis=0)
    return bool(np.any(np.ptp(numbers, axis=0) > _EQUALITY_TOLERANCE * sizes))
