"""Order of the joints in the columns of a log, by names, by ranges, and by the model's preference.

With the measured positions smoothed by a Savitzky-Golay filter, inverse dynamics give the force
f_j(t) that each joint needs, and the model's actuators give the force a_j(t) that they exert under
the recorded commands. An order of the columns is rated by

    R = sqrt(sum_j mean((f_j - a_j)^2) / sum_j mean(a_j^2))                                      (1)

which is small if the order is right, and about 1 otherwise.

Joints with position servos follow their commands, so a position belongs to the joint whose command
it is closest to. With the commands u_i and the positions q_j of a run, both in SI units, the order
of the columns is the permutation p that minimises the root mean square distance

    d(p) = sqrt(sum_i mean((u_i - q_p(i))^2))                                                    (1)

(linear assignment; H. W. Kuhn, Naval Research Logistics 2, 83, 1955).
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from bench.logs.importing.import_result import MAX_NAMES, ImportResult
from bench.logs.importing.run_logs import RunLogs
from bench.logs.importing.signal_assignment import Placement, Signal, SignalAssignment
from sims.core.simulator import Array
from sims.robot.dynamics.inverse_dynamics import motion_forces
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_model import Actuator, Joint, RobotModel

ALL_ORDERS = 4
"""Maximum number of joints for which every order is tested."""
SMOOTHING_WINDOW = 11
"""Length of the smoothing window in samples."""
SMOOTHING_DEGREE = 3
"""Degree of the smoothing polynomial."""
MAX_INSTANTS = 150
"""Maximum number of times at which forces are compared."""
MAX_PREFERRED_RATIO = 0.5
"""Maximum ratio of R in (1) for the preferred order to R for the model's order."""
MAX_UNEXPLAINED = 0.7
"""Maximum R in (1) for the preferred order; a model that explains little prefers no order."""


class PreferredOrder(NamedTuple):
    """The order that a model prefers.

    Attributes:
        order: For each joint the index of its column.
        residual: R of equation (1) for this order.
        model_order_residual: R of equation (1) for the model's own order.
    """

    order: tuple[int, ...]
    residual: float
    model_order_residual: float

    def is_certain(self) -> bool:
        """Return whether the order explains much, and far more than the model's own order."""
        return self.residual < min(MAX_UNEXPLAINED, MAX_PREFERRED_RATIO * self.model_order_residual)


def find_order_by_model(
    robot: RobotModel,
    driven: Sequence[tuple[Joint, Actuator]],
    times: Array,
    commands: Sequence[Array],
    positions: Sequence[Array],
) -> PreferredOrder | None:
    """Find the order of columns with which a model explains a motion best.

    A log often does not name the joints of its columns. In the right order, the forces that the
    motion needs by inverse dynamics are those that the actuators exert under the recorded commands;
    in a wrong order they are not. Velocities and accelerations come from smoothed positions
    (Savitzky-Golay filter).

    Args:
        robot: Model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        driven: J joints with their actuators, in the model's order.
        times: (T,) seconds.
        commands: (T,) command in each of J columns, SI units.
        positions: (T,) position in each of J columns, SI units.

    Returns:
        The best order; None if the motion is too short or there are fewer than two joints.
    """
    is_usable = np.isfinite(commands).all(axis=0) & np.isfinite(positions).all(axis=0)
    is_usable &= np.diff(times, prepend=-np.inf) > 0
    if is_usable.sum() < 4 * SMOOTHING_WINDOW or len(driven) < 2:
        return None
    # SciPy's signal module is slow to import.
    from scipy.signal import savgol_filter

    # Times, commands (J, T) and positions (J, T).
    t, u, q = times[is_usable], np.array(commands)[:, is_usable], np.array(positions)[:, is_usable]
    step = float(np.median(np.diff(t)))
    # (3, J, T): positions, velocities and accelerations.
    motion = np.stack(
        [
            savgol_filter(q, SMOOTHING_WINDOW, SMOOTHING_DEGREE, deriv=k, delta=step, axis=1)
            for k in range(3)
        ]
    )
    # Evenly spaced instants, except at the ends, where the filter has no full window.
    window_centres = np.linspace(
        SMOOTHING_WINDOW,
        t.size - SMOOTHING_WINDOW - 1,
        min(MAX_INSTANTS, t.size - 2 * SMOOTHING_WINDOW),
    )
    samples = np.unique(window_centres.astype(np.intp))
    u, motion = u[:, samples], motion[:, :, samples]
    residuals = {
        order: _compute_order_residual(robot, driven, u[list(order)], motion[:, list(order)])
        for order in _iterate_orders([joint.name for joint, _ in driven])
    }
    best = min(residuals, key=lambda order: residuals[order])
    model_order = tuple(range(len(driven)))
    return PreferredOrder(best, residuals[best], residuals[model_order])


