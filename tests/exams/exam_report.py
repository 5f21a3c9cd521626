"""Summary, page, text and figures of an exam, all from the table of answers (items.csv)."""

from __future__ import annotations

import numpy as np
import pandas as pd

from bench.diagnosis_benchmark.result_tables import compute_share
from tests.exams.exam import LEVELS, NOT_DRAWN

BEGIN, END = "<!-- results -->", "<!-- /results -->"
SIZES = (0.0, 1.0, 10**0.25, 10**0.5, 10**0.75, 10.0, np.inf)
"""Limits of the sizes that are counted together, in units of the noise."""
SUMMARY_COLUMNS = (
    "version", "group", "value", "items", *LEVELS, "no_answer", "intervals_held", "intervals",
    "cpu_median_s", "cpu_p95_s", "cpu_max_s", "wall_median_s", "memory_max_mb",
)  # fmt: skip
MAX_ALARMS = 0.01
COVERAGE = (0.90, 0.98)


def write_report(folder, exam, table):
    """Write summary.csv, figures and the results in README.md.

    Other text of README.md is kept.
    """

    summarise(exam, table).to_csv(folder / "summary.csv", index=False)
    path = folder / "README.md"
    page = path.read_text() if path.exists() else f"# {exam.title}\n\n{exam.about}\n\n{BEGIN}{END}"
    before, _, rest = page.partition(BEGIN)
    after = rest.partition(END)[2]
    path.write_text(f"{before}{BEGIN}\n{format_page(exam, table)}{END}{after}".rstrip() + "\n")
    draw_figures(folder / "figures", table)


def share(good, exact=False):
    """Return (count, total, share, low, high) of a boolean column, with its 95 % interval.

    The interval is Wilson's, or Clopper-Pearson's with `exact`.
    """
    row = compute_share(int(np.sum(good)), len(good), exact)
    if not row["of"]:
        return 0, 0, None, None, None
    return row["count"], row["of"], row["share"], row["low"], row["high"]


def drawn(table):
    """Return the answers without questions that have no case."""
    return table[table.outcome != NOT_DRAWN]


def graded(table):
    """Return the answers that the targets count: without those only of the power curve."""
    table = drawn(table)
    table = table[table.outcome != "unknown"]  # Nobody knows the right answer.
    return table[table.part == "marks"] if "part" in table else table


def groups(exam, table):
    """Yield (group, value, answers) for all, for each kind, and for each group of hidden causes."""
    table = graded(table)
    yield "all", "", table
    for kind, own in table.groupby("kind"):
        yield "kind", kind, own
    hidden = table[~table.kind.isin(["clean", "foreign"])]
    for name in exam.groups:
        if name == "size":
            labels = pd.cut(hidden["size"], SIZES, right=False).map(
                lambda limits: f"{limits.left:.2g} to {limits.right:.2g}"
            )
        else:
            labels = hidden.get(name, pd.Series(dtype=str))
        for value, own in hidden.groupby(labels, observed=True):
            yield name, value, own


def summarise(exam, table):
    """Return a frame with counts and times of each group and version."""
    lines = [
        (version, group, value, *_totals(rows))
        for version, own in table.groupby("version", sort=False)
        for group, value, rows in groups(exam, own)
        if len(rows)
    ]
    return pd.DataFrame(lines, columns=SUMMARY_COLUMNS)


def _totals(rows):
    """Return the cells of `SUMMARY_COLUMNS` from items on."""
    cpu = rows.cpu_s.fillna(0.0)
    sums = rows[[*LEVELS]].sum().astype(int)
    times = cpu.median(), cpu.quantile(0.95), cpu.max(), rows.wall_s.median()
    return (
        len(rows), *sums, int((rows.outcome == "failed").sum()), int(rows.intervals_held.sum()),
        int(rows.intervals.sum()), *(round(float(seconds), 1) for seconds in times),
        rows.memory_mb.max().round(),
    )  # fmt: skip


def target_rows(exam, table):
    """Return rows (description, required, share, whether it is met or None) of the targets."""
    table = graded(table)
    rows = []
    for target in exam.targets:
        own = table if target.kind is None else table[table.kind == target.kind]
        got = share(own[target.level])
        is_met = None if target.min_share is None or got[2] is None else got[2] >= target.min_share
        wanted = "" if target.min_share is None else f"at least {target.min_share:.0%}"
        rows.append((target.description, wanted, got, is_met))
    if (table.kind == "clean").any():
        alarms = share(table[table.kind == "clean"].outcome != "right", exact=True)
        rows.append(("clean recordings: false alarms", f"at most {MAX_ALARMS:.0%}", alarms,
                     alarms[2] <= MAX_ALARMS))  # fmt: skip
    held, count = int(table.intervals_held.sum()), int(table.intervals.sum())
    if count:
        low, high = COVERAGE
        got = share([True] * held + [False] * (count - held))
        rows.append(("95 % intervals that contain the true value", f"{low:.0%} to {high:.0%}", got,
                     low <= got[2] <= high))  # fmt: skip
    return rows


