"""`simgap explain`: a recording in, a verdict, an extended simulator and a report out. The four
steps in order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from bench.gap.assess import Assessor
from bench.gap.causes.name import Finding, answer, name
from bench.gap.causes.rules import SWITCH
from bench.gap.causes.search import Search
from bench.gap.causes.structure import probes, remains
from bench.gap.cross_validation import CrossValidation
from bench.gap.design import Design, design
from bench.gap.explanation import Explanation
from bench.gap.freeze import frozen
from bench.gap.friction_form import has_dry_friction, is_likelier_soft, soft_kind
from bench.gap.held_out import HeldOutRuns, Validation
from bench.gap.model.base_fit import LAST_STEPS, Base, fit_base, without_step
from bench.gap.model.crew import Crew
from bench.gap.model.fit import Fitter
from bench.gap.model.floor import PRECISION, Floor, noise_floor
from bench.gap.model.models import STEPS
from bench.gap.model.noise import Noise
from bench.gap.model.noise_free import add_least_noise
from bench.gap.model.problem import Start
from bench.gap.model.watch import STAGES, Watch
from bench.gap.model.widen import Bounds, fit_wider, outside, use_bounds
from bench.gap.model.world import World
from bench.gap.steps import (
    Coarse,
    Reusable,
    is_finer_model_better,
    is_finer_step_better,
    with_numerics,
)
from bench.gap.tell import Teller
from bench.gap.unit_check import Subject, recognised, wrong_units
from bench.gap.verdict import RecordingFault
from bench.pages.text import joined
from bench.problem.seeds import rng_for
from bench.recordings.filter_start import leave_out_settling
from bench.recordings.joined import load_all
from bench.recordings.pieces import cut
from bench.recordings.size import check_recording
from bench.recordings.stamps import refuse_odd
from bench.recordings.thinning import thin
from bench.runs.threads import one_thread
from sims import extended as extend
from sims.base import Array, InputError, Simulator
from sims.extended import Extended
from sims.recording.description import read_meta
from sims.recording.recording import Recording, Run
from sims.simulated import Simulated

SOFT_FRICTION = (
    "dry friction has MuJoCo's soft form (solreffriction and solimpfriction of the model file): "
    "it fits better than stiff friction"
)
"""Message to the user where the form of dry friction changes."""
STIFF_FRICTION = "soft dry friction leaves a gap all the same: stiff friction is used"
"""Message to the user where it changes back."""
if TYPE_CHECKING:
    from bench.gap.model.numerics import Finer
    from bench.gap.prediction_error.candidate_responses import FollowedRuns

LEAST = 2.0
"""Samples for each unknown without which nothing can be said."""
SPARE = 4
"""Samples that there must be besides."""
HUGE = 1e9
"""Values so many times a channel's typical size are none."""
EXPLAINED = ("adequate", "named", "ambiguous")
"""Verdicts that leave no more than noise."""
Say = Callable[[str], None]
Source: TypeAlias = str | Path | Recording


def explain(
    recording: Source | Sequence[Source],
    system: str | None = None,
    engine: str = "batch",
    seed: int = 0,
    free: Sequence[str] = (),
    tuner: str | None = None,
    say: Say = lambda _: None,
    force: bool = False,
    watch: Watch | None = None,
    jobs: int = 1,
    model: str | Path | None = None,
    whole: bool = False,
    pieces: float | None = None,
    thorough: bool = False,
) -> Explanation:
    """Explain a recording.

    Args:
        recording: the path of the table, or a recording that is in memory; of several, their runs
            are explained together.
        system: take it for this system, whatever the description says.
        engine: pybullet, mujoco or batch; a simulator that steps itself has its own.
        seed: of the surrogates and the bootstrap.
        free: constants to estimate with the parameters.
        tuner: a registered tuner that finds where the fit of the base parameters begins.
        say: told what the user should know of the recording and of the base model.
        force: whether the user insists on a recording that is refused otherwise.
        watch: says when the search has to end, and is told how far it is.
        jobs: processes that work at once; the answer does not depend on it.
        model: take it for this robot, whatever the description says: a model file.
        whole: look at all of a long recording of a robot, not at pieces of it.
        pieces: seconds of the pieces that runs are cut into; None where they are not.
        thorough: search on where causes are left over, with the held-out runs as judges.

    Raises:
        InputError: the recording cannot be read, is too short, or is of nothing that takes effects;
            or the search was ended before anything could be simulated.
    """
    with closing(Crew(jobs)) as crew:
        sources = [recording] if isinstance(recording, Source) else list(recording)
        subject = _Subject(sources, system, model, whole, pieces)
        given = engine, seed, tuple(free), tuner, say, force
        explainer = _Explainer(subject, *given, watch or Watch(), crew, thorough)
        with closing(explainer):
            return explainer.run()


