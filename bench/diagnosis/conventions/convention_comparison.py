"""Compare conventions of a robot's log by the model's own prediction errors.

A Kalman filter with the model follows the log under each hypothesis
(`bench.diagnosis.kalman.kalman_recursions`). Hypotheses are compared by the likelihood of the
recorded values y,

    log L(y | hypothesis) = log L(transformed y) + Σ_c N_c log |k_c|                             (1)

with k_c the factor of channel c and N_c its number of samples. A convention differs if (1) is
clearly larger than for the log as it is described, and larger than with the best set of causes that
prediction-error identification selects (`prediction_error.regression_selection`): friction,
delays and small offsets are causes, not conventions.

Hypotheses are compared on a short part of some runs; the selected ones are confirmed on all
samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from bench.diagnosis.conventions.convention_hypotheses import (
    LATE_SAMPLES,
    MAX_NAMED,
    MIN_OFFSET,
    ConventionHypothesis,
    HypothesisGenerator,
    JointSignals,
)
from bench.diagnosis.conventions.signal_changes import SignalChange
from bench.diagnosis.conventions.unit_check import Subject
from bench.diagnosis.dry_friction_form import make_soft_kind
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.parameter_bounds import get_bounds_by_index
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.trajectory_derivatives import CandidateDirection
from bench.diagnosis.kalman.candidate_responses import compute_columns
from bench.diagnosis.kalman.likelihood_fit import maximise_innovation_likelihood
from bench.diagnosis.kalman.linearised_filter import MAX_LINEARISATIONS, FollowedRuns
from bench.diagnosis.kalman.measured_joint_forces import compute_joint_forces, has_joint_forces
from bench.diagnosis.prediction_error.dry_friction_fits import make_soft_friction_models
from bench.diagnosis.prediction_error.effect_proposals import compute_offset_from_command
from bench.diagnosis.prediction_error.effects_at_joints import MANY_SHAPES
from bench.diagnosis.prediction_error.filters_with_effects import GAUSS_NEWTON_STEPS
from bench.diagnosis.prediction_error.regression_columns import group_coefficients
from bench.diagnosis.prediction_error.regression_selection import Selected, identify
from bench.diagnosis.search.candidate_directions import iterate_first_probes
from bench.diagnosis.search.lack_of_fit import list_hat_effects
from bench.logs.quality.servo_checks import find_copied_commands
from sims.core.user_messages import join_first_names
from sims.recording.recording import Recording, Run
from sims.robot.dynamics.linearisation_points import LINEARISATION_INTERVAL_SECONDS
from sims.robot.robot_model import RobotModel
from sims.robot.robot_simulator import RobotSimulator

LOG_LIKELIHOOD_MARGIN = 20.0
"""Minimum gain in log-likelihood of a hypothesis over the log as it is described."""
CAUSES_MARGIN = 5.0
"""Minimum gain in log-likelihood of a hypothesis over the best set of causes, whose coefficients
are penalised; it corresponds to odds of 150 to 1.
"""
EQUAL_LOG_LIKELIHOOD = 3.0
"""Maximum difference of log-likelihoods of two hypotheses that explain a log equally well."""
MIN_MISSING_FORCE, LARGE_MISSING_FORCE = 0.1, 0.3
"""Limits of the largest missing force of a joint, as a share of its typical force. Below the first
no convention is tested, and below the second only those of joints with a similar share.
"""
ABSURD_MISSING_FORCE = 10.0
"""Missing force of a joint, as a share of its typical force, at which no test of significance is
needed.
"""
SIMILAR_SHARE = 0.5
"""Minimum missing force of a joint whose conventions are tested, as a share of the largest one, if
all of them are small.
"""
SUSPECT_SHARE = 0.1
"""Minimum missing force of a joint whose conventions are tested, as a share of its typical force,
and of the largest such share if that exceeds 1.
"""
SIMILAR_CAUSE_STEPS = 6
"""Maximum number of Gauss-Newton steps of an effect that looks like a convention."""
OFF_FACTOR = 1e-6
"""Factor that switches an input off."""
MAX_REMAINING_FORCE = 0.3
"""Maximum missing force with corrected conventions, as a share of the one before."""
MAX_SUSPECT_LIMIT = 0.5
"""Missing force of a joint, as a share of its typical force, above which its conventions are tested
in any case.
"""
PART_SAMPLES = 60
"""Number of samples of the part of a run on which hypotheses are compared."""
PART_RUNS = 3
"""Maximum number of runs of which parts are used."""
COARSE_JACOBIAN_SECONDS = 0.04
"""Time in seconds for which a Jacobian is held while hypotheses are rejected on one run.

