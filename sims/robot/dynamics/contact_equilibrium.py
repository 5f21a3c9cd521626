"""States of a robot on the ground at which its contacts are in equilibrium.

A contact of MuJoCo is a stiff spring and damper: its depth is a fraction of a millimetre, and it
settles within some time constants of its reference, such as 60 ms. A measured pose has more noise
than this depth. A simulation that begins at the measured state therefore lifts wheels and feet off,
or throws the robot up. After the transient, the state is on a slow manifold (U. Maas, S. B. Pope,
Combustion and Flame 88, 239, 1992, doi:10.1016/0010-2180(92)90034-M), on which the velocity u of
each contact point changes only as slowly as the robot moves:

    u_n = 0,    du/dt = J(x) a(x, v) + (dJ/dt) v = 0,    u = J(x) v                            (1)

with the Jacobian J of the contact point and the acceleration a of the robot, which includes the
contact forces. The normal part of du/dt determines the depth of the contact, and the tangential
part determines its creep. The state z = (x, v) that is most likely, given a measured or smoothed
one z_m and the inverse of its covariance W^T W, minimises

    |W (z - z_m)|^2 + |u_n / e_v|^2 + |(du/dt) / e_a|^2                                        (2)

by damped Gauss-Newton steps. Legged robots are observed with the same constraints (M. Bloesch et
al., Robotics: Science and Systems VIII, 2012, doi:10.15607/RSS.2012.VIII.003).
"""

from __future__ import annotations

from copy import copy
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from sims.core.simulator import Array, Scenario
from sims.robot.dynamics.run_batches import RobotRunBatch
from sims.robot.model_field_effects import select_model_field_effects
from sims.robot.mujoco_messages import capture_mujoco_warnings
from sims.robot.robot_simulator import RobotSimulator

SPEED_TOLERANCE = 1e-3
"""Speed in m/s at which the points of a settled contact approach each other: e_v in (2)."""
ACCELERATION_TOLERANCE = 0.1
"""Acceleration in m/s^2 of the points of a settled contact: e_a in (2)."""
DISTANCE_TOLERANCE = 1e-5
"""Tolerance in m of the depth that an open contact is moved to."""
FIRST_DEPTH = 1e-4
"""Depth in m that an open contact is moved to."""
MAX_DISTANCE_SIGMAS = 3.0
"""Maximum measured distance of a contact that may be closed, in standard deviations."""
SEARCH_GAP = 0.02
"""Distance in m within which MuJoCo lists contacts."""
MAX_ITERATIONS = 8
"""Maximum number of Gauss-Newton steps."""
MAX_HALVINGS = 5
"""Maximum number of halvings of a step."""
MIN_DECREASE = 0.01
"""Minimum relative decrease of (2) for another step."""
SETTLED_COST = 1.0
"""Maximum of (2) per contact at which a measured state counts as settled."""
DIFFERENCES = (1e-7, 1e-6)
"""Sizes of finite differences of positions (rad or m) and velocities (per s)."""

_Key = tuple[int, int, int]
"""Geoms of a contact, and its number among the contacts of these geoms."""


class _Contact(NamedTuple):
    """State of a contact.

    Attributes:
        velocity: (n,) velocity u of the second geom against the first one at the contact point: its
            normal part, and two tangential ones unless the contact is frictionless.
        acceleration: (n,) its derivative du/dt.
        distance: distance of the geoms in m.
        is_closed: whether the contact exerts a force.
        normal: (nv,) row of J for the normal velocity.
    """

    velocity: Array
    acceleration: Array
    distance: float
    is_closed: bool
    normal: Array


