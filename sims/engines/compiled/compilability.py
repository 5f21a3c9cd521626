"""Compilability of systems and effects.

Those that cannot be compiled are reported once and stepped in NumPy.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from threading import Lock

import numpy as np

from sims.core.simulator import Array
from sims.core.system import Contact, Effect, IntegrationBatch, System
from sims.engines.batch.batch_slicing import slice_batch
from sims.engines.batch.force_field import ForceField
from sims.engines.compiled import interpreter
from sims.engines.compiled.data_layout import (
    IN_E,
    IN_MU,
    IN_P,
    IN_SPEED,
    IN_T,
    IN_U,
    IN_V,
    IN_X,
    OUT_E,
    OUT_LIMIT,
    OUT_MU,
)
from sims.engines.compiled.force_program import CompiledModel, InputNames, SystemTracer
from sims.engines.compiled.node_arrays import NotTraceableError
from sims.engines.ground_contact import Indices

_tracings: dict[tuple[type[System], InputNames], SystemTracer | None] = {}
_effects: dict[tuple[type[System], InputNames, type[Effect]], bool] = {}
_lock = Lock()
_TOLERANCE = 1e-9
"""Largest relative difference between a program and the functions from which it was traced."""
_PLAIN = 0.6, 0.2
"""Restitution and friction of the ground with which effects are tested."""


def get_compiled_model(
    lanes: IntegrationBatch, chosen: Indices, effects: Sequence[Effect]
) -> CompiledModel | None:
    """Return the program for some elements; None if it cannot be compiled.

    Args:
        lanes: whole batch.
        chosen: (n,) indices of the elements.
        effects: effects that act on them.
    """
    # The lock prevents that a trace in progress in another thread is taken as not compilable.
    with _lock:
        tracing = _traced(lanes, chosen)
        if tracing is None:
            return None
        for effect in effects:
            if not _compiles(tracing, effect, lanes, chosen):
                return None
        return tracing.build_model(effects)


def _traced(lanes: IntegrationBatch, chosen: Indices) -> SystemTracer | None:
    system = lanes.system
    key = type(system), _names(lanes)
    if key not in _tracings:
        _tracings[key] = None
        try:
            tracing = SystemTracer(system, key[1])
            _check(tracing.build_model([]), lanes, chosen, [], system)
            _tracings[key] = tracing
        # A user's system may raise any error when called with traced arrays.
        except Exception as reason:
            _warn_not_compiled(f"system {system.name}", reason)
    return _tracings[key]


def _compiles(
    tracing: SystemTracer, effect: Effect, lanes: IntegrationBatch, chosen: Indices
) -> bool:
    key = type(lanes.system), _names(lanes), type(effect)
    if key not in _effects:
        _effects[key] = False
        try:
            _check(tracing.build_model([effect]), lanes, chosen, [effect], effect)
            _effects[key] = True
        except Exception as reason:
            _warn_not_compiled(f"effect {effect.name}", reason)
    return _effects[key]


def _names(lanes: IntegrationBatch) -> InputNames:
    return InputNames(
        tuple(lanes.constants), tuple(lanes.inputs), lanes.theta.shape[1], lanes.x.shape[1]
    )


def _warn_not_compiled(what: str, reason: Exception) -> None:
    """Write one line to the standard error output, once per process."""
    text = str(reason) or type(reason).__name__
    sys.stderr.write(f"simgap: {what} is stepped without the compiler: {text}\n")


def _check(
    made: CompiledModel,
    lanes: IntegrationBatch,
    chosen: Indices,
    effects: Sequence[Effect],
    of: System | Effect,
) -> None:
    """Check that the program agrees with the array functions, on one element at two states.

    Args:
        made: traced program.
        lanes: whole batch.
        chosen: (n,) indices of the elements.
        effects: effects in the program.
        of: system or effect under test.

    Raises:
        NotTraceableError: the results differ, or the traced object has its own state.
    """
    if getattr(of, "__dict__", None):
        raise NotTraceableError("it has a state of its own")
    one = slice_batch(lanes, chosen[:1])
    there = tuple((effect, c) for effect, c in one.effects if effect in effects)
    one = replace(one, effects=there)
    inputs = {name: values[:, :1] for name, values in one.inputs.items()}
    with np.errstate(all="ignore"):
        field = ForceField(one)
        field.set_inputs(inputs)
        r = _registers(made, one, inputs)
        for t, moved in ((0.0, 0.0), (0.37, 0.1)):
            x = one.x + moved
            v = one.v - 2.0 * moved
            force, limit = _at(made, r, t, x[0], v[0])
            time = np.full((1, 1), t)
            _same(force, field.compute_force(time, x, v)[0])
            if field.has_dry_friction:
                _same(limit, field.compute_friction_limit(time, x, v)[0])
        for speed in (0.3, 2.0):
            _same(_compute_program_impact(made, r, speed), _compute_reference_impact(there, speed))


def _registers(made: CompiledModel, one: IntegrationBatch, inputs: Mapping[str, Array]) -> Array:
    """Return the registers of a program with the values of one element."""
    rows = made.program.rows
    r = made.allocate_buffers().r
    columns = [one.theta, *one.constants.values(), *(c[:, :, 0].T for _, c in one.effects)]
    parameters = np.concatenate(columns, axis=1)[0]
    if parameters.size != rows[IN_E] - rows[IN_P]:
        raise NotTraceableError("its constants or coefficients are not one number each")
    r[rows[IN_P] : rows[IN_P] + parameters.size] = parameters[:, None]
    for k, values in enumerate(inputs.values()):
        r[rows[IN_U] + k] = values
    interpreter.run_instructions(
        made.program.code, made.program.ends[0], made.program.ends[1], r, 1
    )
    return r


def _at(made: CompiledModel, r: Array, t: float, x: Array, v: Array) -> tuple[Array, Array]:
    """Return the force (D,) and the limit of dry friction (1,) of a program at one state."""
    rows = made.program.rows
    r[rows[IN_T], 0] = t
    r[rows[IN_X] : rows[IN_X] + x.size, 0] = x
    r[rows[IN_V] : rows[IN_V] + v.size, 0] = v
    interpreter.run_instructions(
        made.program.code, made.program.ends[1], made.program.ends[2], r, 1
    )
    return r[made.program.out, 0], r[rows[OUT_LIMIT], :1]


def _compute_program_impact(made: CompiledModel, r: Array, speed: float) -> Array:
    """Return restitution and friction (2,) of an impact, computed by the program."""
    rows = made.program.rows
    r[rows[IN_E]], r[rows[IN_MU]], r[rows[IN_SPEED]] = *_PLAIN, speed
    interpreter.run_instructions(
        made.program.code, made.program.ends[2], made.program.ends[3], r, 1
    )
    found: Array = r[rows[[OUT_E, OUT_MU]], 0]
    return found


def _compute_reference_impact(effects: Sequence[tuple[Effect, Array]], speed: float) -> Array:
    """Return restitution and friction (2,) of an impact, computed by the array functions."""
    e, mu = (np.full((1, 1), value) for value in _PLAIN)
    for effect, c in effects:
        if isinstance(effect, Contact):
            own = c[:, :1]
            e = effect.restitution(own, e, np.full((1, 1), speed))
            mu = mu + effect.friction(own)
    found: Array = np.concatenate([e, mu], axis=1)[0]
    return found


def _same(found: Array, expected: Array) -> None:
    largest = np.abs(expected).max()
    if not np.allclose(found, expected, rtol=_TOLERANCE, atol=_TOLERANCE * largest, equal_nan=True):
        raise NotTraceableError("compiled it gives other numbers")
