"""Force program of a declared system with effects, for the engines of the project.

The hidden state of an effect is one more coordinate, after those of the system. Forces are divided
by the inertia that remains for the system's own coordinates,

    M' = M (1 - sum of the load-side shares)                               (1)

so that the rate r of a hidden state is written as the force M' r.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from sims.core.effect import Contact, Effect, Force, Friction, HiddenState, HiddenStateEffect
from sims.core.engine import IntegrationBatch
from sims.core.simulator import Array, Indices
from sims.core.system import StateSnapshot, System
from sims.engines.compiled.data_layout import IntTable, ProgramArrays
from sims.engines.compiled.register_programs import (
    MAX_CACHED_PROGRAMS,
    ArrayFunction,
    Evaluator,
    PreparedProgram,
    Program,
    TracedPrograms,
    TracedSource,
    make_numpy_program,
)
from sims.engines.compiled.traced_array import PER_ELEMENT, PER_EVALUATION, PER_IMPACT

_TEST_STATES = ((0.0, 0.0, 0.3), (0.37, 0.1, 2.0))
"""Time (s), shift of the initial state (SI units) and impact speed (m/s) of tested states."""
_TEST_RESTITUTION, _TEST_FRICTION = 0.6, 0.2
"""Restitution and friction of the ground with which effects are tested."""
_traced_programs: dict[tuple[type[System], _InputNames], TracedPrograms] = {}
_traced_forces: dict[tuple[object, ...], ForceProgram] = {}
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
        rows: see `ProgramArrays`.
        flags: see `ProgramArrays`.
    """

    program: Program
    rows: IntTable
    flags: IntTable

    def prepare(self, width: int) -> tuple[PreparedProgram, ProgramArrays]:
        """Allocate registers of `width` slots, and return the layout for the compiled engine."""
        prepared = PreparedProgram(self.program, width)
        (force, _), _ = self.program.outputs
        return prepared, ProgramArrays(
            prepared.code, self.program.ends, self.rows, force, self.flags
        )


def get_force_program(
    batch: IntegrationBatch, elements: Indices, effects: Sequence[Effect]
) -> ForceProgram:
    """Return the program that computes the forces of a system and its effects.

    If possible, it consists of instructions, from a trace of their Python functions. Otherwise,
    for example because a user's effect contains an ``if``, the program calls these functions with
    NumPy, which is slower; the reason is printed once.

    Traced programs are cached, because they are the same for equal types of system and effects.

    Args:
        batch: whole batch.
        elements: (n,) indices of the elements; the trace is tested at the initial state of the
            first one.
        effects: effects that act on them.
    """
    system = batch.system
    names = _InputNames(
        tuple(batch.constants), tuple(batch.inputs), batch.theta.shape[1], batch.x.shape[1]
    )

    key = type(system), names, *map(type, effects)
    # The lock prevents that a trace in progress in another thread is taken as not traceable.
    with _lock:
        if key in _traced_forces:
            return _traced_forces[key]
        program = _find_program(batch, elements[:1], names, effects)
        # Registers of the outputs: force and limit of dry friction; restitution and friction. The
        # registers of the force are passed on their own, because it is a vector.
        (_, limit), impact = program.outputs
        rows = [*program.function.input_ends[:-1], *np.concatenate([limit, *impact])]
        flags = _make_flags(system, names, effects)
        force_program = ForceProgram(program, np.array(rows, dtype=np.int64), flags)
        if program.is_traced:
            if len(_traced_forces) == MAX_CACHED_PROGRAMS:
                _traced_forces.clear()
            _traced_forces[key] = force_program
        return force_program


def _find_program(
    batch: IntegrationBatch, first: Indices, names: _InputNames, effects: Sequence[Effect]
) -> Program:
    """Return the traced program of a system and its effects, or one that NumPy evaluates.

    A trace calls a Python function once with symbols, and records its arithmetic as instructions.
    System and effects are first traced one by one, so that a message can name the one that fails.

    Args:
        batch: whole batch.
        first: (1,) index of an element, at whose initial state programs are compared with NumPy.
        names: names and sizes of the inputs.
        effects: effects that act.
    """
    system = batch.system

    def make_test(*own_effects: Effect) -> tuple[ArrayFunction, list[Array]]:
        """Return the function of the system with these effects alone, and inputs to compare at."""
        samples = _make_samples(batch, first, own_effects)
        return _make_function(system, names, own_effects), samples

    sources = [TracedSource(system, f"system {system.name}", make_test)]
    sources += [
        TracedSource(effect, f"effect {effect.name}", partial(make_test, effect))
        for effect in effects
    ]
    function = _make_function(system, names, effects)
    programs = _traced_programs.setdefault((type(system), names), TracedPrograms())
    return programs.find(function, sources) or make_numpy_program(function)


