"""Program on registers that computes the forces of effects on a batch of robots in every step.

With NumPy (`effect_forces`), each effect is evaluated separately, which takes longer than MuJoCo's
step. So the computation of all effects is one program on registers with one column for each batch
element, as for the systems of `sims.engines.compiled`. Effects that cannot be traced are evaluated
with NumPy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from sims.core.effect import ActiveEffects, Effect, HiddenState
from sims.core.simulator import Array
from sims.engines.compiled.register_programs import (
    ArrayFunction,
    Evaluator,
    PreparedProgram,
    TracedPrograms,
    TracedSource,
    make_numpy_program,
)
from sims.engines.compiled.traced_array import PER_ELEMENT, PER_EVALUATION
from sims.robot.dynamics.active_effects import LOAD_DEPENDENT_EFFECTS, StepEffects
from sims.robot.dynamics.effect_forces import (
    compute_effect_forces,
    compute_friction_limits,
    make_snapshot,
)
from sims.robot.dynamics.hidden_states import compute_hidden_state_forces
from sims.robot.dynamics.midpoint_state import JointStates, Mask, predict_midpoint
from sims.robot.dynamics.mujoco_batch import JointAddresses
from sims.robot.robot_system import RobotSystem

TESTED_STATES = 16
"""Number of random states at which a program is compared with NumPy."""
TEST_STATE_SIZES = (0.01, 1.0, 10.0)
"""Standard deviations of these states, SI units."""


class CallbackLayout(NamedTuple):
    """Registers of a program that MuJoCo's callback reads and writes; see `CallbackContext`."""

    t: int
    midpoint: int
    past: int
    x: int
    v: int
    a: int
    first_input: int
    first_state: int


