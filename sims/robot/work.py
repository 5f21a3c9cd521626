"""Lanes of a robot on their way: where they begin, what they are given, what is made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from sims.base import Array, Scenario
from sims.plan import Runs
from sims.robot.floating import Afloat
from sims.robot.midway import Mask, Places
from sims.system import Acting, Sensor

Number = TypeVar("Number", bound=np.generic)

BEYOND, LATE = 1.1, 0.2
"""How far beyond its end a run is simulated at most where sensors are early: times its length, and
seconds.
"""


class Work(NamedTuple):
    """Lanes of one run.

    Attributes:
        scenario: theirs.
        commands: its inputs (T,) by name.
        acting: effects at one place each, with coefficients (K, n, 1).
        x, v: (n, D) initial positions and velocities.
    """

    scenario: Scenario
    commands: Mapping[str, Array]
    acting: Acting
    x: Array
    v: Array

    @property
    def times(self) -> Array:
        """(T,) of samples, seconds since the start."""
        result: Array = self.scenario.times - self.scenario.times[0]
        return result


def instants(work: Work) -> Array:
    """The last instants at which something is read in the lanes of a run, seconds since the start:
    by a clock that runs slow the world goes on beyond the last stamp.
    """
    end = work.times[-1:]
    latest = float(end[0])
    for effect, c in work.acting:
        if isinstance(effect, Sensor):
            latest = max(latest, float(np.max(effect.times(c, np.broadcast_to(end, c[0].shape)))))
    # What a fit tries far from all that can be shall not cost a thousand steps.
    return np.array([min(latest, BEYOND * float(end[0]) + LATE)])


class Start(NamedTuple):
    """Where n lanes begin, (n, D) each, what acts on them, and where what floats begins."""

    x: Array
    v: Array
    acting: Acting
    afloat: Afloat


class Given(NamedTuple):
    """What n lanes are given over S steps, known beforehand.

    Attributes:
        controls: (n, S, nu).
        forces: (n, S, nv) generalised.
        felt: inputs, (n, S) by name; behind a filter before an actuator, its activation.
        instant: controls as they are when each step begins.
        activations: (n, na) of actuators when the first step begins.
        off: (n, S, K) which actuators are switched off.
    """

    controls: Array
    forces: Array
    felt: Mapping[str, Array]
    instant: Array
    activations: Array
    off: Mask

    @classmethod
    def of(cls, parts: Sequence[Given]) -> Given:
        """Lanes of several runs; shorter ones are given their last over and over."""
        if len(parts) == 1:
            return parts[0]
        steps = max(part.controls.shape[1] for part in parts)
        names = parts[0].felt
        return cls(
            np.concatenate([_lasting(part.controls, steps) for part in parts]),
            np.concatenate([_lasting(part.forces, steps) for part in parts]),
            {n: np.concatenate([_lasting(part.felt[n], steps) for part in parts]) for n in names},
            np.concatenate([_lasting(part.instant, steps) for part in parts]),
            np.concatenate([part.activations for part in parts]),
            np.concatenate([_lasting(part.off, steps) for part in parts]),
        )


def _lasting(values: NDArray[Number], steps: int) -> NDArray[Number]:
    """(n, S', ...) drawn out to so many steps by their last."""
    more = steps - values.shape[1]
    if not more:
        return values
    return np.concatenate([values, np.repeat(values[:, -1:], more, axis=1)], axis=1)


def by_run(runs: Runs, lanes: Places) -> list[tuple[int, Places]]:
    """Lanes that lie together by their runs."""
    if not lanes.size:
        return []
    borders = np.flatnonzero(np.diff(runs.of[lanes])) + 1
    return [(int(runs.of[own[0]]), own) for own in np.split(lanes, borders)]


class Made(NamedTuple):
    """What MuJoCo made of n lanes.

    Attributes:
        x, v: (n, S + 1, D) at the beginning and after every step.
        fields: what MuJoCo's data had in each step, (n, S, ...) by name.
        begun: (n, na) activations at the beginning.
        failed: (n,) which lanes did.
        series: positions and velocities (n, S + 1, H) of joints in series with others.
    """

    x: Array
    v: Array
    fields: Mapping[str, Array]
    begun: Array
    failed: Mask
    series: tuple[Array, Array]

    def of(self, lanes: slice) -> Made:
        """Some of the lanes."""
        fields = {name: values[lanes] for name, values in self.fields.items()}
        series = self.series[0][lanes], self.series[1][lanes]
        rest = self.begun[lanes], self.failed[lanes], series
        return Made(self.x[lanes], self.v[lanes], fields, *rest)