A wrong convention changes forces far more than Jacobians change in this time.
"""
MAX_EVALUATIONS = 200
"""Number of filters after which no further hypothesis of one round is compared.

A hand whose fingers touch lacks forces at all of its sixteen joints, with hundreds of hypotheses.
"""
MAX_REFINED = 4
"""Maximum number of hypotheses whose offsets are refined."""
MAX_DIFFERENCES = 3
"""Maximum number of conventions that are searched one after another."""
MIN_WORST_RUN_SHARE = 0.15
"""Minimum gain in the run that the log as described explains worst, as a share of the margin."""
MAX_FORCE_ERROR_GROWTH = 0.3
"""Maximum growth of the logarithm of the missing joint forces for which a filter is run.

The log-likelihood of a filter decreases by about this number for each sample.
"""
NEGLIGIBLE_FORCE = 1e-6
"""Missing force of a joint that counts as none, in N or N m."""
MIN_REFINEMENT_GAIN = 0.1
"""Minimum gain in log-likelihood of a step of the refinement."""
FIRST_OFFSET_STEP = 0.3
"""First step of the refinement of an offset, in rad."""
OFFSET_ACCURACY = 1e-3
"""Accuracy of a refined offset, in rad."""
CONVENTION_EFFECTS = frozenset({"input.gain", "sensor.gain", "joint.zero"})
"""Effects that contain reversed signs, wrong units and other zeros, and therefore do not compete
with them. A joint zero of less than `MIN_OFFSET` is never a convention.
"""


@dataclass(frozen=True)
class ConventionDifference:
    """Convention of the log that differs from that of the model file.

    Attributes:
        hypothesis: Difference between the conventions.
        gain: Gain in log-likelihood on the short parts.
        alternatives: Hypotheses that explain the log equally well.
    """

    hypothesis: ConventionHypothesis
    gain: float
    alternatives: tuple[ConventionHypothesis, ...] = ()

    @property
    def description(self) -> str:
        """Description of the difference and of its alternatives."""
        if not self.alternatives:
            return self.hypothesis.description
        others = join_first_names(
            [alternative.description for alternative in self.alternatives], MAX_NAMED
        )
        return f"{self.hypothesis.description} (or {others})"


class ConventionComparison:
    """Comparison of the conventions of a robot's log with those of its model file.

    Args:
        subject: Recording of a robot.

    Attributes:
        subject: Recording of a robot.
        evaluations: Number of hypotheses that were evaluated by a filter.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.evaluations = 0
        self._generator = HypothesisGenerator(subject)

    def differences(self) -> list[ConventionDifference]:
        """Return the conventions of the log that differ from the model file.

        Commands that are copies of measurements are returned alone: without commands, no other
        convention can be compared. Otherwise the search is greedy:

        1. Find the suspects: the joints at which the filter can follow the log only with a large
           additional force, which the model lacks.
        2. Select the best hypothesis about them, and correct the log by it.
        3. Repeat from 1 until no hypothesis is clearly better.
        4. Confirm all corrections together; if they are not confirmed, return none.
        """
        copies = [
            ConventionDifference(
                ConventionHypothesis(
                    f"command {command} equals {channel} digit for digit: it is a copy of the "
                    "measurement",
                    changes={command: SignalChange(column)},
                ),
                gain=np.inf,
            )
            for command, channel, column in find_copied_commands(
                self.subject.recording, self.subject.kind
            )
        ]
        if copies:
            return copies
        # The log with the conventions of its description, and with the corrections so far.
        described = corrected = self.subject.recording
        differences: list[ConventionDifference] = []
        for _ in range(MAX_DIFFERENCES):
            # 1. Suspects. Short segments of some runs are enough.
            suspects = self._list_suspect_joints(
                self._filter_runs(self._select_segments(corrected))
            )
            # 2. The best hypothesis about them.
            best = self._find_best_hypothesis(corrected, suspects) if suspects else None
            if best is None:
                break
            # 3. The next difference is searched in the corrected log.
            differences.append(best)
            corrected = best.hypothesis.applied(corrected)
        # 4. Confirmation.
        hypotheses = [difference.hypothesis for difference in differences]
        if not differences or not self._are_conventions_confirmed(described, corrected, hypotheses):
            return []
        return differences

    def _are_conventions_confirmed(
        self,
        described: Recording,
        corrected: Recording,
        hypotheses: Sequence[ConventionHypothesis],
    ) -> bool:
        """Return whether the corrected conventions explain the log better than missing effects do.

        A wrong sign and a missing effect (a cause, such as friction) can leave similar residuals,
        so a correction must meet all criteria:

        1. It removes most of the missing force (the process noise that the filter needs).
        2. Its log-likelihood exceeds that of the log as described with the best set of causes. Both
           are computed on the segments with the largest movement, which are fast to filter.
        3. If the filter diverges on the log as described, criterion 2 always holds. Then the
           correction must leave almost no missing force.
        4. It increases the log-likelihood of all samples that both versions of the log have.

        Log-likelihoods are those of the recorded values: changing the unit of a signal rescales its
        density, which `_compute_log_scale_correction` undoes.

        Args:
            described: Recording as it is described.
            corrected: Recording with its conventions corrected.
            hypotheses: Differences of the conventions that were corrected.
        """
        # 1. Tested first, as the comparison with causes takes longest.
        if not self._removes_missing_force(described, corrected):
            return False
        # 2. Conventions against causes.
        segments = self._select_segments(corrected)
        with_conventions = _get_log_likelihood(
            self._filter_runs(segments)
        ) + _compute_log_scale_correction(hypotheses, segments)
        with_causes = self._compute_log_likelihood_of_causes(corrected, hypotheses)
        if with_conventions < with_causes + CAUSES_MARGIN:
            return False
        # 3. Minus infinity: the filter diverged on the log as described.
        if (
            np.isinf(with_causes)
            and self._compute_largest_missing_force(corrected) > MIN_MISSING_FORCE
        ):
            return False
        # 4. All samples that both recordings have.
        before, after = (
            _get_log_likelihood(self._filter_runs(recording))
            for recording in _cut_to_common_samples(described, corrected)
        )
        after += _compute_log_scale_correction(hypotheses, corrected)
        return after > before + LOG_LIKELIHOOD_MARGIN

    def _removes_missing_force(self, described: Recording, corrected: Recording) -> bool:
        """Return whether the corrections remove most of the largest missing force of a joint.

        Args:
            described: recording with the conventions of its description.
            corrected: the same recording with the corrected conventions.
        """
        before, after = map(self._compute_largest_missing_force, (described, corrected))
        return after <= MAX_REMAINING_FORCE * before

    def _compute_largest_missing_force(self, recording: Recording) -> float:
        """Return the largest missing force of a joint or floating body, relative to typical forces.

        A missing force is the process noise with which the filter has to follow the readings. It is
        large if a convention is wrong, and infinite if the filter diverges.

        Args:
            recording: Recording under one hypothesis.
        """
        filtered_runs = self._filter_runs(self._select_segments(recording))
        # Without expected innovations, the filter does not follow the readings: it diverges.
        if not filtered_runs.has_expected_innovations:
            return np.inf
        # Missing and typical force of each joint and each degree of freedom of floating bodies.
        return float((filtered_runs.force / filtered_runs.typical).max())

    def _list_suspect_joints(self, filtered_runs: FollowedRuns) -> list[JointSignals]:
        """Return the joints whose conventions may be wrong.

        These are the joints at which the filter needs a large missing force: the standard deviation
        of the force noise (process noise) with which it follows the readings, relative to the
        typical force of the joint. A wrong sign, unit or joint order shows as such a force.

        - If the filter diverges, all joints are suspects.
        - If all missing forces are negligible or not significant, no joint is.
        - Otherwise those are whose force exceeds a limit, which depends on the largest one.

        Args:
            filtered_runs: Result of the filter, with the missing and the typical force of each
                joint.
        """
        if not filtered_runs.has_expected_innovations:
            return self._generator.joints
        coordinates = self.subject.kind.system.coordinates
        # Forces at joints come first, and those of floating bodies follow.
        relative_missing_forces = (filtered_runs.force / filtered_runs.typical)[: len(coordinates)]
        largest = float(relative_missing_forces.max())
        # `missing_forces` is the result of a significance test for each force.
        is_missing = filtered_runs.missing_forces.any() or largest > ABSURD_MISSING_FORCE
        if not is_missing or largest <= MIN_MISSING_FORCE:
            return []
        # A wrong joint disturbs others, so the limit grows with the largest force.
        limit = min(SUSPECT_SHARE * max(1.0, largest), MAX_SUSPECT_LIMIT)
        # If all forces are small, only those of similar size to the largest count.
        if largest < LARGE_MISSING_FORCE:
            limit = SIMILAR_SHARE * largest
        relative_force_of = dict(zip(coordinates, relative_missing_forces.tolist(), strict=True))
        return [
            joint
            for joint in self._generator.joints
            if relative_force_of[f"q.{joint.name}"] > limit
        ]

    def _find_best_hypothesis(
        self, recording: Recording, suspects: Sequence[JointSignals]
    ) -> ConventionDifference | None:
        """Return the convention with which the model predicts the recording clearly best, or None.

        Its log-likelihood must exceed that of the log as described by `LOG_LIKELIHOOD_MARGIN`.

        1. Rank the hypotheses that exceed this limit.
        2. Refine free offsets, and require that factors of inputs are better than no inputs.
        3. Of equally likely hypotheses, select the simplest; the others are stated with it.

        Args:
            recording: recording as it is described, or with some conventions corrected.
            suspects: joints whose conventions may be wrong.
        """
        # 1. Ranking. The log as described is the hypothesis without any changes.
        described = ConventionHypothesis("")
        limit = self._compute_log_likelihood(described, recording) + LOG_LIKELIHOOD_MARGIN
        ranked = self._rank_hypotheses(recording, suspects, limit)
        # 2. Refinement of the best ones.
        refined = [
            self._refine_offset(score, hypothesis, recording)
            for score, hypothesis in ranked[:MAX_REFINED]
        ]
        accepted = [
            (score, hypothesis)
            for score, hypothesis in (*refined, *ranked[MAX_REFINED:])
            if score > limit and self._uses_inputs(score, hypothesis, recording)
        ]
        if not accepted:
            return None
        # 3. The simplest of the best.
        best = max(score for score, _ in accepted)
        equally_likely = [
            hypothesis for score, hypothesis in accepted if score > best - EQUAL_LOG_LIKELIHOOD
        ]
        simplest, *others = sorted(equally_likely, key=lambda hypothesis: hypothesis.size)
        # The gain is over the log as described, and the limit contains the margin in addition.
        gain = best - limit + LOG_LIKELIHOOD_MARGIN
        return ConventionDifference(simplest, gain, tuple(others[: MAX_NAMED - 1]))

    def _rank_hypotheses(
        self, recording: Recording, suspects: Sequence[JointSignals], limit: float
    ) -> list[tuple[float, ConventionHypothesis]]:
        """Return the hypotheses that exceed a log-likelihood, the likeliest first.

        Filtering all runs is slow, so cheap tests come first:

        1. Find the run that the log as described explains worst, and compute the limits there.
        2. Reject hypotheses by inverse dynamics on this run, and sort the others by its error.
        3. Reject some by a filter of this run, and compute the log-likelihood of the others on all
           runs, up to a number of filters.

        Args:
            recording: recording as it is described, or with some conventions corrected.
            suspects: joints whose conventions may be wrong.
            limit: log-likelihood on all runs that a hypothesis has to exceed.

        Returns:
            Log-likelihood and hypothesis. Of hypotheses with one description, which differ only in
            an offset, only the best one is returned.
        """
        # 1. Limits. Most hypotheses already fail on the worst run.
        described = ConventionHypothesis("")
        log_likelihood_by_run = [
            self._compute_log_likelihood(described, recording, run)
            for run in range(len(self._part_slices))
        ]
        worst_run = int(np.argmin(log_likelihood_by_run))
        min_worst_run_likelihood = (
            log_likelihood_by_run[worst_run] + MIN_WORST_RUN_SHARE * LOG_LIKELIHOOD_MARGIN
        )
        force_error = self._compute_log_force_error(described, recording, worst_run)
        # 2. Inverse dynamics, which takes far less time than a filter. Without forces to compare,
        # the error is NaN or minus infinity, and rejects nothing; it is then counted as unchanged.
        compared: list[tuple[float, ConventionHypothesis]] = []
        known_changes: list[object] = []
        for hypothesis in self._generator.generate(recording, suspects):
            # Several generators may propose one change in different words; it is compared once.
            key = dict(hypothesis.changes), hypothesis.late
            if key in known_changes:
                continue
            known_changes.append(key)
            growth = self._compute_log_force_error(hypothesis, recording, worst_run) - force_error
            if not growth > MAX_FORCE_ERROR_GROWTH:
                compared.append((growth if np.isfinite(growth) else 0.0, hypothesis))
        compared.sort(key=lambda pair: pair[0])
        # 3. Filters, in ascending order of the error. Each log-likelihood needs one of them.
        best_by_description: dict[str, tuple[float, ConventionHypothesis]] = {}
        max_evaluations = self.evaluations + MAX_EVALUATIONS
        for _, hypothesis in compared:
            if self.evaluations >= max_evaluations:
                break
            worst_run_likelihood = self._compute_log_likelihood(hypothesis, recording, worst_run)
            if not worst_run_likelihood > min_worst_run_likelihood:
                continue
            # All runs.
            score = self._compute_log_likelihood(hypothesis, recording)
            best_score, _ = best_by_description.get(hypothesis.description, (limit, hypothesis))
            if score > best_score:
                best_by_description[hypothesis.description] = score, hypothesis
        return sorted(best_by_description.values(), key=lambda scored: scored[0], reverse=True)

    def _compute_log_force_error(
        self, hypothesis: ConventionHypothesis, recording: Recording, run: int
    ) -> float:
        """Return how much needed and driven joint forces disagree under a hypothesis (logarithm).

        Inverse dynamics of the recorded motion gives the force that each joint needs; the drives
        give another one if a sign or a unit is wrong. This takes less time than a filter. The
        result is the sum over the joints of the logarithm of the RMS difference, on the segment of
        one run. It is minus infinity (no objection) if the forces cannot be computed, or if the
        hypothesis changes channels other than positions.

        Args:
            hypothesis: assumed conventions, such as another sign of a joint.
            recording: recording that is converted by the hypothesis.
            run: index of the run.
        """
        kind: Any = self.subject.kind
        robot: RobotModel = kind.robot
        changed_channels = [
            name for name in hypothesis.changes if name not in recording.runs[0].inputs
        ]
        if not all(name.startswith("q.") for name in changed_channels) or not has_joint_forces(
            robot, recording
        ):
            return -np.inf
        segment = self._select_segments(hypothesis.applied(recording), run)
        forces = compute_joint_forces(robot, segment, segment.runs[0])
        # Mean square difference of each joint, in N² or (N m)². Half of its logarithm is that of
        # the RMS; the small force avoids the logarithm of zero.
        squares = np.square(forces.needed - forces.driven).mean(axis=0)
        return float(0.5 * np.log(squares + NEGLIGIBLE_FORCE**2).sum())

    def _uses_inputs(
        self, score: float, hypothesis: ConventionHypothesis, recording: Recording
    ) -> bool:
        """Return whether a hypothesis on units of inputs is better than having no inputs at all.

        A factor near zero switches an input off. This can improve the likelihood of a wrong model,
        but it is not a unit. The result is True for hypotheses that change other signals, or only
        the signs or the order of inputs.

        Args:
            score: log-likelihood with the hypothesis.
            hypothesis: assumed conventions: changed signs, units or orders of signals.
            recording: the recording, on whose short parts log-likelihoods are computed.
        """
        inputs = recording.runs[0].inputs
        changes = hypothesis.changes
        rescales_only_inputs = all(
            name in inputs and abs(change.scale) != 1.0 for name, change in changes.items()
        )
        if not changes or not rescales_only_inputs:
            return True
        switched_off = {
            name: replace(change, scale=OFF_FACTOR * change.scale)
            for name, change in changes.items()
        }
        score_without_inputs = self._compute_log_likelihood(
            replace(hypothesis, changes=switched_off), recording
        )
        return score > score_without_inputs + LOG_LIKELIHOOD_MARGIN

    def _refine_offset(
        self, score: float, hypothesis: ConventionHypothesis, recording: Recording
    ) -> tuple[float, ConventionHypothesis]:
        """Improve the free offset of a hypothesis, such as a zero position, by a pattern search.

        The offset is moved by a step while the log-likelihood increases, then the step is halved
        (R. Hooke, T. A. Jeeves, J. ACM 8(2), 212, 1961, doi:10.1145/321062.321069).

        Args:
            score: log-likelihood with the hypothesis.
            hypothesis: hypothesis, with a first offset. Without a free offset, it is returned as
                it is.
            recording: the recording, on whose short parts the log-likelihood is computed.

        Returns:
            Log-likelihood and hypothesis with the best offset. If the best offset is negligible,
            the log-likelihood is minus infinity, so that the hypothesis is rejected.
        """
        if not hypothesis.has_free_offset:
            return score, hypothesis
        step = FIRST_OFFSET_STEP
        while step > OFFSET_ACCURACY:
            for signed_step in (step, -step):
                shifted = hypothesis.add_offset_step(signed_step)
                shifted_score = self._compute_log_likelihood(shifted, recording)
                if shifted_score > score + MIN_REFINEMENT_GAIN:
                    score, hypothesis = shifted_score, shifted
                    break
            # Neither direction is better.
            else:
                step /= 2.0
        offset = max(abs(change.offset) for change in hypothesis.changes.values())
        return (score if offset > MIN_OFFSET else -np.inf), hypothesis

    def _compute_log_likelihood(
        self, hypothesis: ConventionHypothesis, recording: Recording, run: int | None = None
    ) -> float:
        """Return the log-likelihood of the recorded values under a hypothesis, on the short parts.

        It is that of the filter's innovations for the converted signals. A factor k_c of channel c
        with N_c samples rescales their density, so sum_c N_c log |k_c| is added: eq. (1) of the
        module docstring.

        Args:
            hypothesis: Difference between the conventions.
            recording: Recording as it is described, or with some conventions corrected.
            run: Index of the only run to use; None for all runs of which parts are used. On one
                run, hypotheses are only rejected, so that Jacobians are held longer.
        """
        self.evaluations += 1
        parts = self._select_segments(hypothesis.applied(recording), run)
        jacobian_seconds = (
            LINEARISATION_INTERVAL_SECONDS if run is None else COARSE_JACOBIAN_SECONDS
        )
        followed = self._filter_runs(
            parts, max_linearisations=1, min_jacobian_seconds=jacobian_seconds
        )
        return _get_log_likelihood(followed) + _compute_log_scale_correction([hypothesis], parts)

    def _filter_runs(
        self,
        recording: Recording,
        max_linearisations: int = MAX_LINEARISATIONS,
        min_jacobian_seconds: float = LINEARISATION_INTERVAL_SECONDS,
    ) -> FollowedRuns:
        """Filter the runs for fitting with the parameters of the model file (Kalman filter).

        The result has the prediction errors, and the forces that the filter needs in addition to
        those of the model to follow the readings.

        Args:
            recording: the recording, transformed by a hypothesis.
            max_linearisations: maximum number of linearisations about the smoothed motion.
            min_jacobian_seconds: minimum time in seconds for which a Jacobian is held.
        """
        evaluator = self.subject.evaluator(recording)
        followed = FollowedRuns.follow(
            evaluator,
            evaluator.get_nominal_theta(),
            _estimate_white_noise(evaluator, recording),
            max_linearisations=max_linearisations,
            min_jacobian_seconds=min_jacobian_seconds,
        )
        evaluator.close()
        return followed

    def _compute_log_likelihood_of_causes(
        self, corrected: Recording, hypotheses: Sequence[ConventionHypothesis]
    ) -> float:
        """Return the log-likelihood of the log as described, with the best set of causes.

        Conventions must exceed it to be confirmed. A cause is a missing effect, such as friction.
        Selected effects are penalised by their number (`_fit_selected_effects`).

        1. Filter the segments without effects. If this diverges, the result is minus infinity.
        2. Select effects by regression of the filter's prediction errors.
        3. Add the selected effects to the model one by one, and filter again: with large missing
           forces, the regression is inaccurate.
        4. Add single effects that look like one of the hypotheses: the regression may miss them.
        5. Also try soft friction, which has no linear response.
        6. The result of the regression is less accurate than filters. It counts only if the
           corrections leave a large missing force: then they must exceed both.

        Args:
            corrected: Recording with its conventions corrected.
            hypotheses: Differences of the conventions that were corrected.
        """
        subject = self.subject
        segments = self._select_segments(subject.recording)
        evaluator = RunEvaluator(
            subject.kind,
            segments,
            segments.training(),
            subject.engine,
            list_hat_effects(subject.kind),
        )
        # 1. No effects.
        filtered = FollowedRuns.follow(
            evaluator,
            evaluator.get_nominal_theta(),
            _estimate_white_noise(evaluator, segments),
        )
        if not filtered.has_expected_innovations:
            evaluator.close()
            return -np.inf
        # 2. Regression on simple effects. Left out are those with many shapes, such as periodic
        # forces, and those that contain a convention, such as a gain, and would imitate it.
        excluded_effects = MANY_SHAPES | CONVENTION_EFFECTS
        names = [
            name for name in evaluator.library if name.partition("@")[0] not in excluded_effects
        ]
        # A probe is an effect with the coefficients at which its response is computed.
        probes = [probe for name in names for probe in iterate_first_probes(evaluator, (), name)]
        selected = identify(filtered, compute_columns(filtered, probes))
        # 3. Filters with the effects.
        best, penalty = _fit_selected_effects(filtered, selected, probes, len(names))
        # 4. Effects that look like a convention.
        for name, start in _list_similar_causes(filtered, hypotheses).items():
            theta = evaluator.get_nominal_theta()
            theta[evaluator.get_coefficient_indices(name)] = start
            fitted = _fit_coefficients(filtered.with_parameters(theta), [name], SIMILAR_CAUSE_STEPS)
            # No penalty: such a cause and the convention can hardly be distinguished here. In case
            # of doubt the convention is not reported, and the later search for causes decides.
            best = max(best, fitted.log_likelihood)
        # 5. Soft friction.
        best = max(best, _compute_log_likelihood_of_soft_friction(filtered))
        evaluator.close()
        # 6. Regression.
        if self._compute_largest_missing_force(corrected) < LARGE_MISSING_FORCE:
            return best
        return max(best, selected.log_likelihood - penalty)

    def _select_segments(self, recording: Recording, run: int | None = None) -> Recording:
        """Return the parts of some training runs with the largest movement.

        Args:
            recording: Recording as it is described, or with some conventions corrected.
            run: Index of the only run to use; None for all runs of which parts are used.
        """
        # Only the first runs have parts.
        parts = [
            training_run.part(part)
            for training_run, part in zip(recording.training(), self._part_slices, strict=False)
        ]
        return replace(recording, runs=tuple(parts if run is None else parts[run : run + 1]))

    @cached_property
    def _part_slices(self) -> list[slice]:
        """Samples of the parts of the runs.

        If a joint is not recorded, only the beginning of a run has a known pose.
        """
        runs = self.subject.recording.training()[:PART_RUNS]
        coordinates = self.subject.kind.system.coordinates
        if not all(coordinate in runs[0].channels for coordinate in coordinates):
            return [slice(0, min(run.times.size, PART_SAMPLES)) for run in runs]
        return [_select_liveliest_part(run) for run in runs]


