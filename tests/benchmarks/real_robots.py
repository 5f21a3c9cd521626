"""Explain the measured arm and drive from unchanged logs.

``python -m tests.benchmarks.real_robots``

The arm needs two commands from its folder to a verdict, which are run as by a user. Then three
models predict the six held-out motions from their initial states: the initial model, the model with
tuned gains, and the extended one. The result is the RMSE by joint and motion, in mrad. For the
drive, estimates are printed with published values. With ``--explained DIR`` an existing folder is
used; otherwise explain runs, which takes a quarter of an hour.
"""

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from bench.core.plugin_registries import simulators
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.logs.recording_loading import load_recording
from sims.extended_simulator import open_extended

ROBOTS = Path(os.environ.get("SIMGAP_ROBOTS", Path(__file__).parents[3] / "shared" / "robots"))
FITTED = ("chirp_sweep", "multisine")
EMPS = """<mujoco model="emps"><option timestep="0.001" integrator="implicitfast"/>
<worldbody><body name="carriage"><joint name="screw" type="slide" axis="1 0 0"/>
<geom name="block" type="box" size="0.2 0.2 0.1" mass="100"/></body></worldbody>
<actuator><motor name="drive" joint="screw" gear="1"/></actuator></mujoco>
"""
EMPS_LOG = """model = "emps.xml"
free = ["mass@carriage"]
title = "EMPS: a motor and ball screw move a carriage, 1 kHz"
[time]
column = "t"
[channels."q.screw"]
file = "{file}"
column = "x"
unit = "m"
noise = 2.4e-5
[inputs."u.drive"]
file = "{file}"
column = "u"
unit = "N"
"""


def simgap(*arguments):
    """Run the installed command."""
    command = Path(sys.executable).with_name("simgap")
    subprocess.run([str(command), *map(str, arguments)], check=True)


def so101(out, explained):
    folder = ROBOTS / "so101"
    log = out / "so101.toml"
    log.unlink(missing_ok=True)
    motions = sorted(path.name for path in folder.iterdir() if path.is_dir())
    held_out = [name for name in motions if name not in FITTED]
    model = folder / "so101.urdf"
    simgap("import", folder, "--model", model, "--out", log, "--held-out", ",".join(held_out))
    if explained is None:
        explained = out / "explained"
        shutil.rmtree(explained, ignore_errors=True)
        simgap("explain", log, "--out", explained)
    recording, _ = load_recording(log)
    runs = recording.held_out()
    extended, of_file, _ = open_extended(explained / "extended.toml", simulators.get)
    world = RunEvaluator(of_file, recording, runs, None, candidates=list(extended.effects))
    after = world.get_nominal_theta()
    for place, parameter in enumerate(world.parameters[: world.system_parameter_count]):
        after[place] = extended.parameters[parameter.name].value
    # A search that its budget ended has no numbers of the base model.
    known = tuned(explained) if (explained / "apart.csv").exists() else {}
    before = world.get_nominal_theta()
    for place, parameter in enumerate(world.parameters[: world.system_parameter_count]):
        before[place] = known.get(parameter.name, np.nan)
    for name, numbers in extended.effects.items():
        coefficients = world.available_effects[name].on(world.simulator.system)
        for place, coefficient in zip(
            world.get_coefficient_indices(name), coefficients, strict=True
        ):
            after[place] = numbers[coefficient.name].value
    models = {"as imported": world.get_nominal_theta(), "gains tuned": before, "extended": after}
    models = {name: theta for name, theta in models.items() if np.isfinite(theta).all()}
    errors = {name: by_run(world, theta) for name, theta in models.items()}
    table(
        out / "table.md", world, runs, errors, json.loads((explained / "verdict.json").read_text())
    )


