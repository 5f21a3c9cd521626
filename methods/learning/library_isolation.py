"""Call third-party packages without output, warnings or changes of global random generators."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout

import numpy as np

from methods.learning.deterministic_torch import deterministic_training


@contextmanager
def isolated_library_call(rng: np.random.Generator) -> Iterator[None]:
    """Isolate a call of third-party packages.

    In the block, global generators are seeded from `rng`, one thread is used, and warnings and
    printed output are suppressed. Global generators are restored afterwards.
    """
    import torch

    # Packages draw from NumPy's and torch's global generators, which the caller uses too.
    legacy = np.random.get_state()  # noqa: NPY002 - it is what is guarded
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
            np.random.set_state(legacy)  # noqa: NPY002


class NullTracker:
    """Training tracker that records nothing; a package's own tracker writes files."""

    log_dir = None

    def __getattr__(self, _: str) -> Callable[..., None]:
        return lambda *_args, **_options: None
