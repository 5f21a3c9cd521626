"""What a filmed scene looks like: light, colours, noise and compression, drawn by seed."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

from sims.base import Array, frozen

_CONTRAST = 0.3
"""Least difference between ball and ground in some colour, of 1; a ball like its ground cannot be
seen by anyone.
"""
_WAVES = 6
"""Waves of which the ground's pattern is the sum."""
_LOWEST = np.pi / 6
"""rad above the ground, of the light: 30 degrees."""
_HIGHEST = np.pi / 2.25
"""rad above the ground, of the light: 80 degrees."""
_BALL_VALUE = (0.15, 1.0)
"""Brightness of balls, of 1: any but black."""


@dataclass(frozen=True)
class Look:
    """The look of a scene; colours are red, green, blue from 0 to 1.

    Attributes:
        light: unit vector (3,) towards the light.
        ball: colour of the ball.
        ground: colour of the ground.
        sky: colour above the horizon.
        waves: the ground's pattern, rows of (wave vector x, y in rad/m, phase, amplitude as a share
            of brightness).
        shadow: share of the light that the ball's shadow takes away.
        noise: of the camera, 1 sigma in grey levels of 255.
        crf: compression, the encoder's constant rate factor: 0 loses nothing, above 30 it is
            coarse.
    """

    light: Array
    ball: tuple[float, float, float]
    ground: tuple[float, float, float]
    sky: tuple[float, float, float]
    waves: Array
    shadow: float = 0.4
    noise: float = 1.0
    crf: int = 20

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Look:
        """A look by chance: light 30 to 80 degrees above the ground, any colours that can be told
        apart.
        """
        # the order of the draws is part of what a seed means
        azimuth = rng.uniform(0, 2 * np.pi)
        above = rng.uniform(_LOWEST, _HIGHEST)
        flat = np.cos(above)
        light = [
            flat * np.cos(azimuth),
            flat * np.sin(azimuth),
            np.sin(above),
        ]
        ground = _colour(rng, saturation=(0.0, 0.4), value=(0.3, 0.85))
        ball = _colour(rng, saturation=(0.0, 1.0), value=_BALL_VALUE)
        while np.max(np.abs(np.subtract(ball, ground))) < _CONTRAST:
            ball = _colour(rng, saturation=(0.0, 1.0), value=_BALL_VALUE)
        sky = _colour(rng, saturation=(0.0, 0.3), value=(0.7, 1.0))
        turn = 2 * np.pi
        bearing = rng.uniform(0, turn, _WAVES)
        length = rng.uniform(0.5, 6.0, _WAVES)
        phase = rng.uniform(0, turn, _WAVES)
        amplitude = rng.uniform(0.0, 0.04, _WAVES)
        across = length * np.cos(bearing)
        along = length * np.sin(bearing)
        waves = np.stack([across, along, phase, amplitude], axis=1)
        return cls(
            frozen(light),
            ball,
            ground,
            sky,
            frozen(waves),
            shadow=rng.uniform(0.2, 0.6),
            noise=rng.uniform(0.5, 2.5),
            crf=int(rng.integers(14, 24)),
        )

    def pattern(self, x: Array, y: Array) -> Array:
        """Brightness of the ground at (x, y), 1 on average, of the arguments' shape."""
        bright = np.ones_like(x)
        for kx, ky, phase, amplitude in self.waves:
            bright += amplitude * np.sin(kx * x + ky * y + phase)
        return bright


def _colour(
    rng: np.random.Generator,
    saturation: tuple[float, float],
    value: tuple[float, float],
) -> tuple[float, float, float]:
    """Any hue, with saturation and value from these ranges."""
    return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(*saturation), rng.uniform(*value))
