"""Find samples of a robot's recording in which a drive exerts no force, before any fit.

If a drive is switched off, if a servo is limp after a fault, or after an emergency stop, the
commands continue. Effects of the library could only imitate this. Velocities and accelerations are
estimated from positions alone, and from them three forces at each joint and sample
(`kalman.measured_joint_forces`): the force f that the motion requires by inverse dynamics, the
force τ of the model's drive, and the force g that holds the joint still. Three hypotheses have the
residuals

    on: f - τ,        off: f,        held (by a brake): f - g                                    (1)

A sequence of hypotheses with few changes is found by dynamic programming (A. J. Viterbi 1967,
doi:10.1109/TIT.1967.1054010). A sample costs min(|e| / s, `MAX_SAMPLE_COST`), with s the median of
the smallest of (1), and each change costs `CHANGE_COST`. An interval that is off or held is
accepted only if

* the force error of the model's drive there is at least `MIN_MISSED_RATIO` times that elsewhere,
  and `MIN_WINDOW_RATIO` times that in any window of the same length elsewhere: a wrong gain,
  friction, damping or dead zone is wrong everywhere, or wherever the joint is fast;
* its hypothesis leaves at most `MAX_RESIDUAL_SHARE` of that force, and of the force of the drive
  elsewhere: a drive at its force limit exerts more than elsewhere;
* a run has at most `MAX_STRETCHES` such intervals, and all runs together have at most the share
  `MAX_INACTIVE_SHARE` of their samples in them: a joint that hardly moves may be strongly damped.

Magnitudes are the quantile `MAGNITUDE_QUANTILE` over all such intervals of a joint. Among 500
random effects of the library on an arm with motors or servos, four were mistaken for an inactive
drive.

For the hypothesis "held", all drives are held at once, at the end or the beginning of a run, and
the first two conditions apply to one of them: a joint that presses against a stop does not move,
either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.diagnosis.kalman.measured_joint_forces import (
    JointForces,
    compute_joint_forces,
    has_joint_forces,
)
from bench.logs.segmentation import split_without_masked
from sims.core.simulator import Array, Simulator
from sims.recording.drive_switches import DriveSwitch, apply_drive_switches, format_run_spans, spans
from sims.recording.recording import Recording, Run

Mask = NDArray[np.bool_]

ON, OFF, HELD = 0, 1, 2
"""Hypotheses about a drive: it is on, it is off, or its joint is held by a brake."""
MAX_SAMPLE_COST = 8.0
"""Maximum cost of a sample, so that no single sample decides."""
CHANGE_COST = 40.0
"""Cost of a change from one hypothesis to another."""
MAX_EXTRA_COST = 0.5
"""Maximum extra cost of a column over the likeliest intervals, per change.

