"""Force program of a system with effects: traced once and written as instructions.

A program has three parts: values that depend on an element's parameters alone, computed when an
element begins; the forces and the limit of dry friction, computed at every evaluation; and the
contact parameters with effects, computed at impacts.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from threading import Lock
from typing import Any, ClassVar, NamedTuple

import numpy as np

from sims.core.effect import Contact, Effect, Force, Friction
from sims.core.engine import IntegrationBatch
from sims.core.simulator import Array, Indices
from sims.core.system import StateSnapshot, System
from sims.engines.compiled.data_layout import (
    BLOCK_WIDTH,
    HAS_FRICTION,
    IN_E,
    IN_P,
    IN_T,
    OUT_E,
    OUT_LIMIT,
    OUT_MU,
    BlockBuffers,
    FloatArray,
    InputNames,
    IntTable,
    ProgramArrays,
    allocate_block,
    make_flags,
)
from sims.engines.compiled.kernel import make_instruction_runner
from sims.engines.compiled.numpy_forces import NUMPY_BLOCK_WIDTH, NumpyForces, lay_out_registers
from sims.engines.compiled.traced_array import (
    OPERATION_CODES,
    PER_ELEMENT,
    PER_EVALUATION,
    PER_IMPACT,
    ExpressionGraph,
    ExpressionNode,
    NotTraceableError,
    TracedArray,
    collect_nodes,
    make_constant_nodes,
    make_input_vector,
)

MAX_REGISTERS = 4000
"""Maximum number of registers of a program."""
MAX_CACHED_PROGRAMS = 2000
"""Maximum number of cached programs of a system."""
_TEST_STATES = ((0.0, 0.0), (0.37, 0.1))
"""Time (s) and shift of the initial state (SI units) at which a program is compared with NumPy."""
_TEST_IMPACT_SPEEDS = (0.3, 2.0)
"""Impact speeds at which a program is compared with NumPy, m/s."""


class PreparedProgram(NamedTuple):
    """Program with buffers in which its constants are set.

    Attributes:
        arrays: instructions and layout.
        block: buffers of the slots.
        numpy_forces: functions that the instructions call; None for traced programs.
    """

    arrays: ProgramArrays
    block: BlockBuffers
    numpy_forces: NumpyForces | None = None

    def raise_error(self) -> None:
        """Raise the exception of an array function that the instructions have called."""
        if self.numpy_forces is not None and self.numpy_forces.error is not None:
            raise self.numpy_forces.error

    def make_runners(self) -> tuple[Callable[[], None], ...]:
        """Return functions that run the parts of the program on all slots.

        The parts are the values of each element, the forces, and the contact parameters. If NumPy
        evaluates some forces, compiled code cannot raise their exceptions; they are raised after
        each part.
        """
        part_ends, r = self.arrays.ends.tolist(), self.block.r
        runners = [
            make_instruction_runner(self.arrays.code, first, last, r)
            for first, last in pairwise(part_ends)
        ]
        if self.numpy_forces is None:
            return tuple(runners)

        def make_checked(runner: Callable[[], None]) -> Callable[[], None]:
            """Wrap a runner so that it raises the exceptions of array functions afterwards."""

            def run() -> None:
                runner()
                self.raise_error()

            return run

        return tuple(map(make_checked, runners))


@dataclass(frozen=True)
class ForceProgram:
    """Traced force program.

    Attributes:
        arrays: instructions and layout.
        constants: (C,) values of the registers from `first` on.
        first: first register of the constants.
        registers: number of registers.
    """

    arrays: ProgramArrays
    constants: FloatArray
    first: int
    registers: int
    block_width: ClassVar[int] = BLOCK_WIDTH

    def prepare(self, width: int) -> PreparedProgram:
        """Allocate buffers of `width` slots."""
        block = allocate_block(self.registers, width)
        block.r[self.first : self.first + len(self.constants)] = self.constants[:, None]
        return PreparedProgram(self.arrays, block)


class NumpyForceProgram:
    """Force program of a system and effects that cannot be traced; see `numpy_forces`.

    Args:
        system: system whose forces are evaluated.
        names: input names and sizes.
        effects: effects that act.
    """

    block_width: ClassVar[int] = NUMPY_BLOCK_WIDTH

    def __init__(self, system: System, names: InputNames, effects: Sequence[Effect]) -> None:
        self.arrays, self._registers = lay_out_registers(system, names, effects)
        self._source = system, names, effects

    def prepare(self, width: int) -> PreparedProgram:
        """Allocate buffers of `width` slots, and instructions that read and write them."""
        block = allocate_block(self._registers, width)
        forces = NumpyForces(*self._source, self.arrays.rows, self.arrays.out, block.r)
        return PreparedProgram(self.arrays._replace(code=forces.code), block, forces)


class EffectProgram(NamedTuple):
    """Traced effect as a part of a program.

    Attributes:
        coefficients: (K, 1, 1) input nodes of the coefficients.
        force: (1, D) force, for a force effect.
        limit: (1, 1) friction limit, for a friction effect.
    """

    coefficients: Any
    force: TracedArray | None
    limit: TracedArray | None


class SystemTracer:
    """Traced system; effects are traced on first use.

    Raises:
        NotTraceableError: the system cannot be traced.
    """

    def __init__(self, system: System, names: InputNames) -> None:
        """Trace the system's force: record its operations as an expression graph.

        The system's function is called once with symbols instead of numbers. These inputs of the
        graph are: time `t`, position `x`, velocity `v` and inputs `u`, which change in each
        evaluation; parameters, which change only between batch elements; and restitution `e`,
        friction coefficient `mu` and normal speed of an impact.

        Args:
            system: system to trace.
            names: input names and sizes.
        """
        graph = ExpressionGraph()
        self.graph = graph
        self._system = system
        self._names = names
        self.t = make_input_vector(graph, 1, PER_EVALUATION)
        self.x = make_input_vector(graph, names.coordinates, PER_EVALUATION)
        self.v = make_input_vector(graph, names.coordinates, PER_EVALUATION)
        self.u: dict[str, Any] = {
            name: make_input_vector(graph, 1, PER_EVALUATION) for name in names.inputs
        }
        theta = make_input_vector(graph, names.parameters, PER_ELEMENT)
        constants: dict[str, Any] = {
            name: make_input_vector(graph, 1, PER_ELEMENT) for name in names.constants
        }
        self.e: Any
        self.mu: Any
        self.speed: Any
        self.e, self.mu, self.speed = (make_input_vector(graph, 1, PER_IMPACT) for _ in range(3))
        self.parameters = collect_nodes(theta, *constants.values())
        self._moment = StateSnapshot(system, theta, constants, self.t, self.x, self.v, self.u)
        self._shape = 1, names.coordinates
        self._force = self._broadcast_result(system.force(self._moment), self._shape)
        self._effects: dict[type[Effect], EffectProgram] = {}
        self._programs: dict[tuple[type[Effect], ...], ForceProgram] = {}

    def build_program(self, effects: Sequence[Effect]) -> ForceProgram:
        """Return the program of the system with these effects; it is cached by their classes.

        Raises:
            NotTraceableError: an effect cannot be traced.
        """
        key = tuple(map(type, effects))
        if key not in self._programs:
            if len(self._programs) == MAX_CACHED_PROGRAMS:
                self._programs.clear()
            self._programs[key] = _write_program(self._combine_traces(effects))
        return self._programs[key]

    def trace_effect(self, effect: Effect) -> EffectProgram:
        """Return an effect's force and friction limit as expressions of the graph.

        Each class of effects is traced once: its functions are called with traced arrays,
        which record the operations. Force and limit are None for effects without them. A contact
        effect acts on impacts; it is traced when a program is built.

        Raises:
            NotTraceableError: the effect cannot be traced.
        """
        kind = type(effect)
        if kind not in self._effects:
            count = len(effect.coefficients)
            c = make_input_vector(self.graph, count, PER_ELEMENT).T[:, :, None]
            force = limit = None
            if isinstance(effect, Force):
                force = self._broadcast_result(effect.force(c, self._moment), self._shape)
            elif isinstance(effect, Friction):
                limit = self._broadcast_result(effect.limit(c, self._moment), (1, 1))
            self._effects[kind] = EffectProgram(c, force, limit)
        return self._effects[kind]

    def _combine_traces(self, effects: Sequence[Effect]) -> _ProgramNodes:
        """Combine the traced system and effects into the inputs and outputs of one program.

        Forces and limits of dry friction are added up; without friction effects there is no limit.
        Contact effects change the restitution `e` and the friction coefficient `mu` one after the
        other. The inputs are groups of nodes in the order of `ProgramArrays.rows`.
        """
        force: Any = self._force
        limit: Any = None
        e: Any = self.e
        mu: Any = self.mu
        parameters = list(self.parameters)
        for effect in effects:
            c, effect_force, effect_limit = self.trace_effect(effect)
            parameters += collect_nodes(c)
            if effect_force is not None:
                force = force + effect_force
            if effect_limit is not None:
                limit = effect_limit if limit is None else limit + effect_limit
            if isinstance(effect, Contact):
                e = self._broadcast_result(effect.restitution(c, e, self.speed), (1, 1))
                mu = self._broadcast_result(mu + effect.friction(c), (1, 1))
        return _ProgramNodes(
            inputs=[
                *map(collect_nodes, (self.t, self.x, self.v)),
                collect_nodes(*self.u.values()),
                parameters,
                *map(collect_nodes, (self.e, self.mu, self.speed)),
            ],
            force=collect_nodes(force),
            limit=[] if limit is None else collect_nodes(limit),
            impact=collect_nodes(e, mu),
            flags=make_flags(self._system, self._names, effects),
        )

    def _broadcast_result(self, values: Any, shape: tuple[int, int]) -> TracedArray:
        """Return the result of an array function, broadcast to its expected shape."""
        if not isinstance(values, TracedArray):
            values = TracedArray(self.graph, make_constant_nodes(self.graph, values))
        return TracedArray(self.graph, np.broadcast_to(values.nodes, shape))


class _ProgramNodes(NamedTuple):
    """Input and output nodes of a program, in order."""

    inputs: list[list[ExpressionNode]]
    force: list[ExpressionNode]
    limit: list[ExpressionNode]
    impact: list[ExpressionNode]
    flags: IntTable


def _write_program(nodes: _ProgramNodes) -> ForceProgram:
    """Write traced expressions as instructions, and note the registers of inputs and outputs.

    Args:
        nodes: Expression graph with the outputs: forces, friction limit and impact.
    """
    outputs = [*nodes.force, *nodes.limit, *nodes.impact]
    instructions = emit_instructions(nodes.inputs, outputs)
    # -1 if the program has no dry friction; the register is then never read.
    limit = instructions.place[nodes.limit[0]] if nodes.limit else -1
    rows = [*instructions.rows, limit, *(instructions.place[node] for node in nodes.impact)]
    arrays = ProgramArrays(
        code=instructions.code,
        ends=instructions.ends,
        rows=np.array(rows, dtype=np.int64),
        out=np.array([instructions.place[node] for node in nodes.force], dtype=np.int64),
        flags=nodes.flags,
    )
    return ForceProgram(arrays, instructions.values, instructions.first, len(instructions.place))


class InstructionList(NamedTuple):
    """Expressions as instructions on registers.

    Attributes:
        code: (n, 5) operation, result register, three argument registers.
        ends: (4,) boundaries of the instructions per element, per evaluation and per impact.
        rows: first register of each group of inputs.
        place: register of each node.
        first: first register of the constants.
        values: (C,) constants.
    """

    code: IntTable
    ends: IntTable
    rows: list[int]
    place: dict[ExpressionNode, int]
    first: int
    values: FloatArray


def emit_instructions(
    groups: Sequence[Sequence[ExpressionNode]], outputs: Sequence[ExpressionNode]
) -> InstructionList:
    """Translate an expression graph to instructions that compute its outputs from its inputs.

    Every node of the graph gets a register of its own: first the inputs by group, then the
    constants, then the results of operations. Each operation becomes one instruction: its code, the
    register of its result, and those of three arguments (the first one fills up missing ones).
    Instructions are sorted by how often they must be repeated: once per batch element, per
    evaluation of forces, or per impact.

    Args:
        groups: groups of input nodes; the registers of a group are consecutive.
        outputs: output nodes.

    Raises:
        NotTraceableError: too many registers are needed.
    """
    registers: dict[ExpressionNode, int] = {}
    rows = []
    for group in groups:
        rows.append(len(registers))
        for node in group:
            registers[node] = len(registers)
    first_constant = len(registers)
    sorted_nodes = _sort_nodes(outputs)
    # Constants have consecutive registers, so that they are set by one assignment.
    values = []
    for node in sorted_nodes:
        if node.operation == "constant":
            registers[node] = len(registers)
            values.append(node.value)
    by_frequency: dict[int, list[list[int]]] = {PER_ELEMENT: [], PER_EVALUATION: [], PER_IMPACT: []}
    for node in sorted_nodes:
        if node.args:
            registers[node] = len(registers)
            args = [registers[arg] for arg in node.args]
            args += [args[0]] * (3 - len(args))
            by_frequency[node.change_frequency].append(
                [OPERATION_CODES[node.operation], registers[node], *args]
            )
    if len(registers) > MAX_REGISTERS:
        raise NotTraceableError(f"it needs more than {MAX_REGISTERS} registers")
    lines = [line for part in by_frequency.values() for line in part]
    part_ends = np.cumsum([0, *(len(part) for part in by_frequency.values())])
    code = np.array(lines, dtype=np.int64).reshape(-1, 5)
    return InstructionList(
        code, part_ends.astype(np.int64), rows, registers, first_constant, np.array(values)
    )


def _sort_nodes(outputs: Sequence[ExpressionNode]) -> list[ExpressionNode]:
    """Return the outputs and all nodes on which they depend, each after its arguments.

    It is a depth-first topological sort. It uses a stack, because recursion would be too deep for
    large graphs. A node is on the stack twice: first to put its arguments on top of it, and then to
    be added after them.

    Args:
        outputs: Nodes whose values the program must produce.
    """
    order: dict[ExpressionNode, None] = {}
    stack = [(node, False) for node in reversed(outputs)]
    while stack:
        node, has_arguments_in_order = stack.pop()
        if has_arguments_in_order:
            order[node] = None
        elif node not in order:
            stack.append((node, True))
            stack += [(arg, False) for arg in reversed(node.args)]
    return list(order)


_tracers: dict[tuple[type[System], InputNames], SystemTracer | None] = {}
_effects: dict[tuple[type[System], InputNames, type[Effect]], bool] = {}
_lock = Lock()
_MAX_RELATIVE_DIFFERENCE = 1e-9
"""Largest relative difference between a program and the functions from which it was traced."""
_TEST_RESTITUTION, _TEST_FRICTION = 0.6, 0.2
"""Restitution and friction of the ground with which effects are tested."""


def get_force_program(
    batch: IntegrationBatch, elements: Indices, effects: Sequence[Effect]
) -> ForceProgram | NumpyForceProgram:
    """Return the program that computes the forces of a system and its effects.

    If possible, it consists of instructions, from a trace of their Python functions. Otherwise,
    for example because a user's effect contains an ``if``, the program calls these functions with
    NumPy, which is slower; the reason is printed once.

    Args:
        batch: whole batch.
        elements: (n,) indices of the elements.
        effects: effects that act on them.
    """
    names = InputNames(
        tuple(batch.constants), tuple(batch.inputs), batch.theta.shape[1], batch.x.shape[1]
    )
    # The lock prevents that a trace in progress in another thread is taken as not traceable.
    with _lock:
        tracer = _get_tracer(batch, elements, names)
        if tracer is not None and all(
            _is_traceable(tracer, effect, batch, elements, names) for effect in effects
        ):
            try:
                return tracer.build_program(effects)
            except NotTraceableError as reason:  # the program would be too long
                _print_once("this set of effects", reason)
    return NumpyForceProgram(batch.system, names, effects)


def _get_tracer(
    batch: IntegrationBatch, elements: Indices, names: InputNames
) -> SystemTracer | None:
    """Return the tracer of a system, or None if the system cannot be traced.

    The system is traced once for each set of input names, checked against NumPy, and cached.

    Args:
        batch: batch of the system, from which states for the check are taken.
        elements: indices of its elements with this system.
        names: names and sizes of its inputs.
    """
    key = type(batch.system), names
    if key not in _tracers:
        _tracers[key] = None
        try:
            tracer = SystemTracer(batch.system, names)
            _check_program(tracer, batch, elements, names, None)
            _tracers[key] = tracer
        # A user's system may raise any error when called with traced arrays. The cached None stays.
        except Exception as reason:
            _print_once(f"system {batch.system.name}", reason)
    return _tracers[key]


def _is_traceable(
    tracer: SystemTracer,
    effect: Effect,
    batch: IntegrationBatch,
    elements: Indices,
    names: InputNames,
) -> bool:
    """Return whether an effect can be traced and then gives the same numbers as with NumPy.

    The answer is cached; a failure is reported once.

    Args:
        tracer: tracer of the system.
        effect: effect of the library: a force, friction, input, sensor or contact law.
        batch: batch in which the effect acts, from which states for the check are taken.
        elements: indices of the elements on which it acts.
        names: names and sizes of the inputs.
    """
    key = type(batch.system), names, type(effect)
    if key not in _effects:
        _effects[key] = False
        try:
            _check_program(tracer, batch, elements, names, effect)
            _effects[key] = True
        except Exception as reason:
            _print_once(f"effect {effect.name}", reason)
    return _effects[key]


def _print_once(subject: str, reason: Exception) -> None:
    """Tell the user why a system or effect runs slowly with NumPy; once per process.

    Args:
        subject: system or effect, as the beginning of the line on the standard error output.
        reason: why it cannot be compiled.
    """
    text = str(reason) or type(reason).__name__
    sys.stderr.write(f"simgap: {subject} cannot be compiled, and NumPy evaluates it: {text}\n")


def _check_program(
    tracer: SystemTracer,
    batch: IntegrationBatch,
    elements: Indices,
    names: InputNames,
    effect: Effect | None,
) -> None:
    """Check that a traced program gives the same numbers as the functions that it was traced from.

    A trace records the operations for one call. If a function chooses its operations by values, for
    example by the parameters of an object, the trace is wrong elsewhere. So both are evaluated for
    the first of the elements, at its initial state and at another one, and at two impact speeds.

    Args:
        tracer: traced system.
        batch: whole batch.
        elements: (n,) indices of the elements.
        names: input names and sizes.
        effect: effect under test; None to test the system.

    Raises:
        NotTraceableError: the results differ, or the traced object has instance attributes.
    """
    if getattr(effect or batch.system, "__dict__", None):
        raise NotTraceableError("it has instance attributes, which a trace cannot follow")
    effects = [] if effect is None else [effect]
    first = elements[:1]
    coefficients = [c[:, first, 0].T for active, c in batch.effects if active is effect]
    constants = [values[first] for values in batch.constants.values()]
    parameters = np.concatenate([batch.theta[first], *constants, *coefficients], axis=1)[0]
    inputs = np.array([values[first[0], 0] for values in batch.inputs.values()])
    # The initial state, and another one at an arbitrary later time.
    states = [
        np.concatenate([[t], batch.x[first[0]] + shift, batch.v[first[0]] - 2.0 * shift, inputs])
        for t, shift in _TEST_STATES
    ]
    programs = tracer.build_program(effects), NumpyForceProgram(batch.system, names, effects)
    values, expected_values = (
        _evaluate_program(program, parameters, states) for program in programs
    )
    for value, expected in zip(values, expected_values, strict=True):
        # A component that is nearly zero is compared relative to the largest one.
        atol = _MAX_RELATIVE_DIFFERENCE * np.abs(expected).max()
        if not np.allclose(
            value, expected, rtol=_MAX_RELATIVE_DIFFERENCE, atol=atol, equal_nan=True
        ):
            raise NotTraceableError("its compiled form gives other numbers")


def _evaluate_program(
    program: ForceProgram | NumpyForceProgram, parameters: Array, states: Sequence[Array]
) -> list[Array]:
    """Evaluate a program at some states and two impact speeds, to compare it with NumPy.

    The states are written into the registers of the program, and the results read from there.

    Args:
        program: traced program, or the program that evaluates with NumPy.
        parameters: (P,) parameters of the batch element.
        states: time, positions, velocities and inputs, each as one vector.

    Returns:
        Forces and, if any, friction limits at each state, then restitution and friction of impacts.
    """
    prepared = program.prepare(1)
    (_, _, rows, output_rows, flags), r = prepared.arrays, prepared.block.r
    compute_constants, compute_forces, compute_impact = prepared.make_runners()
    r[rows[IN_P] : rows[IN_P] + parameters.size, 0] = parameters
    compute_constants()
    results = []
    for state in states:
        r[rows[IN_T] : rows[IN_P], 0] = state
        compute_forces()
        results.append(r[output_rows, 0])
        if flags[HAS_FRICTION]:
            results.append(r[rows[OUT_LIMIT], :1].copy())
    for speed in _TEST_IMPACT_SPEEDS:
        r[rows[IN_E] : rows[IN_E] + 3, 0] = _TEST_RESTITUTION, _TEST_FRICTION, speed
        compute_impact()
        results.append(r[rows[[OUT_E, OUT_MU]], 0])
    return results
