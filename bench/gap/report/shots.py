"""Which run a figure shows, and which of its samples are drawn."""

from __future__ import annotations

import warnings
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.gap.report.account import sides
from bench.gap.report.story import Side, Story
from sims.base import Array

MOST_POINTS = 3000
"""Samples of a run that are drawn; of a longer one the extremes of each part are."""
MOST_OUTLINES = 1000
"""Dots that are drawn as outlines; more are pixels, in vector files too."""
MOST_CHANNELS = 3
"""Channels of the run that are shown, the worst."""


class Shot(NamedTuple):
    """The run that is shown: its side, its row, whether it is held out, and its channels, the worst
    first.
    """

    side: Side
    row: int
    held_out: bool
    channels: list[int]


def worst(story: Story) -> Shot:
    """The run with the largest gap in units of the noise, a held-out one if there is any."""
    side = sides(story)[-1]
    sigma = np.array([c.sigma for c in story.channels])
    squares = ((side.observed - side.before) / sigma) ** 2
    with warnings.catch_warnings():
        # A run or channel without a sample has no mean, and is not the worst.
        warnings.simplefilter("ignore", RuntimeWarning)
        row = int(np.argmax(np.nan_to_num(np.nanmean(squares, axis=(1, 2)))))
        by_channel = np.nan_to_num(np.nanmean(squares[row], axis=0))
    channels = np.argsort(-by_channel, kind="stable")[:MOST_CHANNELS]
    return Shot(side, row, side is story.held_out, sorted(int(c) for c in channels))


def kept(values: Array) -> NDArray[np.intp]:
    """Places of at most about `MOST_POINTS` samples that look the same: the least and largest of
    each stretch.
    """
    if values.size <= MOST_POINTS:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, MOST_POINTS // 2 + 1).astype(int)
    # A missing sample is neither the least nor the largest.
    low, high = np.nan_to_num(values, nan=np.inf), np.nan_to_num(values, nan=-np.inf)
    chosen = []
    for begin, end in pairwise(edges):
        chosen += [begin + np.argmin(low[begin:end]), begin + np.argmax(high[begin:end])]
    return np.unique(chosen)
