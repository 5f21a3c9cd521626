"""World of the servo in MuJoCo: the pendulum's, with inertia armature + mass length^2."""

from sims.systems.pendulum_mujoco_world import gravity, load, model

__all__ = ["gravity", "load", "model"]
