"""Diagnosers outside the project: a short one, and some that misbehave."""

import os
import time
from pathlib import Path

import numpy as np

from simgap import Answer, Diagnoser, NamedCause


class Fifteen(Diagnoser):
    """Alarms where a line through the motion changes more from run to run than noise says."""

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
"""Where the truth lies; a test writes the very folder here."""


class Peeks(Diagnoser):
    """Looks for the truth where it lies, and in the memory of who knows it."""

    name = "peeks"

    def diagnose(self, case):
        # That a file is there may be seen; what is in it may not.
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
    """Knows no sliders."""

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
    """Says that it has used fewer simulations than none."""

    name = "lies"

    def diagnose(self, case):
        from sims.core.simulation_counter import SIMULATION_COUNTER

        SIMULATION_COUNTER.used = -5
        return "adequate"
