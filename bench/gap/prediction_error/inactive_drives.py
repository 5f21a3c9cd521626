"""Find samples of a robot's recording in which a drive does nothing, before anything is fitted.

A drive that is switched off, a servo that is limp after a fault and an emergency stop leave the
commands going on. Every effect of the library could only imitate that. From positions alone come
velocities and accelerations (`measured_states`), and from these three forces at each joint and
sample: the force that the motion needs by inverse dynamics, f; the force of the model's drive, τ;
and the force that holds the joint still, g. Three hypotheses leave

    on: f - τ,        off: f,        held (by a brake): f - g                                    (1)

A sequence of hypotheses with few changes follows by dynamic programming (A. J. Viterbi 1967,
doi:10.1109/TIT.1967.1054010), with the cost min(|e| / s, `LARGEST`) of a sample, s the median of
the smallest of (1), and `CHANGE` for each change. A stretch that is off or held stands only if

* what the model's drive misses there is `WORSE` times what it misses elsewhere: a gain, a friction
  or a dead zone that is wrong is wrong everywhere;
* its hypothesis leaves `LEFT` of that, and `LEFT` of what the drive exerts elsewhere: a drive at
  its force limit exerts more than elsewhere;
* there are no more than `MOST` of them in a run.

All drives are held at once, up to the end of a run or from its beginning: a joint that presses
against a stop stands still, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.gap.prediction_error.measured_states import track_joints
from bench.recordings.noise import estimated
from sims.base import Array, Simulator
from sims.recording.drive_switches import (
    DriveSwitch,
    parts_without,
    spans,
    spans_of_runs,
    switched_runs,
)
from sims.recording.recording import Recording, Run
from sims.robot.activation_filters import activation_filters
from sims.robot.model import Robot

Mask = NDArray[np.bool_]

ON, OFF, HELD = 0, 1, 2
"""Numbers of the hypotheses."""
LARGEST = 8.0
"""Largest cost of a sample, so that single samples decide nothing."""
CHANGE = 40.0
"""Cost of a change from one hypothesis to another."""
WORSE = 3.0
"""Factor by which a drive that does nothing makes the model miss more."""
LEFT = 0.3
"""Share that a hypothesis leaves at most."""
SLOW = 0.1
"""Share of its usual velocity below which a joint that is held stands still."""
MOST = 3
"""Maximum number of stretches of a run."""
SHORTEST = 10
"""Minimum number of samples of a stretch, and of those in which a drive works."""
EDGE = 5
"""Number of samples on either side of a change in which the smoothed motion does not tell when it
was.
"""
MOST_SAMPLES = 20_000
"""Maximum number of samples at which forces are computed."""
SMALLEST_SCALE = 1e-3
"""Smallest s, as a share of the force that the motion needs."""


class JointForces(NamedTuple):
    """Forces at the D joints of a robot in the T samples of a run, (T, D) each.

    Attributes:
        needed: by the measured motion.
        driven: what the model's drives exert on it.
        holding: what holds the joints still.
        velocity: of the joints.
    """

    needed: Array
    driven: Array
    holding: Array
    velocity: Array

    def residuals(self, joint: int) -> Array:
        """(3, T) what the hypotheses (1) leave at a joint."""
        needed = self.needed[:, joint]
        return np.stack([needed - self.driven[:, joint], needed, needed - self.holding[:, joint]])


@dataclass(frozen=True)
class InactiveDrive:
    """A drive that does nothing in some samples.

    Attributes:
        joint: that it drives.
        actuators: of the joint.
        is_held: whether the joint is held still, as by a brake, and not free.
        masks: (T,) of each run, the samples.
    """

    joint: str
    actuators: tuple[str, ...]
    is_held: bool
    masks: tuple[Mask, ...]


def without_inactive_drives(recording: Recording, kind: type[Simulator]) -> Recording:
    """Switch off or leave out what drives do nothing about, and say so in the recording's notes.

    Where a column of the recording says when a drive is off, the drive is taken to be off there;
    else the samples are left out.

    Args:
        recording: as it was read, before its runs are divided.
        kind: a simulator of its system.
    """
    drives = inactive_drives(recording, kind)
    if not drives:
        return recording
    notes = list(recording.notes)
    runs = recording.runs
    left_out = [np.zeros(run.times.size, dtype=bool) for run in runs]
    unexplained: list[InactiveDrive] = []
    for drive in drives:
        switches = [] if drive.is_held else _switches(recording, drive)
        if not switches:
            unexplained.append(drive)
            left_out = [a | _widened(b) for a, b in zip(left_out, drive.masks, strict=True)]
            continue
        runs, said = switched_runs(recording.path, runs, switches)
        lines = " and ".join(switch.line for switch in switches)
        description = recording.path.with_suffix(".toml").name
        notes += [
            f"{text}, and the motion needs no force of it: the drive is taken to be off; state it "
            f"in {description}: {lines}"
            for text in said
        ]
    pairs = zip(runs, left_out, strict=True)
    kept = [part for run, mask in pairs for part in parts_without(run, mask)]
    if unexplained and any(not run.held_out for run in kept):
        notes += [_message(recording, unexplained, left_out)]
        runs = tuple(kept)
    return replace(recording, runs=tuple(runs), notes=tuple(notes))


def _message(
    recording: Recording, drives: Sequence[InactiveDrive], left_out: Sequence[Mask]
) -> str:
    """What is to be said of drives for whose state there is no column."""
    joints = ", ".join(drive.joint for drive in drives)
    where = spans_of_runs(recording.runs, left_out)
    noun = "joint" if len(drives) == 1 else "joints"
    does = "the joints stand still" if drives[0].is_held else "the motion needs no force of them"
    column = _changing_column(recording, drives)
    near = f"; column {column} changes there" if column else ""
    name = drives[0].actuators[0]
    line = DriveSwitch(name, "COLUMN", True).line
    return (
        f"the drives of {noun} {joints} do nothing in some samples, which are left out ({where}): "
        f"{does}, whatever is commanded{near}; if a column says when a drive is on, state it: "
        f"{line}"
    )


def _switches(recording: Recording, drive: InactiveDrive) -> list[DriveSwitch]:
    """The switches of a drive's actuators by the first column that says when it is off."""
    for column in recording.runs[0].extra:
        for zero_is_off in (True, False):
            found = [DriveSwitch(name, column, zero_is_off) for name in drive.actuators]
            pairs = zip(recording.runs, drive.masks, strict=True)
            if all(_agree(found[0].off(run), mask) for run, mask in pairs):
                return found
    return []