def tuned(explained):
    """Return the base model's parameters from apart.csv."""
    with (explained / "apart.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["model"] == "base"]
    return {row["number"]: float(row["value"]) for row in rows if row["group"] == "all"}


def by_run(world, theta):
    """Return the RMSE (R, C) of a model that begins in the initial state of each run."""
    runs = np.arange(len(world.prepared_runs))
    simulated = world.simulate(np.tile(theta, (runs.size, 1)), runs, world.initial_state_guesses)
    return np.sqrt(np.nanmean((world.observed - simulated) ** 2, axis=1))


def table(path, world, runs, errors, verdict):
    joints = [name.partition(".")[2] for name in world.channels]
    lines = [
        f"| motion (not fitted) | model | {' | '.join(joints)} |",
        "|---" * (len(joints) + 2) + "|",
    ]
    for r, run in enumerate(runs):
        for name, rmse in errors.items():
            cells = " | ".join(f"{1e3 * value:.1f}" for value in rmse[r])
            lines.append(f"| {run.name} | {name} | {cells} |")
    for name, rmse in errors.items():
        cells = " | ".join(f"{1e3 * value:.1f}" for value in np.sqrt((rmse**2).mean(axis=0)))
        lines.append(f"| **all six** | {name} | {cells} |")
    causes = [" or ".join([c["effect"], *c["alternatives"]]) for c in verdict["causes"]]
    said = f"{verdict['verdict']}: {'; '.join(causes)}; {verdict['seconds']:.0f} s"
    path.write_text(
        "RMSE in mrad (gripper: its own radians)\n\n" + "\n".join(lines) + f"\n\n{said}\n"
    )
    print(path.read_text())


def emps(out, explained):
    (out / "emps.xml").write_text(EMPS)
    (out / "emps.toml").write_text(EMPS_LOG.format(file=ROBOTS / "emps" / "recording.csv"))
    if explained is None:
        explained = out / "explained"
        shutil.rmtree(explained, ignore_errors=True)
        simgap("explain", out / "emps.toml", "--pieces", 0.5, "--out", explained)
    verdict = json.loads((explained / "verdict.json").read_text())
    mass = 100.0 * (1.0 + verdict["parameters"]["mass.scale@carriage"]["value"])
    print(f"mass {mass:.2f} kg (95.11 published)")
    for cause in verdict["causes"]:
        print(cause["effect"], cause["alternatives"], cause["coefficients"])
    print(verdict["verdict"], verdict["heldout"], f"{verdict['seconds']:.0f} s")


def emps_slide(out, explained):
    """Explain the drive as the system `slider`, which may have a flexible transmission.

    It is fitted once on the first run, and once on the second with its pulses, in segments, with
    forces in units of 50 N.
    """
    unit, length = 50.0, 500
    with (ROBOTS / "emps" / "recording.csv").open() as file:
        rows = list(csv.DictReader(file))
    lines = ["run,t,u,x"]
    for run in "12":
        own = [row for row in rows if row["run"] == run]
        for k in range(len(own) // length):
            for i, row in enumerate(own[k * length : (k + 1) * length]):
                lines.append(f"{run}-{k},{i / 1000},{float(row['u']) / unit!r},{row['x']}")
    count = len(rows) // 2 // length
    for fitted, other in ("12", "21"):
        name = out / f"emps-{fitted}.csv"
        name.write_text("\n".join(lines) + "\n")
        held_out = [f'[runs."{other}-{k}"]\nheld_out = true\n' for k in range(count)]
        units = '[inputs.u]\nunit = "N"\n[channels.x]\nunit = "m"\nnoise = 2.4e-5\n'
        name.with_suffix(".toml").write_text(f'system = "slider"\n{units}{"".join(held_out)}')
        simgap("explain", name, "--out", out / f"explained-{fitted}")
        verdict = json.loads((out / f"explained-{fitted}" / "verdict.json").read_text())
        print(
            f"fitted on run {fitted}: mass {unit * verdict['parameters']['mass']['value']:.1f} kg"
        )
        for cause in verdict["causes"]:
            sizes = {k: round(c["value"], 4) for k, c in cause["coefficients"].items()}
            print(cause["effect"], cause["alternatives"], sizes, f"in units of {unit:g} N")
        print(verdict["verdict"], verdict["heldout"], f"{verdict['seconds']:.0f} s")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("which", choices=("so101", "emps", "emps_slide"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--explained", type=Path)
    options = parser.parse_args()
    out = options.out or Path("results/reference/real") / options.which
    out.mkdir(parents=True, exist_ok=True)
    {"so101": so101, "emps": emps, "emps_slide": emps_slide}[options.which](out, options.explained)


if __name__ == "__main__":
    main()
