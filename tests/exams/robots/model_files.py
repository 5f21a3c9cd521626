"""Test cases from unchanged model files of packages, each with a hidden cause.

The reference world makes the data: Pinocchio reads the same file, and the integrator of this folder
simulates it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from tests.exams.robot_files import signal_unit, write_robot_recording
from tests.exams.robots.exam_robots import Drive, Machine, plain
from tests.exams.robots.reference_world import Run, World
from tests.exams.robots.robot_signals import wave

RATE, NOISE = 100, 1e-3


@dataclass(frozen=True)
class Case:
    """A test case for one model file.

    Attributes:
        package: package that contains the file, or a folder.
        file: path inside the package.
        drives: actuators in the order of the file, or those that the recording adds.
        pose: positions around which the robot moves, by joint, rad or m.
        swing: amplitudes of commands: N m or N of motors, rad of servos.
        hidden: coefficients by effect@place.
        seconds: duration of a run.
        runs: count of runs; the last two are held out.
        gears: force per unit of each motor's control, N m or N.
        engine: engine settings of the recording; those of the file if None.
    """

    package: str
    file: str
    drives: tuple[Drive, ...]
    pose: tuple[float, ...]
    swing: tuple[float, ...]
    hidden: dict[str, tuple[float, ...]]
    seconds: float = 4.0
    runs: int = 5
    gears: tuple[float, ...] = ()
    engine: dict | None = None

    @property
    def path(self):
        folder = Path(self.package)
        if not folder.is_absolute():
            __import__(self.package)
            folder = Path(sys.modules[self.package].__file__).parent
        if self.package == "pinocchio":
            of = "share/example-robot-data/robots"
            folder = next(f / of for f in folder.parents if (f / of / self.file).exists())
        return folder / self.file


def motor(name, joint):
    return Drive(joint, "motor", 0.0, 0.0, np.inf, name)


class FromMjcf(Machine):
    """A machine from an MJCF file; `urdf` is the path of the file."""

    @cached_property
    def joints(self):
        return tuple(self._bare.names)[1:]

    @cached_property
    def _bare(self):
        import pinocchio

        return pinocchio.buildModelFromMJCF(self.urdf)

    def stated(self):
        return list(zip(self._bare.damping, self._bare.friction, strict=True))

    def index(self, place):
        return self.joints.index(place.partition(".")[2] or place)

    def unit(self, joint):
        return "m" if "slide" in joint else "rad"

    def model(self):
        model = self._bare.copy()
        model.damping = np.zeros(model.nv)
        return model


def machine_of(case):
    """Return the machine that the file of a case describes."""
    if case.path.suffix == ".xml":
        return FromMjcf(case.file, str(case.path), case.drives, case.pose)
    return Machine(case.file, plain(case.path.read_text()), case.drives, case.pose)


def write_case(case, folder, seed=0):
    """Write a recording of a case and return its path.

    Commands are held between time stamps; positions have noise.
    """
    machine, rng = machine_of(case), np.random.default_rng(seed)
    world = World(machine, case.hidden)
    times = np.arange(round(case.seconds * RATE) + 1) / RATE
    gears = np.array(case.gears or (1.0,) * len(case.drives))
    forms, runs, pose = ("multisine", "chirp", "ramps"), {}, np.array(case.pose)
    for number in range(case.runs):
        commands = {}
        for place, (drive, swing) in enumerate(zip(machine.drives, case.swing, strict=True)):
            form = forms[(number + place) % len(forms)]
            about = case.pose[machine.driven[place]] if drive.kp else 0.0
            commands[drive.name] = about + swing * wave(form, times, rng)
        begun = pose if machine.drives[0].kp else pose + rng.uniform(-0.02, 0.02, pose.size)
        motion = world.move(Run(times, commands, begun, np.zeros(pose.size)), times)
        readings = motion.q + NOISE * rng.standard_normal(motion.q.shape)
        controls = np.column_stack(list(commands.values())) / gears
        runs[str(number)] = number >= case.runs - 2, times, controls, readings
    inputs = {
        f"u.{d.name}": signal_unit("u", machine.unit(d.joint), not d.kp) for d in machine.drives
    }
    channels = {f"q.{joint}": (machine.unit(joint), NOISE) for joint in machine.joints}
    actuators = machine.description["actuators"]
    for table in actuators.values():
        table.pop("force_range", None)
    more = {"actuators": actuators} if case.path.suffix == ".urdf" else {}
    more |= {"engine": case.engine} if case.engine else {}
    model = (case.path, None)
    return write_robot_recording(folder, "log", inputs, channels, runs, model, **more)
