"""The trained object that TuneNet and its regressor share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np

from methods.base import Array, Practice, Task, Tuner
from methods.learning.bridging import bridged
from methods.learning.pair_inputs import roughness
from methods.learning.pair_network import Design, Sides, Watched, estimate, shapes, train
from methods.learning.reader import Reader, Reading
from methods.learning.rehearsal import Rehearsal, rehearse

_OWN = "own-"
"""Begins the names of the arrays of a proposed side that reads something of its own."""
_CALM = 2.0
"""A target is as clean as simulations up to this many times their own roughness."""
_HEARD = 50.0
"""A target counts as noisy from so small a part (one in 50) of the noise prepared for."""


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
        if arrays.keys() != expected.keys():
            raise ValueError(f"expected arrays {sorted(expected)}, found {sorted(arrays)}")
        for name, shape in expected.items():
            if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
                raise ValueError(
                    f"array {name}: expected finite numbers of shape {shape}, "
                    f"found {arrays[name].shape}"
                )
        return cls(design, read, {name: arrays[name] for name in expected}, proposed)


def _sides(proposed: Reader, target: Reader, data: Rehearsal) -> Sides:
    """Input rows of both sides; a side of its own sees simulations, which no sensor spoils."""
    rows = target.table(data)
    own = rows if proposed is target else proposed.table(data.pure)
    return Sides(own, rows)


@dataclass(frozen=True)
class Prepared:
    """A network for targets as clean as the simulations, and one for targets from a sensor.

    The two read different things of an observation: without noise, single samples that follow the
    parameters exactly even far outside the training range; with noise, what many samples say
    together.

    Attributes:
        clean: trained on the simulations as they are; the noisy one again where no target is as
            clean.
        noisy: trained on the same simulations with noise added; the clean one again where there is
            none.
        limit: (C,) roughness above which a target counts as noisy, SI units.
    """

    clean: Fitted
    noisy: Fitted
    limit: Array

    @classmethod
    def train(
        cls,
        design: Design,
        data: Rehearsal,
        rng: np.random.Generator,
        reading: Reading,
        alone: bool = False,
        look: Callable[[str], Look] | None = None,
    ) -> Prepared:
        """Train both networks on the same simulations; only one where `reading` prepares for one
        kind of target.
        """
        spread = data.flat.std(axis=(0, 1))
        own = roughness(data.flat, data.lengths).max(axis=0)
        limit = _CALM * own + reading.noise / _HEARD * spread

        def noisy() -> Fitted:
            noise = reading.noise * spread
            looking = look and look("noisy")
            if looking:
                # noise of its own stream: what is learned is the same whether anybody looks
                spoilt = looking.held_out.spoilt(noise, np.random.default_rng(0))
                looking = replace(looking, held_out=spoilt)
            return Fitted.train(design, data.spoilt(noise, rng), rng, reading, alone, looking)

        # a sensor whose errors last looks as smooth as a clean target: then there is one network
        if reading.noise and not reading.clean:
            network = noisy()
            return cls(network, network, limit)
        clean = Fitted.train(design, data, rng, reading, alone, look and look("clean"))
        return cls(clean, noisy() if reading.noise else clean, limit)

    def suited(self, task: Task) -> Fitted:
        """The network for a target, chosen by the target's roughness."""
        rough = roughness(task.observed[None], task.lengths)[0]
        return self.noisy if (rough > self.limit).any() else self.clean

    def estimator(self, task: Task) -> Callable[[Array], Array]:
        """From one simulation (1, T, C) to h(simulation, target), (dim,); NaN where the simulation
        failed.
        """
        network = self.suited(task)
        alike = network.proposed is network.read
        # hidden in the simulation too, so that the truth gives the target's own row
        hidden = np.isnan(task.observed) if alike else None
        row = None
        if alike:
            # the target's row is the same for every simulation, unless gaps are bridged by it
            row = network.read(task.observed[None], task.lengths, task.scene, hidden)[0]

        def difference(observations: Array) -> Array:
            if not np.isfinite(observations).all():
                return np.full(task.dim, np.nan)
            proposed = network.proposed(observations, task.lengths, task.scene, hidden)[0]
            target = row
            if target is None:
                whole = _bridged(task, observations[0], network)
                target = network.read(whole[None], task.lengths, task.scene)[0]
            return network.difference(proposed, target)

        return difference

    def state(self) -> dict[str, Array]:
        """Everything as plain arrays."""
        arrays = {f"clean.{name}": array for name, array in self.clean.state().items()}
        if self.noisy is not self.clean:
            arrays |= {f"noisy.{name}": array for name, array in self.noisy.state().items()}
        return arrays | {"limit": self.limit}

    @classmethod
    def restored(cls, state: dict[str, Array], design: Design, reading: Reading) -> Prepared:
        """The inverse of `state`.

        Raises:
            ValueError: arrays of other names or shapes, or numbers that are not finite.
        """
        parts: dict[str, dict[str, Array]] = {"clean": {}, "noisy": {}, "limit": {}}
        for name, array in state.items():
            part, _, rest = name.partition(".")
            if part not in parts:
                raise ValueError(f"expected arrays of {sorted(parts)}, found {name}")
            parts[part][rest] = array
        limit = np.array(parts["limit"].get("", np.nan), dtype=np.float64)
        if limit.ndim != 1 or not np.isfinite(limit).all():
            raise ValueError(
                "array limit: expected finite numbers of shape (channels,), "
                f"found shape {limit.shape}"
            )
        two = bool(reading.noise) and reading.clean
        if two != bool(parts["noisy"]):
            raise ValueError(
                f"expected {'two networks' if two else 'one network'}, found another number of them"
            )
        clean = Fitted.restored(parts["clean"], design, reading)
        noisy = Fitted.restored(parts["noisy"], design, reading) if two else clean
        return cls(clean, noisy, limit)


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

    _fitted: Prepared | None = None

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
        look = None
        watch = self.watch
        if watch is not None:
            ground = watch.ground
            # simulations of their own, from a stream of their own: training does not notice
            apart = rehearse(
                ground,
                np.random.default_rng(0),
                ground.budget,
                scenarios,
                max(each, 2),
            )

            def look(stage: str) -> Look:
                return Look(apart, partial(watch.epoch, stage))

        self._fitted = Prepared.train(
            self.design(),
            data,
            rng,
            self.reading(),
            self.alone,
            look,
        )

    def state(self) -> dict[str, Array]:
        """The network's weights and what it reads, by name; empty before `fit`."""
        return {} if self._fitted is None else self._fitted.state()

    def restore(self, state: dict[str, Array]) -> None:
        """Take back what `state` gave.

        Raises:
            ValueError: arrays of other names or shapes.
        """
        self._fitted = Prepared.restored(state, self.design(), self.reading())

    def fitted(self) -> Prepared:
        """What was trained.

        Raises:
            RuntimeError: nothing was.
        """
        if self._fitted is None:
            raise RuntimeError(f"{self.name} has not been trained; call fit or restore first")
        return self._fitted
