"""Lists of names and items in the text of notes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from sims.limits import cut

MOST = 12
"""Maximum number of names that a note lists."""
FEW = 4
"""Maximum number of items that a note lists if each item contains numbers."""


def listed(names: Iterable[str], most: int = MOST, between: str = ", ") -> str:
    """Format names as a list without duplicates.

    Args:
        names: names to list; each is shortened to 200 characters.
        most: maximum number of names to list.
        between: separator.

    Returns:
        The first `most` names, followed by the number of the remaining ones ("and 3 more").
    """
    each = list(dict.fromkeys(names))
    more = f" and {len(each) - most} more" if len(each) > most else ""
    return between.join(cut(name, 200) for name in each[:most]) + more


def told(things: Sequence[str]) -> str:
    """Format at most `FEW` items that contain numbers, with the number of further ones."""
    return listed(things, FEW, "; ")
