"""Arrays of nodes: numbers as nodes, and operations element by element."""

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
"""Functions that do the same to what is traced, but for where there is no number."""
SWAPPED = {"greater": "less", "greater_equal": "less_equal"}
MASKS = {
    *("less", "less_equal", "equal", "not_equal", "logical_and", "logical_or", "logical_not"),
}
MOVING = {
    *("concatenate", "stack", "hstack", "vstack", "column_stack", "broadcast_to", "reshape"),
    *("transpose", "moveaxis", "squeeze", "expand_dims", "copy", "tile", "repeat", "roll", "flip"),
    *("split", "atleast_1d", "atleast_2d", "take", "broadcast_arrays", "swapaxes", "ravel"),
}
"""Functions that move elements and do nothing else."""


class UntracedError(TypeError):
    """Something that cannot be traced."""


def one(node: Node) -> Any:
    """A node as an array without dimensions."""
    result = np.empty((), dtype=object)
    result[()] = node
    return result


def array(nodes: Any) -> Any:
    """Nodes, or one, as an array."""
    return one(nodes) if isinstance(nodes, Node) else nodes


def constants(graph: Graph, value: Any) -> Any:
    """Numbers as nodes.

    Raises:
        UntracedError: they are none.
    """
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "biuf":
        raise UntracedError(f"{type(value).__name__} is not traced")
    result = np.empty(numbers.shape, dtype=object)
    for place in np.ndindex(numbers.shape):
        result[place] = graph.constant(float(numbers[place]))
    return result


def combined(graph: Graph, name: str, args: Sequence[Any]) -> Any:
    """An operation on arrays of nodes, element by element.

    Raises:
        UntracedError: there is no such operation.
    """
    if name not in CODES:
        raise UntracedError(f"numpy.{name} is not traced")
    spread: Any = np.broadcast_arrays(*args)
    result = np.empty(spread[0].shape, dtype=object)
    for place in np.ndindex(result.shape):
        result[place] = graph.apply(name, *(nodes[place] for nodes in spread))
    return result
