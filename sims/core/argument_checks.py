"""Check the arguments of public functions against their annotations.

`check_arguments` decorates a public function. Its arguments are checked before its body runs, and a
wrong one raises an `InputError` that names the argument, the expected and the found value. Values
that lower layers check, such as names of tuners, are not checked here.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, wraps
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from sims.core.number_limits import is_plausible_number
from sims.core.simulator import InputError, make_unknown_name_error
from sims.core.user_messages import truncate_text

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class Expected:
    """Restriction of an argument in addition to its type, used in ``Annotated``.

    Attributes:
        words: Description of the expected value in messages.
        least: Minimum value; None for no minimum.
        above: Exclusive lower bound; None for none.
    """

    words: str
    least: float | None = None
    above: float | None = None

    def allows(self, value: Any) -> bool:
        """Return whether a number is in range."""
        low = self.least is None or value >= self.least
        return low and (self.above is None or value > self.above)


Count = Annotated[int, Expected("a whole number of at least 1", least=1)]
Natural = Annotated[int, Expected("a whole number of at least 0", least=0)]
Seconds = Annotated[float, Expected("a number of seconds above 0", above=0)]
Name = Annotated[str, Expected("a name")]
Names = Annotated[Sequence[str], Expected("a name or a list of names")]
Files = Annotated[Sequence[str | Path], Expected("a path or a list of paths")]


class _MismatchError(Exception):
    """Value that does not match its annotation.

    Args:
        place: The argument and the position in it, as ``effects['drag.linear']``.
        words: Description of the expected value.
        value: Value that was found.
    """

    def __init__(self, place: str, words: str, value: object) -> None:
        super().__init__(place, words, value)
        self.place, self.words, self.value = place, words, value


def check_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Check a function's arguments against its annotations at each call.

    A single name is accepted as a list of one, and a text of names with commas as a list of
    several. NumPy numbers are accepted as Python numbers, integers as floats, and floats without
    fraction as integers.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        """Check and convert the arguments by their annotations, then call the function.

        Args:
            *args: arguments without a name.
            **kwargs: arguments with a name.
        """
        bound = bind_checked(function.__name__, signature, get_hints(function), args, kwargs)
        return function(*bound.args, **bound.kwargs)

    return call


def bind_checked(
    called: str,
    signature: inspect.Signature,
    hints: Mapping[str, Any],
    args: Sequence[object],
    kwargs: Mapping[str, object],
) -> inspect.BoundArguments:
    """Bind the arguments of a call to their names, checked and converted to their annotations.

    Args:
        called: Name of the function, for messages.
        signature: Its parameters.
        hints: Annotations by name; other arguments are not checked.
        args: Arguments without a name.
        kwargs: Arguments by name.

    Raises:
        InputError: An argument is wrong, unknown or missing, or there are too many.
    """
    bound = _bind_arguments(called, signature, hints, args, kwargs)
    for name, value in bound.arguments.items():
        if name in hints:
            try:
                bound.arguments[name] = _convert_value(name, value, hints[name])
            except _MismatchError as error:
                raise InputError(
                    f"{error.place}: expected {error.words}, found {_format_value(error.value)}"
                ) from None
    return bound


def check_options(options: Callable[..., R], values: Mapping[str, object]) -> R:
    """Make an options dataclass from checked and converted values.

    Args:
        options: Dataclass, whose annotations describe the values.
        values: Values by field.

    Raises:
        InputError: A value is wrong.
    """
    signature = inspect.signature(options)
    bound = bind_checked("options", signature, get_hints(options), (), values)
    return options(**bound.arguments)


@cache
def get_hints(annotated: Hashable) -> dict[str, Any]:
    """Return the annotations of a function or of the fields of a class, by name."""
    return get_type_hints(annotated, include_extras=True)


def _bind_arguments(
    function_name: str,
    signature: inspect.Signature,
    hints: Mapping[str, Any],
    args: Sequence[object],
    kwargs: Mapping[str, object],
) -> inspect.BoundArguments:
    """Return the arguments of a call by name, not yet checked, with errors that a user understands.

    Python's own TypeError names neither the expected type nor a similar name.

    Args:
        function_name: name of the function in messages.
        signature: its signature.
        hints: annotation of each argument.
        args: arguments without a name.
        kwargs: arguments with a name.

    Raises:
        InputError: An argument is unknown or missing, or there are too many.
    """
    names = [name for name in signature.parameters if name != "self"]
    for name in kwargs:
        if name not in names:
            raise make_unknown_name_error(f"argument of {function_name}", name, names)
    try:
        return signature.bind(*args, **kwargs)
    except TypeError as error:
        # A required argument is missing: say what is expected for it.
        for name, parameter in signature.parameters.items():
            required = parameter.default is parameter.empty
            # Python's message: missing 1 required positional argument: 'NAME'
            if required and "missing" in str(error) and f"'{name}'" in str(error):
                expected = _describe_type(hints[name])
                raise InputError(
                    f"{function_name}: expected {name}, {expected}; found none"
                ) from None
        # Otherwise, there are too many arguments without a name.
        max_count = sum(p.kind is not p.KEYWORD_ONLY for p in signature.parameters.values())
        plural = "" if max_count == 1 else "s"
        problem = f"expected at most {max_count} argument{plural} without a name, found {len(args)}"
        raise InputError(
            f"{function_name}: {problem}; name the others, as {names[-1]}=..."
        ) from None


def _convert_value(place: str, value: Any, hint: Any) -> Any:
    """Convert a value to the type of its annotation.

    The result may differ from the value, for example a list in place of a single entry.

    Args:
        place: the argument or its entry in messages, such as ``runs[2]``.
        value: value of the argument or entry.
        hint: its annotation.

    Raises:
        _MismatchError: The value does not match.
    """
    origin = get_origin(hint)
    if origin is Annotated:
        return _convert_annotated(place, value, hint)
    if origin in (Union, UnionType):
        return _convert_to_union(place, value, hint)
    # Each generic type, such as Sequence[str], has a converter; ``type[Effect]`` is a single type.
    if origin is not None and origin is not type:
        converted = _CONVERTERS[origin](place, value, hint)
    elif hint is Any:
        return value
    else:
        converted = _convert_to_type(value, hint, get_args(hint))
    if converted is _NO_MATCH:
        raise _MismatchError(place, _describe_type(hint), value)
    return converted


_NO_MATCH = object()
"""Marker for a value that does not match."""


def _convert_annotated(place: str, value: Any, hint: Any) -> Any:
    """Convert a value annotated with `Expected`, whose words replace the default ones.

    Args:
        place: the argument and the position in it, for messages.
        value: value of the argument.
        hint: annotation, ``Annotated[TYPE, Expected(...)]``.

    Raises:
        _MismatchError: the value, or an entry of it, has a wrong type or is out of range.
    """
    annotated_type, expected = get_args(hint)[:2]
    try:
        converted = _convert_value(place, value, annotated_type)
    except _MismatchError as error:
        # An entry of the value is wrong: its own error says more.
        if error.place != place:
            raise
        raise _MismatchError(place, expected.words, value) from None
    # None is possible only if the type allows it; a range does not apply to it.
    if converted is not None and not expected.allows(converted):
        raise _MismatchError(place, expected.words, value)
    return converted


def _convert_to_union(place: str, value: Any, hint: Any) -> Any:
    """Convert a value to the first of several types that accepts it.

    Args:
        place: the argument and the position in it, for messages.
        value: value of the argument.
        hint: annotation, a union of types.

    Raises:
        _MismatchError: no type accepts it; the error names a wrong entry of a list or dict.
    """
    entry_errors = []
    for kind in get_args(hint):
        try:
            return _convert_value(place, value, kind)
        except _MismatchError as error:
            if error.place != place:
                entry_errors.append(error)
    # For a list or dict, report the entry that is wrong.
    if len(entry_errors) == 1:
        raise entry_errors[0]
    raise _MismatchError(place, _describe_type(hint), value)


def _convert_to_type(value: Any, hint: Any, arguments: tuple[Any, ...]) -> Any:
    """Convert a value to a single type; return `_NO_MATCH` if it does not match.

    Only conversions without loss are made: 1 or NumPy's True is a bool, 2.0 an int, a whole number
    a float, but no text is a number.

    Args:
        value: value of the argument.
        hint: annotation, a single type.
        arguments: arguments of this type, as of ``type[Effect]``.
    """
    if hint is NoneType:
        return None if value is None else _NO_MATCH
    if get_origin(hint) is type:  # a subclass of the class in brackets
        return value if inspect.isclass(value) and issubclass(value, arguments[0]) else _NO_MATCH
    if hint is bool:
        is_bool = isinstance(value, bool | np.bool_) or (isinstance(value, int) and value in (0, 1))
        return bool(value) if is_bool else _NO_MATCH
    if hint is int:
        return int(value) if _is_number(value) and _is_whole(value) else _NO_MATCH
    if hint is float:
        if not _is_number(value):
            return _NO_MATCH
        # Keep integers, because hashes of experiments contain numbers as they are written.
        return int(value) if isinstance(value, Integral) else float(value)
    if hint is Path:
        return Path(value) if isinstance(value, PathLike) else _NO_MATCH
    return value if isinstance(value, hint) else _NO_MATCH


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool | np.bool_)


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) or float(value).is_integer()


def _convert_to_list(place: str, value: Any, hint: Any) -> Any:
    """Convert a value to a list; a single entry becomes a list of one.

    Args:
        place: the argument and the position in it, for messages.
        value: value of the argument; a text is split at commas, unless it is a path.
        hint: annotation, a list type.

    Returns:
        The list of converted entries; `_NO_MATCH` if the value is no list, or no valid text.

    Raises:
        _MismatchError: an entry of the list has a wrong type.
    """
    (element_hint,) = get_args(hint)
    if isinstance(value, str):
        # Paths may contain commas, names may not. A path is annotated as text or `Path`.
        is_path = get_origin(element_hint) in (Union, UnionType) and Path in get_args(element_hint)
        parts = [value] if is_path else [part.strip() for part in value.split(",")]
    elif isinstance(value, Iterable) and not isinstance(value, Mapping | bytes):
        parts = list(value)
    elif _is_convertible(value, element_hint):
        parts = [value]
    else:
        return _NO_MATCH
    # A wrong part of a text has no position in a list: the whole text is reported.
    if isinstance(value, str) and not all(_is_convertible(part, element_hint) for part in parts):
        return _NO_MATCH
    return [
        _convert_value(f"{place}[{number}]", part, element_hint)
        for number, part in enumerate(parts)
    ]


def _is_convertible(value: Any, hint: Any) -> bool:
    """Return whether a value has the annotated type, or can be converted to it.

    Args:
        value: value of the argument.
        hint: its annotation.
    """
    try:
        _convert_value("", value, hint)
    except _MismatchError:
        return False
    return True


def _convert_to_dict(place: str, value: Any, hint: Any) -> Any:
    """Convert a value to a dict with texts as keys; return `_NO_MATCH` for another value.

    Args:
        place: the argument and the position in it, for messages.
        value: value of the argument.
        hint: annotation, a mapping type.
    """
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        return _NO_MATCH
    _, entry_hint = get_args(hint)
    return {
        key: _convert_value(f"{place}[{key!r}]", entry, entry_hint) for key, entry in value.items()
    }


def _convert_to_tuple(place: str, value: Any, hint: Any) -> Any:
    """Convert a value to a tuple of the annotated length; return `_NO_MATCH` for another value.

    Args:
        place: the argument and the position in it, for messages.
        value: value of the argument.
        hint: annotation, a tuple type of fixed length.
    """
    entry_types = get_args(hint)
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != len(entry_types):
        return _NO_MATCH
    return tuple(
        _convert_value(place, entry, kind) for entry, kind in zip(value, entry_types, strict=True)
    )


def _convert_to_function(_place: str, value: Any, _hint: Any) -> Any:
    return value if callable(value) else _NO_MATCH


_CONVERTERS: Mapping[Any, Callable[[str, Any, Any], Any]] = {
    Sequence: _convert_to_list,
    Mapping: _convert_to_dict,
    tuple: _convert_to_tuple,
    Callable: _convert_to_function,
}
"""Conversion for each generic type, by the type's origin."""
_TYPE_DESCRIPTIONS: Mapping[Any, str] = {
    str: "text",
    int: "a whole number",
    float: "a number",
    bool: "True or False",
    Path: "a path",
    Callable: "a function",
    Mapping: "a dict",
    tuple: "a pair of numbers",
}
"""Description of each type in messages."""