def _cut_to_common_samples(first: Recording, second: Recording) -> tuple[Recording, Recording]:
    """Cut the runs of two versions of a recording to the samples that both have.

    Likelihoods can be compared only for the same samples.

    Args:
        first: a recording.
        second: the same runs, whose ends may be cut differently.
    """
    pairs = list(zip(first.runs, second.runs, strict=True))
    counts = [min(run.times.size, same_run.times.size) for run, same_run in pairs]

    def cut(recording: Recording) -> Recording:
        """Return a recording with only the first `counts` samples of each run."""
        runs = zip(recording.runs, counts, strict=True)
        return replace(recording, runs=tuple(run.part(slice(0, count)) for run, count in runs))

    return cut(first), cut(second)


def _get_log_likelihood(followed: FollowedRuns) -> float:
    """Return the log-likelihood of the innovations; minus infinity if the filter diverges."""
    likelihood = followed.log_likelihood
    return likelihood if np.isfinite(likelihood) and followed.has_expected_innovations else -np.inf


def _compute_log_scale_correction(
    hypotheses: Sequence[ConventionHypothesis], recording: Recording
) -> float:
    """Return the sum of log |factor| over all converted samples of the training runs.

    Added to the log-likelihood of converted signals, it gives that of the recorded values;
    otherwise a small factor would seem to fit better.

    Args:
        hypotheses: hypotheses that are applied together, with the factor of each changed signal.
        recording: the recording, as described.
    """
    result = 0.0
    changes = [change for hypothesis in hypotheses for change in hypothesis.changes.items()]
    for name, change in changes:
        # Inputs have no likelihood, and no channel of their name.
        samples = [run.channels[name] for run in recording.training() if name in run.channels]
        count = sum(int(np.isfinite(values).sum()) for values in samples)
        result += count * math.log(abs(change.scale))
    return result


