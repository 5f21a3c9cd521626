"""Expressions of numbers: what a system's and its effects' array functions compute for one lane.

A node is an operation on nodes, an input or a constant. Equal expressions are one node, so what two
effects both ask for is computed once; what depends on constants alone is computed here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

OPERATIONS: tuple[str, ...] = (
    *("add", "subtract", "multiply", "divide", "negative", "absolute", "sqrt"),
    *("maximum", "minimum", "where", "sin", "cos", "exp", "power"),
    *("less", "less_equal", "equal", "not_equal", "logical_and", "logical_or", "logical_not"),
    *("sign", "tan", "tanh", "arctan", "arctan2", "log", "expm1", "log1p"),
    *("floor", "ceil", "rint", "sinh", "cosh", "arcsin", "arccos", "hypot", "copysign"),
)
"""By their codes in a program; all but `where` are numpy's universal functions of that name."""
CODES = {name: code for code, name in enumerate(OPERATIONS)}

CONSTANT, LANE, MOMENT, IMPACT = range(4)
"""How often a value changes: never; from lane to lane; from instant to instant; at impacts."""


@dataclass(frozen=True, eq=False)
class Node:
    """One number.

    Attributes:
        operation: a name of `OPERATIONS`, ``input`` or ``constant``.
        args: what it is computed from.
        value: of a constant.
        changes: how often.
    """

    operation: str
    args: tuple[Node, ...] = ()
    value: float = 0.0
    changes: int = CONSTANT


class Graph:
    """Makes nodes, equal ones once."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], Node] = {}

    def constant(self, value: float) -> Node:
        """A number; zeros of either sign and every NaN are told apart."""
        bits = np.float64(value).tobytes()
        return self._once(("constant", bits), lambda: Node("constant", value=float(value)))

    def input(self, changes: int) -> Node:
        """A new input."""
        return Node("input", changes=changes)

    def apply(self, operation: str, *args: Node) -> Node:
        """An operation on nodes."""
        if all(arg.changes == CONSTANT for arg in args):
            return self.constant(_computed(operation, [arg.value for arg in args]))
        changes = max(arg.changes for arg in args)
        key = operation, *map(id, args)
        return self._once(key, lambda: Node(operation, args, changes=changes))

    def _once(self, key: tuple[object, ...], make: Callable[[], Node]) -> Node:
        if key not in self._known:
            self._known[key] = make()
        return self._known[key]


def _computed(operation: str, values: list[float]) -> float:
    with np.errstate(all="ignore"):
        if operation == "where":
            return values[1] if values[0] else values[2]
        return float(getattr(np, operation)(*map(np.float64, values)))