def _added_noise(channels: Sequence[str]) -> str:
    """What is to be said of channels to which noise was added; empty where there are none."""
    if not channels:
        return ""
    return (
        f"no noise is found in {joined(channels)}: white noise of {PRECISION:g} of the range is "
        "added, the accuracy of a simulation; smaller differences are not explained"
    )


class Proposed(NamedTuple):
    """An explanation, and the recording that would say more; None where no run would."""

    explanation: Explanation
    design: Design | None


def explain_and_design(
    recording: Source | Sequence[Source],
    seconds: float,
    longest: float,
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
    say: Say = lambda _: None,
    watch: Watch | None = None,
    jobs: int = 1,
) -> Proposed:
    """Explain recordings, and design the next one, of so many seconds, or up to `longest` where
    these do not settle it; the other arguments are those of `explain`.
    """
    with closing(Crew(jobs)) as crew:
        sources = [recording] if isinstance(recording, Source) else list(recording)
        subject = _Subject(sources, system, model, whole=False, pieces=None)
        given = "batch", 0, tuple(free), None, say, False
        with closing(_Explainer(subject, *given, watch or Watch(), crew)) as explainer:
            explanation = explainer.run()
            explainer.watch.stage("designing the next recording")
            return Proposed(explanation, explainer.design(seconds, longest))


def _without_inactive_drives(recording: Recording, kind: type[Simulator]) -> Recording:
    """Switch off or leave out what a robot's drives do nothing about."""
    if not kind.has_model:
        return recording
    # Loaded where there is a robot alone.
    from bench.gap.prediction_error.inactive_drives import without_inactive_drives

    return without_inactive_drives(recording, kind)


class _Subject(NamedTuple):
    """What is explained: a recording, what it is taken for if not for what it says, and whether all
    of it is looked at.
    """

    sources: Sequence[Source]
    system: str | None
    model: str | Path | None
    whole: bool
    pieces: float | None


class _Worlds(NamedTuple):
    """A simulator with one step, and its runs for fitting and for measuring."""

    kind: type[Simulated]
    fitting: World
    validation: Validation | None


class _Found(NamedTuple):
    """An answer: the base model, the search from it, what that found, and its random numbers."""

    base: Base
    search: Search
    finding: Finding
    rng: np.random.Generator


