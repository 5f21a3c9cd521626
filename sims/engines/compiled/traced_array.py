"""Trace NumPy code: arrays that record operations as nodes of an expression graph.

A node is an operation on nodes, an input or a constant. Equal expressions are one node
(common-subexpression elimination), so that a value used by two effects is computed once.
Expressions of constants are evaluated here.

A traced array has the shape for one batch element, with a node in place of each number. NumPy
functions that are elementwise, and those that only rearrange elements, work on it. Code that needs
a value (``if``, `float`, `numpy.asarray`) and functions without a traced version raise
`NotTraceableError`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

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

        If all arguments are constants, the result is computed at once and is a constant too.
        Otherwise it changes as often as the argument that changes most often.

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
        """Return the node with this key, so that equal expressions share one node.

        Args:
            key: operation and arguments of the expression.
            make_node: makes its node.
        """
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


class TracedArray(NDArrayOperatorsMixin):
    """Array of nodes of one graph.

    Args:
        graph: graph that contains the nodes.
        nodes: array of any shape with dtype object.
        mask: whether it contains Booleans.
    """

    def __init__(self, graph: ExpressionGraph, nodes: Any, mask: bool = False) -> None:
        self.graph = graph
        self.nodes = nodes
        self.mask = mask

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape, as of a NumPy array."""
        shape: tuple[int, ...] = self.nodes.shape
        return shape

    @property
    def ndim(self) -> int:
        """Number of dimensions, as of a NumPy array."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of elements, as of a NumPy array."""
        return int(self.nodes.size)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Data type: bool for a mask, otherwise float."""
        return np.dtype(bool if self.mask else float)

    @property
    def T(self) -> TracedArray:  # noqa: N802
        """Transposed array, as of a NumPy array."""
        return self._make_like(self.nodes.T)

    def reshape(self, *shape: Any) -> TracedArray:
        """Return the array in another shape, as for a NumPy array."""
        return self._make_like(self.nodes.reshape(*shape))

    def copy(self) -> TracedArray:
        """Return a copy, as for a NumPy array."""
        return self._make_like(self.nodes.copy())

    def astype(self, kind: Any, **_: Any) -> TracedArray:
        """Return the array as numbers; only float64 is supported."""
        if np.dtype(kind) != np.float64:
            raise NotTraceableError(f"numbers as {np.dtype(kind)} are not traced")
        return TracedArray(self.graph, self.nodes)

    def sum(self, axis: Any = None, keepdims: bool = False, **_: Any) -> TracedArray:
        """Return the sum, as for a NumPy array.

        Args:
            axis: axis of the sum; None for all elements.
            keepdims: whether to keep the axis with size one.
            **_: other options of NumPy, which are ignored.
        """
        return self._reduce_axis("add", axis, keepdims)

    def max(self, axis: Any = None, keepdims: bool = False, **_: Any) -> TracedArray:
        """Return the maximum, as for a NumPy array.

        Args:
            axis: axis of the maximum; None for all elements.
            keepdims: whether to keep the axis with size one.
            **_: other options of NumPy, which are ignored.
        """
        return self._reduce_axis("maximum", axis, keepdims)

    def min(self, axis: Any = None, keepdims: bool = False, **_: Any) -> TracedArray:
        """Return the minimum, as for a NumPy array.

        Args:
            axis: axis of the minimum; None for all elements.
            keepdims: whether to keep the axis with size one.
            **_: other options of NumPy, which are ignored.
        """
        return self._reduce_axis("minimum", axis, keepdims)

    def clip(self, low: Any, high: Any) -> TracedArray:
        """Return the values limited to an interval, as for a NumPy array.

        Args:
            low: lower limit; None for none.
            high: upper limit; None for none.
        """
        return _trace_clip(self, low, high)

    def __len__(self) -> int:
        return len(self.nodes)

    def __iter__(self) -> Iterator[TracedArray]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: Any) -> TracedArray:
        """Return selected elements as a traced array, also if it is a single element."""
        _check_index(index)
        selected = self.nodes[index]
        if isinstance(selected, ExpressionNode):
            selected = to_scalar_array(selected)
        return self._make_like(selected)

    def __setitem__(self, index: Any, value: Any) -> None:
        _check_index(index)
        self.nodes[index] = _to_nodes(self.graph, value)

    def __bool__(self) -> bool:
        raise NotTraceableError("it tests whether a number is true, which differs between elements")

    def __float__(self) -> float:
        raise NotTraceableError("it reads the value of a number, which differs between elements")

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise NotTraceableError("it converts its arguments to a new array")

    def __array_ufunc__(self, ufunc: Any, method: str, *args: Any, **kwargs: Any) -> TracedArray:
        """Trace a NumPy ufunc; NumPy calls this method for an operation on a traced array.

        Sums, maxima and minima along an axis are traced too (``numpy.add.reduce``); other methods
        and options are not.

        Args:
            ufunc: the NumPy function, such as ``numpy.add``.
            method: ``__call__`` for a plain call, ``reduce`` for a reduction along an axis.
            *args: its arguments.
            **kwargs: its options; the traced array ``out`` gets the result.

        Raises:
            NotTraceableError: the function, its method or an option has no traced version.
        """
        if method == "reduce" and ufunc.__name__ in {"add", "maximum", "minimum"}:
            axis = kwargs.get("axis", 0)
            result = args[0]._reduce_axis(ufunc.__name__, axis, bool(kwargs.get("keepdims")))
            assert isinstance(result, TracedArray)
            return result
        outputs = kwargs.pop("out", None)
        if method != "__call__" or kwargs or (outputs and not isinstance(outputs[0], TracedArray)):
            raise NotTraceableError(f"numpy.{ufunc.__name__} is traced only as a plain call")
        result = _apply_elementwise(self.graph, ufunc.__name__, args)
        if not outputs:
            return result
        target = outputs[0]
        assert isinstance(target, TracedArray)
        target.nodes[...] = result.nodes
        return target

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        """Trace a NumPy function that is not a ufunc; NumPy calls this method.

        Functions that only rearrange elements work on the array of nodes itself.

        Args:
            func: the NumPy function, such as ``numpy.stack``.
            types: types of its array arguments, not used.
            args: its arguments.
            kwargs: its options.

        Raises:
            NotTraceableError: the function has no traced version.
        """
        name = func.__name__
        if name in RESHAPING_FUNCTIONS:
            return _wrap_result(self.graph, func(*_unwrap_arguments(self.graph, args), **kwargs))
        trace_function = _FUNCTIONS.get(name)
        if trace_function is None:
            raise NotTraceableError(f"numpy.{name} is not traced")
        return trace_function(*args, **kwargs)

    def _make_like(self, nodes: Any) -> TracedArray:
        return TracedArray(self.graph, nodes, self.mask)

    def _reduce_axis(self, operation: str, axis: Any, keepdims: bool) -> TracedArray:
        """Combine the elements along an axis with an operation of two operands, such as a sum.

        Elements are combined one after the other, from first to last.

        Args:
            operation: name of the operation, such as ``add``.
            axis: number of the axis; None for all elements.
            keepdims: whether the axis stays, with length one.
        """
        if axis is None:
            reduced = self.reshape(-1)._reduce_axis(operation, axis=0, keepdims=False)
            return reduced.reshape((1,) * self.ndim) if keepdims else reduced
        parts = list(np.moveaxis(self.nodes, axis, 0))
        total = TracedArray(self.graph, to_node_array(parts[0]))
        for part in parts[1:]:
            total = _apply_elementwise(
                self.graph, operation, (total, TracedArray(self.graph, to_node_array(part)))
            )
        if keepdims:
            total = total._make_like(np.expand_dims(total.nodes, axis))
        return total


def _check_index(index: Any) -> None:
    """Reject a traced index, whose number of selected elements would not be constant."""
    for part in index if isinstance(index, tuple) else (index,):
        if isinstance(part, TracedArray):
            raise NotTraceableError("it selects elements by computed values")


def _to_nodes(graph: ExpressionGraph, value: Any) -> Any:
    """Return the nodes of a traced array, or numbers as constant nodes.

    Args:
        graph: graph to which constant nodes are added.
        value: traced array, or numbers.
    """
    return value.nodes if isinstance(value, TracedArray) else make_constant_nodes(graph, value)


def _apply_elementwise(graph: ExpressionGraph, name: str, args: Sequence[Any]) -> TracedArray:
    """Apply a NumPy function to traced arrays and numbers, element by element.

    Some functions are first expressed by others, such as square by a product and > by <, so
    that the interpreter needs fewer operations.

    Args:
        graph: graph to which nodes are added.
        name: name of the NumPy function.
        args: its arguments, traced arrays or numbers.

    Raises:
        NotTraceableError: arithmetic with booleans alone, or an operation that is not known.
    """
    if name == "positive":
        return TracedArray(graph, _to_nodes(graph, args[0]))
    if name == "square":
        return _apply_elementwise(graph, "multiply", (args[0], args[0]))
    if name == "reciprocal":
        return _apply_elementwise(graph, "divide", (1.0, args[0]))
    if name == "power" and not isinstance(args[1], TracedArray) and np.ndim(args[1]) == 0:
        simplified = _simplify_power(graph, args[0], float(args[1]))
        if simplified is not None:
            return simplified
    if name in SWAPPED_COMPARISONS:
        return _apply_elementwise(graph, SWAPPED_COMPARISONS[name], args[::-1])
    name = OPERATION_ALIASES.get(name, name)
    masks = [isinstance(arg, TracedArray) and arg.mask for arg in args]
    if all(masks) and name not in BOOLEAN_OPERATIONS:
        raise NotTraceableError(f"numpy.{name} of Booleans is not traced")
    node_arrays = [to_node_array(_to_nodes(graph, arg)) for arg in args]
    return TracedArray(
        graph, apply_elementwise(graph, name, node_arrays), name in BOOLEAN_OPERATIONS
    )


def _simplify_power(graph: ExpressionGraph, base: Any, exponent: float) -> TracedArray | None:
    """Return a power that NumPy computes as a simpler operation; None for other exponents.

    Args:
        graph: graph to which nodes are added.
        base: traced array.
        exponent: the exponent.
    """
    if exponent == 2.0:
        return _apply_elementwise(graph, "multiply", (base, base))
    if exponent == 0.5:
        return _apply_elementwise(graph, "sqrt", (base,))
    if exponent == -1.0:
        return _apply_elementwise(graph, "divide", (1.0, base))
    return TracedArray(graph, _to_nodes(graph, base)) if exponent == 1.0 else None


def _unwrap_arguments(graph: ExpressionGraph, args: Any) -> list[Any]:
    """Return arguments with traced arrays, and numbers next to them in lists, as nodes.

    Args:
        graph: graph to which constant nodes are added.
        args: arguments of a NumPy function.
    """

    def bare(arg: Any) -> Any:
        """Return the nodes of one argument; an argument without traced arrays is unchanged."""
        if isinstance(arg, TracedArray):
            return arg.nodes
        if isinstance(arg, list | tuple) and any(isinstance(part, TracedArray) for part in arg):
            return [_to_nodes(graph, part) for part in arg]
        return arg

    return [bare(arg) for arg in args]


def _wrap_result(graph: ExpressionGraph, result: Any) -> Any:
    """Return arrays of nodes, also several in a list or tuple, as traced arrays.

    Args:
        graph: graph that contains the nodes.
        result: array of nodes, or a list or tuple of arrays.
    """
    if isinstance(result, list | tuple):
        return type(result)(_wrap_result(graph, part) for part in result)
    return TracedArray(graph, to_node_array(result))


def _find_graph(*args: Any) -> ExpressionGraph:
    return next(arg.graph for arg in args if isinstance(arg, TracedArray))


def _trace_where(condition: Any, *values: Any) -> TracedArray:
    """Trace numpy.where(condition, x, y), a choice between two numbers for each element.

    Args:
        condition: traced array of Booleans.
        *values: x and y.
    """
    if len(values) != 2:
        raise NotTraceableError("numpy.where with a condition alone is not traced")
    graph = _find_graph(condition, *values)
    return _apply_elementwise(graph, "where", (condition, *values))


def _trace_clip(x: Any, low: Any, high: Any) -> TracedArray:
    """Trace numpy.clip as a maximum and a minimum; at least one argument is traced.

    Args:
        x: values to clip.
        low: lower limit; None for no limit.
        high: upper limit; None for no limit.
    """
    graph = _find_graph(x, low, high)
    result: TracedArray = x
    if low is not None:
        result = _apply_elementwise(graph, "maximum", (result, low))
    if high is not None:
        result = _apply_elementwise(graph, "minimum", (result, high))
    return result


def _fill_like(x: TracedArray, value: float) -> TracedArray:
    """Return a traced array of the same shape as x, with one constant in every place.

    Args:
        x: traced array.
        value: the constant.
    """
    nodes = np.empty(x.shape, dtype=object)
    nodes[...] = x.graph.make_constant(value)
    return TracedArray(x.graph, nodes)


def _trace_sum(x: TracedArray, axis: Any = None, keepdims: bool = False, **_: Any) -> TracedArray:
    return x.sum(axis, keepdims)


def _trace_norm(
    x: TracedArray,
    ord: Any = None,  # noqa: A002
    axis: Any = None,
    keepdims: bool = False,
) -> TracedArray:
    """Trace numpy.linalg.norm as the root of the sum of squares (Euclidean or Frobenius norm).

    Args:
        x: traced array.
        ord: order of the norm; only the default is traced.
        axis: axis or axes of the sum; None for all.
        keepdims: whether the summed axes stay with length one.

    Raises:
        NotTraceableError: another order is requested.
    """
    if ord is not None:
        raise NotTraceableError("numpy.linalg.norm with the argument ord is not traced")
    squares = _apply_elementwise(x.graph, "multiply", (x, x)).sum(axis, keepdims)
    return _apply_elementwise(x.graph, "sqrt", (squares,))


_FUNCTIONS: dict[str, Callable[..., TracedArray]] = {
    "where": _trace_where,
    "clip": _trace_clip,
    "sum": _trace_sum,
    "norm": _trace_norm,
    "max": lambda x, axis=None, keepdims=False, **_: x.max(axis, keepdims),
    "min": lambda x, axis=None, keepdims=False, **_: x.min(axis, keepdims),
    "amax": lambda x, axis=None, keepdims=False, **_: x.max(axis, keepdims),
    "amin": lambda x, axis=None, keepdims=False, **_: x.min(axis, keepdims),
    "zeros_like": lambda x, **_: _fill_like(x, 0.0),
    "empty_like": lambda x, **_: _fill_like(x, 0.0),
    "ones_like": lambda x, **_: _fill_like(x, 1.0),
    "full_like": lambda x, value, **_: _fill_like(x, float(value)),
}


def make_input_vector(graph: ExpressionGraph, size: int, changes: int) -> Any:
    """Return a traced array (1, size) of new inputs, whose values are not known.

    Args:
        graph: graph that contains the nodes.
        size: number of inputs.
        changes: how often the values change: `PER_ELEMENT`, `PER_EVALUATION` or `PER_IMPACT`.
    """
    nodes = np.empty((1, size), dtype=object)
    for k in range(size):
        nodes[0, k] = graph.make_input(changes)
    return TracedArray(graph, nodes)


def collect_nodes(*arrays: TracedArray) -> list[ExpressionNode]:
    """Return all nodes of traced arrays, in order."""
    return [node for array in arrays for node in array.nodes.ravel()]


def collect_output(graph: ExpressionGraph, values: Any, size: int) -> list[ExpressionNode]:
    """Return the nodes of an output, broadcast to its size.

    Args:
        graph: graph to which constant nodes are added.
        values: traced array, or numbers.
        size: number of values.
    """
    nodes = values.nodes if isinstance(values, TracedArray) else make_constant_nodes(graph, values)
    return list(np.broadcast_to(nodes, (1, size))[0])


def sort_nodes(outputs: Sequence[ExpressionNode]) -> list[ExpressionNode]:
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
