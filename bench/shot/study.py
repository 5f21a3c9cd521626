"""Bounce-shot study in its result folder: record drops, plan with every method, store the shots."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from bench.problem.experiment import Experiment
from bench.registry import tuners
from bench.runs.begun import begun
from bench.runs.housing import tuned_of
from bench.runs.pools import Call, LostError, Pool, pool_of
from bench.runs.runner import Progress, check, refuse_unreachable, silent
from bench.runs.survey import admitted
from bench.runs.training import Lesson, Training, train
from bench.runs.training import folder as trained
from bench.sealing.kernel import memory_hidden
from bench.sealing.outside import Tuned
from bench.shot import tune
from bench.shot.deal import RECORDINGS, Deal, deals, in_view, record
from bench.shot.kept import SHOTS, keep, missing
from bench.shot.kept import check as check_kept
from bench.shot.settings import Settings, settings_of
from bench.store.folder import configuration
from bench.store.secret import kept, reveal
from bench.store.standing import MISSING, End, Made, Standing
from sims.base import InputError
from sims.camera import packages
from sims.shot import world

Say = Callable[[str], None]


class BounceShotStudy:
    """Study of shots by several methods, stored in a folder; implements `bench.study.Study`.

    Args:
        folder: result folder of a bounce-shot study.

    Attributes:
        folder: result folder.
        configuration: stored configuration of the study.
        plugins: plugin files that its tuners need.

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
    ) -> BounceShotStudy:
        """Create a study in a new folder, without running it; see `bench.study.Study.begin`.

        Args:
            experiment: experiment with a [shot] table.
            plugins: plugin files that its tuners need.
            folder: new result folder; None for the default one.
            jobs: number of worker processes that will be used; 0 runs everything in this process.
            salt: random string from which shots are drawn; see `bench.study.Study.begin`.
        """
        from bench.runs.identity import fingerprint

        if settings_of(experiment).filmed:
            packages.require("; or set shot.filmed = 0")
        if experiment.simulator != "ball" or experiment.observe != ("z",):
            raise InputError(
                f'experiment {experiment.name}: a shot needs simulator = "ball" and observe = ["z"]'
            )
        new = begun(experiment, folder, jobs, salt)
        # Validated before the folder is created: an error of the user leaves no files.
        check(new.experiment)
        if jobs:
            refuse_unreachable(new.experiment)
        return cls(new.write(plugins, fingerprint(new.experiment, plugins)))

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> BounceShotStudy:
        """Open an interrupted study to run what is missing; see `bench.study.Study.resume`.

        Args:
            folder: result folder.
            plugins: further plugin files.
        """
        from bench.runs.identity import unchanged

        study = cls(folder)
        study.plugins = unchanged(folder, study.configuration, plugins)
        check_kept(folder, study.deals)
        return study

    @cached_property
    def skipped(self) -> dict[str, str]:
        """Tuners that cannot be used here, by label, with the reason."""
        return check(self.configuration.experiment)

    @cached_property
    def experiment(self) -> Experiment:
        """The experiment, with the tuners that can be used."""
        whole = self.configuration.experiment
        # Skipped tuners would have empty lines; `finish` reports why they are missing.
        labels = [entry.label for entry in whole.tuners if entry.label not in self.skipped]
        return whole.with_tuners(labels)

    @cached_property
    def settings(self) -> Settings:
        """The [shot] table."""
        return settings_of(self.configuration.experiment)

    @cached_property
    def deals(self) -> list[Deal]:
        """All shots of the study."""
        experiment = self.configuration.experiment
        salt = kept(self.folder, experiment) or experiment.salt
        return deals(experiment, self.settings, salt)

    def make(
        self, jobs: int = 2, progress: Progress | None = None, pool: Pool | None = None
    ) -> Made:
        """Execute the missing shots; see `bench.study.Study.make`.

        Args:
            jobs: number of worker processes.
            progress: makes progress callbacks; None for no progress output.
            pool: worker pool; None to create one.
        """
        if reason := world.missing():
            return self._made(skipped=reason)
        if pool is not None or jobs:
            refuse_unreachable(self.experiment)
        try:
            left = missing(self.folder, self.deals)
            if left:
                _Making(self, left, progress or silent).run(jobs, pool)
        except KeyboardInterrupt:  # the kinds of balls alternate, so a partial result covers all
            return self._made(interrupted=True)
        except LostError as error:
            return self._made(stopped=str(error))
        return self._made()

    def _made(self, **why: Any) -> Made:
        left = missing(self.folder, self.deals)
        if not left and not why:
            experiment = self.configuration.experiment
            reveal(self.folder, kept(self.folder, experiment))
            self.configuration = configuration(self.folder)
        return Made(len(self.deals) - len(left), len(self.deals), **why)

    def close(self) -> None:
        """Close the study; it holds no open files."""

    def status(self) -> Standing:
        """Return which shots are stored and which are missing.

        Raises:
            InputError: the file of a shot is damaged.
        """
        check_kept(self.folder, self.deals)
        left = {one.name for one in missing(self.folder, self.deals)}
        ends = tuple(
            End(one.name, one.ball.name, MISSING if one.name in left else "made")
            for one in self.deals
        )
        held = self.configuration
        return Standing(held.experiment.name, "shots made", held.fingerprint, ends)

    def finish(self, say: Say) -> int:
        """Write tables, figures and HTML report, and print a summary.

        Args:
            say: prints a line.

        Returns:
            Number of failures of methods.

        Raises:
            InputError: the file of a shot is damaged.
        """
        from bench.shot.report import finish

        return finish(self, say)


