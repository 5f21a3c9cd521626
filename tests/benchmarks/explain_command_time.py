"""Measure the cost of `simgap explain` for a simple system, by stage and as a command.

``python -m tests.benchmarks.explain_command_time [--recording FILE.csv] [--against PYTHON]``

The default recording is that of the README's first example: a pendulum, 4 runs of 4 s at 100 Hz.
Every number is processor time (user and system, with child processes), the minimum of `--repeats`
processes, with its ratio to importing NumPy on the same machine. With ``--against``, runs of the
whole command alternate between this Python and another one, whose environment has another version
of simgap, and the ratio of the two minima is printed: a busy machine affects both in the same way.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.simulation_arguments import Wish, write

STAGES = """
import json, sys, time
ends = [("interpreter", time.process_time())]
def end(stage):
    ends.append((stage, time.process_time()))
import numpy
end("import NumPy")
import bench.cli.main
bench.cli.main.build_parser()
end("parser of the command line")
import simgap
simgap.explain
end("import of simgap.explain")
found = simgap.explain(sys.argv[1], jobs=1)
end("diagnosis")
simgap.explain(sys.argv[1], jobs=1)
end("diagnosis again, everything loaded")
import matplotlib.figure, matplotlib.backends.backend_agg
end("import Matplotlib")
from bench.diagnosis.report import explanation_figures
from bench.diagnosis.report.explanation_page import render_report
drawn = explanation_figures.render_figures(found.story)
end("figures as PNG")
render_report(found.story, drawn)
end("report page")
from bench.figures.figure_files import pdf_figures
with pdf_figures():
    explanation_figures.render_figures(found.story)
end("figures as PNG, PDF and SVG")
print(json.dumps({b[0]: b[1] - a[1] for a, b in zip([("", 0.0), *ends], ends)}))
"""
NOT_PART = ("diagnosis again, everything loaded", "figures as PNG, PDF and SVG")
"""Stages that are not part of the command."""


def stages(recording):
    """Measure the stages of one process; return seconds by name."""
    command = [sys.executable, "-c", STAGES, str(recording)]
    return json.loads(subprocess.run(command, capture_output=True, check=True).stdout)


def processor_seconds(python, recording):
    """Run the command once with an interpreter and return its processor seconds."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["explain", str(recording), "--out", f"{folder}/out"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        # Import the packages of this interpreter, not those of the current folder.
        subprocess.run(
            [python, "-P", "-m", "simgap", *words], cwd=folder, capture_output=True, check=True
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--against", metavar="PYTHON", help="of another environment")
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recording = given.recording
        if recording is None:
            recording = Path(folder) / "swing.csv"
            noise = ["q=0.01", "qd=0.05"]
            write(Wish("pendulum", effects=["drag.linear=2e-4"], noise=noise), recording)
        _report(recording.resolve(), given.against, given.repeats)


def _report(recording, against, repeats):
    measured = [stages(recording) for _ in range(repeats)]
    least = {name: min(one[name] for one in measured) for name in measured[0]}
    unit = least["import NumPy"]
    for name, seconds in least.items():
        print(f"{name:36} {seconds:6.3f} s {seconds / unit:6.1f} x import NumPy")
    whole = sum(seconds for name, seconds in least.items() if name not in NOT_PART)
    print(f"{'sum of the stages of the command':36} {whole:6.3f} s {whole / unit:6.1f}")
    if against is None:
        print(f"{'the command':36} {processor_seconds(sys.executable, recording):6.3f} s")
        return
    pairs = [
        [processor_seconds(python, recording) for python in (sys.executable, against)]
        for _ in range(repeats)
    ]
    own, other = (min(seconds) for seconds in zip(*pairs, strict=True))
    print(f"the command: {own:.2f} s here, {other:.2f} s there, ratio {own / other:.2f}")


if __name__ == "__main__":
    main()
