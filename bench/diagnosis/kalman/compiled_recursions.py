"""Compiled recursions of the filter and the smoother, eqs. (1) to (6) of `filter_and_smoother`.

Matrices of a few joints are too small for one library call each: a step in Python takes fifty
microseconds whatever their size. numba translates the functions once; the machine code is stored in
the user's cache and loaded with llvmlite alone (`sims.engines.compiled.kernel`), because loading
numba would take longer than filtering a short log. The functions allocate no memory.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from sims.core.simulator import Array
from sims.engines.compiled.intrinsics import carray, to_real_pointer
from sims.engines.compiled.kernel import get_address, load_compiled_module

FILTER, SMOOTHER = range(2)
"""Recursions, by the first argument of `recursion_entry`."""
SIZE_COUNT = 6
"""Number of integers before the addresses in the argument of `recursion_entry`."""
MAX_ARRAYS = 26
"""Maximum number of addresses in the argument of `recursion_entry`."""
FILTER_SHAPES = (
    *("bizz", "biz", "bize", "btcz", "btc", "biz", "btc", "z", "be", "1"),
    *("btz", "btzz", "btc", "btzc", "btcc", "b"),
    *("z", "z", "zz", "zz", "zz", "cc", "cc", "zc", "zc", "c"),
)
"""Shapes of the arguments of `run_filter`.