def _describe_type(hint: Any) -> str:
    """Describe in words what an annotation expects.

    The words follow "expected" in a message, for example "a list (a number each)".
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return str(arguments[1].words)  # of ``Annotated[TYPE, Expected(...)]``
    if origin in (Union, UnionType):
        # Text is accepted for a path, too.
        implied_types = {NoneType, str} if Path in arguments else {NoneType}
        return " or ".join(
            dict.fromkeys(_describe_type(kind) for kind in arguments if kind not in implied_types)
        )
    if origin is Sequence:
        return f"a list ({_describe_type(arguments[0])} each)"
    if origin is Mapping and arguments[1] is not Any:
        return f"a dict ({_describe_type(arguments[1])} for each name)"
    if origin is type:
        return f"a subclass of {arguments[0].__name__}"
    kind = origin or hint
    return _TYPE_DESCRIPTIONS.get(kind) or f"a {kind.__name__}"


def _format_value(value: object) -> str:
    """Format a value for a message: small ones literally, others by their type."""
    if value is None or isinstance(value, str | bool | Real | list | tuple | dict | Path):
        return truncate_text(repr(value))
    if inspect.isclass(value):
        return f"the class {value.__name__}"
    return f"a {type(value).__name__}"


def check_positive(name: str, value: Any, expected: str = "a positive number of seconds") -> float:
    """Check that a setting of an engine is a positive number, and return it as a float.

    Args:
        name: Name of the setting, for messages.
        value: Value that the user has given.
        expected: Description of the expected value for messages.

    Raises:
        InputError: The value is not a positive number.
    """
    if not (is_plausible_number(value) and value > 0):
        raise InputError(f"{name} must be {expected}, found {truncate_text(str(value))}")
    return float(value)
