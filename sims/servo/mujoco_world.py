"""The servo's world in MuJoCo: the pendulum's, its inertia being armature + mass length^2."""

from sims.pendulum.mujoco_world import gravity, load, model

__all__ = ["OPEN_LOOP", "gravity", "load", "model"]

OPEN_LOOP = False
"""The motor's torque depends on angle and rate."""
