"""A plugin with a learned tuner whose training takes no time."""

from methods.tuner import Tuner


class Learner(Tuner):
    name = "learner"
    learned = True

    def fit(self, simulator, rng, budget):
        points = simulator.sample(rng, budget)
        self.points, self.seen = points, simulator.simulate(rng, points)

    def state(self):
        return {"points": self.points, "seen": self.seen}

    def restore(self, state):
        if set(state) != {"points", "seen"} or state["points"].ndim != 2:
            raise ValueError(f"expected points and what was seen, found {sorted(state)}")
        self.points, self.seen = state["points"], state["seen"]

    def tune(self, task, rng):
        yield from self.points[None]
