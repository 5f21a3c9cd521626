"""Notes, in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from sims.limits import cut

MOST = 12
"""Names that a note lists."""
FEW = 4
"""Things that a note lists when each has numbers."""


def listed(names: Iterable[str], most: int = MOST, between: str = ", ") -> str:
    """Names, each once, with how many more there are."""
    each = list(dict.fromkeys(names))
    more = f" and {len(each) - most} more" if len(each) > most else ""
    return between.join(cut(name, 200) for name in each[:most]) + more


def told(things: Sequence[str]) -> str:
    """Things with numbers, with how many more there are."""
    return listed(things, FEW, "; ")
