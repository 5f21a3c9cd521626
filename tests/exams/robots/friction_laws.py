"""Dry friction of several joints with exact sticking.

While a joint slides, friction is a force of known size against its motion. While it is at rest,
friction holds it, up to its limit. Accelerations and friction forces are then a linear
complementarity problem over the joints at rest, coupled by the inertia matrix.

Sources: Ph. Lötstedt, Mechanical systems of rigid bodies subject to unilateral constraints, SIAM J.
Appl. Math. 42 (1982), for accelerations; J. J. Moreau, Unilateral contact and dry friction in
finite freedom dynamics (1988), and D. Stewart and J. Trinkle, IJNME 39 (1996), for time stepping.
Solved by projected Gauss-Seidel (R. Cottle, J.-S. Pang, R. Stone, The Linear Complementarity
Problem, 1992, section 5.2).
"""

from __future__ import annotations

import numpy as np

TIGHT = 1e-13  # Convergence threshold of the sweeps, as a fraction of the largest force.
SWEEPS = 10_000


def held(coupling, free, limits):
    """Return friction forces (S,) and accelerations (S,) of the joints at rest.

    With a = free + coupling f: |f| <= limits, a = 0 where |f| < limits, and a has the opposite sign
    of f where f is at its limit.

    Args:
        coupling: acceleration per force, symmetric and positive definite, (S, S).
        free: accelerations without these forces, (S,).
        limits: largest friction forces, (S,).
    """
    forces, scale = np.zeros(free.size), max(float(np.max(limits, initial=0.0)), 1e-300)
    for _ in range(SWEEPS):
        change = 0.0
        for i in range(free.size):
            pull = free[i] + coupling[i] @ forces
            new = min(max(forces[i] - pull / coupling[i, i], -limits[i]), limits[i])
            change = max(change, abs(new - forces[i]))
            forces[i] = new
        if change <= TIGHT * scale:
            return forces, free + coupling @ forces
    raise RuntimeError("friction did not settle")
