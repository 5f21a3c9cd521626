"""What several diagnosers look at: the base model fitted to a recording, what it leaves, and what
each effect of the library would change about it, along the trajectory or as an acceleration.

With y the recorded runs and y₀ those of the fitted base model, the residual r = y - y₀ is to first
order a sum of what parameters, initial states (J) and missing effects (D) change,

    r = J δ + D c + noise                                                                      (1)

An effect's direction D is taken from the simulator (`bench.gap.causes.candidates`), and so holds
for effects of forces, inputs, sensors and impacts alike. What a regression of accelerations sees of
it is (1) under a linear operator: the second derivative of a position, the first of a rate, less
what the motion's own stiffness A and damping B make of a displacement,

    L r = r'' - A r - B r'                                                                     (2)

with derivatives by local polynomials (A. Savitzky, M. J. E. Golay, Anal. Chem. 36, 1627, 1964).
Both sides pass the same filter, which thus biases nothing. Samples near an impact are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bench.diagnoser import Case
from bench.gap.causes.candidates import Directions, directions
from bench.gap.model.base_fit import Base, fit_base
from bench.gap.model.floor import noise_floor
from bench.gap.model.noise import Mask, Noise
from bench.gap.model.problem import Fit
from bench.gap.model.world import World
from sims.base import Array
from sims.system import Moment

WINDOW = 0.2
"""Seconds of the local polynomials."""
LEAST_WINDOW = 7
"""Samples of them at least."""
DEGREE = 3
"""Of the polynomials."""
NUDGE = 1e-5
"""Of a coordinate and of a rate, SI units, for A and B of (2)."""


@dataclass(frozen=True)
class Column:
    """A column of (1): one grid point of an effect, all of its directions together.

    Attributes:
        effect: its name.
        places: of its directions among all.
    """

    effect: str
    places: tuple[int, ...]


@dataclass(frozen=True)
class Rows:
    """(1) as a linear regression, each row in units of its noise.

    Attributes:
        left: (N,) of the residual.
        base: (N, B) of parameters and initial states.
        effects: (N, K) of all directions.
        run: (N,) of which run each row is.
        state: (N, F) time, channels of the base model and inputs there.
    """

    left: Array
    base: Array
    effects: Array
    run: NDArray[np.intp]
    state: Array

    def of(self, runs: Sequence[int]) -> Rows:
        """The rows of some runs."""
        chosen = np.isin(self.run, list(runs))
        return Rows(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def projected(self) -> tuple[Array, Array]:
        """(N,) and (N, K): what parameters and initial states cannot take up of them."""
        scale = np.sqrt(np.square(self.base).sum(axis=0))
        basis = self.base[:, scale > 0] / scale[scale > 0]
        orthonormal, triangle = np.linalg.qr(basis)
        # A parameter that others stand for already has no direction of its own.
        kept = orthonormal[:, np.abs(np.diag(triangle)) > 1e-10]
        left: Array = self.left - kept @ (kept.T @ self.left)
        effects: Array = self.effects - kept @ (kept.T @ self.effects)
        return left, effects


class Evidence:
    """The base model of a case, and what would change it.

    Args:
        case: its recording is fitted, with the runs for fitting or with all.
        every: whether runs that are held out are fitted too.

    Attributes:
        world: the runs and the simulator.
        noise: of each channel, stated or estimated.
        base: the fitted base model.
        fitted: numbers of the runs that are for fitting.
        held_out: numbers of the others.
    """

    def __init__(self, case: Case, every: bool = True) -> None:
        recording = case.recording
        runs = [*recording.training(), *(recording.held_out() if every else ())]
        # A robot steps as its file says.
        engine = None if case.kind.own_engine else "batch"
        self.world = World(case.kind, recording, runs, engine, candidates=list(case.library))
        floor = noise_floor(self.world, recording)
        self.noise = Noise(floor.sigma, np.zeros(floor.sigma.size))
        self.stated: Mask = floor.stated
        self.base: Base = fit_base(self.world, self.noise)
        count = len(recording.training())
        self.fitted = range(count)
        self.held_out = range(count, len(runs))

    def close(self) -> None:
        """Give back what the engine holds."""
        self.world.close()

    @cached_property
    def seen(self) -> Mask:
        """(R, T, C) samples that there are."""
        return np.isfinite(self.world.observed)

    @cached_property
    def residual(self) -> Array:
        """(R, T, C) observed less the base model, zero where nothing was seen."""
        left = self.world.observed - self.base.fit.simulated
        residual: Array = np.where(self.seen, left, 0.0)
        return residual

    @cached_property
    def directions(self) -> Directions:
        """What each effect would change."""
        return directions(self.world, self.base.fit, self.world.library)

    @cached_property
    def columns(self) -> list[Column]:
        """Of each effect every grid point."""
        places: dict[tuple[str, int, int], list[int]] = {}
        for i, probe in enumerate(self.directions.probes):
            # Directions that are whole changes stand for one size each, and do not add up.
            alone = i if probe.fixed else -1
            places.setdefault((probe.effect, probe.group, alone), []).append(i)
        return [Column(effect, tuple(members)) for (effect, *_), members in places.items()]

    def trajectories(self) -> Rows:
        """(1) along the trajectories, every sample a row."""
        fit = self.base.fit
        runs, length, channels, _ = fit.jacobian.shape
        return self._rows(
            self.residual,
            self._base_columns(),
            self.directions.values,
            np.broadcast_to(self.noise.sigma, (runs, length, channels)),
            self.seen,
        )

    def accelerations(self, seconds: float = WINDOW) -> Rows:
        """(2) of it: accelerations in units of what noise makes of them, by polynomials of this
        length.
        """
        left, sigma, seen = self._filtered(self.residual[..., None], seconds)
        base, _, _ = self._filtered(self._base_columns(), seconds)
        effects, _, _ = self._filtered(self.directions.values, seconds)
        return self._rows(left[..., 0], base, effects, sigma, seen)

    def _base_columns(self) -> Array:
        return columns_of(self.world, self.base.fit)

    def _rows(self, left: Array, base: Array, effects: Array, sigma: Array, seen: Mask) -> Rows:
        runs = np.broadcast_to(np.arange(len(left))[:, None, None], seen.shape)
        # An impact makes some numbers very large; nothing can be learned where one is none.
        whole = seen & np.isfinite(base).all(axis=3) & np.isfinite(effects).all(axis=3)
        scale = 1.0 / sigma[whole]
        states = self._states()
        states = np.broadcast_to(states[:, :, None], (*seen.shape, states.shape[2]))
        return Rows(
            left[whole] * scale,
            base[whole] * scale[:, None],
            effects[whole] * scale[:, None],
            runs[whole],
            states[whole],
        )

    def _states(self) -> Array:
        """(R, T, F) time, channels of the base model and inputs."""
        world = self.world
        runs, length, channels = world.observed.shape
        names = [channel.name for channel in world.simulator.inputs]
        states = np.zeros((runs, length, 1 + channels + len(names)))
        for r, track in enumerate(world.tracks):
            size = int(world.lengths[r])
            times, inputs = track.scenario.times, track.scenario.inputs
            states[r, :size, 0] = times - times[0]
            for i, name in enumerate(names):
                states[r, :size, 1 + channels + i] = inputs.get(name, np.zeros(size))
        states[..., 1 : 1 + channels] = np.nan_to_num(self.base.fit.simulated)
        return states

    def _filtered(self, values: Array, seconds: float) -> tuple[Array, Array, Mask]:
        """(2) of trajectories (R, T, C, K), what noise makes of it (R, T, C), and where it is
        to be used.
        """
        from scipy.signal import savgol_coeffs, savgol_filter

        world, system = self.world, self.world.simulator.system
        runs, length, channels, _ = values.shape
        result = np.full_like(values, np.nan)
        sigma = np.ones((runs, length, channels))
        used = np.zeros((runs, length, channels), dtype=bool)
        pairs = dict(zip(system.rates, system.coordinates, strict=False))
        for r, track in enumerate(world.tracks):
            size = int(world.lengths[r])
            step = float(np.median(np.diff(track.scenario.times)))
            window = _odd(min(max(LEAST_WINDOW, round(seconds / step)), size // 2))
            stiff, damped = self._linear(r)
            for c, name in enumerate(world.channels):
                rate = name in pairs
                if not rate and name not in system.coordinates:
                    continue
                part = values[r, :size, c]
                order = 1 if rate else 2

                def smooth(
                    deriv: int, part: Array = part, window: int = window, step: float = step
                ) -> Array:
                    filtered: Array = savgol_filter(
                        part, window, DEGREE, deriv=deriv, delta=step, axis=0
                    )
                    return filtered

                place = system.coordinates.index(pairs[name] if rate else name)
                own = smooth(order)
                if rate:
                    own -= damped[:size, place, None] * smooth(0)
                else:
                    own -= stiff[:size, place, None] * smooth(0)
                    own -= damped[:size, place, None] * smooth(1)
                result[r, :size, c] = own
                weights = savgol_coeffs(window, DEGREE, deriv=order, delta=step)
                sigma[r, :size, c] = self.noise.sigma[c] * np.sqrt(np.square(weights).sum())
                used[r, :size, c] = self._smooth_at(r, size, window)
        return result, sigma, used & self.seen

    def _smooth_at(self, run: int, size: int, window: int) -> Mask:
        """(T,) where the window meets neither an end of the run nor an impact."""
        good = np.ones(size, dtype=bool)
        half = window // 2
        good[:half] = good[size - half :] = False
        system = self.world.simulator.system
        name = system.coordinates[-1] if system.bounces else ""
        if name in self.world.channels:
            c = self.world.channels.index(name)
            simulated = self.base.fit.simulated[run, :size, c]
            for path in (simulated, self.world.observed[run, :size, c]):
                lowest = np.flatnonzero((path[1:-1] < path[:-2]) & (path[1:-1] <= path[2:])) + 1
                for at in lowest[path[lowest] < _NEAR_GROUND]:
                    good[max(0, at - half - 1) : at + half + 2] = False
        return good

    def _linear(self, run: int) -> tuple[Array, Array]:
        """A and B of (2), (T, D) each: only a coordinate's own, which is all that there is in
        systems of one joint, and none in flight.
        """
        world, system = self.world, self.world.simulator.system
        track = world.tracks[run]
        size, dimensions = int(world.lengths[run]), len(system.coordinates)
        nothing = np.zeros((size, dimensions))
        if system.uniform or dimensions != 1:
            return nothing, nothing
        times = track.scenario.times
        name = system.coordinates[0]
        if name not in world.channels:
            return nothing, nothing
        x = self.base.fit.simulated[run, :size, world.channels.index(name)][:, None]
        v = np.gradient(x[:, 0], times)[:, None]
        given = {c.name: c.value for c in world.kind.constants}
        given |= {**world.simulator.constant_values, **track.scenario.constants}
        constants = {key: np.full((size, 1), float(value)) for key, value in given.items()}
        theta = np.tile(self.base.fit.theta[: world.own], (size, 1))
        inputs = {
            channel.name: np.asarray(track.scenario.inputs.get(channel.name, np.zeros(size)))[
                :size, None
            ]
            for channel in world.simulator.inputs
        }
        clock = (times - times[0])[:, None]

        def accelerated(x: Array, v: Array) -> Array:
            moment = Moment(system(), theta, constants, clock, x, v, inputs)
            force: Array = moment.system.force(moment) / moment.inertia
            return force

        still = accelerated(x, v)
        return (accelerated(x + NUDGE, v) - still) / NUDGE, (
            accelerated(x, v + NUDGE) - still
        ) / NUDGE


_NEAR_GROUND = 1.0
"""Metres of the last coordinate below which a lowest point is taken for an impact."""


def _odd(samples: int) -> int:
    return max(samples - 1 + samples % 2, DEGREE + 2)


def columns_of(world: World, fit: Fit) -> Array:
    """(R, T, C, q + n) what a fit's parameters and each run's own initial state change."""
    shared = fit.free.size
    runs, length, channels, _ = fit.jacobian.shape
    unknown = [np.flatnonzero(~world.known[r]) for r in range(runs)]
    width = shared + sum(places.size for places in unknown)
    columns = np.zeros((runs, length, channels, width))
    columns[..., :shared] = fit.jacobian[..., :shared]
    first = shared
    for r, places in enumerate(unknown):
        columns[r, :, :, first : first + places.size] = fit.jacobian[r][..., shared + places]
        first += places.size
    return columns


def strongest(
    left: Array, effects: Array, columns: Sequence[Column]
) -> dict[str, tuple[float, Column]]:
    """Of each effect the grid point that explains most of what is left, and how much.

    Args:
        left: (N,) projected.
        effects: (N, K) projected.
        columns: grid points.

    Returns:
        By effect the drop of the sum of squares, and the column.
    """
    best: dict[str, tuple[float, Column]] = {}
    for column in columns:
        part = effects[:, list(column.places)]
        scale = np.sqrt(np.square(part).sum(axis=0))
        if not (scale > 1e-9).any():
            continue
        part = part[:, scale > 1e-9] / scale[scale > 1e-9]
        gram = part.T @ part + 1e-9 * np.eye(part.shape[1])
        cross = part.T @ left
        gain = float(cross @ np.linalg.solve(gram, cross))
        if column.effect not in best or gain > best[column.effect][0]:
            best[column.effect] = gain, column
    return best
