"""How every study begins: in a folder of its own, with a salt, under seals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from bench.problem.experiment import Experiment
from bench.problem.targets import Redraws
from bench.runs.housing import seals
from bench.store.folder import Configuration, create, free_folder
from bench.store.secret import salted


class Begun(NamedTuple):
    """A study whose folder is not written yet: a fault of the user's leaves nothing behind.

    Attributes:
        folder: where it will lie.
        experiment: as it will be made.
        secret: the salt, where nobody is to know it; None where it is public.
        jobs: worker processes.
    """

    folder: Path
    experiment: Experiment
    secret: str | None
    jobs: int

    def write(
        self, plugins: Sequence[str], hashes: Mapping[str, str], redraws: Redraws | None = None
    ) -> Path:
        """Write its folder, and return it.

        Args:
            plugins: plugin files that it needs.
            hashes: of what must not change while it is made.
            redraws: how many targets were drawn again, for environment.json.
        """
        held = () if self.experiment.trusted else seals()
        configuration = Configuration(self.experiment, list(plugins), dict(hashes))
        create(self.folder, configuration, self.jobs, self.secret, held, redraws)
        return self.folder


def begun(experiment: Experiment, folder: Path | None, jobs: int, salt: str | None) -> Begun:
    """A free folder, and the experiment with its salt; see `bench.study.Study.begin`."""
    place = free_folder(experiment, folder)
    experiment, secret = salted(experiment, salt)
    # Nothing is out of reach of what works in this process.
    return Begun(place, experiment.chosen(trusted=experiment.trusted or not jobs), secret, jobs)
