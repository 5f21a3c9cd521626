"""Impacts with level ground: velocity after an impact, and end of bouncing.

The last coordinate strikes the ground at its `floor`; the others are tangential. Restitution e is
the system's, modified by the contact effects in their order. With the normal speed n and the
tangential velocity u before the impact,

    n' = e n                                                               (1)
    u' = u max(1 - mu (1 + e) n / |u|, 1 - g)                              (2)

so the ground removes the tangential speed mu (1 + e) n, but never more than there is (R. M. Brach,
J. Appl. Mech. 56(1), 133, 1989, doi:10.1115/1.3176033). The maximum tangential impulse share g is
1, or less where the system specifies at which share a body that starts to spin begins to roll. A
ball that rests on the ground has no impacts and is not slowed by it.

A ball with e < 1 stops bouncing in finite time after infinitely many bounces. A flight that starts
with speed n' under a downward acceleration f lasts

    2 n' / f                                                               (3)

Bouncing is treated as finished when this time is less than `MIN_FLIGHT_SECONDS`, or after more than
`MAX_SHORT_FLIGHTS` consecutive flights shorter than `SHORT_FLIGHT_SECONDS`. The omitted bounces
have impact speeds n', e n', e^2 n', ..., and the tangential speed that they would remove is removed
at once:

    mu (1 + e) (n' + e n' + e^2 n' + ...) = mu (1 + e) n' / (1 - e)        (4)
"""

from __future__ import annotations

MIN_FLIGHT_SECONDS = 5e-5
"""Minimum duration of a flight in seconds; a flight of this duration rises 3 nm."""
SHORT_FLIGHT_SECONDS = 2e-3
"""Duration in seconds below which a flight counts as short, see `MAX_SHORT_FLIGHTS`."""
MAX_SHORT_FLIGHTS = 64
"""Maximum number of consecutive short flights; after more, bouncing is finished."""
