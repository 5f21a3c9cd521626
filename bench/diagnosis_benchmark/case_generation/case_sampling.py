"""Sampling of cases for ball, pendulum and slider.

`draw_case` chooses what is hidden and how strongly. `record_case` simulates the recording.
Everything that is drawn follows from the name of the case; a case is a recipe without data.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.diagnosis_benchmark.case_generation import effect_coefficients, refitted_residuals
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    BenchmarkCase,
    RecordedCase,
    RecordingConditions,
    RequestedConditions,
    draw_conditions,
    draw_size,
    make_case_rng,
    name_case,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    SIMULATORS,
    UNMODELLED_CAUSES,
    EffectCoefficients,
    simulate_with_mujoco,
    simulate_with_scipy,
)
from bench.diagnosis_benchmark.case_generation.strength_search import find_strength_for_size
from sims import effects as library
from sims.core.simulator import Array
from sims.recording.recording import Recording, Run

SYSTEMS = ("ball", "pendulum", "slider")
SUBTHRESHOLD_SIZES = (0.1, 0.2, 0.3, 0.5)  # sizes for the power curve only

SIMPLER_EFFECTS = {
    "friction.direction": ("drag.linear",),
    "friction.load_direction": ("friction.load",),
    "friction.load_quadratic": ("friction.load",),
    "friction.position": ("friction.coulomb",),
    "friction.stribeck": ("friction.coulomb",),
    "input.power": ("input.gain",),
    "friction.warming": ("friction.coulomb", "drag.linear"),
    "wind": (
        "drag.linear",
        "drag.quadratic",
        "force.bias",
        "gravity.tilt",
    ),  # fast air is a steady push
}

EQUIVALENT_EFFECTS: tuple[tuple[str, bool, frozenset[str]], ...] = (
    ("slider", True, frozenset({"gravity.tilt", "force.bias", "input.bias"})),
    ("pendulum", True, frozenset({"force.bias", "input.bias"})),
    ("pendulum", True, frozenset({"input.gain", "gravity.scale"})),  # the inertia absorbs the rest
    ("pendulum", False, frozenset({"force.bias", "input.bias"})),
    ("pendulum", False, frozenset({"gravity.tilt", "sensor.bias"})),  # gravity rotated and scaled
    (
        "ball",
        False,
        frozenset({"force.bias", "gravity.scale", "clock.skew"}),
    ),  # no accelerometer is recorded
)
"""Effects that are exactly equivalent: they give the same motion for some parameters.

Each entry is a system, whether it has an input, and the effects. The initial states may differ too.
"""


def find_equivalent_effects(system: str, driven: bool, effect: str) -> frozenset[str]:
    """Return an effect and all effects that are equivalent to it: no recording tells them apart.

    Args:
        system: name of the system, such as ``pendulum``.
        driven: whether there is an input.
        effect: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    classes = (
        names
        for class_system, has_input, names in EQUIVALENT_EFFECTS
        if (class_system, has_input) == (system, driven) and effect in names
    )
    return frozenset({effect}).union(*classes)


