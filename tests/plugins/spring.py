"""A closed-form simulator for tests: a spring released at x0 oscillates and decays."""

import numpy as np

from sims.core.simulator import Channel, Parameter, Simulator


class Spring(Simulator):
    name = "spring"
    says = "a spring that is let go, in closed form"
    parameters = (
        Parameter("rate", "rad/s", 3.0, (1.0, 5.0), (2.0, 4.0)),
        Parameter("decay", "1/s", 0.3, (0.0, 1.0), (0.2, 0.6)),
    )
    channels = (Channel("x", "m"), Channel("v", "m/s"))
    states = {"x": 1.0}  # noqa: RUF012

    def simulate(self, theta, scenario):
        (
            self.run_constants(scenario),
            self.run_inputs(scenario),
        )  # it has none: refuses those that a scenario names
        t, x0 = scenario.times, self.run_initial(scenario)["x"]
        rate, decay = theta[:, :1], theta[:, 1:]
        x = x0 * np.exp(-decay * t) * np.cos(rate * t)
        v = -x0 * np.exp(-decay * t) * (decay * np.cos(rate * t) + rate * np.sin(rate * t))
        return np.stack([x, v], axis=2)[:, :, self.columns]
