"""Call libraries without side effects: no output or warnings, own random states, determinism."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout

import numpy as np


@contextmanager
def deterministic_training() -> Iterator[None]:
    """Make torch reproducible: one thread, so that sums have a fixed order.

    Other runs can use the machine's other cores.
    """
    import torch

    threads = torch.get_num_threads()
    # A sum that is distributed over threads depends on their number.
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def isolated_library_call(rng: np.random.Generator) -> Iterator[None]:
    """Isolate a call of third-party packages.

    In the block, global generators are seeded from `rng`, one thread is used, and warnings and
    printed output are suppressed. Global generators are restored afterwards.
    """
    import torch

    # Packages draw from NumPy's and torch's global generators, which the caller uses too.
    numpy_state = np.random.get_state()  # noqa: NPY002 - it is what is guarded
    seed = int(rng.integers(2**62))
    with (
        torch.random.fork_rng(devices=[]),
        deterministic_training(),
        warnings.catch_warnings(),
        redirect_stdout(io.StringIO()),
    ):
        warnings.simplefilter("ignore")
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002 - it takes 32 bits
        try:
            yield
        finally:
            np.random.set_state(numpy_state)  # noqa: NPY002


class NullTracker:
    """Training tracker that records nothing; a package's own tracker writes files."""

    log_dir = None

    def __getattr__(self, _: str) -> Callable[..., None]:
        return lambda *_args, **_options: None
