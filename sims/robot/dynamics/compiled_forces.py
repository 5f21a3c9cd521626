"""Effect forces on a batch of robots by a compiled program.

With numpy, each effect is evaluated separately, which takes longer than MuJoCo's step. Here the
computation of the effects is traced once, as for the systems of `sims.engines.compiled`, and
written as instructions on registers with one column for each batch element. Effects that cannot be
traced, or that give other numbers then, are evaluated with numpy.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.core.effect import Effect, HiddenState, HiddenStateEffect
from sims.core.simulator import Array
from sims.engines.compiled.force_program import InstructionList, emit_instructions
from sims.engines.compiled.kernel import make_instruction_runner
from sims.engines.compiled.traced_array import (
    PER_ELEMENT,
    PER_EVALUATION,
    ExpressionGraph,
    NotTraceableError,
    collect_nodes,
    make_input_vector,
)
from sims.robot.dynamics.effect_forces import (
    EffectForces,
    compute_effect_forces,
    compute_friction_limits,
    compute_hidden_state_forces,
    make_snapshot,
)
from sims.robot.dynamics.midpoint_state import JointStates, predict_midpoint
from sims.robot.robot_system import RobotSystem

MAX_PROGRAM_DEVIATION = 1e-9
"""Maximum deviation of a program from its source, as a share of the largest number."""
CHECKED_INSTANTS = 16
"""Maximum number of times at which a program is compared with its source."""
MAX_CACHED_PROGRAMS = 500
"""Maximum number of cached programs for one robot and set of inputs."""
TEST_STATE_SIZES = (0.01, 1.0, 10.0)
"""Standard deviations of the random states at which a program is compared with NumPy, SI units."""


class _TracedEffect(NamedTuple):
    """An effect prepared for tracing.

    Attributes:
        effect: the effect.
        c: (K, 1, 1) traced coefficients.
        state: traced hidden state; None for effects without one.
    """

    effect: Effect
    c: Any
    state: HiddenState | None


class _Program(NamedTuple):
    """Forces of effects as instructions.

    Attributes:
        instructions: instructions on groups of registers: time at the beginning and at the middle
            of a step, step length, integration interval of hidden states, motion, inputs,
            stiffness, coefficients, hidden states.
        force: (D,) registers of the forces.
        limit: (D,) registers of the limits of dry friction.
        states: (2 H,) registers of the hidden states after the step.
    """

    instructions: InstructionList
    force: NDArray[np.intp]
    limit: NDArray[np.intp]
    states: NDArray[np.intp]


class _Tracing:
    """Traced state of a robot, and programs of the effects that are evaluated at it."""

    def __init__(self, system: RobotSystem, inputs: tuple[str, ...]) -> None:
        """Make symbols for everything that effects may read, and two states made of them.

        Effects are called with these states instead of numbers, which records their arithmetic
        as an expression graph. The two states are at the beginning of a step, and at its middle,
        which is predicted (midpoint rule). Time, states and inputs change in each step; the servo
        stiffness is constant for a batch element.
        """
        graph = ExpressionGraph()
        joints = len(system.coordinates)
        self._graph = graph
        self._t, self._midpoint_time, self._step, self._state_interval = (
            make_input_vector(graph, 1, PER_EVALUATION) for _ in range(4)
        )
        motion = [make_input_vector(graph, joints, PER_EVALUATION) for _ in JointStates._fields]
        self._motion = motion
        self._inputs = {name: make_input_vector(graph, 1, PER_EVALUATION) for name in inputs}
        self._stiffness = make_input_vector(graph, joints, PER_ELEMENT)
        joint_states = JointStates(*motion)
        instants = [(self._t, joint_states.x, joint_states.v, joint_states.transmission_loads)]
        instants.append(
            (
                self._midpoint_time,
                *predict_midpoint(joint_states.x, joint_states.v, joint_states.a, self._step),
                joint_states.at_midpoint,
            )
        )
        self._begin, self._middle = (
            make_snapshot(system, t, x, v, dict(self._inputs), np.stack(sides), self._stiffness)
            for t, x, v, sides in instants
        )
        self._traced_effects: dict[tuple[type[Effect], int], _TracedEffect] = {}
        self._programs: dict[tuple[type[Effect], ...], _Program] = {}
        self.is_compilable: dict[type[Effect], bool] = {}

    def get_program(self, effects: Sequence[Sequence[Effect]]) -> _Program:
        """Return the program for forces, frictions and effects with hidden states.

        Raises:
            NotTraceableError: an effect cannot be traced, or there are too many effects.
        """
        key = tuple(type(effect) for group in effects for effect in group)
        if key not in self._programs:
            if len(self._programs) == MAX_CACHED_PROGRAMS:
                self._programs.clear()
            self._programs[key] = self._compose_program(effects)
        return self._programs[key]

    def _compose_program(self, effects: Sequence[Sequence[Effect]]) -> _Program:
        """Trace all given effects, and write the instructions that compute their sum.

        The three groups of `effects` are forces, dry frictions and effects with hidden
        states. Each effect is called with symbols, which records its arithmetic. The outputs are
        the total force and the friction limit of each joint, and the hidden states after the step.
        The order of `groups` fixes the order of the input registers, see `_Program.instructions`.
        """
        counts: Counter[type[Effect]] = Counter()
        traced: list[list[_TracedEffect]] = []
        for group in effects:
            traced.append([])
            for effect in group:
                # An effect may occur twice: alone, and as a member of a family in other batch
                # elements.
                traced[-1].append(self._make_graph_effect(effect, counts[type(effect)]))
                counts[type(effect)] += 1
        forces, frictions, hidden = (
            [(traced_effect.effect, traced_effect.c) for traced_effect in group] for group in traced
        )
        states = [
            traced_effect.state for traced_effect in traced[2] if traced_effect.state is not None
        ]
        force: Any = compute_effect_forces(forces, self._middle)  # type: ignore[arg-type]
        later_states: list[HiddenState] = []
        if hidden:
            moments = self._begin, self._middle
            hidden_force, later_states = compute_hidden_state_forces(
                hidden,  # type: ignore[arg-type]
                moments,
                states,
                self._state_interval,
            )
            force = force + hidden_force
        limit: Any = compute_friction_limits(frictions, self._middle)  # type: ignore[arg-type]
        # A hidden state has a position x and a rate v.
        later_parts: Any = [part for state in later_states for part in (state.x, state.v)]
        outputs = [self._get_nodes(values) for values in (force, limit, *later_parts)]
        state_inputs: Any = [part for state in states for part in (state.x, state.v)]
        coefficients = [traced_effect.c for group in traced for traced_effect in group]
        clock = self._t, self._midpoint_time, self._step, self._state_interval
        groups = [*((part,) for part in clock), *((part,) for part in self._motion)]
        groups += [tuple(self._inputs.values()), (self._stiffness,), tuple(coefficients)]
        groups.append(tuple(state_inputs))
        instructions = emit_instructions(
            [collect_nodes(*group) for group in groups],
            [node for nodes in outputs for node in nodes],
        )
        registers = [
            np.array([instructions.place[node] for node in nodes], dtype=np.intp)
            for nodes in outputs
        ]
        state_registers = np.concatenate([np.empty(0, dtype=np.intp), *registers[2:]])
        return _Program(instructions, registers[0], registers[1], state_registers)

    def _make_graph_effect(self, effect: Effect, number: int) -> _TracedEffect:
        """Return an effect with graph inputs for its coefficients and its hidden state.

        `number` counts earlier occurrences of the same class in a program, each with inputs
        of its own.

        Raises:
            NotTraceableError: the effect has attributes, which a compiled program would freeze.
        """
        kind = type(effect), number
        if kind not in self._traced_effects:
            if getattr(effect, "__dict__", None):
                raise NotTraceableError("it has instance attributes, which a trace cannot follow")
            c = make_input_vector(self._graph, len(effect.coefficients), PER_ELEMENT).T[:, :, None]
            state = None
            if isinstance(effect, HiddenStateEffect):
                state = HiddenState(
                    *(make_input_vector(self._graph, 1, PER_EVALUATION) for _ in range(2))
                )
            self._traced_effects[kind] = _TracedEffect(effect, c, state)
        return self._traced_effects[kind]

    @staticmethod
    def _get_nodes(values: Any) -> list[Any]:
        """Return the nodes of a traced value; the shape of a hidden state may have changed."""
        if not hasattr(values, "nodes"):
            raise NotTraceableError("its result does not depend on its arguments")
        return collect_nodes(values)


class CompiledForces:
    """Effect forces computed by a program, with the interface of `effect_forces.EffectForces`.

    Attributes:
        has_dry_friction: as in `EffectForces`.
        addresses: as in `EffectForces`.
        loaded: as in `EffectForces`.
    """

    def __init__(self, forces: EffectForces, program: _Program) -> None:
        """Allocate registers for all batch elements, and write the values that stay constant.

        Registers are an array with a row for each value of the program and a column for each batch
        element. Constant are the numbers of the program itself, the step length, the servo
        stiffness and the coefficients. Instructions that depend only on them run once here; the
        others run in each step.

        Args:
            forces: effects to evaluate.
            program: program of these effects.
        """
        self.has_dry_friction = forces.has_dry_friction
        self.addresses = forces.addresses
        self.loaded = forces.loaded
        self._source = forces
        self._program = program
        instructions = program.instructions
        batch_size, joints = forces.stiffness.shape
        self._registers = r = np.zeros((len(instructions.place), batch_size))
        r[instructions.first : instructions.first + instructions.values.size] = instructions.values[
            :, None
        ]
        # First registers of the input groups, in the order of `_compose_program`.
        *clock, u, stiffness, c, states = instructions.rows
        self._t, self._midpoint_time, step, self._state_interval, *motion = clock
        self._motion = [slice(first, first + joints) for first in motion]
        self._u = slice(u, stiffness)
        self._states = slice(states, instructions.first)
        r[step] = forces.step
        r[stiffness:c] = forces.stiffness.T
        coefficients = [own[:, :, 0] for _, own in _list_effects(forces)]
        r[c:states] = np.concatenate(coefficients)
        # Bounds of the instructions that run once for an element, and of those for each step.
        first_once, first_in_step, end, _ = instructions.ends.tolist()
        make_instruction_runner(instructions.code, first_once, first_in_step, r)()
        self._run = make_instruction_runner(instructions.code, first_in_step, end, r)

    @cached_property
    def _stacked_inputs(self) -> Array:
        """Applied inputs (S, U, L)."""
        return np.ascontiguousarray(
            np.stack(list(self._source.applied_inputs.values())).transpose(2, 0, 1)
        )

    @property
    def registers(self) -> Array:
        """Registers (registers, L) of the program."""
        return self._registers

    @property
    def input_values(self) -> Array:
        """Applied inputs (S, U, L) over S steps: U inputs of L batch elements."""
        if not self._source.applied_inputs:
            return np.zeros((1, 0, self._registers.shape[1]))
        return self._stacked_inputs

    @property
    def layout(self) -> dict[str, Any]:
        """Fields of `CallbackContext` that are equal for all batch elements.

        They are numbers of registers and instructions, and arrays.
        """
        instructions = self._program.instructions
        _, begin, end, _ = instructions.ends.tolist()
        x, v, a, *_ = (rows.start for rows in self._motion)
        return {
            "code": instructions.code,
            "begin": begin,
            "end": end,
            "t": self._t,
            "midpoint": self._midpoint_time,
            "past": self._state_interval,
            "x": x,
            "v": v,
            "a": a,
            "first_input": self._u.start,
            "first_state": self._states.start,
            "forces": self._program.force,
            "limits": self._program.limit,
            "next_states": self._program.states,
            "positions": self.addresses.positions,
            "velocities": self.addresses.velocities,
            "step": np.array([self._source.step]),
        }

    def begin(self, joint_states: JointStates) -> None:
        """Set the hidden states at the beginning of a motion."""
        hidden = self._source.hidden
        if not hidden:
            return
        snapshot = self._source.make_step_snapshot(0, joint_states)
        states = [effect.begin(c, snapshot) for effect, c in hidden]
        initial = [part for state in states for part in (state.x, state.v)]
        self._registers[self._states] = np.concatenate(initial, axis=1).T

    def compute(self, k: int, joint_states: JointStates) -> tuple[Array, Array]:
        """Run the program for step k of all batch elements; see `EffectForces.compute`.

        Shapes: L batch elements, D joints.

        Args:
            k: number of the step.
            joint_states: states of the joints at the beginning of the step.

        Returns:
            Forces (L, D) and limits of dry friction (L, D), in N or N m.
        """
        registers = self._registers
        for rows, values in zip(self._motion, joint_states, strict=True):
            registers[rows] = values.T
        registers[self._t] = k * self._source.step
        registers[self._midpoint_time] = (k + 0.5) * self._source.step
        if self._source.applied_inputs:
            registers[self._u] = self._stacked_inputs[k]
        hidden = self._source.hidden
        # Hidden states advance from the middle of one step to that of the next; the first time,
        # from the beginning of the motion, by half a step.
        if hidden and k < 2:
            registers[self._state_interval] = self._source.step if k else 0.5 * self._source.step
        if k == 0:
            self.begin(joint_states)
        self._run()
        if hidden:
            registers[self._states] = registers[self._program.states]
        return registers[self._program.force].T, registers[self._program.limit].T


def compile_forces(forces: EffectForces) -> CompiledForces | None:
    """Compile the forces of effects into instructions, which run in every step without Python.

    The result is None if there is nothing to compile, if an effect cannot be traced (its arithmetic
    cannot be recorded), or if the program would be too large; then the caller evaluates `forces`
    with NumPy. Traces are kept by the names of the inputs, and programs by the classes of effects.
    """
    groups = [[effect for effect, _ in group] for group in _list_groups(forces)]
    if not any(groups):
        return None
    inputs = tuple(forces.applied_inputs)
    tracings = forces.system.traced
    if inputs not in tracings:
        tracings[inputs] = _Tracing(forces.system, inputs)
    tracing = tracings[inputs]
    if not all(_can_compile(tracing, forces, effect) for effect, _ in _list_effects(forces)):
        return None
    try:
        return CompiledForces(forces, tracing.get_program(groups))
    except NotTraceableError:  # The program is too large; the effects themselves are valid.
        return None


def _can_compile(tracing: _Tracing, forces: EffectForces, effect: Effect) -> bool:
    """Return whether an effect can be traced, and then gives the same numbers as with NumPy.

    Each class of effects is tested once; a failure is reported on standard error, unless the effect
    declares that it cannot be traced.

    Args:
        tracing: traced state of the robot.
        forces: effects of the batch, evaluated by NumPy.
        effect: effect of the library: a force, friction, input, sensor or contact law.
    """
    if not effect.is_traceable:
        return False
    kind = type(effect)
    if kind not in tracing.is_compilable:
        tracing.is_compilable[kind] = False
        try:
            _check_against_numpy(tracing, _select_effect(forces, effect))
            tracing.is_compilable[kind] = True
        # An effect of a user may raise any exception when it is evaluated with traced values.
        except Exception as reason:
            text = str(reason) or type(reason).__name__
            sys.stderr.write(
                f"simgap: effect {effect.name} is evaluated with NumPy, "
                f"since it cannot be compiled: {text}\n"
            )
    return tracing.is_compilable[kind]


def _check_against_numpy(tracing: _Tracing, forces: EffectForces) -> None:
    """Compare an effect's program with numpy at random states.

    Positions, velocities and loads are random numbers of different sizes, with a fixed seed, so
    that the answer is the same in each process.

    Args:
        tracing: traced state of the robot.
        forces: effects, evaluated by NumPy.

    Raises:
        NotTraceableError: the results differ.
    """
    program = tracing.get_program(
        [[effect for effect, _ in group] for group in _list_groups(forces)]
    )
    compiled = CompiledForces(forces, program)
    rng = np.random.default_rng(0)
    steps = min([CHECKED_INSTANTS, *(u.shape[1] for u in forces.applied_inputs.values())])
    for step_index in range(steps):
        shape = (len(JointStates._fields), *forces.stiffness.shape)
        joint_states = JointStates(*(rng.normal(size=shape) * rng.choice(TEST_STATE_SIZES)))
        for result, expected in zip(
            compiled.compute(step_index, joint_states),
            forces.compute(step_index, joint_states),
            strict=True,
        ):
            tolerance = MAX_PROGRAM_DEVIATION * np.abs(expected[np.isfinite(expected)]).max(
                initial=0.0
            )
            if not np.allclose(
                result, expected, rtol=MAX_PROGRAM_DEVIATION, atol=tolerance, equal_nan=True
            ):
                raise NotTraceableError("compiled it gives other numbers")


def _list_groups(forces: EffectForces) -> list[Sequence[tuple[Effect, Array]]]:
    return [forces.forces, forces.frictions, forces.hidden]


def _list_effects(forces: EffectForces) -> list[tuple[Effect, Array]]:
    return [pair for group in _list_groups(forces) for pair in group]


def _select_effect(forces: EffectForces, effect: Effect) -> EffectForces:
    """Return the forces of one effect without the others, to test whether it can be compiled."""
    own = tuple(pair for pair in _list_effects(forces) if pair[0] is effect)
    return EffectForces(
        forces.system, own, forces.applied_inputs, forces.addresses, forces.stiffness, forces.step
    )
