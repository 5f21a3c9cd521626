"""Compare with mujoco.sysid on the arm of examples/robot: results, held-out errors and costs.

Run: `python -m tests.benchmarks.mujoco_sysid [--only CASE]`. The toolbox and its dependencies are
installed into a temporary environment, or come from the Python in $PEERS. Cases:

- mass: the model file specifies a forearm of 0.96 kg, a fifth too heavy; the arm has 0.8 kg;
- friction: the example as published; the elbow has dry friction of 0.03 N m that the model lacks;
- late: the elbow's command arrives 20 ms late, which no number of a model file describes.

mujoco.sysid fits the requested parameters: once masses, damping and armature of both links, as in
its own examples, and once dry friction as well. It receives the initial states; simgap estimates
them.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np

from tests.benchmarks import peer_libraries
from tests.example_logs import robot_arm

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "robot"
NUMBERS = ("mass", "damping", "armature")
FREED = {"sysid, numbers": NUMBERS, "sysid, numbers and friction": (*NUMBERS, "frictionloss")}
STATED = 'mass="0.8" diaginertia="0.009 0.009 0.0006"'
HEAVY = 'mass="0.96" diaginertia="0.0108 0.0108 0.00072"'
CASES = ("mass", "friction", "late")


def late_table(samples):
    """Return the recording of an arm whose elbow command arrives some samples late."""
    straight = robot_arm.table(0.0).splitlines()
    rows, arm = [straight[0]], robot_arm.Arm()
    for number in robot_arm.RUNS:
        torques = robot_arm.torques_of(number)
        late = torques.copy()
        late[samples:, 1], late[:samples, 1] = torques[:-samples, 1], torques[0, 1]
        moved = arm.simulate(np.zeros(4), late) - arm.simulate(np.zeros(4), torques)
        begun = 1 + (number - 1) * len(torques)
        for line, change in zip(straight[begun : begun + len(torques)], moved, strict=True):
            *kept, shoulder, elbow = line.split(",")
            seen = float(shoulder) + change[0], float(elbow) + change[1]
            rows.append(",".join([*kept, f"{seen[0]:.5f}", f"{seen[1]:.5f}"]))
    return "\n".join(rows) + "\n"


def prepare(case, folder):
    """Return a folder with arm2.xml, log.csv and log.toml of a case."""
    folder.mkdir()
    shutil.copy(EXAMPLE / "log.toml", folder)
    model = (EXAMPLE / "arm2.xml").read_text()
    if case == "mass":
        if STATED not in model:
            raise ValueError("arm2.xml states another forearm")
        model = model.replace(STATED, HEAVY)
    (folder / "arm2.xml").write_text(model)
    tables = {
        "mass": lambda: robot_arm.table(0.0),
        "friction": robot_arm.table,
        "late": lambda: late_table(2),
    }
    (folder / "log.csv").write_text(tables[case]())
    return folder


def measured(command):
    """Return the output, wall seconds and processor seconds of a command."""
    started = perf_counter()
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, stdout=output, stderr=errors, cwd=ROOT)
        _, status, usage = os.wait4(process.pid, 0)
        wall = perf_counter() - started
        output.seek(0)
        errors.seek(0)
        if status:
            raise RuntimeError(errors.read()[-2000:])
        return output.read(), wall, usage.ru_utime + usage.ru_stime


def by_sysid(python, folder, what):
    fit = str(Path(__file__).with_name("mujoco_sysid_fit.py"))
    said, wall, work = measured(
        [python, fit, str(folder / "arm2.xml"), str(folder / "log.csv"), *what]
    )
    found = json.loads(said.splitlines()[-1])
    return {**found, "verdict": None, "wall_s": wall, "processor_s": work}


def by_simgap(folder):
    out = folder / "explained"
    command = [sys.executable, "-m", "bench.cli.main", "explain", str(folder / "log.csv")]
    _, wall, work = measured([*command, "--out", str(out)])
    verdict = json.loads((out / "verdict.json").read_text())
    scored, _, _ = measured(
        [
            *command[:3],
            "score",
            str(out / "extended.toml"),
            str(folder / "log.csv"),
            "--held-out",
            "--json",
        ]
    )
    causes = {
        f"{cause['effect']} {name}": value
        for cause in verdict["causes"]
        for name, value in cause["coefficients"].items()
    }
    alternatives = {cause["effect"]: cause["alternatives"] for cause in verdict["causes"]}
    return {
        "found": {**verdict["parameters"], **causes},
        "alternatives": alternatives,
        "verdict": verdict["verdict"],
        "heldout_rmse": json.loads(scored)["rmse"],
        "wall_s": wall,
        "processor_s": work,
    }


def line(case, name, outcome):
    """Return a row of the table."""
    errors = " / ".join(f"{1e3 * v:.2f}" for v in outcome["heldout_rmse"].values())
    numbers = ", ".join(
        f"{key} {v['value']:.4g} ({v['low']:.4g} to {v['high']:.4g})"
        for key, v in outcome["found"].items()
    )
    times = f"{outcome['processor_s']:.1f} | {outcome['wall_s']:.1f}"
    return f"| {case} | {name} | {outcome['verdict'] or '–'} | {errors} | {times} | {numbers} |"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="+", choices=CASES, default=CASES)
    cases = parser.parse_args().only
    print("| case | who | verdict | held-out error, mrad | processor s | wall s | found |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as place:
        python = peer_libraries.environment(Path(place), ("mujoco[sysid]==4.0.0",))
        for case in cases:
            folder = prepare(case, Path(place) / case)
            for name, what in FREED.items():
                print(line(case, name, by_sysid(python, folder, what)), flush=True)
            print(line(case, "simgap explain", by_simgap(folder)), flush=True)


if __name__ == "__main__":
    sys.exit(main())
