"""Explain the measured recordings.

``python -m tests.benchmarks.real_recordings [NAME ...] [--out DIR]``

Each recording of `tests/exams/recordings/recordings.toml` with measured data gets a folder with its
verdict, extended simulator and report, and each robot a budget of five minutes. For the SO-101,
the RMSE of all motions that were not fitted is written to table.md, in mrad by joint.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from bench.core.plugin_registries import simulators
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.logs.recording_loading import load_recording
from sims.extended_simulator import open_extended
from tests.exams.recordings.recording_cases import RecordingQuestion

BALLS = [
    "baseball",
    "blue_basketball",
    "bowling_ball",
    "golf_ball",
    "green_basketball",
    "orange_whiffle_ball",
    "tennis_ball",
    "volleyball",
    "whiffle_ball_1",
    "whiffle_ball_2",
    "yellow_whiffle_ball",
]
RECORDINGS = {f"ball_drops/{name}": name for name in BALLS} | {
    "pendulum_free_swing/recording": "pendulum_free_swing",
    "servo_pendulum/recording": "servo_pendulum",
    "smartphone_fall/fall": "smartphone_fall",
    "smartphone_fall/up_down": "smartphone_up_down",
    "dfki_double_pendulum/explained": "dfki_double_pendulum",
    "emps/explained": "emps",
    "so101/explained": "so101",
}
"""Recordings by the folder of their results."""
PUBLISHED = {
    "ball_drops/bowling_ball": "nothing measurable",
    "pendulum_free_swing/recording": "linear damping",
    "servo_pendulum/recording": "viscous friction, and friction that grows with the load",
    "smartphone_fall/fall": "quadratic air drag, and an offset",
    "smartphone_fall/up_down": "quadratic air drag, and an offset that varies by run",
    "dfki_double_pendulum/explained": "inertias stated about the joints, dry friction",
    "emps/explained": "mass 95.11 kg, friction that differs by direction",
    "so101/explained": "nothing",
}
"""Published causes; air drag for the other recordings."""
HEAD = (
    "| recording | published | verdict | causes (what explains it as well) | held-out RMSE: base | "
    "extended | floor "
    "| gap closed | s |\n|---|---|---|---|---|---|---|---|---|\n"
)
BUDGET_SECONDS = 300


def explain_recording(name, folder):
    """Explain a recording by the public commands, and keep the files that pages refer to."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as scratch:
        command = Path(sys.executable).with_name("simgap")
        case = RecordingQuestion(RECORDINGS[name]).draw()
        described = case.write(Path(scratch))
        if "import" in case.expected:
            options = [o.replace("{folder}", str(case.folder)) for o in case.expected["import"]]
            subprocess.run(
                [command, "import", case.folder, *options, "--out", described], check=True
            )
        budget = ["--budget", str(BUDGET_SECONDS)] if case.folder.parent.name == "robots" else []
        out = Path(scratch) / "out"
        subprocess.run([command, "explain", described, *budget, "--out", out], check=True)
        for file in ("verdict.json", "extended.toml", "report.html"):
            shutil.copy(out / file, folder / file)
        if name.startswith("so101"):
            write_motion_table(described, folder)


def write_motion_table(log, folder):
    """Write the RMSE of the held-out motions of the SO-101, imported and extended, by joint."""
    recording, _ = load_recording(log)
    runs = recording.held_out()
    extended, kind, _ = open_extended(folder / "extended.toml", simulators.get)
    evaluator = RunEvaluator(kind, recording, runs, None, candidates=list(extended.effects))
    theta = evaluator.get_nominal_theta()
    for i, parameter in enumerate(evaluator.parameters[: evaluator.system_parameter_count]):
        theta[i] = extended.parameters[parameter.name].value
    for name, numbers in extended.effects.items():
        coefficients = evaluator.available_effects[name].on(evaluator.simulator.system)
        indices = evaluator.get_coefficient_indices(name)
        for i, coefficient in zip(indices, coefficients, strict=True):
            theta[i] = numbers[coefficient.name].value
    models = {"as imported": evaluator.get_nominal_theta(), "extended": theta}
    errors = {name: compute_errors(evaluator, theta) for name, theta in models.items()}
    joints = [name.partition(".")[2] for name in evaluator.channels]
    rows = [
        (run.name, name, rmse[r]) for r, run in enumerate(runs) for name, rmse in errors.items()
    ]
    rows += [("**all six**", name, np.sqrt((e**2).mean(axis=0))) for name, e in errors.items()]
    lines = [f"| motion (not fitted) | model | {' | '.join(joints)} |", "|---" * 8 + "|"]
    for motion, name, values in rows:
        lines.append(f"| {motion} | {name} | {' | '.join(f'{1e3 * v:.1f}' for v in values)} |")
    text = "RMSE in mrad (gripper: its own radians)\n\n" + "\n".join(lines) + "\n"
    (folder.parent / "table.md").write_text(text)


def compute_errors(evaluator, theta):
    """Return the RMSE (R, C) of a model that begins in the initial state of each run."""
    runs = np.arange(len(evaluator.prepared_runs))
    thetas = np.tile(theta, (runs.size, 1))
    simulated = evaluator.simulate(thetas, runs, evaluator.initial_state_guesses)
    return np.sqrt(np.nanmean((evaluator.observed - simulated) ** 2, axis=1))


def row(name, verdict):
    """Return the row of a recording in the table of the page."""
    causes = "; ".join(
        c["effect"] + (f" ({', '.join(c['alternatives'])})" if c["alternatives"] else "")
        for c in verdict["causes"]
    )
    held, numbers = verdict["heldout"], ["–"] * 4
    if held:
        keys = ("rmse_base", "rmse_extended", "noise_floor")
        numbers = [f"{held[key]:.3g} {held['unit']}" for key in keys]
        numbers.append(f"{held['gap_closed']:.0%}")
    published = PUBLISHED.get(name, "air drag")
    cells = [f"[{name}]({name}/report.html)", published, verdict["verdict"], causes or "–"]
    return "| " + " | ".join([*cells, *numbers, f"{verdict['seconds']:.0f}"]) + " |"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*")
    parser.add_argument("--out", type=Path, default=Path("results/reference/real"))
    options = parser.parse_args()
    for name in RECORDINGS:
        if not options.names or any(wanted in name for wanted in options.names):
            explain_recording(name, options.out / name)
            verdict = json.loads((options.out / name / "verdict.json").read_text())
            print(row(name, verdict), flush=True)


if __name__ == "__main__":
    main()
