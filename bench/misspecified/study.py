"""A study of a missing effect in its folder: a recording of the world is made, explain extends the
simulator from it, and every tuner is compared in both simulators on the same targets.

The folder holds `calibration.csv`, explain's answer in `explain/`, and two comparisons, `plain/`
and `extended/`, each a folder as any comparison's.
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
"""What explain gets."""
ANSWER = "explain/extended.toml"
"""The simulator that it gives."""


class MisspecifiedStudy:
    """Tuners in a simulator that lacks an effect, and in the one that explain extended; fulfils
    `bench.study.Study`.

    Args:
        folder: of such a study.

    Attributes:
        folder: where everything lies.
        configuration: what it is for.
        plugins: plugin files that it needs.

    Raises:
        InputError: it is no such folder, or it is damaged.
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
        """A study in a new folder; nothing has been recorded yet; see `bench.study.Study.begin`."""
        from bench.runs.begun import begun
        from bench.runs.identity import fingerprint
        from bench.runs.runner import prepare, refuse_unreachable

        new = begun(experiment, folder, jobs, salt)
        # Before there is a folder: a fault of the user's leaves nothing behind.
        prepare(before(new.experiment), new.secret)
        if jobs:
            refuse_unreachable(new.experiment)
        return cls(new.write(plugins, fingerprint(new.experiment, plugins)))

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> MisspecifiedStudy:
        """A study that was interrupted: what is finished stays; see `bench.study.Study.resume`."""
        from bench.runs.identity import unchanged

        study = cls(folder)
        study.plugins = unchanged(folder, study.configuration, plugins)
        return study

    def make(
        self, jobs: int = 2, progress: Progress | None = None, pool: Pool | None = None
    ) -> Made:
        """Make what is missing; see `bench.study.Study.make`."""
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
                # The one that was not begun plans as much.
                left = made.planned if model == PLAIN else 0
                return Made(finished, planned + left, made.interrupted, made.stopped, made.skipped)
        reveal(self.folder, kept(self.folder, self.configuration.experiment))
        self.configuration = configuration(self.folder)
        segments = self.folder / FOLDER
        if segments.is_dir() and not any(segments.iterdir()):
            segments.rmdir()
        return Made(finished, planned)

    def _planned(self) -> int:
        """Runs in each simulator."""
        from bench.runs.runner import seeds_of

        experiment = self.configuration.experiment
        runs = sum(seeds_of(experiment, entry) for entry in experiment.tuners)
        return runs * experiment.targets * len(experiment.ranges)

    def _extend(self, jobs: int, progress: Progress) -> None:
        """Record the world and have explain extend the simulator, where that is still to do."""
        if (self.folder / ANSWER).is_file():
            return
        experiment = self.configuration.experiment
        step = progress("explaining", 1)
        table = self.folder / RECORDING
        # One of the two without the other is what a kill left.
        for file in (table, table.with_suffix(".toml")):
            file.unlink(missing_ok=True)
        record(experiment, self._salt(), table)
        explained(table, experiment, jobs)
        step()

    def _salt(self) -> str:
        experiment = self.configuration.experiment
        return kept(self.folder, experiment) or experiment.salt

    def _comparison(self, model: str, jobs: int) -> Comparison:
        """The comparison in one of the simulators, begun or taken up."""
        place, experiment = self.folder / model, self.configuration.experiment
        if (place / CONFIGURATION).is_file():
            comparison = Comparison.resume(place, self.plugins)
        else:
            # A public salt stands in the experiment already.
            secret = kept(self.folder, experiment)
            plan = replace(self.experiment_of(model), salt_sha256="")
            comparison = Comparison.begin(plan, self.plugins, place, jobs, secret)
        if comparison.results is not None:
            # What is known of the truths lies in the other simulator's folder too.
            everything = (str(self.folder.resolve()), *comparison.results.hidden)
            comparison.results.hidden = everything
        return comparison

    def experiment_of(self, model: str) -> Experiment:
        """The comparison that is made in one of the simulators; in the extended one only once that
        is there.
        """
        from bench.problem.robots import kind_of

        experiment = self.configuration.experiment
        if model == PLAIN:
            return before(experiment)
        kind = kind_of(experiment)
        found = extension(self.folder / ANSWER)
        return after(experiment, coefficients(found, kind))

    def close(self) -> None:
        """Let go of the folder; its comparisons are opened when they are made."""

    def status(self) -> Standing:
        """Which runs the folder holds and which are missing, in both simulators.

        Raises:
            InputError: it is damaged.
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
        """Write tables and figures of what there is, and say what came out.

        Returns:
            How many runs failed.

        Raises:
            InputError: a comparison in it is damaged.
        """
        from bench.misspecified.report import finish

        return finish(self, say)
