"""Coefficients of hidden causes as functions of a strength.

`draw_effect_shape` draws the shape of a cause at random and returns the function from strength to
coefficients. Strength 1 is the upper end of the plausible range, whose bounds are those of the
effect library. `find_coefficients` searches the strength at which the cause has a given size.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from bench.diagnosis_benchmark.case_generation import refitted_residuals
from bench.diagnosis_benchmark.case_generation.recording_conditions import (
    MAX_RUNS,
    SIMULATORS,
    RecordingConditions,
)
from bench.diagnosis_benchmark.case_generation.reference_simulation import (
    simulate_causes,
    simulate_observations,
)
from bench.diagnosis_benchmark.case_generation.strength_search import find_strength_for_size
from sims import effects as library
from sims.core.simulator import Array
from sims.systems.servo import Servo

CoefficientFunction = Callable[[float], tuple[float, ...]]
"""Function from strength to coefficients."""

SIGNED_EFFECTS = (
    "force.bias",
    "gravity.scale",
    "input.gain",
    "input.bias",
    "sensor.gain",
    "sensor.bias",
    "sensor.drift",
    "clock.skew",
    "spring.cubic",
    "restitution.speed",
)
"""Effects whose sign is drawn."""

MAX_STRENGTH = 2.0
"""Maximum strength: twice the plausible range."""


class BaseMotion:
    """Scales of the motion without hidden causes, from which shapes are drawn."""

    def __init__(self, setting: RecordingConditions) -> None:
        """Keep the conditions; the motion is simulated when a scale of it is needed."""
        self.setting, self.system = setting, setting.system
        self.rate, self.seconds, self.scenarios = setting.rate, setting.seconds, setting.scenarios

    @cached_property
    def peak(self) -> float:
        """Largest absolute value of the input."""
        return float(max(np.abs(s.inputs["u"]).max() for s in self.scenarios))

    @cached_property
    def paths(self) -> Array:
        """Noise-free motion: the first channel of every run, (R, T)."""
        return simulate_observations(self.setting, {})[:, :, 0]

    @property
    def path(self) -> Array:
        """Positions of all runs, (R T,)."""
        return np.concatenate(self.paths)

    @property
    def travel(self) -> float:
        """Median travel of a run."""
        return float(np.median([np.ptp(path) for path in self.paths]))

    @property
    def speed(self) -> float:
        """Median absolute speed, by finite differences."""
        speeds = np.concatenate([np.diff(path) for path in self.paths]) * self.rate
        return float(np.median(np.abs(speeds)))


def find_coefficients(
    name: str, setting: RecordingConditions, target_size: float, rng: np.random.Generator
) -> tuple[float, ...] | None:
    """Find coefficients of a hidden cause at which the residual has the requested size.

    Args:
        name: name of the effect or unmodelled cause.
        setting: recording conditions.
        target_size: size in units of the noise.
        rng: random generator for the shape of the cause.

    Returns:
        Coefficients, or None if no strength up to the maximum gives this size.
    """
    # The shape (sign, direction, period) is drawn; the strength that scales it is searched.
    compute_coefficients = draw_effect_shape(name, setting, rng)
    compute_residual = refitted_residuals.make_gap_function(
        setting, lambda strength: simulate_causes(setting, {name: compute_coefficients(strength)})
    )
    strength_and_size = find_strength_for_size(
        compute_residual, target_size, get_max_strength(name)
    )
    if strength_and_size is None:
        return None
    strength, _ = strength_and_size
    return compute_coefficients(strength)


def draw_effect_shape(
    name: str, setting: RecordingConditions, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw the shape of an effect or unmodelled cause: everything except its strength.

    The shape is the sign, direction, period, speed or time constant. The strength stays free, so
    that `refitted_residuals` can find the one that gives the requested size.

    Args:
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.
        setting: recording conditions.
        rng: random generator.

    Returns:
        Coefficients as a function of the strength.
    """
    # A gust of a ball differs from one of a pendulum or slider, so the key contains this, too.
    if (unmodelled_cause := (setting.system == "ball", name)) in UNMODELLED_SAMPLERS:
        return UNMODELLED_SAMPLERS[unmodelled_cause](BaseMotion(setting), rng)
    kind = SIMULATORS[setting.system].system.kind
    # Strength 1 is the end of the plausible range of the first coefficient.
    coefficient_scale = max(
        abs(bound) for bound in library.get_effect(name).coefficients[0].range(kind)
    )
    if name in SHAPE_SAMPLERS:
        return SHAPE_SAMPLERS[name](coefficient_scale, BaseMotion(setting), rng)
    sign = float(rng.choice([-1, 1])) if name in SIGNED_EFFECTS else 1.0
    return lambda strength: (sign * coefficient_scale * strength,)


