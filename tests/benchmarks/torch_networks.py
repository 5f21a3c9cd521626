"""A plugin: random search with torch loaded, as learned tuners have it, and no training."""

import torch

from methods.tuner import Tuner


class Torched(Tuner):
    name = "torched"

    def tune(self, task, rng):
        torch.set_num_threads(1)
        while True:
            yield torch.from_numpy(rng.uniform(size=(1, task.dim))).numpy()
