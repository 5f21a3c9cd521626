"""Expression graph of the numbers that system and effects compute, and arrays of its nodes.

A node is an operation on nodes, an input or a constant. Equal expressions are one node
(common-subexpression elimination), so that a value used by two effects is computed once.
Expressions of constants are evaluated here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

OPERATIONS: tuple[str, ...] = (
    *("add", "subtract", "multiply", "divide", "negative", "absolute", "sqrt"),
    *("maximum", "minimum", "where", "sin", "cos", "exp", "power"),
    *("less", "less_equal", "equal", "not_equal", "logical_and", "logical_or", "logical_not"),
    *("sign", "tan", "tanh", "arctan", "arctan2", "log", "expm1", "log1p"),
    *("floor", "ceil", "rint", "sinh", "cosh", "arcsin", "arccos", "hypot", "copysign"),
)
"""Operations in the order of their codes; all except `where` are NumPy functions of that name."""
OPERATION_CODES = {name: code for code, name in enumerate(OPERATIONS)}
EXTERNAL = len(OPERATIONS)
"""Code of the instruction that calls a function of Python.

Its last two arguments are the part of the program and the address of the function.
"""

CONSTANT, PER_ELEMENT, PER_EVALUATION, PER_IMPACT = range(4)
"""Change frequency of a value: never, per batch element, per evaluation, or per impact."""


@dataclass(frozen=True, eq=False)
class ExpressionNode:
    """Node of an expression graph: one number.

    Attributes:
        operation: a name of `OPERATIONS`, ``input`` or ``constant``.
        args: argument nodes.
        value: value of a constant.
        change_frequency: change frequency, from CONSTANT to PER_IMPACT.
    """

    operation: str
    args: tuple[ExpressionNode, ...] = ()
    value: float = 0.0
    change_frequency: int = CONSTANT


class ExpressionGraph:
    """Factory of nodes in which equal expressions are one node."""

    def __init__(self) -> None:
        self._nodes: dict[tuple[object, ...], ExpressionNode] = {}

    def make_constant(self, value: float) -> ExpressionNode:
        """Return the node of a number; zeros of different sign and different NaN are distinct."""
        bits = np.float64(value).tobytes()
        return self._get_or_make(
            ("constant", bits), lambda: ExpressionNode("constant", value=float(value))
        )

    def make_input(self, changes: int) -> ExpressionNode:
        """Return a new input node with this change frequency."""
        return ExpressionNode("input", change_frequency=changes)

    def make_operation(self, operation: str, *args: ExpressionNode) -> ExpressionNode:
        """Return the node of an operation on nodes.

        Args:
            operation: a name of `OPERATIONS`.
            *args: argument nodes.
        """
        if all(arg.change_frequency == CONSTANT for arg in args):
            return self.make_constant(_compute_constant(operation, [arg.value for arg in args]))
        changes = max(arg.change_frequency for arg in args)
        key = operation, *map(id, args)
        return self._get_or_make(
            key, lambda: ExpressionNode(operation, args, change_frequency=changes)
        )

    def _get_or_make(
        self, key: tuple[object, ...], make_node: Callable[[], ExpressionNode]
    ) -> ExpressionNode:
        """Return the node with this key, so that equal expressions share one node."""
        if key not in self._nodes:
            self._nodes[key] = make_node()
        return self._nodes[key]


def _compute_constant(operation: str, values: list[float]) -> float:
    """Apply an operation to constants, with NumPy's result for overflow and division by zero."""
    with np.errstate(all="ignore"):
        if operation == "where":
            return values[1] if values[0] else values[2]
        return float(getattr(np, operation)(*map(np.float64, values)))


OPERATION_ALIASES = {
    "true_divide": "divide",
    "fabs": "absolute",
    "bitwise_and": "logical_and",
    "bitwise_or": "logical_or",
    "invert": "logical_not",
    "fmax": "maximum",
    "fmin": "minimum",
    "float_power": "power",
}
"""NumPy functions that are traced as another operation; they differ only for NaN."""
SWAPPED_COMPARISONS = {"greater": "less", "greater_equal": "less_equal"}
BOOLEAN_OPERATIONS = {
    *("less", "less_equal", "equal", "not_equal", "logical_and", "logical_or", "logical_not"),
}
RESHAPING_FUNCTIONS = {
    *("concatenate", "stack", "hstack", "vstack", "column_stack", "broadcast_to", "reshape"),
    *("transpose", "moveaxis", "squeeze", "expand_dims", "copy", "tile", "repeat", "roll", "flip"),
    *("split", "atleast_1d", "atleast_2d", "take", "broadcast_arrays", "swapaxes", "ravel"),
}
"""Functions that only rearrange elements."""


class NotTraceableError(TypeError):
    """Operation or value that cannot be traced."""


def to_scalar_array(node: ExpressionNode) -> Any:
    """Return a node as an array without dimensions."""
    result = np.empty((), dtype=object)
    result[()] = node
    return result


def to_node_array(nodes: Any) -> Any:
    """Return nodes, or a single node, as an array."""
    return to_scalar_array(nodes) if isinstance(nodes, ExpressionNode) else nodes


def make_constant_nodes(graph: ExpressionGraph, value: Any) -> Any:
    """Return numbers as an array of constant nodes.

    Args:
        graph: graph that contains the nodes.
        value: number or array of numbers.

    Raises:
        NotTraceableError: the value is not numeric.
    """
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "biuf":
        raise NotTraceableError(f"{type(value).__name__} is not traced")
    result = np.empty(numbers.shape, dtype=object)
    for index in np.ndindex(numbers.shape):
        result[index] = graph.make_constant(float(numbers[index]))
    return result


def apply_elementwise(graph: ExpressionGraph, name: str, args: Sequence[Any]) -> Any:
    """Apply an operation elementwise to arrays of nodes.

    The arrays are broadcast as in NumPy.

    Args:
        graph: graph that contains the nodes.
        name: name of the operation.
        args: arrays of nodes.

    Returns:
        Array of the resulting nodes.

    Raises:
        NotTraceableError: the operation does not exist.
    """
    if name not in OPERATION_CODES:
        raise NotTraceableError(f"numpy.{name} is not traced")
    broadcast: Any = np.broadcast_arrays(*args)
    result = np.empty(broadcast[0].shape, dtype=object)
    for index in np.ndindex(result.shape):
        result[index] = graph.make_operation(name, *(nodes[index] for nodes in broadcast))
    return result
