"""Explain the measured recordings.

``python -m tests.benchmarks.real_recordings [NAME ...] [--thorough] [--out DIR]``

Writes a folder for each recording (verdict, extended simulator, report; the folder of a thorough
search is named `thorough`) and the table of results/reference/real. The README of the recordings
gives published results and the held-out errors of a quick independent fit.
"""

import argparse
import json
import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.diagnosis.explain import explain
from bench.diagnosis.score_extended import score_model
from sims.recording.recording import Run, read_recording
from sims.recording.recording_writer import write_recording
from sims.systems.pendulum import Pendulum

DATA = Path(os.environ.get("SIMGAP_DATA", Path(__file__).parents[3] / "shared" / "data"))
PUBLISHED = {
    "pendulum_free_swing/recording": "linear damping",
    "servo_pendulum/recording": "viscous friction, and friction that grows with the load",
    "servo_pendulum/thorough": "the same",
    "smartphone_fall/fall": "quadratic air drag, and an offset",
    "smartphone_fall/up_down": "quadratic air drag, and an offset that varies by run",
    "ball_drops/bowling_ball": "nothing measurable",
    "emps/explained": "mass 95.1 kg, viscous 203.5 N·s/m, Coulomb 20.4 N, offset −3.2 N",
    "so101/explained": "nothing",
}
HEAD = (
    "| recording | published | verdict | causes (what explains it as well) | held-out RMSE: base | "
    "extended | floor "
    "| gap closed | s |\n|---|---|---|---|---|---|---|---|---|\n"
)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*")
    parser.add_argument("--thorough", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("results/reference/real"))
    options = parser.parse_args()
    paths = sorted(path for path in DATA.glob("*/*.csv") if path.with_suffix(".toml").is_file())
    for path in paths:
        name = f"{path.parent.name}/{path.stem}"
        if options.names and not any(wanted in name for wanted in options.names):
            continue
        folder = options.out / path.parent.name / ("thorough" if options.thorough else path.stem)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        explain(path, thorough=options.thorough).write(folder)
        for figure in folder.glob("*.p*"):  # The report contains the figures.
            figure.unlink()
        if name.startswith("pendulum"):
            (folder / "open_loop.json").write_text(
                json.dumps(open_loop(folder / "extended.toml", path)) + "\n"
            )
        print(row(options.out, folder), flush=True)
    kinds = sorted({path.parent.name for path in paths})  # Robots have their own program.
    folders = [
        found.parent for of in kinds for found in sorted(options.out.glob(f"{of}/*/verdict.json"))
    ]
    (options.out / "table.md").write_text(
        HEAD + "\n".join(row(options.out, folder) for folder in folders) + "\n"
    )


def open_loop(model, path):
    """Return the error over the held-out runs, joined to the original run of 25 s."""
    recording = read_recording(path, Pendulum, whole=True)
    parts, begin = recording.held_out(), 0.0
    times, channels = [], {name: [] for name in parts[0].channels}
    for run in parts:
        step = float(np.median(np.diff(run.times)))
        times.append(run.times - run.times[0] + begin)
        begin = float(times[-1][-1]) + step
        for name, values in run.channels.items():
            channels[name].append(values)
    joined = {name: np.concatenate(values) for name, values in channels.items()}
    run = Run("joined", np.concatenate(times), joined, {}, {}, {}, False)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "joined.csv"
        write_recording(target, replace(recording, runs=(run,)), Pendulum)
        return score_model(model, target)


def row(out, folder):
    """Return a row of the table."""
    verdict = json.loads((folder / "verdict.json").read_text())
    name = str(folder.relative_to(out))
    causes = "; ".join(
        c["effect"] + (f" ({', '.join(c['alternatives'])})" if c["alternatives"] else "")
        for c in verdict["causes"]
    )
    held = verdict["heldout"]
    numbers = ["–"] * 4
    if held:
        share = f"{held['gap_closed']:.0%}"
        numbers = [
            *(
                f"{held[k]:.3g} {held['unit']}"
                for k in ("rmse_base", "rmse_extended", "noise_floor")
            ),
            share,
        ]
    published = PUBLISHED.get(name, "air drag")
    cells = [
        f"[{name}]({name}/report.html)",
        published,
        verdict["verdict"],
        causes or "–",
        *numbers,
    ]
    return "| " + " | ".join([*cells, f"{verdict['seconds']:.0f}"]) + " |"


if __name__ == "__main__":
    main()
