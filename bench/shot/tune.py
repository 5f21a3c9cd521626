"""From the recording of a drop to tuned models and planned shots. Nothing in here knows the ball
that was dropped.

The models are those of the tuners, in the simulator as it is and in the one that `explain` extended
from the same recording, and `explain`'s own fit. Heights are shifted as if every ball had the
radius of the experiment, so that a network trained once serves all; tuners on vision get pixel rows
instead (`bench.shot.rows`).
"""

from __future__ import annotations

import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from bench.problem.experiment import Entry, Experiment
from bench.problem.recorded import Side, scenario_of
from bench.problem.targets import SealedTarget
from bench.runs.worker import Order, perform, problem_of
from bench.sealing.outside import Tuned
from bench.sealing.outside import moved as elsewhere
from bench.shot.rows import before_a_camera, rows_of
from bench.shot.settings import Settings
from sims.ball.simulator import Ball as BallSimulator
from sims.base import Array, InputError, Scenario
from sims.recording.recording import Recording, read_recording
from sims.shot.planner import Plan, plan
from sims.shot.scene import ShotScene
from sims.shot.simulator import BounceShot
from sims.shot.system import ShotSystem

NOMINAL = "nominal"
"""The method that tunes nothing."""
EXPLAINED = "explain"
"""The method that takes explain's own fit."""
AFTER = " + explain"
"""Behind the label of a tuner that tunes the simulator that explain extended."""
Effects = Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class TunedModel:
    """A tuned simulator and the shot planned in it.

    Attributes:
        method: label.
        restitution: tuned.
        effects: coefficients of the effects it was extended with and that act on the shot.
        simulations: used on this target.
        seconds: taken.
        status: as in status.csv; ``no plan`` where the model reaches the hoop from no height.
        reason: in words.
        height: planned drop height, m; NaN where there is none.
        margin: to the rim, as planned, m.
    """

    method: str
    restitution: float
    effects: Effects
    simulations: int
    seconds: float
    status: str
    reason: str = ""
    height: float = float("nan")
    margin: float = float("nan")


@dataclass(frozen=True)
class Known:
    """What a method gets of a shot.

    Attributes:
        name: of the shot.
        recording: of the ball's drop.
        scene: incline and hoop.
        weights: files of trained weights, by tuner.
        tuned: which tuner lives in a process of its own, by label.
        hidden: folders that it must not reach.
    """

    name: str
    recording: Path
    scene: ShotScene
    weights: Mapping[str, Path]
    tuned: Mapping[str, Tuned] = field(default_factory=dict)
    hidden: tuple[str, ...] = ()

    def files(self) -> tuple[Path, ...]:
        """What must travel with it to another machine."""
        plugins = {Path(tuned.file) for tuned in self.tuned.values() if tuned.file}
        described = self.recording.with_suffix(".toml")
        return self.recording, described, *self.weights.values(), *sorted(plugins)

    def moved(self, places: Mapping[Path, Path]) -> Known:
        """The same where its files have other places."""
        weights = {label: places[path] for label, path in self.weights.items()}
        tuned = {label: elsewhere(one, places) for label, one in self.tuned.items()}
        return replace(self, recording=places[self.recording], weights=weights, tuned=tuned)


def models(experiment: Experiment, settings: Settings, known: Known) -> list[dict[str, Any]]:
    """Every method's model and plan, as plain dictionaries."""
    recording = read_recording(known.recording, BallSimulator, whole=True)
    made = [TunedModel(NOMINAL, _nominal(), {}, 0, 0.0, "done")]
    made += [
        _tuned(experiment, settings, entry, known, recording, {}) for entry in experiment.tuners
    ]
    explained, acting = _explained(known.recording)
    made.append(explained)
    # What explain could not extend cannot be tuned in its extension.
    if explained.status == "done":
        again = [
            _tuned(experiment, settings, entry, known, recording, acting)
            for entry in experiment.tuners
        ]
        made += [
            replace(model, method=model.method + AFTER, effects=explained.effects)
            for model in again
        ]
    radius = _constants(recording)["radius"]
    return [asdict(_planned(model, settings, known.scene, radius)) for model in made]


def _nominal() -> float:
    return BallSimulator.system.parameters[0].nominal


def _tuned(
    experiment: Experiment,
    settings: Settings,
    entry: Entry,
    known: Known,
    recording: Recording,
    effects: Effects,
) -> TunedModel:
    """The model of a tuner, in the simulator with these effects."""
    label, radius = entry.label, _constants(recording)["radius"]
    experiment = tuned_in(experiment, settings, entry)
    if effects:
        fixed = {name: list(values) for name, values in effects.items()}
        experiment = experiment.chosen(settings={**experiment.settings, "fixed": fixed})
    try:
        problem = problem_of(experiment)
        start = problem.cube.inverse(np.array([p.nominal for p in problem.cube.parameters]))
        seen = (
            rows_of(recording, experiment, radius)
            if label in settings.rows
            else _side(recording, experiment)
        )
        nothing = Side((), np.empty((0, seen.observed.shape[1])))
        target = SealedTarget(known.name, "real", start, seen, nothing)
        order = Order(
            label,
            entry,
            0,
            target,
            entry.budget or experiment.budget,
            known.weights.get(entry.label),
            known.tuned.get(entry.label),
            known.hidden,
        )
        outcome = perform(experiment, order)
    except InputError as error:
        return TunedModel(label, _nominal(), {}, 0, 0.0, "crashed", str(error))
    trace = outcome.trace
    found = float(problem.cube.physical(trace.recommendations[-1])[0])
    return TunedModel(
        label, found, {}, len(trace.losses), outcome.seconds, trace.status, trace.reason
    )


