"""Base class of tuners on TuneNet's pair network: training, state and estimates."""

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
"""Prefix of array names of the proposed side if both sides have different inputs."""


@dataclass(frozen=True)
class Look:
    """Monitor of the training of one network.

    Attributes:
        held_out: simulations that are used for evaluation only.
        epoch: called after each epoch with its number from 1, the number of epochs, training loss
            and held-out loss.
    """

    held_out: Rehearsal
    epoch: Callable[[int, int, float, float], None]


@dataclass(frozen=True)
class Fitted:
    """A trained pair network with its input features.

    Attributes:
        design: design of the network.
        read: map from observations and scenarios to input rows of the target's side.
        weights: weight arrays by name.
        proposed: map to input rows of the proposed side; the object `read` if both sides have the
            same inputs.
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
        """Choose the inputs, and train the network on them.

        Args:
            design: design of the network.
            data: training data.
            rng: random generator.
            reading: configuration of the inputs.
            alone: as in `pair_network.train`.
            look: monitor of the training; None for none.
        """
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
        """Compute h(proposed, target) of input rows; see `pair_network.estimate`.

        Args:
            proposed: (n, D) or (D,) input rows of the proposed side.
            target: (n, E) or (E,) input rows of the target's side.
        """
        return estimate(self.weights, self.design, proposed, target)

    def estimator(self, task: Task) -> Callable[[Array], Array]:
        """Return the function from one simulation (1, T, C) to h(simulation, target), shape (dim,).

        The result is NaN if the simulation failed.
        """
        alike = self.proposed is self.read
        # Samples missing in the target are hidden in the simulation too, so that the true
        # parameters give the target's own row.
        hidden = np.isnan(task.observed) if alike else None
        row = None
        if alike:
            # The target's row is equal for all simulations, unless a simulation fills its gaps.
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
        """Return weights and input features as plain arrays by name."""
        state = self.read.state() | self.weights
        if self.proposed is self.read:
            return state
        # The arrays of both sides have the same names.
        own = {_OWN + name: array for name, array in self.proposed.state().items()}
        return own | state

    @classmethod
    def restored(cls, state: dict[str, Array], design: Design, reading: Reading) -> Fitted:
        """Restore a network from the arrays of `state`.

        Args:
            state: arrays by name.
            design: design of the network.
            reading: configuration of the inputs.

        Raises:
            ValueError: arrays have other names or shapes, or numbers that are not finite.
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
    """Compute input rows of both sides; separate inputs of the proposed side have no noise."""
    rows = target.table(data)
    own = rows if proposed is target else proposed.table(data.pure)
    return Sides(own, rows)


def _bridged(task: Task, shown: Array, network: Fitted) -> Array:
    """Fill the gaps of the target (T, C) from a simulation (T, C), run by run.

    This is done only if one channel is compared.
    """
    sensor = network.proposed.reading.part(shown)
    whole = task.observed.copy()
    # With several channels of the simulation, the one that belongs to the sensor is not known.
    if sensor.shape[-1] != 1:
        return whole
    ends = np.cumsum(task.lengths)
    for first, end in zip(ends - task.lengths, ends, strict=True):
        # Slices of the copy are filled in place.
        for channel in network.read.reading.part(whole[first:end]).T:
            channel[:] = bridged(channel, sensor[first:end, 0])
    return whole


class PairTuner(Tuner):
    """Base class of tuners on TuneNet's network.

    Subclasses define the design, the inputs and the tuning loop.
    """

    requires: ClassVar[tuple[str, ...]] = ("torch",)
    stochastic: ClassVar[bool] = False
    learned: ClassVar[bool] = True
    alone: ClassVar[bool] = False
    """Whether the network has a single input, the target; see `pair_network.train`."""

    _fitted: Prepared[Fitted] | None = None

    def design(self) -> Design:
        """Return the design of the network."""
        raise NotImplementedError

    def reading(self) -> Reading:
        """Return the configuration of the inputs."""
        raise NotImplementedError

    def layout(self, dim: int) -> tuple[int, int]:
        """Return the maximum number of training scenarios, and of simulations in each."""
        raise NotImplementedError

    def fit(self, simulator: Practice, rng: np.random.Generator, budget: int) -> None:
        """Train on at most `budget` simulations of the training range.

        Args:
            simulator: training simulator.
            rng: random generator.
            budget: maximum number of simulations.

        Raises:
            ValueError: the budget is smaller than two scenarios.
        """
        scenarios, each = self.layout(simulator.dim)
        data = rehearse(simulator, rng, budget, scenarios, each)
        watch = self.watch
        apart = None
        if watch is not None:
            ground = watch.ground
            # Separate simulations and a separate random stream do not affect the training.
            stream = np.random.default_rng(0)
            apart = rehearse(ground, stream, ground.budget, scenarios, max(each, 2))
        self.learn(data, rng, apart)

    def learn(
        self, data: Rehearsal, rng: np.random.Generator, apart: Rehearsal | None = None
    ) -> None:
        """Train on simulations.

        Args:
            data: training data.
            rng: random generator.
            apart: held-out data for the losses that `watch` gets; None for none.
        """
        watch = self.watch

        def fitted(stage: str, shown: Rehearsal, noise: Array | None) -> Fitted:
            look = None
            if watch is not None and apart is not None:
                look = Look(heard(apart, noise), partial(watch.epoch, stage))
            return Fitted.train(self.design(), shown, rng, self.reading(), self.alone, look)

        self._fitted = Prepared.train(data, rng, self.reading(), fitted)

    def state(self) -> dict[str, Array]:
        """Return weights and input features by name; empty before `fit`."""
        return {} if self._fitted is None else self._fitted.state()

    def restore(self, state: dict[str, Array]) -> None:
        """Restore the arrays that `state` returned.

        Raises:
            ValueError: arrays have other names or shapes.
        """
        design, reading = self.design(), self.reading()
        self._fitted = Prepared.restored(
            state, reading, lambda part: Fitted.restored(part, design, reading)
        )

    def fitted(self) -> Prepared[Fitted]:
        """Return the trained networks.

        Raises:
            RuntimeError: the tuner has not been trained.
        """
        if self._fitted is None:
            raise RuntimeError(f"{self.name} has not been trained; call fit or restore first")
        return self._fitted