def get_max_strength(name: str) -> float:
    """Return the maximum strength of an effect: the largest value that the sizing may try.

    For most effects it is twice the plausible range. A saturation above strength 0.97 would remove
    almost the whole input; `input.hold` is a share of linear interpolation, at most 1.
    """
    return {"input.saturation": 0.97, "input.hold": 1.0}.get(name, MAX_STRENGTH)


def list_coefficient_names(system: str, name: str) -> list[str]:
    """List the names of an effect's coefficients, in the order of the numbers in a case.

    They may depend on the system, as the number of directions does; those of the robot arm arm2
    do not.

    Args:
        system: name of the system, such as ``pendulum``.
        name: name of the effect, with or without a place, as ``friction.coulomb@elbow``.
    """
    effect = library.get_effect(name.partition("@")[0])
    if system == "arm2":
        return [coefficient.name for coefficient in effect.coefficients]
    system_model = Servo.system if system == "servo" else SIMULATORS[system].system
    # `on` gives the coefficients that the effect has on this system.
    return [coefficient.name for coefficient in effect.on(system_model)]


def draw_direction(
    coefficient_scale: float,
    motion: BaseMotion,
    rng: np.random.Generator,
    *further_coefficients: float,
) -> CoefficientFunction:
    """Draw the angle of an effect with two components: a horizontal direction, or a phase.

    Args:
        coefficient_scale: magnitude at strength 1.
        motion: unused; all samplers of shapes have the same arguments.
        rng: random generator.
        *further_coefficients: coefficients that do not depend on the strength, such as a
            period.

    Returns:
        Function from the strength s to the coefficients: s times the scale times cosine and sine of
        the angle, then the further coefficients.
    """
    angle = rng.uniform(0, 2 * np.pi)
    cosine_part = coefficient_scale * float(np.cos(angle))
    sine_part = coefficient_scale * float(np.sin(angle))
    return lambda strength: (cosine_part * strength, sine_part * strength, *further_coefficients)


