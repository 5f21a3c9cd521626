"""Options that a command, a Python function and the code below them share, declared once.

A frozen dataclass declares the options of one job. `option` declares a field, `with_options` gives
a public function the fields as keyword arguments, and `bench.cli.shared_options` makes options of
a command from them. The docstring of the class is the documentation of both.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import field
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from sims.core.argument_checks import bind_checked, get_hints

Source = TypeVar("Source")
Options = TypeVar("Options")
Result = TypeVar("Result")
P = ParamSpec("P")

_ATTRIBUTE = re.compile(r"^(\w+): (.+(?:\n .+)*)", re.MULTILINE)
"""Entry of the section Attributes of a docstring, without the indentation of the section."""


def option(
    default: Any,
    metavar: str = "",
    *,
    flags: Sequence[str] = (),
    choices: Sequence[str] | None = None,
    in_command: bool = True,
) -> Any:
    """Declare a field of an options dataclass.

    Args:
        default: Default value.
        metavar: Placeholder of the value in the help of a command; empty for the one of its type.
        flags: Names of the option in a command, if they differ from ``--NAME``.
        choices: Allowed values in a command; None for any.
        in_command: Whether commands have this option.
    """
    metadata = {"metavar": metavar, "flags": flags, "choices": choices, "in_command": in_command}
    return field(default=default, metadata=metadata)


def read_option_texts(options: type) -> dict[str, str]:
    """Return the description of each field of an options dataclass, from the docstrings."""
    texts: dict[str, str] = {}
    # Base classes first, so that a subclass can describe a field anew.
    for base in reversed(options.__mro__):
        _, _, attributes = (inspect.cleandoc(base.__doc__ or "")).partition("Attributes:\n")
        entries = _ATTRIBUTE.findall(inspect.cleandoc(attributes))
        texts |= {name: " ".join(text.split()) for name, text in entries}
    return texts


def takes_options(
    options: Callable[P, Options], name: str = ""
) -> Callable[[Callable[[Options], Result]], Callable[P, Result]]:
    """Decorate a function of options: callers give the fields as arguments.

    The arguments are checked as by `sims.core.argument_checks.check_arguments`.

    Args:
        options: Frozen dataclass of the options.
        name: Name of the function in messages; empty for its own.
    """

    def decorate(function: Callable[[Options], Result]) -> Callable[P, Result]:
        """Return the function that makes the options from its arguments, and calls `function`."""
        signature, function_name = inspect.signature(options), name or function.__name__

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> Result:
            bound = bind_checked(function_name, signature, get_hints(options), args, kwargs)
            return function(options(*bound.args, **bound.kwargs))

        call.__name__ = function_name
        _set_signature(call, options, signature)
        return call

    return decorate


def with_options(
    options: Callable[P, Options],
) -> Callable[[Callable[[Source, Options], Result]], Callable[Concatenate[Source, P], Result]]:
    """Decorate a function of a source and options: callers give the options as keyword arguments.

    The source is the first argument, such as the path of a recording. The arguments are checked as
    by `sims.core.argument_checks.check_arguments`.

    Args:
        options: Frozen dataclass of the options.
    """

    def decorate(
        function: Callable[[Source, Options], Result],
    ) -> Callable[Concatenate[Source, P], Result]:
        """Return the function that makes the options from keywords, and calls `function`."""
        # The caller gives the fields of the second argument, the options, by keyword.
        source, _ = inspect.signature(function).parameters.values()
        keywords = inspect.signature(options).parameters.values()
        signature = inspect.Signature(
            [source, *(option.replace(kind=option.KEYWORD_ONLY) for option in keywords)]
        )

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Result:
            hints = {**get_hints(options), source.name: get_hints(function)[source.name]}
            arguments = bind_checked(function.__name__, signature, hints, args, kwargs).arguments
            make_options: Callable[..., Options] = options
            return function(arguments.pop(source.name, source.default), make_options(**arguments))

        _set_signature(call, options, signature)
        return call

    return decorate


def _set_signature(call: Any, options: Any, signature: inspect.Signature) -> None:
    """Give a function the signature of its callers, and the descriptions of its options.

    Without this, help() and editors would show ``*args, **kwargs``.
    """
    call.__signature__ = signature
    texts = read_option_texts(options)
    lines = [f"    {name}: {texts[name]}" for name in signature.parameters if name in texts]
    call.__doc__ = "\n".join([inspect.cleandoc(call.__doc__ or ""), "", "Options:", *lines])
