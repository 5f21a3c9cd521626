"""Complete user-defined simulator in PyBullet: a puck that slides down an inclined plane."""

import math

from simgap import BulletWorld, Channel, Constant, OwnSimulator, Parameter


class Puck(OwnSimulator):
    name, says, requires = "puck", "a puck that slides down an inclined plane", ("pybullet",)
    parameters = (Parameter("friction", "1", 0.3, (0.0, 0.5), (0.1, 0.4)),)
    gravity = Constant("gravity", "m/s^2", 9.81)
    constants = (Constant("incline", "rad", 0.5), Constant("mass", "kg", 0.16), gravity)
    channels = (Channel("x", "m", says="way down the plane"), Channel("v", "m/s", says="its rate"))
    states, coordinates, rates = {"x": 0.0, "v": 0.0}, ("x",), ("v",)

    def reset(self, theta, constants, initial):
        self.sim = world = BulletWorld()
        self.mass, down, g = constants["mass"], constants["incline"], constants["gravity"]
        world.setGravity(g * math.sin(down), 0, -g * math.cos(down))  # x runs down the plane
        plane = world.createMultiBody(0, world.createCollisionShape(world.GEOM_PLANE))
        world.changeDynamics(plane, -1, lateralFriction=1)  # Bullet multiplies it by the puck's
        box = world.createCollisionShape(world.GEOM_BOX, halfExtents=[0.05, 0.05, 0.01])
        self.puck = world.createMultiBody(self.mass, box, basePosition=[initial["x"], 0, 0.01])
        world.changeDynamics(self.puck, -1, lateralFriction=theta["friction"], linearDamping=0)
        world.changeDynamics(self.puck, -1, localInertiaDiagonal=[0, 0, 0])  # no rotation
        world.resetBaseVelocity(self.puck, [initial["v"], 0, 0])

    def step(self, inputs, seconds):
        self.sim.setTimeStep(seconds)
        self.sim.stepSimulation()

    def observe(self):
        self.at, _ = self.sim.getBasePositionAndOrientation(self.puck)
        return {"x": self.at[0], "v": self.sim.getBaseVelocity(self.puck)[0][0]}

    def apply_force(self, force):
        self.sim.applyExternalForce(self.puck, -1, [*force, 0, 0], self.at, self.sim.WORLD_FRAME)

    def inertia(self):
        return self.mass
