"""Messages of MuJoCo, and text of the notes on a model file."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from sims.core.user_messages import truncate_text


@contextmanager
def capture_mujoco_warnings() -> Iterator[list[str]]:
    """Collect the warnings that MuJoCo issues within the block, each as one line.

    Without a handler MuJoCo prints warnings and appends them to ``MUJOCO_LOG.TXT`` in the current
    working directory.

    Yields:
        The list to which warnings are appended.
    """
    import mujoco

    messages: list[str] = []
    previous_handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: messages.append(format_mujoco_error(text)))
    try:
        with warnings.catch_warnings():
            # MuJoCo's compiler issues its warnings through Python's `warnings` module.
            warnings.simplefilter("always")
            warnings.showwarning = lambda message, *_: messages.append(format_mujoco_error(message))
            yield messages
    finally:
        mujoco.set_mju_user_warning(previous_handler)


def format_mujoco_error(message: object) -> str:
    """Format a message of MuJoCo as one line: ``message; Element 'joint', line 6``."""
    lines = [line.strip().rstrip(".") for line in str(message).splitlines()]
    line_text = "; ".join(line for line in lines if line)
    return re.sub(r"^((XML )?(Error|Warning): )+", "", line_text)


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