class _Explainer:
    def __init__(
        self,
        subject: _Subject,
        engine: str,
        seed: int,
        free: tuple[str, ...],
        tuner: str | None,
        say: Say,
        force: bool,
        watch: Watch,
        crew: Crew,
        thorough: bool = False,
    ) -> None:
        self.started = time.perf_counter()
        self.seed = seed
        self.tuner = tuner
        self.say = say
        self.recording, kind = load_all(
            subject.sources, subject.system, subject.model, free, _without_inactive_drives
        )
        self.path = self.recording.path
        if not issubclass(kind, Simulated):
            raise self._takes_no_effects()
        # The effects that it holds already could not be chosen again.
        extend.refuse_extended(kind)
        # A simulator that steps itself has no engine to choose.
        usual = kind.default_engine if kind.has_model else None
        self.engine = usual if kind.own_engine else engine
        # What is free of a robot is a number of its file, and a parameter of its simulator.
        free = () if kind.has_model else free
        # Before the worlds, which plan every step of every run.
        for odd in refuse_odd(self.recording, kind, force):
            say(f"{self.path}: {odd}")
        self.recording, thinned = thin(self.recording, kind)
        self.recording, settled = leave_out_settling(self.recording, kind)
        self.recording, note = cut(self.recording, kind, subject.pieces, subject.whole)
        recorded = self.recording.runs[0].channels
        names = [channel.name for channel in kind.channels if channel.name in recorded]
        self.recording, quiet = add_least_noise(self.recording, names)
        said = thinned, settled, note, _added_noise(quiet)
        self.notes = tuple(text for text in said if text)
        for note in self.notes:
            say(note)
        check_recording(self.recording, kind(engine=self.engine), force)
        self.watch = watch
        self.force = force
        self.crew = crew
        self.thorough = thorough
        self.free = tuple(free)
        # By name the declared range of a base parameter and the wider one that it was given.
        self.wider: dict[str, tuple[Bounds, Bounds]] = {}
        # Base parameters of a robot that prediction errors give, where the fit begins.
        self.identified: Array | None = None
        self._enter(kind)
        left_out = [
            f"{effect} is not tested: {why}" for effect, why in kind.system.left_out.items()
        ]
        for line in left_out:
            say(line)
        self.notes = (*self.notes, *left_out)
        self.coarse: Coarse | None = None
        # Finer steps that differ from the file's, and the worlds of the file's where one is used.
        self.finer: Reusable[Finer] | None = None
        self.file = _Worlds(self.kind, self.fitting, self.validation)
        self.found: tuple[Search, Finding] | None = None
        self.faults: tuple[RecordingFault, ...] = ()
        self._check()

    def _enter(self, kind: type[Simulated]) -> None:
        """Take the recording for one of this simulator."""
        before = self._followed()
        self.fitting = self._world(kind, self.recording.training())
        self.floor: Floor = noise_floor(self.fitting, self.recording)
        # White to begin with: each likelihood finds the memory of the noise for itself.
        self.noise = Noise(self.floor.sigma, np.zeros(len(self.floor.sigma)))
        self.kind = kind
        self.validation = self._validation(kind)
        self.assessor = self._assessor()
        for known, world in zip(before, self._worlds(), strict=False):
            # Where the runs begin depends little on how they are stepped.
            world.follow(known)

    def _worlds(self) -> list[World]:
        """The runs for fitting, and those held out."""
        validation = self.validation
        held_out = validation.world if isinstance(validation, HeldOutRuns) else None
        return [self.fitting] if held_out is None else [self.fitting, held_out]

    def _followed(self) -> list[FollowedRuns]:
        """Runs of a robot as a filter follows them, if it does."""
        if not hasattr(self, "fitting"):
            return []
        return [w.followed for w in self._worlds() if w.followed is not None]

    def _validation(self, kind: type[Simulated]) -> Validation | None:
        """Prepare the validation: on held-out runs, else by cross-validation of few runs."""
        if held_out := self.recording.held_out():
            # The same effects in the same places, so that a fitted vector means the same there.
            return HeldOutRuns(self._world(kind, held_out), self.noise)
        if len(self.recording.folds()) > 1:
            return CrossValidation(self.fitting, self.noise)
        return None

    def _assessor(self) -> Assessor:
        given = self.recording, self.fitting, self.validation, self.floor, self.engine
        return Assessor(*given)

    def _world(self, kind: type[Simulated], runs: Sequence[Run]) -> World:
        world = World(kind, self.recording, runs, self.engine, probes(kind), self.free)
        world.watch = self.watch
        world.crew = self.crew
        self.crew.join(world)
        use_bounds(world, {name: bounds for name, (_, bounds) in self.wider.items()})
        world.identified = self.identified
        return world

    def _takes_no_effects(self) -> InputError:
        return InputError(
            f"{self.path}: simulator {self.recording.system} takes no effects, "
            "so nothing can be missing from it"
        )

    def _check(self) -> None:
        world = self.fitting
        # Fewer samples than unknowns are followed exactly, whatever the model: no gap would show.
        samples = int(np.isfinite(world.observed).sum())
        unknowns = world.base.size + int((~world.known).sum())
        if samples < LEAST * unknowns + SPARE:
            least = int(LEAST * unknowns) + SPARE
            raise InputError(
                f"{self.path}: too short: {samples} samples for fitting, "
                f"expected at least {least} for {unknowns} parameters and initial states"
            )
        # What is larger by so many orders is of a wrong unit, and nothing that a fit could follow.
        measuring = self.assessor.measuring
        parts = [part.observed for part in (world, measuring) if part is not None]
        for c, channel in enumerate(world.simulator.channels):
            largest = max(float(np.nanmax(np.abs(part[..., c]), initial=0.0)) for part in parts)
            if largest >= HUGE * channel.scale:
                raise InputError(
                    f"{self.path}: column {channel.name}: expected values of about "
                    f"{channel.scale:g} {channel.unit}, found {largest:.3g}; is the unit right?"
                )

    # Small products: with a thread for each core they take five times as long where others compute.
    @one_thread()
    def run(self) -> Explanation:
        self._refuse_broken_conventions()
        self.watch.stage(STAGES["base_fit"])
        base = self._base()
        if not np.isfinite(base.fit.simulated[np.isfinite(self.fitting.observed)]).all():
            raise self._fails()
        found = self._searched(base)
        found = self._with_better_step(found.search, found.finding) or found
        base, search, finding, rng = found
        self.watch.stage("measuring the gain")
        verdict = self.assessor.verdict(search, finding, rng, self.started)
        verdict = replace(
            verdict, recording_faults=self.faults, recording_notes=self.recording.notes
        )
        if self.coarse is not None:
            verdict = with_numerics(verdict, self.coarse)
        self.found = search, finding
        notes = (*outside(self.fitting, finding.model.fit.theta, self.wider), *self.notes)
        story = Teller(self.assessor, search, base, finding, notes).story(verdict)
        return Explanation(verdict, story, self._extended(search, finding))

    def _searched(self, base: Base) -> _Found:
        """Search and judge; again with MuJoCo's soft dry friction where the data show it."""
        # One stream for surrogates and bootstrap: the same seed tells the same story.
        rng = self._rng()
        search = self._search(base, rng)
        if not self.kind.has_model:
            return _Found(base, search, self._finding(search), rng)
        # Loaded where there is a robot alone.
        from bench.gap.prediction_error.dry_friction import SoftFrictionError

        stiff = _Worlds(self.kind, self.fitting, self.validation)
        try:
            found = _Found(base, search, self._finding(search), rng)
            # A search does not select dry friction that is a free number.
            is_free = has_dry_friction(self.fitting, ())
            done = self.watch.left() or bool(self.faults) or not is_free
            if done or not is_likelier_soft(search, found.finding.model, SWITCH):
                return found
            return self._searched_soft(base, search)
        except SoftFrictionError as error:
            soft = self._searched_soft(base, search, error.start)
            if not error.is_preliminary or self._is_explained(soft) or self.watch.left():
                return soft
        self.say(STIFF_FRICTION)
        before = self.assessor.before
        self._return(stiff, before)
        again = self._search(base, rng, is_form_given=True)
        try:
            return _Found(base, again, self._finding(again), rng)
        except SoftFrictionError as error:
            return self._searched_soft(base, search, error.start)

    def _refuse_broken_conventions(self) -> None:
        """Refuse a robot's recording whose conventions differ from those of its model file.

        Raises:
            InputError: they do; the message says what to change.
        """
        if not self.kind.has_model or self.force:
            return
        # Loaded where there is a robot alone.
        from bench.gap.conventions.comparison import ConventionComparison
        from bench.gap.conventions.corrected_description import lines_of

        self.watch.stage("comparing conventions of log and model")
        differences = ConventionComparison(self._units).differences()
        if not differences:
            return
        remedy = "correct these signals"
        if self.recording.path.with_suffix(".toml").exists():
            _, meta = read_meta(self.recording.path)
            lines = "; ".join(lines_of(meta, self.kind, differences))
            remedy = (
                f"set {lines} in {self._units.file}, or write a corrected description: "
                f"simgap inspect {self.path.name} --fix NAME.toml"
            )
        what = "; ".join(one.description for one in differences)
        raise InputError(
            f"{self.path}: {what}; expected the conventions of the model file: {remedy} "
            "(--force explains the log as it is)"
        )

    @staticmethod
    def _is_explained(found: _Found) -> bool:
        """Whether an answer leaves no more than noise."""
        return found.finding.verdict in EXPLAINED

    def _searched_soft(self, base: Base, before: Search, likely: Start | None = None) -> _Found:
        """Search and judge with MuJoCo's soft dry friction.

        Args:
            base: the base model.
            before: the search with stiff friction.
            likely: a model that may explain the runs.
        """
        # Loaded where there is a robot alone.
        from bench.gap.prediction_error.search import PredictionErrorSearch

        self.say(SOFT_FRICTION)
        held_out = self.assessor.before
        self._enter(soft_kind(self.kind))
        self.assessor = replace(self.assessor, before=held_out)
        fitter = Fitter(self.fitting, self.noise, base.frozen)
        start = replace(base.fit.start(), states=self.fitting.guess)
        (fit,) = fitter.fit([start], LAST_STEPS)
        base = self._without_step(replace(base, fit=fit))
        rng = self._rng()
        search = self._search(base, rng)
        if isinstance(search, PredictionErrorSearch) and isinstance(before, PredictionErrorSearch):
            search.likely = likely
            robot: Any = self.kind
            if not robot.robot.compiled.dof_frictionloss.any():
                search.take_over(before)
        return _Found(base, search, self._finding(search), rng)

    def _answered(self, base: Base) -> _Found:
        """The answer from a base model that was fitted with another step."""
        return self._searched(self._settled(base))

    def _finding(self, search: Search) -> Finding:
        """What the simulator lacks; no cause where the recording states a unit or a sign wrongly,
        which every cause would only imitate.
        """
        base = search.base
        if not self.faults:
            finding = self.assessor.judged(search, self._named(search))
            self.faults = self._imitated(search, finding) or self._unexplained(search, finding)
            if not self.faults:
                return finding
        return Finding("unknown", base, base, (), remains(search, base))

    def _named(self, search: Search) -> Finding:
        """Answer the questions about a recording; about a robot's by prediction errors."""
        if self.fitting.followed is None:
            return name(search, self.validation)
        # Loaded where there is a robot alone.
        from bench.gap.prediction_error.confirmation import Confirmation

        return answer(Confirmation(search, self.validation))

    def _unexplained(self, search: Search, finding: Finding) -> tuple[RecordingFault, ...]:
        """Wrong units and signs of a robot's recording that no effect explains."""
        explained = finding.verdict in EXPLAINED
        if not self._asks_units_late or explained or self.watch.left():
            return ()
        base = Base(search.base.fit, frozenset(search.frozen))
        fault = wrong_units(self._units, self.fitting, self.noise, base)
        return () if fault is None else (fault,)

    def _imitated(self, search: Search, finding: Finding) -> tuple[RecordingFault, ...]:
        """Wrong units and signs that causes stand for."""
        found = [
            recognised(self._units, self.fitting, cause, search.base.fit)
            for cause in self.assessor.causes(search, finding)
        ]
        return tuple(fault for fault in found if fault is not None)

    @property
    def _units(self) -> Subject:
        """What the check of units looks at."""
        return Subject(self.kind, self.recording, self.engine, self.free)

    def close(self) -> None:
        """Let go of what simulates; not earlier, since experiments are proposed by simulating."""
        self.fitting.close()
        if self.validation is not None:
            self.validation.close()

    def design(self, seconds: float, longest: float) -> Design | None:
        """The next recording, after `run`: that which splits the first set of causes that is open,
        else that which narrows the numbers of what stands.
        """
        if self.found is None:
            return None
        search, finding = self.found
        for cause in finding.causes:
            rest = {name for name in finding.model.names if name != cause.effect}
            keys = [frozenset({*rest, other}) for other in cause.alternatives]
            rivals = [search.models[key] for key in keys if key in search.models]
            if rivals:
                return design(search, finding.model, rivals, seconds, longest)
        return design(search, finding.model, (), seconds, longest)

    def _search(self, base: Base, rng: np.random.Generator, **attributes: Any) -> Search:
        """Begin a search, by prediction errors where the simulator can be linearised."""
        kind = Search
        if self.fitting.followed is not None:
            # Loaded where there is a robot alone.
            from bench.gap.prediction_error.search import PredictionErrorSearch

            kind = PredictionErrorSearch
        given = self.fitting, self.noise, base.frozen, rng, self.floor.stated
        search = kind(*given, thorough=self.thorough, **attributes)
        search.enter(base.fit)
        return search

    def _base(self) -> Base:
        """The base model; of a robot with the step that the data ask for, the file's or a finer
        one.
        """
        if self.kind.has_model:
            self._follow()
        base = fit_base(self.fitting, self.noise, self._given())
        if self._asks_units_late:
            return self._prepared(base)
        if not self.watch.left():
            fault = wrong_units(self._units, self.fitting, self.noise, base)
            self.faults = (fault,) if fault is not None else ()
        if self.faults:
            return base
        return self._prepared(base) if self.kind.has_model else self._within_range(base)

    @property
    def _asks_units_late(self) -> bool:
        """Whether units are questioned where no effect explains the gap, as those of a robot's
        recording are unless its free numbers could not be identified.
        """
        lost = self.free_numbers and self.identified is None and self.fitting.followed is not None
        return self.kind.has_model and not lost

    @property
    def free_numbers(self) -> bool:
        """Whether the base model has parameters."""
        return bool(self.fitting.base.size)

    def _follow(self) -> None:
        """Estimate where the runs of a robot begin, by a filter with the model as it stands."""
        # Loaded where there is a robot alone.
        from bench.gap.prediction_error.candidate_responses import FollowedRuns

        self.watch.stage("following the runs with the model")
        world, *held_out = self._worlds()
        followed = FollowedRuns.follow(world, world.nominal(), self.noise)
        # Where the linear model diverges, causes are searched by simulation.
        if not followed.is_sound:
            return
        if self.free_numbers and self.tuner is None:
            followed = self._identified(followed)
        world.follow(followed)
        for world in held_out:
            # Held-out runs are simulated alone, and begin at their readings without a filter.
            found = FollowedRuns.follow(world, world.nominal(), self.noise)
            if found.is_sound:
                world.follow(found)

    def _identified(self, followed: FollowedRuns) -> FollowedRuns:
        """The runs, filtered with base parameters that are identified by prediction errors."""
        # Loaded where there is a robot alone.
        from bench.gap.prediction_error.likelihood_fit import identify_base

        world = self.fitting
        declared = {p.name: p.bounds for p in world.parameters}
        found, wider = identify_base(world, self.noise, followed)
        if found is not followed:
            self.identified = world.identified = found.theta[world.base]
        self._widen(wider, declared)
        return found

    def _widen(self, found: Mapping[str, Bounds], declared: Mapping[str, Bounds]) -> None:
        """State the wider ranges of base parameters, and use them for all runs."""
        for world in self._worlds()[1:]:
            use_bounds(world, found)
        for parameter, (low, high) in found.items():
            self.say(f"{parameter} ends at a bound of its range: widened to {low:g} to {high:g}")
        self.wider |= {one: (declared[one], bounds) for one, bounds in found.items()}

    def _prepared(self, base: Base) -> Base:
        """The base model of a robot with the step that the data ask for, and without free numbers
        that they cannot fix.
        """
        if self._shows_steps(base):
            base = self._stepped(base)
        return self._settled(base)

    def _shows_steps(self, base: Base) -> bool:
        """Whether the recording shows what the engine's steps miss."""
        lost = self.fitting.followed is None or not np.isfinite(base.fit.cost)
        if self.watch.left() or lost:
            return True
        # Loaded where there is a robot alone.
        from bench.gap.prediction_error.candidate_responses import FollowedRuns
        from bench.gap.prediction_error.identification import shows_step_errors

        return shows_step_errors(FollowedRuns.of_model(self.fitting, base.fit.theta, self.noise))

    def _without_step(self, base: Base) -> Base:
        """The base model without the errors of the engine's steps, where the recording shows them
        or no filter could tell.
        """
        # Loaded where there is a robot alone.
        from bench.gap.prediction_error.identification import shows_step_errors

        followed = self.fitting.followed
        if followed is not None and not shows_step_errors(followed):
            return base
        return without_step(self.fitting, self.noise, base)

    def _settled(self, base: Base) -> Base:
        """The base model of a robot whose step is chosen."""
        base = self._frozen(self._within_range(base))
        # What is asked about as a cause comes first: it would not be seen afterwards.
        return self._without_step(base)

    def _within_range(self, base: Base) -> Base:
        """The base model with wider ranges for parameters that its fit leaves at a bound."""
        declared = {p.name: p.bounds for p in self.fitting.parameters}
        declared |= {name: bounds for name, (bounds, _) in self.wider.items()}
        base, found = fit_wider(self.fitting, self.noise, base)
        self._widen(found, declared)
        return base

    def _frozen(self, base: Base) -> Base:
        """The base model without free numbers of the robot that the data cannot fix.

        A system has few parameters, and without them nothing is told: there the verdict says so.
        """
        if self.watch.left() or not np.isfinite(base.fit.cost):
            return base
        kept = frozen(self.fitting, self.noise, base, lambda base: self._search(base, self._rng()))
        if kept.vague:
            names = ", ".join(self.fitting.parameters[i].name for i in sorted(kept.vague))
            self.say(f"frozen, as the recording cannot fix it beside the others: {names}")
        return kept

    def _stepped(self, base: Base) -> Base:
        """The base model with the step that closes a large part of its gap alone: the file's own,
        or a finer one. Its worlds are the explainer's.
        """
        # Loaded where there is a robot alone.
        from bench.gap.model.numerics import finer

        self.finer = Reusable(finer(self.fitting, self.noise))
        file = _Worlds(self.kind, self.fitting, self.validation)
        value, left = self._judged(base)
        gap = left - 1.0
        for fine in self.finer:
            # A finer step leaves less: one that is too coarse for what is left is not tried.
            if not fine.suits(left):
                continue
            self._enter(fine.kind)
            if self.fitting.followed is None:
                # A model that diverges with the file's step may be followed with a finer one.
                self._follow()
            other = fit_base(self.fitting, self.noise, self._nearby(base))
            reached, left = self._judged(other)
            if not is_finer_step_better(reached - value, gap, left - 1.0):
                # Another missing effect may bend either model: both are compared again with it.
                if fine.suits(0.0):
                    break
                left = 0.0
            elif fine.suits(left):
                self._use_finer(fine, reached - value, base, file)
                return other
        self._return(file)
        return base

    def _use_finer(self, fine: Finer, gain: float, base: Base, file: _Worlds) -> None:
        """State that the file's own step is at fault; the worlds are those of the finer one."""
        numerics = fine.numerics
        self.say(f"stepped more finely: {numerics.integrator}, {numerics.timestep:g} s")
        self.coarse, self.file = Coarse(fine, gain), file
        self.assessor = replace(self.assessor, before=self._before(base, file.validation))

    def _with_better_step(self, search: Search, finding: Finding) -> _Found | None:
        """The answer with another step, where that explains the data better with the effects of
        this answer or with some of them; None where this step stands.

        A missing effect can make either step look better, and effects can imitate a step, so the
        first choice is preliminary. Models are compared by merit and residual, and a finer step
        must be clearly better: data that MuJoCo made with the file's own step must
        not be explained by another.
        """
        if self.finer is None or self.faults or finding.cut is not None or self.watch.left():
            return None
        if not finding.causes and (self.coarse is not None or finding.verdict == "adequate"):
            return None
        found = finding.model.merit, search.excess(finding.model)
        here = _Worlds(self.kind, self.fitting, self.validation)
        if self.coarse is not None:
            before = self.assessor.before
            self._return(self.file)
            if not is_finer_model_better(self._best(search, finding), found):
                self.say("the model file's own step explains the data as well: it is used")
                self.coarse = None
                base = Base(search.base.fit, search.frozen)
                return self._answered(fit_base(self.fitting, self.noise, self._nearby(base)))
            self._return(here, before)
            return None
        fine = next((one for one in self.finer or () if one.suits(0.0)), None)
        if fine is None:
            return None
        self._enter(fine.kind)
        best = self._best(search, finding)
        if not is_finer_model_better(found, best):
            self._return(here)
            return None
        base = Base(search.base.fit, search.frozen)
        other = fit_base(self.fitting, self.noise, self._nearby(base))
        self._use_finer(fine, best[0] - found[0], base, here)
        return self._answered(other)

    def _best(self, search: Search, finding: Finding) -> tuple[float, float]:
        """Merit and excess over the noise of the best model with some or all effects of a finding,
        fitted with the step of the present worlds.
        """
        names, fit = finding.model.names, finding.model.fit
        slots = self.fitting.slots
        starts = []
        for count in range(len(names) + 1):
            for some in combinations(names, count):
                theta = fit.theta.copy()
                for left_out in set(names) - set(some):
                    theta[slots[left_out]] = self.fitting.nominal()[slots[left_out]]
                starts.append(Start(some, theta, fit.states))
        fits = Fitter(self.fitting, self.noise, search.frozen).fit(starts, STEPS)
        models = self._search(Base(search.base.fit, search.frozen), self._rng())
        best = max((models.enter(one) for one in fits), key=lambda model: model.merit)
        return best.merit, models.excess(best)

    def _nearby(self, base: Base) -> Array | None:
        """Where a fit of finer steps begins: a step moves the best parameters a little, and its
        fit needs no other starts; None where the coarse one has come to nothing.
        """
        if not np.isfinite(base.fit.cost) or self.identified is not None:
            return self._given()
        nearby: Array = base.fit.theta[self.fitting.base]
        return nearby

    def _before(self, base: Base, validation: Validation | None) -> Array | None:
        """Predict the held-out runs with the file's own step; None without validation."""
        if validation is None:
            return None
        return validation.validate([base.fit])[0].simulated

    def _return(self, worlds: _Worlds, before: Array | None = None) -> None:
        """Go back to worlds that were left."""
        self.kind, self.fitting, self.validation = worlds
        self.assessor = replace(self._assessor(), before=before)

    def _judged(self, base: Base) -> tuple[float, float]:
        """Twice the log likelihood of a base model, and what it leaves, RMS in units of the
        noise.
        """
        found = self._search(base, self._rng())
        return float(found.base.likelihood.value), 1.0 + found.excess(found.base)

    def _rng(self) -> np.random.Generator:
        return rng_for("explain", self.recording.system, self.seed)

    def _fails(self) -> InputError:
        """Why nothing could be simulated."""
        if self.faults:
            return InputError(f"{self.path}: {self.faults[0].says}")
        if self.watch.left():
            return InputError(
                f"{self.path}: the search was ended before a fit could follow the recording"
            )
        return InputError(
            f"{self.path}: the simulation fails wherever a fit begins; "
            "check constants, units, inputs and initial states"
        )

    def _given(self) -> Array | None:
        """Base parameters with which a fit begins: those of a registered tuner, or those that are
        identified by prediction errors; None where there are none.
        """
        if self.tuner is None:
            return self.identified
        # Loaded here alone: few ask for a tuner, and what drives one is much to load.
        from bench.gap.model.tuner_start import tuned

        return tuned(self.tuner, self.fitting, self.noise, self.seed)

    def _extended(self, search: Search, finding: Finding) -> Extended:
        world, numbers = self.fitting, self.assessor.numbers(search, finding.model)
        own = {p.name: numbers[i] for i, p in enumerate(world.parameters[: world.own])}
        # A freed constant is a constant of the extended simulator, with the value that was fitted.
        freed = {p.name: numbers[world.own + i].value for i, p in enumerate(world.freed)}
        added = {}
        # In the simulator's order, so that the file does not hang on how the search went.
        for effect, slot in world.slots.items():
            if effect not in finding.model.names:
                continue
            coefficients = world.effects[effect].on(world.simulator.system)
            places = range(*slot.indices(len(world.parameters)))
            added[effect] = {
                coefficient.name: numbers[place]
                for coefficient, place in zip(coefficients, places, strict=True)
            }
        return Extended(
            extend.name_of(self.recording.system),
            self.recording.system,
            self.engine,
            self.recording.title,
            own,
            added,
            {**self.recording.constants, **freed},
            world.channels,
            self.kind,
            extend.robot_of(self.kind),
        )