def _iterate_orders(names: Sequence[str]) -> Iterator[tuple[int, ...]]:
    """Yield the orders of the columns that are tested, each as the column index of every joint.

    For few joints they are all permutations; otherwise the order of the model, the alphabetical and
    the reversed order, each also with every pair of joints exchanged.

    Args:
        names: names of the joints, in the order of the model.
    """
    count = len(names)
    if count <= ALL_ORDERS:
        yield from permutations(range(count))
        return
    model_order = list(range(count))
    joints_by_name = sorted(model_order, key=lambda joint: names[joint])
    # If columns are sorted by name, the column of a joint is at the index of its name.
    alphabetical = [joints_by_name.index(joint) for joint in model_order]
    for order in (model_order, alphabetical, model_order[::-1]):
        yield tuple(order)
        for first, second in combinations(range(count), 2):
            exchanged_order = list(order)
            exchanged_order[first], exchanged_order[second] = order[second], order[first]
            yield tuple(exchanged_order)


def _compute_order_residual(
    robot: RobotModel, driven: Sequence[tuple[Joint, Actuator]], commands: Array, motion: Array
) -> float:
    """Compute how badly the actuators explain a motion, to rate an order of the columns.

    With the force f_j that joint j needs for the motion and the force a_j that its actuator exerts,
    it is R = sqrt(sum_j mean((f_j - a_j)^2) / sum_j mean(a_j^2)) (1): small in the right order,
    about 1 otherwise. It is infinite if a joint would be far beyond its range, or no actuator
    exerts a force. Contacts and joint limits are switched off.

    Args:
        robot: Model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        driven: J joints with their actuators.
        commands: (J, T) their commands at T times.
        motion: (3, J, T) their positions, velocities and accelerations.
    """
    import mujoco

    positions, _, _ = motion
    for (joint, _), q in zip(driven, positions, strict=True):
        if joint.range is not None:
            low, high = joint.range
            slack = 0.5 * (high - low)  # half of the range, since limits may be inaccurate
            if q.min() < low - slack or q.max() > high + slack:
                return np.inf
    model = copy.copy(robot.compiled)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    controls = np.zeros((commands.shape[1], model.nu))
    controls[:, [actuator.control for _, actuator in driven]] = commands.T
    joints = [joint for joint, _ in driven]
    with capture_mujoco_warnings():
        forces = motion_forces(model, joints, np.swapaxes(motion, 1, 2), controls)
    unexplained_square = float(np.sum((forces.needed - forces.driven) ** 2))
    total_square = float(np.sum(forces.driven**2))
    return float(np.sqrt(unexplained_square / total_square)) if total_square > 0 else np.inf


MAX_DISTANCE_RATIO = 0.5
"""Maximum ratio of distances (1), another order over the present one, for changing the order."""
MIN_SAMPLES = 20
"""Minimum number of samples for determining an order."""


def find_order_by_commands(
    commands: Sequence[Array], positions: Sequence[Array]
) -> list[int] | None:
    """Find the order of position columns in which they follow their commands best.

    Args:
        commands: (T,) command of each joint, SI units.
        positions: (T,) position in each column at the same times, SI units.

    Returns:
        For each command the index of the position that follows it; None if the present order
        follows about as well, or the motion is too short.
    """
    distances = _compute_square_distances(commands, positions)
    if distances is None:
        return None
    order = _find_best_order(distances)
    # Commands that another position follows better than that of their own joint.
    moved_commands = [command for command, position in enumerate(order) if position != command]
    if not moved_commands:
        return None
    # Root mean square distances over the commands whose position would change.
    new_positions = [order[command] for command in moved_commands]
    unchanged_distance = float(np.sqrt(distances[moved_commands, moved_commands].sum()))
    reordered_distance = float(np.sqrt(distances[moved_commands, new_positions].sum()))
    return order if reordered_distance < MAX_DISTANCE_RATIO * unchanged_distance else None


