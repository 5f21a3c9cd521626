"""Tables of the page of the diagnosis benchmark, from results/reference/diagnosis.

To update them, copy the tables, figures and report.html of a finished folder of ``simgap compare
diagnosis-full`` there and run ``python -m tests.docs.page_numbers.inserted_numbers``.
"""

from functools import cache

import pandas as pd

from tests.docs.documentation_pages import ROOT

FOLDER = ROOT / "results/reference/diagnosis"
METRICS = {
    "false alarms": "false alarms",
    "named, alone": "named alone",
    "the same, up to equivalence": "named, set of at most two",
    "pairs: both named": "both of two",
    "foreign causes: unknown or partial": "foreign",
    "95 % intervals that hold": "intervals that hold",
}
"""Headings of the page by metric."""


@cache
def read_table(name):
    return pd.read_csv(FOLDER / f"{name}.csv")


def list_diagnosers():
    """List the diagnosers by number of diagnosed causes, simgap first."""
    table = read_table("table")
    named = table[table["metric"] == "the same, up to equivalence"]
    names = named.sort_values("count", ascending=False)["diagnoser"].tolist()
    return ["simgap", *(name for name in names if name != "simgap")]


def list_board_lines():
    metrics = read_table("table").set_index(["diagnoser", "metric"])
    costs = read_table("costs").set_index("diagnoser")
    yield f"| diagnoser | {' | '.join(METRICS.values())} | simulations | processor seconds |"
    yield "|---" * (len(METRICS) + 3) + "|"
    for name in list_diagnosers():
        cells = " | ".join(_format_share(metrics.loc[name, metric]) for metric in METRICS)
        simulations = costs.loc[name, "simulations_median"]
        seconds = costs.loc[name, "processor_seconds_median"]
        yield f"| {name} | {cells} | {simulations:.0f} | {seconds:.2f} |"


def _format_share(row):
    if not row["of"]:
        return "–"
    share, low, high = (f"{100 * row[key]:.0f}" for key in ("share", "low", "high"))
    return f"{row['count']:.0f}/{row['of']:.0f} = {share} % ({low} to {high})"


def list_pair_lines():
    pairs = read_table("pairs").set_index(["metric", "diagnoser"])
    yield (
        "| against | named: simgap alone right | the other alone right | p (Holm) "
        "| no false alarm: simgap alone | the other alone | p (Holm) |"
    )
    yield "|---" * 7 + "|"
    for name in list_diagnosers()[1:]:
        rows = [pairs.loc[metric, name] for metric in ("named", "no false alarm")]
        cells = [f"{r.only_simgap:.0f} | {r.only_other:.0f} | {r.p_holm:.2g}" for r in rows]
        yield f"| {name} | {' | '.join(cells)} |"


def list_failure_lines():
    items = read_table("items")
    singles = items[(items["kind"] == "single") & (items["size"] >= 1.0)]
    is_named = singles.pivot(index="question", columns="diagnoser", values="found_class")
    yield "| question (size in noises, then its number) | noise | simgap says | named by |"
    yield "|---" * 4 + "|"
    failures = singles[(singles["diagnoser"] == "simgap") & ~singles["found_class"]]
    for row in failures.sort_values("question").to_dict("records"):
        others = [name for name in list_diagnosers()[1:] if is_named.loc[row["question"], name]]
        cells = row["noise"], _format_answer(row), ", ".join(others) or "nobody"
        yield f"| `{row['question']}` | {' | '.join(cells)} |"


def _format_answer(row):
    names = str(row["named"])
    if row["outcome"] == "set":
        return f"in a set of {row['largest_set']} ({names.replace('|', ', ')})"
    if row["outcome"] == "unnamed":
        return "seen and not named (`unknown`)"
    if row["outcome"] == "missed":
        return "not seen (`adequate`)"
    return f"{row['outcome']}: {names.replace('|', ', ')}"
