"""Tune every method to the recording of a drop, and plan a shot with each tuned model.

No code in this module uses the true ball. The models are those of the tuners, in the original
simulator and in the one that `explain` extended from the same recording, and the fit of `explain`
itself. Heights are shifted as if every ball had the radius of the experiment, so that one trained
network serves all balls. Vision tuners get the pixel rows of the tracked film instead.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from bench.benchmark.isolation.tuner_processes import TunerSpec, relocate
from bench.benchmark.problem.experiment_config import Experiment, TunerEntry
from bench.benchmark.problem.experiment_recording import ObservedRuns, make_scenario
from bench.benchmark.problem.targets import BlindedTarget
from bench.benchmark.runner.run_in_worker import RunRequest, execute_run, get_problem
from bench.bounce_shot.drop_recording import (
    CAMERA_DISTANCE_RANGE,
    CAMERA_HEIGHT_RANGE,
    CAMERA_TARGET_HEIGHT,
)
from bench.bounce_shot.shot_config import ShotConfig, get_ball_kind
from bench.bounce_shot.shot_geometry import ShotGeometry
from bench.bounce_shot.shot_planner import EffectCoefficients, TunedModel, plan_tuned_shot
from sims.core.simulator import Array, InputError, Scenario
from sims.recording.recording import Recording, read_recording
from sims.systems.ball import Ball as BallSimulator
from sims.systems.bounce_shot import ShotSystem

UNTUNED_METHOD = "nominal"
"""Method without tuning."""

EXPLAIN_METHOD = "explain"
"""Method that uses the fit of explain itself."""

EXPLAIN_SUFFIX = " + explain"
"""Suffix of the label of a tuner that tunes the simulator extended by explain."""

DEFAULT_GRAVITY = 9.81
"""Gravity of a recording that does not state it, m/s²."""

ROW_CHANNEL = "v"
"""Channel of the ball's row in the picture, pixels from above."""


@dataclass(frozen=True)
class ShotInputs:
    """Input of a method for a shot.

    Attributes:
        name: name of the shot.
        recording: recording of the ball's drop.
        scene: incline and hoop.
        weights: files of trained weights, by tuner.
        tuned: specifications of the tuners that run in isolated processes, by label.
        hidden: folders that isolated tuners must not read.
    """

    name: str
    recording: Path
    scene: ShotGeometry
    weights: Mapping[str, Path]
    tuned: Mapping[str, TunerSpec] = field(default_factory=dict)
    hidden: tuple[str, ...] = ()

    def list_files(self) -> tuple[Path, ...]:
        """List the files that another machine needs."""
        plugins = {Path(tuned.file) for tuned in self.tuned.values() if tuned.file}
        description_file = self.recording.with_suffix(".toml")
        return self.recording, description_file, *self.weights.values(), *sorted(plugins)

    def relocate(self, paths: Mapping[Path, Path]) -> ShotInputs:
        """Return a copy for another machine, where the files have other paths."""
        weights = {label: paths[path] for label, path in self.weights.items()}
        tuned = {label: relocate(tuner_spec, paths) for label, tuner_spec in self.tuned.items()}
        return replace(self, recording=paths[self.recording], weights=weights, tuned=tuned)


def tune_and_plan(
    experiment: Experiment, settings: ShotConfig, inputs: ShotInputs
) -> list[TunedModel]:
    """Tune all methods to the recording of a drop, and plan a shot with each.

    The methods are: the untuned simulator; each tuner in the original simulator; the fit of
    `explain`, which searches for effects that the simulator lacks; and each tuner in the simulator
    that `explain` has extended with such effects.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        inputs: input of the methods.

    Returns:
        The tuned model of each method, with its plan.
    """
    recording = read_recording(inputs.recording, BallSimulator, whole=True)
    untuned = TunedModel(
        UNTUNED_METHOD,
        restitution=_get_nominal_restitution(),
        effects={},
        simulations=0,
        seconds=0.0,
        status="done",
    )
    models = [untuned]
    models += [
        _tune_model(experiment, settings, entry, inputs, recording, {})
        for entry in experiment.tuners
    ]
    explained, effects_of_drop = _explain_drop(inputs.recording)
    models.append(explained)
    # If explain failed, there is no extended simulator to tune.
    if explained.status == "done":
        extended_models = [
            _tune_model(experiment, settings, entry, inputs, recording, effects_of_drop)
            for entry in experiment.tuners
        ]
        # The shot is planned with those effects that act on a shot, too.
        models += [
            replace(model, method=model.method + EXPLAIN_SUFFIX, effects=explained.effects)
            for model in extended_models
        ]
    radius = _get_run_constants(recording)["radius"]
    return [plan_tuned_shot(model, settings, inputs.scene, radius) for model in models]


