"""Comparison of diagnosers in its result folder: draw cases, run diagnosers, store answers."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import cached_property
from pathlib import Path
from typing import Any

from bench.diagnosis.kept import Answered, Kept, read
from bench.diagnosis.learning import Learned, learn
from bench.diagnosis.lessons import Taught, write_lessons
from bench.diagnosis.room import Examined, Limits, answered
from bench.diagnosis.settings import Settings, settings_of
from bench.diagnosis.sheet import Question, sheet
from bench.problem.experiment import Experiment
from bench.problem.salt import PUBLIC
from bench.problem.seeds import rng_for
from bench.registry import SkippedError, diagnosers, simulators
from bench.runs.begun import begun
from bench.runs.housing import ahead_of
from bench.runs.identity import refuse_changes
from bench.runs.pools import Call, LostError, Pool, pool_of
from bench.runs.runner import Progress, silent, unreachable
from bench.runs.sources import digest, plugin_files, rooms, source, versions
from bench.runs.survey import admit, enter, foreign, installed
from bench.runs.training import folder as trained
from bench.sealing.ended import EndedError
from bench.sealing.kernel import memory_hidden
from bench.sealing.outside import Tuned
from bench.store.folder import configuration
from bench.store.secret import kept as kept_salt
from bench.store.secret import reveal
from bench.store.standing import MISSING, End, Made, Standing
from sims.base import InputError

Say = Callable[[str], None]
ROOMS = ("sims", "bench/problem", "bench/runs", "bench/sealing", "bench/gap", "bench/recordings")
"""Source folders that determine the answers, except those of the diagnosis benchmark itself."""
OWN = (*ROOMS, "bench/diagnosis/worlds", "bench/diagnosers")
LONGEST_LESSON = 3600.0
"""Maximum training time of a diagnoser for one system, seconds."""
_DRAWING = 300.0
"""Maximum time to draw one case, seconds."""


class DiagnosisStudy:
    """Comparison of diagnosers on cases, stored in a folder; implements `bench.study.Study`.

    Args:
        folder: result folder of a comparison of diagnosers.

    Attributes:
        folder: result folder.
        configuration: stored configuration of the study.
        plugins: plugin files that the diagnosers need.

    Raises:
        InputError: the folder does not contain such a comparison, or it is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.configuration = configuration(folder)
        self.plugins = self.configuration.plugins
        self._kept: Kept | None = None

    @classmethod
    def begin(
        cls,
        experiment: Experiment,
        plugins: Sequence[str] = (),
        folder: Path | None = None,
        jobs: int = 2,
        salt: str | None = None,
    ) -> DiagnosisStudy:
        """Create a comparison in a new folder, without running it; see `bench.study.Study`.

        Args:
            experiment: experiment with a ``[diagnosis]`` table.
            plugins: plugin files that the diagnosers need.
            folder: new result folder; None for the default one.
            jobs: number of worker processes that will be used; 0 runs everything in this process.
            salt: random string from which cases are drawn; see `bench.study.Study.begin`.
        """
        settings = settings_of(experiment)
        new = begun(experiment, folder, jobs, salt)
        sheet(settings)
        if jobs:
            _refuse_unreachable(settings.diagnosers)
        for name in settings.diagnosers:
            _announced(name, new.experiment.trusted)
        return cls(new.write(plugins, _fingerprint(new.experiment, plugins)))

    @classmethod
    def resume(cls, folder: Path, plugins: Sequence[str] = ()) -> DiagnosisStudy:
        """Open an interrupted comparison in order to run it; see `bench.study.Study.resume`.

        Args:
            folder: result folder.
            plugins: further plugin files.
        """
        study = cls(folder)
        held = study.configuration
        given = {str(Path(p).resolve()) for p in plugins}
        study.plugins = held.plugins + sorted(given - set(held.plugins))
        admit(study.plugins, held.experiment)
        for name in study.settings.diagnosers:
            _announced(name, held.experiment.trusted)
        refuse_changes(folder, held.fingerprint, _fingerprint(held.experiment, study.plugins))
        return study

    @cached_property
    def settings(self) -> Settings:
        """The validated ``[diagnosis]`` table."""
        return settings_of(self.configuration.experiment)

    @cached_property
    def questions(self) -> list[Question]:
        """All cases of the experiment."""
        return sheet(self.settings)

    @cached_property
    def skipped(self) -> dict[str, str]:
        """Diagnosers that cannot be used here, by name, with the reason."""
        reasons = {}
        # A diagnoser of a plugin is registered only where the plugin was loaded. Reading the folder
        # does not require the plugin, so an unregistered name is no reason to skip.
        known = set(diagnosers.names())
        for name in self.settings.diagnosers:
            if name not in known:
                continue
            try:
                diagnosers.get(name)
            except SkippedError as error:
                reasons[name] = error.reason
        return reasons

    @property
    def usable(self) -> list[str]:
        """Names of the diagnosers that can be used here."""
        return [name for name in self.settings.diagnosers if name not in self.skipped]

    def make(
        self, jobs: int = 2, progress: Progress | None = None, pool: Pool | None = None
    ) -> Made:
        """Collect the missing answers; see `bench.study.Study.make`.

        Args:
            jobs: number of worker processes.
            progress: makes progress callbacks; None for no progress output.
            pool: worker pool; None to create one.
        """
        self._kept = Kept(self.folder)
        try:
            _Asking(self, self._kept, progress or silent).run(jobs, pool)
        except KeyboardInterrupt:
            return self._made(interrupted=True)
        except LostError as error:
            return self._made(stopped=str(error))
        finally:
            self.close()
        return self._made()

    def _made(self, **why: Any) -> Made:
        ends = self.status().ends
        missing = sum(end.status == MISSING for end in ends)
        if not missing and not why:
            reveal(self.folder, kept_salt(self.folder, self.configuration.experiment))
            self.configuration = configuration(self.folder)
        return Made(len(ends) - missing, len(ends), **why)

    def close(self) -> None:
        """Close the answer file and release its lock."""
        if self._kept is not None:
            self._kept.close()
            self._kept = None

    @property
    def answered(self) -> Answered:
        """All stored answers, by case."""
        return read(self.folder)

    def status(self) -> Standing:
        """Return which answers are stored and which are missing."""
        held = self.answered
        ends = []
        for question in self.questions:
            one = held.get(question.name)
            for name in self.settings.diagnosers:
                label = f"{question.name} {name}"
                if name in self.skipped:
                    ends.append(End(label, name, "skipped", self.skipped[name]))
                elif one is not None and not one["item"]:
                    ends.append(End(label, name, "done", "the sensors cannot show it"))
                elif one is None or name not in one["rows"]:
                    ends.append(End(label, name, MISSING))
                else:
                    row = one["rows"][name]
                    ends.append(End(label, name, row["status"], row["reason"]))
        configured = self.configuration
        name = configured.experiment.name
        return Standing(name, "answers given", configured.fingerprint, tuple(ends))

    def finish(self, say: Say) -> int:
        """Write tables, figures and HTML report, and print a summary.

        Args:
            say: prints one line.

        Returns:
            Number of failed answers.
        """
        from bench.diagnosis.report import finish

        return finish(self, say)


