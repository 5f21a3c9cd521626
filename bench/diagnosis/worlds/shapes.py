"""Coefficients of hidden causes as functions of a strength.

The shape is drawn at random. The strength s remains free; 1 is the upper end of the plausible
range. The bounds are those of the effect library. `shape(name, setting, rng)` returns the function
from strength to coefficients.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bench.diagnosis.worlds.settings import MOST_RUNS, Setting
from bench.diagnosis.worlds.sizing import observed_by_batch
from bench.diagnosis.worlds.world import SIMULATORS
from sims import effects as library
from sims.base import Array

Shape = Callable[[float], tuple[float, ...]]
"""Function from strength to coefficients."""
SIGNED: tuple[str, ...] = (
    "force.bias",
    "gravity.scale",
    "input.gain",
    "input.bias",
    "sensor.gain",
    "sensor.bias",
    "sensor.drift",
)
SIGNED += ("clock.skew", "spring.cubic", "restitution.speed")
LARGEST = 2.0  # maximum strength: twice the plausible range


def shape(name: str, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw the shape of an effect of the library.

    Args:
        name: name of the effect.
        setting: recording conditions.
        rng: random generator.

    Returns:
        Coefficients as a function of the strength.
    """
    kind = SIMULATORS[setting.system].system.kind
    far = max(abs(bound) for bound in library.get(name).coefficients[0].range(kind))
    if name in SHAPES:
        return SHAPES[name](far, setting, rng)
    sign = float(rng.choice([-1, 1])) if name in SIGNED else 1.0
    return lambda s: (sign * far * s,)


def largest(name: str) -> float:
    """Return the maximum strength of an effect."""
    return {"input.saturation": 0.97, "input.hold": 1.0}.get(name, LARGEST)


def _direction(far: float, setting: Setting, rng: np.random.Generator, *behind: float) -> Shape:
    angle = rng.uniform(0, 2 * np.pi)
    along, across = far * float(np.cos(angle)), far * float(np.sin(angle))
    return lambda s: (along * s, across * s, *behind)


