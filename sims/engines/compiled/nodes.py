"""Arrays of expression nodes: numbers as nodes, and elementwise operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sims.engines.compiled.graph import CODES, Graph, Node

OTHERWISE_NAMED = {
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
SWAPPED = {"greater": "less", "greater_equal": "less_equal"}
MASKS = {
    *("less", "less_equal", "equal", "not_equal", "logical_and", "logical_or", "logical_not"),
}
MOVING = {
    *("concatenate", "stack", "hstack", "vstack", "column_stack", "broadcast_to", "reshape"),
    *("transpose", "moveaxis", "squeeze", "expand_dims", "copy", "tile", "repeat", "roll", "flip"),
    *("split", "atleast_1d", "atleast_2d", "take", "broadcast_arrays", "swapaxes", "ravel"),
}
"""Functions that only rearrange elements."""


class UntracedError(TypeError):
    """Operation or value that cannot be traced."""


def one(node: Node) -> Any:
    """Return a node as an array without dimensions."""
    result = np.empty((), dtype=object)
    result[()] = node
    return result


def array(nodes: Any) -> Any:
    """Return nodes, or a single node, as an array."""
    return one(nodes) if isinstance(nodes, Node) else nodes


def constants(graph: Graph, value: Any) -> Any:
    """Return numbers as an array of constant nodes.

    Args:
        graph: graph that contains the nodes.
        value: number or array of numbers.

    Raises:
        UntracedError: the value is not numeric.
    """
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "biuf":
        raise UntracedError(f"{type(value).__name__} is not traced")
    result = np.empty(numbers.shape, dtype=object)
    for place in np.ndindex(numbers.shape):
        result[place] = graph.constant(float(numbers[place]))
    return result


def combined(graph: Graph, name: str, args: Sequence[Any]) -> Any:
    """Apply an operation elementwise to arrays of nodes.

    Args:
        graph: graph that contains the nodes.
        name: name of the operation.
        args: arrays of nodes.

    Returns:
        Array of the resulting nodes.

    Raises:
        UntracedError: the operation does not exist.
    """
    if name not in CODES:
        raise UntracedError(f"numpy.{name} is not traced")
    spread: Any = np.broadcast_arrays(*args)
    result = np.empty(spread[0].shape, dtype=object)
    for place in np.ndindex(result.shape):
        result[place] = graph.apply(name, *(nodes[place] for nodes in spread))
    return result
