"""`simgap explain`: a recording in, a verdict, an extended simulator and a report out. The four
steps in order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from bench.gap.assess import Assessor
from bench.gap.causes.name import Finding, name
from bench.gap.causes.rules import SWITCH
from bench.gap.causes.search import Search
from bench.gap.causes.structure import probes, remains
from bench.gap.cross_validation import CrossValidation
from bench.gap.design import Design, design
from bench.gap.explanation import Explanation
from bench.gap.freeze import frozen
from bench.gap.held_out import HeldOutRuns, Validation
from bench.gap.model.base_fit import Base, fit_base, without_step
from bench.gap.model.crew import Crew
from bench.gap.model.floor import Floor, noise_floor
from bench.gap.model.noise import Noise
from bench.gap.model.watch import STAGES, Watch
from bench.gap.model.world import World
from bench.gap.steps import Coarse, with_numerics
from bench.gap.tell import Teller
from bench.gap.unit_check import Subject, recognised, wrong_units
from bench.gap.verdict import RecordingFault
from bench.problem.seeds import rng_for
from bench.recordings.joined import load_all
from bench.recordings.pieces import cut
from bench.recordings.size import check_recording
from bench.recordings.stamps import refuse_odd
from bench.runs.threads import one_thread
from sims import extended as extend
from sims.base import Array, InputError
from sims.extended import Extended
from sims.recording.recording import Recording, Run
from sims.simulated import Simulated

LEAST = 2.0
"""Samples for each unknown without which nothing can be said."""
SPARE = 4
"""Samples that there must be besides."""
HUGE = 1e9
"""Values so many times a channel's typical size are none."""
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


class _Subject(NamedTuple):
    """What is explained: a recording, what it is taken for if not for what it says, and whether all
    of it is looked at.
    """

    sources: Sequence[Source]
    system: str | None
    model: str | Path | None
    whole: bool
    pieces: float | None


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
        self.recording, kind = load_all(subject.sources, subject.system, subject.model, free)
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
        self.recording, note = cut(self.recording, kind, subject.pieces, subject.whole)
        self.notes = (note,) if note else ()
        for note in self.notes:
            say(note)
        check_recording(self.recording, kind(engine=self.engine), force)
        self.watch = watch
        self.crew = crew
        self.thorough = thorough
        self.free = tuple(free)
        self._enter(kind)
        self.coarse: Coarse | None = None
        self.found: tuple[Search, Finding] | None = None
        self.faults: tuple[RecordingFault, ...] = ()
        self._check()

    def _enter(self, kind: type[Simulated]) -> None:
        """Take the recording for one of this simulator."""
        self.fitting = self._world(kind, self.recording.training())
        self.floor: Floor = noise_floor(self.fitting, self.recording)
        # White to begin with: each likelihood finds the memory of the noise for itself.
        self.noise = Noise(self.floor.sigma, np.zeros(len(self.floor.sigma)))
        self.kind = kind
        self.validation = self._validation(kind)
        self.assessor = self._assessor()

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
        self.watch.stage(STAGES["base_fit"])
        base = self._base()
        if not np.isfinite(base.fit.simulated[np.isfinite(self.fitting.observed)]).all():
            raise self._fails()
        # One stream for surrogates and bootstrap: the same seed tells the same story.
        rng = self._rng()
        search = self._search(base, rng)
        finding = self._finding(search)
        self.watch.stage("measuring the gain")
        verdict = self.assessor.verdict(search, finding, rng, self.started)
        verdict = replace(verdict, recording_faults=self.faults)
        if self.coarse is not None:
            verdict = with_numerics(verdict, self.coarse)
        self.found = search, finding
        story = Teller(self.assessor, search, base, finding, self.notes).story(verdict)
        return Explanation(verdict, story, self._extended(search, finding))

    def _finding(self, search: Search) -> Finding:
        """What the simulator lacks; no cause where the recording states a unit or a sign wrongly,
        which every cause would only imitate.
        """
        base = search.base
        if not self.faults:
            finding = self.assessor.judged(search, name(search, self.validation))
            self.faults = self._imitated(search, finding)
            if not self.faults:
                return finding
        return Finding("unknown", base, base, (), remains(search, base))

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

    def _search(self, base: Base, rng: np.random.Generator) -> Search:
        given = self.fitting, self.noise, base.frozen, rng, self.floor.stated
        search = Search(*given, thorough=self.thorough)
        search.enter(base.fit)
        return search

    def _base(self) -> Base:
        """The base model; of a robot with the step that the data ask for, the file's or a finer
        one.
        """
        base = fit_base(self.fitting, self.noise, self._given())
        if not self.watch.left():
            fault = wrong_units(self._units, self.fitting, self.noise, base)
            self.faults = (fault,) if fault is not None else ()
        if self.faults or not self.kind.has_model:
            return base
        base = self._frozen(self._stepped(base))
        # What is asked about as a cause comes first: it would not be seen afterwards.
        return without_step(self.fitting, self.noise, base)

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
        """The base model with the step that the data ask for; its worlds are the explainer's."""
        # Loaded where there is a robot alone.
        from bench.gap.model.numerics import finer

        coarse = self.kind, self.fitting, self.validation
        value, left = self._judged(base)
        for fine in finer(self.fitting, self.noise):
            # A finer step leaves less: one that is too coarse for what is left is not tried.
            if not fine.suits(left):
                continue
            self._enter(fine.kind)
            other = fit_base(self.fitting, self.noise, self._nearby(base))
            reached, left = self._judged(other)
            gain = reached - value
            if gain < SWITCH:
                # What the robot does is no nearer to its fine motion: the file's own step stands.
                if fine.suits(0.0):
                    break
                left = 0.0
            elif fine.suits(left):
                numerics = fine.numerics
                self.say(f"stepped more finely: {numerics.integrator}, {numerics.timestep:g} s")
                self.coarse = Coarse(fine, gain)
                self.assessor = replace(self.assessor, before=self._before(base, coarse[2]))
                return other
        self._return(*coarse)
        return base

    def _nearby(self, base: Base) -> Array | None:
        """Where a fit of finer steps begins: a step moves the best parameters a little, and its
        fit needs no other starts; None where the coarse one has come to nothing.
        """
        if not np.isfinite(base.fit.cost):
            return self._given()
        nearby: Array = base.fit.theta[self.fitting.base]
        return nearby

    def _before(self, base: Base, validation: Validation | None) -> Array | None:
        """Predict the held-out runs with the file's own step; None without validation."""
        if validation is None:
            return None
        return validation.validate([base.fit])[0].simulated

    def _return(self, kind: type[Simulated], fitting: World, validation: Validation | None) -> None:
        """Go back to worlds that were left."""
        self.kind, self.fitting, self.validation = kind, fitting, validation
        self.assessor = self._assessor()

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
        """Where a registered tuner would begin; None without one."""
        if self.tuner is None:
            return None
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
