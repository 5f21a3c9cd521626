"""Scenarios of batch elements, grouped by content, so that shared work is done once per group."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Indices, Scenario

Number = TypeVar("Number", np.float64, np.intp)


@dataclass(frozen=True)
class ScenarioGroups:
    """Scenarios of batch elements, grouped if they are equal.

    Attributes:
        unique_scenarios: Scenarios that differ in their times or inputs.
        scenario_index: (L,) number of the distinct scenario of each batch element.
        contents: Hashable content of each distinct scenario; empty if unknown.
    """

    unique_scenarios: tuple[Scenario, ...]
    scenario_index: Indices
    contents: tuple[object, ...] = ()

    @property
    def one_each(self) -> ScenarioGroups:
        """Groups of the distinct scenarios with one batch element each."""
        count = len(self.unique_scenarios)
        return ScenarioGroups(self.unique_scenarios, np.arange(count), self.contents)

    def expand_rows(self, rows: NDArray[Number]) -> NDArray[Number]:
        """Expand rows (N, ...) of the distinct scenarios to rows (L, ...) of the batch elements.

        Equal rows that share memory are broadcast.

        Shapes: N distinct scenarios, L batch elements.
        """
        # Rows that are the same memory have a stride of zero.
        if len(rows) == 1 or rows.strides[0] == 0:
            rows = rows[:1]
            return np.broadcast_to(rows, (self.scenario_index.size, *rows.shape[1:]))
        return rows[self.scenario_index]


def group_scenarios(scenarios: Sequence[Scenario], by_initial: bool = False) -> ScenarioGroups:
    """Group scenarios with the same times and inputs.

    Inputs and time steps are computed once for each group, not for each batch element. The inputs
    include their interpolation, offset and history before the run, and when actuators are off.

    Args:
        scenarios: Scenario of each batch element.
        by_initial: Whether grouped scenarios must also state the same initial states.

    Returns:
        The first scenario of each group, and the number of the group of each batch element.
    """
    # Compare objects first, because comparing the contents of each scenario is slow.
    objects, object_index = group_by_identity(scenarios)
    group_by_content: dict[object, int] = {}
    distinct: list[Scenario] = []
    group_by_object = []
    for scenario in objects:
        signals = sorted(scenario.inputs.items())
        input_histories = tuple((name, u.tobytes()) for name, u in sorted(scenario.before.items()))
        interpretation = tuple(sorted(scenario.linear)), scenario.offset, input_histories
        initial_states = tuple(sorted(scenario.initial.items())) if by_initial else ()
        signals_content = ((name, u.tobytes()) for name, u in signals)
        off_masks = tuple((name, mask.tobytes()) for name, mask in sorted(scenario.off.items()))
        content = (
            scenario.times.tobytes(),
            interpretation,
            initial_states,
            off_masks,
            *signals_content,
        )
        group = group_by_content.setdefault(content, len(distinct))
        if group == len(distinct):
            distinct.append(scenario)
        group_by_object.append(group)
    index = np.array(group_by_object, dtype=np.intp)[object_index]
    return ScenarioGroups(tuple(distinct), index, tuple(group_by_content))


def group_by_identity(scenarios: Sequence[Scenario]) -> tuple[list[Scenario], Indices]:
    """Return the distinct objects among scenarios, and the number of each element's object (L,)."""
    # One dictionary lookup per batch element, of which there may be thousands.
    objects = {id(scenario): scenario for scenario in scenarios}
    index = {key: i for i, key in enumerate(objects)}
    object_index = np.array([index[id(scenario)] for scenario in scenarios], dtype=np.intp)
    return list(objects.values()), object_index
