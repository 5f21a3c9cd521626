"""Read tensors of PyTorch files (``.pt``, ``.pth``) without torch and without unpickling.

The files are zip archives. An archive holds ``data.pkl``, a pickle program that builds lists and
dictionaries of tensors; their numbers are in ``data/0``, ``data/1`` and so on. The program is read
step by step (`pickletools`). Only steps that build containers and tensors are carried out: no name
in it is imported or called. (Layout: pytorch, torch/serialization.py.)
"""

from __future__ import annotations

import pickletools
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array, InputError, make_read_only
from sims.recording.log_formats.hdf5_and_parquet import MAX_COLUMNS
from sims.recording.log_formats.read_errors import make_memory_error

ENDINGS = (".pt", ".pth")
"""File name endings of PyTorch files."""
MAX_PROGRAM = 10_000_000
"""Maximum size of the pickle program of an archive, in bytes."""
MAX_ENTRIES = 250_000_000
"""Maximum number of entries of a tensor (2 GB of 64-bit numbers)."""
MAX_DEPTH = 8
"""Maximum depth of nested containers."""
_NUMBER_TYPES = {
    "FloatStorage": "<f4", "DoubleStorage": "<f8", "HalfStorage": "<f2", "LongStorage": "<i8",
    "IntStorage": "<i4", "ShortStorage": "<i2", "CharStorage": "i1", "ByteStorage": "u1",
    "BoolStorage": "?", "BFloat16Storage": "<u2",
}  # fmt: skip
"""Number type of each torch storage class."""


class _Name(NamedTuple):
    """Name of a class or function in the program, which is never imported."""

    text: str


class _Storage(NamedTuple):
    """Numbers in the archive: their storage class, and the name of their archive entry."""

    kind: str
    key: str


class _Tensor(NamedTuple):
    """Tensor: its storage, and the offset, size and strides of its numbers there."""

    storage: _Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


class _Other(NamedTuple):
    """Object of another class, which is left out."""

    name: str


_STACK_MARK = _Other("mark")


def read_tensors(path: Path) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Read the tensors of a PyTorch file, and its lists of texts.

    Returns:
        Tensors by name, (T,) or (T, k), and the texts of each other entry, empty where it holds
        something else.

    Raises:
        InputError: The file is not a PyTorch archive; the message is one line.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return _read_tensors(path, archive)
    except zipfile.BadZipFile:
        raise InputError(
            f"{path}: expected a PyTorch file as a zip archive, found another format; save it "
            "again with torch.save of PyTorch 1.6 or newer"
        ) from None
    except InputError:
        raise
    except MemoryError:
        raise make_memory_error(path) from None
    except Exception as error:  # a damaged archive or program can fail in any step
        raise InputError(
            f"{path}: not a PyTorch file that can be read ({type(error).__name__})"
        ) from None