def _estimate_white_noise(evaluator: RunEvaluator, recording: Recording) -> NoiseModel:
    """Return the noise floor of the channels as noise without autocorrelation.

    Args:
        evaluator: run evaluator of the runs to which models are fitted.
        recording: the recording, which may state the noise.
    """
    return NoiseModel.make_white(compute_noise_floor(evaluator, recording).sigma)


def _list_similar_causes(
    followed: FollowedRuns, hypotheses: Sequence[ConventionHypothesis]
) -> dict[str, float]:
    """Return effects that change a log nearly as a hypothesis does, with a first coefficient.

    - A command that seems late, because the robot answers before it: a servo whose D term acts on
      the rate of the set point, which leads by this time.
    - A zero that seems shifted: an offset of the encoder, of the command or of the force, or a
      centre of mass at another place. Only for the first one is a coefficient known: by how much
      readings differ from commands.

    Args:
        followed: the runs as described, filtered without effects.
        hypotheses: differences of the conventions.

    Returns:
        First coefficient of each effect, by name; zero where none is known.
    """
    causes: dict[str, float] = {}
    evaluator = followed.evaluator
    coordinates = evaluator.simulator.system.coordinates
    robot = cast(Any, evaluator.kind).robot
    for hypothesis in hypotheses:
        if hypothesis.late > 0.0:
            leads = [n for n in evaluator.library if n.partition("@")[0] == "servo.derivative"]
            # An effect of all servos ends with "@*". A robot with one servo has none.
            of_all_servos = [name for name in leads if name.endswith("@*")]
            causes |= dict.fromkeys(of_all_servos or leads, hypothesis.late)
        if not hypothesis.has_free_offset:
            continue
        for name in hypothesis.changes:
            # A command, `u.ACTUATOR`.
            if name not in coordinates:
                causes[f"input.bias@{name.removeprefix('u.')}"] = 0.0
                continue
            joint = name.removeprefix("q.")
            body = robot.compiled.body(int(robot.compiled.jnt_bodyid[robot.joint(joint).id])).name
            causes |= {f"force.bias@{joint}": 0.0, f"mass.offset@{body}": 0.0}
            causes[f"sensor.bias@{name}"] = compute_offset_from_command(
                evaluator, followed.noise, coordinates.index(name)
            )
    return {name: start for name, start in causes.items() if name in evaluator.library}


