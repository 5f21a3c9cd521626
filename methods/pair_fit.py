"""Training data and the trained object that TuneNet and its regressor share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from methods.base import Array, Practice, Task
from methods.pair_inputs import Inputs, raw_inputs, roughness, weighed_inputs
from methods.pair_network import Design, estimate, shapes, train


class Options(Protocol):
    """The options of a tuner that bear on its network's inputs."""

    published: bool
    points: int
    inputs: int
    strictness: float
    noise: float


class Rehearsal(NamedTuple):
    """Training simulations: several in each scenario.

    Attributes:
        parameters: (scenarios, each, dim), unit cube.
        observations: (scenarios, each, T, C), SI units.
        lengths: samples of each run.
    """

    parameters: Array
    observations: Array
    lengths: tuple[int, ...]


def rehearse(simulator: Practice, rng: np.random.Generator, budget: int, scenarios: int, each: int) -> Rehearsal:
    """Simulate `each` uniformly drawn points in each of `scenarios` scenarios, fewer scenarios if the budget is small.

    Raises:
        ValueError: the budget does not last for two scenarios.
    """
    count = min(scenarios, budget // each)
    if count < 2:
        raise ValueError(f"{budget} training simulations are fewer than two scenarios of {each} need")
    parameters, observations = [], []
    for _ in range(count):
        points = simulator.sample(rng, each)
        seen = simulator.simulate(rng, points)
        whole = np.isfinite(seen).all(axis=(1, 2))
        if whole.all():
            parameters.append(points)
            observations.append(seen)
    if len(parameters) < 2:
        raise ValueError(f"of {count} training scenarios, {len(parameters)} could be simulated; at least 2 are needed")
    return Rehearsal(np.array(parameters), np.array(observations), tuple(simulator.lengths))


@dataclass(frozen=True)
class Fitted:
    """A trained network together with what it reads.

    Attributes:
        design: how the network is built.
        rows: observations to input rows.
        weights: the network's arrays by name.
    """

    design: Design
    rows: Inputs
    weights: dict[str, Array]

    @classmethod
    def train(cls, design: Design, data: Rehearsal, rng: np.random.Generator, options: Options, alone: bool) -> Fitted:
        """Choose the inputs and train the network on them; `alone` as in `pair_network.train`."""
        parameters, observations, lengths = data
        flat = observations.reshape(-1, *observations.shape[2:])
        if options.published:
            rows = raw_inputs(flat, lengths, options.points)
        else:
            rows = weighed_inputs(parameters, observations, lengths, options.points, options.inputs, options.strictness)
        seen = rows(flat, lengths).reshape(*parameters.shape[:2], -1)
        return cls(design, rows, train(seen, parameters, design, rng, alone))

    def difference(self, proposed: Array, target: Array) -> Array:
        """h(proposed, target) of input rows; see `pair_network.estimate`."""
        return estimate(self.weights, self.design, proposed, target)

    def state(self) -> dict[str, Array]:
        """Everything as plain arrays."""
        return {
            "inputs.chosen": self.rows.chosen,
            "inputs.centre": self.rows.centre,
            "inputs.gain": self.rows.gain,
            **self.weights,
        }

    @classmethod
    def restored(cls, state: dict[str, Array], design: Design, points: int, plain: bool) -> Fitted:
        """The inverse of `state`.

        Raises:
            ValueError: arrays of other names or shapes, or numbers that are not finite.
        """
        arrays = {name: np.array(array, dtype=np.float64) for name, array in state.items()}
        expected: dict[str, tuple[int, ...]] = dict.fromkeys(("inputs.chosen", "inputs.centre", "inputs.gain"), ())
        chosen, bias = arrays.get("inputs.chosen"), arrays.get("output.bias")
        size = chosen.size if chosen is not None else 0
        expected = dict.fromkeys(expected, (size,)) | shapes(size, design.width, bias.size if bias is not None else 0)
        if arrays.keys() != expected.keys():
            raise ValueError(f"expected arrays {sorted(expected)}, found {sorted(arrays)}")
        for name, shape in expected.items():
            if arrays[name].shape != shape or not size or not np.isfinite(arrays[name]).all():
                raise ValueError(f"array {name}: expected finite numbers of shape {shape}, found {arrays[name].shape}")
        weights = {name: arrays[name] for name in shapes(size, design.width, 1)}
        return cls(
            design, Inputs(points, plain, *(arrays[f"inputs.{n}"] for n in ("chosen", "centre", "gain"))), weights
        )


@dataclass(frozen=True)
class Prepared:
    """A network for targets as clean as the simulations, and one for targets from a sensor.

    The two read different things of an observation: without noise, single samples that follow the parameters exactly
    even far outside the training range; with noise, what many samples say together.

    Attributes:
        clean: trained on the simulations as they are.
        noisy: trained on the same simulations with noise added; the clean one again where there is none.
        limit: (C,) roughness above which a target counts as noisy, SI units.
    """

    clean: Fitted
    noisy: Fitted
    limit: Array

    @classmethod
    def train(
        cls, design: Design, data: Rehearsal, rng: np.random.Generator, options: Options, alone: bool = False
    ) -> Prepared:
        """Train both networks on the same simulations; only one where published or where `options.noise` is 0."""
        clean = Fitted.train(design, data, rng, options, alone)
        flat = data.observations.reshape(-1, *data.observations.shape[2:])
        spread = flat.std(axis=(0, 1))
        limit = 2.0 * roughness(flat, data.lengths).max(axis=0) + options.noise / 50.0 * spread
        if options.published or not options.noise:
            return cls(clean, clean, limit)
        spoilt = data.observations + options.noise * spread * rng.standard_normal(data.observations.shape)
        return cls(clean, Fitted.train(design, data._replace(observations=spoilt), rng, options, alone), limit)

    def suited(self, task: Task) -> Fitted:
        """The network for a target, chosen by the target's roughness."""
        rough = roughness(task.observed[None], task.lengths)[0]
        return self.noisy if (rough > self.limit).any() else self.clean

    def state(self) -> dict[str, Array]:
        """Everything as plain arrays."""
        arrays = {f"clean.{name}": array for name, array in self.clean.state().items()}
        if self.noisy is not self.clean:
            arrays |= {f"noisy.{name}": array for name, array in self.noisy.state().items()}
        return arrays | {"limit": self.limit}

    @classmethod
    def restored(cls, state: dict[str, Array], design: Design, options: Options) -> Prepared:
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
            raise ValueError(f"array limit: expected finite numbers of shape (channels,), found shape {limit.shape}")
        two = bool(options.noise) and not options.published
        if two != bool(parts["noisy"]):
            raise ValueError(f"expected {'two networks' if two else 'one network'}, found another number of them")
        clean = Fitted.restored(parts["clean"], design, options.points, options.published)
        noisy = Fitted.restored(parts["noisy"], design, options.points, options.published) if two else clean
        return cls(clean, noisy, limit)
