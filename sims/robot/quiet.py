"""MuJoCo, kept quiet: its warnings are collected, its errors become one line, and neither its
printing nor its log file happens.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet() -> Iterator[list[str]]:
    """Collects the warnings that MuJoCo gives within the block, each as one line.

    Without a handler MuJoCo prints warnings and appends them to ``MUJOCO_LOG.TXT`` in the folder
    where the program runs.
    """
    import mujoco

    said: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: said.append(one_line(text)))
    try:
        with warnings.catch_warnings():
            # Its compiler warns by way of Python.
            warnings.simplefilter("always")
            warnings.showwarning = lambda message, *_: said.append(one_line(message))
            yield said
    finally:
        mujoco.set_mju_user_warning(before)


def one_line(message: object) -> str:
    """What MuJoCo says, in one line: ``what; Element 'joint', line 6``."""
    lines = [line.strip().rstrip(".") for line in str(message).splitlines()]
    said = "; ".join(line for line in lines if line)
    return re.sub(r"^((XML )?(Error|Warning): )+", "", said)
