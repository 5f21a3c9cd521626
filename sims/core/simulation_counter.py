"""Counter and limit of the simulations in this process.

Every simulator of a declared system counts its simulations here. A comparison of diagnosers sets
the limit; by default there is none.
"""

from __future__ import annotations

from dataclasses import dataclass


class SimulationBudgetExceededError(RuntimeError):
    """More simulations were requested than are allowed."""


@dataclass
class SimulationCounter:
    """Counter of simulations.

    Attributes:
        used: Number of simulations so far.
        limit: Maximum number of simulations; None for no limit.
    """

    used: int = 0
    limit: int | None = None

    def count(self, count: int) -> None:
        """Count simulations before they are made.

        Args:
            count: Number of batch elements, each of which is one simulation.

        Raises:
            SimulationBudgetExceededError: They exceed the limit; none of them is counted.
        """
        if self.limit is not None and self.used + count > self.limit:
            raise SimulationBudgetExceededError(
                f"{self.used + count} simulations requested, {self.limit} are allowed"
            )
        self.used += count

    def reset(self, limit: int | None = None) -> None:
        """Reset the counter to zero, and set the limit."""
        self.used, self.limit = 0, limit


SIMULATION_COUNTER = SimulationCounter()
"""Counter of this process."""
