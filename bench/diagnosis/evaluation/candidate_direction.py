"""Direction in which an effect changes the simulated runs."""

from __future__ import annotations

from dataclasses import dataclass

from sims.core.simulator import Array


@dataclass(frozen=True)
class CandidateDirection:
    """One candidate direction.

    Attributes:
        effect: name of the effect.
        grid_point: number of the grid point; directions of one group act together.
        coefficient_index: index of the coefficient that scales it.
        coefficients: (k,) coefficients that are simulated.
        can_be_negative: whether the scaling coefficient may be negative.
        is_single_size: whether the direction is valid only at this size.
        is_only_proposed: whether the effect is proposed with this size for a fit alone, and not
            selected together with others.
    """

    effect: str
    grid_point: int
    coefficient_index: int
    coefficients: Array
    can_be_negative: bool
    is_single_size: bool = False
    is_only_proposed: bool = False
