"""The page of the reference board: ``python -m tests.benchmarks.diagnoser_board FOLDER``.

Reads a finished folder of ``simgap compare diagnosis-full``, copies the tables of the board to
results/reference/diagnosis and writes the numeric parts of its page. Text between other marks of
the page is not changed.
"""

import argparse
import re
import shutil
from pathlib import Path

import pandas as pd

from tests.docs.documentation_pages import ROOT

FOLDER = ROOT / "results/reference/diagnosis"
TABLES = (
    "items", "table", "groups", "power", "confusion", "calibration", "sets", "costs", "pairs",
    "training", "failures",
)  # fmt: skip
METRICS = {
    "false alarms": "false alarms",
    "named, alone": "named alone",
    "the same, up to equivalence": "named, set of at most two",
    "pairs: both named": "both of two",
    "foreign causes: unknown or partial": "foreign",
    "95 % intervals that hold": "intervals that hold",
}


class Board:
    """Tables of a results folder."""

    def __init__(self, folder):
        self.table = pd.read_csv(folder / "table.csv")
        self.items = pd.read_csv(folder / "items.csv")
        self.pairs = pd.read_csv(folder / "pairs.csv")
        self.costs = pd.read_csv(folder / "costs.csv").set_index("diagnoser")
        # Sort diagnosers by the count of diagnosed causes, after simgap.
        named = self.table[self.table["metric"] == "the same, up to equivalence"]
        order = named.sort_values("count", ascending=False)["diagnoser"].tolist()
        self.order = ["simgap", *(name for name in order if name != "simgap")]

    def cell(self, diagnoser, metric):
        chosen = (self.table["diagnoser"] == diagnoser) & (self.table["metric"] == metric)
        row = self.table[chosen].iloc[0]
        if not row["of"]:
            return "–"
        share, low, high = (f"{100 * row[key]:.0f}" for key in ("share", "low", "high"))
        return f"{int(row['count'])}/{int(row['of'])} = {share} % ({low} to {high})"

    def compared(self):
        head = " | ".join(METRICS.values())
        lines = [f"| diagnoser | {head} | simulations | processor seconds |"]
        lines.append("|---" * (len(METRICS) + 3) + "|")
        for name in self.order:
            cells = " | ".join(self.cell(name, metric) for metric in METRICS)
            cost = self.costs.loc[name]
            lines.append(
                f"| {name} | {cells} | {cost['simulations_median']:.0f} "
                f"| {cost['processor_seconds_median']:.2f} |"
            )
        return "\n".join(lines)

    def against(self):
        lines = [
            "| against | named: simgap alone right | the other alone right | p (Holm) "
            "| no false alarm: simgap alone | the other alone | p (Holm) |",
            "|---" * 7 + "|",
        ]
        table = self.pairs.set_index(["metric", "diagnoser"])
        for name in self.order[1:]:
            cells = []
            for metric in ("named", "no false alarm"):
                row = table.loc[(metric, name)]
                counts = f"{row['only_simgap']:.0f} | {row['only_other']:.0f}"
                cells.append(f"{counts} | {row['p_holm']:.2g}")
            lines.append(f"| {name} | {' | '.join(cells)} |")
        return "\n".join(lines)

    def failures(self):
        singles = self.items[(self.items["kind"] == "single") & (self.items["size"] >= 1.0)]
        wide = singles.pivot(index="question", columns="diagnoser", values="found_class")
        lines = [
            "| question (size in noises, then its number) | noise | simgap says | named by |",
            "|---" * 4 + "|",
        ]
        own = singles[(singles["diagnoser"] == "simgap") & ~singles["found_class"]]
        for row in own.sort_values("question").to_dict("records"):
            who = [name for name in self.order[1:] if wide.loc[row["question"], name]]
            lines.append(
                f"| `{row['question']}` | {row['noise']} | {self._said(row)} "
                f"| {', '.join(who) or 'nobody'} |"
            )
        return "\n".join(lines)

    @staticmethod
    def _said(row):
        names = str(row["named"])
        if row["outcome"] == "set":
            return f"in a set of {row['largest_set']} ({names.replace('|', ', ')})"
        if row["outcome"] == "unnamed":
            return "seen and not named (`unknown`)"
        if row["outcome"] == "missed":
            return "not seen (`adequate`)"
        return f"{row['outcome']}: {names.replace('|', ', ')}"


def written(page, parts):
    """Return the page with each part between its marks, <!-- NAME --> and <!-- /NAME -->."""
    for name, text in parts.items():
        pattern = rf"(<!-- {name} -->\n).*?(\n<!-- /{name} -->)"
        page, count = re.subn(
            pattern, lambda m, text=text: m[1] + "\n" + text + "\n" + m[2], page, flags=re.S
        )
        assert count == 1, name
    return page


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    for name in TABLES:
        shutil.copy(folder / f"{name}.csv", FOLDER)
    shutil.copytree(folder / "figures", FOLDER / "figures", dirs_exist_ok=True)
    shutil.copy(folder / "report.html", FOLDER)
    board, page = Board(FOLDER), FOLDER / "README.md"
    parts = {"failures": board.failures(), "board": board.compared(), "pairs": board.against()}
    page.write_text(written(page.read_text(encoding="utf-8"), parts), encoding="utf-8")


if __name__ == "__main__":
    main()