def tuned_in(experiment: Experiment, settings: Settings, entry: Entry) -> Experiment:
    """The experiment as a tuner gets it: heights, or simulated heights and pixel rows."""
    return before_a_camera(experiment, settings) if entry.label in settings.rows else experiment


def _side(recording: Recording, experiment: Experiment) -> Side:
    """The recorded run as the experiment's simulator sees it: let go at rest at time 0, whenever it
    is seen first.
    """
    (run,) = recording.runs
    scenario = scenario_of(run, BallSimulator(observe=["z"]), recording.constants)
    # As if the ball had the experiment's radius: one network serves balls of all sizes.
    radius = experiment.fixed["radius"]
    shift = radius - _constants(recording)["radius"]
    z = run.channels["z"] + shift
    seen = run.channels["z"][np.isfinite(run.channels["z"])]
    # Let go at rest at t = 0, it has the speed g t when it is seen first.
    fallen = scenario.constants.get("gravity", _constants(recording)["gravity"]) * float(
        run.times[0]
    )
    first = {"z": float(seen[0]), "vz": -fallen, **scenario.initial}
    initial = {**first, "z": first["z"] + shift}
    moved = Scenario(scenario.times, initial, {}, {**scenario.constants, "radius": radius})
    return Side((moved,), z[:, None])


def _constants(recording: Recording) -> dict[str, float]:
    """Of the recorded run, the system's where the recording states none."""
    return {**BallSimulator().constant_values, **recording.constants, **recording.runs[0].constants}


def _explained(recording: Path) -> tuple[TunedModel, Effects]:
    """The model of explain, with the effects that act on the shot, and all that it found."""
    from bench.gap.explain import explain

    started = perf_counter()
    try:
        found = explain(recording)
    except Exception:  # a failure of one method is a row of the table
        last = traceback.format_exc()
        return TunedModel(
            EXPLAINED, _nominal(), {}, 0, perf_counter() - started, "crashed", last
        ), {}
    acting = {
        name: tuple(number.value for number in numbers.values())
        for name, numbers in found.extended.effects.items()
    }
    carried = carry(acting, found.extended.constants.get("gravity", 9.81))
    reason = f"{found.verdict}: {', '.join(acting) or 'nothing'}"
    restitution = found.extended.parameters["restitution"].value
    seconds = perf_counter() - started
    simulations = found.answer.simulations
    model = TunedModel(EXPLAINED, restitution, carried, simulations, seconds, "done", reason)
    return model, acting


def carry(effects: Effects, gravity: float) -> dict[str, tuple[float, ...]]:
    """The effects of a drop that act on a shot: what belongs to the ball and the air, not to the
    camera.

    A constant force along the vertical is a change of gravity, and goes over as that.
    """
    from sims import effects as library

    carried: dict[str, tuple[float, ...]] = {}
    for name, values in effects.items():
        kind = library.get(name)
        # Per unit mass and along z: a force c is a change of gravity by -c / g.
        if name == "force.bias":
            carried["gravity.scale"] = (-values[0] / gravity,)
        elif kind.hook in ("force", "contact") and kind.fits(ShotSystem):
            carried[name] = tuple(values)
    return carried


def simulator_of(model: TunedModel) -> BounceShot:
    """The planning simulator of a model."""
    return BounceShot(fixed={name: list(values) for name, values in model.effects.items()})


def constants_of(settings: Settings, radius: float) -> dict[str, float]:
    """What the planner takes for known of a ball."""
    return {
        "radius": radius,
        "friction": settings.planned_friction,
        "inertia_ratio": settings.planned_inertia,
    }


def theta_of(model: TunedModel) -> Array:
    """The parameters of a model's planning simulator."""
    return np.array([model.restitution])


def planned_in(model: TunedModel, settings: Settings, scene: ShotScene, radius: float) -> Plan:
    """The shot planned in a model."""
    known = constants_of(settings, radius)
    return plan(simulator_of(model), theta_of(model), scene, known, settings.heights)


def _planned(model: TunedModel, settings: Settings, scene: ShotScene, radius: float) -> TunedModel:
    if model.status == "crashed":
        return model
    made = planned_in(model, settings, scene, radius)
    if not made.found and model.status in ("done", "converged"):
        return replace(
            model, status="no plan", reason="the model reaches the hoop's plane from no height"
        )
    return replace(model, height=made.height, margin=made.margin)
