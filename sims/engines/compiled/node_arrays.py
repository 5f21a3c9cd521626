"""Arrays of expression nodes: numbers as nodes, and elementwise operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sims.engines.compiled.expression_graph import OPERATION_CODES, ExpressionGraph, ExpressionNode

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