def are_followed(commands: Sequence[Array], positions: Sequence[Array]) -> bool:
    """Return whether each command is closer to the position of its joint than to any other one.

    It is False if the motion is too short to decide.

    Args:
        commands: (T,) command of each joint, SI units.
        positions: (T,) position of each joint at the same times, SI units.
    """
    distances = _compute_square_distances(commands, positions)
    if distances is None:
        return False
    return bool((np.argmin(distances, axis=1) == np.arange(len(distances))).all())


def _find_best_order(distances: Array) -> list[int]:
    """Return the order in which the positions are closest to the commands.

    The order is the permutation p that minimises d(p) = sqrt(sum_i mean((u_i - q_p(i))^2)) (1),
    with commands u_i and positions q_j, found by linear assignment.

    Args:
        distances: (J, J) mean square distance of each command (rows) from each position (columns),
            for J joints.

    Returns:
        For each command the index of its position.
    """
    # SciPy's optimisers take a third of a second to import.
    from scipy.optimize import linear_sum_assignment

    _, assigned = linear_sum_assignment(distances)
    order: list[int] = assigned.tolist()
    return order


def find_order_by_variance(
    runs: Iterable[tuple[Sequence[Array], Sequence[Array]]], joint_count: int
) -> dict[int, int]:
    """Return the order of positions that follows the commands best, up to constant offsets.

    A position differs little from its own command, so the variance of the difference is the cost of
    the linear assignment. The zero of a position may differ from that of its command.

    Args:
        runs: commands and positions of each run, a (T,) array of each of J joints.
        joint_count: number J of joints.

    Returns:
        For the index of each command, the index of the joint whose position follows it.
    """
    costs = np.zeros((joint_count, joint_count))
    for commands, positions in runs:
        for i, j in np.ndindex(joint_count, joint_count):
            costs[i, j] += float(np.nanvar(positions[j] - commands[i]))
    return dict(enumerate(_find_best_order(costs)))


def _compute_square_distances(
    commands: Sequence[Array], positions: Sequence[Array]
) -> Array | None:
    """Return the mean square distance of each command from each position.

    Args:
        commands: Command of each of J joints, (T,) in SI units.
        positions: Position in each of J columns, (T,) in SI units.

    Returns:
        (J, J) distances, commands in rows; None if the motion is too short, or of one joint only.
    """
    command_table, position_table = np.array(commands), np.array(positions)
    finite = np.isfinite(command_table).all(axis=0) & np.isfinite(position_table).all(axis=0)
    if finite.sum() < MIN_SAMPLES or len(command_table) < 2:
        return None
    squares: Array = np.mean(
        (command_table[:, None, finite] - position_table[None][:, :, finite]) ** 2, axis=2
    )
    return squares


class _ServoSignals(NamedTuple):
    """Joints with a position servo, and their signals at the times of the positions.

    Attributes:
        joints: Names of the joints.
        inputs: Name of the input of each servo.
        commands: (T,) command of each servo, SI units; empty if orders cannot or need not be
            compared.
        positions: (T,) position of each joint, SI units; empty like `commands`.
    """

    joints: list[str]
    inputs: list[str]
    commands: list[Array]
    positions: list[Array]

    @property
    def channels(self) -> list[str]:
        """Names of the channels with the positions of the joints."""
        return [f"q.{joint}" for joint in self.joints]