def make_failed_models(
    experiment: Experiment, error: BaseException, status: str = "crashed"
) -> list[TunedModel]:
    """Make a failed model of each method, for a shot whose recording or planning failed.

    None of them has a plan, so that the shot counts as a miss of every method. The methods are
    those of `tune_and_plan`, in the same order.

    Args:
        experiment: the experiment with its tuners.
        error: the error of the recording or of the worker.
        status: status of the models; it is "timeout" if the error is a timeout.

    Returns:
        One model per method, without parameters and without a plan.
    """
    if isinstance(error, TimeoutError):
        status = "timeout"
    labels = [entry.label for entry in experiment.tuners]
    methods = [
        UNTUNED_METHOD,
        *labels,
        EXPLAIN_METHOD,
        *(label + EXPLAIN_SUFFIX for label in labels),
    ]
    return [
        TunedModel(
            method,
            restitution=math.nan,
            effects={},
            simulations=0,
            seconds=math.nan,
            status=status,
            reason=str(error),
        )
        for method in methods
    ]


def _get_nominal_restitution() -> float:
    """Return the nominal restitution of the ball simulator, which an untuned model has."""
    return BallSimulator.system.parameters[0].nominal


def _tune_model(
    experiment: Experiment,
    settings: ShotConfig,
    entry: TunerEntry,
    inputs: ShotInputs,
    recording: Recording,
    effects: EffectCoefficients,
) -> TunedModel:
    """Run a tuner on the recorded drop, in a simulator with fixed effects.

    The tuner starts at the nominal parameters and sees only the drop: heights, or pixel rows of the
    film if the settings list the tuner for these.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        entry: entry of the tuner: registered name, label and options.
        inputs: input of the methods.
        recording: recording of the ball's drop.
        effects: coefficients of the effects that explain found; empty for the original simulator.

    Returns:
        The tuned model without a plan and without effects; with the status "crashed" if the
        experiment or recording cannot be used.
    """
    label, radius = entry.label, _get_run_constants(recording)["radius"]
    experiment = make_tuning_experiment(experiment, settings, entry)
    if effects:
        fixed = {name: list(values) for name, values in effects.items()}
        experiment = experiment.chosen(settings={**experiment.settings, "fixed": fixed})
    try:
        problem = get_problem(experiment)
        start = problem.cube.to_unit_cube(np.array([p.nominal for p in problem.cube.parameters]))
        observed_runs = (
            build_pixel_runs(recording, experiment, radius)
            if label in settings.rows
            else _make_observed_runs(recording, experiment)
        )
        # All of the drop is for fitting; no run is held out.
        no_runs = ObservedRuns((), np.empty((0, observed_runs.observed.shape[1])))
        target = BlindedTarget(inputs.name, "real", start, observed_runs, no_runs)
        request = RunRequest(
            run=label,
            entry=entry,
            seed=0,
            target=target,
            budget=entry.budget or experiment.budget,
            weights=inputs.weights.get(entry.label),
            tuned=inputs.tuned.get(entry.label),
            hidden=inputs.hidden,
        )
        outcome = execute_run(experiment, request)
    except InputError as error:
        return TunedModel(label, _get_nominal_restitution(), {}, 0, 0.0, "crashed", str(error))
    trace = outcome.trace
    # The restitution is the only parameter.
    restitution = float(problem.cube.to_physical(trace.recommendations[-1])[0])
    return TunedModel(
        label,
        restitution,
        effects={},
        simulations=len(trace.losses),
        seconds=outcome.seconds,
        status=trace.status,
        reason=trace.reason,
    )


def make_tuning_experiment(
    experiment: Experiment, settings: ShotConfig, entry: TunerEntry
) -> Experiment:
    """Adapt the experiment to a tuner: to pixel rows if the tuner uses them.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
        entry: entry of the tuner: registered name, label and options.
    """
    return (
        make_pixel_experiment(experiment, settings) if entry.label in settings.rows else experiment
    )


def _make_observed_runs(recording: Recording, experiment: Experiment) -> ObservedRuns:
    """Convert the recorded run to observed heights for the experiment's simulator.

    * The ball is released at rest at time 0, even if it is first seen later. So its initial state
      is the first height and the speed that it has reached by then.
    * Heights are shifted as if the ball had the radius of the experiment, because one trained
      network serves balls of all sizes.

    Args:
        recording: recording of the ball's drop.
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
    """
    (run,) = recording.runs  # one drop
    scenario = make_scenario(run, BallSimulator(observe=["z"]), recording.constants)
    constants = _get_run_constants(recording)
    radius = experiment.fixed["radius"]
    shift = radius - constants["radius"]
    heights = run.channels["z"]
    visible_heights = heights[np.isfinite(heights)]
    # After a free fall of t seconds the speed is g t.
    speed = scenario.constants.get("gravity", constants["gravity"]) * float(run.times[0])
    # Initial states that the recording states precede these.
    first = {"z": float(visible_heights[0]), "vz": -speed, **scenario.initial}
    initial = {**first, "z": first["z"] + shift}
    shifted_scenario = Scenario(
        scenario.times, initial, {}, {**scenario.constants, "radius": radius}
    )
    return ObservedRuns((shifted_scenario,), (heights + shift)[:, None])


