"""Model of a two-joint arm with position servos, for logs of its joints hip and knee."""

ARM = """<mujoco model="arm"><compiler angle="radian" autolimits="true"/><worldbody>
<body><joint name="hip" axis="0 1 0" range="-2 2"/><geom size="0.1" pos="0 0 -0.3"/>
<body pos="0 0 -0.6"><joint name="knee" axis="0 1 0" range="-2 2"/>
<geom size="0.1" pos="0 0 -0.3"/></body></body></worldbody>
<actuator><position name="m_hip" joint="hip" kp="100" kv="10"/>
<position name="m_knee" joint="knee" kp="100" kv="10"/></actuator></mujoco>"""