def assign_order(
    logs: RunLogs, signals: SignalAssignment, is_normalised: bool, result: ImportResult
) -> Mapping[str, str]:
    """Correct the order of joints in unnamed columns, and report which order is a guess.

    Such columns were assigned in the order of the model, which is a guess.

    * If positions follow the commands better in another order, columns are exchanged.
    * If the orders of commands and positions are both guesses and agree with each other, both may
      be wrong: columns are exchanged if the model explains the motion better in another order.

    Args:
        logs: Logs that are imported.
        signals: Signals whose columns are exchanged.
        is_normalised: Whether positions are normalised to the ranges of their joints.
        result: Result to which messages are added.

    Returns:
        For each joint, the joint to which its position column had been assigned in the order of the
        model; empty if positions were not exchanged.
    """
    servos = _collect_servo_signals(logs, signals)
    # An order is a guess if only the numbers of the columns decided it.
    are_commands_guessed = all(signals.inputs[name].placement.is_order for name in servos.inputs)
    are_positions_guessed = all(
        signals.channels[name].placement.is_order for name in servos.channels
    )
    # `servos` has no values if orders cannot or need not be compared.
    if not servos.commands:
        _report_order(signals, [], result)
        return {}
    exchanged = {}
    if are_commands_guessed or are_positions_guessed:
        exchanged = _follow_commands(signals, servos, are_commands_guessed)
    is_following = are_followed(servos.commands, servos.positions) or bool(exchanged)
    are_both_guessed = are_commands_guessed and are_positions_guessed
    # Commands and positions agree, but both may be wrong: the model decides. Normalised positions
    # (-100 to 100 of a joint's range) have no known scale, so the model cannot explain them.
    if are_both_guessed and is_following and not exchanged and not is_normalised:
        preferred = _prefer_model(logs, signals, servos, result)
        if preferred:
            return preferred
    _report_order(signals, servos.joints if is_following else [], result)
    # The result concerns positions. If the order of the commands is a guess, these were exchanged.
    return exchanged if are_positions_guessed and not are_commands_guessed else {}


def _collect_servo_signals(logs: RunLogs, signals: SignalAssignment) -> _ServoSignals:
    """Collect the joints that have a servo, a recorded command and a recorded position.

    Their values (T,) are included only if they are needed and suitable to test other orders: the
    order of some columns is a guess, there are several joints, and all have the same sample times.

    Args:
        logs: logs of all runs, with their time stamps and columns.
        signals: signals and their columns.

    Returns:
        Names of the joints and of their commands, and the values in SI units, or no values.
    """
    joints = [
        joint
        for joint in signals.joints
        if signals.get_servo_input(joint.name) in signals.inputs
        and signals.get_position(joint.name) is not None
    ]
    names = [joint.name for joint in joints]
    inputs = [signals.get_servo_input(name) for name in names]
    # Command and position of each joint.
    pairs = [
        (signals.inputs[input_name], signals.channels[f"q.{name}"])
        for input_name, name in zip(inputs, names, strict=True)
    ]
    is_guess = any(signal.placement.is_order for pair in pairs for signal in pair)
    # Their values (T,) at the sample times of the position, in the units of the columns.
    value_pairs = [
        logs.hold_command(command.column, position.column) for command, position in pairs
    ]
    # Positions of one file share their sample times; those of several files may not.
    sample_counts = {command_values.size for command_values, _ in value_pairs}
    if len(joints) < 2 or not is_guess or len(sample_counts) > 1:
        return _ServoSignals(names, inputs, [], [])
    commands, positions = [], []
    for joint, (command, position), (command_values, position_values) in zip(
        joints, pairs, value_pairs, strict=True
    ):
        commands.append(command.convert(joint.unit, command_values))
        positions.append(position.convert(joint.unit, position_values))
    return _ServoSignals(names, inputs, commands, positions)


def _follow_commands(
    signals: SignalAssignment, servos: _ServoSignals, are_commands_guessed: bool
) -> dict[str, str]:
    """Exchange columns whose order is a guess if positions then follow the commands better.

    Commands are exchanged if their order is a guess, otherwise positions.

    Args:
        signals: signals and their columns, exchanged in place.
        servos: joints with a servo and their signals.
        are_commands_guessed: whether the order of the commands is a guess.

    Returns:
        For each joint, the joint to which the position that follows its command had been assigned;
        empty if nothing is exchanged.
    """
    order = find_order_by_commands(servos.commands, servos.positions)
    if order is None:
        return {}
    joints = servos.joints
    if are_commands_guessed:
        # `order` has the position of each command. The position columns stay, so each position gets
        # the command that it follows: the inverse permutation.
        inverse_order = np.argsort(order).tolist()
        _reorder(signals.inputs, servos.inputs, inverse_order, Placement.COMMANDS)
    else:
        _reorder(signals.channels, servos.channels, order, Placement.COMMANDS)
    return {joint: joints[index] for joint, index in zip(joints, order, strict=True)}


def _reorder(
    table: dict[str, Signal], names: Sequence[str], order: Sequence[int], placement: Placement
) -> None:
    """Exchange the columns of signals, and note the reason for the new order.

    Args:
        table: channels or inputs of the assignment, changed in place.
        names: names of the signals.
        order: for each name, the index of the name whose column it gets.
        placement: reason for the new order.
    """
    old_signals = [table[name] for name in names]
    for name, index in zip(names, order, strict=True):
        table[name] = old_signals[index].with_placement(placement)


