"""Dry friction of several joints that truly sticks.

While a joint slides, friction is a force of known size against its motion. Where it stands still,
friction is what keeps it so, up to its limit: accelerations and forces are then a linear
complementarity problem over the joints that stand still, coupled by the inertia matrix.

Sources: Ph. Lötstedt, Mechanical systems of rigid bodies subject to unilateral constraints, SIAM J.
Appl. Math. 42 (1982), on accelerations; J. J. Moreau, Unilateral contact and dry friction in finite
freedom dynamics (1988), and D. Stewart and J. Trinkle, IJNME 39 (1996), on the same in time steps;
solved by projected Gauss-Seidel (R. Cottle, J.-S. Pang, R. Stone, The Linear Complementarity
Problem, 1992, section 5.2).
"""

from __future__ import annotations

import numpy as np

TIGHT = 1e-13  # of the largest force: where the sweeps end
SWEEPS = 10_000


def held(coupling, free, limits):
    """Friction forces (S,) of joints that stand still, and their accelerations (S,).

    With a = free + coupling f: |f| <= limits, a = 0 where |f| < limits, and a against f where it is
    at its limit.

    Args:
        coupling: acceleration by force, symmetric and positive definite, (S, S).
        free: accelerations without these forces, (S,).
        limits: largest friction, (S,).
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
