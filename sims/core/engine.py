"""Interface of engines, which integrate batches of simulations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sims.core.effect import ActiveEffects
from sims.core.simulator import Array, Indices, InputError
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

    def select(self, i: Indices) -> IntegrationBatch:
        """Return the part of the batch with the elements i (n,).

        Engines use it to simulate some elements separately. All elements in their order give the
        batch itself, and steps that all elements share are not copied.
        """
        if i.size == len(self.x) and (i[1:] > i[:-1]).all():
            return self
        if self.steps.strides[0] == 0:  # steps shared by all elements stay shared
            steps = np.broadcast_to(self.steps[0], (i.size, self.steps.shape[1]))
        else:
            steps = self.steps[i]
        return replace(
            self,
            theta=self.theta[i],
            constants={name: values[i] for name, values in self.constants.items()},
            x=self.x[i],
            v=self.v[i],
            steps=steps,
            inputs={name: values[i] for name, values in self.inputs.items()},
            effects=tuple((effect, c[:, i]) for effect, c in self.effects),
        )


@dataclass(frozen=True)
class Trajectories:
    """Result of an engine: positions, velocities, accelerations (L, S // every + 1, D).

    The acceleration is that of the smooth motion without the shocks of impacts. Failed batch
    elements are NaN.
    """

    x: Array
    v: Array
    a: Array


def make_unsupported_error(engine: str, system: type[System], reason: str) -> InputError:
    """Make the error for a system that an engine cannot integrate.

    Args:
        engine: Name of the engine.
        system: The system.
        reason: Property of the system, as the end of the message.
    """
    return InputError(f"engine {engine} cannot simulate system {system.name}: {reason}")


class Engine(Protocol):
    """Integrator of batches of simulations."""

    name: str
    largest_step: float
    """Maximum step in seconds, to which sampling intervals are divided."""

    def integrate(self, batch: IntegrationBatch) -> Trajectories:
        """Integrate every batch element over its steps."""
        ...

    def close(self) -> None:
        """Release the engine's worlds."""
        ...