def _prefer_model(
    logs: RunLogs, signals: SignalAssignment, servos: _ServoSignals, result: ImportResult
) -> dict[str, str]:
    """Exchange columns whose joints the log does not name, if the model then explains the motion.

    The forces that the motion needs are compared with those that the actuators exert under the
    recorded commands, for the possible orders of the columns.

    Args:
        logs: logs of all runs, with their time stamps and columns.
        signals: signals and their columns, exchanged in place.
        servos: joints with a servo and their signals.
        result: result of the import, to which a message is added.

    Returns:
        For each joint, the joint to which its column had been assigned; empty if the order is not
        changed.
    """
    joints = servos.joints
    actuators = [signals.get_actuator(joint) for joint in joints]
    driven = [
        (signals.robot.joint(joint), actuator)
        for joint, actuator in zip(joints, actuators, strict=True)
        if actuator is not None
    ]
    # A servo that the model file lacks has unknown gains, and so unknown forces. Numbers in the
    # names of columns that are those of the joints confirm the order.
    if len(driven) < len(joints) or all(map(signals.has_number_of_joint, joints)):
        return {}
    seconds = logs.seconds[signals.channels[servos.channels[0]].column.file]
    preferred = find_order_by_model(
        signals.robot, driven, seconds, servos.commands, servos.positions
    )
    if preferred is None or not preferred.is_certain():
        return {}
    _reorder(signals.channels, servos.channels, preferred.order, Placement.MODEL)
    _reorder(signals.inputs, servos.inputs, preferred.order, Placement.MODEL)
    # Joints in the order of their columns in the log: `order` has the column index of each joint.
    columns = sorted(joints, key=lambda joint: preferred.order[joints.index(joint)])
    result.checks.append(
        "order of joints: the log does not name those of its columns; they are taken in the "
        f"order {', '.join(columns)}, in which the model explains the motion best (a residual of "
        f"{preferred.residual:.2g} of the drives' forces, "
        f"{preferred.model_order_residual:.2g} in the model's "
        f"order, {', '.join(joints)}); it is a guess: compare it with the logger's order"
    )
    return {joint: joints[index] for joint, index in zip(joints, preferred.order, strict=True)}


def _report_order(
    signals: SignalAssignment, following_joints: Sequence[str], result: ImportResult
) -> None:
    """Report which orders of joints are a guess, and mark those that the motion confirms.

    Nothing is reported if names of columns or numbers in them confirm the order.

    Args:
        signals: Signals of the robot.
        following_joints: Joints with a servo each of which follows its own command best; empty if
            some do not.
        result: Result to which messages are added.
    """
    # Joints whose signals were assigned by a guess, by the kind of signal: the part of its name
    # before the dot, such as q for positions and u for commands.
    guessed: dict[str, set[str]] = {"q": set(), "u": set()}
    for table in (signals.channels, signals.inputs):
        for name, signal in table.items():
            if signal.placement not in (Placement.MODEL_ORDER, Placement.COMMANDS):
                continue
            joint = signals.get_joint(name)
            if signal.placement is Placement.MODEL_ORDER and joint in following_joints:
                table[name] = signal.with_placement(Placement.CONFIRMED_ORDER)
            guessed.setdefault(name.partition(".")[0], set()).add(joint)
    positions, commands = guessed["q"], guessed["u"]
    # A position that follows a named command, and a command that a named position follows, are
    # certain. Only a joint with both of them guessed is in doubt.
    if following_joints and not positions & commands:
        return
    names = [joint.name for joint in signals.joints if joint.name in positions | commands]
    if len(names) < 2 or all(map(signals.has_number_of_joint, names)):
        return
    model, alphabet = ", ".join(names[:MAX_NAMES]), ", ".join(sorted(names)[:MAX_NAMES])
    sorted_order_note = f" (sorted by name, as ROS drivers have it, they would be {alphabet})"
    subject = "columns" if positions else "commands"
    result.checks.append(
        f"order of joints: the log does not name those of its {subject}; they are taken in the "
        f"model's order, {model}, which is a "
        f"guess{sorted_order_note if model != alphabet else ''}; if another order is right, "
        "exchange the `column` lines"
    )
