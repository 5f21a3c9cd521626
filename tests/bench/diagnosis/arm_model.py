"""Model file of a two-link arm with position servos, for logs that tests make.

No motion in the tests of discretisation errors reaches the range limit of the shoulder, so the
limit must not change any result.
"""

ARM = """<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.004"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper">
      <inertial pos="0 0 -0.2" mass="1.2" diaginertia="0.02 0.02 0.002"/>
      <joint name="shoulder" axis="0 1 0" damping="0.3" range="-2.6 2.6"/>
      <body name="fore" pos="0 0 -0.4">
        <inertial pos="0 0 -0.1" mass="0.8" diaginertia="0.01 0.01 0.001"/>
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="m_shoulder" joint="shoulder" kp="150" kv="6"/>
    <position name="m_elbow" joint="elbow" kp="60" kv="2"/>
  </actuator>
</mujoco>
"""
