"""World of the servo in MuJoCo: the pendulum's, with inertia armature + mass length^2."""

from sims.systems.pendulum_mujoco_world import gravity, load, model

__all__ = ["OPEN_LOOP", "gravity", "load", "model"]

OPEN_LOOP = False
"""True if the torque depends on the input alone; the motor's also depends on angle and rate."""
