"""Runge-Kutta 4 steps with events: impacts, standstill and break-away.

The method is the classical Runge-Kutta method of fourth order, written for x'' = a(t, x, v) (E.
Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sections II.1
and, for second order, II.14, doi:10.1007/978-3-540-78862-1). With step h,

    k1 = a(t, x, v)                                                        (1)
    k2 = a(t + h/2, x + h/2 v, v + h/2 k1)                                 (2)
    k3 = a(t + h/2, x + h/2 v + h^2/4 k1, v + h/2 k2)                      (3)
    k4 = a(t + h, x + h v + h^2/2 k2, v + h k3)                            (4)
    x' = x + h v + h^2/6 (k1 + k2 + k3)                                    (5)
    v' = v + h/6 (k1 + 2 k2 + 2 k3 + k4)                                   (6)

The nonlinearity of the acceleration within the step is estimated by the difference between (6) and
the midpoint rule, v + h/2 (k2 + k3), per second:

    b = (k1 - k2 - k3 + k4) / 6                                            (7)

Steps are the planned ones, divided where the motion of an element is too fast for them. Every
element has its own clock. A step that contains an event is rejected and repeated up to the event
time, which is estimated by interpolation and corrected to second order afterwards; the state is
changed there, and the rest of the step follows. No element waits for another or depends on it. With
distance d to the event after the second attempt, its rate r and its acceleration a, the event is

    s = -d / r (1 + d a / (2 r^2))                                         (8)

seconds away, which solves d + r s + a s^2 / 2 = 0 up to terms of third order in d.

An element with dry friction whose velocity would reverse is stopped where the velocity is zero.
Steps in which friction or the forces of effects are too nonlinear (Stribeck's peak, the ripples of
a fast motor) are rejected and shortened.
"""

from __future__ import annotations

import numpy as np

from sims.core.simulator import Array
from sims.core.system import IntegrationBatch, Trajectories
from sims.engines.batch.dynamics import StepDynamics, compute_norm, dot
from sims.engines.batch.element_clock import ElementClocks
from sims.engines.batch.event_roots import find_event_time
from sims.engines.batch.force_field import ForceField
from sims.engines.ground_contact import GroundContact, Indices, Mask

MAX_EVENTS_PER_STEP = 256
"""Maximum number of events in one step of one element; further events are ignored."""
FRICTION_NONLINEARITY_TOLERANCE = 0.05
"""Nonlinearity tolerance of dry friction, as a fraction of its largest value so far, eq. (7)."""
FORCE_NONLINEARITY_TOLERANCE = 0.005
"""Nonlinearity tolerance of the acceleration, as a fraction of its largest value so far."""
NEGLIGIBLE_ACCELERATION_SHARE = 1e-5
"""Fraction of the largest acceleration so far below which friction is negligible.

Nonlinearity of negligible friction does not shorten a step.
"""
STEP_REDUCTION_FACTOR = 0.25
"""Reduction factor of the length of a step in which forces are too nonlinear."""
MIN_STEP_SHARE = 1.0 / 256.0
"""Fraction of a full step below which steps are not shortened."""
BREAK_AWAY_TIME_TOLERANCE = 1e-4
"""Time tolerance of break-away, as a fraction of a step."""
REST_SPEED_SHARE = 1e-9
"""Fraction of the speed change in a full step below which a stopped element is at rest."""

NO_EVENT = 0
"""Goal of a step: no event."""
IMPACT = 1
"""Goal of a step that ends with an impact on the ground."""
STANDSTILL = 2
"""Goal of a step that ends where dry friction has stopped the element."""
BREAK_AWAY = 3
"""Goal of a step that ends at break-away, where the pulling force exceeds dry friction."""