class ContactModel:
    """A robot at the first instant of a run, whose contacts are evaluated at given states."""

    def __init__(self, simulator: RobotSimulator, theta: Array) -> None:
        """Copy the robot's MuJoCo model, with the active effects written into it.

        A large gap (`SEARCH_GAP`) makes MuJoCo report geoms that only nearly touch, too.

        Args:
            simulator: simulator of the robot.
            theta: (P,) values of the P parameters, of which effects have their coefficients.
        """
        import mujoco

        self._simulator = simulator
        self._acting = simulator.get_active_effects(theta[None])
        mujoco_batch = simulator.make_linearisation_batch(self._acting)
        # All elements of the batch get the same effects; the model of the first one is copied.
        mujoco_batch.write_effects(
            tuple(
                (effect, np.repeat(c, mujoco_batch.count, axis=1))
                for effect, c in select_model_field_effects(self._acting)
            )
        )
        self._model = copy(mujoco_batch.batch.get_model(0))
        self._model.geom_gap[:] = SEARCH_GAP
        self._data = mujoco.MjData(self._model)
        self._map_forces = mujoco_batch.map_forces
        self._joints = mujoco_batch.file_joints
        self._body_of_geom: list[int] = self._model.geom_bodyid.tolist()

    def begin_run(self, scenario: Scenario, x: Array, v: Array) -> None:
        """Set the inputs at the beginning of a run: first controls, forces and activations.

        Later calls of `evaluate` hold them, whatever the state is.

        Args:
            scenario: scenario of the run, whose first commands act.
            x: (D,) initial positions of the D joints, on which activations may depend.
            v: (D,) initial velocities.
        """
        import mujoco

        # The inputs of a batch of one element, over one step.
        commands = self._simulator.run_inputs(scenario)
        inputs = self._simulator.compute_controls(
            RobotRunBatch(scenario, commands, self._acting, x[None], v[None]), 1
        )
        mujoco.mj_resetData(self._model, self._data)
        self._data.ctrl[:] = inputs.controls[0, 0]
        self._data.qfrc_applied[:] = self._map_forces(inputs.forces[0, 0])
        self._data.act[:] = inputs.activations[0]

    def evaluate(self, state: Array) -> dict[_Key, _Contact]:
        """Return all contacts at a state (2 D,): positions, then velocities of the D joints.

        With the Jacobian J of a contact point, its velocity is u = J v and its acceleration is
        du/dt = J a + (dJ/dt) v, for velocities v and accelerations a of the robot. The change of J
        with time is the difference to the Jacobian after the robot has moved by one time step; a
        contact that no longer exists there counts as unchanged.

        Returns:
            The contacts by their two geoms and a number, which distinguishes contacts of the same
            geoms.
        """
        import mujoco

        model, data, joints = self._model, self._data, self._joints
        positions, velocities = np.split(state, 2)
        data.qpos[joints.positions] = positions
        data.qvel[joints.velocities] = velocities
        mujoco.mj_forward(model, data)
        v, a = data.qvel.copy(), data.qacc.copy()
        contacts = self._compute_jacobians()
        mujoco.mj_integratePos(model, data.qpos, v, model.opt.timestep)
        mujoco.mj_fwdPosition(model, data)
        contacts_after_step = self._compute_jacobians()
        result = {}
        for key, (jacobian, distance, is_closed) in contacts.items():
            later_jacobian, *_ = contacts_after_step.get(key, (jacobian,))
            acceleration = jacobian @ a + (later_jacobian - jacobian) @ v / model.opt.timestep
            normal = jacobian[0, joints.velocities]  # the first row is along the normal
            result[key] = _Contact(jacobian @ v, acceleration, distance, is_closed, normal)
        return result

    def _compute_jacobians(self) -> dict[_Key, tuple[Array, float, bool]]:
        """Return Jacobian (n, nv), distance in m, and whether it is closed, for each contact.

        The Jacobian maps the velocities (nv,) of the robot to that of the second geom against the
        first one at the contact point, in the frame of the contact: along its normal, and, with
        friction, along two tangents (n components, 1 or 3). A closed contact exerts a force. The
        key of a contact is its two geoms, and its number among the contacts of these geoms.
        """
        import mujoco

        model, data = self._model, self._data
        contacts: dict[_Key, tuple[Array, float, bool]] = {}
        jacobians = np.zeros((2, 3, model.nv))
        # A field of all contacts is much faster to read than one contact after another.
        all_contacts = data.contact
        frames, points = all_contacts.frame.reshape(-1, 3, 3), all_contacts.pos
        dims, distances = all_contacts.dim.tolist(), all_contacts.dist.tolist()
        addresses = all_contacts.efc_address.tolist()
        last_numbers: dict[tuple[int, int], int] = {}
        for i, (first, second) in enumerate(all_contacts.geom.tolist()):
            # Velocity of the contact point if it moves with the one or with the other geom.
            for jacobian, geom in zip(jacobians, (first, second), strict=True):
                mujoco.mj_jac(model, data, jacobian, None, points[i], self._body_of_geom[geom])
            first_jacobian, second_jacobian = jacobians
            # The rows of a frame are the normal and two tangents. MuJoCo's dimension 1 means a
            # contact without friction.
            directions = frames[i, : 3 if dims[i] > 1 else 1]
            relative = directions @ (second_jacobian - first_jacobian)
            number = last_numbers[first, second] = last_numbers.get((first, second), -1) + 1
            # A contact without a force has no constraint, and so the address -1.
            contacts[first, second, number] = relative, distances[i], addresses[i] >= 0
        return contacts


