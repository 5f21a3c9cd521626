"""Freeze free numbers of a robot that the recording cannot identify.

A number that cannot be identified together with the others could take any value and would change
all other numbers. Numbers are frozen step by step, those with the largest standard error relative
to their range first, because a confounded number may then become identifiable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import FINAL_ITERATIONS, BaseFit
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.search.diagnose import find_unidentified_parameters
from bench.diagnosis.search.effect_search import EffectSearch

MAX_REFITS = 4
"""Maximum number of refits with more frozen numbers; the last one freezes all remaining ones."""


def freeze_unidentified_parameters(
    evaluator: RunEvaluator,
    noise: NoiseModel,
    base: BaseFit,
    searching: Callable[[BaseFit], EffectSearch],
) -> BaseFit:
    """Freeze at the nominal value all free numbers that the data cannot identify.

    Args:
        evaluator: Run evaluator of the runs.
        noise: Noise of each channel.
        base: Fitted base model.
        searching: Function that begins a search from a base model, which gives its covariance.

    Returns:
        The base model, fitted without these numbers.
    """
    for iteration in range(MAX_REFITS):
        search = searching(base)
        unidentified = find_unidentified_parameters(search, search.base_model)
        unidentified_indices = [
            i
            for i in evaluator.base_indices.tolist()
            if evaluator.parameters[i].name in unidentified
        ]
        if not unidentified_indices:
            break
        # `unidentified` is sorted by the width of the intervals.
        unidentified_indices.sort(key=lambda i: unidentified.index(evaluator.parameters[i].name))
        frozen_indices = (
            unidentified_indices
            if iteration == MAX_REFITS - 1
            else unidentified_indices[: (len(unidentified_indices) + 1) // 2]
        )
        theta = base.fit.theta.copy()
        theta[frozen_indices] = evaluator.get_nominal_theta()[frozen_indices]
        base = replace(
            base, unidentified_parameters=base.unidentified_parameters | frozenset(frozen_indices)
        )
        start = replace(base.fit.make_start(), theta=theta)
        base = replace(
            base,
            fit=TrajectoryFitter(evaluator, noise, base.fixed_parameters).fit_models(
                [start], FINAL_ITERATIONS
            )[0],
        )
    return base
