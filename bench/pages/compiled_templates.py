"""Templates compiled to Python bytecode, stored in a folder as Python stores that of modules.

Compiling the templates of a page takes twice as long as rendering it. Jinja2's own cache unpickles
its files; this one contains marshalled code only, as a .pyc file does.
"""

from __future__ import annotations

import marshal
import os
import sys
from contextlib import suppress
from pathlib import Path
from types import CodeType

import jinja2
from jinja2.bccache import Bucket, BytecodeCache


class CompiledTemplates(BytecodeCache):
    """Cache of compiled templates; without permission to write, they are compiled every time.

    Args:
        folder: Folder of the compiled templates.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load_bytecode(self, bucket: Bucket) -> None:
        """Load the code of a template, if it was compiled from the same source."""
        with suppress(OSError, ValueError, EOFError, TypeError):
            content = self._get_path(bucket).read_bytes()
            checksum = bucket.checksum.encode()
            code = marshal.loads(content[len(checksum) :]) if content.startswith(checksum) else None
            bucket.code = code if isinstance(code, CodeType) else None

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Store the compiled code of a template on disk, for reuse in the next process."""
        if sys.dont_write_bytecode or bucket.code is None:
            return
        path = self._get_path(bucket)
        # Another process may load the file while it is written.
        temporary = path.with_suffix(f".{os.getpid()}")
        with suppress(OSError):
            self._folder.mkdir(exist_ok=True)
            temporary.write_bytes(bucket.checksum.encode() + marshal.dumps(bucket.code))
            temporary.replace(path)

    def _get_path(self, bucket: Bucket) -> Path:
        # Bytecode depends on the version of Python and on that of Jinja2.
        name = f"{bucket.key}.{sys.implementation.cache_tag}-{jinja2.__version__}"
        return self._folder / f"{name}.bin"
