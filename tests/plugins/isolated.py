"""Tuners that do what isolation forbids, as careless tuners often do."""

import os
import socket
import subprocess
from multiprocessing import Pool
from pathlib import Path

from methods.tuner import Tuner


class ReadsSiblingFile(Tuner):
    """Begin with the content of a file next to this file."""

    name = "reads_beside"

    def tune(self, task, rng):
        yield Path(__file__).with_name("__init__.py").read_text()


class ReadsHere(Tuner):
    """Read a file of the working directory of the command."""

    name = "reads_here"

    def tune(self, task, rng):
        yield Path("earlier.json").read_text()


class StartsProgram(Tuner):
    name = "starts_program"

    def tune(self, task, rng):
        subprocess.run(["true"], check=True)
        yield task.start


class StartsPool(Tuner):
    name = "starts_pool"

    def tune(self, task, rng):
        with Pool(2):
            yield task.start


class AsksServer(Tuner):
    name = "asks_server"

    def tune(self, task, rng):
        socket.create_connection(("127.0.0.1", 80), timeout=1.0)
        yield task.start


class Mistaken(Tuner):
    """Raise an error unrelated to isolation, although its message names an isolation error."""

    name = "mistaken"

    def tune(self, task, rng):
        yield task.start
        raise ValueError("no PermissionError")


class KeepsLog(Tuner):
    """Write a log, a table in a folder, and a hidden file as libraries do."""

    name = "keeps_log"

    def tune(self, task, rng):
        os.makedirs("out/.cache")
        for name in ("log.txt", "out/points.csv", "out/.cache/font"):
            Path(name).write_text("1")
        while True:
            yield rng.uniform(size=(1, task.dim))