def _make_function(system: System, names: _InputNames, effects: Sequence[Effect]) -> ArrayFunction:
    """Return the function that computes the forces of a system and its effects from their inputs.

    It can be traced into instructions, or evaluated with NumPy. It has two parts. One computes the
    force and the limit of dry friction from time, position, velocity, inputs and parameters. The
    other computes restitution and friction of an impact with effects, from those of the ground and
    the impact speed. Positions, velocities and forces are those of the system, followed by those of
    hidden states. The parameters are those of the system, its constants, and the coefficients of
    each effect.

    Args:
        system: system whose forces are evaluated.
        names: names and sizes of its inputs.
        effects: effects that act.
    """
    own = names.coordinates  # number of the system's own coordinates
    d = own + _count_hidden_states(effects)
    # Sizes of the consecutive groups of parameters: those of the system, constants, coefficients.
    sizes = [names.parameters, *(1 for _ in names.constants)]
    sizes += [len(effect.coefficients) for effect in effects]

    def bind(
        t: Any, x: Any, v: Any, u: Any, parameters: Any, e: Any, mu: Any, speed: Any
    ) -> tuple[Evaluator, Evaluator]:
        """Return the functions that evaluate forces and impacts for these L elements.

        Shapes: L elements, d coordinates, of which the last ones are hidden states of effects, U
        inputs, P parameters.

        Args:
            t: (L, 1) time since the start of the run, s.
            x: (L, d) positions.
            v: (L, d) velocities.
            u: (L, U) inputs.
            parameters: (L, P) parameters of the system, its constants, and coefficients of effects.
            e: (L, 1) restitution without effects.
            mu: (L, 1) friction coefficient of the ground without effects.
            speed: (L, 1) impact speed, m/s.
        """
        # The columns of the constants come first; those that follow are coefficients of effects.
        theta, *columns = np.split(parameters, np.cumsum(sizes)[:-1], axis=1)
        constants = dict(zip(names.constants, columns, strict=False))
        # (L, K) becomes (K, L, 1), the shape that effects expect.
        coefficients = [c.T[:, :, None] for c in columns[len(constants) :]]
        acting = list(zip(effects, coefficients, strict=True))
        inputs = {name: u[:, k, None] for k, name in enumerate(names.inputs)}
        moment = StateSnapshot(system, theta, constants, t, x[:, :own], v[:, :own], inputs)

        # The inertia M', which only the forces of hidden states need.
        inertia = 1.0 if d == own else compute_own_inertia(system, theta, constants, acting)

        def evaluate_forces() -> tuple[Any, Any]:
            """Return the generalised force (L, d), and the limit (L, 1) of dry friction.

            Shapes: L elements, d coordinates.

            The rate r of a hidden state is returned as the force M' r, because the engine divides
            all forces by the inertia M' of the system's own coordinates.
            """
            force = system.force(moment)
            limit: Any = None  # None instead of zero saves an addition in the traced program
            hidden_forces: list[Any] = []
            for effect, c in acting:
                if isinstance(effect, Force):
                    force = force + effect.force(c, moment)
                elif isinstance(effect, Friction):
                    added = effect.limit(c, moment)
                    limit = added if limit is None else limit + added
                elif isinstance(effect, HiddenStateEffect):
                    k = own + len(hidden_forces)  # coordinate of this hidden state
                    added, rate = effect.act(c, moment, HiddenState(x[:, k, None], v[:, k, None]))
                    force = force + added
                    hidden_forces.append(inertia * rate)
            if hidden_forces:
                force = np.concatenate([force, *hidden_forces], axis=1)
            return force, 0.0 if limit is None else limit

        def evaluate_impact() -> tuple[Any, Any]:
            """Return restitution and friction coefficient of an impact, each (L, 1)."""
            restitution, friction = e, mu
            for effect, c in acting:
                if isinstance(effect, Contact):
                    restitution = effect.restitution(c, restitution, speed)
                    friction = friction + effect.friction(c)
            return restitution, friction

        return evaluate_forces, evaluate_impact

    # Size of each argument of `bind`, and how often its values change: with each evaluation of the
    # forces, each batch element, or each impact.
    groups = [(size, PER_EVALUATION) for size in (1, d, d, len(names.inputs))]
    groups += [(sum(sizes), PER_ELEMENT), *[(1, PER_IMPACT)] * 3]
    # Sizes of the outputs: force and friction limit; restitution and friction coefficient.
    return ArrayFunction(groups, ((d, 1), (1, 1)), bind)