class _Asking:
    """Execution of the cases that have missing answers."""

    def __init__(self, study: DiagnosisStudy, kept: Kept, progress: Progress) -> None:
        self._study, self._kept, self._progress = study, kept, progress
        self._experiment = study.configuration.experiment
        self._hidden = tuple(str(place.resolve()) for place in (study.folder, trained()))
        self._salt = kept_salt(study.folder, self._experiment) or self._experiment.salt or PUBLIC
        self._limits = Limits(
            self._experiment.budget, self._experiment.timeout, self._experiment.memory
        )

    def run(self, jobs: int, pool: Pool | None) -> None:
        """Train the diagnosers and collect the missing answers.

        Args:
            jobs: number of worker processes.
            pool: worker pool; None to create one.

        Raises:
            LostError: the workers are no longer available.
        """
        open_questions = [q for q in self._mixed() if self._open(q)]
        if not open_questions:
            return
        # The truths are in the memory of this process, and a diagnoser's process may run as the
        # same user.
        trusted = self._experiment.trusted
        with nullcontext() if trusted else memory_hidden(), pool or pool_of(jobs) as workers:
            examined, taught = self._learn(workers)
            write_lessons(self._study.folder, taught)
            self._ask(workers, open_questions, examined)

    def _mixed(self) -> list[Question]:
        """Return the cases in a fixed random order, so that a partial result is a fair sample."""
        questions = self._study.questions
        order = rng_for("diagnosis", "order", len(questions)).permutation(len(questions))
        return [questions[place] for place in order.tolist()]

    def _open(self, question: Question) -> list[str]:
        """Return the names of the diagnosers that have not answered a case."""
        one = self._kept.answered.get(question.name)
        if one is not None and not one["item"]:
            return []
        rows = one["rows"] if one else {}
        return [name for name in self._study.usable if name not in rows]

    def _learn(self, workers: Pool) -> tuple[dict[str, Examined], list[Taught]]:
        """Train the diagnosers.

        Returns:
            The diagnosers to evaluate, by name, and the costs of their training.
        """
        trusted = self._experiment.trusted
        # The model file of a robot is not known before its case, so no diagnoser can train for it.
        wanted = {question.system for question in self._study.questions}
        systems = sorted(wanted & set(simulators.names()))
        codes = {name: code_of(name) for name in self._study.usable}
        learned = [name for name in codes if diagnosers.get(name).learned]
        pairs = [(name, system) for name in learned for system in systems]
        budget = self._experiment.training_budget
        calls: list[Call] = [
            (
                learn,
                (
                    codes[name],
                    source(diagnosers.get(name)),
                    system,
                    budget,
                    LONGEST_LESSON,
                    self._hidden,
                    trusted,
                ),
            )
            for name, system in pairs
        ]
        files: dict[str, dict[str, Path]] = {name: {} for name in codes}
        taught = []
        step = self._progress("training", len(calls)) if calls else None
        for place, result in workers.results(calls, math.inf) if calls else ():
            name, system = pairs[place]
            if isinstance(result, Learned):
                files[name][system] = result.path
                taught.append(Taught(name, system, result.simulations, result.seconds))
            elif isinstance(result, EndedError | TimeoutError):
                # An untrained diagnoser is evaluated all the same; its answer states what it lacks.
                taught.append(Taught(name, system, 0, 0.0, str(result)))
            else:
                raise result
            if step:
                step()
        examined = {n: Examined(n, code, files[n], trusted) for n, code in codes.items()}
        return examined, taught

    def _ask(
        self, workers: Pool, questions: Sequence[Question], examined: dict[str, Examined]
    ) -> None:
        calls: list[Call] = []
        for question in questions:
            one = self._kept.answered.get(question.name)
            asked = [examined[name] for name in self._open(question)]
            known = one["item"] if one else None
            given = (question.json(), self._study.settings.seed, self._salt, known, asked)
            calls.append((answered, (*given, self._limits, self._hidden)))
        step = self._progress("asking", len(calls))
        longest = _DRAWING + len(examined) * (self._limits.seconds + _DRAWING)
        for place, result in workers.results(calls, longest):
            if isinstance(result, BaseException):
                result = _lost(questions[place], [one.label for one in calls[place][1][4]], result)
            self._kept.add(result)
            step()


