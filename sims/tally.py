"""How many simulations this process has made, and how many it may make.

Every simulator of a declared system counts its lanes here, whoever asks for them. A comparison of
diagnosers sets the limit; without one nothing is refused.
"""

from __future__ import annotations

from dataclasses import dataclass


class SpentError(RuntimeError):
    """More simulations were asked for than are allowed."""


@dataclass
class Tally:
    """Simulations of this process.

    Attributes:
        used: lanes simulated so far.
        most: that may be; None for no limit.
    """

    used: int = 0
    most: int | None = None

    def count(self, lanes: int) -> None:
        """Count lanes that are about to be simulated.

        Raises:
            SpentError: they are more than what is left; none of them is counted.
        """
        if self.most is not None and self.used + lanes > self.most:
            raise SpentError(f"{self.used + lanes} simulations asked for, {self.most} are allowed")
        self.used += lanes

    def begin(self, most: int | None = None) -> None:
        """Count anew from zero."""
        self.used, self.most = 0, most


TALLY = Tally()
"""Of this process."""
