"""World of the servo in Bullet: the pendulum's, with inertia armature + mass length^2."""

from sims.systems.pendulum_bullet_world import build, gravity, load

__all__ = ["OPEN_LOOP", "build", "gravity", "load"]

OPEN_LOOP = False
"""True if the torque depends on the input alone; the motor's also depends on angle and rate."""