It is a share of `CHANGE_COST`.
"""
MAGNITUDE_QUANTILE = 0.8
"""Quantile by which magnitudes are compared."""
MIN_MISSED_RATIO = 2.0
"""Minimum ratio of the force error of the model within the intervals to that elsewhere."""
MIN_WINDOW_RATIO = 1.5
"""Minimum ratio of this error to the largest one in a window of the same length elsewhere."""
MAX_RESIDUAL_SHARE = 0.4
"""Maximum residual of a hypothesis over all intervals, as a share of the force."""
MAX_STRETCH_SHARE = 0.6
"""Maximum residual of a hypothesis in a single interval, as a share of the force."""
MAX_REST_SPEED = 0.1
"""Maximum velocity of a joint that is held, as a share of its usual velocity."""
MAX_STRETCHES = 3
"""Maximum number of inactive intervals in a run."""
MAX_INACTIVE_SHARE = 0.7
"""Maximum share of inactive samples in the recording."""
MIN_SAMPLES = 20
"""Minimum number of samples in an interval, and in the part in which a drive works."""
EDGE_SAMPLES = 5
"""Number of samples on either side of a change in which the smoothed motion is blurred."""
MAX_SAMPLES = 20_000
"""Maximum number of samples at which forces are computed."""
MIN_SCALE_SHARE = 1e-3
"""Minimum of the scale s, as a share of the force that the motion requires."""


@dataclass(frozen=True)
class InactiveDrive:
    """A drive that exerts no force in some samples.

    Attributes:
        joint: name of the driven joint.
        actuators: names of the actuators of the joint.
        is_held: whether the joint is held still, as by a brake, and not free.
        masks: inactive samples (T,) of each run, the likeliest ones.
        costs: (2, T / every) costs in each run, of a drive that is on and of an inactive one.
        every: interval, in samples, at which costs are computed.
    """

    joint: str
    actuators: tuple[str, ...]
    is_held: bool
    masks: tuple[Mask, ...]
    costs: tuple[Array, ...]
    every: int

    def is_likely(self, masks: Sequence[Mask]) -> bool:
        """Return whether the drive may be inactive in the given samples, and only there.

        Used to test whether a column of the recording shows when the drive is off. A sample costs
        more the larger the residual force of its hypothesis is. A drive with small commands does
        not show exactly when it is switched off, so the masks may cost more than the likeliest
        ones, in proportion to the number of changes. Masks with too many intervals are refused.

        Args:
            masks: (T,) samples of each run in which the drive would be inactive.
        """
        extra_cost, changes = 0.0, 0
        for costs, mask, likeliest_mask in zip(self.costs, masks, self.masks, strict=True):
            given_costs = np.where(mask[:: self.every], costs[1], costs[0])
            lowest_costs = np.where(likeliest_mask[:: self.every], costs[1], costs[0])
            extra_cost += float((given_costs - lowest_costs).sum())
            if len(spans(mask)) > MAX_STRETCHES:
                return False
            changes += int((mask[1:] != mask[:-1]).sum())
        return extra_cost <= MAX_EXTRA_COST * CHANGE_COST * max(changes, 1)


def remove_inactive_drives(recording: Recording, kind: type[Simulator]) -> Recording:
    """Switch off inactive drives or omit these samples, and add notes to the recording.

    A fit would explain samples without drive force by wrong effects.

    - If a column of the recording shows when a drive is off, the drive is switched off in the model
      there.
    - Otherwise, or if a brake holds the joint, the samples are omitted. They are kept if no run for
      fitting would remain.

    Args:
        recording: the recording as it was read, before its runs are divided.
        kind: a simulator of its system.
    """
    drives = find_inactive_drives(recording, kind)
    if not drives:
        return recording
    notes = list(recording.notes)
    runs = recording.runs
    omitted_masks = [np.zeros(run.times.size, dtype=bool) for run in runs]
    drives_without_column: list[InactiveDrive] = []
    for drive in drives:
        # Switches tell by a column when a drive is off; a brake is not described by them.
        switches = [] if drive.is_held else _find_switches(recording, drive)
        if not switches:
            drives_without_column.append(drive)
            for omitted_mask, inactive_mask in zip(omitted_masks, drive.masks, strict=True):
                omitted_mask |= _widen_mask(inactive_mask)
            continue
        # A column shows when this drive is off; `texts` say in which samples of which runs.
        runs, texts = apply_drive_switches(recording.path, runs, switches)
        switch_lines = " and ".join(switch.line for switch in switches)
        description = recording.path.with_suffix(".toml").name
        notes += [
            f"{text}, and the motion shows no force of it: the drive is assumed to be off; state "
            f"it in {description}: {switch_lines}"
            for text in texts
        ]
    remaining_runs = [
        part
        for run, omitted_mask in zip(runs, omitted_masks, strict=True)
        for part in split_without_masked(run, omitted_mask)
    ]
    if drives_without_column and any(not run.held_out for run in remaining_runs):
        notes += [_format_message(recording, drives_without_column, omitted_masks)]
        runs = tuple(remaining_runs)
    return replace(recording, runs=tuple(runs), notes=tuple(notes))


def _format_message(
    recording: Recording, drives: Sequence[InactiveDrive], omitted_masks: Sequence[Mask]
) -> str:
    """Write the note on samples that were omitted because drives are inactive.

    No column of the recording shows when these drives are on. The note says how a column can be
    stated that does.

    Args:
        recording: the recording.
        drives: drives that are inactive in a part of it; all of them are held, or none.
        omitted_masks: (T,) mask of each run, of the samples that were left out.
    """
    joints = ", ".join(drive.joint for drive in drives)
    sample_text = format_run_spans(recording.runs, omitted_masks)
    noun = "joint" if len(drives) == 1 else "joints"
    symptom_text = (
        "the joints stand still" if drives[0].is_held else "the motion shows no force of them"
    )
    column = _find_changing_column(recording, drives)
    column_text = f"; column {column} changes there" if column else ""
    # Example of a line of the description file; the user replaces COLUMN by the name of a column.
    name = drives[0].actuators[0]
    line = DriveSwitch(name, "COLUMN", True).line
    return (
        f"the drives of {noun} {joints} exert no force in some samples, which are excluded "
        f"({sample_text}): "
        f"{symptom_text}, whatever the command is{column_text}; "
        f"if a column shows when a drive is on, state it: {line}"
    )


def _find_switches(recording: Recording, drive: InactiveDrive) -> list[DriveSwitch]:
    """Return switches of a drive's actuators from the first column that shows when it is off.

    Each column is tried as one that is zero where the drive is off, and as one that is zero where
    it is on. The result is empty if no column shows it.

    Args:
        recording: the recording, whose further columns may be state words of the drives.
        drive: the drive, with the samples in which it is inactive.
    """
    for column in recording.runs[0].extra:
        for zero_is_off in (True, False):
            # All actuators of the joint have the same samples, so the first one is tested.
            switches = [DriveSwitch(name, column, zero_is_off) for name in drive.actuators]
            if drive.is_likely([switches[0].off(run) for run in recording.runs]):
                return switches
    return []


def _find_changing_column(recording: Recording, drives: Sequence[InactiveDrive]) -> str:
    """Return the first other column that changes only where drives become inactive or active.

    The note to the user names it as a hint: it may show the state of the drives. The result is
    empty if there is no such column.

    Args:
        recording: the recording, with further columns.
        drives: the drives, with the samples in which they are inactive.
    """
    for column in recording.runs[0].extra:
        changes_near, other_changes = 0, 0
        for number, run in enumerate(recording.runs):
            values = run.extra[column]
            changes = np.flatnonzero(np.diff(values) != 0) + 1
            inactive_mask = np.any([drive.masks[number] for drive in drives], axis=0)
            # Near the beginning or the end of an inactive interval.
            is_near_change = _widen_mask(inactive_mask) & _widen_mask(~inactive_mask)
            changes_near += int(is_near_change[changes].sum())
            other_changes += int((~is_near_change[changes]).sum())
        if changes_near and not other_changes:
            return column
    return ""


def _widen_mask(mask: Mask) -> Mask:
    """Return a mask (T,) whose intervals are extended by `EDGE_SAMPLES` on either side."""
    wide: Mask = np.convolve(mask, np.ones(2 * EDGE_SAMPLES + 1), mode="same") > 0.5
    return wide


def find_inactive_drives(recording: Recording, kind: type[Simulator]) -> list[InactiveDrive]:
    """Find drives that are inactive in some samples, by (1) of the module docstring.

    Forces are computed from the recorded motion, at every k-th sample of long recordings, and
    compared with those of the model. Each joint is tested alone for a drive that is off. If no
    drive is off, all joints together are tested for a brake or an emergency stop that holds them.
    Masks are then extended to all samples.

    Args:
        recording: the recording as it was read.
        kind: the simulator class of its system, with the model of the robot.

    Returns:
        The drives; empty if the positions of some joints are not recorded, if there is a floating
        base, if joints are coupled by equalities, or if a run is too short.
    """
    # Only simulators of robots have this attribute.
    robot = getattr(kind, "robot", None)
    if not kind.has_model or robot is None or not has_joint_forces(robot, recording):
        return []
    if any(run.times.size <= 3 * MIN_SAMPLES for run in recording.runs):
        return []
    total = sum(run.times.size for run in recording.runs)
    # Rounded up, so that at most MAX_SAMPLES samples remain.
    sample_stride = -(-total // MAX_SAMPLES)
    # Forces that cannot be computed are NaN, and do not count.
    with np.errstate(all="ignore"):
        forces = [
            compute_joint_forces(robot, recording, run)
            for run in _thin_runs(recording, sample_stride)
        ]
    joint_actuators = [a for a in robot.actuators if a.joint is not None and a.kind != "other"]
    # Names of the actuators of each joint, by its index.
    actuators = {
        joint_index: tuple(a.name for a in joint_actuators if a.joint == joint.name)
        for joint_index, joint in enumerate(robot.joints)
    }
    joints = [joint_index for joint_index, actuator_names in actuators.items() if actuator_names]
    # First each drive alone, then a brake on all joints.
    drives = []
    for joint in joints:
        intervals = _Intervals(forces, [joint], OFF)
        if intervals.any():
            drives.append((joint, intervals))
    if not drives and joints:
        intervals = _Intervals(forces, joints, HELD)
        drives = [(joint, intervals) for joint in joints] if intervals.any() else []
    return [
        InactiveDrive(
            joint=robot.joints[joint].name,
            actuators=actuators[joint],
            is_held=intervals.state == HELD,
            # From every k-th sample to all samples.
            masks=tuple(
                np.repeat(mask, sample_stride)[: run.times.size]
                for mask, run in zip(intervals.masks, recording.runs, strict=True)
            ),
            costs=tuple(intervals.costs),
            every=sample_stride,
        )
        for joint, intervals in drives
    ]


def _thin_runs(recording: Recording, every: int) -> list[Run]:
    """Return all runs with every k-th of their samples.

    Args:
        recording: the recording.
        every: the number k.
    """
    return [run.part(slice(None, None, every)) for run in recording.runs]


class _Intervals:
    """Intervals of runs in which a hypothesis about some joints holds instead of active drives.

    Attributes:
        state: number of the hypothesis, ``OFF`` or ``HELD``.
        costs: (2, T) costs in each run, of active drives and of the hypothesis.
        masks: (T,) samples of each run in which the hypothesis holds.
    """

    def __init__(self, forces: Sequence[JointForces], joints: Sequence[int], state: int) -> None:
        """Find the most likely intervals of the hypothesis, and keep those that are plausible.

        The alternative is that the drives are active. Each sample costs more under the hypothesis
        that fits it worse, and each change costs too; dynamic programming finds the cheapest
        sequence. Costs of all joints are added, since the hypothesis is that they are inactive
        together. If the intervals are too many, the hypothesis explains noise, and none is kept.

        Args:
            forces: forces in the runs.
            joints: indices of the joints to which the hypothesis applies.
            state: the hypothesis, ``OFF`` or ``HELD`` (by a brake); it is also a row of the
                residuals.
        """
        self.state = state
        self._forces, self._joints = forces, joints
        # Residual forces (3, T) under the three hypotheses, by joint and run.
        self._residuals = [
            [run_forces.residuals(joint) for run_forces in forces] for joint in joints
        ]
        self.costs = [np.zeros((2, len(run_forces.needed))) for run_forces in forces]
        for residuals_by_run in self._residuals:
            joint_costs = _compute_costs(residuals_by_run, state)
            for run_costs, added_costs in zip(self.costs, joint_costs, strict=True):
                run_costs += added_costs
        masks = [_remove_short_intervals(_choose_second_hypothesis(cost)) for cost in self.costs]
        if max(len(spans(mask)) for mask in masks) > MAX_STRETCHES:
            masks = [np.zeros_like(mask) for mask in masks]
        self.masks = self._accept_masks(masks)

    def any(self) -> bool:
        """Return whether there is an interval."""
        return any(mask.any() for mask in self.masks)

    def _accept_masks(self, masks: Sequence[Mask]) -> list[Mask]:
        """Return masks (T,) if they fulfil the conditions of the module docstring, else empty ones.

        The hypothesis is that the drives are off, or that a brake holds all joints. An error is the
        force that a hypothesis leaves unexplained; that of an active drive (`ON`) is the error of
        the model's drive. All intervals are rejected together if they are too long or too short, if
        the model's drive is not clearly worse inside them than outside, or if the hypothesis leaves
        large forces.
        Then single intervals that the hypothesis does not explain are removed. Samples near the
        ends of intervals are not compared, because the smoothed motion is blurred there.

        Args:
            masks: samples of each run in which the hypothesis is the likelier one.
        """
        empty_masks = [np.zeros_like(mask) for mask in masks]
        active_masks = [~_widen_mask(mask) for mask in masks]
        interior_masks = [_remove_edges(mask) for mask in masks]
        inactive_share = np.concatenate(masks).mean()
        active_count = sum(int(mask.sum()) for mask in active_masks)
        interior_count = sum(int(mask.sum()) for mask in interior_masks)
        # Of the shortest interval, only half is left without the samples near its ends.
        if (
            inactive_share > MAX_INACTIVE_SHARE
            or min(active_count, interior_count) < MIN_SAMPLES // 2
        ):
            return empty_masks
        drive_error_outside = self._compute_residual_magnitudes(ON, active_masks)
        hypothesis_error_outside = self._compute_residual_magnitudes(self.state, active_masks)
        drive_error_inside = self._compute_residual_magnitudes(ON, interior_masks)
        hypothesis_error_inside = self._compute_residual_magnitudes(self.state, interior_masks)
        # A wrong damping has large errors wherever the joint is fast, not in one interval alone. So
        # windows elsewhere are compared, with the median length of the intervals.
        length = int(np.median([end - first for mask in masks for first, end in spans(mask)]))
        drive_error_in_windows = self._compute_largest_errors(active_masks, length)
        # One joint is enough: another one may press against a stop and not move, either.
        is_worse = any(
            inside >= MIN_MISSED_RATIO * outside and inside >= MIN_WINDOW_RATIO * in_windows
            for inside, outside, in_windows in zip(
                drive_error_inside, drive_error_outside, drive_error_in_windows, strict=True
            )
        )
        # Outside, the drive is active, and this error is about the force that it exerts there.
        is_small = all(
            inside <= MAX_RESIDUAL_SHARE * outside
            for inside, outside in zip(
                hypothesis_error_inside, hypothesis_error_outside, strict=True
            )
        )
        if not (
            is_worse
            and is_small
            and sum(hypothesis_error_inside) <= MAX_RESIDUAL_SHARE * sum(drive_error_inside)
        ):
            return empty_masks
        return self._accept_intervals(masks, active_masks, interior_masks)

    def _accept_intervals(
        self, masks: Sequence[Mask], active_masks: Sequence[Mask], interior_masks: Sequence[Mask]
    ) -> list[Mask]:
        """Return masks (T,) with only those intervals that the hypothesis explains.

        It must leave much less force than that of an active drive. If it is that a brake holds the
        joints, they must also be at rest.

        Args:
            masks: samples of each run in which the hypothesis is the likelier one.
            active_masks: samples that are clearly outside these intervals.
            interior_masks: samples of the intervals that are not near their ends.
        """
        typical_speeds = [
            _compute_magnitude(
                np.concatenate(
                    [
                        run_forces.velocity[active_mask, joint]
                        for run_forces, active_mask in zip(self._forces, active_masks, strict=True)
                    ]
                )
            )
            for joint in self._joints
        ]
        result = []
        for run, (mask, interior_mask) in enumerate(zip(masks, interior_masks, strict=True)):
            accepted_mask = np.zeros_like(mask)
            for first, end in spans(mask):
                # Masks of all runs that have only this interval.
                interval_masks = [np.zeros_like(m) for m in masks]
                interval_masks[run][first:end] = interior_mask[first:end]
                is_explained = sum(
                    self._compute_residual_magnitudes(self.state, interval_masks)
                ) <= MAX_STRETCH_SHARE * sum(self._compute_residual_magnitudes(ON, interval_masks))
                # A drive that is off need not be at rest.
                accepted_mask[first:end] = is_explained and (
                    self.state == OFF
                    or self._is_at_rest(run, interval_masks[run], (first, end), typical_speeds)
                )
            result.append(accepted_mask)
        return result

    def _compute_residual_magnitudes(self, state: int, masks: Sequence[Mask]) -> list[float]:
        """Return the magnitude of the residual forces of a hypothesis within masks, by joint.

        Args:
            state: the hypothesis, ``ON``, ``OFF`` or ``HELD``: a row of the residuals.
            masks: (T,) samples of each run that count.
        """
        return [
            _compute_magnitude(
                np.concatenate(
                    [
                        residuals[state, mask]
                        for residuals, mask in zip(residuals_by_run, masks, strict=True)
                    ]
                )
            )
            for residuals_by_run in self._residuals
        ]

    def _compute_largest_errors(self, masks: Sequence[Mask], length: int) -> list[float]:
        """Return the largest force error of the model's drive in any fully active window, by joint.

        The error in an inactive interval is compared with it: a model whose drive is wrong in other
        short windows too does not show that the drive is off. A force error is the missing force
        under the hypothesis that the drive is on (row `ON` of the residuals of a joint and run).

        Args:
            masks: (T,) samples of each run in which the drive is active.
            length: length of the windows in samples; they overlap by half.

        Returns:
            The largest error at each joint, in N or N·m; zero if no window is fully active.
        """
        largest = [0.0] * len(self._joints)
        for run, mask in enumerate(masks):
            for first in range(0, mask.size - length + 1, max(length // 2, 1)):
                window = slice(first, first + length)
                if not mask[window].all():
                    continue
                for joint, residuals_by_run in enumerate(self._residuals):
                    error = _compute_magnitude(residuals_by_run[run][ON, window])
                    largest[joint] = max(largest[joint], error)
        return largest

    def _is_at_rest(
        self, run: int, mask: Mask, ends: tuple[int, int], typical_speeds: Sequence[float]
    ) -> bool:
        """Return whether all joints are at rest in an interval at an end of the run.

        The hypothesis that all joints are held counts only at the beginning or the end of a run.

        Args:
            run: index of the run.
            mask: (T,) samples of the interval that are not near its ends.
            ends: first sample of the interval, and the sample after its last one.
            typical_speeds: typical speed of each joint of the hypothesis, in its unit per second.
        """
        velocity = self._forces[run].velocity
        first, end = ends
        # The interval reaches an end of the run, except for a few samples.
        at_end = first <= EDGE_SAMPLES or end >= mask.size - EDGE_SAMPLES
        is_joint_at_rest = [
            _compute_magnitude(velocity[mask, j]) <= MAX_REST_SPEED * typical_speed
            for j, typical_speed in zip(self._joints, typical_speeds, strict=True)
        ]
        return at_end and all(is_joint_at_rest)


def _remove_edges(mask: Mask) -> Mask:
    """Return a mask without the samples near changes, where the smoothed motion is blurred."""
    result = np.zeros_like(mask)
    for first, end in spans(mask):
        result[first + EDGE_SAMPLES * (first > 0) : end - EDGE_SAMPLES * (end < mask.size)] = True
    return result


def _compute_costs(residuals: Sequence[Array], state: int) -> list[Array]:
    """Return costs (2, T) in each run, of an active drive (row 0) and of a hypothesis (row 1).

    The cost of a sample is the absolute residual force at one joint in units of the typical
    residual of the better hypothesis, at most `MAX_SAMPLE_COST`. An unknown residual has this cost
    under both. Costs are zero if no residual is known.

    Args:
        residuals: (S, T) residual forces of each run under the S hypotheses, NaN where unknown.
        state: number of the hypothesis.
    """
    # Two of the S rows.
    hypotheses = [ON, state]
    # Residuals (2, n) of all samples in which both are known.
    pooled_residuals = np.concatenate(residuals, axis=1)[hypotheses]
    pooled_residuals = pooled_residuals[:, np.isfinite(pooled_residuals).all(axis=0)]
    if not pooled_residuals.size:
        return [np.zeros((2, run_residuals.shape[1])) for run_residuals in residuals]
    scale = float(np.median(np.abs(pooled_residuals).min(axis=0)))
    # Without noise, the smaller residual may be zero at most samples.
    scale = max(scale, MIN_SCALE_SHARE * _compute_magnitude(pooled_residuals[1]))
    if not scale > 0:
        return [np.zeros((2, run_residuals.shape[1])) for run_residuals in residuals]
    return [
        np.minimum(
            np.abs(np.nan_to_num(run_residuals[hypotheses], nan=MAX_SAMPLE_COST * scale)) / scale,
            MAX_SAMPLE_COST,
        )
        for run_residuals in residuals
    ]


def _choose_second_hypothesis(costs: Array) -> Mask:
    """Return where the second of two hypotheses is chosen (T,), from costs (2, T).

    The sequence with the lowest sum of sample costs and `CHANGE_COST` for each change is found by
    dynamic programming (Viterbi): forward, the lowest cost that ends in each hypothesis; backward,
    the choices that led there.
    """
    # Python's own numbers: an operation of NumPy takes ten times as long for two of them.
    # `first_total` is the lowest cost of a sequence so far that ends in the first hypothesis.
    first_costs, second_costs = costs.tolist()
    first_total, second_total = first_costs[0], second_costs[0]
    # Whether the best sequence that ends in the first or second hypothesis changed to it here.
    from_other = [(False, False)]
    for first_cost, second_cost in zip(first_costs[1:], second_costs[1:], strict=True):
        first_with_change = second_total + CHANGE_COST
        second_with_change = first_total + CHANGE_COST
        from_other.append((first_with_change < first_total, second_with_change < second_total))
        first_total = min(first_total, first_with_change) + first_cost
        second_total = min(second_total, second_with_change) + second_cost
    result = np.zeros(len(from_other), dtype=bool)
    current = int(second_total < first_total)
    for i in range(len(from_other) - 1, -1, -1):
        result[i] = current == 1
        if from_other[i][current]:
            current = 1 - current
    return result


def _remove_short_intervals(mask: Mask) -> Mask:
    """Return a mask (T,) without intervals of fewer than `MIN_SAMPLES` samples."""
    result = np.zeros_like(mask)
    for first, end in spans(mask):
        result[first:end] = end - first >= MIN_SAMPLES
    return result


def _compute_magnitude(values: Array) -> float:
    """Return a typical magnitude of values (n,), the quantile `MAGNITUDE_QUANTILE`; 0 without any.

    The quantile excludes impacts, which the smoothed motion does not reproduce. Values that are not
    finite are left out.
    """
    finite = np.abs(values[np.isfinite(values)])
    return float(np.quantile(finite, MAGNITUDE_QUANTILE)) if finite.size else 0.0