class RungeKuttaStepper:
    """Stepper of a batch, with impacts if there is a ground.

    Args:
        lanes: batch to integrate.
        field: forces on the batch.
        ground: ground contact; None without ground.
        spans: (L, 1) longest step of each element in seconds.
        parts: (L, 1) number of parts into which it is divided.
    """

    def __init__(
        self,
        lanes: IntegrationBatch,
        field: ForceField,
        ground: GroundContact | None,
        spans: Array,
        parts: Array,
    ) -> None:
        count, dim = lanes.x.shape
        self._field = field
        self._ground = ground
        # Each coordinate is contiguous, so that values of shape (L, 1) multiply whole rows.
        self._state = np.empty((3, dim, count))
        self._rows = self._state.reshape(3 * dim, count)
        self._x, self._v, self._a = (part.T for part in self._state)
        self._x[...] = lanes.x
        self._v[...] = lanes.v
        shared = lanes.steps.strides[0] == 0
        self._planned = np.count_nonzero(lanes.steps[:1] if shared else lanes.steps, axis=1)
        if lanes.system.bends:
            # The fine steps that hidden states need count as planned steps.
            self._planned = self._planned * parts[:, 0]
        self._taken = np.zeros(count)
        # Slightly longer than the part, so that rounding does not leave a tiny step after the last
        # one.
        self._longest = np.where(parts > 1, spans / parts * (1.0 + 1e-9), spans)
        # Elements without any of these take the planned steps unchanged, which is much faster.
        self._bends = field.has_dry_friction or bool(field.pushed.any())
        self._eventful = ground is not None or self._bends or bool((parts > 1).any())
        self._clock = ElementClocks(lanes)
        self._dynamics = StepDynamics(field, (count, dim))
        self._limit = self._longest  # of step sizes, from nonlinearity
        self._peak = np.zeros((count, 1))  # square of the largest acceleration so far
        self._rubbed = np.zeros((count, 1))  # largest friction so far
        self._try = np.full((count, 1), np.inf)  # seconds to an event
        self._goal = np.full(count, NO_EVENT, dtype=np.int8)
        self._events = np.zeros(count, dtype=np.intp)
        # An element is open to events if none is pending and it has not had too many in this step.
        self._open = np.ones(count, dtype=bool)
        self._awaits = self._shortened = False
        if ground is not None:
            self._start_on(ground)

    def integrate(self, patience: float = np.inf) -> Trajectories:
        """Integrate all steps.

        Args:
            patience: maximum number of steps of an element, as a multiple of the planned ones;
                beyond it, the element is NaN.

        Returns:
            The trajectories.
        """
        clock = self._clock
        dynamics = self._dynamics
        hurries = self._eventful and np.isfinite(patience)
        while True:
            self._field.set_inputs(clock.get_inputs())
            k1 = dynamics.begin_step(clock.t, self._x, self._v)  # (1)
            self._a[...] = k1
            # Recorded before the step, because k1 is the acceleration of this state.
            clock.record_states(self._rows)
            if clock.over or (hurries and self._overdue(patience)):
                return clock.get_trajectories()
            if self._eventful:
                h = np.minimum(clock.left, self._limit)
                # A step with an event is repeated only up to that event.
                if self._awaits:
                    h = np.minimum(h, self._try)
                self._settle(h, k1)
            else:
                self._x[...], self._v[...], _ = self._stepped(clock.left, k1)[:3]
                clock.finish_step()

    def _overdue(self, patience: float) -> bool:
        """Count a step of every active element and abandon those with too many steps.

        Returns:
            Whether no active element remains.
        """
        self._taken += self._clock.left[:, 0] > 0
        late = self._taken > patience * self._planned
        if not late.any():
            return False
        self._rows[:, late] = np.nan
        # A pending event of an abandoned element must not delay the clock of the others.
        self._limit = np.where(late[:, None], self._longest, self._limit)
        self._try[late] = np.inf
        self._goal[late] = NO_EVENT
        self._taken[late] = 0.0
        self._clock.abandon(late, self._rows)
        return bool(self._clock.over)

    def _stepped(self, h: Array, k1: Array) -> tuple[Array, Array, Array, Array]:
        """Compute one step of h (L, 1) seconds.

        Args:
            h: (L, 1) step sizes in seconds.
            k1: (L, D) accelerations at the beginning.

        Returns:
            Position, velocity and (to third order) acceleration after the step, and six times the
            nonlinearity (7).
        """
        t = self._clock.t
        x = self._x
        v = self._v
        during = self._dynamics.compute_acceleration
        half = 0.5 * h
        middle = t + half
        sixth = h / 6.0
        x2 = x + half * v
        k2 = during(middle, x2, v + half * k1)  # (2)
        v3 = v + half * k2
        k3 = during(middle, x2 + (half * half) * k1, v3)  # (3)
        k4 = during(t + h, x + h * v3, v + h * k3)  # (4)
        inner = k2 + k3
        outer = k1 + k4
        after_x = x + h * (v + sixth * (k1 + inner))  # (5)
        after_v = v + sixth * (outer + 2.0 * inner)  # (6)
        return after_x, after_v, k4, outer - inner  # six times (7)

    def _settle(self, h: Array, k1: Array) -> None:
        """Accept steps of h (L, 1) without events; prepare to repeat the others."""
        x, v, k4, bend = self._stepped(h, k1)
        # Nonlinearity is checked first: events are searched only in accurate steps.
        refused = self._bent(h, k1, bend) if self._bends else None
        now = self._x, self._v, k1
        then = x, v, k4
        cut = self._interrupted(h, now, then, refused)
        if cut is not None:
            refused = cut if refused is None else refused | cut
        if refused is None:
            self._x[...] = x
            self._v[...] = v
        else:
            np.copyto(self._x, x, where=~refused[:, None])
            np.copyto(self._v, v, where=~refused[:, None])
            h = np.where(refused[:, None], 0.0, h)  # time does not advance for rejected steps
        self._clock.advance_time(h)
        if self._awaits:
            self._reach(refused, k4)
        self._dynamics.clear_resting(self._v)
        ended = self._clock.left[:, 0] <= 0
        self._clock.finish_step(ended if refused is None else ended & ~refused)
        if self._events.any():
            self._events[ended] = 0
            self._open = (self._goal == NO_EVENT) & (self._events < MAX_EVENTS_PER_STEP)

    def _bent(self, h: Array, k1: Array, bend: Array) -> Mask | None:
        """Return the elements (L,) whose step must be shorter, as forces are too nonlinear in it.

        Args:
            h: (L, 1) step sizes in seconds.
            k1: (L, D) accelerations at the beginning.
            bend: (L, D) six times the nonlinearity (7).

        Returns:
            Elements (L,) to repeat with a shorter step; None if there are none.
        """
        field = self._field
        # Squares are compared, which avoids a root for each element; `bend` is six times (7).
        self._peak = np.maximum(self._peak, dot(k1, k1))
        most_bent = (6.0 * FORCE_NONLINEARITY_TOLERANCE) ** 2 * self._peak
        sharp = field.pushed & (dot(bend, bend) > most_bent)
        if field.has_dry_friction:
            first, second, third, fourth = self._dynamics.rubs  # at the stages (1) to (4)
            # The nonlinearity is compared with the largest friction so far: the tail of a Stribeck
            # peak, almost zero at speed, is strongly nonlinear in relation to itself.
            rubbed = np.maximum(compute_norm(first), compute_norm(fourth))
            self._rubbed = np.maximum(self._rubbed, rubbed)
            faint = NEGLIGIBLE_ACCELERATION_SHARE * np.sqrt(self._peak) * field.mass
            most = np.maximum(self._rubbed, faint)
            bent = compute_norm(first - second - third + fourth)
            bends = bent > 6.0 * FRICTION_NONLINEARITY_TOLERANCE * most  # (7)
            sharp |= bends & field.rubs & ~self._dynamics.sticks
        any_sharp = sharp.any()
        if any_sharp:
            # A step that leads to an event keeps its length, otherwise the event would be missed.
            sharp &= (h > MIN_STEP_SHARE * self._longest) & self._open[:, None]
        if any_sharp or self._shortened:
            # The limit doubles with each accepted step of that length, as the nonlinearity may
            # still be near.
            grown = np.where(h >= self._limit, 2.0 * self._limit, self._limit)
            grown = np.minimum(grown, self._longest)
            self._limit = np.where(sharp, STEP_REDUCTION_FACTOR * h, grown)
            self._shortened = bool((self._limit < self._longest).any())
        return sharp[:, 0] if any_sharp else None

    def _interrupted(
        self,
        h: Array,
        now: tuple[Array, Array, Array],
        then: tuple[Array, Array, Array],
        refused: Mask | None,
    ) -> Mask | None:
        """Return the elements (L,) with an event within the step, and schedule these events.

        Args:
            h: (L, 1) step sizes in seconds.
            now: position, velocity and acceleration before the step.
            then: position, velocity and acceleration after the step.
            refused: (L,) elements whose step is already rejected.

        Returns:
            Elements (L,) with an event; None if there are none.
        """
        watched = self._open if refused is None else self._open & ~refused
        result = None
        if self._ground is not None:
            hit = (then[0][:, -1] < self._ground.floor[:, 0]) & watched
            if hit.any():
                seconds = self._impacts(np.flatnonzero(hit), h, now, then)
                self._await(hit, h, seconds, IMPACT)
                result = hit
        if self._field.has_dry_friction:
            dynamics = self._dynamics
            moves = (watched[:, None] & self._field.rubs & ~dynamics.sticks)[:, 0]
            turned = moves & (dot(then[1], dynamics.way) < 0)[:, 0]
            if turned.any():
                seconds = self._standstills(np.flatnonzero(turned), h, now, then)
                self._await(turned, h, seconds, STANDSTILL)
                result = turned if result is None else result | turned
            # An element with scheduled break-away is checked again with a tolerance: the excess is
            # nonlinear within the step, and its root is that of a straight line.
            before, after = dynamics.excess
            to_loose = self._goal == BREAK_AWAY
            late = np.where(to_loose, BREAK_AWAY_TIME_TOLERANCE, 0.0)[:, None] * (after - before)
            loose = (dynamics.sticks & (after > late))[:, 0] & (watched | to_loose)
            if loose.any():
                seconds = self._loosenings(np.flatnonzero(loose), h)
                self._await(loose, h, seconds, BREAK_AWAY)
                result = loose if result is None else result | loose
        return result

    def _impacts(
        self, i: Indices, h: Array, now: tuple[Array, ...], then: tuple[Array, ...]
    ) -> Array:
        """Return the seconds (n,) to the impacts of elements i (n,)."""
        assert self._ground is not None
        floor = self._ground.floor[i, 0]
        height = now[0][i, -1] - floor
        rate = now[1][i, -1]
        later = then[0][i, -1] - floor
        return find_event_time(height, rate, later, h[i, 0])

    def _standstills(
        self, i: Indices, h: Array, now: tuple[Array, ...], then: tuple[Array, ...]
    ) -> Array:
        """Return the seconds (n,) until elements i (n,) lose their speed along their direction."""
        way = self._dynamics.way[i]
        speed = dot(now[1][i], way)[:, 0]
        rate = dot(now[2][i], way)[:, 0]
        later = dot(then[1][i], way)[:, 0]
        return find_event_time(speed, rate, later, h[i, 0])

    def _loosenings(self, i: Indices, h: Array) -> Array:
        """Return the seconds (n,) until the forces on elements i (n,) exceed dry friction.

        The time is slightly later, so that the force certainly exceeds it.
        """
        before, after = (excess[i, 0] for excess in self._dynamics.excess)
        # Root of the straight line, plus a tenth of the tolerance.
        result: Array = h[i, 0] * (before / (before - after) + 0.1 * BREAK_AWAY_TIME_TOLERANCE)
        return result

    def _await(self, lanes: Mask, h: Array, seconds: Array, goal: int) -> None:
        """Schedule an event at the end of the next steps; of two events the first counts.

        Args:
            lanes: (L,) elements with the event.
            h: (L, 1) step sizes in seconds.
            seconds: (n,) seconds to the event.
            goal: kind of event.
        """
        i = np.flatnonzero(lanes)
        first = seconds < self._try[i, 0]
        i = i[first]
        seconds = seconds[first]
        self._try[i, 0] = np.clip(seconds, 0.0, h[i, 0])
        self._goal[i] = goal
        self._events[i] += 1
        self._open[i] = False
        self._awaits = True

    def _reach(self, refused: Mask | None, k4: Array) -> None:
        """Apply the scheduled events of the elements whose step was accepted."""
        there = np.isfinite(self._try[:, 0])
        if refused is not None:
            there &= ~refused
        if not there.any():
            return
        # Break-away needs no action: the next `begin` finds that the element slips.
        struck = np.flatnonzero(there & (self._goal == IMPACT))
        stopped = np.flatnonzero(there & (self._goal == STANDSTILL))
        if struck.size:
            self._strike(struck, k4[struck])
        if stopped.size:
            self._stop(stopped, k4[stopped])
        self._try[there] = np.inf
        self._goal[there] = NO_EVENT
        self._awaits = bool(np.isfinite(self._try).any())

    def _strike(self, i: Indices, a: Array) -> None:
        """Apply impacts to elements i (n,) whose steps end there up to rounding.

        Args:
            i: (n,) indices of the elements.
            a: (n, D) accelerations before the impact.
        """
        assert self._ground is not None
        x = self._x[i]
        v = self._v[i]
        floor = self._ground.floor[i]
        rate = v[:, -1:]
        late = np.where(rate < 0, (floor - x[:, -1:]) / rate, 0.0)
        falling = np.where(rate < 0, rate, 1.0)
        late *= 1.0 - 0.5 * late * a[:, -1:] / falling  # (8)
        late = self._rounding(i, late)
        x = x + late * (v + 0.5 * late * a)
        v = v + late * a
        self._clock.shift_time(i, late)
        # Exactly on the ground and not moving up, otherwise the next step would contain the same
        # impact.
        x[:, -1:] = floor
        v[:, -1:] = np.minimum(v[:, -1:], 0.0)
        outcome = self._ground.resolve_impacts(i, v, a)
        self._x[i] = x
        self._v[i] = outcome.v
        if outcome.is_resting.any():
            self._dynamics.set_resting(i[outcome.is_resting])

    def _rounding(self, i: Indices, seconds: Array) -> Array:
        """Return time corrections (n, 1) of elements i (n,), limited to one step.

        For an element that is almost at rest, the unlimited correction is meaningless.
        """
        step = self._longest[i]
        bounded: Array = np.clip(np.nan_to_num(seconds), -step, step)
        return bounded

    def _stop(self, i: Indices, a: Array) -> None:
        """Stop elements i (n,) that have lost their speed along their direction, up to rounding.

        Args:
            i: (n,) indices of the elements.
            a: (n, D) accelerations before.
        """
        v = self._v[i]
        way = self._dynamics.way[i]
        slows = dot(a, way)
        late = np.where(slows < 0, -dot(v, way) / slows, 0.0)
        late = self._rounding(i, late)
        self._x[i] += late * v
        self._clock.shift_time(i, late)
        v = v + late * a
        v = v - way * dot(v, way)
        # The speed becomes exactly zero, because only an element with zero speed can stick.
        faint = REST_SPEED_SHARE * self._dynamics.compute_speed(a) * self._longest[i]
        self._v[i] = self._dynamics.zero_small_velocities(v, faint)

    def _start_on(self, ground: GroundContact) -> None:
        """Apply ground contact at the initial state.

        Elements that start inside the ground are moved to its surface; those that do not move up
        have an impact or rest.
        """
        self._x[:, -1:] = np.maximum(self._x[:, -1:], ground.floor)
        height = self._x[:, -1]
        rate = self._v[:, -1]
        down = (height <= ground.floor[:, 0]) & (rate <= 0)
        if down.any():
            a = self._dynamics.begin_step(self._clock.t, self._x, self._v)
            # Both groups are determined before the impacts, after which a struck element may have
            # zero speed.
            struck = np.flatnonzero(down & (rate < 0))
            lying = np.flatnonzero(down & (rate == 0))
            if struck.size:
                self._strike(struck, a[struck])
            self._dynamics.set_resting(lying)