A letter is a size: b runs, t samples, i = t - 1 intervals, c channels, z states, e forces.
"""
SMOOTHER_SHAPES = (
    *("bizz", "bize", "btcz", "be", "btz", "btzz", "btc", "btzc", "btcc"),
    *("btz", "bie", "e", "e"),
    *("z", "z", "c", "zz", "zz", "zz", "zz", "zz", "zz", "cz"),
)
"""Shapes of the arguments of `run_smoother`, as in `FILTER_SHAPES`."""
BUFFER_COUNT = 10
"""Number of buffers, which are the last arguments of both recursions."""


def filter_recursion(*arrays: Array) -> None:
    """Run the filter: the arguments of `run_filter` without the buffers.

    Raises:
        ValueError: an array has another shape or layout.
    """
    _run(FILTER, FILTER_SHAPES, run_filter, arrays, arrays[3].shape, arrays[2].shape[3])


def smoother_recursion(*arrays: Array) -> None:
    """Run the smoother: the arguments of `run_smoother` without the buffers.

    Raises:
        ValueError: an array has another shape or layout.
    """
    _run(SMOOTHER, SMOOTHER_SHAPES, run_smoother, arrays, arrays[2].shape, arrays[1].shape[3])


def _run(
    function: int,
    shapes: tuple[str, ...],
    python_function: Callable[..., None],
    arrays: tuple[Array, ...],
    readings_shape: tuple[int, ...],
    force_count: int,
) -> None:
    """Allocate the buffers and run a recursion, compiled if numba supports this Python version.

    Args:
        function: `FILTER` or `SMOOTHER`.
        shapes: shapes of all arguments of the recursion.
        python_function: the same recursion in Python.
        arrays: arguments of the recursion without the buffers.
        readings_shape: (B, T, C, Z).
        force_count: E.
    """
    b, t, c, z = readings_shape
    sizes = {"b": b, "t": t, "i": t - 1, "c": c, "z": z, "e": force_count, "1": 1}
    expected_shapes = [tuple(sizes[letter] for letter in shape) for shape in shapes]
    buffers = tuple(np.zeros(shape) for shape in expected_shapes[-BUFFER_COUNT:])
    arguments = (*arrays, *buffers)
    # The compiled code does not check array bounds.
    for array, shape in zip(arguments, expected_shapes, strict=True):
        if array.shape != shape or array.dtype != np.float64 or not array.flags.c_contiguous:
            raise ValueError(f"expected a contiguous array of shape {shape}, got {array.shape}")
    if t < 1:
        return
    compiled = _load_compiled_recursions()
    if compiled is None:
        python_function(*arguments)
        return
    numbers = np.zeros(SIZE_COUNT + MAX_ARRAYS, dtype=np.int64)
    numbers[:SIZE_COUNT] = function, b, t, c, z, force_count
    numbers[SIZE_COUNT : SIZE_COUNT + len(arguments)] = [get_address(a) for a in arguments]
    compiled(get_address(numbers))


@cache
def _load_compiled_recursions() -> Callable[[int], None] | None:
    """Return the compiled `recursion_entry`; None if numba does not support this Python version.

    The recursions then run uncompiled, a hundred times slower.
    """
    if importlib.util.find_spec("llvmlite") is None:
        return None
    return load_compiled_module(__name__, "recursion_entry", "the Kalman filter")


def recursion_entry(arguments_at: Any) -> None:
    """Run a recursion (compiled code only).

    The argument is the address of `SIZE_COUNT` + `MAX_ARRAYS` integers: the recursion, the sizes
    B, T, C, Z and E, and the addresses of its arguments.
    """
    numbers = carray(arguments_at, (SIZE_COUNT + MAX_ARRAYS,))
    b, t, c, z, e = numbers[1], numbers[2], numbers[3], numbers[4], numbers[5]
    i = t - 1
    at = numbers[SIZE_COUNT:]
    if numbers[0] == FILTER:
        run_filter(
            carray(to_real_pointer(at[0]), (b, i, z, z)),
            carray(to_real_pointer(at[1]), (b, i, z)),
            carray(to_real_pointer(at[2]), (b, i, z, e)),
            carray(to_real_pointer(at[3]), (b, t, c, z)),
            carray(to_real_pointer(at[4]), (b, t, c)),
            carray(to_real_pointer(at[5]), (b, i, z)),
            carray(to_real_pointer(at[6]), (b, t, c)),
            carray(to_real_pointer(at[7]), (z,)),
            carray(to_real_pointer(at[8]), (b, e)),
            carray(to_real_pointer(at[9]), (1,)),
            carray(to_real_pointer(at[10]), (b, t, z)),
            carray(to_real_pointer(at[11]), (b, t, z, z)),
            carray(to_real_pointer(at[12]), (b, t, c)),
            carray(to_real_pointer(at[13]), (b, t, z, c)),
            carray(to_real_pointer(at[14]), (b, t, c, c)),
            carray(to_real_pointer(at[15]), (b,)),
            carray(to_real_pointer(at[16]), (z,)),
            carray(to_real_pointer(at[17]), (z,)),
            carray(to_real_pointer(at[18]), (z, z)),
            carray(to_real_pointer(at[19]), (z, z)),
            carray(to_real_pointer(at[20]), (z, z)),
            carray(to_real_pointer(at[21]), (c, c)),
            carray(to_real_pointer(at[22]), (c, c)),
            carray(to_real_pointer(at[23]), (z, c)),
            carray(to_real_pointer(at[24]), (z, c)),
            carray(to_real_pointer(at[25]), (c,)),
        )
    else:
        run_smoother(
            carray(to_real_pointer(at[0]), (b, i, z, z)),
            carray(to_real_pointer(at[1]), (b, i, z, e)),
            carray(to_real_pointer(at[2]), (b, t, c, z)),
            carray(to_real_pointer(at[3]), (b, e)),
            carray(to_real_pointer(at[4]), (b, t, z)),
            carray(to_real_pointer(at[5]), (b, t, z, z)),
            carray(to_real_pointer(at[6]), (b, t, c)),
            carray(to_real_pointer(at[7]), (b, t, z, c)),
            carray(to_real_pointer(at[8]), (b, t, c, c)),
            carray(to_real_pointer(at[9]), (b, t, z)),
            carray(to_real_pointer(at[10]), (b, i, e)),
            carray(to_real_pointer(at[11]), (e,)),
            carray(to_real_pointer(at[12]), (e,)),
            carray(to_real_pointer(at[13]), (z,)),
            carray(to_real_pointer(at[14]), (z,)),
            carray(to_real_pointer(at[15]), (c,)),
            carray(to_real_pointer(at[16]), (z, z)),
            carray(to_real_pointer(at[17]), (z, z)),
            carray(to_real_pointer(at[18]), (z, z)),
            carray(to_real_pointer(at[19]), (z, z)),
            carray(to_real_pointer(at[20]), (z, z)),
            carray(to_real_pointer(at[21]), (z, z)),
            carray(to_real_pointer(at[22]), (c, z)),
        )


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


def propagate_covariance(a: Array, p: Array, half: Array, out: Array) -> None:
    """Write a p aᵀ for a symmetric matrix p to `out`, as a covariance is propagated.

    `half` receives the product a p. Only one triangle is computed; the other one is copied.
    """
    multiply_sparse(a, p, half)
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
    """Filter B runs of T samples by (1) to (4).

    Results are written to `predicted` and the five arguments after it; the last ten are buffers.

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
        limits: (1,) maximum covariance; a run with larger ones is treated as lost.
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
        crossed: (Z, C) P Hᵀ.
        half: (Z, C) P Hᵀ L⁻ᵀ.
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
            propagate_covariance(a, p, work, spread)
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
                    if not abs(value) < limits[0]:
                        lost = True
            if lost:
                # If the motion is unstable, the state after the step is unknown.
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
    transposed: Array,
    closed: Array,
    weighed: Array,
) -> None:
    """Smooth B runs by (5) and (6).

    Results are written to `smoothed` and the three arguments after it; the last ten are buffers.

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
        adjoint: (Z,) λ.
        moved: (Z,) λ of the previous sample.
        white: (C,) whitened innovation.
        information: (Z, Z) Λ.
        spread: (Z, Z) propagated Λ.
        work: (Z, Z) product.
        back: (Z, Z) A C.
        transposed: (Z, Z) transpose of `back`.
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
                # closed = I - K H
                multiply_sparse(gains[run, i], h, closed)
                for z in range(size):
                    for y in range(size):
                        closed[z, y] = (1.0 if z == y else 0.0) - closed[z, y]
                multiply_sparse(states[run, i], closed, back)
                for z in range(size):
                    value = 0.0
                    for y in range(size):
                        value += back[y, z] * adjoint[y]
                        transposed[z, y] = back[y, z]
                    moved[z] = value
                for z in range(size):
                    adjoint[z] = moved[z]
                propagate_covariance(transposed, information, work, spread)
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