def _get_run_constants(recording: Recording) -> dict[str, float]:
    """Return the constants of the recorded run, with defaults of the system."""
    return {**BallSimulator().constant_values, **recording.constants, **recording.runs[0].constants}


def _explain_drop(recording: Path) -> tuple[TunedModel, EffectCoefficients]:
    """Run explain on the recording of the drop, and convert its fit to a tuned model.

    An error of explain does not stop the other methods: the model then has the status "crashed".

    Args:
        recording: CSV file of the recording.

    Returns:
        The model, with the effects that act on a shot; and the coefficients of all effects of the
        drop that explain found, such as those of the camera.
    """
    from bench.diagnosis.explain import explain

    started = perf_counter()
    try:
        explanation = explain(recording)
    except Exception:  # the failure of one method is a row of the table
        nominal, seconds = _get_nominal_restitution(), perf_counter() - started
        reason = traceback.format_exc()
        return TunedModel(EXPLAIN_METHOD, nominal, {}, 0, seconds, "crashed", reason), {}
    all_effects = {
        name: tuple(number.value for number in numbers.values())
        for name, numbers in explanation.extended.effects.items()
    }
    acting_effects = select_transferable_effects(
        all_effects, explanation.extended.constants.get("gravity", DEFAULT_GRAVITY)
    )
    reason = f"{explanation.verdict}: {', '.join(all_effects) or 'nothing'}"
    restitution = explanation.extended.parameters["restitution"].value
    seconds = perf_counter() - started
    simulations = explanation.answer.simulations
    model = TunedModel(
        EXPLAIN_METHOD, restitution, acting_effects, simulations, seconds, "done", reason
    )
    return model, all_effects


def select_transferable_effects(
    effects: EffectCoefficients, gravity: float
) -> dict[str, tuple[float, ...]]:
    """Select the effects of a drop that act on a shot.

    They are effects of the ball and the air, which change a force or a contact, and not those of
    the camera. A constant vertical force is converted to a change of gravity.

    Args:
        effects: coefficients by name.
        gravity: gravitational acceleration, m/s^2.
    """
    from sims import effects as library

    selected: dict[str, tuple[float, ...]] = {}
    for name, coefficients in effects.items():
        effect = library.get_effect(name)
        if name == "force.bias":
            # A constant acceleration c along z is a relative change of gravity by -c / g.
            selected["gravity.scale"] = (-coefficients[0] / gravity,)
        elif effect.hook in ("force", "contact") and effect.fits(ShotSystem):
            selected[name] = tuple(coefficients)
    return selected


def make_pixel_experiment(experiment: Experiment, settings: ShotConfig) -> Experiment:
    """Make the experiment for a tuner that sees pixel rows of a film and not the camera.

    It simulates a filmed ball. The radius of the ball, the camera's azimuth, distance and height
    are drawn at random from ranges, for training; pixel rows have no noise in addition.

    Args:
        experiment: content of the experiment's TOML file: simulator, tuners, targets and budget.
        settings: settings of the bounce shot, from the table [shot] of the experiment.
    """
    radii = [get_ball_kind(name).radius for name in settings.balls]
    return experiment.chosen(
        simulator="ball-filmed",
        observe=("z", ROW_CHANNEL),
        error_channel=ROW_CHANNEL,
        noise={},
        constants={
            **experiment.constants,
            "radius": (min(radii), max(radii)),
            "camera_azimuth": (0.0, 2.0 * math.pi),
            "camera_distance": CAMERA_DISTANCE_RANGE,
            "camera_height": CAMERA_HEIGHT_RANGE,
            "camera_aim": CAMERA_TARGET_HEIGHT,
            "pixels": settings.filmed,
        },
    )


def build_pixel_runs(recording: Recording, experiment: Experiment, radius: float) -> ObservedRuns:
    """Convert the tracked pixel rows of a drop to observations at the experiment's sample times.

    The ball is released at rest at time 0, even if it is first seen later. Samples without a
    tracked ball, and all heights, which a tuner for pixel rows does not get, are NaN.

    Args:
        recording: a tracked drop, with the rows as extra column `v`.
        experiment: the experiment as returned by `make_pixel_experiment`.
        radius: radius of the ball, m.
    """
    (run,) = recording.runs
    times: Array = np.arange(experiment.sampling.samples) / experiment.sampling.rate
    # The recording may begin later or skip samples; each row is assigned by its time.
    indices = np.rint(run.times * experiment.sampling.rate).astype(np.intp)
    is_inside = indices < times.size
    # The channels are z and the pixel row v.
    observed: Array = np.full((times.size, 2), np.nan)
    observed[indices[is_inside], 1] = run.extra[ROW_CHANNEL][is_inside]
    heights = run.channels["z"]
    first = int(np.flatnonzero(np.isfinite(heights))[0])
    gravity = recording.constants["gravity"]
    # Free fall from the release to the first seen height: z(t) = z(0) - g t^2 / 2.
    drop_height = float(heights[first] + 0.5 * gravity * run.times[first] ** 2)
    return ObservedRuns((Scenario(times, {"z": drop_height}, {}, {"radius": radius}),), observed)
