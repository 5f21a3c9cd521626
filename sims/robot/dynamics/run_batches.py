"""Batches of robot runs: initial states, inputs and results of their batch elements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import ActiveEffects
from sims.core.simulator import Array, Scenario
from sims.engines.scenario_groups import ScenarioGroups
from sims.robot.dynamics.active_effects import find_active_elements, is_evaluated_per_step
from sims.robot.dynamics.added_elements import group_by_added_elements
from sims.robot.dynamics.midpoint_state import IndexArray, Mask
from sims.robot.floating_joints import FloatingState
from sims.robot.model_field_effects import changes_derived_constants

Number = TypeVar("Number", bound=np.generic)


class RobotRunBatch(NamedTuple):
    """Batch elements of one run.

    Attributes:
        scenario: scenario of the run.
        commands: inputs (T,) by name.
        acting: effects at one place each, with coefficients (K, n, 1).
        x: (n, D) initial positions.
        v: (n, D) initial velocities.
    """

    scenario: Scenario
    commands: Mapping[str, Array]
    acting: ActiveEffects
    x: Array
    v: Array

    @property
    def times(self) -> Array:
        """Sample times (T,) in seconds since the start."""
        result: Array = self.scenario.times - self.scenario.times[0]
        return result


class BatchStart(NamedTuple):
    """Initial states of n batch elements, and the effects active on them.

    Attributes:
        x: (n, D) initial positions.
        v: (n, D) initial velocities.
        acting: effects with their coefficients (K, n, 1).
        floating_state: initial poses and velocities of floating bodies.
    """

    x: Array
    v: Array
    acting: ActiveEffects
    floating_state: FloatingState


class BatchInputs(NamedTuple):
    """Precomputed inputs of n batch elements over S steps.

    Attributes:
        controls: (n, S, nu) mean controls over each step.
        forces: (n, S, nv) generalised forces.
        applied_inputs: applied inputs (n, S) by name; after an activation filter, the activation.
        instant: (n, S, nu) controls at the beginning of each step.
        activations: (n, na) initial activations of the actuators.
        off: (n, S, K) whether each actuator is switched off.
    """

    controls: Array
    forces: Array
    applied_inputs: Mapping[str, Array]
    instant: Array
    activations: Array
    off: Mask

    @classmethod
    def concatenate(cls, parts: Sequence[BatchInputs]) -> BatchInputs:
        """Join the inputs of several runs, so that one batch simulates all of them.

        The batch elements of the runs follow one another. All runs then have as many steps as the
        longest; shorter ones repeat their last inputs, and the additional steps are ignored
        afterwards.

        Args:
            parts: inputs of each run, with arrays (n, S, ...) of its own n elements and S steps.
        """
        if len(parts) == 1:
            return parts[0]
        steps = max(part.controls.shape[1] for part in parts)
        names = parts[0].applied_inputs
        return cls(
            np.concatenate([_extend_to_steps(part.controls, steps) for part in parts]),
            np.concatenate([_extend_to_steps(part.forces, steps) for part in parts]),
            {
                n: np.concatenate(
                    [_extend_to_steps(part.applied_inputs[n], steps) for part in parts]
                )
                for n in names
            },
            np.concatenate([_extend_to_steps(part.instant, steps) for part in parts]),
            np.concatenate([part.activations for part in parts]),
            np.concatenate([_extend_to_steps(part.off, steps) for part in parts]),
        )


def _extend_to_steps(values: NDArray[Number], steps: int) -> NDArray[Number]:
    """Extend values (n, S', ...) to S steps by repeating the last one."""
    missing = steps - values.shape[1]
    if not missing:
        return values
    return np.concatenate([values, np.repeat(values[:, -1:], missing, axis=1)], axis=1)


def group_by_run(runs: ScenarioGroups, batch_indices: IndexArray) -> list[tuple[int, IndexArray]]:
    """Group batch elements by their runs.

    Args:
        runs: runs (scenarios), and the number of the run of each batch element.
        batch_indices: indices of the batch elements; those of one run follow one another.

    Returns:
        For each group, the number of the run and the indices of its batch elements.
    """
    if not batch_indices.size:
        return []
    run_numbers = runs.scenario_index[batch_indices]
    # Positions at which another run begins.
    run_begins = np.flatnonzero(np.diff(run_numbers)) + 1
    groups = np.split(batch_indices, run_begins)
    return [(int(runs.scenario_index[group[0]]), group) for group in groups]


class BatchResult(NamedTuple):
    """Simulation results of n batch elements.

    Attributes:
        x: (n, S + 1, D) positions at the beginning and after every step.
        v: (n, S + 1, D) velocities at the beginning and after every step.
        fields: recorded fields of MuJoCo's data in each step, (n, S, ...) by name.
        initial_activations: (n, na) initial activations.
        failed: (n,) whether the simulation failed.
        series: positions and velocities (n, S + 1, H) of joints in series with others.
    """

    x: Array
    v: Array
    fields: Mapping[str, Array]
    initial_activations: Array
    failed: Mask
    series: tuple[Array, Array]

    def select(self, batch_indices: slice) -> BatchResult:
        """Return the results of some batch elements.

        Args:
            batch_indices: consecutive batch elements, such as those of one run.
        """
        series_x, series_v = self.series
        return BatchResult(
            x=self.x[batch_indices],
            v=self.v[batch_indices],
            fields={name: values[batch_indices] for name, values in self.fields.items()},
            initial_activations=self.initial_activations[batch_indices],
            failed=self.failed[batch_indices],
            series=(series_x[batch_indices], series_v[batch_indices]),
        )


def split_into_batches(
    acting: ActiveEffects, runs: ScenarioGroups, max_size: int
) -> Iterator[IndexArray]:
    """Yield the indices of the elements of each batch, which are simulated together.

    Only elements whose effects need the same model and the same kind of simulation are in one batch
    (`group_batch_elements`). Elements are sorted by run, so that data common to a run are computed
    once for each batch. The batches of a group are of nearly equal size.

    Args:
        acting: active effects with K coefficients each, (K, L, 1).
        runs: runs (scenarios), and the number of the run of each of the L elements.
        max_size: maximum number of elements of a batch.
    """
    for indices in group_batch_elements(acting, runs.scenario_index.size):
        order = np.argsort(runs.scenario_index[indices], kind="stable")
        batch_count = -(-indices.size // max_size)  # rounded up
        yield from np.array_split(indices[order], batch_count)


def group_batch_elements(acting: ActiveEffects, count: int) -> Iterator[IndexArray]:
    """Yield the indices of batch elements that can be simulated together.

    Their effects add the same elements to the model; all or none of them change constants that
    MuJoCo derives; and the forces of all or none are evaluated in every step.

    Args:
        acting: active effects with K coefficients each, (K, L, 1).
        count: number L of batch elements.
    """
    # For each of the L elements, whether it has such an effect.
    has_step_forces = find_active_elements(acting, count, is_evaluated_per_step)
    has_changed_constants = find_active_elements(acting, count, changes_derived_constants)
    # Groups with the same added elements are divided by these two properties.
    for indices in map(np.array, group_by_added_elements(acting, count).values()):
        for step_forces, changed_constants in product((False, True), repeat=2):
            is_in_group = (has_step_forces[indices] == step_forces) & (
                has_changed_constants[indices] == changed_constants
            )
            if is_in_group.any():
                yield indices[is_in_group]
