"""Lists of names and items in the text of notes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from sims.core.value_limits import truncate_text

MAX_LISTED_NAMES = 12
"""Maximum number of names that a note lists."""
MAX_LISTED_WITH_NUMBERS = 4
"""Maximum number of items that a note lists if each item contains numbers."""


def format_name_list(
    names: Iterable[str], max_names: int = MAX_LISTED_NAMES, separator: str = ", "
) -> str:
    """Format names as a list without duplicates.

    Args:
        names: names to list; each is shortened to 200 characters.
        max_names: maximum number of names to list.
        separator: text between two names.

    Returns:
        The first `max_names` names, followed by the number of the remaining ones ("and 3 more").
    """
    unique_names = list(dict.fromkeys(names))
    others_text = (
        f" and {len(unique_names) - max_names} more" if len(unique_names) > max_names else ""
    )
    return (
        separator.join(truncate_text(name, 200) for name in unique_names[:max_names]) + others_text
    )


def format_item_list(items: Sequence[str]) -> str:
    """Format at most `MAX_LISTED_WITH_NUMBERS` items with numbers, and count the further ones."""
    return format_name_list(items, MAX_LISTED_WITH_NUMBERS, "; ")