def draw_case(
    kind: str,
    system: str,
    seed: int,
    effect: str | None = None,
    size: float | None = None,
    requested: RequestedConditions = ANY_CONDITIONS,
) -> BenchmarkCase | None:
    """Draw the hidden causes, the recording conditions and the size of the causes of a case.

    The causes are drawn first, then recording conditions in which they can be observed, and finally
    their size in units of the noise, see `recording_conditions.draw_size`. Coefficients that give
    this size are found by simulation.

    Args:
        kind: clean (no cause), single, double, or foreign (a cause that the effect library does not
            contain).
        system: ball, pendulum or slider.
        seed: seed from which everything else follows.
        effect: hidden effect (the first one of a double case); None to draw it.
        size: size in units of the noise; None to draw it.
        requested: recording conditions that are given; those that are None are drawn.

    Returns:
        The case, or None if the sensors cannot show the effect at this size with a strength up to
        `effect_coefficients.MAX_STRENGTH`, or if another answer explains it too well.
    """
    effect_label = "" if kind == "clean" else effect or "any"
    name = name_case(kind, system, effect_label, size, requested, seed)
    rng = make_case_rng(name, "cause")
    hidden = _choose_hidden_causes(kind, system, effect, rng)
    setting = _draw_conditions(name, system, hidden, requested)
    source = str(rng.choice(["scipy", "mujoco"]))
    case = BenchmarkCase(
        name,
        system,
        kind,
        effects={},
        size=0.0,
        noise=setting.noise.kind,
        stated=setting.noise.stated,
        rate=setting.rate,
        seconds=setting.seconds,
        runs=len(setting.scenarios),
        # The library, which MuJoCo uses, has no unmodelled causes.
        source="scipy" if kind == "foreign" else source,
        driven=setting.is_driven,
        channels=setting.channels,
        seed=seed,
        parameters=setting.parameters,
        asked=requested,
    )
    target_size = draw_size(kind, size, rng)
    if not hidden:
        return case
    # The effect must be observable in the runs for fitting, because the held-out runs are not
    # fitted.
    fitted_setting = replace(
        setting, scenarios=setting.scenarios[: case.runs - count_held_out_runs(case)]
    )
    # The first function finds the coefficients of a cause, the second one computes the residual
    # that the best wrong answer leaves.
    return case.hide(
        hidden,
        target_size,
        lambda name: find_coefficients(name, fitted_setting, target_size, rng),
        lambda effects: _compute_unexplained_size(kind, fitted_setting, effects, target_size),
    )


