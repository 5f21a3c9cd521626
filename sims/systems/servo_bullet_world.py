"""World of the servo in Bullet: the pendulum's, with inertia armature + mass length^2."""

from sims.systems.pendulum_bullet_world import build, gravity, load

__all__ = ["build", "gravity", "load"]