def passes(exam, table):
    """Return whether a quick exam has no alarm, no failure and enough right answers."""
    table = drawn(table)
    hidden = table[table.kind != "clean"]
    return (
        not (table.outcome == "failed").any()
        and bool(table[table.kind == "clean"].strict.all())
        and hidden.equivalent.sum() >= exam.quick_share * len(hidden)
    )


def format_share(got):
    count, total, ratio, low, high = got
    if ratio is None:
        return "none"
    return f"{count}/{total} = {ratio:.1%} ({low:.1%} to {high:.1%})"


def format_targets(exam, table):
    """Return the targets and times of each version as lines of text."""
    lines = []
    words = {None: "", True: "yes", False: "NO"}
    for version, own in table.groupby("version", sort=False):
        lines.append(f"{version}:")
        for description, wanted, got, is_met in target_rows(exam, own):
            lines.append(f"{words[is_met]:4}{format_share(got):>34}  {description} {wanted}")
        lines.append(format_times(own))
    return "\n".join(lines)


def format_times(table):
    """Return quantiles of processor seconds as text."""
    table = drawn(table)
    column, word = ("cpu_s", "processor ") if table.cpu_s.notna().any() else ("wall_s", "")
    seconds = table[column].dropna()
    if not len(seconds):
        return "no times"
    middle, high, most = seconds.median(), seconds.quantile(0.95), seconds.max()
    return (
        f"{word}seconds per answer: median {middle:.1f}, 95th percentile {high:.1f}, "
        f"maximum {most:.1f}"
    )


def format_answers(table):
    """Return one line an answer."""
    lines = []
    for row in table.itertuples():
        level = next((level for level in LEVELS if getattr(row, level)), "-")
        lines.append(
            f"{row.item:44} {row.outcome:9} {level:10} {row.cpu_s:6.1f} s  {row.hidden}  ->  "
            f"{row.causes or row.message or '-'}"
        )
    return "\n".join(lines)


def format_page(exam, table):
    """Return the results as Markdown: targets, times, counts by group, outcomes."""
    table = table[table.version == table.version.iloc[-1]]
    words = {None: "", True: "yes", False: "no"}
    lines = ["| criterion | goal | result (95 % interval) | met |", "|---|---|---|---|"]
    for description, wanted, got, is_met in target_rows(exam, table):
        if got[1]:
            lines.append(f"| {description} | {wanted} | {format_share(got)} | {words[is_met]} |")
    lines += ["", f"{format_times(table)[0].upper()}{format_times(table)[1:]}.", ""]
    summary = summarise(exam, table)
    for group in dict.fromkeys(summary.group):
        if group != "all":
            head = " | ".join(LEVELS)
            lines += [f"## By {group}", "", f"| | answers | {head} |", "|---|---|" + "---|" * 5]
            for row in summary[summary.group == group].itertuples():
                cells = " | ".join(str(getattr(row, level)) for level in LEVELS)
                lines.append(f"| {row.value} | {row.items} | {cells} |")
            lines.append("")
    lines += ["## Outcomes", ""]
    for kind, own in graded(table).groupby("kind"):
        counts = own.outcome.value_counts().sort_index()
        lines.append(f"- {kind}: " + ", ".join(f"{n} {name}" for name, n in counts.items()))
    undrawn = table[table.outcome == NOT_DRAWN]
    if len(undrawn):
        count = "1 question is" if len(undrawn) == 1 else f"{len(undrawn)} questions are"
        names = ", ".join(f"`{item}`" for item in sorted(undrawn.item))
        lines += [
            "",
            f"{count} not graded, because no sampled recording shows the cause: {names}.",
        ]
    return "\n".join(lines) + "\n"


def differing_recordings(rows):
    """Yield a line if versions have answered different recordings of a question."""
    digests = {}
    for row in rows:
        digests.setdefault(row["item"], set()).add(row.get("digest"))
    names = sorted(name for name, found in digests.items() if len(found) > 1)
    if names:
        yield "recordings differ between versions (use --fresh): " + ", ".join(names)


WANTED = 0.97


