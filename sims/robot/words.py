"""Names as notes list them."""

from __future__ import annotations

from collections.abc import Sequence

from sims.limits import cut

MOST = 12
"""Names that a note lists."""


def listed(names: Sequence[str]) -> str:
    """Names, with how many more there are."""
    more = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return ", ".join(cut(name) for name in names[:MOST]) + more
