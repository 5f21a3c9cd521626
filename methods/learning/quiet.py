"""Calls of packages that print, warn and draw from global generators, made as if they did not."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout

import numpy as np

from methods.learning.pair_network import reproducible


@contextmanager
def quietly(rng: np.random.Generator) -> Iterator[None]:
    """Global generators seeded from `rng` inside and as they were outside; one thread, no warnings,
    nothing printed.
    """
    import torch

    # packages draw from NumPy's and torch's global generators, which belong to the caller
    legacy = np.random.get_state()  # noqa: NPY002 - it is what is guarded
    seed = int(rng.integers(2**62))
    with (
        torch.random.fork_rng(devices=[]),
        reproducible(),
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


class Silent:
    """A tracker of training that keeps nothing; the package's own writes files where it runs."""

    log_dir = None

    def __getattr__(self, _: str) -> Callable[..., None]:
        return lambda *_args, **_options: None