def count_held_out_runs(case: BenchmarkCase) -> int:
    """Return the number of held-out runs; they are the last runs of the recording."""
    return max(1, case.runs // 3)


@lru_cache(maxsize=16)
def _draw_conditions(
    name: str, system: str, hidden: tuple[str, ...], requested: RequestedConditions = ANY_CONDITIONS
) -> RecordingConditions:
    """Draw the recording conditions of a case from its name; the last 16 results are cached.

    Args:
        name: name of the case, from which its random numbers follow.
        system: name of the system, such as ``pendulum``.
        hidden: names of the hidden effects, which the conditions must make observable.
        requested: conditions that are given; those that are None are drawn.
    """
    return draw_conditions(system, make_case_rng(name, "setting"), hidden, requested=requested)


def restore_conditions(case: BenchmarkCase) -> RecordingConditions:
    """Restore the recording conditions of a case from its name; a case stores no runs."""
    return _draw_conditions(case.name, case.system, tuple(case.effects), case.asked)


def _choose_hidden_causes(
    kind: str, system: str, effect: str | None, rng: np.random.Generator
) -> tuple[str, ...]:
    """Choose the names of the causes that a case hides.

    Args:
        kind: clean, single, double or foreign.
        system: ball, pendulum or slider.
        effect: name of the first cause; None to draw it.
        rng: random generator.

    Returns:
        No name for a clean case, two for a double case, otherwise one. The second effect is never
        equivalent to the first, with or without an input, because no data could tell the two apart.
    """
    if kind == "clean":
        return ()
    names = (
        list(UNMODELLED_CAUSES[system])
        if kind == "foreign"
        else sorted(library.list_effects_for(SIMULATORS[system].system))
    )
    first = effect or str(rng.choice(names))
    if kind != "double":
        return (first,)
    equivalent_effects = find_equivalent_effects(system, True, first) | find_equivalent_effects(
        system, False, first
    )
    return first, str(rng.choice([name for name in names if name not in equivalent_effects]))


def find_coefficients(
    name: str, setting: RecordingConditions, target_size: float, rng: np.random.Generator
) -> tuple[float, ...] | None:
    """Find coefficients of a hidden cause at which the residual has the requested size.

    Args:
        name: name of the effect or unmodelled cause.
        setting: recording conditions.
        target_size: size in units of the noise.
        rng: random generator for the shape of the cause.

    Returns:
        Coefficients, or None if no strength up to the maximum gives this size.
    """
    # The shape (sign, direction, period) is drawn; the strength that scales it is searched.
    compute_coefficients = effect_coefficients.draw_effect_shape(name, setting, rng)
    compute_residual = refitted_residuals.make_gap_function(
        setting, lambda strength: _simulate_causes(setting, {name: compute_coefficients(strength)})
    )
    strength_and_size = find_strength_for_size(
        compute_residual, target_size, effect_coefficients.get_max_strength(name)
    )
    if strength_and_size is None:
        return None
    strength, _ = strength_and_size
    return compute_coefficients(strength)


def _simulate_causes(setting: RecordingConditions, causes: EffectCoefficients) -> Array:
    """Simulate noise-free observations (R, T, C) with hidden causes.

    Unmodelled causes are simulated by scipy, because the batch engine does not know them.

    Shapes: R runs, T samples, C channels.

    Args:
        setting: recording conditions.
        causes: coefficients of the hidden causes by name.
    """
    if set(causes).isdisjoint(UNMODELLED_CAUSES[setting.system]):
        return refitted_residuals.simulate_observations(setting, causes)
    true_system = setting.make_true_system(causes)
    return np.array(
        [
            simulate_with_scipy(true_system, scenario, setting.channels, run_index)
            for run_index, scenario in enumerate(setting.scenarios)
        ]
    )


def _compute_unexplained_size(
    kind: str, setting: RecordingConditions, effects: EffectCoefficients, size: float
) -> float | None:
    """Compute the RMS residual that the best wrong answer leaves, in units of the noise.

    It would be a correct answer if it left little. Wrong answers by kind of case:

    * single: simpler forms of the effect, such as Coulomb friction for Stribeck friction,
    * double: each of the two effects alone,
    * foreign: the best effect of the library.

    Args:
        kind: single, double or foreign.
        setting: recording conditions with the runs for fitting only.
        effects: coefficients of the hidden causes by name.
        size: size of each in units of the noise.

    Returns:
        The residual; 0 if the simulation with the causes diverges, so that the case is rejected;
        None for a single effect that has no simpler form or is smaller than the noise.
    """
    # Effects with the coefficients from which their fit starts; None for several guesses.
    wrong_answers = (
        [(simpler, None) for name in effects for simpler in SIMPLER_EFFECTS.get(name, ())]
        if kind == "single"
        else list(effects.items())
    )
    if kind == "single" and (not wrong_answers or size < 1.0):
        return None
    observed = _simulate_causes(setting, effects)
    if not np.isfinite(observed).all():
        return 0.0
    if kind == "foreign":
        return refitted_residuals.compute_smallest_residual(setting, observed)
    return min(
        refitted_residuals.compute_refitted_residual(setting, observed, name, coefficients)
        for name, coefficients in wrong_answers
    )


def record_case(case: BenchmarkCase) -> RecordedCase:
    """Simulate the recording of a case, with sensor noise.

    A case is a recipe without data: its name determines the runs and all random numbers.

    Args:
        case: the case with its true causes, which the recording does not state.

    Returns:
        The recording, with the noise only if the case states it, and the system for the units.
    """
    setting = restore_conditions(case)
    # Only some recordings state the noise, as those of users.
    noise = setting.noise.sigma if case.stated else {}
    # The recording of a slider states no constants.
    constants = {} if case.system == "slider" else setting.constants
    runs = _simulate_runs(case, setting)
    recording = Recording(Path(), case.system, "", constants, noise, runs)
    return RecordedCase(recording, SIMULATORS[case.system].system)


def _simulate_runs(case: BenchmarkCase, setting: RecordingConditions) -> tuple[Run, ...]:
    """Simulate every run of a case, add sensor noise, and mark the last runs as held out.

    Args:
        case: the case; it states the simulator of the recording (`source`).
        setting: its recording conditions, with all runs.

    Returns:
        The runs, named by their indices, with noisy channels and the inputs.
    """
    rng = make_case_rng(case.name, "noise")
    first_held_out = case.runs - count_held_out_runs(case)
    true_system, runs = setting.make_true_system(case.effects), []
    for run_index, scenario in enumerate(setting.scenarios):
        if case.source == "mujoco":
            observed = simulate_with_mujoco(true_system, scenario, setting.channels)
        else:
            observed = simulate_with_scipy(true_system, scenario, setting.channels, run_index)
        recorded = setting.noise.add_to(observed, rng)
        channels = dict(zip(setting.channels, recorded.T, strict=True))
        is_held_out = run_index >= first_held_out
        # The recording states neither initial states nor constants of a run.
        runs.append(
            Run(str(run_index), scenario.times, channels, scenario.inputs, {}, {}, is_held_out)
        )
    return tuple(runs)