def _read_tensors(
    path: Path, archive: zipfile.ZipFile
) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Read all tensors of one or two dimensions in an archive, and its lists of texts, by name.

    Raises:
        InputError: the archive has no single pickle program, or one that is too large.
    """
    programs = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    if len(programs) != 1:
        raise InputError(f"{path}: expected one data.pkl in the archive, found {len(programs)}")
    if archive.getinfo(programs[0]).file_size > MAX_PROGRAM:
        raise InputError(f"{path}: data.pkl is too large for a log of tensors")
    folder = programs[0].removesuffix("data.pkl")
    content = _run_pickle_program(archive.read(programs[0]))
    columns: dict[str, Array] = {}
    texts: dict[str, list[str]] = {}
    for name, value in _flatten_containers("", content, 0):
        if isinstance(value, _Tensor) and 1 <= len(value.size) <= 2:
            columns[name] = _read_storage(path, archive, folder, value)
        elif isinstance(value, list) and all(isinstance(item, str) for item in value):
            texts[name] = value
        else:
            texts[name] = []
    return columns, texts


def _flatten_containers(name: str, value: Any, depth: int) -> list[tuple[str, Any]]:
    """Flatten nested containers to named entries; lists of numbers and texts stay whole.

    Raises:
        ValueError: There are more than `MAX_COLUMNS` entries, as where containers hold each other.
    """
    children: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        children = list(value.items())
    elif type(value) in (list, tuple) and any(map(_is_container, value)):
        children = list(enumerate(value))
    if not children or depth > MAX_DEPTH:
        return [(name or "tensor", value)]
    entries: list[tuple[str, Any]] = []
    for key, child in children:
        entries += _flatten_containers(f"{name}/{key}" if name else str(key), child, depth + 1)
        if len(entries) > MAX_COLUMNS:
            raise ValueError("too many entries")
    return entries


def _is_container(value: Any) -> bool:
    """Return whether a value is a tensor, or may contain some."""
    return isinstance(value, dict | list | _Tensor)


def _read_storage(path: Path, archive: zipfile.ZipFile, folder: str, tensor: _Tensor) -> Array:
    """Read the numbers of a tensor from its storage in the archive.

    Element (i, j) is the number at offset + i stride_0 + j stride_1 of the storage.

    Raises:
        InputError: the tensor holds no numbers, is too large, or exceeds its storage.
    """
    number_type = _NUMBER_TYPES.get(tensor.storage.kind)
    if number_type is None:
        raise InputError(f"{path}: expected tensors of numbers, found {tensor.storage.kind}")
    if np.prod(tensor.size, dtype=np.float64) > MAX_ENTRIES:
        raise InputError(f"{path}: a tensor has more than {MAX_ENTRIES} entries")
    entry = f"{folder}data/{tensor.storage.key}"
    if archive.getinfo(entry).file_size > 8 * MAX_ENTRIES:
        raise InputError(f"{path}: {entry} is too large for a log of tensors")
    stored_numbers = np.frombuffer(archive.read(entry), dtype=number_type)
    if tensor.storage.kind == "BFloat16Storage":
        # A bfloat16 is the upper half of a 32-bit number.
        stored_numbers = (stored_numbers.astype(np.uint32) << 16).view(np.float32)
    if 0 in tensor.size:
        return make_read_only(np.empty(tensor.size))
    steps = [(n - 1) * s for n, s in zip(tensor.size, tensor.stride, strict=True)]
    if min(tensor.offset, *tensor.stride) < 0 or tensor.offset + sum(steps) >= stored_numbers.size:
        raise InputError(f"{path}: {entry} has fewer numbers than its tensor")
    indices = np.full((), tensor.offset)
    for length, stride in zip(tensor.size, tensor.stride, strict=True):
        indices = indices[..., None] + stride * np.arange(length)
    return make_read_only(stored_numbers[indices].astype(np.float64))


def _run_pickle_program(program: bytes) -> Any:
    """Carry out the steps of a program that build containers and tensors.

    Raises:
        ValueError: The program contains another step.
    """
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for step, argument, _ in pickletools.genops(program):
        opcode = step.name
        if opcode in ("PROTO", "FRAME"):
            continue
        if opcode == "STOP":
            return stack[-1]
        if opcode == "MARK":
            stack.append(_STACK_MARK)
        elif opcode in ("BINPUT", "LONG_BINPUT", "PUT"):
            memo[int(str(argument))] = stack[-1]
        elif opcode == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif opcode in ("BINGET", "LONG_BINGET", "GET"):
            stack.append(memo[int(str(argument))])
        elif opcode in _CONSTANTS:
            stack.append(_CONSTANTS[opcode])
        elif opcode in ("EMPTY_DICT", "EMPTY_LIST", "EMPTY_TUPLE"):
            empty: dict[str, Any] = {"EMPTY_DICT": {}, "EMPTY_LIST": [], "EMPTY_TUPLE": ()}
            stack.append(empty[opcode])
        elif opcode == "GLOBAL":
            stack.append(_Name(str(argument).replace(" ", ".")))
        elif opcode == "STACK_GLOBAL":
            attribute, module = stack.pop(), stack.pop()
            stack.append(_Name(f"{module}.{attribute}"))
        elif opcode == "POP":
            stack.pop()
        elif argument is not None and opcode.startswith(_NUMBERS_AND_TEXTS):
            stack.append(argument)
        else:
            _build_object(opcode, stack)
    raise ValueError("the program has no end")


_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_NUMBERS_AND_TEXTS = (
    "BININT", "INT", "LONG", "BINFLOAT", "FLOAT", "BINUNICODE", "SHORT_BINUNICODE", "UNICODE",
    "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES",
)  # fmt: skip
"""Beginnings of the names of steps that push a number or a text onto the stack."""


def _build_object(opcode: str, stack: list[Any]) -> None:
    """Carry out one instruction of the pickle program that builds an object from the stack.

    Only containers and tensors are built; nothing is imported or called.
    """
    if opcode in ("TUPLE", "LIST", "DICT", "APPENDS", "SETITEMS"):
        mark_index = max(i for i, value in enumerate(stack) if value is _STACK_MARK)
        values = stack[mark_index + 1 :]
        del stack[mark_index:]
        if opcode == "TUPLE":
            stack.append(tuple(values))
        elif opcode == "LIST":
            stack.append(values)
        elif opcode == "DICT":
            stack.append(dict(zip(values[::2], values[1::2], strict=True)))
        elif opcode == "APPENDS":
            _as_list(stack[-1]).extend(values)
        else:
            _as_dict(stack[-1]).update(zip(values[::2], values[1::2], strict=True))
    elif opcode in ("TUPLE1", "TUPLE2", "TUPLE3"):
        count = int(opcode[-1])
        values = stack[-count:]
        del stack[-count:]
        stack.append(tuple(values))
    elif opcode == "APPEND":
        value = stack.pop()
        _as_list(stack[-1]).append(value)
    elif opcode == "SETITEM":
        value, key = stack.pop(), stack.pop()
        _as_dict(stack[-1])[key] = value
    elif opcode == "BINPERSID":
        # ("storage", class, key, device, number of entries)
        _, kind, key, *_ = stack.pop()
        stack.append(_Storage(kind.text.rpartition(".")[2], str(key)))
    elif opcode in ("REDUCE", "NEWOBJ"):
        arguments, made_by = stack.pop(), stack.pop()
        stack.append(_evaluate_call(made_by, arguments))
    elif opcode == "BUILD":
        stack.pop()  # attributes of an object
    else:
        raise ValueError(f"unknown step {opcode}")


def _evaluate_call(function: Any, arguments: Any) -> Any:
    """Return the result of a call in the program: a tensor, a dictionary, or a placeholder."""
    name = function.text if isinstance(function, _Name) else ""
    if name == "torch._utils._rebuild_tensor_v2":
        storage, offset, size, stride, *_ = arguments
        return _Tensor(storage, int(offset), tuple(map(int, size)), tuple(map(int, stride)))
    if name == "torch._utils._rebuild_parameter":
        return arguments[0]
    if name == "collections.OrderedDict":
        return {}
    return _Other(name)


def _as_list(value: Any) -> list[Any]:
    """Return a list unchanged, and a new list, which is discarded, for any other value."""
    return value if isinstance(value, list) else []


def _as_dict(value: Any) -> dict[Any, Any]:
    """Return a dictionary unchanged, and a new one, which is discarded, for any other value."""
    return value if isinstance(value, dict) else {}
