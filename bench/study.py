"""Studies: what an experiment asks for, made in a folder.

Comparisons of tuners and of diagnosers, bounce shots and studies of a missing effect are kinds of
one contract, and this is the one place that tells which is which.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from bench.problem.salt import fresh
from bench.store.folder import CONFIGURATION, configuration, free_folder

if TYPE_CHECKING:
    from bench.compare import Say
    from bench.problem.experiment import Experiment
    from bench.runs.pools import Pool
    from bench.runs.runner import Progress
    from bench.store.folder import Configuration
    from bench.store.standing import Made, Standing


class Study(Protocol):
    """A study in its folder.

    ``Kind(folder)`` opens one to look at it and to report it, without hindering whoever is at work
    there; `begin` and `resume` give one that can be made.

    Attributes:
        folder: where everything lies.
        configuration: what it is for.
    """

    folder: Path
    configuration: Configuration

    def __init__(self, folder: Path) -> None: ...

    @classmethod
    def begin(
        cls,
        experiment: Experiment,
        plugins: Sequence[str] = (),
        folder: Path | None = None,
        jobs: int = 2,
        salt: str | None = None,
    ) -> Study:
        """A study in a new folder, checked and planned.

        Args:
            experiment: what it is of.
            plugins: plugin files that it needs; the caller has loaded them.
            folder: new or empty; one below results/ that is named for the time where None.
            jobs: worker processes that it is meant to be made with; 0 for none, and tuners that
                are trusted.
            salt: what its targets are drawn from, secret until it is complete; a fresh one where
                None.

        Raises:
            InputError: a fault in the experiment, or the folder is not free.
        """
        ...

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> Study:
        """A study that was interrupted; its own plugins are loaded, and these.

        Raises:
            InputError: the folder is damaged, or something that matters has changed since.
        """
        ...

    def make(
        self, jobs: int = 2, progress: Progress | None = None, pool: Pool | None = None
    ) -> Made:
        """Make what is missing; says how far it came, also where it was interrupted.

        Args:
            jobs: worker processes; 0 for none, and everything in this one.
            progress: told of every step.
            pool: where to run instead, e.g. on a cluster.

        Raises:
            InputError: workers cannot be had; what was finished is kept.
        """
        ...

    def close(self) -> None:
        """Let go of the folder without making what is missing."""
        ...

    def status(self) -> Standing:
        """What the folder holds, and what is missing."""
        ...

    def finish(self, say: Say) -> int:
        """Write tables and figures of what there is, and say what came out; how many failed."""
        ...


def begin(
    experiment: Experiment,
    plugins: Sequence[str] = (),
    folder: Path | None = None,
    jobs: int = 2,
    salt: str | None = None,
) -> Study:
    """Begin the study that an experiment asks for; see `Study.begin`."""
    return kind_of(experiment).begin(experiment, plugins, folder, jobs, salt)


def begin_all(
    experiment: Experiment,
    plugins: Sequence[str] = (),
    folder: Path | None = None,
    jobs: int = 2,
    salt: str | None = None,
) -> list[Study]:
    """Begin the study, or the studies where the experiment sweeps over values or names others.

    Args:
        experiment: what is asked for.
        plugins: as in `Study.begin`.
        folder: of the study; of several the folder in which each gets its own, named as its
            experiment is.
        jobs: as in `Study.begin`.
        salt: as in `Study.begin`; of several one for all, so that they meet the same targets.

    Raises:
        InputError: a fault in one of them, or the folder is not free; nothing is left behind.
    """
    from bench.problem.experiment import expand

    wanted = expand(experiment)
    if len(wanted) == 1:
        return [begin(wanted[0], plugins, folder, jobs, salt)]
    # Experiments of their own have salts of their own: one that is complete gives away no other's.
    if salt is None and not experiment.salt and not experiment.experiments:
        salt = fresh()
    parent = free_folder(experiment, folder)
    begun: list[Study] = []
    try:
        # All before the first is made: a fault in the last would show after hours.
        for one in wanted:
            begun.append(begin(one, plugins, parent / one.name, jobs, salt))
    except BaseException:
        for study in begun:
            study.close()
            shutil.rmtree(study.folder, ignore_errors=True)
        if parent.is_dir() and not any(parent.iterdir()):
            parent.rmdir()
        raise
    return begun


def parts_of(folder: Path) -> list[Path]:
    """The folders of the studies in a folder: itself, or those that a sweep has put there."""
    if (folder / CONFIGURATION).exists() or not folder.is_dir():
        return [folder]
    inside = sorted(path for path in folder.iterdir() if (path / CONFIGURATION).exists())
    return inside or [folder]


def conclude(folder: Path, say: Say) -> None:
    """Write and say what the studies in a folder come to together, where they are such as that can
    be said of.

    Args:
        folder: as `begin_all` was given it.
        say: prints a line.
    """
    parts = parts_of(folder)
    experiments = [configuration(part).experiment for part in parts]
    if len(parts) > 1 and all(experiment.calibration for experiment in experiments):
        from bench.misspecified.report import conclude

        conclude(folder, parts, say)


def resume(folder: Path, plugins: Sequence[str] = ()) -> Study:
    """Take up the study in a folder; see `Study.resume`."""
    return _kind_in(folder).resume(folder, plugins)


def opened(folder: Path) -> Study:
    """The study in a folder, to be looked at and reported.

    Raises:
        InputError: there is none, or it is damaged.
    """
    return _kind_in(folder)(folder)


def kind_of(experiment: Experiment) -> type[Study]:
    """Which study an experiment asks for."""
    # Imported here: who compares needs none of what makes shots.
    if experiment.shot:
        from bench.shot.study import BounceShotStudy

        return BounceShotStudy
    if experiment.calibration:
        from bench.misspecified.study import MisspecifiedStudy

        return MisspecifiedStudy
    if experiment.diagnosis:
        from bench.diagnosis.study import DiagnosisStudy

        return DiagnosisStudy
    from bench.compare import Comparison

    return Comparison


def _kind_in(folder: Path) -> type[Study]:
    return kind_of(configuration(folder).experiment)
