"""Read tensors of PyTorch files (``.pt``, ``.pth``) without torch and without running their code.

The files are zip archives. An archive holds ``data.pkl``, a pickle program that builds lists and
dictionaries of tensors; their numbers are in ``data/0``, ``data/1`` and so on. The names in the
program are restricted as in "Restricting Globals" of Python's documentation of pickle: none is
imported or called. (Layout: pytorch, torch/serialization.py.)
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sims.core.simulator import Array, InputError, make_read_only
from sims.recording.log_formats.log_columns import MAX_COLUMNS, convert_read_errors

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


class _UnknownObject:
    """Object of any other class, which is left out: it ignores its arguments and its content."""

    def __init__(self, *_: object) -> None:
        """Ignore what the object was made from."""

    def __call__(self, *_: object) -> _UnknownObject:
        """Return this object for the result of a call to it."""
        return self

    def __setstate__(self, _: object) -> None:
        """Ignore the attributes of the object."""

    append = extend = __setstate__

    def __setitem__(self, _key: object, _value: object) -> None:
        """Ignore an entry of the object."""


class _TensorUnpickler(pickle._Unpickler):
    """Unpickler that makes containers and tensors only; no name in the file is imported.

    It is the one in Python, because the one in C allocates memory for any number in the program.
    """

    def find_class(self, module: str, name: str) -> Any:
        """Return the substitute for a class or function that the pickle program names."""
        if module == "torch" and name.endswith("Storage"):
            return name
        return _KNOWN_NAMES.get(f"{module}.{name}", _UnknownObject)

    def persistent_load(self, pid: Any) -> _Storage:
        """Return a storage from ("storage", class, key, device, number of entries)."""
        _, kind, key, *_ = pid
        return _Storage(kind, str(key))


def _make_tensor(storage: _Storage, offset: int, size: Any, stride: Any, *_: object) -> _Tensor:
    return _Tensor(storage, int(offset), tuple(map(int, size)), tuple(map(int, stride)))


_KNOWN_NAMES = {
    "torch._utils._rebuild_tensor_v2": _make_tensor,
    "torch._utils._rebuild_parameter": lambda tensor, *_: tensor,
    "collections.OrderedDict": OrderedDict,
}


def read_tensors(path: Path) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Read the tensors of a PyTorch file, and its lists of texts.

    Shapes: T samples.

    Returns:
        Tensors of one or two dimensions by name, (T,) or (T, k), and the texts of each other entry,
        empty where it holds something else.

    Raises:
        InputError: The file is not a PyTorch archive; the message is one line.
    """
    with convert_read_errors(path, "a PyTorch file"):
        try:
            with zipfile.ZipFile(path) as archive:
                return _read_tensors(path, archive)
        except zipfile.BadZipFile:
            raise InputError(
                f"{path}: expected a PyTorch file as a zip archive, found another format; save it "
                "again with torch.save of PyTorch 1.6 or newer"
            ) from None


def _read_tensors(
    path: Path, archive: zipfile.ZipFile
) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Read all tensors of one or two dimensions in an archive, and its lists of texts.

    Shapes: T samples.

    Args:
        path: path of the file, for messages.
        archive: archive, open for reading.

    Returns:
        Tensors by name, (T,) or (T, k), and the texts of each other entry, empty where it holds
        something else, such as a tensor of more dimensions.

    Raises:
        InputError: the archive has no single pickle program, or one that is too large.
    """
    # The pickle program builds the containers of the tensors; their numbers are in other members.
    programs = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    if len(programs) != 1:
        raise InputError(f"{path}: expected one data.pkl in the archive, found {len(programs)}")
    (program,) = programs
    if archive.getinfo(program).file_size > MAX_PROGRAM:
        raise InputError(f"{path}: data.pkl is too large for a log of tensors")
    folder = program.removesuffix("data.pkl")
    content = _TensorUnpickler(io.BytesIO(archive.read(program))).load()
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
    """Flatten nested dictionaries and lists to named entries.

    The name of an entry is its path, such as ``episode/0/action``. Lists of numbers and texts stay
    whole, and so do containers nested deeper than `MAX_DEPTH`.

    Args:
        name: name of the value, the beginning of the names of its entries; empty for the outermost.
        value: a container, or an entry.
        depth: number of containers around it.

    Returns:
        Name and value of each entry.

    Raises:
        ValueError: There are more than `MAX_COLUMNS` entries, as where containers hold each other.
    """
    children: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        children = list(value.items())
    elif type(value) in (list, tuple) and any(
        isinstance(child, dict | list | _Tensor) for child in value
    ):
        children = list(enumerate(value))
    if not children or depth > MAX_DEPTH:
        return [(name or "tensor", value)]
    entries: list[tuple[str, Any]] = []
    for key, child in children:
        entries += _flatten_containers(f"{name}/{key}" if name else str(key), child, depth + 1)
        if len(entries) > MAX_COLUMNS:
            raise ValueError("too many entries")
    return entries


def _read_storage(path: Path, archive: zipfile.ZipFile, folder: str, tensor: _Tensor) -> Array:
    """Read the numbers of a tensor from its storage in the archive.

    Element (i, j) is the number at offset + i stride_0 + j stride_1 of the storage. The sizes in
    the file are checked before memory is allocated for them.

    Args:
        path: path of the file, for messages.
        archive: archive, open for reading.
        folder: folder of the program in the archive.
        tensor: storage, offset, size and strides of the tensor.

    Raises:
        InputError: the tensor holds no numbers, is too large, or exceeds its storage.
    """
    number_type = _NUMBER_TYPES.get(tensor.storage.kind)
    if number_type is None:
        raise InputError(f"{path}: expected tensors of numbers, found {tensor.storage.kind}")
    if np.prod(tensor.size, dtype=np.float64) > MAX_ENTRIES:
        raise InputError(f"{path}: a tensor has more than {MAX_ENTRIES} entries")
    member_name = f"{folder}data/{tensor.storage.key}"
    # A number has at most 8 bytes.
    if archive.getinfo(member_name).file_size > 8 * MAX_ENTRIES:
        raise InputError(f"{path}: {member_name} is too large for a log of tensors")
    stored_numbers = np.frombuffer(archive.read(member_name), dtype=number_type)
    if tensor.storage.kind == "BFloat16Storage":
        # A bfloat16 is the upper half of a 32-bit number.
        stored_numbers = (stored_numbers.astype(np.uint32) << 16).view(np.float32)
    if 0 in tensor.size:
        return make_read_only(np.empty(tensor.size))
    last_index = tensor.offset + sum(
        (length - 1) * stride for length, stride in zip(tensor.size, tensor.stride, strict=True)
    )
    if min(tensor.offset, *tensor.stride) < 0 or last_index >= stored_numbers.size:
        raise InputError(f"{path}: {member_name} has fewer numbers than its tensor")
    # Indices of all elements, in the shape of the tensor.
    indices = np.full((), tensor.offset)
    for length, stride in zip(tensor.size, tensor.stride, strict=True):
        indices = indices[..., None] + stride * np.arange(length)
    return make_read_only(stored_numbers[indices].astype(np.float64))