class StepForces:
    """Forces of effects on a batch, computed on registers in every step.

    Attributes:
        has_dry_friction: (L, D) whether an effect adds dry friction.
        loaded: (L,) whether an effect depends on the loads of transmissions.
        addresses: addresses of the joints.
        step: step length in seconds.
        prepared: program of the forces, with its registers. Its outputs are the forces (D,), the
            limits of dry friction (D,), and the hidden states after the step (2 H,).
        depends_on_switches: whether switched servos change the forces.
    """

    def __init__(
        self,
        system: RobotSystem,
        acting: ActiveEffects,
        applied_inputs: Mapping[str, Array],
        addresses: JointAddresses,
        stiffness: Array,
        step: float,
        working: Array | None = None,
    ) -> None:
        """Find or make the program of the effects, and write the values that stay constant.

        1. Note in which batch elements an effect adds dry friction or depends on the loads of
           transmissions, because these need additional work in each step.
        2. Find a compiled program of these effects in the system's cache, or make one. Effects that
           cannot be compiled are evaluated by NumPy.
        3. Divide the registers of the program into groups, in the order of the inputs of
           `_make_function`, and write those that do not change from step to step.

        Args:
            system: system of the robot.
            acting: effects at one place each.
            applied_inputs: applied inputs (L, S) by name, of L batch elements over S steps.
            addresses: addresses of the D joints.
            stiffness: (L, D) stiffness of the position servos.
            step: step length in seconds.
            working: (L, S, D) 0 where a position servo is switched off and 1 elsewhere; None if all
                are on.
        """
        self.addresses, self.step = addresses, step
        self.depends_on_switches = working is not None
        self._system, self._applied_inputs = system, applied_inputs
        self._stiffness, self._working = stiffness, working
        # 1. Dry friction and loads.
        effects = StepEffects.from_active(acting)
        self._hidden = effects.hidden
        self.has_dry_friction: Mask = np.zeros(stiffness.shape, dtype=bool)
        for effect, c in effects.frictions:
            self.has_dry_friction[:, effect.coordinate] |= (c != 0).any(axis=0)[:, 0]
        self.loaded: Mask = np.zeros(len(stiffness), dtype=bool)
        for loading, c in acting:
            if loading.of in LOAD_DEPENDENT_EFFECTS:
                self.loaded |= (c != 0).any(axis=0)[:, 0]
        # 2. Program.
        inputs = tuple(applied_inputs)
        function = _make_function(system, inputs, effects)
        programs: TracedPrograms = system.traced.setdefault(inputs, TracedPrograms())
        sources = [
            TracedSource(effect, f"effect {effect.name}", partial(self._make_test, effect, c))
            for group in effects
            for effect, c in group
        ]
        program = programs.find(function, sources) or make_numpy_program(function)
        # 3. Registers, one row for each number and one column for each batch element. Each group is
        # a slice of rows. The motion has one group for each field of `JointStates`.
        self.prepared = PreparedProgram(program, len(stiffness))
        self.registers = registers = self.prepared.r
        groups = [slice(*ends) for ends in pairwise(function.input_ends)]
        self._time_group, self._midpoint_time_group, step_group, self._interval_group = groups[:4]
        *self._motion_groups, self._input_group = groups[4:-3]
        self._stiffness_group, coefficient_group, self._state_group = groups[-3:]
        registers[step_group] = step
        registers[self._stiffness_group] = stiffness.T
        registers[coefficient_group] = effects.coefficients
        # The first part of the program computes what stays constant; the second part is that of a
        # step; robots have no third part, the impacts.
        prepare_elements, self._run, _ = self.prepared.make_runners()
        prepare_elements()

    def _make_test(self, effect: Effect, c: Array) -> tuple[ArrayFunction, Iterator[Array]]:
        """Return the array function of one effect, and random inputs at which to test its program.

        An array function computes the forces of the effect from groups of numbers, such as the
        motion and the coefficients. A compiled program must agree with NumPy there
        (`TracedSource`). The random numbers have different sizes and a fixed seed, so that the
        answer is the same in each process.

        Args:
            effect: effect in the batch.
            c: (K, L, 1) its K coefficients for L batch elements.
        """
        effects = StepEffects.from_active(((effect, c),))
        function = _make_function(self._system, tuple(self._applied_inputs), effects)
        # Rows of the inputs of each group.
        groups = [slice(*ends) for ends in pairwise(function.input_ends)]

        def make_samples() -> Iterator[Array]:
            """Yield values (inputs, L) of all inputs of the function: random motions and states.

            Each yield is a test at other values, in L batch elements. Times, step, stiffness and
            coefficients are not random.
            """
            rng = np.random.default_rng(0)
            shape = function.input_ends[-1], len(self._stiffness)
            for number in range(TESTED_STATES):
                sample = rng.normal(size=shape) * rng.choice(TEST_STATE_SIZES)
                # The first groups are the time at the beginning and in the middle of a step, its
                # length, and the interval over which hidden states advance: all in steps.
                for group, steps in zip(groups, (number, number + 0.5, 1.0, 1.0), strict=False):
                    sample[group] = steps * self.step
                # The last groups are stiffness, coefficients and hidden states.
                *_, stiffness_group, coefficient_group, _ = groups
                sample[stiffness_group] = self._stiffness.T
                sample[coefficient_group] = effects.coefficients
                yield sample

        return function, make_samples()

    @cached_property
    def input_values(self) -> Array:
        """Applied inputs (S, U, L) over S steps: U inputs of L batch elements."""
        if not self._applied_inputs:
            return np.zeros((1, 0, len(self._stiffness)))
        inputs = np.stack(list(self._applied_inputs.values()))
        return np.ascontiguousarray(inputs.transpose(2, 0, 1))

    @property
    def layout(self) -> CallbackLayout:
        """First registers of the groups that MuJoCo's callback reads and writes."""
        x, v, a, *_ = self._motion_groups
        times = self._time_group, self._midpoint_time_group, self._interval_group
        # In the order of the fields of the layout.
        groups = (*times, x, v, a, self._input_group, self._state_group)
        return CallbackLayout(*(group.start for group in groups))

    def begin(self, joint_states: JointStates) -> None:
        """Set the hidden states of effects at the beginning of a motion, in the registers.

        Args:
            joint_states: joint states at the beginning of the first step.
        """
        if not self._hidden:
            return
        # Inputs (L, 1) in the first step.
        inputs = {name: u[:, 0, None] for name, u in self._applied_inputs.items()}
        snapshot = make_snapshot(
            self._system,
            np.zeros((len(self._stiffness), 1)),
            joint_states.x,
            joint_states.v,
            inputs,
            np.stack(joint_states.transmission_loads),
            self.registers[self._stiffness_group].T,
        )
        states = [effect.begin(c, snapshot) for effect, c in self._hidden]
        # A hidden state has a position x and a rate v, (L, 1) each.
        parts = [part for state in states for part in (state.x, state.v)]
        self.registers[self._state_group] = np.concatenate(parts, axis=1).T

    def compute(self, k: int, joint_states: JointStates) -> tuple[Array, Array]:
        """Compute forces and dry friction limits (L, D) at the middle of step k, in N or N m.

        MuJoCo holds forces over a step. Evaluated at the predicted middle, they have an error of
        second order only. Hidden states of effects advance to the same time. All L batch elements
        and D joints are evaluated at once. The inputs are written into the registers of the
        program, which has a column for each batch element, and the results are read from there.

        Args:
            k: number of the step; must increase by one from call to call.
            joint_states: joint states at the beginning of the step.

        Returns:
            Forces, and limits of dry friction, (L, D) each.
        """
        registers = self.registers
        for rows, values in zip(self._motion_groups, joint_states, strict=True):
            registers[rows] = values.T
        registers[self._time_group] = k * self.step
        registers[self._midpoint_time_group] = (k + 0.5) * self.step
        # Without inputs there is one row, which holds for all steps.
        registers[self._input_group] = self.input_values[min(k, len(self.input_values) - 1)]
        # Hidden states advance from the middle of the previous step to the middle of this one.
        registers[self._interval_group] = self.step if k else 0.5 * self.step
        if self._working is not None:
            registers[self._stiffness_group] = (self._stiffness * self._working[:, k]).T
        # The initial hidden states depend on the state and the inputs of the first step.
        if k == 0:
            self.begin(joint_states)
        self._run()
        # Numbers of the registers with the results; the hidden states begin the next step.
        ((force, limit, states),) = self.prepared.program.outputs
        registers[self._state_group] = registers[states]
        return registers[force].T, registers[limit].T