def draw_figures(folder, table):
    """Draw power and confusion as PNG and PDF, if there are data."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(exist_ok=True)
    figures = {"power": _power(power_groups(table)), "confusion": _confusion(table)}
    for name, figure in figures.items():
        for suffix in (".png", ".pdf") if figure else ():
            metadata = {"CreationDate": None} if suffix == ".pdf" else None
            figure.savefig(folder / f"{name}{suffix}", dpi=150, metadata=metadata)
        plt.close(figure) if figure else None


def power_groups(table):
    """Return (size, share, share up to equivalence) by group of sizes of single causes."""
    singles = drawn(table)[drawn(table).kind == "single"]
    counted = graded(singles)
    rest = singles.drop(counted.index)
    labels = pd.cut(counted["size"], SIZES, right=False)
    parts = [(float(size), own) for size, own in rest.groupby("size")]
    for limits, own in counted.groupby(labels, observed=True):
        parts.append((float(np.sqrt(max(limits.left, 0.1) * min(limits.right, 30.0))), own))
    return [(size, share(own.few), share(own.equivalent)) for size, own in parts]


def _power(groups):
    from matplotlib import pyplot as plt

    if not groups:
        return None
    figure, axis = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    sizes = np.array([size for size, _, _ in groups])
    for place, label, marker, colour, shift in (
        (1, "by name, alone or in a small set", "o", "#000000", 0.985),
        (2, "the same, equivalent effects counted as one", "s", "#888888", 1.015),
    ):
        _, _, ratio, low, high = np.array([group[place] for group in groups], dtype=float).T
        axis.errorbar(
            sizes * shift, ratio, yerr=np.maximum([ratio - low, high - ratio], 0.0),
            fmt=f"{marker}-", color=colour, markersize=4.5, linewidth=1.1, capsize=2.5, label=label,
        )  # fmt: skip
    for size, got, _ in groups:
        axis.annotate(f"{got[1]}", (size, -0.07), ha="center", fontsize=7)
    axis.axhline(WANTED, color="#444444", linewidth=0.8, linestyle=(0, (2, 2)))
    axis.set(
        xscale="log", ylim=(-0.09, 1.03), xlabel="size of the hidden effect [noise]",
        ylabel="share found",
    )  # fmt: skip
    ticks = [0.1, 0.2, 0.5, 1, 2, 5, 10, 30]
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.minorticks_off()
    axis.set_title(
        "Bars: 95 % (Wilson). Numbers: recordings. Dashes: target from 1 on.", fontsize=8
    )
    axis.legend(loc="center right", fontsize=8, frameon=False)
    axis.grid(axis="y", color="#DDDDDD", linewidth=0.6)
    return figure


def count_confusion(table):
    """Return counts of answers: rows are hidden effects, columns the effect named first."""
    rows = graded(table)
    rows = rows[rows.kind != "double"]
    hidden = rows.effect.where(~rows.kind.isin(["clean", "foreign", "numerics"]))
    hidden = hidden.fillna("(" + rows.kind + ")")
    first = rows.causes.str.split(r"\||@| \+ ", regex=True).str[0]
    is_named = (first != "") & ~rows.verdict.isin(["adequate", "unknown", "unidentifiable"])
    # Tables of imported answers have no verdicts.
    without_verdict = rows.outcome.where(rows.outcome == "failed", "no cause")
    verdict = rows.verdict.where(rows.verdict != "", without_verdict)
    first = first.where(is_named, "(" + verdict + ")")
    return pd.crosstab(hidden, first)


def _confusion(table):
    from matplotlib import pyplot as plt

    counts = count_confusion(table)
    if counts.empty:
        return None
    truths, named = (sorted(index, key=lambda n: (n.startswith("("), n)) for index in counts.axes)
    values = counts.loc[truths, named].to_numpy(dtype=float)
    shares = values / values.sum(axis=1, keepdims=True)
    size = 2.6 + 0.24 * len(named), 2.0 + 0.24 * len(truths)
    figure, axis = plt.subplots(figsize=size, layout="constrained")
    axis.imshow(shares, cmap="Greys", vmin=0, vmax=1, aspect="auto")
    for i, j in np.argwhere(values > 0):
        colour = "white" if shares[i, j] > 0.5 else "black"
        axis.text(j, i, f"{values[i, j]:.0f}", ha="center", va="center", fontsize=6.5, color=colour)
    axis.set_xticks(range(len(named)), named, rotation=90, fontsize=7)
    axis.set_yticks(range(len(truths)), truths, fontsize=7)
    axis.set(xlabel="named first", ylabel="hidden")
    axis.set_title("Recordings; grey: share of the row", fontsize=8)
    return figure
