"""External diagnosers: a short one, and some that violate the rules."""

import os
import time
from pathlib import Path

import numpy as np

from simgap import Answer, Diagnoser, NamedCause


class Fifteen(Diagnoser):
    """Diagnoser that names drag where a run deviates from the simulation by 0.5 or more (std)."""

    name = "fifteen"

    def diagnose(self, case):
        worst = 0.0
        for run in case.recording.training():
            seen = run.channels["x"]
            simulated = case.simulate(run, initial={"x": seen[0]})["x"]
            worst = max(worst, float(np.std(seen - simulated)))
        if worst < 0.5:
            return "adequate"
        return Answer("named", (NamedCause("drag.linear"),))


WHERE = "/tmp"
"""Folder with the true causes; a test replaces this path."""


class Peeks(Diagnoser):
    """Diagnoser that searches for the true causes in the file system and in other processes."""

    name = "peeks"

    def diagnose(self, case):
        # It may see that a file exists, but not its content.
        found = [text for path in Path(WHERE).rglob("*") for text in read(path)]
        for process in Path("/proc").glob("[0-9]*"):
            if process.name != str(os.getpid()):
                texts = [read(process / name) for name in ("environ", "cmdline")]
                found += [text for part in texts for text in part if WHERE in text]
        found += read(Path(WHERE) / "answers.jsonl")
        return "unknown" if any(found) else "adequate"


def read(path):
    try:
        return [path.read_text()]
    except (OSError, ValueError):
        return []


class Hangs(Diagnoser):
    name = "hangs"

    def diagnose(self, case):
        while True:
            time.sleep(0.01)


class Crashes(Diagnoser):
    name = "crashes"

    def diagnose(self, case):
        raise RuntimeError("no idea")


class Declines(Diagnoser):
    """Diagnoser that declines sliders."""

    name = "declines"

    def cannot(self, kind):
        return "it knows no sliders" if kind.name == "slider" else ""

    def diagnose(self, case):
        raise AssertionError("it was asked all the same")


class Spends(Diagnoser):
    name = "spends"

    def diagnose(self, case):
        for _ in range(1000):
            for run in case.recording.runs:
                case.simulate(run)
        return "adequate"


class Lies(Diagnoser):
    """Diagnoser that reports a negative number of simulations."""

    name = "lies"

    def diagnose(self, case):
        from sims.core.simulation_counter import SIMULATION_COUNTER

        SIMULATION_COUNTER.used = -5
        return "adequate"
