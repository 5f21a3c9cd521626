"""Random appearance of a filmed scene: light, colours, noise and compression."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

from sims.core.simulator import Array, make_read_only

_MIN_CONTRAST = 0.3
"""Minimum difference between ball and ground in some colour, on a scale from 0 to 1."""
_WAVE_COUNT = 6
"""Number of waves whose sum is the ground's pattern."""
_MIN_LIGHT_ELEVATION = np.pi / 6
"""Minimum elevation of the light, rad (30 degrees)."""
_MAX_LIGHT_ELEVATION = np.pi / 2.25
"""Maximum elevation of the light, rad (80 degrees)."""
_BALL_VALUE = (0.15, 1.0)
"""Range of the brightness of balls, on a scale from 0 to 1; black is excluded."""


@dataclass(frozen=True)
class SceneAppearance:
    """Appearance of a scene; colours are red, green, blue from 0 to 1.

    Attributes:
        light: Unit vector (3,) towards the light.
        ball: Colour of the ball.
        ground: Colour of the ground.
        sky: Colour above the horizon.
        waves: Pattern of the ground, rows of (wave vector x, y in rad/m, phase in rad, amplitude as
            a fraction of brightness).
        shadow: Fraction of the light that the ball's shadow removes.
        noise: Standard deviation of the camera noise, grey levels of 255.
        crf: Constant rate factor of the video encoder: 0 is lossless, above 30 is coarse.
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
    def draw(cls, rng: np.random.Generator) -> SceneAppearance:
        """Draw a random appearance.

        The light is 30 to 80 degrees above the ground, and the colours of ball and ground are
        distinguishable.
        """
        # The order of the draws must not change, because it determines the result of a seed.
        azimuth = rng.uniform(0, 2 * np.pi)
        elevation = rng.uniform(_MIN_LIGHT_ELEVATION, _MAX_LIGHT_ELEVATION)
        horizontal = np.cos(elevation)
        light = [
            horizontal * np.cos(azimuth),
            horizontal * np.sin(azimuth),
            np.sin(elevation),
        ]
        ground = _draw_colour(rng, saturation=(0.0, 0.4), value=(0.3, 0.85))
        ball = _draw_colour(rng, saturation=(0.0, 1.0), value=_BALL_VALUE)
        while np.max(np.abs(np.subtract(ball, ground))) < _MIN_CONTRAST:
            ball = _draw_colour(rng, saturation=(0.0, 1.0), value=_BALL_VALUE)
        sky = _draw_colour(rng, saturation=(0.0, 0.3), value=(0.7, 1.0))
        full_turn = 2 * np.pi
        bearing = rng.uniform(0, full_turn, _WAVE_COUNT)
        wave_number = rng.uniform(0.5, 6.0, _WAVE_COUNT)
        phase = rng.uniform(0, full_turn, _WAVE_COUNT)
        amplitude = rng.uniform(0.0, 0.04, _WAVE_COUNT)
        wave_x = wave_number * np.cos(bearing)
        wave_y = wave_number * np.sin(bearing)
        waves = np.stack([wave_x, wave_y, phase, amplitude], axis=1)
        return cls(
            make_read_only(light),
            ball,
            ground,
            sky,
            make_read_only(waves),
            shadow=rng.uniform(0.2, 0.6),
            noise=rng.uniform(0.5, 2.5),
            crf=int(rng.integers(14, 24)),
        )

    def compute_ground_brightness(self, x: Array, y: Array) -> Array:
        """Return the brightness of the ground at positions (x, y) in m, 1 on average.

        Args:
            x: Positions, any shape.
            y: Positions, of the shape of `x`.
        """
        brightness = np.ones_like(x)
        for kx, ky, phase, amplitude in self.waves:
            brightness += amplitude * np.sin(kx * x + ky * y + phase)
        return brightness


def _draw_colour(
    rng: np.random.Generator,
    saturation: tuple[float, float],
    value: tuple[float, float],
) -> tuple[float, float, float]:
    """Draw a colour with any hue, and with saturation and value in the given ranges."""
    return colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(*saturation), rng.uniform(*value))
