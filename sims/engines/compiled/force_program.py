"""Force program of a declared system with effects, for the engines of the project."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from sims.core.effect import Contact, Effect, Force, Friction
from sims.core.engine import IntegrationBatch
from sims.core.simulator import Array, Indices
from sims.core.system import StateSnapshot, System
from sims.engines.compiled.array_programs import (
    ArrayFunction,
    Evaluator,
    PreparedProgram,
    Program,
    TracedPrograms,
    TracedSource,
    make_numpy_program,
)
from sims.engines.compiled.data_layout import IntTable, ProgramArrays
from sims.engines.compiled.traced_array import PER_ELEMENT, PER_EVALUATION, PER_IMPACT

_TEST_STATES = ((0.0, 0.0, 0.3), (0.37, 0.1, 2.0))
"""Time (s), shift of the initial state (SI units) and impact speed (m/s) of tested states."""
_TEST_RESTITUTION, _TEST_FRICTION = 0.6, 0.2
"""Restitution and friction of the ground with which effects are tested."""
_traced_programs: dict[tuple[type[System], _InputNames], TracedPrograms] = {}
_lock = Lock()


class _InputNames(NamedTuple):
    """Names and sizes of the inputs of a system's forces, in the order of the parameters.

    Attributes:
        constants: names of the constants.
        inputs: names of the inputs.
        parameters: number of the system's parameters.
        coordinates: number of coordinates.
    """

    constants: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: int
    coordinates: int


class ForceProgram(NamedTuple):
    """Program of the forces, the limit of dry friction, and the contact parameters with effects.

    Attributes:
        program: the program.
        flags: see `ProgramArrays`.
    """

    program: Program
    flags: IntTable

    def prepare(self, width: int) -> tuple[PreparedProgram, ProgramArrays]:
        """Allocate registers of `width` slots, and return the layout for the compiled kernel."""
        prepared = PreparedProgram(self.program, width)
        (force, limit), impact = self.program.outputs
        rows = [*self.program.function.input_ends[:-1], *np.concatenate([limit, *impact])]
        return prepared, ProgramArrays(
            prepared.code, self.program.ends, np.array(rows, dtype=np.int64), force, self.flags
        )


def get_force_program(
    batch: IntegrationBatch, elements: Indices, effects: Sequence[Effect]
) -> ForceProgram:
    """Return the program that computes the forces of a system and its effects.

    If possible, it consists of instructions, from a trace of their Python functions. Otherwise,
    for example because a user's effect contains an ``if``, the program calls these functions with
    NumPy, which is slower; the reason is printed once.

    Args:
        batch: whole batch.
        elements: (n,) indices of the elements.
        effects: effects that act on them.
    """
    system = batch.system
    names = _InputNames(
        tuple(batch.constants), tuple(batch.inputs), batch.theta.shape[1], batch.x.shape[1]
    )

    def make_test(*own_effects: Effect) -> tuple[ArrayFunction, list[Array]]:
        samples = _make_samples(batch, elements[:1], own_effects)
        return _make_function(system, names, own_effects), samples

    sources = [TracedSource(system, f"system {system.name}", make_test)]
    sources += [
        TracedSource(effect, f"effect {effect.name}", partial(make_test, effect))
        for effect in effects
    ]
    function = _make_function(system, names, effects)
    # The lock prevents that a trace in progress in another thread is taken as not traceable.
    with _lock:
        programs = _traced_programs.setdefault((type(system), names), TracedPrograms())
        program = programs.find(function, sources)
    flags = _make_flags(system, names, effects)
    return ForceProgram(program or make_numpy_program(function), flags)


def _make_function(system: System, names: _InputNames, effects: Sequence[Effect]) -> ArrayFunction:
    """Return the array function of a system and its effects.

    The groups of inputs are time, position, velocity, inputs, parameters; restitution and friction
    of the ground, and speed of an impact. The parameters are those of the system, its constants,
    and the coefficients of each effect. The outputs are the force and the limit of dry friction;
    restitution and friction with effects.

    Args:
        system: system whose forces are evaluated.
        names: names and sizes of its inputs.
        effects: effects that act.
    """
    d = names.coordinates
    sizes = [names.parameters, *(1 for _ in names.constants)]
    sizes += [len(effect.coefficients) for effect in effects]

    def bind(
        t: Any, x: Any, v: Any, u: Any, parameters: Any, e: Any, mu: Any, speed: Any
    ) -> tuple[Evaluator, Evaluator]:
        """Return the functions that evaluate forces and impacts; see `ArrayFunction.bind`."""
        theta, *columns = np.split(parameters, np.cumsum(sizes)[:-1], axis=1)
        constants = dict(zip(names.constants, columns, strict=False))
        coefficients = [c.T[:, :, None] for c in columns[len(constants) :]]
        acting = list(zip(effects, coefficients, strict=True))
        inputs = {name: u[:, k, None] for k, name in enumerate(names.inputs)}
        moment = StateSnapshot(system, theta, constants, t, x, v, inputs)

        def evaluate_forces() -> tuple[Any, Any]:
            """Return the force, and the limit of dry friction."""
            force = system.force(moment)
            limit: Any = None
            for effect, c in acting:
                if isinstance(effect, Force):
                    force = force + effect.force(c, moment)
                elif isinstance(effect, Friction):
                    added = effect.limit(c, moment)
                    limit = added if limit is None else limit + added
            return force, 0.0 if limit is None else limit

        def evaluate_impact() -> tuple[Any, Any]:
            """Return restitution and friction coefficient."""
            restitution, friction = e, mu
            for effect, c in acting:
                if isinstance(effect, Contact):
                    restitution = effect.restitution(c, restitution, speed)
                    friction = friction + effect.friction(c)
            return restitution, friction

        return evaluate_forces, evaluate_impact

    groups = [(size, PER_EVALUATION) for size in (1, d, d, len(names.inputs))]
    groups += [(sum(sizes), PER_ELEMENT), *[(1, PER_IMPACT)] * 3]
    return ArrayFunction(groups, ((d, 1), (1, 1)), bind)


def _make_samples(
    batch: IntegrationBatch, first: Indices, effects: Sequence[Effect]
) -> list[Array]:
    """Return inputs (n, 1) of a program at the initial state of an element, and at another one.

    Args:
        batch: whole batch.
        first: (1,) index of the element.
        effects: effects of the program.
    """
    coefficients = [c[:, first, 0].T for active, c in batch.effects if active in effects]
    constants = [values[first] for values in batch.constants.values()]
    parameters = np.concatenate([batch.theta[first], *constants, *coefficients], axis=1)[0]
    inputs = [values[first[0], 0] for values in batch.inputs.values()]
    x, v = batch.x[first[0]], batch.v[first[0]]
    impact = _TEST_RESTITUTION, _TEST_FRICTION
    return [
        np.concatenate([[t], x + shift, v - 2.0 * shift, inputs, parameters, [*impact, speed]])[
            :, None
        ]
        for t, shift, speed in _TEST_STATES
    ]


def _make_flags(system: System, names: _InputNames, effects: Sequence[Effect]) -> IntTable:
    """Return `ProgramArrays.flags`: integers from which compiled code skips what is not needed.

    `system.bends` is true if its own force may change sharply, as with hidden states such as a
    motor's current. `system.guided` is the number of coordinates, from the first, on which dry
    friction acts; zero stands for all.

    Args:
        system: System that is integrated.
        names: Names and numbers of its coordinates and inputs.
        effects: Effects that act on it.
    """
    has_friction = any(isinstance(effect, Friction) for effect in effects)
    has_forces = any(isinstance(effect, Force) for effect in effects)
    # In the order of the constants from DIMENSIONS to HAS_HIDDEN_STATES.
    flags = (
        names.coordinates,
        has_friction,
        has_forces or system.bends,
        system.bounces,
        system.guided or names.coordinates,
        system.bends,
    )
    return np.array(flags, dtype=np.int64)
