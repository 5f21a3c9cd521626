"""Capture MuJoCo's warnings and errors, so that it neither prints them nor writes a log file."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


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
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: messages.append(format_mujoco_error(text)))
    try:
        with warnings.catch_warnings():
            # MuJoCo's compiler issues its warnings through Python's `warnings` module.
            warnings.simplefilter("always")
            warnings.showwarning = lambda message, *_: messages.append(format_mujoco_error(message))
            yield messages
    finally:
        mujoco.set_mju_user_warning(before)


def format_mujoco_error(message: object) -> str:
    """Format a message of MuJoCo as one line: ``message; Element 'joint', line 6``."""
    lines = [line.strip().rstrip(".") for line in str(message).splitlines()]
    line_text = "; ".join(line for line in lines if line)
    return re.sub(r"^((XML )?(Error|Warning): )+", "", line_text)
