"""Plugin with random search and torch loaded, as in learned tuners, without training."""

import torch

from methods.tuner import Tuner


class Torched(Tuner):
    name = "torched"

    def tune(self, task, rng):
        torch.set_num_threads(1)
        while True:
            yield torch.from_numpy(rng.uniform(size=(1, task.dim))).numpy()
