"""Complete user-defined simulator of first order: two tanks with levels and no velocities."""

import math

from simgap import Channel, Constant, OwnSimulator, Parameter


class Tanks(OwnSimulator):
    name, says = "tanks", "two tanks, of which a pump fills the upper and the upper the lower"
    parameters = (
        Parameter("pump", "m^3/(s*V)", 3e-6, (1e-6, 1e-5), (2e-6, 5e-6)),
        Parameter("upper_outlet", "m^2", 7e-6, (2e-6, 2e-5), (5e-6, 1e-5)),
        Parameter("lower_outlet", "m^2", 7e-6, (2e-6, 2e-5), (5e-6, 1e-5)),
    )
    constants = (Constant("area", "m^2", 2.8e-3, "of either tank", positive=True),)
    inputs = (Channel("volts", "V"),)
    channels = (Channel("upper", "m", 0.1, "level"), Channel("lower", "m", 0.1, "level"))
    states, levels, time_step = {"upper": 0.05, "lower": 0.05}, ("upper", "lower"), 1.0

    def reset(self, theta, constants, initial):
        self.theta, self.area, self.now = theta, constants["area"], dict(initial)

    def after(self, seconds, now, volts):
        filled = self.theta["pump"] * volts  # the outflows follow Torricelli's law
        drained = self.theta["upper_outlet"] * math.sqrt(2 * 9.81 * max(now["upper"], 0.0))
        away = self.theta["lower_outlet"] * math.sqrt(2 * 9.81 * max(now["lower"], 0.0))
        gained = {"upper": filled - drained, "lower": drained - away}
        return {name: self.now[name] + gained[name] / self.area * seconds for name in gained}

    def step(self, inputs, seconds):  # midpoint rule: levels change over minutes
        middle = self.after(seconds / 2, self.now, inputs["volts"])
        self.now = self.after(seconds, middle, inputs["volts"])

    def observe(self):
        return self.now

    def put(self, levels):
        self.now |= levels
