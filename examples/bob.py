"""Complete user-defined simulator in MuJoCo: a weight on a spring, pulled by an input."""

import mujoco

from simgap import Channel, Constant, OwnSimulator, Parameter

MODEL = """<mujoco><option integrator="Euler" gravity="0 0 0"/><worldbody><body>
  <joint name="z" type="slide" axis="0 0 1" stiffness="{stiffness}" damping="{damping}"/>
  <geom type="sphere" size="0.02" mass="{mass}"/>
</body></worldbody><actuator><motor joint="z"/></actuator></mujoco>"""


class Bob(OwnSimulator):
    name, says, requires = "bob", "a weight on a spring", ("mujoco",)
    parameters = (
        Parameter("stiffness", "N/m", 20.0, (1.0, 100.0), (10.0, 40.0)),
        Parameter("damping", "N*s/m", 0.05, (0.0, 1.0), (0.0, 0.2)),
    )
    constants = (Constant("mass", "kg", 0.2, positive=True),)
    inputs = (Channel("pull", "N"),)
    channels = (Channel("z", "m", says="height above rest"),)
    states, time_step = {"z": 0.1, "vz": 0.0}, 1e-3

    def reset(self, theta, constants, initial):
        self.model = mujoco.MjModel.from_xml_string(MODEL.format(**theta, **constants))
        self.data = mujoco.MjData(self.model)
        self.data.qpos[0], self.data.qvel[0] = initial["z"], initial["vz"]

    def step(self, inputs, seconds):
        self.data.ctrl[0], self.model.opt.timestep = inputs["pull"], seconds
        mujoco.mj_step(self.model, self.data)

    def observe(self):
        return {"z": self.data.qpos[0]}
