"""Sampling of cases for ball, pendulum and slider.

`draw_case` chooses what is hidden and how strongly. `record_case` simulates the recording.
Everything that is drawn follows from the name of the case; a case is a recipe without data.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from bench.diagnosis_benchmark.case_generation.benchmark_case import (
    BenchmarkCase,
    RecordedCase,
    draw_size,
    make_case_rng,
    name_case,
)
from bench.diagnosis_benchmark.case_generation.effect_coefficients import find_coefficients
from bench.diagnosis_benchmark.case_generation.equivalent_effects import find_equivalent_effects
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    ANY_CONDITIONS,
    SIMULATORS,
    RecordingConditions,
    RequestedConditions,
    draw_conditions,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    UNMODELLED_CAUSES,
    count_held_out_runs,
    simulate_runs,
)
from bench.diagnosis_benchmark.case_generation.refitted_residuals import (
    compute_wrong_answer_residual,
)
from sims import effects as library
from sims.recording.recording import Recording

SYSTEMS = ("ball", "pendulum", "slider")
"""Names of the systems."""
SUBTHRESHOLD_SIZES = (0.1, 0.2, 0.3, 0.5)
"""Sizes for the power curve only, in units of the noise."""


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
    their size in units of the noise, see `benchmark_case.draw_size`. Coefficients that give
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
        lambda effects: compute_wrong_answer_residual(kind, fitted_setting, effects, target_size),
    )


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
    runs = simulate_runs(case, setting)
    recording = Recording(Path(), case.system, "", constants, noise, runs)
    return RecordedCase(recording, SIMULATORS[case.system].system)
