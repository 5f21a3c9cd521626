"""A bounce shot in its folder: drops are recorded, every method plans, shots are made and kept."""

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
    """Shots x methods, kept in a folder; fulfils `bench.study.Study`.

    Args:
        folder: of a bounce shot.

    Attributes:
        folder: where everything lies.
        configuration: what it is for.
        plugins: plugin files that its tuners need.

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
    ) -> BounceShotStudy:
        """A bounce shot in a new folder; nothing has been dropped yet; see
        `bench.study.Study.begin`.
        """
        from bench.runs.identity import fingerprint

        if settings_of(experiment).filmed:
            packages.require("; or set shot.filmed = 0")
        if experiment.simulator != "ball" or experiment.observe != ("z",):
            raise InputError(
                f'experiment {experiment.name}: a shot needs simulator = "ball" and observe = ["z"]'
            )
        new = begun(experiment, folder, jobs, salt)
        # Before there is a folder: a fault of the user's leaves nothing behind.
        check(new.experiment)
        if jobs:
            refuse_unreachable(new.experiment)
        return cls(new.write(plugins, fingerprint(new.experiment, plugins)))

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> BounceShotStudy:
        """A bounce shot that was interrupted: what is kept stays, what is missing remains; see
        `bench.study.Study.resume`.
        """
        from bench.runs.identity import unchanged

        study = cls(folder)
        study.plugins = unchanged(folder, study.configuration, plugins)
        check_kept(folder, study.deals)
        return study

    @cached_property
    def skipped(self) -> dict[str, str]:
        """The tuners that cannot be used here, by label, and why."""
        return check(self.configuration.experiment)

    @cached_property
    def experiment(self) -> Experiment:
        """What is shot, with the tuners that can be used."""
        whole = self.configuration.experiment
        # Their lines would be empty; finish says why they are not there.
        labels = [entry.label for entry in whole.tuners if entry.label not in self.skipped]
        return whole.with_tuners(labels)

    @cached_property
    def settings(self) -> Settings:
        """The [shot] table."""
        return settings_of(self.configuration.experiment)

    @cached_property
    def deals(self) -> list[Deal]:
        """All shots."""
        experiment = self.configuration.experiment
        salt = kept(self.folder, experiment) or experiment.salt
        return deals(experiment, self.settings, salt)

    def make(
        self, jobs: int = 2, progress: Progress | None = None, pool: Pool | None = None
    ) -> Made:
        """Make what is missing; see
        `bench.study.Study.make`.
        """
        if reason := world.missing():
            return self._made(skipped=reason)
        if pool is not None or jobs:
            refuse_unreachable(self.experiment)
        try:
            left = missing(self.folder, self.deals)
            if left:
                _Making(self, left, progress or silent).run(jobs, pool)
        except KeyboardInterrupt:  # the balls take turns, so what there is tells of all of them
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
        """Let go of the folder; a shot's holds nothing open."""

    def status(self) -> Standing:
        """Which shots the folder holds and which are missing.

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
        """Write tables and figures of what there is, and say what came out.

        Returns:
            How many times a method failed.

        Raises:
            InputError: the file of a shot is damaged.
        """
        from bench.shot.report import finish

        return finish(self, say)


class _Making:
    """The work on the shots that are missing, one stage after another."""

    def __init__(self, study: BounceShotStudy, left: list[Deal], progress: Progress) -> None:
        self._study, self._left, self._progress = study, left, progress
        self._experiment, self._settings = study.experiment, study.settings
        self._tuned: dict[str, Tuned] = {}
        if not self._experiment.trusted:
            self._tuned = {entry.label: tuned_of(entry) for entry in self._experiment.tuners}
        self._hidden = tuple(str(place.resolve()) for place in (study.folder, trained()))
        self._paths = [study.folder / RECORDINGS / f"{one.name}.csv" for one in left]

    def run(self, jobs: int, pool: Pool | None) -> None:
        """Record the drops, train, tune and plan, make the shots.

        Raises:
            LostError: what makes the calls is gone.
            WeightsError: trained weights are there and damaged.
        """
        for name in (SHOTS, RECORDINGS):
            (self._study.folder / name).mkdir(exist_ok=True)
        # These workers know the balls, and tune nothing; those that tune are others.
        with pool_of(jobs) as workers:
            faults = self._record(workers)
        # Here are the true balls, and a tuner's process may be this user's.
        hidden = nullcontext() if self._experiment.trusted else memory_hidden()
        with hidden, pool or pool_of(jobs) as workers:
            workers.load(admitted(self._study.plugins, self._experiment))
            weights = self._train(workers)
            self._shoot(workers, faults, weights)

    def _record(self, workers: Pool) -> dict[int, BaseException]:
        """Record every drop; returns what went wrong, by place."""
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
        """The files of the learned tuners' weights, by label.

        Raises:
            Exception: a training failed; an untrained tuner must not be taken for a trained one.
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
        """Have every method tune and plan, and make the shots."""
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
    """The models of a shot whose drop could not be recorded, or whose worker died or took too long:
    none has a plan.
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