def _draw_horizontal_direction(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw a horizontal direction: along x, and along y if the system has it.

    Args:
        coefficient_scale: magnitude at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to the components along x and y, or along x alone.
    """
    if motion.system == "ball":
        return draw_direction(coefficient_scale, motion, rng)
    sign = float(rng.choice([-1, 1]))
    return lambda strength: (sign * coefficient_scale * strength,)


def _draw_ripple(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw a ripple whose period the motion passes several times.

    A ripple is a force that is periodic in the position. The period is at most 1 m for a slider and
    6.28 rad for a pendulum.

    Args:
        coefficient_scale: amplitude at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to sine amplitude, cosine amplitude and period.
    """
    travel = motion.travel
    period = min(travel / rng.uniform(2.0, 8.0), 1.0 if motion.system == "slider" else 6.28)
    return draw_direction(coefficient_scale, motion, rng, float(period))


def _draw_periodic_force(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw a periodic force with at least 1.5 periods in a run.

    The frequency is drawn log-uniformly up to 4 Hz.

    Args:
        coefficient_scale: amplitude at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to sine amplitude, cosine amplitude and frequency.
    """
    low, high = 1.5 / motion.seconds, 4.0
    frequency = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    return draw_direction(coefficient_scale, motion, rng, frequency)  # the direction is the phase


def _draw_wind(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw quadratic drag in moving air: the air velocity is fixed, the drag grows with s.

    The air moves along the rail of a slider at 0.3 to 2 m/s in either direction, otherwise in any
    horizontal direction at 2 to 8 m/s.

    Args:
        coefficient_scale: drag coefficient at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength s to the drag coefficient and the air velocity, m/s.
    """
    if motion.system == "slider":
        speed = float(rng.choice([-1, 1]) * rng.uniform(0.3, 2.0))
        return lambda strength: (coefficient_scale * strength, speed)
    speed, angle = rng.uniform(2.0, 8.0), rng.uniform(0, 2 * np.pi)
    return lambda strength: (
        coefficient_scale * strength,
        float(speed * np.cos(angle)),
        float(speed * np.sin(angle)),
    )


def _draw_stribeck(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw Stribeck friction with a large static part, at speeds that often occur in the motion.

    The friction at rest is 3 to 7 times the Coulomb friction, and the Stribeck speed is 0.15 to 0.5
    of the median speed.

    Args:
        coefficient_scale: Coulomb friction at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to Coulomb friction, additional friction at rest, and Stribeck
        speed.
    """
    # The static part is added to the Coulomb friction: its factor is 3 to 7 less 1.
    extra = rng.uniform(2.0, 6.0)
    speed = float(np.clip(motion.speed * rng.uniform(0.15, 0.5), 0.02, 2.0))  # m/s or rad/s
    return lambda strength: (
        coefficient_scale * strength,
        extra * coefficient_scale * strength,
        speed,
    )


def _draw_saturation(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Return an input limit: at strength 0 the peak of the input, at strength 1 zero.

    The effect vanishes at strength 0, because the input never exceeds its own peak.

    Args:
        coefficient_scale: unused, as `rng`: all samplers of shapes have the same arguments.
        motion: motion without hidden causes.
        rng: unused.

    Returns:
        Function from the strength to the limit.
    """
    peak = motion.peak
    return lambda strength: (float(peak * (1 - strength)),)


def _draw_direction_dependent_friction(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw friction that is several times larger in one direction.

    Args:
        coefficient_scale: coefficient of the larger direction at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to the coefficients of both directions.
    """
    shares = [1.0, float(rng.uniform(0.0, 0.3))]
    rng.shuffle(shares)  # either direction may be the one with more friction
    forward, backward = shares
    return lambda strength: (
        coefficient_scale * forward * strength,
        coefficient_scale * backward * strength,
    )


def _draw_power_law(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Return a power law of the input that keeps the peak of the input unchanged.

    The effect multiplies the input u by (1 + gain) |u|^s, with the strength s as power. The gain
    is peak^-s - 1, because then the factor is 1 for |u| = peak.

    Args:
        coefficient_scale: unused, as `rng`: all samplers of shapes have the same arguments.
        motion: motion without hidden causes.
        rng: unused.

    Returns:
        Function from the strength to gain and power.
    """
    peak = motion.peak
    return lambda strength: (float(peak**-strength - 1), strength)


def _draw_rate_limit(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Return a rate limit: a jump to the input's peak takes 0.8 s times the strength.

    Args:
        coefficient_scale: unused, as `rng`: all samplers of shapes have the same arguments.
        motion: motion without hidden causes.
        rng: unused.

    Returns:
        Function from the strength to the maximum rate of the input.
    """
    peak = motion.peak
    return lambda strength: (float(peak / (0.8 * strength)),)


def _draw_quadratic_friction(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw friction whose quadratic part exceeds the linear one at the peak force.

    It is friction that depends on the transmitted load.

    Args:
        coefficient_scale: end of the plausible range of the linear coefficient, which is half of it
            at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to the linear and the quadratic coefficient.
    """
    peak = motion.peak
    square = float(coefficient_scale * rng.uniform(2.0, 6.0) / peak)
    return lambda strength: (0.5 * coefficient_scale * strength, square * strength)


def _draw_position_friction(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw position-dependent friction whose period the motion passes one to four times.

    The periodic part is half to almost all of the friction, with a random phase.

    Args:
        coefficient_scale: friction at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to constant part, sine and cosine amplitude, and period.
    """
    travel = motion.travel
    # Range of the period, in m for the slider and in rad otherwise.
    low, high = (0.2, 5.0) if motion.system == "slider" else (0.5, 6.2832)
    period = float(np.clip(travel / rng.uniform(1.0, 4.0), low, high))
    angle, share = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 0.95)
    sine = coefficient_scale * share * float(np.sin(angle))
    cosine = coefficient_scale * share * float(np.cos(angle))
    return lambda strength: (
        coefficient_scale * (1 - share) * strength,
        sine * strength,
        cosine * strength,
        period,
    )


def _draw_warm_up_friction(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw warm-up friction, partly viscous, which is largest at the beginning of a run.

    It decays exponentially, with a time constant of 0.2 to 0.8 run lengths but at least 0.5 s.

    Args:
        coefficient_scale: Coulomb friction at the begin, at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to Coulomb friction, viscous friction and time constant.
    """
    time_constant = max(float(motion.seconds * rng.uniform(0.2, 0.8)), 0.5)
    # At the median speed, the viscous part is at most as large as the Coulomb friction.
    viscous = float(coefficient_scale * rng.uniform(0.0, 1.0) / motion.speed)
    return lambda strength: (coefficient_scale * strength, viscous * strength, time_constant)


def _draw_sensor_slip(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw a sensor slip at a time well within each run.

    From that time on, the reading is shifted by a constant.

    Args:
        coefficient_scale: shift at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to shift and time, s.
    """
    # The slip happens between 15 and 85 % of the run.
    sign, instant = float(rng.choice([-1, 1])), float(rng.uniform(0.15, 0.85) * motion.seconds)
    return lambda strength: (sign * coefficient_scale * strength, instant)


def _draw_flexible_load(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw a flexible load: from four oscillations per run to a fifth of the sampling rate.

    The frequency and the damping ratio are drawn log-uniformly.

    Args:
        coefficient_scale: share of the load at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to share of the load, frequency in rad/s, and damping ratio.
    """
    # Lowest and highest angular frequency in rad/s; at most 40 Hz.
    low, high = 2 * np.pi * 4 / motion.seconds, 2 * np.pi * min(0.2 * motion.rate, 40.0)
    frequency = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    # Damping ratio, 1 to 30 %.
    ratio = float(np.exp(rng.uniform(np.log(0.01), np.log(0.3))))
    # The load has at most 95 % of the inertia.
    return lambda strength: (
        min(coefficient_scale * strength, 0.95),
        float(np.clip(frequency, 6, 300)),
        ratio,
    )


def _draw_backlash(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw backlash between drive and load: at strength 1 the gap is 0.3 of the travel.

    Args:
        coefficient_scale: unused; all samplers of shapes have the same arguments.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to the gap and the fraction of the inertia that is the load's.
    """
    share, travel = float(rng.uniform(0.2, 0.8)), motion.travel
    return lambda strength: (0.3 * travel * strength, share)


def _draw_hysteresis(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw hysteresis with a deflection of 0.02 to 0.2 of the travel.

    The deflection is the distance over which friction builds up after a reversal.

    Args:
        coefficient_scale: friction limit at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to friction limit and deflection.
    """
    travel = motion.travel
    deflection = float(travel * np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    return lambda strength: (coefficient_scale * strength, deflection)


def _draw_end_stop(
    coefficient_scale: float, motion: BaseMotion, rng: np.random.Generator
) -> CoefficientFunction:
    """Draw an end stop near an end of the travel: 5 to 20 % of the samples are beyond it.

    Args:
        coefficient_scale: stiffness at strength 1.
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to stiffness (its sign is the side of the stop), position, and
        loss: the damping as a factor of the approach velocity.
    """
    side, share_beyond = float(rng.choice([-1, 1])), float(rng.uniform(0.05, 0.2))
    stop_quantile = 1 - share_beyond if side > 0 else share_beyond
    stop_position = float(np.quantile(motion.path, stop_quantile))
    # Loss of the stop: relative increase of its force per unit of speed, in s/m or s/rad.
    loss = float(rng.uniform(0.0, 0.4)) / (5.0 if motion.system == "pendulum" else 1.0)
    return lambda strength: (side * coefficient_scale * strength, stop_position, loss)


SHAPE_SAMPLERS: dict[str, Callable[..., CoefficientFunction]] = {
    "state.limit": _draw_end_stop,
    "sensor.slip": _draw_sensor_slip,
    "friction.hysteresis": _draw_hysteresis,
    "joint.backlash": _draw_backlash,
    "joint.flexibility": _draw_flexible_load,
    "friction.direction": _draw_direction_dependent_friction,
    "friction.load_direction": _draw_direction_dependent_friction,
    "friction.load_quadratic": _draw_quadratic_friction,
    "friction.position": _draw_position_friction,
    "friction.warming": _draw_warm_up_friction,
    "input.power": _draw_power_law,
    "input.rate": _draw_rate_limit,
    "sensor.eccentricity": draw_direction,
    "gravity.tilt": _draw_horizontal_direction,
    "lift.magnus": draw_direction,
    "force.ripple": _draw_ripple,
    "force.periodic": _draw_periodic_force,
    "wind": _draw_wind,
    "friction.stribeck": _draw_stribeck,
    "input.saturation": _draw_saturation,
}


def _draw_onsets(motion: BaseMotion, duration: float, rng: np.random.Generator) -> list[float]:
    """Draw the time at which a gust begins in each run, s; always `MAX_RUNS` numbers.

    The strength is found from the runs for fitting, but the recording has held-out runs too. A
    begin for every possible run serves both.

    Args:
        motion: scales of the motion without hidden causes.
        duration: duration of the gust, s.
        rng: random numbers of the case.
    """
    return [float(rng.uniform(0.1, 0.9) * (motion.seconds - duration)) for _ in range(MAX_RUNS)]


def _draw_friction_patch(motion: BaseMotion, rng: np.random.Generator) -> CoefficientFunction:
    """Draw a region of dry friction, 0.14 to 0.3 of the central 80 % of positions wide.

    Args:
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to friction limit, centre and half width of the region.
    """
    # The region covers 14 to 30 % of the central 80 % of the path.
    low, high = np.quantile(motion.path, [0.1, 0.9])
    half_width = float((high - low) * rng.uniform(0.07, 0.15))
    centre = float(rng.uniform(low + half_width, high - half_width))
    return lambda strength: (_get_unit_force(motion) * strength, centre, half_width)


def _get_unit_force(motion: BaseMotion) -> float:
    """Return the force of an unmodelled cause at strength 1: N m for a pendulum, N for a slider."""
    return 0.5 if motion.system == "pendulum" else 5.0


def _draw_gust(motion: BaseMotion, rng: np.random.Generator) -> CoefficientFunction:
    """Draw a temporary force of 0.1 to 0.3 s in each run, in either direction.

    Args:
        motion: scales of the motion without hidden causes.
        rng: random numbers of the case.

    Returns:
        Function from the strength to force, duration (s), and the begin in each run (s).
    """
    duration, sign = float(rng.uniform(0.1, 0.3)), float(rng.choice([-1, 1]))
    start_times = _draw_onsets(motion, duration, rng)
    return lambda strength: (sign * _get_unit_force(motion) * strength, duration, *start_times)


def _draw_growing_damping(motion: BaseMotion, rng: np.random.Generator) -> CoefficientFunction:
    """Draw damping that grows in proportion to time, up to a value at the end of the run.

    At strength 1 this value is 0.1 N m s/rad for a pendulum and 5 N s/m for a slider.

    Args:
        motion: scales of the motion without hidden causes.
        rng: unused; all samplers have the same arguments.

    Returns:
        Function from the strength to the growth of the damping per second.
    """
    max_growth = (0.1 if motion.system == "pendulum" else 5.0) / motion.seconds
    return lambda strength: (max_growth * strength,)


def _draw_soft_stop(motion: BaseMotion, rng: np.random.Generator) -> CoefficientFunction:
    """Draw a soft stop: a spring beyond a position that 15 to 30 % of the samples pass.

    It is the unmodelled cause `latch`, which the simulation lets act in every other run only.

    Args:
        motion: motion without hidden causes.
        rng: random generator.

    Returns:
        Function from the strength to stiffness (N m/rad or N/m) and position.
    """
    # The stop begins at the 70 to 85 % quantile of the path.
    position = float(np.quantile(motion.path, rng.uniform(0.7, 0.85)))
    # Stiffness at strength 1, in N m/rad for the pendulum and in N/m for the slider.
    max_stiffness = 10.0 if motion.system == "pendulum" else 2000.0
    return lambda strength: (max_stiffness * strength, position)


def _draw_updraft(motion: BaseMotion, rng: np.random.Generator) -> CoefficientFunction:
    """Draw a region of rising air that the balls pass; at strength 1 it accelerates by 10 m/s^2.

    Args:
        motion: scales of the motion without hidden causes.
        rng: random numbers of the case.

    Returns:
        Function from the strength to acceleration (m/s^2), centre and half width of the region (m).
        The centre lies between the 10 % and 90 % quantiles of x over all runs.
    """
    positions = motion.path
    # Half width of the column of rising air, in m.
    half_width = float(rng.uniform(0.3, 0.8))
    centre = float(rng.uniform(*np.quantile(positions, [0.1, 0.9])))
    return lambda strength: (10.0 * strength, centre, half_width)


def _draw_ball_gust(motion: BaseMotion, rng: np.random.Generator) -> CoefficientFunction:
    """Draw a gust of 0.1 to 0.4 s in each run; at strength 1 it accelerates the ball by 20 m/s^2.

    Its direction is drawn in the vertical plane along x.

    Args:
        motion: scales of the motion without hidden causes.
        rng: random numbers of the case.

    Returns:
        Function from the strength to acceleration along x, upward acceleration (m/s^2), duration
        (s), and the begin in each run (s).
    """
    duration, angle = float(rng.uniform(0.1, 0.4)), rng.uniform(0, 2 * np.pi)
    start_times = _draw_onsets(motion, duration, rng)
    return lambda strength: (
        20.0 * strength * float(np.cos(angle)),
        20.0 * strength * float(np.sin(angle)),
        duration,
        *start_times,
    )


def _draw_changing_restitution(motion: BaseMotion, rng: np.random.Generator) -> CoefficientFunction:
    """Draw restitution that changes linearly with time: at strength 1 by all its value in a run.

    Args:
        motion: scales of the motion without hidden causes.
        rng: random numbers of the case.

    Returns:
        Function from the strength to the rate c of the law e0 (1 - c t), 1/s, of either sign.
    """
    sign = float(rng.choice([-1, 1]))
    return lambda strength: (sign * strength / motion.seconds,)


def _draw_drag_layer(motion: BaseMotion, rng: np.random.Generator) -> CoefficientFunction:
    """Draw a height above most bounces and below most drops, from which drag acts.

    Args:
        motion: scales of the motion without hidden causes.
        rng: random numbers of the case.

    Returns:
        Function from the strength to the drag coefficient and the height (m) above which drag acts.
    """
    # The layer ends at 55 to 80 % of the lowest height of release.
    height = float(min(s.initial["z"] for s in motion.scenarios) * rng.uniform(0.55, 0.8))
    return lambda strength: (2.0 * strength, height)


UNMODELLED_SAMPLERS: dict[tuple[bool, str], Callable[..., CoefficientFunction]] = {
    (False, "patch"): _draw_friction_patch,
    (False, "gust"): _draw_gust,
    (False, "ageing"): _draw_growing_damping,
    (False, "latch"): _draw_soft_stop,
    (True, "updraft"): _draw_updraft,
    (True, "gust"): _draw_ball_gust,
    (True, "wear"): _draw_changing_restitution,
    (True, "layer"): _draw_drag_layer,
}
