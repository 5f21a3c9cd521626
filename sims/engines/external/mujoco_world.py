"""MuJoCo connection: a model compiled for the constants of a system, and a body on a joint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sims.core.mujoco_import import import_mujoco


class CompiledWorld:
    """MuJoCo model and its state, compiled on first use and again when the constants change."""

    def __init__(self, write_model: Callable[[Mapping[str, float]], str]) -> None:
        """Store the function that writes the MJCF; nothing is compiled before the first use.

        Args:
            write_model: function from constants to MJCF.
        """
        self._write_model = write_model
        self._built_for: dict[str, float] | None = None
        self._model: Any = None
        self._data: Any = None

    def __reduce__(self) -> tuple[type[CompiledWorld], tuple[Callable[[Mapping[str, float]], str]]]:
        # A copy of a simulator, in this or in another process, gets its own world.
        return CompiledWorld, (self._write_model,)

    def get_reset_world(self, constants: Mapping[str, float]) -> tuple[Any, Any]:
        """Return model and data in their initial state, for these constants.

        Args:
            constants: Constants of the system; a new model is compiled if they have changed.

        Returns:
            `MjModel` and `MjData`.
        """
        if self._built_for != constants:
            mujoco = import_mujoco()
            self._model = mujoco.MjModel.from_xml_string(self._write_model(constants))
            disabled = mujoco.mjtDisableBit
            # Joint damping is explicit, as in Bullet and as `external.joint_integration` assumes.
            self._model.opt.disableflags |= disabled.mjDSBL_EULERDAMP
            # A failed element must become NaN; otherwise MuJoCo would reset it, and it would look
            # finished.
            self._model.opt.disableflags |= disabled.mjDSBL_AUTORESET
            self._data = mujoco.MjData(self._model)
            self._built_for = dict(constants)
        else:
            import_mujoco().mj_resetData(self._model, self._data)
        return self._model, self._data

    def close(self) -> None:
        """Release model and data."""
        self._model = self._data = self._built_for = None


_BODY_INERTIA = 1e-14
"""Mass and moment of inertia of a body on a joint: MuJoCo requires positive values."""


def write_joint_model(joint_type: str, constants: Mapping[str, float]) -> str:  # noqa: ARG001
    """Return the MuJoCo model (MJCF) of a body with hardly any inertia on one joint.

    `MujocoJoint` sets the joint's inertia as its armature, which MuJoCo uses only if the body's
    centre of mass is beyond the joint. There is no gravity.

    Args:
        joint_type: ``hinge`` or ``slide``.
        constants: unused; the forces of the system depend on them, and the body does not.
    """
    inertia = f"{_BODY_INERTIA} {_BODY_INERTIA} {_BODY_INERTIA}"
    return f"""
    <mujoco>
      <option gravity="0 0 0"/>
      <worldbody>
        <body>
          <joint type="{joint_type}" axis="1 0 0"/>
          <inertial mass="{_BODY_INERTIA}" pos="0 0 -1e-3" diaginertia="{inertia}"/>
        </body>
      </worldbody>
    </mujoco>"""


class MujocoJoint:
    """Body on one hinge or guide; see `sims.engines.external.joint_integration.JointBody`."""

    def __init__(self, world: CompiledWorld) -> None:
        self._world = world

    def reset_world(self) -> None:
        """Prepare a world in its initial state."""
        self._model, self._data = self._world.get_reset_world({})
        self._x = self._data.qpos
        self._w = self._data.qvel
        self._force = self._data.qfrc_applied
        self._step_world = import_mujoco().mj_step

    def set_step(self, step: float, inertia: float) -> None:
        """Set step (s) and inertia (kg or kg*m^2)."""
        self._model.opt.timestep = step
        self._model.dof_armature[0] = inertia - _BODY_INERTIA

    def set_state(self, x: float, w: float) -> None:
        """Set the joint's position and velocity.

        Args:
            x: position, rad or m.
            w: velocity at the time half a step before.
        """
        self._x[0] = x
        self._w[0] = w

    def advance(self, force: float) -> tuple[float, float]:
        """Advance by one step; return position and velocity."""
        self._force[0] = force
        self._step_world(self._model, self._data)
        return self._x.item(), self._w.item()

    def __getstate__(self) -> dict[str, Any]:
        return {"_world": self._world}