class _Making:
    """Execution of the missing shots, in several stages."""

    def __init__(self, study: BounceShotStudy, left: list[Deal], progress: Progress) -> None:
        self._study, self._left, self._progress = study, left, progress
        self._experiment, self._settings = study.experiment, study.settings
        self._tuned: dict[str, Tuned] = {}
        if not self._experiment.trusted:
            self._tuned = {entry.label: tuned_of(entry) for entry in self._experiment.tuners}
        self._hidden = tuple(str(place.resolve()) for place in (study.folder, trained()))
        self._paths = [study.folder / RECORDINGS / f"{one.name}.csv" for one in left]

    def run(self, jobs: int, pool: Pool | None) -> None:
        """Record the drops, train tuners, tune and plan, and execute the shots.

        Args:
            jobs: number of worker processes.
            pool: worker pool; None to create one.

        Raises:
            LostError: the workers are no longer available.
            WeightsError: stored trained weights are damaged.
        """
        for name in (SHOTS, RECORDINGS):
            (self._study.folder / name).mkdir(exist_ok=True)
        # These workers know the true balls and run no tuner; other workers run the tuners.
        with pool_of(jobs) as workers:
            faults = self._record(workers)
        # The true balls are in the memory of this process, and a tuner's process may run as the
        # same user.
        hidden = nullcontext() if self._experiment.trusted else memory_hidden()
        with hidden, pool or pool_of(jobs) as workers:
            workers.load(admitted(self._study.plugins, self._experiment))
            weights = self._train(workers)
            self._shoot(workers, faults, weights)

    def _record(self, workers: Pool) -> dict[int, BaseException]:
        """Record every drop.

        Returns:
            Errors by index of the shot.
        """
        calls: list[Call] = [
            (record, (self._experiment, one, self._settings, path))
            for one, path in zip(self._left, self._paths, strict=True)
        ]
        step = self._progress("dropping", len(calls))
        faults: dict[int, BaseException] = {}
        for place, fault in workers.results(calls, self._experiment.timeout):
            if isinstance(fault, BaseException):
                faults[place] = fault
            step()
        return faults

    def _train(self, workers: Pool) -> dict[str, Path]:
        """Train the tuners that need training.

        Returns:
            Files of the trained weights, by label.

        Raises:
            Exception: a training failed; an untrained tuner must not be used as a trained one.
        """
        learned = [e for e in self._experiment.tuners if tuners.get(e.tuner).learned]
        grounds = [tune.tuned_in(self._experiment, self._settings, entry) for entry in learned]
        calls: list[Call] = [
            (train, (ground, Lesson(entry, 0, self._tuned.get(entry.label), self._hidden)))
            for ground, entry in zip(grounds, learned, strict=True)
        ]
        step = self._progress("training", len(calls))
        weights = {}
        for place, training in workers.results(calls, math.inf):
            if not isinstance(training, Training):
                raise training
            weights[learned[place].label] = training.path
            step()
        return weights

    def _shoot(
        self, workers: Pool, faults: dict[int, BaseException], weights: dict[str, Path]
    ) -> None:
        """Tune and plan with every method, and execute the shots."""
        seen = [place for place in range(len(self._left)) if place not in faults]
        calls: list[Call] = []
        for place in seen:
            one = self._left[place]
            known = tune.Known(
                one.name, self._paths[place], one.scene, weights, self._tuned, self._hidden
            )
            calls.append((tune.models, (self._experiment, self._settings, known)))
        step = self._progress("shooting", len(self._left))
        for place, fault in faults.items():
            status = "no recording" if isinstance(fault, InputError) else "crashed"
            self._keep(place, _failed(self._experiment, fault, status), 0.0)
            step()
        for at, models in workers.results(calls, self._experiment.timeout):
            place = seen[at]
            if isinstance(models, BaseException):
                models = _failed(self._experiment, models)
            self._keep(place, models, in_view(self._paths[place], self._experiment))
            step()

    def _keep(self, place: int, models: list[dict[str, Any]], seen: float) -> None:
        keep(self._study.folder, self._left[place], self._settings, models, seen)


def _failed(
    experiment: Experiment, error: BaseException, status: str = "crashed"
) -> list[dict[str, Any]]:
    """Make failed models for a shot without a recording, or whose worker died or was too slow.

    None of them has a plan.
    """
    if isinstance(error, TimeoutError):
        status = "timeout"
    nothing = partial(
        tune.TunedModel,
        effects={},
        simulations=0,
        seconds=math.nan,
        status=status,
        reason=str(error),
    )
    labels = [entry.label for entry in experiment.tuners]
    methods = [tune.NOMINAL, *labels, tune.EXPLAINED, *(label + tune.AFTER for label in labels)]
    return [vars(nothing(method=method, restitution=math.nan)) for method in methods]
