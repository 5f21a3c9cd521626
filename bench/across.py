"""Joint statistics over several comparisons: mean ranks, runtime distribution, ERT and pairs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from bench.analysis.curves import Curves
from bench.analysis.marks import marked
from bench.analysis.paired import PROBLEMS, nemenyi, pairs, ranks
from bench.analysis.runtimes import ert_table, solved
from bench.analysis.statistics import Statistics
from bench.figures import runtimes
from bench.figures.comparison import statistics_of
from bench.figures.style import Pictures, Styles, keep, mark, taken
from bench.pages.comparison.together import Several, together_page
from bench.problem.experiment import Entry, Experiment
from bench.report import NEEDED, REPORT
from bench.store.folder import read
from sims.base import Array, InputError
from sims.files import write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TUNERS = 3
"""Minimum number of tuners for Friedman's test."""


class Across(NamedTuple):
    """Result of evaluating several comparisons together.

    Attributes:
        together: comparisons.
        files: files that were written.
    """

    together: Together
    files: list[Path]

    def document(self) -> dict[str, Any]:
        """Return the result as a JSON document."""
        ranked = self.together.ranked
        return {
            "problems": list(ranked.index),
            "ranks": {str(tuner): list(ranked[tuner]) for tuner in ranked},
            "mean_ranks": ranked.mean().sort_values().to_dict(),
            "friedman_p": self.together.tests[0] if self.together.comparable else None,
            "trusted": self.together.trusted,
            "files": self.files,
        }


def across(folders: Sequence[Path], out: Path, say: Callable[[str], None]) -> Across:
    """Compute joint statistics of several comparisons, and write tables, figures and a page.

    Args:
        folders: result folders of the comparisons.
        out: folder to write to.
        say: callback that prints one line.

    Raises:
        InputError: a folder is not that of a comparison, or they share no tuners.
    """
    together = read_together(folders)
    out.mkdir(parents=True, exist_ok=True)
    files = []
    frames = together.frames()
    for name, frame in frames.items():
        files.append(out / f"{name}.csv")
        write(files[-1], frame.to_csv(index=False))
    means = together.ranked.mean().sort_values().round(2)
    count = len(together.ranked)
    say(f"mean rank over {count} problems (1 is best)\n{means.to_string()}")
    if not together.comparable:
        say(f"no critical-difference diagram: it needs {PROBLEMS} problems and {_TUNERS} tuners")
    pictures = {name: taken(figure) for name, figure in together.figures().items()}
    for name, picture in pictures.items():
        drawn = keep(out / "figures" / name, picture.png, picture.pdf)
        say(f"figure  {drawn[0]}")
        files += drawn
    files.append(out / REPORT)
    write(files[-1], together_page(together.several(frames, pictures, folders, out)))
    say(f"report  {files[-1]}")
    return Across(together, files)


def read_together(folders: Sequence[Path]) -> Together:
    """Load several comparisons.

    Raises:
        InputError: a folder is not that of a comparison, or they share no tuners.
    """
    parts = []
    for folder in folders:
        stored = read(folder, NEEDED)
        if stored.runs.empty:
            raise InputError(f"{folder}: holds no runs")
        parts.append(Part(statistics_of(stored), stored.experiment))
    first, *others = (part.statistics.curves.tuners() for part in parts)
    tuners = [t for t in first if all(t in other for other in others)]
    if not tuners:
        raise InputError(f"{', '.join(map(str, folders))}: have no tuner in common")
    return Together(parts, tuners)


@dataclass(frozen=True)
class Part:
    """One of several comparisons.

    Attributes:
        statistics: statistics of the comparison.
        experiment: configuration of the comparison.
    """

    statistics: Statistics
    experiment: Experiment


