"""Compiled recursions of the filter and the smoother, eqs. (1) to (6) of `filter_and_smoother`.

Matrices of a few joints are too small for one library call each: a step in Python takes fifty
microseconds whatever their size. numba stores the compiled code in the user's cache.
"""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np

from sims.core.simulator import Array


def _compile(function: Any) -> Any:
    """Compile a function, and cache the code if possible.

    If numba does not support this Python version, the function runs uncompiled, a hundred times
    slower.
    """
    if importlib.util.find_spec("numba") is None:
        return function
    import numba

    settings: dict[str, Any] = {"error_model": "numpy", "nogil": True}
    try:
        return numba.njit(cache=True, **settings)(function)
    except RuntimeError:
        # Neither the package folder nor the user's cache is writable.
        return numba.njit(**settings)(function)


def _multiply_sparse(a: Array, b: Array, out: Array) -> None:
    """Write a b to `out`; zeros of a are skipped, because most entries of a are zero."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            out[i, j] = 0.0
        for k in range(a.shape[1]):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(b.shape[1]):
                    out[i, j] += factor * b[k, j]


def _propagate_covariance(a: Array, p: Array, half: Array, out: Array) -> None:
    """Write a p aᵀ for a symmetric matrix p to `out`, as a covariance is propagated.

    `half` receives the product a p. Only one triangle is computed; the other one is copied.
    """
    product(a, p, half)
    size = a.shape[0]
    for i in range(size):
        for j in range(i, size):
            out[i, j] = 0.0
    for j in range(size):
        for k in range(a.shape[1]):
            factor = a[j, k]
            if factor != 0.0:
                for i in range(j + 1):
                    out[i, j] += half[i, k] * factor
    for i in range(size):
        for j in range(i):
            out[i, j] = out[j, i]


def _run_filter(
    states: Array,
    defects: Array,
    forces: Array,
    readings: Array,
    residuals: Array,
    jumps: Array,
    variances: Array,
    prior: Array,
    deviations: Array,
    largest: float,
    predicted: Array,
    covariances: Array,
    innovations: Array,
    gains: Array,
    whiteners: Array,
    likelihood: Array,
) -> None:
    """Filter B runs of T samples by (1) to (4); results are written to the last six arguments.

    Args:
        states: A (B, T - 1, Z, Z).
        defects: d (B, T - 1, Z).
        forces: G (B, T - 1, Z, E).
        readings: H (B, T, C, Z).
        residuals: r (B, T, C).
        jumps: J (B, T - 1, Z), variances.
        variances: variances of white noise (B, T, C).
        prior: (Z,) standard deviations of the first states.
        deviations: (B, E) standard deviations of the missing forces.
        largest: maximum covariance; a run with larger ones is treated as lost.
        predicted: δ- (B, T, Z).
        covariances: P- (B, T, Z, Z).
        innovations: e (B, T, C).
        gains: K (B, T, Z, C).
        whiteners: W (B, T, C, C).
        likelihood: log L (B,).
    """
    runs, samples, channels, size = readings.shape
    count = forces.shape[3]
    for run in range(runs):
        x, moved = np.zeros(size), np.zeros(size)
        p, work, spread = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
        root, inverse = np.zeros((channels, channels)), np.zeros((channels, channels))
        crossed, half = np.zeros((size, channels)), np.zeros((size, channels))
        w = np.zeros(channels)
        for z in range(size):
            p[z, z] = prior[z] * prior[z]
        total = 0.0
        for i in range(samples):
            h = readings[run, i]
            for z in range(size):
                predicted[run, i, z] = x[z]
                for y in range(size):
                    covariances[run, i, z, y] = p[z, y]
            # crossed = P Hᵀ
            for z in range(size):
                for c in range(channels):
                    crossed[z, c] = 0.0
            for c in range(channels):
                for y in range(size):
                    factor = h[c, y]
                    if factor != 0.0:
                        for z in range(size):
                            crossed[z, c] += p[z, y] * factor
            # S = L Lᵀ, and W = L⁻¹
            for c in range(channels):
                for d in range(c + 1):
                    value = variances[run, i, c] if c == d else 0.0
                    for y in range(size):
                        value += h[c, y] * crossed[y, d]
                    for k in range(d):
                        value -= root[c, k] * root[d, k]
                    root[c, d] = np.sqrt(value) if c == d else value / root[d, d]
            for c in range(channels):
                for d in range(c + 1):
                    value = 1.0 if c == d else 0.0
                    for k in range(d, c):
                        value -= root[c, k] * inverse[k, d]
                    inverse[c, d] = value / root[c, c]
            for z in range(size):
                for c in range(channels):
                    value = 0.0
                    for d in range(c + 1):
                        value += crossed[z, d] * inverse[c, d]
                    half[z, c] = value
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
            for z in range(size):
                for c in range(channels):
                    value = 0.0
                    for d in range(c, channels):
                        value += half[z, d] * inverse[d, c]
                    gains[run, i, z, c] = value
            if i + 1 == samples:
                break
            for z in range(size):
                for c in range(channels):
                    x[z] += half[z, c] * w[c]
            for z in range(size):
                for y in range(size):
                    value = 0.0
                    for c in range(channels):
                        value += half[z, c] * half[y, c]
                    p[z, y] -= value
            a = states[run, i]
            for z in range(size):
                value = -defects[run, i, z]
                for y in range(size):
                    value += a[z, y] * x[y]
                moved[z] = value
            for z in range(size):
                x[z] = moved[z]
            sandwich(a, p, work, spread)
            lost = False
            for z in range(size):
                for y in range(z + 1):
                    value = spread[z, y] + (jumps[run, i, z] if z == y else 0.0)
                    for e in range(count):
                        g = forces[run, i, z, e]
                        if g != 0.0:
                            q = deviations[run, e]
                            value += g * forces[run, i, y, e] * q * q
                    p[z, y] = value
                    p[y, z] = value
                    if not abs(value) < largest:
                        lost = True
            if lost:
                # If the motion is unstable, the state after the step is unknown.
                for z in range(size):
                    for y in range(size):
                        p[z, y] = prior[z] * prior[z] + 1.0 if z == y else 0.0
        likelihood[run] = total


def _run_smoother(
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
) -> None:
    """Smooth B runs by (5) and (6); results are written to the last four arguments.

    Args:
        states: A (B, T - 1, Z, Z).
        forces: G (B, T - 1, Z, E).
        readings: H (B, T, C, Z).
        deviations: (B, E) standard deviations of the missing forces.
        predicted: δ- (B, T, Z), as written by the filter.
        covariances: P- (B, T, Z, Z), as written by the filter.
        innovations: e (B, T, C), as written by the filter.
        gains: K (B, T, Z, C), as written by the filter.
        whiteners: W (B, T, C, C), as written by the filter.
        smoothed: δ (B, T, Z).
        missing: f (B, T - 1, E).
        measured: (E,) numerator of (7), to which the runs are added.
        expected: (E,) denominator of (7), to which the runs are added.
    """
    runs, samples, channels, size = readings.shape
    count = forces.shape[3]
    for run in range(runs):
        adjoint, moved, white = np.zeros(size), np.zeros(size), np.zeros(channels)
        information, spread = np.zeros((size, size)), np.zeros((size, size))
        work, back, transposed = (
            np.zeros((size, size)),
            np.zeros((size, size)),
            np.zeros((size, size)),
        )
        closed, weighed = np.zeros((size, size)), np.zeros((channels, size))
        for i in range(samples - 1, -1, -1):
            h, whitener = readings[run, i], whiteners[run, i]
            product(whitener, h, weighed)
            if i + 1 < samples:
                # closed = I - K H
                product(gains[run, i], h, closed)
                for z in range(size):
                    for y in range(size):
                        closed[z, y] = (1.0 if z == y else 0.0) - closed[z, y]
                product(states[run, i], closed, back)
                for z in range(size):
                    value = 0.0
                    for y in range(size):
                        value += back[y, z] * adjoint[y]
                        transposed[z, y] = back[y, z]
                    moved[z] = value
                for z in range(size):
                    adjoint[z] = moved[z]
                sandwich(transposed, information, work, spread)
                for z in range(size):
                    for y in range(size):
                        information[z, y] = spread[z, y]
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
                value = predicted[run, i, z]
                for y in range(size):
                    value -= covariances[run, i, z, y] * adjoint[y]
                smoothed[run, i, z] = value  # (6)
            if i == 0:
                break
            g = forces[run, i - 1]
            for e in range(count):
                pushed, known = 0.0, 0.0
                for z in range(size):
                    if g[z, e] != 0.0:
                        pushed += g[z, e] * adjoint[z]
                        for y in range(size):
                            known += g[z, e] * information[z, y] * g[y, e]
                q = deviations[run, e]
                missing[run, i - 1, e] = -q * q * pushed
                measured[e] += pushed * pushed
                expected[e] += known


product: Any = _compile(_multiply_sparse)
sandwich: Any = _compile(_propagate_covariance)
filter_recursion: Any = _compile(_run_filter)
smoother_recursion: Any = _compile(_run_smoother)