def _make_function(
    system: RobotSystem, input_names: Sequence[str], effects: StepEffects
) -> ArrayFunction:
    """Return the array function that evaluates effects on a robot in one step.

    Its inputs are these groups of registers, with one column for each batch element:

    * time at the beginning and at the middle of the step, step length, and interval over which
      hidden states advance (1 each),
    * the motion, which is the fields of `JointStates` (D joints each),
    * inputs of the robot, stiffness of servos (D), coefficients of the effects, and hidden states
      (position and rate of each).

    Its outputs are the forces (D), the limits of dry friction (D), and the hidden states after the
    interval.

    Args:
        system: system of the robot, with D joints.
        input_names: names of the inputs.
        effects: the effects.
    """
    # A hidden state has a position and a rate.
    joints, states = len(system.coordinates), 2 * len(effects.hidden)

    def bind(t: Any, middle: Any, step: Any, interval: Any, *values: Any) -> tuple[Evaluator]:
        """Return the function that evaluates all effects on given registers.

        Each group of registers is an array with one row for each batch element, and one column for
        each number.

        Args:
            t: time at the beginning of the step.
            middle: time at its middle.
            step: its length in seconds.
            interval: time over which hidden states advance.
            *values: motion (fields of `JointStates`), inputs, stiffness, coefficients, hidden
                states.
        """
        *motion, u, stiffness, coefficients, hidden_states = values
        at = JointStates(*motion)
        inputs = {name: u[:, i, None] for i, name in enumerate(input_names)}
        acting = effects.with_coefficients(coefficients)

        def evaluate() -> tuple[Any, Any, Any]:
            """Return forces and friction limits (L, D) at the middle of a step, and hidden states.

            There are L batch elements and D joints. The H hidden states (L, 2 H), a position and a
            rate each, are those after the interval; without any, the result is an array (1, 0).
            """
            x, v = predict_midpoint(at.x, at.v, at.a, step)
            midpoint = make_snapshot(
                system, middle, x, v, inputs, np.stack(at.at_midpoint), stiffness
            )
            force = compute_effect_forces(acting.forces, midpoint)
            later_states = np.zeros((1, 0))
            # Hidden states advance with the state at the beginning of the step, and act at its
            # middle.
            if acting.hidden:
                loads = np.stack(at.transmission_loads)
                start = make_snapshot(system, t, at.x, at.v, inputs, loads, stiffness)
                columns = [hidden_states[:, i, None] for i in range(states)]
                earlier = [HiddenState(*columns[i : i + 2]) for i in range(0, states, 2)]
                added, later = compute_hidden_state_forces(
                    acting.hidden, (start, midpoint), earlier, interval
                )
                force = force + added
                later_states = np.concatenate([p for s in later for p in (s.x, s.v)], axis=1)
            limit = compute_friction_limits(acting.frictions, midpoint)
            return force, limit, later_states

        return (evaluate,)

    # Sizes of the groups, and how often their values change: coefficients never do in a batch.
    sizes = [1] * 4 + [joints] * len(JointStates._fields) + [len(input_names), joints]
    groups = [(size, PER_EVALUATION) for size in sizes]
    groups += [(len(effects.coefficients), PER_ELEMENT), (states, PER_EVALUATION)]
    # There is one evaluator (`evaluate`), and these are the sizes of its three outputs.
    return ArrayFunction(groups, ((joints, joints, states),), bind)
