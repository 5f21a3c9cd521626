"""Compiled recursions of the filter and the smoother, eqs. (1) to (6) of `filter_and_smoother`.

Matrices of a few joints are too small for one library call each: a step in Python takes fifty
microseconds whatever their size. The functions are compiled once (`compiled_functions`) and
allocate no memory.
"""

from __future__ import annotations

import numpy as np

from sims.core.simulator import Array
from sims.engines.compiled.compiled_functions import CompiledFunctions


def multiply_sparse(a: Array, b: Array, out: Array) -> None:
    """Write a b to `out`; zeros of a are skipped, because most entries of a are zero."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            out[i, j] = 0.0
        for k in range(a.shape[1]):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(b.shape[1]):
                    out[i, j] += factor * b[k, j]


def multiply_transposed(a: Array, b: Array, out: Array) -> None:
    """Write aᵀ b to `out`; zeros of a are skipped."""
    for i in range(a.shape[1]):
        for j in range(b.shape[1]):
            out[i, j] = 0.0
    for k in range(a.shape[0]):
        for i in range(a.shape[1]):
            factor = a[k, i]
            if factor != 0.0:
                for j in range(b.shape[1]):
                    out[i, j] += factor * b[k, j]


def propagate_covariance(a: Array, p: Array, product: Array, out: Array) -> None:
    """Write a p aᵀ for a symmetric matrix p to `out`, as a covariance is propagated.

    `product` receives (a p)ᵀ = p aᵀ, for which `out` is used as a buffer. The lower triangle is
    copied from the upper one, so that the result is exactly symmetric.
    """
    # product = (a p)ᵀ
    multiply_sparse(a, p, out)
    size = a.shape[0]
    for i in range(size):
        for j in range(size):
            product[j, i] = out[i, j]
    # out = a (p aᵀ)
    multiply_sparse(a, product, out)
    for i in range(size):
        for j in range(i):
            out[i, j] = out[j, i]


def run_filter(
    states: Array,
    defects: Array,
    forces: Array,
    readings: Array,
    residuals: Array,
    jumps: Array,
    variances: Array,
    prior: Array,
    deviations: Array,
    limits: Array,
    predicted: Array,
    covariances: Array,
    innovations: Array,
    gains: Array,
    whiteners: Array,
    likelihood: Array,
    x: Array,
    moved: Array,
    p: Array,
    work: Array,
    spread: Array,
    root: Array,
    inverse: Array,
    crossed: Array,
    half: Array,
    w: Array,
) -> None:
    """Filter B runs of T samples with Z states, C channels and E forces (Kalman filter).

    The deviation δ of the state is that from the motion about which the model is linear. With δ-
    and P- its prediction and the covariance of that, each sample has ((1) to (4) of
    `filter_and_smoother`)

        e = r - H δ-,    S = H P- Hᵀ + R = L Lᵀ,    W = L⁻¹,    K = P- Hᵀ Wᵀ W
        log L -= log det L + |W e|² / 2

    After each sample but the last, the state is updated by the reading, and that of the next sample
    is predicted:

        δ = δ- + K e,    P = P- - K S Kᵀ,    δ- = A δ - d,    P- = A P Aᵀ + G Q Gᵀ + J

    If a predicted covariance exceeds the limit, the state of an unstable motion is unknown, and its
    covariance is reset to a prior that is wider than that of the first state. Results are written
    to `predicted` and the five arguments after it, which are zero at first; the last ten are
    buffers, so that no memory is allocated.

    Args:
        states: A (B, T - 1, Z, Z).
        defects: d (B, T - 1, Z).
        forces: G (B, T - 1, Z, E).
        readings: H (B, T, C, Z).
        residuals: r (B, T, C).
        jumps: J (B, T - 1, Z), variances.
        variances: diagonal of R (B, T, C), variances of white noise.
        prior: (Z,) standard deviations of the first states.
        deviations: (B, E) standard deviations of the missing forces, whose squares are Q.
        limits: (1,) maximum covariance.
        predicted: δ- (B, T, Z).
        covariances: P- (B, T, Z, Z).
        innovations: e (B, T, C).
        gains: K (B, T, Z, C).
        whiteners: W (B, T, C, C).
        likelihood: log L (B,).
        x: (Z,) deviation of the state.
        moved: (Z,) deviation of the next state.
        p: (Z, Z) covariance of the state.
        work: (Z, Z) product.
        spread: (Z, Z) propagated covariance.
        root: (C, C) Cholesky factor L of S.
        inverse: (C, C) inverse of L.
        crossed: (C, Z) H P.
        half: (C, Z) L⁻¹ H P.
        w: (C,) whitened innovation.
    """
    runs, samples, channels, size = readings.shape
    count = forces.shape[3]
    for run in range(runs):
        for z in range(size):
            x[z] = 0.0
            for y in range(size):
                p[z, y] = prior[z] * prior[z] if z == y else 0.0
        total = 0.0
        for i in range(samples):
            h = readings[run, i]
            for z in range(size):
                predicted[run, i, z] = x[z]
                for y in range(size):
                    covariances[run, i, z, y] = p[z, y]
            # crossed = H P
            multiply_sparse(h, p, crossed)
            # S = H P Hᵀ + R (lower triangle, in `root`), and in place, row by row, its Cholesky
            # factor L
            for c in range(channels):
                for d in range(c + 1):
                    root[c, d] = variances[run, i, c] if c == d else 0.0
                for y in range(size):
                    factor = h[c, y]
                    if factor != 0.0:
                        for d in range(c + 1):
                            root[c, d] += factor * crossed[d, y]
                for d in range(c + 1):
                    value = root[c, d]
                    for k in range(d):
                        value -= root[c, k] * root[d, k]
                    root[c, d] = np.sqrt(value) if c == d else value / root[d, d]
            # W = L⁻¹ by forward substitution, and half = W H P
            for c in range(channels):
                for d in range(c + 1):
                    value = 1.0 if c == d else 0.0
                    for k in range(d, c):
                        value -= root[c, k] * inverse[k, d]
                    inverse[c, d] = value / root[c, c]
            multiply_sparse(inverse, crossed, half)
            # Innovation, whitened innovation w = W e, and what they add to the log-likelihood.
            for c in range(channels):
                value = residuals[run, i, c]
                for z in range(size):
                    value -= h[c, z] * x[z]
                innovations[run, i, c] = value
            for c in range(channels):
                value = 0.0
                for d in range(c + 1):
                    value += inverse[c, d] * innovations[run, i, d]
                    whiteners[run, i, c, d] = inverse[c, d]
                w[c] = value
                total -= np.log(root[c, c]) + 0.5 * value * value
            # K = halfᵀ W; gains are zero at first.
            for z in range(size):
                for c in range(channels):
                    factor = half[c, z]
                    for d in range(c + 1):
                        gains[run, i, z, d] += factor * inverse[c, d]
            if i + 1 == samples:
                break
            # Update by the reading: K e = halfᵀ w, and K S Kᵀ = halfᵀ half
            for c in range(channels):
                for z in range(size):
                    x[z] += half[c, z] * w[c]
            for z in range(size):
                for c in range(channels):
                    factor = half[c, z]
                    for y in range(size):
                        p[z, y] -= factor * half[c, y]
            # Predict the next state and its covariance.
            a = states[run, i]
            for z in range(size):
                value = -defects[run, i, z]
                for y in range(size):
                    value += a[z, y] * x[y]
                moved[z] = value
            for z in range(size):
                x[z] = moved[z]
            propagate_covariance(a, p, work, spread)
            # Add J and G Q Gᵀ to the lower triangle, and copy it to both halves of P-.
            is_lost = False
            for z in range(size):
                spread[z, z] += jumps[run, i, z]
                for e in range(count):
                    g = forces[run, i, z, e] * deviations[run, e] * deviations[run, e]
                    if g != 0.0:
                        for y in range(z + 1):
                            spread[z, y] += g * forces[run, i, y, e]
                for y in range(z + 1):
                    value = spread[z, y]
                    p[z, y] = value
                    p[y, z] = value
                    # `not` also finds NaN.
                    if not abs(value) < limits[0]:
                        is_lost = True
            if is_lost:
                for z in range(size):
                    for y in range(size):
                        p[z, y] = prior[z] * prior[z] + 1.0 if z == y else 0.0
        likelihood[run] = total


def run_smoother(
    states: Array,
    forces: Array,
    readings: Array,
    deviations: Array,
    predicted: Array,
    covariances: Array,
    innovations: Array,
    gains: Array,
    whiteners: Array,
    smoothed: Array,
    missing: Array,
    measured: Array,
    expected: Array,
    adjoint: Array,
    moved: Array,
    white: Array,
    information: Array,
    spread: Array,
    work: Array,
    back: Array,
    closed: Array,
    weighed: Array,
) -> None:
    """Smooth B runs of T samples with Z states, C channels and E forces (Bryson and Frazier).

    Backward from the last sample i, the adjoint λ and its information Λ collect what the readings
    from this sample on say about its state. With C = I - K H and the whitener W of the filter
    ((5) and (6) of `filter_and_smoother`),

        λ_i = Cᵀ Aᵀ λ_{i+1} - Hᵀ Wᵀ W e,    Λ_i = Cᵀ Aᵀ Λ_{i+1} A C + Hᵀ Wᵀ W H
        δ_i = δ- - P- λ_i,    f_{i-1} = - Q Gᵀ λ_i

    Sums of (Gᵀ λ)² and of the diagonal of Gᵀ Λ G over all runs are the numerator and denominator of
    (7), the factor by which the variances Q of the missing forces must change. Results are written
    to `smoothed` and the three arguments after it; the last ten are buffers, so that no memory is
    allocated.

    Args:
        states: A (B, T - 1, Z, Z).
        forces: G (B, T - 1, Z, E).
        readings: H (B, T, C, Z).
        deviations: (B, E) standard deviations of the missing forces, whose squares are Q.
        predicted: δ- (B, T, Z), as written by the filter.
        covariances: P- (B, T, Z, Z), as written by the filter.
        innovations: e (B, T, C), as written by the filter.
        gains: K (B, T, Z, C), as written by the filter.
        whiteners: W (B, T, C, C), as written by the filter.
        smoothed: δ (B, T, Z).
        missing: f (B, T - 1, E).
        measured: (E,) numerator of (7), to which the runs are added.
        expected: (E,) denominator of (7), to which the runs are added.
        adjoint: (Z,) λ.
        moved: (Z,) λ of the previous sample.
        white: (C,) whitened innovation.
        information: (Z, Z) Λ.
        spread: (Z, Z) propagated Λ.
        work: (Z, Z) product.
        back: (Z, Z) A C.
        closed: (Z, Z) C.
        weighed: (C, Z) W H.
    """
    runs, samples, channels, size = readings.shape
    count = forces.shape[3]
    for run in range(runs):
        for z in range(size):
            adjoint[z] = 0.0
            for y in range(size):
                information[z, y] = 0.0
        for i in range(samples - 1, -1, -1):
            h, whitener = readings[run, i], whiteners[run, i]
            multiply_sparse(whitener, h, weighed)
            if i + 1 < samples:
                # Carry λ and Λ from the next sample to this one; closed = I - K H.
                for z in range(size):
                    for y in range(size):
                        closed[z, y] = 1.0 if z == y else 0.0
                for c in range(channels):
                    for y in range(size):
                        factor = h[c, y]
                        if factor != 0.0:
                            for z in range(size):
                                closed[z, y] -= gains[run, i, z, c] * factor
                multiply_sparse(states[run, i], closed, back)
                for z in range(size):
                    moved[z] = 0.0
                for y in range(size):
                    for z in range(size):
                        moved[z] += back[y, z] * adjoint[y]
                for z in range(size):
                    adjoint[z] = moved[z]
                multiply_sparse(information, back, work)
                multiply_transposed(back, work, spread)
                for z in range(size):
                    for y in range(z, size):
                        information[z, y] = spread[z, y]
                        information[y, z] = spread[z, y]
            # Add what the reading of this sample says.
            for c in range(channels):
                value = 0.0
                for d in range(channels):
                    value += whitener[c, d] * innovations[run, i, d]
                white[c] = value
            for c in range(channels):
                for z in range(size):
                    factor = weighed[c, z]
                    if factor != 0.0:
                        adjoint[z] -= factor * white[c]
                        for y in range(size):
                            information[z, y] += factor * weighed[c, y]
            for z in range(size):
                smoothed[run, i, z] = predicted[run, i, z]
            for y in range(size):
                for z in range(size):
                    smoothed[run, i, z] -= covariances[run, i, y, z] * adjoint[y]  # (6)
            if i == 0:
                break
            # Missing force between the previous sample and this one, and what it adds to (7).
            g = forces[run, i - 1]
            for e in range(count):
                pushed, known = 0.0, 0.0
                for z in range(size):
                    if g[z, e] != 0.0:
                        pushed += g[z, e] * adjoint[z]
                        for y in range(size):
                            if g[y, e] != 0.0:
                                known += g[z, e] * information[z, y] * g[y, e]
                q = deviations[run, e]
                missing[run, i - 1, e] = -q * q * pushed
                measured[e] += pushed * pushed
                expected[e] += known


COMPILED = CompiledFunctions(
    __name__,
    "the Kalman filter",
    {
        run_filter: (
            *("bizz", "biz", "bize", "btcz", "btc", "biz", "btc", "z", "be", "1"),
            *("btz", "btzz", "btc", "btzc", "btcc", "b"),
            *("z", "z", "zz", "zz", "zz", "cc", "cc", "cz", "cz", "c"),
        ),
        run_smoother: (
            *("bizz", "bize", "btcz", "be", "btz", "btzz", "btc", "btzc", "btcc"),
            *("btz", "bie", "e", "e"),
            *("z", "z", "c", "zz", "zz", "zz", "zz", "zz", "cz"),
        ),
    },
)
"""Recursions for b runs, t samples, i = t - 1 intervals, c channels, z states and e forces."""
