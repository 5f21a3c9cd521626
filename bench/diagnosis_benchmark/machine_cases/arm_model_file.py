"""Model file of the arm in MJCF, which belongs to the recording of a case."""

from __future__ import annotations

from collections.abc import Mapping

MODEL_FILE_NAME = "robot.xml"
"""Name of the model file, in the folder of the recording."""


def render_arm_mjcf(numbers: Mapping[str, float]) -> str:
    """Render the MJCF text of an arm of two links, with joints `shoulder` and `elbow`.

    Args:
        numbers: parameters in SI units: ``length`` of the upper arm; and for the links 1 (upper
            arm) and 2 (forearm), ``mass1``, ``centre1`` (distance of the centre of mass from the
            joint), ``inertia1`` (about the centre of mass), ``damping1`` and ``armature1``.
    """
    # The names of a link's parameters end with its number.
    inner_link, outer_link = (
        _render_link(
            joint,
            {
                name.removesuffix(number): value
                for name, value in numbers.items()
                if name.endswith(number)
            },
        )
        for joint, number in (("shoulder", "1"), ("elbow", "2"))
    )
    return f"""<mujoco model="arm2">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="RK4" gravity="0 0 -9.81">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="upper_arm">
      {inner_link}
      <body name="forearm" pos="0 0 {-numbers["length"]!r}">
        {outer_link}
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m_shoulder" joint="shoulder" gear="1"/>
    <motor name="m_elbow" joint="elbow" gear="1"/>
  </actuator>
</mujoco>
"""


def _render_link(joint: str, n: Mapping[str, float]) -> str:
    """Render the inertia and joint of a link; it is slender along its own axis.

    The moment of inertia about that axis is a tenth of the others. It does not matter, because the
    link never turns about it.

    Args:
        joint: name of its joint.
        n: mass, centre, inertia, damping and armature of the link.
    """
    moments = f"{n['inertia']!r} {n['inertia']!r} {0.1 * n['inertia']!r}"
    return (
        f'<inertial pos="0 0 {-n["centre"]!r}" mass="{n["mass"]!r}" diaginertia="{moments}"/>\n'
        f'      <joint name="{joint}" type="hinge" axis="0 1 0" damping="{n["damping"]!r}" '
        f'armature="{n["armature"]!r}"/>'
    )
