"""Array functions as programs on registers: traced into instructions, or evaluated by NumPy.

An array function computes outputs from inputs, such as the forces of effects from a state. Its
numbers are in registers: a row for each number, a column (a slot) for each batch element. A program
has three parts: values that depend on an element's parameters alone, computed when an element
begins; those of each evaluation; and those of each impact.

If possible, the function is traced (`traced_array`): it is called once with symbols, which record
its arithmetic as instructions on registers. Otherwise each part has one instruction, which calls
the function with views of the registers.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array
from sims.engines.compiled.data_layout import BLOCK_WIDTH, FloatArray, IntTable, uses_registers
from sims.engines.compiled.element_stepping import COMPILED
from sims.engines.compiled.interpreter import run_instructions
from sims.engines.compiled.traced_array import (
    EXTERNAL,
    OPERATION_CODES,
    PER_ELEMENT,
    PER_EVALUATION,
    PER_IMPACT,
    ExpressionGraph,
    NotTraceableError,
    collect_nodes,
    collect_output,
    make_input_vector,
    sort_nodes,
)

MAX_REGISTERS = 4000
"""Maximum number of registers of a traced program."""
MAX_CACHED_PROGRAMS = 2000
"""Maximum number of cached programs of a system."""
NUMPY_BLOCK_WIDTH = 1024
"""Number of slots of a program that NumPy evaluates: a call of NumPy costs more than its rows."""
MAX_RELATIVE_DIFFERENCE = 1e-9
"""Largest relative difference between a program and the function from which it was traced."""
PART_COUNT = 3
_Callback = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)

Evaluator = Callable[[], Sequence[Any]]
"""Function that returns the outputs of one part, arrays (slots, n) or numbers."""


@dataclass(frozen=True)
class ArrayFunction:
    """Function that computes outputs from groups of inputs, once or twice with the same inputs.

    Attributes:
        groups: number of inputs in each group, and their change frequency (`traced_array`).
        outputs: number of values of each output; of each evaluation, then of each impact if any.
        bind: returns the evaluators of these outputs for input arrays (slots, n) of all groups,
            whose values may change afterwards.
    """

    groups: Sequence[tuple[int, int]]
    outputs: Sequence[Sequence[int]]
    bind: Callable[..., Sequence[Evaluator]]

    @cached_property
    def input_ends(self) -> list[int]:
        """First register of each group, and the register after the last one."""
        return [0, *accumulate(size for size, _ in self.groups)]


@dataclass(frozen=True, eq=False)
class Program:
    """Array function as instructions on registers, of which the first ones are the inputs.

    Attributes:
        function: the function.
        is_traced: whether the instructions compute the outputs; otherwise NumPy does.
        code: (n, 5) operation, result register, three argument registers.
        ends: (4,) boundaries of the parts in `code`.
        outputs: registers of each output, as in `ArrayFunction.outputs`.
        registers: number of registers.
        constants: (C,) values of the registers that follow the inputs.
    """

    function: ArrayFunction
    is_traced: bool
    code: IntTable
    ends: IntTable
    outputs: Sequence[Sequence[IntTable]]
    registers: int
    constants: FloatArray

    @property
    def block_width(self) -> int:
        """Number of slots that are evaluated together."""
        return BLOCK_WIDTH if self.is_traced else NUMPY_BLOCK_WIDTH


class PreparedProgram:
    """Program with registers.

    Attributes:
        program: the program.
        r: (registers, slots) registers, in which the constants are set.
        code: (n, 5) instructions.
    """

    def __init__(self, program: Program, width: int) -> None:
        """Allocate registers, and make the callback by which instructions call NumPy.

        Args:
            program: the program.
            width: number of slots.
        """
        self.program = program
        self.r = np.zeros((program.registers, width))
        self.code = program.code
        self._error: BaseException | None = None
        # Evaluators by the number of slots in use, whose inputs are views of the registers.
        self._evaluators: dict[int, Sequence[Evaluator]] = {}
        # The registers of constants follow those of the inputs.
        first = program.function.input_ends[-1]
        self.r[first : first + program.constants.size] = program.constants[:, None]
        if not program.is_traced:
            # One instruction for each part. The attribute keeps the callback alive.
            self._callback = _Callback(self._evaluate_part)
            address = ctypes.cast(self._callback, ctypes.c_void_p).value
            self.code = np.array(
                [[EXTERNAL, 0, 0, part, address] for part in range(PART_COUNT)], dtype=np.int64
            )

    def raise_error(self) -> None:
        """Raise the exception of the function that the instructions have called."""
        if self._error is not None:
            raise self._error

    def make_runners(self) -> tuple[Callable[[], None], ...]:
        """Return functions that run the parts of the program on all slots.

        Compiled code cannot raise the exceptions of functions that it calls; they are raised after
        each part.

        Returns:
            One function for each part: values that depend on parameters alone, values of an
            evaluation, and values of an impact.
        """
        runners = [
            make_instruction_runner(self.code, first, last, self.r)
            for first, last in pairwise(self.program.ends.tolist())
        ]
        if self.program.is_traced:
            return tuple(runners)

        def make_checked(runner: Callable[[], None]) -> Callable[[], None]:
            """Wrap a runner so that it raises the exceptions of the function afterwards."""

            def run() -> None:
                runner()
                self.raise_error()

            return run

        return tuple(map(make_checked, runners))

    def _evaluate_part(self, part: int, width: int) -> None:
        """Evaluate one part of the program for the first `width` slots (called by machine code).

        An exception cannot pass through machine code: it is stored, all results are NaN from
        then on, and the caller raises it afterwards.

        Args:
            part: 0 for the values that depend on parameters alone, 1 for those of an evaluation,
                2 for those of an impact.
            width: number of slots in use.
        """
        # NumPy computes the values of part 0 again in each evaluation, so that part 0 does nothing.
        # A function without impacts has no outputs for part 2.
        if not 0 < part <= len(self.program.outputs):
            return
        outputs = self.program.outputs[part - 1]
        if self._error is None:
            try:
                with np.errstate(all="ignore"):
                    if width not in self._evaluators:
                        # The inputs (width, n) of each group are views, so that the evaluators are
                        # made once and read the present values of the registers.
                        ends = self.program.function.input_ends
                        views = [self.r[a:b, :width].T for a, b in pairwise(ends)]
                        self._evaluators[width] = self.program.function.bind(*views)
                    values = self._evaluators[width][part - 1]()
                for rows, value in zip(outputs, values, strict=True):
                    self.r[rows, :width] = np.broadcast_to(value, (width, rows.size)).T
            except BaseException as error:
                self._error = error
        if self._error is not None:
            for rows in outputs:
                self.r[rows] = np.nan


def make_instruction_runner(
    code: IntTable, first: int, last: int, r: FloatArray
) -> Callable[[], None]:
    """Return a function that runs instructions on the present values of the registers.

    Machine code does not check array bounds, so the instructions are checked once, here.

    Args:
        code: (n, 5) n instructions; see `ProgramArrays`.
        first: index of the first instruction.
        last: index after the last instruction.
        r: (registers, W) registers of W slots.

    Returns:
        The function without arguments.

    Raises:
        ValueError: an instruction uses a register that does not exist.
    """
    run = COMPILED.bind(run_instructions, code, first, last, r, r.shape[1])
    if not (0 <= first <= last <= len(code) and uses_registers(code, len(r))):
        raise ValueError("the instructions are not for these registers")
    return run


def make_numpy_program(function: ArrayFunction) -> Program:
    """Return a program whose instructions call the function, one for each part.

    Its registers are the inputs, followed by the values of each output. The instructions are only
    reserved here, as zeros: `PreparedProgram` makes them, since they contain an address of this
    process.
    """
    ends = np.cumsum([function.input_ends[-1], *(n for part in function.outputs for n in part)])
    output_bounds = iter(pairwise(ends.tolist()))
    return Program(
        function,
        is_traced=False,
        code=np.zeros((PART_COUNT, 5), dtype=np.int64),
        ends=np.arange(PART_COUNT + 1),
        outputs=[[np.arange(*next(output_bounds)) for _ in part] for part in function.outputs],
        registers=int(ends[-1]),
        constants=np.zeros(0),
    )


def trace_program(function: ArrayFunction) -> Program:
    """Translate a function to instructions that compute its outputs from its inputs.

    Every node of the function's expression graph gets a register of its own: first the inputs by
    group, then the constants, then the results of operations. Each operation becomes one
    instruction: its code, the register of its result, and those of three arguments (the first one
    fills up missing ones). Instructions are sorted by how often they must be repeated: once per
    batch element, per evaluation, or per impact.

    Raises:
        NotTraceableError: the function cannot be traced, or too many registers are needed.
    """
    graph = ExpressionGraph()
    inputs = [make_input_vector(graph, size, changes) for size, changes in function.groups]
    # Nodes of each output, of each evaluation and then of each impact.
    parts = [
        [collect_output(graph, value, size) for value, size in zip(evaluate(), sizes, strict=True)]
        for evaluate, sizes in zip(function.bind(*inputs), function.outputs, strict=True)
    ]
    registers = {node: number for number, node in enumerate(collect_nodes(*inputs))}
    sorted_nodes = sort_nodes([node for part in parts for nodes in part for node in nodes])
    constants = [node for node in sorted_nodes if node.operation == "constant"]
    for node in constants:
        registers[node] = len(registers)
    by_frequency: dict[int, list[list[int]]] = {PER_ELEMENT: [], PER_EVALUATION: [], PER_IMPACT: []}
    for node in sorted_nodes:
        if node.args:
            registers[node] = len(registers)
            args = [registers[arg] for arg in node.args]
            args += [args[0]] * (3 - len(args))  # registers that the operation does not read
            by_frequency[node.change_frequency].append(
                [OPERATION_CODES[node.operation], registers[node], *args]
            )
    if len(registers) > MAX_REGISTERS:
        raise NotTraceableError(f"it needs {len(registers)} of {MAX_REGISTERS} registers")
    code = [instruction for part in by_frequency.values() for instruction in part]
    return Program(
        function,
        is_traced=True,
        code=np.array(code, dtype=np.int64).reshape(-1, 5),
        ends=np.cumsum([0, *map(len, by_frequency.values())]).astype(np.int64),
        outputs=[
            [np.array([registers[node] for node in nodes], dtype=np.int64) for nodes in part]
            for part in parts
        ],
        registers=len(registers),
        constants=np.array([node.value for node in constants], dtype=np.float64),
    )


class TracedSource(NamedTuple):
    """System or effect whose functions are traced as a part of a program.

    Attributes:
        source: the system or effect; one answer holds for all instances of its class.
        description: description in messages.
        make_test: returns the array function of the source alone, and values (inputs, slots) of all
            its inputs at which its program is compared with NumPy.
    """

    source: Any
    description: str
    make_test: Callable[[], tuple[ArrayFunction, Iterable[Array]]]


class TracedPrograms:
    """Cache of traced programs for one system, by the classes of their effects."""

    def __init__(self) -> None:
        self._programs: dict[object, Program | None] = {}
        self._is_traceable: dict[type, bool] = {}

    def find(self, function: ArrayFunction, sources: Sequence[TracedSource]) -> Program | None:
        """Return the traced program of a function; None if NumPy must evaluate it.

        The first time, the reason for that is printed.

        Args:
            function: the function; equal classes of sources give equal programs.
            sources: all systems and effects whose functions it calls.
        """
        if not all(map(self._can_trace, sources)):
            return None
        key = tuple(type(one.source) for one in sources)
        if key not in self._programs:
            if len(self._programs) == MAX_CACHED_PROGRAMS:
                self._programs.clear()
            try:
                self._programs[key] = trace_program(function)
            except NotTraceableError as reason:  # the program would be too long
                self._programs[key] = None
                _print_reason("this set of effects", reason)
        return self._programs[key]

    def _can_trace(self, one: TracedSource) -> bool:
        """Return whether a source can be traced and then gives the same numbers as with NumPy.

        A failure is reported once, unless the effect declares that it cannot be traced.
        """
        kind = type(one.source)
        if kind not in self._is_traceable:
            self._is_traceable[kind] = False  # unless all checks below succeed
            if getattr(one.source, "is_traceable", True):
                # A user's code may raise any error when called with traced arrays.
                try:
                    # The program is cached by class, but attributes differ between instances.
                    if getattr(one.source, "__dict__", None):
                        raise NotTraceableError(
                            "it has instance attributes, which a trace cannot follow"
                        )
                    check_program(*one.make_test())
                    self._is_traceable[kind] = True
                except Exception as reason:
                    _print_reason(one.description, reason)
        return self._is_traceable[kind]


def _print_reason(subject: str, reason: Exception) -> None:
    """Tell the user why a system or effect runs slowly with NumPy.

    Args:
        subject: system or effect, as the beginning of the line on the standard error output.
        reason: why it cannot be compiled.
    """
    text = str(reason) or type(reason).__name__
    sys.stderr.write(f"simgap: {subject} cannot be compiled, and NumPy evaluates it: {text}\n")


def check_program(function: ArrayFunction, samples: Iterable[Array]) -> None:
    """Check that a traced program gives the same numbers as the function that it was traced from.

    A trace records the operations for one call. If a function chooses its operations by values, for
    example by the parameters of an object, the trace is wrong elsewhere.

    Args:
        function: the function.
        samples: values (inputs, slots) of all inputs, at which both are evaluated.

    Raises:
        NotTraceableError: the function cannot be traced, or the results differ.
    """
    programs = trace_program(function), make_numpy_program(function)
    for sample in samples:
        results = []
        for program in programs:
            prepared = PreparedProgram(program, sample.shape[1])
            prepared.r[: len(sample)] = sample
            for run in prepared.make_runners():
                run()
            results.append([prepared.r[rows] for part in program.outputs for rows in part])
        for value, expected in zip(*results, strict=True):
            # A component that is nearly zero is compared relative to the largest one.
            largest = np.abs(expected[np.isfinite(expected)]).max(initial=0.0)
            if not np.allclose(
                value,
                expected,
                rtol=MAX_RELATIVE_DIFFERENCE,
                atol=MAX_RELATIVE_DIFFERENCE * largest,
                equal_nan=True,
            ):
                raise NotTraceableError("its compiled form gives other numbers")