@dataclass(frozen=True)
class Together:
    """Several comparisons.

    Attributes:
        parts: comparisons, each with one problem per range.
        tuners: labels of the tuners that all comparisons have.
    """

    parts: Sequence[Part]
    tuners: Sequence[str]

    @cached_property
    def ranked(self) -> pd.DataFrame:
        """Ranks among the common tuners: one row per problem, one column per tuner, 1 is best."""
        each = pd.concat(
            [ranks(part.statistics.curves, part.statistics.floor) for part in self.parts]
        )
        # Ranks among all tuners have gaps if some tuners are left out.
        return each[list(self.tuners)].rank(axis=1)

    @property
    def comparable(self) -> bool:
        """Whether there are enough problems and tuners for Friedman's and Nemenyi's tests."""
        return len(self.ranked) >= PROBLEMS and len(self.tuners) >= _TUNERS

    @cached_property
    def tests(self) -> tuple[float, pd.DataFrame]:
        """Friedman's p-value, and Nemenyi's for each pair of tuners; requires `comparable`."""
        return nemenyi(self.ranked)

    def frames(self) -> dict[str, pd.DataFrame]:
        """Build the tables ert, pairs, ranks, and nemenyi if `comparable`, by name."""
        ert, paired = [], []
        for part in self.parts:
            curves, levels = part.statistics.curves, part.statistics.levels
            times = ert_table(curves, levels, part.experiment.budget)
            ert.append(marked(times, part.experiment))
            paired.append(marked(pairs(curves, part.statistics.floor), part.experiment))
        frames = {
            "ert": pd.concat(ert),
            "pairs": pd.concat(paired),
            "ranks": self._squared(self.ranked).reset_index(names="problem"),
        }
        if self.comparable:
            frames["nemenyi"] = self._squared(self.tests[1]).reset_index(names="tuner")
        return frames

    def several(
        self,
        frames: Mapping[str, pd.DataFrame],
        pictures: Mapping[str, Pictures],
        folders: Sequence[Path],
        out: Path,
    ) -> Several:
        """Build the data of the page.

        Args:
            frames: tables by name.
            pictures: rendered figures by name.
            folders: result folders of the comparisons.
            out: folder of the page.
        """
        friedman, p_values = self.tests if self.comparable else (float("nan"), None)
        parts = [(part.experiment, part.statistics) for part in self.parts]
        return Several(
            parts,
            self.tuners,
            self.ranked,
            p_values,
            friedman,
            self._shares(),
            frames,
            pictures,
            [str(folder) for folder in folders],
            str(out),
        )

    @property
    def trusted(self) -> bool:
        """Whether tuners ran without isolation in any of the comparisons."""
        return any(part.experiment.trusted for part in self.parts)

    def _squared(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Add the column `trusted` to a table if any tuner ran without isolation."""
        return frame.assign(trusted=True) if self.trusted else frame

    def figures(self) -> dict[str, Figure]:
        """Draw the figures runtime-distribution, and critical-difference if `comparable`."""
        drawn = {"runtime-distribution": self._joint_figure()}
        if self.comparable:
            friedman, p_values = self.tests
            drawn["critical-difference"] = runtimes.rank_figure(self.ranked, p_values, friedman)
        return {name: mark(figure, self.trusted) for name, figure in drawn.items()}

    def _joint_figure(self) -> Figure:
        title = f"{len(self.ranked)} problems"
        experiment = Experiment("all", title, tuners=tuple(Entry(t, t) for t in self.tuners))
        style = Styles(experiment, list(self.ranked.mean().sort_values(kind="stable").index))
        return runtimes.joint_runtime_figure(experiment, style, self._shares())

    def _shares(self) -> dict[str, Array]:
        """Compute each tuner's share reached after 0..100 % of the budget, mean over problems."""
        each = [
            problem
            for part in self.parts
            for problem in _shares(part.statistics.curves, part.statistics.spread)
        ]
        return {t: np.mean([problem[t] for problem in each], axis=0) for t in self.tuners}


def _shares(curves: Curves, spread: Array) -> list[dict[str, Array]]:
    """Compute for each range and tuner the share reached after 0..100 % of the budget."""
    budget = curves.values.shape[1] - 1
    points = np.floor(np.linspace(0, budget, 101)).astype(np.int64)
    shares = []
    for kind in dict.fromkeys(curves.keys["range"]):
        part = curves.of(range=str(kind))
        shares.append({t: solved(part.of(tuner=t), spread, points) for t in part.tuners()})
    return shares
