"""Client of the fork server: start the server, and processes of tuners from it."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bench.benchmark.isolation import fork_server
from bench.benchmark.isolation.isolation_layers import PROJECT_ROOT, list_readable_paths
from bench.benchmark.isolation.message_channel import MessageChannel
from bench.benchmark.isolation.process_errors import KilledExternallyError
from bench.benchmark.isolation.resource_limits import THREAD_COUNT_VARIABLES
from bench.benchmark.isolation.temporary_folders import (
    LockedFolder,
    create_locked_folder,
    remove_stale_folders,
)
from bench.benchmark.isolation.tuner_processes import IsolatedProcess
from sims.engines.compiled.machine_code_cache import get_cache_folder

_EXIT_WAIT_SECONDS = 5.0
"""Time in seconds that the fork server has to end after its link is closed."""
_BOOTSTRAP_CODE = (
    "import sys; sys.path[:] = {path!r}; "
    "from bench.benchmark.isolation.fork_server import serve_fork_requests; "
    "serve_fork_requests({descriptor})"
)
_PRELOADED_MODULES = ("numpy.random", "bench.benchmark.isolation.tuner_server")
_NUMERICAL_VARIABLE_PREFIXES = ("OPENBLAS_", "MKL_", "OMP_", "NPY_")
"""Prefixes of environment variables that determine how numerical libraries compute."""


class ForkServerClient:
    """Client of the fork server that starts tuner processes; see `isolation.fork_server`."""

    def __init__(self) -> None:
        """Start the fork server in a new interpreter, which imports the modules that tuners need.

        The server runs in an empty scratch folder (`_folder`, locked while in use) and searches no
        current folder for modules. `_loaded` are the modules that it has already imported;
        processes that it forks start fast, because they inherit these modules.
        """
        self._scratch_folder: LockedFolder | None = create_locked_folder()
        self._folder = self._scratch_folder.path
        self._loaded: set[str] = set()
        self._link, server_link = socket.socketpair()
        root = str(PROJECT_ROOT)
        path = [*(folder for folder in sys.path if folder not in ("", root)), root]
        code = _BOOTSTRAP_CODE.format(path=path, descriptor=server_link.fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            pass_fds=[server_link.fileno()],
            env=_make_environment(self._folder),
            cwd=self._folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
        server_link.close()
        atexit.register(self.close)
        self._send_request({}, _PRELOADED_MODULES)

    def _send_request(
        self, request: Mapping[str, Any], modules: Iterable[str], descriptors: tuple[int, ...] = ()
    ) -> None:
        """Send a request, with modules to be loaded that have not been loaded before.

        Args:
            request: request as JSON values.
            modules: names of modules that the service will need.
            descriptors: file descriptors to pass to the server.
        """
        missing = [name for name in dict.fromkeys(modules) if name not in self._loaded]
        try:
            fork_server.send_request(self._link, {**request, "modules": missing}, descriptors)
        except OSError:
            self.close()
            raise KilledExternallyError("the fork server has ended") from None
        self._loaded.update(missing)

    @property
    def is_alive(self) -> bool:
        """True if the fork server can start another process."""
        return self._process.poll() is None

    def start_process(
        self,
        service: str,
        files: Iterable[str] = (),
        memory: int = 0,
        hidden: Iterable[str] = (),
        modules: Iterable[str] = (),
    ) -> IsolatedProcess:
        """Start an isolated process, by a request to the fork server.

        Two pipes for messages and a control socket to its supervisor are made. Their ends for the
        process are sent with the request and closed here.

        Args:
            service: module and function that the process runs, as ``MODULE:FUNCTION``; it gets a
                message channel, the access policy and the active isolation layers.
            files: files that it may read, in addition to Python and its packages.
            memory: memory limit in MiB; 0 for no limit.
            hidden: folders that it must not access, in addition to the working directory.
            modules: modules that the fork server loads first; never those of plugins, because the
                next process would inherit their effects.

        Returns:
            Handle of the process.

        Raises:
            KilledExternallyError: the fork server is gone.
        """
        request = {
            "service": service,
            "folder": self._folder,
            "readable": [*list_readable_paths((*hidden, str(Path.cwd()))), *files],
            "memory": memory,
        }
        # A pipe has a reading end, given first, and a writing end.
        (reading, child_writing), (child_reading, writing) = os.pipe(), os.pipe()
        control, child_control = socket.socketpair()
        descriptors = child_control.fileno(), child_reading, child_writing
        try:
            self._send_request(request, modules, descriptors)
        except KilledExternallyError:
            control.close()
            os.close(reading)
            os.close(writing)
            raise
        finally:
            # The process has its own copies. While a copy is open here, no end of file arrives when
            # the process ends.
            child_control.close()
            os.close(child_reading)
            os.close(child_writing)
        return IsolatedProcess(MessageChannel(reading, writing), control, self.empty_shared_folder)

    def empty_shared_folder(self) -> None:
        """Delete the content of the folder that processes without their own folder share."""
        for path in Path(self._folder).iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)

    def close(self) -> None:
        """End the fork server and every process that it started, and delete their scratch folder.

        The server ends by itself when its link is closed; it is killed if this takes longer than
        `_EXIT_WAIT_SECONDS`.
        """
        atexit.unregister(self.close)
        self._link.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=_EXIT_WAIT_SECONDS)
        self._process.kill()
        self._process.wait()
        if self._scratch_folder is not None:
            self._scratch_folder.remove()
            self._scratch_folder = None
        # Workers that have ended may have left their folders.
        remove_stale_folders()


def _make_environment(folder: str) -> dict[str, str]:
    """Return the environment variables of tuner processes.

    Only variables that numerical libraries and Python need are inherited, because others could pass
    information to a tuner. Unless the user has set it, the number of numerical threads is one.

    Args:
        folder: Private folder of the process, which becomes its home and its place for temporary
            files.
    """
    inherited_names = (
        "PATH",
        "LANG",
        "LC_ALL",
        "LD_LIBRARY_PATH",
        "CUDA_VISIBLE_DEVICES",
        "SYSTEMROOT",
    )
    variables = {name: os.environ[name] for name in inherited_names if name in os.environ}
    # Libraries would otherwise compute differently, and results would differ in the last digits.
    variables |= {
        name: value
        for name, value in os.environ.items()
        if name.startswith(_NUMERICAL_VARIABLE_PREFIXES)
    }
    # Compiled steps are loaded from the cache folder before the process is isolated.
    variables["SIMGAP_COMPILED"] = str(get_cache_folder())
    single_thread = dict.fromkeys(THREAD_COUNT_VARIABLES, "1")
    return {
        **single_thread,
        **variables,
        "HOME": folder,
        "TMPDIR": folder,
        "PYTHONDONTWRITEBYTECODE": "1",
    }