def compute_own_inertia(
    system: System,
    theta: Array,
    constants: Mapping[str, Array],
    acting: Sequence[tuple[Effect, Array]],
) -> Array:
    """Return the inertia (L, 1) that remains for the system's own coordinates.

    It is M' = M (1 - sum of the shares) (1): an elastic element, for example, moves a share of the
    inertia M behind it, to its hidden coordinate. `effect.behind` returns this share, from 0 to 1.

    Args:
        system: the system.
        theta: (L, p) its p parameters in L batch elements.
        constants: (L, 1) constants by name.
        acting: effects with their K coefficients (K, L, 1).
    """
    remaining_share: Any = 1.0
    for effect, c in acting:
        if isinstance(effect, HiddenStateEffect):
            remaining_share = remaining_share - effect.behind(c)
    inertia: Array = system.mass(theta, constants) * remaining_share  # (1)
    return inertia


def _count_hidden_states(effects: Sequence[Effect]) -> int:
    return sum(isinstance(effect, HiddenStateEffect) for effect in effects)


def _make_samples(
    batch: IntegrationBatch, first: Indices, effects: Sequence[Effect]
) -> list[Array]:
    """Return the n inputs (n, 1) of a program at an element's initial state, and at a shifted one.

    Hidden states are zero at the first. A traced program is compared with NumPy at both. The last
    axis is that of the slots, of which there is one.

    Args:
        batch: whole batch.
        first: (1,) index of the element.
        effects: effects of the program, a part of those of the batch.
    """
    # (1, K) for each effect of the program.
    coefficients = [c[:, first, 0].T for active, c in batch.effects if active in effects]
    constants = [values[first] for values in batch.constants.values()]
    parameters = np.concatenate([batch.theta[first], *constants, *coefficients], axis=1)[0]
    inputs = [values[first[0], 0] for values in batch.inputs.values()]
    hidden = np.zeros(_count_hidden_states(effects))
    x, v = (np.append(state[first[0]], hidden) for state in (batch.x, batch.v))
    samples = []
    for t, shift, impact_speed in _TEST_STATES:
        impact = _TEST_RESTITUTION, _TEST_FRICTION, impact_speed
        # In the order of the groups of inputs of `_make_function`.
        groups = [t], x + shift, v - 2.0 * shift, inputs, parameters, impact
        samples.append(np.concatenate(groups)[:, None])
    return samples


def _make_flags(system: System, names: _InputNames, effects: Sequence[Effect]) -> IntTable:
    """Return `ProgramArrays.flags`: integers from which compiled code skips what is not needed.

    `system.bends` is true if its own force may change sharply, as that of hidden states may.
    `system.guided` is the number of coordinates, from the first, on which dry friction acts; zero
    stands for all that are not hidden states.

    Args:
        system: System that is integrated.
        names: Names and numbers of its coordinates and inputs.
        effects: Effects that act on it.
    """
    has_friction = any(isinstance(effect, Friction) for effect in effects)
    has_forces = any(isinstance(effect, Force) for effect in effects)
    hidden_count = _count_hidden_states(effects)
    bends = system.bends or hidden_count > 0
    # In the order of the constants from DIMENSIONS to HAS_HIDDEN_STATES. The last one is also set
    # for a system whose own force may change sharply: both need fine steps.
    flags = (
        names.coordinates + hidden_count,
        has_friction,
        has_forces or bends,
        system.bounces,
        system.guided or names.coordinates,
        bends,
    )
    return np.array(flags, dtype=np.int64)
