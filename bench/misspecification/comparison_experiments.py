"""Experiments in the original and in the extended simulator, which have the same targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from bench.benchmark.problem.experiment import Experiment

PLAIN, EXTENDED = "plain", "extended"
"""Names of the simulators in which tuners are compared: the original and the extended one."""
MODEL_LABELS = (PLAIN, EXTENDED)


def make_base_experiment(experiment: Experiment) -> Experiment:
    """Make the experiment in the original simulator, which lacks the hidden effects."""
    return _make_comparison_experiment(experiment, PLAIN, experiment.settings)


def make_extended_experiment(experiment: Experiment, effects: dict[str, list[float]]) -> Experiment:
    """Make the experiment in the extended simulator.

    The tuned parameters remain the same. The missing effects act with the coefficients that explain
    fitted.

    Args:
        experiment: the experiment.
        effects: coefficients by name of the effect.
    """
    settings = dict(experiment.settings)
    # An effect that is tuned stays tuned, although explain fitted its coefficients too.
    tuned = {*settings.get("effects", ()), *(p for p in experiment.parameters)}
    fixed_effects = {name: values for name, values in effects.items() if name not in tuned}
    settings["fixed"] = {**settings.get("fixed", {}), **fixed_effects}
    return _make_comparison_experiment(experiment, EXTENDED, settings)


def _make_comparison_experiment(
    experiment: Experiment, model: str, settings: Mapping[str, Any]
) -> Experiment:
    """Make the experiment of one of the two comparisons: the same targets in another simulator.

    Args:
        experiment: the experiment of the study.
        model: `PLAIN` or `EXTENDED`, which is added to name and title.
        settings: settings of the simulator, such as its fixed effects.
    """
    return replace(
        experiment,
        name=f"{experiment.name}-{model}",
        title=f"{experiment.title or experiment.name} ({model})",
        same_targets_as=experiment.name,
        settings=settings,
        calibration=None,
    )