def _agree(off: Mask, found: Mask) -> bool:
    """Whether two masks agree but for some samples about the changes of the second."""
    unclear = _widened(found) & _widened(~found)
    return bool((off == found)[~unclear].all())


def _changing_column(recording: Recording, drives: Sequence[InactiveDrive]) -> str:
    """The name of the first other column that changes where drives begin or cease to do nothing,
    and nowhere else; empty where there is none.
    """
    for column in recording.runs[0].extra:
        hits, others = 0, 0
        for number, run in enumerate(recording.runs):
            values = run.extra[column]
            changes = np.flatnonzero(np.diff(values) != 0) + 1
            found = np.any([drive.masks[number] for drive in drives], axis=0)
            near = _widened(found) & _widened(~found)
            hits += int(near[changes].sum())
            others += int((~near[changes]).sum())
        if hits and not others:
            return column
    return ""


def _widened(mask: Mask) -> Mask:
    """A mask with some samples more on either side."""
    wide: Mask = np.convolve(mask, np.ones(2 * EDGE + 1), mode="same") > 0.5
    return wide


def inactive_drives(recording: Recording, kind: type[Simulator]) -> list[InactiveDrive]:
    """Find drives that do nothing in some samples, by (1).

    Args:
        recording: as it was read.
        kind: a simulator of its system.

    Returns:
        The drives; none where the positions of some joints are not recorded, where bodies float,
        or where joints are coupled by equalities.
    """
    robot = getattr(kind, "robot", None)
    if not kind.has_model or robot is None or not _is_open_chain(robot, recording):
        return []
    total = sum(run.times.size for run in recording.runs)
    every = -(-total // MOST_SAMPLES)
    with np.errstate(all="ignore"):
        forces = [_forces(robot, recording, run) for run in _thinned(recording, every)]
    driven = [a for a in robot.actuators if a.joint is not None and a.kind != "other"]
    joints = [joint.name for joint in robot.joints]
    drives: list[InactiveDrive] = []
    held: list[InactiveDrive] = []
    for number, joint in enumerate(joints):
        names = tuple(a.name for a in driven if a.joint == joint)
        if not names:
            continue
        for state, into in ((OFF, drives), (HELD, held)):
            masks = _stretches(forces, number, state)
            if any(mask.any() for mask in masks):
                whole = [
                    np.repeat(mask, every)[: run.times.size]
                    for mask, run in zip(masks, recording.runs, strict=True)
                ]
                into.append(InactiveDrive(joint, names, state == HELD, tuple(whole)))
    moving = {a.joint for a in driven}
    return drives + _held_at_once(held, len(moving))


def _held_at_once(held: Sequence[InactiveDrive], driven: int) -> list[InactiveDrive]:
    """Drives that are held, in the stretches in which all of them are, at an end of a run."""
    if len(held) < driven:
        return []
    masks = []
    for together in zip(*(drive.masks for drive in held), strict=True):
        all_held: Mask = np.all(together, axis=0)
        mask = np.zeros_like(all_held)
        for first, end in spans(all_held):
            if end - first >= SHORTEST and (first <= EDGE or end >= mask.size - EDGE):
                mask[first:end] = True
        masks.append(mask)
    if not any(mask.any() for mask in masks):
        return []
    return [replace(drive, masks=tuple(masks)) for drive in held]


def _is_open_chain(robot: Robot, recording: Recording) -> bool:
    """Whether forces follow from the recorded positions."""
    recorded = recording.runs[0].channels
    singles = all(joint.single and f"q.{joint.name}" in recorded for joint in robot.joints)
    long = all(run.times.size > 3 * SHORTEST for run in recording.runs)
    return singles and long and not robot.compiled.neq and bool(robot.actuators)


def _thinned(recording: Recording, every: int) -> list[Run]:
    """Every k-th sample of all runs."""
    return [run.part(slice(None, None, every)) for run in recording.runs]


def _forces(robot: Robot, recording: Recording, run: Run) -> JointForces:
    """Compute the forces of (1) by MuJoCo's inverse dynamics."""
    import mujoco

    model = robot.compiled
    data = mujoco.MjData(model)
    states = np.stack(track_joints(run.times, _readings(robot, recording, run)))
    positions = [joint.position for joint in robot.joints]
    dofs = [joint.velocity for joint in robot.joints]
    controls, activations = _controls(robot, run)
    applied = np.zeros((run.times.size, model.nv))
    for joint in robot.joints:
        name = f"force.{joint.name}"
        if name in run.inputs:
            applied[:, joint.velocity] = _about(run, name)
    shape = run.times.size, len(dofs)
    needed, driven, holding = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for k in range(run.times.size):
        data.qpos[positions] = states[:, k, 0]
        data.qvel[:], data.qacc[:] = 0.0, 0.0
        mujoco.mj_inverse(model, data)
        holding[k] = data.qfrc_inverse[dofs] - applied[k, dofs]
        data.qvel[dofs] = states[:, k, 1]
        data.qacc[dofs] = states[:, k, 2]
        mujoco.mj_inverse(model, data)
        needed[k] = data.qfrc_inverse[dofs] - applied[k, dofs]
        data.ctrl[:] = controls[k]
        data.act[:] = activations[k]
        mujoco.mj_fwdActuation(model, data)
        driven[k] = data.qfrc_actuator[dofs]
    names = [joint.name for joint in robot.joints]
    for name, off in run.off.items():
        of = robot.actuator(name).joint
        if of is not None:
            # Where it is known to be off, both hypotheses agree.
            driven[off, names.index(of)] = 0.0
    return JointForces(needed, driven, holding, states[:, :, 1].T)


def _readings(robot: Robot, recording: Recording, run: Run) -> list[tuple[Array, Array]]:
    """Recorded positions and velocities of all joints, and their noise."""
    readings = []
    for joint in robot.joints:
        columns, noise = [], []
        for name in (f"q.{joint.name}", f"qd.{joint.name}"):
            values = run.channels.get(name, np.full(run.times.size, np.nan))
            columns.append(values)
            sigma = recording.noise.get(name, 0.0)
            if not sigma > 0 and name in run.channels:
                sigma = estimated([(run.times, values)]).sigma
            noise.append(sigma if np.isfinite(sigma) and sigma > 0 else 1e-6)
        readings.append((np.stack(columns, axis=1), np.array(noise)))
    return readings


def _about(run: Run, name: str) -> Array:
    """(T,) an input about each sample: the mean of what it was until then and is from then on."""
    values = run.inputs[name]
    if name in run.linear:
        return values
    earlier = np.concatenate([values[:1], values[:-1]])
    mean: Array = 0.5 * (values + earlier)
    return mean


def _controls(robot: Robot, run: Run) -> tuple[Array, Array]:
    """Controls (T, nu) and activations (T, na) at the samples."""
    model = robot.compiled
    controls = np.zeros((run.times.size, model.nu))
    activations = np.zeros((run.times.size, model.na))
    for actuator in robot.actuators:
        name = f"u.{actuator.name}"
        if name in run.inputs:
            controls[:, actuator.control] = _about(run, name)
    steps = np.diff(run.times)
    for one in activation_filters(robot):
        taken = one.clipped(controls[:, one.actuator.control])
        now = float(taken[0])
        for k, kept in enumerate(np.exp(-np.append(steps, 0.0) / max(one.seconds, 1e-9)).tolist()):
            activations[k, one.address] = now
            now = taken[k] + kept * (now - taken[k])
    return controls, activations


def _stretches(forces: Sequence[JointForces], joint: int, state: int) -> list[Mask]:
    """Find the samples (T,) of each run in which a joint's drive is off or held."""
    residuals = [one.residuals(joint) for one in forces]
    chosen = [ON, state]
    pooled = np.concatenate(residuals, axis=1)[chosen]
    pooled = pooled[:, np.isfinite(pooled).all(axis=0)]
    nothing = [np.zeros(r.shape[1], dtype=bool) for r in residuals]
    if not pooled.size:
        return nothing
    scale = float(np.median(np.abs(pooled).min(axis=0)))
    scale = max(scale, SMALLEST_SCALE * _rms(pooled[1]))
    if not scale > 0:
        return nothing
    masks = [
        _likeliest(np.minimum(np.abs(np.nan_to_num(r[chosen], nan=np.inf)) / scale, LARGEST))
        for r in residuals
    ]
    masks = [_long(mask) for mask in masks]
    if max(len(spans(mask)) for mask in masks) > MOST:
        return nothing
    return _standing(forces, residuals, masks, joint, state)


def _likeliest(costs: Array) -> Mask:
    """(T,) where the second of two hypotheses is chosen, by dynamic programming over costs
    (2, T).
    """
    count = costs.shape[1]
    from_other = np.zeros((2, count), dtype=bool)
    best = costs[:, 0].copy()
    for k in range(1, count):
        changed = best[::-1] + CHANGE
        from_other[:, k] = changed < best
        best = np.minimum(best, changed) + costs[:, k]
    result = np.zeros(count, dtype=bool)
    now = int(np.argmin(best))
    for k in range(count - 1, -1, -1):
        result[k] = now == 1
        if from_other[now, k]:
            now = 1 - now
    return result


def _long(mask: Mask) -> Mask:
    """A mask without stretches that are too short."""
    result = np.zeros_like(mask)
    for first, end in spans(mask):
        result[first:end] = end - first >= SHORTEST
    return result


def _standing(
    forces: Sequence[JointForces],
    residuals: Sequence[Array],
    masks: Sequence[Mask],
    joint: int,
    state: int,
) -> list[Mask]:
    """Leave those stretches of masks (T,) that fulfil the conditions above."""
    working = [~_widened(mask) for mask in masks]
    if sum(int(mask.sum()) for mask in working) < SHORTEST:
        return [np.zeros_like(mask) for mask in masks]

    def elsewhere(values: Sequence[Array]) -> float:
        return _rms(np.concatenate([v[m] for v, m in zip(values, working, strict=True)]))

    missed = elsewhere([r[ON] for r in residuals])
    usual = elsewhere([r[state] for r in residuals])
    fast = elsewhere([one.velocity[:, joint] for one in forces])
    result = []
    for one, residual, mask in zip(forces, residuals, masks, strict=True):
        standing = np.zeros_like(mask)
        for first, end in spans(mask):
            # The smoothed motion blurs both ends.
            inner = slice(first + (EDGE if first else 0), end - (EDGE if end < mask.size else 0))
            if inner.stop - inner.start < SHORTEST // 2:
                continue
            of_drive, left = _rms(residual[ON, inner]), _rms(residual[state, inner])
            still = _rms(one.velocity[inner, joint]) <= SLOW * fast
            standing[first:end] = (
                of_drive >= WORSE * missed
                and left <= LEFT * min(of_drive, usual)
                and (state == OFF or still)
            )
        result.append(standing)
    return result


def _rms(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(finite)))) if finite.size else 0.0
