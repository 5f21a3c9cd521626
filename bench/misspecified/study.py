"""Misspecification study in its result folder.

A recording of the true system is made, explain extends the simulator from it, and every tuner is
compared in both simulators on the same targets. The folder contains `calibration.csv`, the result
of explain in `explain/`, and two comparisons, `plain/` and `extended/`, each in the common format
of comparisons.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from bench.compare import Comparison
from bench.misspecified.calibration import (
    MODELS,
    PLAIN,
    after,
    before,
    coefficients,
    explained,
    extension,
    record,
)
from bench.store.folder import CONFIGURATION, configuration
from bench.store.secret import kept, reveal
from bench.store.segments import FOLDER
from bench.store.standing import MISSING, End, Made, Standing

if TYPE_CHECKING:
    from bench.problem.experiment import Experiment
    from bench.runs.pools import Pool
    from bench.runs.runner import Progress

Say = Callable[[str], None]
RECORDING = "calibration.csv"
"""Calibration recording from which explain extends the simulator."""
ANSWER = "explain/extended.toml"
"""Extended simulator that explain writes."""


class MisspecifiedStudy:
    """Study of tuners in a simulator with a missing effect and in the extended one.

    It implements `bench.study.Study`.

    Args:
        folder: result folder of such a study.

    Attributes:
        folder: result folder.
        configuration: stored configuration of the study.
        plugins: plugin files that it needs.

    Raises:
        InputError: the folder does not contain such a study, or it is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.configuration = configuration(folder)
        self.plugins = self.configuration.plugins

    @classmethod
    def begin(
        cls,
        experiment: Experiment,
        plugins: Sequence[str] = (),
        folder: Path | None = None,
        jobs: int = 2,
        salt: str | None = None,
    ) -> MisspecifiedStudy:
        """Create a study in a new folder, without running it; see `bench.study.Study.begin`.

        Args:
            experiment: experiment with a calibration table.
            plugins: plugin files that it needs.
            folder: new result folder; None for the default one.
            jobs: number of worker processes that will be used; 0 runs everything in this process.
            salt: random string from which targets are drawn; see `bench.study.Study.begin`.
        """
        from bench.runs.begun import begun
        from bench.runs.identity import fingerprint
        from bench.runs.runner import prepare, refuse_unreachable

        new = begun(experiment, folder, jobs, salt)
        # Validated before the folder is created: an error of the user leaves no files.
        prepare(before(new.experiment), new.secret)
        if jobs:
            refuse_unreachable(new.experiment)
        return cls(new.write(plugins, fingerprint(new.experiment, plugins)))

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> MisspecifiedStudy:
        """Open an interrupted study to run what is missing; see `bench.study.Study.resume`.

        Args:
            folder: result folder.
            plugins: further plugin files.
        """
        from bench.runs.identity import unchanged

        study = cls(folder)
        study.plugins = unchanged(folder, study.configuration, plugins)
        return study

    def make(
        self, jobs: int = 2, progress: Progress | None = None, pool: Pool | None = None
    ) -> Made:
        """Run what is missing; see `bench.study.Study.make`.

        Args:
            jobs: number of worker processes.
            progress: makes progress callbacks; None for no progress output.
            pool: worker pool; None to create one.
        """
        from bench.runs.runner import silent

        finished = planned = 0
        try:
            self._extend(jobs, progress or silent)
        except KeyboardInterrupt:
            count = self._planned()
            return Made(0, 2 * count, interrupted=True)
        for model in MODELS:
            comparison = self._comparison(model, jobs)
            made = comparison.make(jobs, progress, pool)
            finished, planned = finished + made.finished, planned + made.planned
            if not made.complete:
                # The comparison that has not started has the same number of runs.
                left = made.planned if model == PLAIN else 0
                return Made(finished, planned + left, made.interrupted, made.stopped, made.skipped)
        reveal(self.folder, kept(self.folder, self.configuration.experiment))
        self.configuration = configuration(self.folder)
        segments = self.folder / FOLDER
        if segments.is_dir() and not any(segments.iterdir()):
            segments.rmdir()
        return Made(finished, planned)

    def _planned(self) -> int:
        """Return the number of runs in each simulator."""
        from bench.runs.runner import seeds_of

        experiment = self.configuration.experiment
        runs = sum(seeds_of(experiment, entry) for entry in experiment.tuners)
        return runs * experiment.targets * len(experiment.ranges)

    def _extend(self, jobs: int, progress: Progress) -> None:
        """Record the true system and extend the simulator by explain, unless done already."""
        if (self.folder / ANSWER).is_file():
            return
        experiment = self.configuration.experiment
        step = progress("explaining", 1)
        table = self.folder / RECORDING
        # If only one of the two files exists, the process was killed while writing.
        for file in (table, table.with_suffix(".toml")):
            file.unlink(missing_ok=True)
        record(experiment, self._salt(), table)
        explained(table, experiment, jobs)
        step()

    def _salt(self) -> str:
        experiment = self.configuration.experiment
        return kept(self.folder, experiment) or experiment.salt

    def _comparison(self, model: str, jobs: int) -> Comparison:
        """Create or resume the comparison in one of the simulators."""
        place, experiment = self.folder / model, self.configuration.experiment
        if (place / CONFIGURATION).is_file():
            comparison = Comparison.resume(place, self.plugins)
        else:
            # A public salt is already part of the experiment.
            secret = kept(self.folder, experiment)
            plan = replace(self.experiment_of(model), salt_sha256="")
            comparison = Comparison.begin(plan, self.plugins, place, jobs, secret)
        if comparison.results is not None:
            # The folder of the other simulator contains the same truths, so it must be inaccessible
            # too.
            everything = (str(self.folder.resolve()), *comparison.results.hidden)
            comparison.results.hidden = everything
        return comparison

    def experiment_of(self, model: str) -> Experiment:
        """Return the experiment of the comparison in one of the simulators.

        The extended simulator must exist for its experiment.
        """
        from bench.problem.robots import kind_of

        experiment = self.configuration.experiment
        if model == PLAIN:
            return before(experiment)
        kind = kind_of(experiment)
        found = extension(self.folder / ANSWER)
        return after(experiment, coefficients(found, kind))

    def close(self) -> None:
        """Close the study; its comparisons are opened when they run."""

    def status(self) -> Standing:
        """Return which runs are stored and which are missing, in both simulators.

        Raises:
            InputError: the study is damaged.
        """
        held = self.configuration
        ends: list[End] = []
        under_way = (self.folder / FOLDER).exists()
        for model in MODELS:
            if not (self.folder / model / CONFIGURATION).is_file():
                ends += [End(f"{model} {i}", model, MISSING) for i in range(self._planned())]
                continue
            standing = Comparison(self.folder / model).status()
            under_way = under_way or standing.under_way
            ends += [
                End(f"{model} {e.name}", f"{model} {e.group}", e.status, e.reason)
                for e in standing.ends
            ]
        name = held.experiment.name
        return Standing(name, "runs finished", held.fingerprint, tuple(ends), under_way)

    def finish(self, say: Say) -> int:
        """Write tables and figures, and print a summary.

        Args:
            say: prints a line.

        Returns:
            Number of failed runs.

        Raises:
            InputError: a comparison of the study is damaged.
        """
        from bench.misspecified.report import finish

        return finish(self, say)