KnownJacobians: TypeAlias = dict[tuple[tuple[_Key, bool], ...], Array]
"""Derivatives (m, 2 D) of the residual of contact equilibrium by the state.

The key is the contacts that count, and whether each one is closed: they determine the rows.
"""


def settle_contacts(
    model: ContactModel,
    scenario: Scenario,
    start: tuple[Array, Array],
    sigma: tuple[Array, Array],
    weights: Array | None = None,
    known_jacobians: KnownJacobians | None = None,
) -> tuple[Array, Array]:
    """Return the likeliest first state of a run at which the contacts are in equilibrium.

    A simulation that begins at the measured state z_m would throw the robot up or let it fall,
    because contacts are stiffer than a measurement is accurate. The result z minimises

        |W (z - z_m)|^2 + |u_n / e_v|^2 + |(du/dt) / e_a|^2                                    (2)

    with the velocity u of the contact points, its normal part u_n, the tolerances e_v of a velocity
    and e_a of an acceleration, and W^T W, the inverse of the covariance of z_m. The steps are:

    1. Select the contacts that may be closed: those whose distance could be a measurement error.
    2. Linearise them by finite differences, and solve for a Gauss-Newton step.
    3. Halve the step until the sum decreases, and repeat from 2 until it hardly does.

    Args:
        model: the robot.
        scenario: scenario of the run, whose first commands act.
        start: (D,) measured or smoothed positions and velocities of D joints.
        sigma: (D,) standard deviations of a measurement of them.
        weights: (2 D, 2 D) W of (2), invertible; None if the errors of the start are independent
            with the standard deviations `sigma`. The readings of a whole run determine a velocity
            better than two of them do.
        known_jacobians: derivatives of nearly the same contacts, by the contacts and whether each
            is closed. They are used in place of finite differences while the steps decrease the sum
            (chord method), and new ones are added. By default, each iteration makes its own.

    Returns:
        (D,) positions and velocities; the measured ones if no contact may be closed.
    """
    measured = np.concatenate(start)  # z_m
    if weights is None:
        weights = np.diag(1.0 / np.concatenate(sigma))
    with capture_mujoco_warnings():
        # 1. Contacts that may be closed. The standard deviation of a distance follows from those of
        # the positions, by its derivatives along the normal.
        model.begin_run(scenario, *start)
        state, contacts = measured, model.evaluate(measured)
        keys = [
            key
            for key, contact in contacts.items()
            if contact.distance
            < MAX_DISTANCE_SIGMAS * float(np.linalg.norm(contact.normal * sigma[0]))
        ]
        if not keys:
            return start
        cost = _compute_cost(contacts, keys)
        for _ in range(MAX_ITERATIONS):
            # The contacts are already in equilibrium.
            if cost <= SETTLED_COST * len(keys):
                break
            # 2. Gauss-Newton step. The layout determines the rows of the derivatives.
            layout = tuple((key, contacts[key].is_closed) for key in keys)
            residual = _compute_residual(contacts, contacts, keys)
            # Without known derivatives, each iteration makes its own.
            reused = {} if known_jacobians is None else known_jacobians
            is_known = layout in reused
            if not is_known:
                reused[layout] = _differentiate(model, state, contacts, residual, keys)
            jacobian = reused[layout]
            step = _solve(jacobian, residual, weights @ (state - measured), weights)
            # 3. Step length. The cost is the sum (2) of contacts and distance from the measurement.
            for _ in range(MAX_HALVINGS):
                new_contacts = model.evaluate(state + step)
                offset = weights @ (state + step - measured)
                new_cost = _compute_cost(new_contacts, keys) + float(offset @ offset)
                if new_cost < cost:
                    break
                step = step / 2.0
            else:  # No step decreases the cost.
                if not is_known:
                    break
                # The reused derivatives are not valid here, so the next iteration makes new ones.
                del reused[layout]
                continue
            has_converged = cost - new_cost < MIN_DECREASE * cost
            state, contacts, cost = state + step, new_contacts, new_cost
            if has_converged:
                break
    positions, velocities = np.split(state, 2)
    return positions, velocities


