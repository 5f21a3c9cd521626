"""Propose a discriminating run: the run in which the predictions of two models differ most.

It is a T-optimal design over a few changes that an experimenter can make (A. C. Atkinson, V. V.
Fedorov, Biometrika 62(1), 57, 1975, doi:10.1093/biomet/62.1.57), with the competing model's
parameters fixed at their fit to the present data. On a run x with T samples of C channels the two
models differ by

    apart(x) = sqrt(mean over t, c of ((y_model - y_other) / sigma_c)^2)                       (1)

For a robot no run is proposed that exceeds a limit of the model file (`model_file_limits`):
commands and initial states are limited, and the motion is simulated with both models.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.experiment_design.candidate_runs import (
    CandidateRun,
    ChangedRun,
    RunPlan,
    iterate_changed_runs,
)
from bench.diagnosis.experiment_design.safety_limits import RigLimits
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from sims.core.json_documents import OPTIONAL, Document
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array

MIN_DISCRIMINATION_SIGMAS = 2.0
"""Minimum RMS difference of two models, in noise standard deviations, for which one more run would
distinguish them.
"""


@dataclass(frozen=True)
class DiscriminatingRun(Document):
    """Proposed run or measurement, as in verdict.json.

    Attributes:
        says: Proposal as a sentence.
        change: By name, the differences from the first fitted run: seconds, an initial state, or
            the factor of an input; left out where no run is proposed.
        apart: RMS difference of the two models in units of the noise; left out where no run is
            proposed.
    """

    says: str
    change: Mapping[str, float] | None = field(default=None, metadata=OPTIONAL)
    apart: float | None = field(default=None, metadata=OPTIONAL)


def propose_discriminating_run(
    models: ModelSet, model: FittedModel, competing_model: FittedModel
) -> DiscriminatingRun:
    """Propose a run or measurement that shows which of two models is right.

    1. Change the present runs in a few ways that an experimenter can make, and simulate each with
       both models.
    2. Select the run within the limits of the robot on which the models differ most.
    3. Describe it, or, if they differ by less than `MIN_DISCRIMINATION_SIGMAS`, explain why.

    Args:
        models: Fitted models, which include both.
        model: Model of the present diagnosis.
        competing_model: Competing model that explains the data as well.
    """
    evaluator = models.evaluator
    # 1. Changed runs.
    runs_by_discrimination: list[tuple[float, ChangedRun]] = []
    for run in iterate_changed_runs(evaluator):
        discrimination = _compute_discrimination(
            evaluator, run, model, competing_model, models.noise.sigma
        )
        # A run that cannot be simulated with both models is not proposed.
        if np.isfinite(discrimination) and discrimination > 0.0:
            runs_by_discrimination.append((discrimination, run))
    runs_by_discrimination.sort(key=lambda entry: entry[0], reverse=True)
    # 2. The most different run within the limits.
    description = ""
    change: dict[str, float] = {}
    discrimination, is_limited = 0.0, False
    if best := _find_first_within_limits(
        evaluator, (model, competing_model), runs_by_discrimination
    ):
        discrimination, best_run = best
        description, change = best_run.says, best_run.change
        # Whether some run distinguishes the models, but only runs beyond the limits do.
        largest_discrimination, _ = runs_by_discrimination[0]
        is_limited = discrimination < MIN_DISCRIMINATION_SIGMAS <= largest_discrimination
    # 3. Description.
    # Effects that both models have are not in question.
    effects, competing_names = set(model.effects), set(competing_model.effects)
    model_effects = " and ".join(sorted(effects - competing_names))
    competing_effects = " and ".join(sorted(competing_names - effects))
    if discrimination < MIN_DISCRIMINATION_SIGMAS:
        return DiscriminatingRun(
            _explain_no_run(evaluator, model_effects, competing_effects, is_limited),
            {},
            discrimination,
        )
    description += (
        f": in it the predictions with {model_effects} and {competing_effects} differ by "
        f"{discrimination:.3g} times the noise"
    )
    return DiscriminatingRun(description, change, discrimination)


def _find_first_within_limits(
    evaluator: RunEvaluator, models: Sequence[FittedModel], runs: Sequence[tuple[float, ChangedRun]]
) -> tuple[float, ChangedRun] | None:
    """Return the first run that stays within the limits of a robot, whichever model is right.

    A proposed run must not damage the robot. For a system without a model file it is the first run.
    The search ends at the first run that does not discriminate the models, because the following
    ones do not either.

    Args:
        evaluator: Evaluator of the recorded runs.
        models: Models, either of which may be right.
        runs: Candidate runs with the RMS difference of the two models, largest first.

    Returns:
        A run with its difference. The difference is 0 if discriminating runs exist, but none of
        them is within the limits. None without runs.
    """
    if not runs:
        return None
    largest_discrimination, _ = runs[0]
    if not evaluator.kind.has_model or largest_discrimination < MIN_DISCRIMINATION_SIGMAS:
        return runs[0]
    limits = RigLimits(evaluator, models[0])
    for discrimination, run in runs:
        if discrimination < MIN_DISCRIMINATION_SIGMAS:
            return discrimination, run
        # The check of the limits needs no plan, only scenario and initial state; so it is empty.
        candidate = CandidateRun(RunPlan(), run.says, run.scenario, run.states)
        if all(all(limits(model, [candidate])) for model in models):
            return discrimination, run
    # No run is within the limits: a difference of zero means that none is proposed.
    _, most_different_run = runs[0]
    return 0.0, most_different_run


def _explain_no_run(
    evaluator: RunEvaluator, model_effects: str, competing_effects: str, is_limited: bool
) -> str:
    """Write what the user can do if no run distinguishes the two models.

    Args:
        evaluator: evaluator, whose channels are recorded.
        model_effects: effects of the model in words.
        competing_effects: effects of the competing model in words.
        is_limited: whether only the limits of the model file exclude such a run.
    """
    channels = [channel.name for channel in evaluator.kind.channels]
    unrecorded = ", ".join(name for name in channels if name not in evaluator.channels)
    advice = "measure one of the causes directly"
    # Another sensor may measure a difference where these sensors agree.
    if unrecorded:
        advice = f"also record {unrecorded}"
    if is_limited:
        return (
            "No run of this kind within the limits of the model file would distinguish "
            f"{model_effects} from {competing_effects}; {advice}, "
            "or search for other commands with simgap design"
        )
    return (
        f"No run of this kind would distinguish {model_effects} from {competing_effects}: "
        f"their predictions agree within the noise; {advice}"
    )


def _compute_discrimination(
    evaluator: RunEvaluator,
    run: ChangedRun,
    model: FittedModel,
    competing_model: FittedModel,
    sigma: Array,
) -> float:
    """Simulate a run with two models, and return the RMS difference of their predictions.

    It is sqrt(mean over samples and channels of ((y_model - y_other) / sigma)^2) (1), in standard
    deviations of the noise; NaN or infinite if a simulation fails. The larger it is, the more
    clearly the run shows which model is right.

    Args:
        evaluator: run evaluator that simulates the run.
        run: run that could be recorded.
        model: fitted model with one of the causes.
        competing_model: fitted model with the other one.
        sigma: (C,) standard deviation of the noise of each of C channels.
    """
    thetas = np.stack([model.fit.theta, competing_model.fit.theta])
    predictions = evaluator.simulate_scenarios(
        thetas, [run.scenario] * 2, np.stack([run.states] * 2)
    )
    whitened_difference = (predictions[0] - predictions[1]) / sigma
    return compute_rms(whitened_difference)  # (1)
