"""Convert the state of a random generator to integers that can be sent through a pipe."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def encode_rng_state(state: Any) -> NDArray[np.int64]:
    """Return the state of a PCG64 generator as six integers."""
    inner, mask = state["state"], (1 << 64) - 1
    wide = [part for n in (inner["state"], inner["inc"]) for part in (n & mask, n >> 64)]
    whole = np.array([*wide, state["has_uint32"], state["uinteger"]], dtype="<u8")
    return whole.view(np.int64)


def decode_rng_state(stream: NDArray[Any]) -> dict[str, Any]:
    """Return the state of a PCG64 generator from the integers of `encode_rng_state`.

    Raises:
        ValueError: the integers are not a valid state.
    """
    low, high, low_step, high_step, has, held = (int(n) & (1 << 64) - 1 for n in stream)
    # With an even increment the stream may be constant, and rejection sampling would never end.
    if has not in (0, 1) or held >> 32 or not low_step & 1:
        raise ValueError("no state of a random stream")
    inner = {"state": high << 64 | low, "inc": high_step << 64 | low_step}
    return {"bit_generator": "PCG64", "state": inner, "has_uint32": has, "uinteger": held}
