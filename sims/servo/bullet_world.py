"""The servo's world in Bullet: the pendulum's, its inertia being armature + mass length^2."""

from sims.pendulum.bullet_world import build, gravity, load

__all__ = ["OPEN_LOOP", "build", "gravity", "load"]

OPEN_LOOP = False
"""The motor's torque depends on angle and rate."""