def _lost(question: Question, labels: Sequence[str], error: BaseException) -> dict[str, Any]:
    """Make failed answers for a case whose worker died or exceeded its time limit.

    Raises:
        InputError: the worker failed with this error.
    """
    if isinstance(error, InputError):
        raise error
    status = "timeout" if isinstance(error, TimeoutError) else "crashed"
    rows = [
        {
            "question": question.name,
            "diagnoser": label,
            "status": status,
            "reason": str(error),
            "answer": None,
            "simulations": 0,
            "processor_seconds": None,
            "seconds": None,
            "trusted": False,
        }
        for label in labels
    ]
    return {"question": question.name, "item": {"name": question.name}, "rows": rows}


def code_of(name: str) -> Tuned:
    """Return the code location of a diagnoser and the modules to preload for it."""
    kind, place = diagnosers.get(name), diagnosers.place(name)
    module = getattr(kind, "module", "") or kind.__module__
    file = str(place) if place else ""
    own = importlib.util.find_spec(module) if module.startswith("bench.") else None
    # Without preloading, packages that a diagnoser imports would be imported again for each answer.
    ahead = ahead_of(file or (own.origin or "" if own else "")) if file or own else ()
    return Tuned(name, module, file, {}, ahead)


def _refuse_unreachable(names: Sequence[str]) -> None:
    """Reject diagnosers that exist in this process alone: worker processes cannot load them.

    Raises:
        InputError: a diagnoser is a class of a script or notebook.
    """
    for name in names:
        added = diagnosers.snapshot().get(name)
        if added is not None and added.path is None:
            raise unreachable("diagnoser", name, added.part)


def _announced(name: str, trusted: bool) -> None:
    """Register a stub for a diagnoser of another package, without importing its code here.

    Args:
        name: registered name of the diagnoser.
        trusted: whether diagnosers run in this process.

    Raises:
        InputError: the diagnoser does not exist, or its code is already in this process.
    """
    if not trusted and foreign(name, diagnosers):
        try:
            enter([installed(name, "diagnoser")])
        except SkippedError:
            return
    try:
        kind = diagnosers.get(name)
    except SkippedError:
        return
    added = diagnosers.snapshot().get(name)
    if not trusted and added is not None:
        raise InputError(
            f"diagnoser {name}: class {kind.__qualname__} is in this process, where the truths "
            "are: put it into a plugin file, or trust the diagnosers (--trust)"
        )


def _fingerprint(experiment: Experiment, plugins: Sequence[str]) -> dict[str, str]:
    """Compute hashes of everything that must not change while the study is incomplete.

    Returns:
        Hashes by a description for the user.
    """
    public = experiment.chosen(salt="") if experiment.salt_sha256 else experiment
    sources = []
    for name in settings_of(experiment).diagnosers:
        try:
            sources.append(source(diagnosers.get(name)))
        except SkippedError:
            sources.append("skipped")
    return {
        "configuration": digest(experiment.name, public.document()),
        "plugins": plugin_files(plugins),
        "code": rooms(OWN),
        "package versions": versions(),
        "diagnosers": digest(sources),
    }