def _level(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw a horizontal direction: along x, and along y if the system has it."""
    if setting.system == "ball":
        return _direction(far, setting, rng)
    sign = float(rng.choice([-1, 1]))
    return lambda s: (sign * far * s,)


def _ripple(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw a ripple whose period the motion passes several times."""
    travel = np.median(_ranges(setting))
    period = min(travel / rng.uniform(2.0, 8.0), 1.0 if setting.system == "slider" else 6.28)
    return _direction(far, setting, rng, float(period))


def _periodic(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw a periodic force with at least 1.5 periods in a run."""
    low, high = 1.5 / setting.seconds, 4.0
    return _direction(far, setting, rng, float(np.exp(rng.uniform(np.log(low), np.log(high)))))


def _wind(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    if setting.system == "slider":
        speed = float(rng.choice([-1, 1]) * rng.uniform(0.3, 2.0))
        return lambda s: (far * s, speed)
    speed, angle = rng.uniform(2.0, 8.0), rng.uniform(0, 2 * np.pi)
    return lambda s: (far * s, float(speed * np.cos(angle)), float(speed * np.sin(angle)))


def _stribeck(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw Stribeck friction with a large static part, at speeds that often occur in the motion."""
    extra, typical = rng.uniform(2.0, 6.0), np.median(np.abs(_speeds(setting)))
    speed = float(np.clip(typical * rng.uniform(0.15, 0.5), 0.02, 2.0))
    return lambda s: (far * s, extra * far * s, speed)


def _saturation(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Return an input limit: at strength 0 the peak of the input, at strength 1 zero."""
    peak = max(np.abs(s.inputs["u"]).max() for s in setting.scenarios)
    return lambda s: (float(peak * (1 - s)),)


def _one_way(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw friction that is several times larger in one direction."""
    shares = [1.0, float(rng.uniform(0.0, 0.3))]
    rng.shuffle(shares)
    return lambda s: (far * shares[0] * s, far * shares[1] * s)


def _power(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Return a power law of the input that keeps the peak of the input unchanged."""
    peak = max(np.abs(s.inputs["u"]).max() for s in setting.scenarios)
    return lambda s: (float(peak**-s - 1), s)


def _rate(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Return a rate limit: a jump to the input's peak takes 0.8 s times the strength."""
    peak = max(np.abs(s.inputs["u"]).max() for s in setting.scenarios)
    return lambda s: (float(peak / (0.8 * s)),)


def _quadratic(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw friction whose quadratic part exceeds the linear one at the peak force."""
    peak = max(np.abs(s.inputs["u"]).max() for s in setting.scenarios)
    square = float(far * rng.uniform(2.0, 6.0) / peak)
    return lambda s: (0.5 * far * s, square * s)


def _uneven(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw position-dependent friction whose period the motion passes one to four times."""
    travel = float(np.median(_ranges(setting)))
    low, high = (0.2, 5.0) if setting.system == "slider" else (0.5, 6.2832)
    period = float(np.clip(travel / rng.uniform(1.0, 4.0), low, high))
    angle, share = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 0.95)
    sine, cosine = far * share * float(np.sin(angle)), far * share * float(np.cos(angle))
    return lambda s: (far * (1 - share) * s, sine * s, cosine * s, period)


def _warming(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw warm-up friction with a time constant of 0.2 to 0.8 run lengths, partly viscous."""
    time = float(setting.seconds * rng.uniform(0.2, 0.8))
    viscous = float(far * rng.uniform(0.0, 1.0) / np.median(np.abs(_speeds(setting))))
    return lambda s: (far * s, viscous * s, max(time, 0.5))


def _slip(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw a sensor slip at a time well within each run."""
    sign, instant = float(rng.choice([-1, 1])), float(rng.uniform(0.15, 0.85) * setting.seconds)
    return lambda s: (sign * far * s, instant)


def _flexibility(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw a flexible load: from four oscillations per run to a fifth of the sampling rate."""
    low, high = 2 * np.pi * 4 / setting.seconds, 2 * np.pi * min(0.2 * setting.rate, 40.0)
    frequency = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    ratio = float(np.exp(rng.uniform(np.log(0.01), np.log(0.3))))
    return lambda s: (min(far * s, 0.95), float(np.clip(frequency, 6, 300)), ratio)


def _play(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw backlash: at strength 1 the gap is 0.3 of the travel."""
    share, travel = float(rng.uniform(0.2, 0.8)), float(np.median(_ranges(setting)))
    return lambda s: (0.3 * travel * s, share)


def _hysteresis(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw hysteresis with a deflection of 0.02 to 0.2 of the travel."""
    travel = float(np.median(_ranges(setting)))
    deflection = float(travel * np.exp(rng.uniform(np.log(0.02), np.log(0.2))))
    return lambda s: (far * s, deflection)


def _stop(far: float, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw an end stop within the travel, near its upper or lower end."""
    side, within = float(rng.choice([-1, 1])), float(rng.uniform(0.05, 0.2))
    place = float(np.quantile(np.concatenate(_bare(setting)), 1 - within if side > 0 else within))
    loss = float(rng.uniform(0.0, 0.4)) / (5.0 if setting.system == "pendulum" else 1.0)
    return lambda s: (side * far * s, place, loss)


SHAPES: dict[str, Callable[..., Shape]] = {
    "state.limit": _stop,
    "sensor.slip": _slip,
    "friction.hysteresis": _hysteresis,
    "joint.backlash": _play,
    "joint.flexibility": _flexibility,
    "friction.direction": _one_way,
    "friction.load_direction": _one_way,
    "friction.load_quadratic": _quadratic,
    "friction.position": _uneven,
    "friction.warming": _warming,
    "input.power": _power,
    "input.rate": _rate,
    "sensor.eccentricity": _direction,
    "gravity.tilt": _level,
    "lift.magnus": _direction,
    "force.ripple": _ripple,
    "force.periodic": _periodic,
    "wind": _wind,
    "friction.stribeck": _stribeck,
    "input.saturation": _saturation,
}


def _bare(setting: Setting) -> list[Array]:
    """Simulate the noise-free motion without hidden causes: the first channel (T,) of every run."""
    return list(observed_by_batch(setting, {})[:, :, 0])


def _ranges(setting: Setting) -> list[float]:
    return [np.ptp(path) for path in _bare(setting)]


def _speeds(setting: Setting) -> Array:
    return np.concatenate([np.diff(path) for path in _bare(setting)]) * setting.rate


def foreign(name: str, setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw the shape of an unmodelled cause; see `bench.diagnosis.worlds.world`.

    Args:
        name: name of the cause.
        setting: recording conditions.
        rng: random generator.

    Returns:
        Numbers of the cause as a function of the strength.
    """
    return FOREIGN[(setting.system == "ball", name)](setting, rng)


def _begins(setting: Setting, lasting: float, rng: np.random.Generator) -> list[float]:
    """Draw a start time for each run, held-out runs included."""
    return [float(rng.uniform(0.1, 0.9) * (setting.seconds - lasting)) for _ in range(MOST_RUNS)]


def _patch(setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw a region of dry friction, 0.14 to 0.3 of the central 80 % of positions wide."""
    low, high = np.quantile(np.concatenate(_bare(setting)), [0.1, 0.9])
    half = float((high - low) * rng.uniform(0.07, 0.15))
    centre = float(rng.uniform(low + half, high - half))
    return lambda s: (_force(setting) * s, centre, half)


def _force(setting: Setting) -> float:
    return 0.5 if setting.system == "pendulum" else 5.0


def _gust(setting: Setting, rng: np.random.Generator) -> Shape:
    lasting, sign = float(rng.uniform(0.1, 0.3)), float(rng.choice([-1, 1]))
    begins = _begins(setting, lasting, rng)
    return lambda s: (sign * _force(setting) * s, lasting, *begins)


def _ageing(setting: Setting, rng: np.random.Generator) -> Shape:
    far = (0.1 if setting.system == "pendulum" else 5.0) / setting.seconds
    return lambda s: (far * s,)


def _latch(setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw a soft stop in every other run, which the motion reaches for a short time."""
    place = float(np.quantile(np.concatenate(_bare(setting)), rng.uniform(0.7, 0.85)))
    far = 10.0 if setting.system == "pendulum" else 2000.0
    return lambda s: (far * s, place)


def _updraft(setting: Setting, rng: np.random.Generator) -> Shape:
    where = np.concatenate(_bare(setting))
    half = float(rng.uniform(0.3, 0.8))
    centre = float(rng.uniform(*np.quantile(where, [0.1, 0.9])))
    return lambda s: (10.0 * s, centre, half)


def _ball_gust(setting: Setting, rng: np.random.Generator) -> Shape:
    lasting, angle = float(rng.uniform(0.1, 0.4)), rng.uniform(0, 2 * np.pi)
    begins = _begins(setting, lasting, rng)
    return lambda s: (
        20.0 * s * float(np.cos(angle)),
        20.0 * s * float(np.sin(angle)),
        lasting,
        *begins,
    )


def _wear(setting: Setting, rng: np.random.Generator) -> Shape:
    sign = float(rng.choice([-1, 1]))
    return lambda s: (sign * s / setting.seconds,)


def _layer(setting: Setting, rng: np.random.Generator) -> Shape:
    """Draw a height above most bounces and below most drops, from which drag acts."""
    height = float(min(s.initial["z"] for s in setting.scenarios) * rng.uniform(0.55, 0.8))
    return lambda s: (2.0 * s, height)


FOREIGN: dict[tuple[bool, str], Callable[..., Shape]] = {
    (False, "patch"): _patch,
    (False, "gust"): _gust,
    (False, "ageing"): _ageing,
    (False, "latch"): _latch,
    (True, "updraft"): _updraft,
    (True, "gust"): _ball_gust,
    (True, "wear"): _wear,
    (True, "layer"): _layer,
}
