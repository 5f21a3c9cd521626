"""Interface of engines, which integrate batches of simulations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from sims.core.effect import ActiveEffects
from sims.core.simulator import Array
from sims.core.system import System


@dataclass(frozen=True)
class IntegrationBatch:
    """Batch of simulations to be integrated by an engine.

    Attributes:
        system: System to integrate.
        theta: (L, p) parameters of the system.
        constants: Constants (L, 1) by name.
        x: (L, D) initial position.
        v: (L, D) initial velocity.
        steps: (L, S) lengths of the steps, s; zero where a batch element has finished.
        inputs: Applied inputs (L, S) by name, constant over each step.
        effects: Forces, frictions, contacts and effects with other hooks of the engine; inputs and
            sensors are processed outside the engine.
        steps_per_sample: Number of steps after which the state is stored, in addition to the
            initial state.
    """

    system: System
    theta: Array
    constants: Mapping[str, Array]
    x: Array
    v: Array
    steps: Array
    inputs: Mapping[str, Array]
    effects: ActiveEffects
    steps_per_sample: int = 1


@dataclass(frozen=True)
class Trajectories:
    """Result of an engine: positions, velocities, accelerations (L, S // every + 1, D).

    The acceleration is that of the smooth motion without the shocks of impacts. Failed batch
    elements are NaN.
    """

    x: Array
    v: Array
    a: Array


class Engine(Protocol):
    """Integrator of batches of simulations."""

    name: str
    requires: tuple[str, ...]
    largest_step: float
    """Maximum step in seconds, to which sampling intervals are divided."""

    def integrate(self, batch: IntegrationBatch) -> Trajectories:
        """Integrate every batch element over its steps."""
        ...

    def find_unsupported_reason(self, system: type[System]) -> str:
        """Return why this engine cannot integrate the system; empty if it can."""
        ...

    def close(self) -> None:
        """Release the engine's worlds."""
        ...
