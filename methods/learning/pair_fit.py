"""The trained object that TuneNet and its regressor share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from methods.base import Array, Practice, Task, Tuner
from methods.learning.bridging import bridged
from methods.learning.pair_network import Design, Sides, Watched, estimate, shapes, train
from methods.learning.prepared import Prepared, checked, heard
from methods.learning.reader import Reader, Reading
from methods.learning.rehearsal import Rehearsal, rehearse

_OWN = "own-"
"""Begins the names of the arrays of a proposed side that reads something of its own."""


@dataclass(frozen=True)
class Look:
    """Looks on while one network is trained.

    Attributes:
        held_out: simulations that measure only.
        epoch: told of each pass: its number from 1, how many there are, training and held-out loss.
    """

    held_out: Rehearsal
    epoch: Callable[[int, int, float, float], None]


@dataclass(frozen=True)
class Fitted:
    """A trained network together with what it reads.

    Attributes:
        design: how the network is built.
        read: observations and scenes to input rows, on the target's side.
        weights: the network's arrays by name.
        proposed: the same on the proposed side; the same object where both sides read the same.
    """

    design: Design
    read: Reader
    weights: dict[str, Array]
    proposed: Reader

    @classmethod
    def train(
        cls,
        design: Design,
        data: Rehearsal,
        rng: np.random.Generator,
        reading: Reading,
        alone: bool,
        look: Look | None,
    ) -> Fitted:
        """Choose the inputs and train the network on them; `alone` as in `pair_network.train`."""
        read = Reader.learned(data, reading)
        proposed = Reader.learned(data.pure, reading.proposed) if reading.proposed else read
        watched = None
        if look is not None:
            held_out = look.held_out
            rows = _sides(proposed, read, held_out)
            watched = Watched(rows, held_out.parameters, look.epoch)
        rows = _sides(proposed, read, data)
        weights = train(rows, data.parameters, design, rng, alone, watched)
        return cls(design, read, weights, proposed)

    def difference(self, proposed: Array, target: Array) -> Array:
        """h(proposed, target) of input rows; see `pair_network.estimate`."""
        return estimate(self.weights, self.design, proposed, target)

    def estimator(self, task: Task) -> Callable[[Array], Array]:
        """From one simulation (1, T, C) to h(simulation, target), (dim,); NaN where the simulation
        failed.
        """
        alike = self.proposed is self.read
        # hidden in the simulation too, so that the truth gives the target's own row
        hidden = np.isnan(task.observed) if alike else None
        row = None
        if alike:
            # the target's row is the same for every simulation, unless gaps are bridged by it
            row = self.read(task.observed[None], task.lengths, task.scene, hidden)[0]

        def difference(observations: Array) -> Array:
            if not np.isfinite(observations).all():
                return np.full(task.dim, np.nan)
            proposed = self.proposed(observations, task.lengths, task.scene, hidden)[0]
            target = row
            if target is None:
                whole = _bridged(task, observations[0], self)
                target = self.read(whole[None], task.lengths, task.scene)[0]
            return self.difference(proposed, target)

        return difference

    def state(self) -> dict[str, Array]:
        """Everything as plain arrays."""
        state = self.read.state() | self.weights
        if self.proposed is self.read:
            return state
        # both sides' arrays have the same names
        own = {_OWN + name: array for name, array in self.proposed.state().items()}
        return own | state

    @classmethod
    def restored(cls, state: dict[str, Array], design: Design, reading: Reading) -> Fitted:
        """The inverse of `state`.

        Raises:
            ValueError: arrays of other names or shapes, or numbers that are not finite.
        """
        own: dict[str, Array] = {}
        common: dict[str, Array] = {}
        for name, array in state.items():
            part = own if name.startswith(_OWN) else common
            part[name.removeprefix(_OWN)] = array
        read, arrays = Reader.restored(common, reading)
        proposed = Reader.restored(own, reading.proposed)[0] if reading.proposed else read
        dim = arrays.get("output.bias", np.empty(0)).size
        expected = shapes((proposed.size, read.size), design.width, dim)
        return cls(design, read, checked(arrays, expected), proposed)


def _sides(proposed: Reader, target: Reader, data: Rehearsal) -> Sides:
    """Input rows of both sides; a side of its own sees simulations, which no sensor spoils."""
    rows = target.table(data)
    own = rows if proposed is target else proposed.table(data.pure)
    return Sides(own, rows)


def _bridged(task: Task, shown: Array, network: Fitted) -> Array:
    """The target (T, C) with its gaps bridged by a simulation (T, C), run by run, where one channel
    is compared.
    """
    sensor = network.proposed.reading.part(shown)
    whole = task.observed.copy()
    # a map from one number to one: from several channels nobody knows which shows what
    if sensor.shape[-1] != 1:
        return whole
    ends = np.cumsum(task.lengths)
    for first, end in zip(ends - task.lengths, ends, strict=True):
        # columns of the copy, so that they are filled in place
        for channel in network.read.reading.part(whole[first:end]).T:
            channel[:] = bridged(channel, sensor[first:end, 0])
    return whole


class PairTuner(Tuner):
    """What the tuners on TuneNet's network share; subclasses say how it is built and what it reads,
    and tune.
    """

    requires: ClassVar[tuple[str, ...]] = ("torch",)
    stochastic: ClassVar[bool] = False
    learned: ClassVar[bool] = True
    alone: ClassVar[bool] = False
    """As in `pair_network.train`."""

    _fitted: Prepared[Fitted] | None = None

    def design(self) -> Design:
        """How the network is built and trained."""
        raise NotImplementedError

    def reading(self) -> Reading:
        """What it reads."""
        raise NotImplementedError

    def layout(self, dim: int) -> tuple[int, int]:
        """Training scenarios, at most as many as the budget allows, and simulations in each."""
        raise NotImplementedError

    def fit(self, simulator: Practice, rng: np.random.Generator, budget: int) -> None:
        """Train on at most `budget` simulations of the training range.

        Raises:
            ValueError: a budget of less than two scenarios.
        """
        scenarios, each = self.layout(simulator.dim)
        data = rehearse(simulator, rng, budget, scenarios, each)
        watch = self.watch
        apart = None
        if watch is not None:
            ground = watch.ground
            # simulations of their own, from a stream of their own: training does not notice
            stream = np.random.default_rng(0)
            apart = rehearse(ground, stream, ground.budget, scenarios, max(each, 2))
        self.learn(data, rng, apart)

    def learn(
        self, data: Rehearsal, rng: np.random.Generator, apart: Rehearsal | None = None
    ) -> None:
        """Train on simulations; `apart` are others, on which `watch` sees how well."""
        watch = self.watch

        def fitted(stage: str, shown: Rehearsal, noise: Array | None) -> Fitted:
            look = None
            if watch is not None and apart is not None:
                look = Look(heard(apart, noise), partial(watch.epoch, stage))
            return Fitted.train(self.design(), shown, rng, self.reading(), self.alone, look)

        self._fitted = Prepared.train(data, rng, self.reading(), fitted)

    def state(self) -> dict[str, Array]:
        """The network's weights and what it reads, by name; empty before `fit`."""
        return {} if self._fitted is None else self._fitted.state()

    def restore(self, state: dict[str, Array]) -> None:
        """Take back what `state` gave.

        Raises:
            ValueError: arrays of other names or shapes.
        """
        design, reading = self.design(), self.reading()
        self._fitted = Prepared.restored(
            state, reading, lambda part: Fitted.restored(part, design, reading)
        )

    def fitted(self) -> Prepared[Fitted]:
        """What was trained.

        Raises:
            RuntimeError: nothing was.
        """
        if self._fitted is None:
            raise RuntimeError(f"{self.name} has not been trained; call fit or restore first")
        return self._fitted
