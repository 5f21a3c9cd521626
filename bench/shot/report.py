"""Writes table.csv, shots.csv, status.csv and the figures of a bounce shot, and says what came out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pandas as pd

from bench.problem.experiment import Experiment
from bench.shot.animation import animate
from bench.shot.deal import deals
from bench.shot.pictures import draw, examples
from bench.shot.settings import Settings
from bench.shot.study import read
from bench.shot.table import FAILED, table, text
from bench.store.journal import FOLDER
from bench.store.status import STATUS_COLUMNS
from sims.files import write


def finish(
    folder: Path,
    experiment: Experiment,
    settings: Settings,
    skipped: Mapping[str, str],
    say: Callable[[str], None],
) -> int:
    """Write and say what the shots in `folder` came to; returns the exit code: 1 where a method
    failed or died.
    """
    dealt = deals(experiment, settings)
    kept = {one.name: made for one in dealt if (made := read(folder, one)) is not None}
    rows = pd.DataFrame([row for made in kept.values() for row in made["rows"]])
    for name in (
        "off",
        "margin",
        "planned_margin",
        "prediction_error",
        "drop_height",
        "restitution",
        "seconds",
    ):
        rows[name] = pd.to_numeric(rows[name])
    lines = table(rows)
    write(folder / "table.csv", lines.to_csv(index=False, float_format="%.6g"))
    write(folder / "shots.csv", rows.to_csv(index=False, float_format="%.6g"))
    write(folder / "status.csv", _statuses(rows, skipped).to_csv(index=False, float_format="%.6g"))
    figures = draw(folder, experiment, settings, dealt, kept, rows, lines)
    figures += [
        animate(folder, settings, example, kept) for example in examples(dealt, kept, rows)[:1]
    ]
    journal = folder / FOLDER
    if journal.is_dir() and not any(journal.iterdir()):
        journal.rmdir()
    say("\n" + text(lines))
    for label, reason in skipped.items():
        say(f"skipped {label}: {reason}")
    failed = rows[rows["status"].isin(FAILED)]
    for (method, status), part in failed.groupby(["method", "status"]):
        say(f"{status}: {method} in {len(part)} shots; {part['reason'].iloc[0]}")
    say(f"\ntable   {folder / 'table.csv'}\nshots   {folder / 'shots.csv'}")
    for figure in figures:
        say(f"figure  {figure}")
    return 1 if failed["status"].isin(("crashed", "timeout")).any() else 0


def _statuses(rows: pd.DataFrame, skipped: Mapping[str, str]) -> pd.DataFrame:
    made = pd.DataFrame(
        {
            "run": rows["method"] + "/" + rows["shot"],
            "tuner": rows["method"],
            "simulator": "bounce-shot",
            "target": rows["shot"],
            "seed": 0,
            "status": rows["status"],
            "reason": rows["reason"],
            "simulations": rows["simulations"],
            "seconds": rows["seconds"],
        }
    )
    left = [
        (label, label, "bounce-shot", "", 0, "skipped", reason, 0, 0.0)
        for label, reason in skipped.items()
    ]
    return pd.concat([made, pd.DataFrame(left, columns=STATUS_COLUMNS)]) if left else made
