"""Design of the next recording: commands that decide what the present recording leaves open.

Runs that an experimenter could make (`candidate_runs`), within the limits of the robot
(`safety_limits`), are simulated and ranked by their value (`information_gain`). The best plans are
then varied, one property at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from bench.diagnosis.experiment_design.candidate_runs import RigModel
from bench.diagnosis.experiment_design.information_gain import (
    DISCRIMINATION_THRESHOLD,
    RunRanker,
    RunValue,
    get_sort_key,
    symmetrise_discrimination,
)
from bench.diagnosis.fitting.fitted_models import FittedModel, ModelSet
from sims.core.simulator import Array

MAX_VARIATION_ROUNDS = 2
"""Maximum number of rounds in which the best plans are varied."""
PLANS_VARIED_PER_ROUND = 2
"""Number of plans that are varied in each round."""
PLANS_TESTED_FOR_LENGTH = 8
"""Maximum number of plans that are also tested with a longer run."""
MAX_REPEATS = 8
"""Maximum number of repetitions of a run that is recommended."""
MAX_LOG_GAIN = 50.0
"""Largest logarithm of a gain that is printed as a factor."""


@dataclass(frozen=True)
class NextRunDesign:
    """Design of the next recording.

    Attributes:
        says: Commands in words.
        by: Criterion: ``T`` if the run distinguishes models, ``D`` if it narrows parameters.
        gain: For ``D``, eq. (2) of `information_gain`, the logarithm of the factor by which the
            volume of the confidence region shrinks; for ``T``, the smallest `discrimination`.
        effect: Effect of the present model that is to be distinguished; empty for ``D``.
        discrimination: Eq. (1) of `information_gain` from each alternative effect; empty for ``D``.
        times: (T,) sample times in seconds.
        inputs: (T,) values by input, each held until the next sample.
        initial: Initial states by name.
        constants: Constants of the run that differ from those of the first run, by name.
        groups: Effects grouped by those that the run would still not distinguish.
    """

    says: str
    by: Literal["T", "D"]
    gain: float
    effect: str
    discrimination: Mapping[str, float]
    times: Array
    inputs: Mapping[str, Array]
    initial: Mapping[str, float]
    constants: Mapping[str, float]
    groups: tuple[tuple[str, ...], ...] = ()

    @property
    def is_for_discrimination(self) -> bool:
        """True if the run distinguishes models (criterion T), and not parameters (D)."""
        return self.by == "T"

    @property
    def distinguished_effects(self) -> tuple[str, ...]:
        """Alternative effects that the run would distinguish from the present effect."""
        return tuple(
            name for name, value in self.discrimination.items() if value > DISCRIMINATION_THRESHOLD
        )

    @property
    def settles_all(self) -> bool:
        """Return whether the run would distinguish all effects, whichever is true."""
        return len(self.groups) == len(self.discrimination) + 1

    def to_document(self) -> dict[str, Any]:
        """Return the design as JSON data; the command signals are written as a table instead.

        `by` is the criterion, T or D. For T, `told` has the discrimination of each competing effect
        from `effect`, `split` the effects that the run distinguishes, and `settles` whether these
        are all.
        """
        return {
            "says": self.says,
            "by": self.by,
            "gain": self.gain,
            "effect": self.effect,
            "told": dict(self.discrimination),
            "split": self.distinguished_effects,
            "settles": self.settles_all,
            "seconds": float(self.times[-1]),
            "inputs": list(self.inputs),
            "initial": dict(self.initial),
            "constants": dict(self.constants),
            "groups": self.groups,
        }

    def format_csv(self) -> str:
        """Format the commands as CSV text: a column ``t``, and one for each input."""
        columns = [self.times, *self.inputs.values()]
        rows = ["t," + ",".join(self.inputs) if self.inputs else "t"]
        rows += [",".join(f"{value:.9g}" for value in row) for row in np.column_stack(columns)]
        return "\n".join(rows) + "\n"

    def format_lines(self) -> list[str]:
        """Format the run and its expected benefit as text lines."""
        initial_text = ", ".join(f"{name} = {value:.4g}" for name, value in self.initial.items())
        lines = [f"record next, {self.times[-1]:.3g} s: {self.says}; begin near {initial_text}"]
        if self.is_for_discrimination:
            return [*lines, *_format_discrimination(self)]
        # The gain is a logarithm; its limit keeps the factor printable.
        factor = math.exp(min(self.gain, MAX_LOG_GAIN))
        benefit = (
            f"it shrinks the joint confidence region of all parameters by a factor of {factor:.3g}"
        )
        return [*lines, f"no causes need to be distinguished: {benefit}"]


def _format_discrimination(design: NextRunDesign) -> list[str]:
    """Format which causes a run distinguishes from the present one, and which it does not.

    The discrimination of two causes is the squared distance between their predictions, in noise
    standard deviations. It is proportional to the number of recordings, which gives the number of
    repeats that would be needed.

    Args:
        design: the designed run with its discrimination.
    """
    lines, discrimination = [], design.discrimination
    if design.distinguished_effects:
        distances = [
            f"{name} ({math.sqrt(discrimination[name]):.3g})"
            for name in design.distinguished_effects
        ]
        lines.append(
            f"it distinguishes {design.effect} from {', '.join(distances)}; in brackets: "
            "distance between the predictions in noise standard deviations, with all parameters "
            "refitted"
        )
    remaining = [name for name in discrimination if name not in design.distinguished_effects]
    if remaining:
        lines.append(f"no run of this kind distinguishes it from {', '.join(remaining)}")
    # The discrimination of the cause that needs the fewest repetitions of the run.
    best = max((discrimination[name] for name in remaining), default=0.0)
    if best > 0 and (repeats := math.ceil(DISCRIMINATION_THRESHOLD / best)) <= MAX_REPEATS:
        lines.append(f"{repeats} recordings of it would distinguish one more of these")
    if design.settles_all:
        lines.append("all equivalent causes are then distinguished")
    other_groups = [
        group for group in design.groups if len(group) > 1 and design.effect not in group
    ]
    lines += [
        f"if the cause is one of {', '.join(group)}, this run does not distinguish them"
        for group in other_groups
    ]
    return lines


def design_next_run(
    models: ModelSet,
    model: FittedModel,
    competing_models: Sequence[FittedModel],
    seconds: float,
    max_seconds: float,
) -> NextRunDesign | None:
    """Design the recording that tells most about models or uncertain parameters.

    1. Rank basic plans by their linearised value.
    2. Evaluate the best ones exactly, and try variants of them, for up to `MAX_VARIATION_ROUNDS`
       rounds.
    3. If no run decides, try the best plans with the maximum duration.

    Args:
        models: Fitted models, which include all of these.
        model: Model of the present diagnosis.
        competing_models: Competing models that explain the data as well; empty if there are none.
        seconds: Duration of the run in seconds.
        max_seconds: Maximum duration in seconds, if a run of `seconds` does not decide.

    Returns:
        The design; None if no run can be simulated.
    """
    # 1. Basic plans.
    rig = RigModel(models.evaluator, seconds)
    ranker = RunRanker(models, [model, *competing_models])
    ranked_runs = ranker.rank_runs([rig.make_run(plan) for plan in rig.list_basic_plans()])
    evaluated_plans = {run_value.run.plan for run_value in ranked_runs}
    # 2. Variants.
    for _ in range(MAX_VARIATION_ROUNDS):
        ranked_runs = _evaluate_fully(ranker, ranked_runs)
        if (
            not ranked_runs
            or ranked_runs[0].value >= ranker.max_total_value
            or models.evaluator.search_control.is_over()
        ):
            break
        plans = [
            plan
            for run_value in ranked_runs[:PLANS_VARIED_PER_ROUND]
            for plan in rig.list_variants(run_value.run.plan)
        ]
        new_plans = [plan for plan in dict.fromkeys(plans) if plan not in evaluated_plans]
        evaluated_plans.update(new_plans)
        ranked_runs = [*ranked_runs, *ranker.rank_runs([rig.make_run(plan) for plan in new_plans])]
    ranked_runs = _evaluate_fully(ranker, ranked_runs)
    # 3. Longer runs. The best run is the first one.
    if ranked_runs and _may_longer_run_help(ranked_runs[0], max_seconds / seconds):
        longer_rig = RigModel(models.evaluator, max_seconds)
        plans = [run_value.run.plan for run_value in ranked_runs[:PLANS_TESTED_FOR_LENGTH]]
        longer_runs = ranker.rank_runs([longer_rig.make_run(plan) for plan in plans])
        best_longer_runs = _evaluate_fully(ranker, longer_runs)[:1]
        ranked_runs = sorted([ranked_runs[0], *best_longer_runs], key=get_sort_key)
    if not ranked_runs:
        return None
    return _describe_best_run(models, [model, *competing_models], rig, ranked_runs[0])


def _may_longer_run_help(best: RunValue, length_factor: float) -> bool:
    """Return whether a longer run may distinguish models that the best run does not.

    The discrimination of a pair of models grows about in proportion to the duration; growth by up
    to twice as much is considered possible. The result is False if no models compete.

    Args:
        best: the best run, with the discrimination of each pair of models.
        length_factor: duration of the longest allowed run, in durations of this run.
    """
    # The values of a run are a matrix over models, or one gain of information.
    has_pairs = best.values.ndim == 2
    if length_factor <= 1.0 or not has_pairs:
        return False
    discrimination = symmetrise_discrimination(best.values)
    # Zero is the diagonal, or a pair that cannot be simulated on this run.
    undistinguished = discrimination[
        (discrimination > 0) & (discrimination <= DISCRIMINATION_THRESHOLD)
    ]
    return bool((undistinguished * 2.0 * length_factor > DISCRIMINATION_THRESHOLD).any())


def _evaluate_fully(ranker: RunRanker, runs: Sequence[RunValue]) -> list[RunValue]:
    """Evaluate the most valuable runs exactly, and sort all runs: exact ones first, then by value.

    Linearised values tend to be too high, so a run is proposed only after an exact evaluation. The
    best run that is only linearised is evaluated next; its value then usually falls, and another
    run is the best one. This is repeated until the best runs are exact or the limit of the ranker
    is reached.

    Args:
        ranker: evaluates runs exactly, by fits of the competing models.
        runs: runs with their linearised values.
    """
    ranked = sorted(runs, key=get_sort_key)
    for _ in range(ranker.max_exact_evaluations):
        # Only the best plans are varied or proposed, so only they are evaluated.
        linearised_indices = [
            index
            for index, run_value in enumerate(ranked[:PLANS_VARIED_PER_ROUND])
            if not run_value.is_exact
        ]
        # An exact value of `max_total_value` means that all models are distinguished: no other run
        # can be better.
        is_best_found = ranked and ranked[0].is_exact and ranked[0].value >= ranker.max_total_value
        if not linearised_indices or is_best_found:
            break
        next_index = linearised_indices[0]
        ranked[next_index] = ranker.evaluate_exactly(ranked[next_index])
        ranked.sort(key=get_sort_key)
    return sorted(ranked, key=lambda run_value: (not run_value.is_exact, *get_sort_key(run_value)))


def _describe_best_run(
    models: ModelSet, models_compared: Sequence[FittedModel], rig: RigModel, run_value: RunValue
) -> NextRunDesign:
    """Return the design of the best run, and what it is expected to tell, for the report.

    With competing models, the design states the effects that it distinguishes and the expected
    discrimination (T-optimal); otherwise the gain of information about parameters (D-optimal).

    Args:
        models: Fitted models of the recording.
        models_compared: Model of the present diagnosis, followed by the models that compete with
            it.
        rig: Experimental setup.
        run_value: Best run with its value.
    """
    run = run_value.run
    diagnosed_model, *competing_models = models_compared
    effect = ""
    discrimination: dict[str, float] = {}
    groups: tuple[tuple[str, ...], ...] = ()
    if competing_models:
        pair_discrimination = symmetrise_discrimination(run_value.values)
        effect = _list_other_effects(diagnosed_model, competing_models[0])
        names = [_list_other_effects(model, diagnosed_model) for model in competing_models]
        # The first row has the pairs with the diagnosed model.
        discrimination = dict(zip(names, pair_discrimination[0, 1:].tolist(), strict=True))
        groups = tuple(_iterate_connected_groups([effect, *names], pair_discrimination))
        gain = min(discrimination.values())
    else:
        gain = float(run_value.values[0])
    recorded_constants = rig.recorded_scenario.constants
    return NextRunDesign(
        says=run.says,
        by="T" if competing_models else "D",
        gain=gain,
        effect=effect,
        discrimination=discrimination,
        times=run.scenario.times,
        inputs=dict(run.scenario.inputs),
        initial=dict(zip(models.evaluator.state_names, run.states.tolist(), strict=True)),
        constants={
            name: value
            for name, value in run.plan.constants
            if recorded_constants.get(name) != value
        },
        groups=groups,
    )


def _list_other_effects(model: FittedModel, other_model: FittedModel) -> str:
    """Return the effects that one model has and the other does not have."""
    return " and ".join(name for name in model.effects if name not in other_model.effects)


def _iterate_connected_groups(
    names: Sequence[str], discrimination: Array
) -> Iterator[tuple[str, ...]]:
    """Yield groups of models that a run does not distinguish, as the names of their members.

    Two models are linked if their discrimination is at most `DISCRIMINATION_THRESHOLD`. The groups
    are the connected components of these links, each found by a breadth-first search. So the run
    distinguishes models of different groups, but perhaps not those of one group.

    Args:
        names: names of N models.
        discrimination: (N, N) discrimination of each pair.
    """
    remaining = list(range(len(names)))
    while remaining:
        connected, newly_connected = [], [remaining[0]]
        while newly_connected:
            connected += newly_connected
            remaining = [index for index in remaining if index not in newly_connected]
            newly_connected = [
                other
                for other in remaining
                if any(
                    discrimination[member, other] <= DISCRIMINATION_THRESHOLD
                    for member in newly_connected
                )
            ]
        yield tuple(names[index] for index in sorted(connected))
