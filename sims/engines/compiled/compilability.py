"""Force programs of batch elements, traced where possible.

Systems and effects that cannot be traced are reported once, and NumPy evaluates their functions.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from threading import Lock

import numpy as np

from sims.core.effect import Effect
from sims.core.engine import IntegrationBatch
from sims.core.simulator import Array, Indices
from sims.core.system import System
from sims.engines.compiled.data_layout import (
    HAS_FRICTION,
    IN_E,
    IN_P,
    IN_T,
    OUT_E,
    OUT_LIMIT,
    OUT_MU,
    InputNames,
)
from sims.engines.compiled.expression_graph import NotTraceableError
from sims.engines.compiled.force_program import ForceProgram, NumpyForceProgram, SystemTracer

_tracers: dict[tuple[type[System], InputNames], SystemTracer | None] = {}
_effects: dict[tuple[type[System], InputNames, type[Effect]], bool] = {}
_lock = Lock()
_MAX_RELATIVE_DIFFERENCE = 1e-9
"""Largest relative difference between a program and the functions from which it was traced."""
_TEST_RESTITUTION, _TEST_FRICTION = 0.6, 0.2
"""Restitution and friction of the ground with which effects are tested."""


def get_force_program(
    batch: IntegrationBatch, elements: Indices, effects: Sequence[Effect]
) -> ForceProgram | NumpyForceProgram:
    """Return the program that computes the forces of a system and its effects.

    It is compiled from a trace of their functions if possible; otherwise it calls them with
    NumPy, which is slower.

    Args:
        batch: whole batch.
        elements: (n,) indices of the elements.
        effects: effects that act on them.
    """
    names = InputNames(
        tuple(batch.constants), tuple(batch.inputs), batch.theta.shape[1], batch.x.shape[1]
    )
    # The lock prevents that a trace in progress in another thread is taken as not traceable.
    with _lock:
        tracer = _get_tracer(batch, elements, names)
        if tracer is not None and all(
            _is_traceable(tracer, effect, batch, elements, names) for effect in effects
        ):
            try:
                return tracer.build_program(effects)
            except NotTraceableError as reason:  # the program would be too long
                _print_once("this set of effects", reason)
    return NumpyForceProgram(batch.system, names, effects)


def _get_tracer(
    batch: IntegrationBatch, elements: Indices, names: InputNames
) -> SystemTracer | None:
    """Return the tracer of a system, or None if the system cannot be traced.

    The system is traced once for each set of input names, checked against NumPy, and cached.
    """
    key = type(batch.system), names
    if key not in _tracers:
        _tracers[key] = None
        try:
            tracer = SystemTracer(batch.system, names)
            _check_program(tracer, batch, elements, names, None)
            _tracers[key] = tracer
        # A user's system may raise any error when called with traced arrays.
        except Exception as reason:
            _print_once(f"system {batch.system.name}", reason)
    return _tracers[key]


def _is_traceable(
    tracer: SystemTracer,
    effect: Effect,
    batch: IntegrationBatch,
    elements: Indices,
    names: InputNames,
) -> bool:
    """Return whether an effect can be traced and then gives the same numbers as with NumPy.

    The answer is cached; a failure is reported once.
    """
    key = type(batch.system), names, type(effect)
    if key not in _effects:
        _effects[key] = False
        try:
            _check_program(tracer, batch, elements, names, effect)
            _effects[key] = True
        except Exception as reason:
            _print_once(f"effect {effect.name}", reason)
    return _effects[key]


def _print_once(subject: str, reason: Exception) -> None:
    """Write one line to the standard error output, once per process."""
    text = str(reason) or type(reason).__name__
    sys.stderr.write(f"simgap: {subject} cannot be compiled, and NumPy evaluates it: {text}\n")


def _check_program(
    tracer: SystemTracer,
    batch: IntegrationBatch,
    elements: Indices,
    names: InputNames,
    effect: Effect | None,
) -> None:
    """Check that a program agrees with the array functions, on one element.

    Args:
        tracer: traced system.
        batch: whole batch.
        elements: (n,) indices of the elements.
        names: input names and sizes.
        effect: effect under test; None to test the system.

    Raises:
        NotTraceableError: the results differ, or the traced object has instance attributes.
    """
    if getattr(effect or batch.system, "__dict__", None):
        raise NotTraceableError("it has instance attributes, which a trace cannot follow")
    effects = [] if effect is None else [effect]
    first = elements[:1]
    coefficients = [c[:, first, 0].T for active, c in batch.effects if active is effect]
    constants = [values[first] for values in batch.constants.values()]
    parameters = np.concatenate([batch.theta[first], *constants, *coefficients], axis=1)[0]
    inputs = np.array([values[first[0], 0] for values in batch.inputs.values()])
    # The initial state, and another one at an arbitrary later time.
    states = [
        np.concatenate([[t], batch.x[first[0]] + shift, batch.v[first[0]] - 2.0 * shift, inputs])
        for t, shift in ((0.0, 0.0), (0.37, 0.1))
    ]
    programs = tracer.build_program(effects), NumpyForceProgram(batch.system, names, effects)
    values, expected_values = (
        _evaluate_program(program, parameters, states) for program in programs
    )
    for value, expected in zip(values, expected_values, strict=True):
        size = _MAX_RELATIVE_DIFFERENCE * np.abs(expected).max()
        if not np.allclose(
            value, expected, rtol=_MAX_RELATIVE_DIFFERENCE, atol=size, equal_nan=True
        ):
            raise NotTraceableError("its compiled form gives other numbers")


def _evaluate_program(
    program: ForceProgram | NumpyForceProgram, parameters: Array, states: Sequence[Array]
) -> list[Array]:
    """Evaluate a program at some states and two impact speeds, to compare it with NumPy.

    Args:
        program: traced program, or the program that evaluates with NumPy.
        parameters: (P,) parameters of the batch element.
        states: time, positions, velocities and inputs, each as one vector.

    Returns:
        Forces and, if any, friction limits at each state, then restitution and friction of impacts.
    """
    prepared = program.prepare(1)
    (_, _, rows, output_rows, flags), r = prepared.arrays, prepared.block.r
    compute_constants, compute_forces, compute_impact = prepared.make_runners()
    r[rows[IN_P] : rows[IN_P] + parameters.size, 0] = parameters
    compute_constants()
    results = []
    for state in states:
        r[rows[IN_T] : rows[IN_P], 0] = state
        compute_forces()
        results.append(r[output_rows, 0])
        if flags[HAS_FRICTION]:
            results.append(r[rows[OUT_LIMIT], :1].copy())
    for speed in (0.3, 2.0):
        r[rows[IN_E] : rows[IN_E] + 3, 0] = _TEST_RESTITUTION, _TEST_FRICTION, speed
        compute_impact()
        results.append(r[rows[[OUT_E, OUT_MU]], 0])
    return results