def _fit_coefficients(
    followed: FollowedRuns, names: Sequence[str], steps: int = GAUSS_NEWTON_STEPS
) -> FollowedRuns:
    """Fit the coefficients of effects by maximum likelihood of a Kalman filter (Gauss-Newton).

    Args:
        followed: the runs, followed by the filter with the present coefficients.
        names: names of the effects.
        steps: maximum number of steps.
    """
    return maximise_innovation_likelihood(
        followed,
        get_bounds_by_index(followed.evaluator, names),
        steps,
        lambda theta, best: best.with_parameters(theta),
    )


def _fit_selected_effects(
    filtered: FollowedRuns,
    selected: Selected,
    probes: Sequence[CandidateDirection],
    effect_count: int,
) -> tuple[float, float]:
    """Add the effects of a regression to the model one by one, and fit their coefficients.

    Each effect is penalised by half the logarithm of the number of samples for each coefficient
    (BIC), and by the logarithm of the number of effects from which it was selected.

    Args:
        filtered: the runs, filtered without effects.
        selected: effects that a regression selected.
        probes: effects with the coefficients at which their responses were computed.
        effect_count: number of effects from which the regression could select.

    Returns:
        Largest penalised log-likelihood with none or some of the effects, and the penalty of all.
    """
    evaluator = filtered.evaluator
    samples = int(filtered.runs.recorded.sum())
    best, penalty = filtered.log_likelihood, 0.0
    # A group has the columns of one selected effect.
    for count, group in enumerate(selected.groups, start=1):
        penalty += 0.5 * len(group.column_indices) * math.log(samples) + math.log(effect_count)
        groups = selected.groups[:count]
        # The fit starts from the coefficients of the regression.
        theta = evaluator.get_nominal_theta()
        for effect_group, coefficients in zip(
            groups, selected.regression.solve(groups).coefficients, strict=True
        ):
            theta[evaluator.coefficient_slices[effect_group.effect]] = group_coefficients(
                evaluator, probes, effect_group, coefficients
            )
        fitted = _fit_coefficients(
            filtered.with_parameters(theta), [group.effect for group in groups]
        )
        best = max(best, fitted.log_likelihood - penalty)
    return best, penalty


