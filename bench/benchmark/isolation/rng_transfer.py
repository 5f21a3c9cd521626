"""Convert the state of a random generator to bytes that can be sent through a pipe."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray


def encode_rng_state(state: Any) -> NDArray[np.uint8]:
    """Return the state of a PCG64 generator as JSON in an array of bytes."""
    return np.frombuffer(json.dumps(state).encode(), dtype=np.uint8)


def decode_rng_state(text: NDArray[Any]) -> dict[str, Any]:
    """Return the state of a PCG64 generator from the result of `encode_rng_state`.

    Raises:
        ValueError: the text is not a valid state.
    """
    generator = np.random.PCG64()
    try:
        state = json.loads(text.tobytes())
        generator.state = state
        # With an even increment the stream may be constant, and rejection sampling would never end.
        if generator.state == state and state["state"]["inc"] & 1:
            return dict(state)
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError):
        pass
    raise ValueError("not the state of a random generator")
