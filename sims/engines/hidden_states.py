"""Extend a system by the hidden states of effects, one coordinate for each.

With a hidden coordinate in addition to those of the system, any engine for several coordinates can
integrate the state of an effect. The augmented system scales forces by the inertia that remains for
its own coordinates,

    M' = M (1 - sum of the load-side shares)                               (1)

so that the forces on them need no change, and a rate r of a hidden state is written as the force M'
r. Dry friction acts on the system's own coordinates only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import numpy as np

from sims.core.effect import Effect, Force, Friction, HiddenState, HiddenStateEffect
from sims.core.engine import Engine, IntegrationBatch, Trajectories
from sims.core.simulator import Array
from sims.core.system import StateSnapshot, System
from sims.engines.batch import join_trajectories


class AugmentedSystem(System):
    """System with hidden coordinates after its own; `make_augmented_system` makes one.

    Its parameters are those of the system, followed by the coefficients of the effects.

    Attributes:
        base_system: system without hidden coordinates.
        effects: effects with a hidden state, one coordinate for each.
    """

    base_system: ClassVar[System]
    effects: ClassVar[tuple[HiddenStateEffect, ...]]

    @classmethod
    def get_base_snapshot(cls, moment: StateSnapshot) -> StateSnapshot:
        """Return the state of the original system, without hidden coordinates."""
        base_size = len(cls.base_system.coordinates)
        theta = moment.theta[:, : len(cls.base_system.parameters)]
        x, v = moment.x[:, :base_size], moment.v[:, :base_size]
        return replace(moment, system=cls.base_system, theta=theta, x=x, v=v)

    @classmethod
    def split_coefficients(cls, theta: Array) -> list[Array]:
        """Return the coefficients (K, L, 1) of each effect with hidden states.

        They are stored in the columns of `theta` after the system's own parameters.

        Shapes: L batch elements, K coefficients.
        """
        coefficients = []
        column = len(cls.base_system.parameters)
        for effect in cls.effects:
            count = len(effect.coefficients)
            coefficients.append(theta[:, column : column + count].T[:, :, None])
            column += count
        return coefficients

    def mass(self, theta: Array, constants: Mapping[str, Array]) -> Array:
        """Return the inertia (L, 1) of the system's own coordinates.

        It is M' = M (1 - sum of the load-side shares) (1).

        Shapes: L batch elements.

        Args:
            theta: (L, p) parameters of the augmented system.
            constants: (L, 1) constants by name.
        """
        total_mass = self.base_system.mass(theta[:, : len(self.base_system.parameters)], constants)
        pairs = zip(self.effects, self.split_coefficients(theta), strict=True)
        remaining_share = np.ones_like(total_mass)
        for effect, c in pairs:
            remaining_share = remaining_share - effect.behind(c)
        return total_mass * remaining_share  # (1)

    def weight(self, moment: StateSnapshot) -> Array:
        """Return the force of gravity (L, D) of the system."""
        return pad_force(self.base_system.weight(self.get_base_snapshot(moment)), moment)

    def force(self, moment: StateSnapshot) -> Array:
        """Return the force (L, D) on the system's coordinates and on the hidden states.

        The engine divides forces by the inertia. So the force on a hidden state is the
        inertia times its rate, which gives the rate as its acceleration.

        Shapes: L batch elements, D coordinates.
        """
        base_moment = self.get_base_snapshot(moment)
        base_size = len(self.base_system.coordinates)
        total = self.base_system.force(base_moment)
        inertia = self.mass(moment.theta, moment.constants)
        rates = []
        for k, c in enumerate(self.split_coefficients(moment.theta)):
            place = slice(base_size + k, base_size + k + 1)
            state = HiddenState(moment.x[:, place], moment.v[:, place])
            force, rate = self.effects[k].act(c, base_moment, state)
            total = total + force
            rates.append(inertia * rate)
        return np.concatenate([total, *rates], axis=1)

    def observe(
        self, x: Array, v: Array, a: Array, constants: Mapping[str, Array]
    ) -> dict[str, Array]:
        """Return the sensor channels of the system without hidden coordinates.

        Shapes: L batch elements, S steps, D coordinates.

        Args:
            x: (L, S, D) positions.
            v: (L, S, D) velocities.
            a: (L, S, D) accelerations.
            constants: constants by name.
        """
        base_size = len(self.base_system.coordinates)
        return self.base_system.observe(
            x[:, :, :base_size], v[:, :, :base_size], a[:, :, :base_size], constants
        )


def integrate_with_hidden_states(engine: Engine, batch: IntegrationBatch) -> Trajectories:
    """Integrate batch elements, on some of which hidden-state effects may be active.

    Args:
        engine: engine for several coordinates.
        batch: batch to integrate.

    Returns:
        The trajectories of the system's own coordinates.
    """
    hidden = [(e, c) for e, c in batch.effects if isinstance(e, HiddenStateEffect)]
    if not hidden:
        return engine.integrate(batch)
    other_effects = tuple((e, c) for e, c in batch.effects if not isinstance(e, HiddenStateEffect))
    active = np.array([c[0, :, 0] > 0 for _, c in hidden])
    # Most calls have no hidden-state effects; they must not become slower.
    if not active.any():
        return engine.integrate(replace(batch, effects=other_effects))
    motions = []
    # Bit k of a pattern says whether effect k is active; elements with equal patterns form a group.
    patterns = (1 << np.arange(len(hidden))) @ active
    for pattern in sorted(set(patterns.tolist())):
        group_indices = np.flatnonzero(patterns == pattern)
        active_effects = [pair for k, pair in enumerate(hidden) if pattern >> k & 1]
        group = replace(batch, effects=other_effects).select(group_indices)
        effects = [(e, c[:, group_indices]) for e, c in active_effects]
        motion = engine.integrate(_augment_batch(group, effects) if active_effects else group)
        base_size = batch.x.shape[1]
        parts = (values[:, :, :base_size] for values in (motion.x, motion.v, motion.a))
        motions.append((group_indices, Trajectories(*parts)))
    return join_trajectories(motions, batch)


def _augment_batch(
    batch: IntegrationBatch, effects: Sequence[tuple[HiddenStateEffect, Array]]
) -> IntegrationBatch:
    """Return the batch of a system whose coordinates include the effects' hidden states.

    Parameters get the effects' coefficients as further columns, and x and v the initial hidden
    states.
    """
    kinds = tuple(type(effect) for effect, _ in effects)
    system = make_augmented_system(type(batch.system), kinds)()
    inputs = {name: values[:, :1] for name, values in batch.inputs.items()}
    start = np.zeros((len(batch.x), 1))
    initial_moment = StateSnapshot(
        batch.system, batch.theta, batch.constants, start, batch.x, batch.v, inputs
    )
    states = [effect.begin(c, initial_moment) for effect, c in effects]
    return replace(
        batch,
        system=system,
        theta=np.concatenate([batch.theta, *(c[:, :, 0].T for _, c in effects)], axis=1),
        x=np.concatenate([batch.x, *(state.x for state in states)], axis=1),
        v=np.concatenate([batch.v, *(state.v for state in states)], axis=1),
        effects=tuple((_wrap_effect(type(effect))(), c) for effect, c in batch.effects),
    )


@cache
def make_augmented_system(
    system: type[System], effects: tuple[type[HiddenStateEffect], ...]
) -> type[AugmentedSystem]:
    """Return the system with a hidden coordinate for each of these effects.

    An effect with a memory, such as a load on a spring, has a state that no sensor shows. The
    integrators treat it as one more coordinate, so they need not know such effects.

    Args:
        system: system to extend.
        effects: effect classes with a hidden state.
    """
    names = [effect.name for effect in effects]
    attributes: dict[str, Any] = {
        "base_system": system(),
        "effects": tuple(effect() for effect in effects),
        "name": f"{system.name} with {' and '.join(names)}",
        "kind": system.kind,
        "parameters": system.parameters,
        "constants": system.constants,
        "inputs": system.inputs,
        "channels": system.channels,
        "coordinates": (*system.coordinates, *names),
        "rates": (*system.rates, *(f"rate of {name}" for name in names)),
        "states": system.states,
        "sensed": system.sensed,
        "primary": system.primary,
        "servo": system.servo,
        "bends": True,
        "fastest": max(effect.fastest for effect in effects),
        "guided": len(system.coordinates),
    }
    return type("EnlargedSystem", (AugmentedSystem,), attributes)


@cache
def _wrap_effect(effect: type[Effect]) -> type[Effect]:
    """Return an effect that acts on the system's own coordinates of the augmented system."""
    methods: dict[str, Any] = {}
    if issubclass(effect, Force):
        methods["force"] = lambda self, c, moment: pad_force(
            effect.force(self, c, _get_base_snapshot(moment)), moment
        )
    elif issubclass(effect, Friction):
        methods["limit"] = lambda self, c, moment: effect.limit(self, c, _get_base_snapshot(moment))
    return type("PlainEffect", (effect,), methods) if methods else effect


def _get_base_snapshot(moment: StateSnapshot) -> StateSnapshot:
    """Return the state as the original system sees it, without hidden states of effects."""
    assert isinstance(moment.system, AugmentedSystem)
    return moment.system.get_base_snapshot(moment)


def pad_force(force: Array, moment: StateSnapshot) -> Array:
    """Return a force (L, D), padded with zeros for the hidden coordinates.

    Shapes: L batch elements, D coordinates.

    Args:
        force: (L, d) force on the system's own coordinates.
        moment: state snapshot with hidden coordinates.
    """
    zeros = np.zeros_like(moment.x[:, force.shape[1] :])
    return np.concatenate([force, zeros], axis=1)