def _compute_log_likelihood_of_soft_friction(followed: FollowedRuns) -> float:
    """Return the largest log-likelihood with dry friction in MuJoCo's soft form, of several sizes.

    The friction acts at the joint with the largest missing force. The regression cannot propose it,
    because its force depends on MuJoCo's constraint solver. The result is minus infinity without
    such an effect.

    Args:
        followed: Result of the filter without this friction.
    """
    evaluator = followed.evaluator
    # The joint at which removing the process noise (the missing force) costs most likelihood.
    joint = followed.joints_by_loss[0]
    # Parameters with friction of several sizes.
    thetas = make_soft_friction_models(followed, evaluator.get_nominal_theta(), joint)
    if not thetas:
        return -np.inf
    simulator = evaluator.make_simulator(make_soft_kind(evaluator.kind))
    assert isinstance(simulator, RobotSimulator)
    likelihoods = [followed.with_parameters(theta, simulator).log_likelihood for theta in thetas]
    simulator.close()
    return max(likelihoods)


def _select_liveliest_part(run: Run) -> slice:
    """Return the slice of a run, of `PART_SAMPLES` samples, in which its channels move most.

    Hypotheses are compared on such segments, because filtering whole runs would take too long. The
    starts that are compared are half a segment apart. Of a short run, nearly all samples are
    returned.

    Args:
        run: recorded run: times, channels and inputs.
    """
    # The hypothesis of late commands moves them to earlier samples, so the last samples of a run
    # would have no command.
    count = run.times.size - max(LATE_SAMPLES)
    if count <= PART_SAMPLES:
        return slice(0, max(count, min(run.times.size, 2)))

    def movement(begin: int) -> float:
        """Return how much all channels move in the segment that starts at sample `begin`.

        The movement of a channel is its standard deviation in the segment relative to that in the
        whole run, so that channels with different units can be added. Channels without samples in
        the segment are skipped.
        """
        movement_sum = 0.0
        for values in run.channels.values():
            segment = values[begin : begin + PART_SAMPLES]
            if np.isfinite(segment).any():
                movement_sum += float(np.nanstd(segment)) / max(float(np.nanstd(values)), 1e-12)
        return movement_sum

    begins = range(0, count - PART_SAMPLES + 1, PART_SAMPLES // 2)
    best = max(begins, key=movement)
    return slice(best, best + PART_SAMPLES)