def _differentiate(
    model: ContactModel,
    state: Array,
    contacts: dict[_Key, _Contact],
    residual: Array,
    keys: list[_Key],
) -> Array:
    """Return finite differences (m, 2 D) of the residual of contact equilibrium by the state.

    The columns are the D positions, then the D velocities.

    Args:
        model: the robot.
        state: (2 D,) positions and velocities.
        contacts: contacts at this state.
        residual: (m,) residual of m components at this state.
        keys: contacts that may be closed, which make up the residual.
    """
    jacobian = np.empty((residual.size, state.size))
    # `DIFFERENCES` has one size for all positions, and one for all velocities.
    for i, difference in enumerate(np.repeat(DIFFERENCES, state.size // 2).tolist()):
        moved = state.copy()
        moved[i] += difference
        # Which contacts are closed is that of the state itself, so that the rows are the same.
        changed = _compute_residual(model.evaluate(moved), contacts, keys)
        jacobian[:, i] = (changed - residual) / difference
    return jacobian


def _solve(jacobian: Array, residual: Array, offset: Array, weights: Array) -> Array:
    """Return the Gauss-Newton step (2 D,) for the sum of squares |offset|^2 + |residual|^2.

    With a step dz of the state z, the positions and velocities of D joints, the offset becomes
    offset + y with the weighted step y = W dz, and the residual becomes residual + J W^-1 y with
    the Jacobian J. The sum is smallest for the solution y of a linear least-squares problem.

    Args:
        jacobian: (m, 2 D) derivatives of the residual.
        residual: (m,) weighted residual of the contacts, of m components.
        offset: (2 D,) W (z - z_m), the weighted distance of the state z from the measured one.
        weights: (2 D, 2 D) W, a square root of the inverse covariance of the measured state.
    """
    weighted_jacobian = np.linalg.solve(weights.T, jacobian.T).T  # J W^-1
    rows = np.concatenate([np.eye(offset.size), weighted_jacobian])
    weighted_step, *_ = np.linalg.lstsq(rows, -np.concatenate([offset, residual]), rcond=None)
    step: Array = np.linalg.solve(weights, weighted_step).astype(np.float64)
    return step


def _compute_residual(
    contacts: dict[_Key, _Contact], reference: dict[_Key, _Contact], keys: list[_Key]
) -> npt.NDArray[np.float64]:
    """Return the residual (m,) of contact equilibrium, divided by its tolerances.

    A closed contact must have no normal velocity and no acceleration of its point: two components
    without friction, four with it. An open one must have no normal velocity and the depth
    `FIRST_DEPTH`, so that it closes: two components.

    Args:
        contacts: contacts at the state; one that does not exist there is taken from `reference`.
        reference: contacts at the state of the linearisation, which decide what is closed, so that
            the number of rows does not change with the state.
        keys: contacts that may be closed, which make up the residual.
    """
    rows: list[Array] = []
    for key in keys:
        contact = contacts.get(key, reference[key])
        # The first component of the velocity is along the normal.
        rows.append(contact.velocity[:1] / SPEED_TOLERANCE)
        if reference[key].is_closed:
            rows.append(contact.acceleration / ACCELERATION_TOLERANCE)
        else:
            rows.append(np.array([(contact.distance + FIRST_DEPTH) / DISTANCE_TOLERANCE]))
    return np.concatenate(rows)


def _compute_cost(contacts: dict[_Key, _Contact], keys: list[_Key]) -> float:
    """Return the sum of squares of the residual of contact equilibrium.

    The square of the acceleration of free fall is added for each open contact, so that closing one
    decreases the sum, by the same amount whichever number is open. If a contact does not exist at
    the state, the sum is infinite.

    Args:
        contacts: contacts at a state.
        keys: contacts that may be closed, which make up the residual.
    """
    if not all(key in contacts for key in keys):
        return float("inf")
    # The contacts at this state itself decide which of them are closed.
    residual = _compute_residual(contacts, contacts, keys)
    open_count = sum(not contacts[key].is_closed for key in keys)
    # An open contact falls with the acceleration of gravity, 9.81 m/s^2.
    falling = 9.81 / ACCELERATION_TOLERANCE
    return float(residual @ residual) + open_count * falling**2
