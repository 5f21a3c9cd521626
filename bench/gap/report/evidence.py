"""Tables of candidates and gap locations, and a chart of residual profiles.

Their numbers are those of verdict.json and of the report data.
"""

from __future__ import annotations

from bench.figures.text_layout import brief
from bench.gap.report.joints import by_joint, joint_of
from bench.gap.report.motion import AFTER, BEFORE
from bench.gap.report.panels import MOST_LETTERS, changed, telling
from bench.gap.report.places import has_places, of_set, without_place
from bench.gap.report.ranking import entries, standing
from bench.gap.report.story import Story
from bench.gap.report.words import FAMILY, clean, kind_of, labelled, name_of, parted, sentence
from bench.pages.chart import Axis, Chart, Panel, Series
from bench.pages.grid import Column, Grid
from bench.pages.table import Table
from sims import effects
from sims.base import InputError

CANDIDATES, PLACES, FOLLOWS = "candidates", "where", "follows"
"""Names of the tables."""
BEST, ELSEWHERE = "the best of each effect", "the same at other places"
"""Labels of the rows of a robot's candidates, for the filter."""


def candidates_table(story: Story) -> Table:
    """Build a table with one row per candidate, the highest score first."""
    sets = _sets(story)
    heads = {entry.best.effect for entry in entries(story)}
    found = bool(story.verdict.causes)
    rows = []
    for c in sorted(story.verdict.candidates, key=lambda one: -one.score):
        _, place = parted(c.effect)
        rows.append(
            {
                # A place has its own column.
                "candidate": clean(name_of(parted(c.effect)[0]), 120),
                "effect": clean(c.effect, 120),
                "score": c.score,
                "p_value": c.p_value,
                "heldout_gain": c.heldout_gain,
                # Without a diagnosed cause, "not needed" would be wrong.
                "standing": standing(story, c.effect) if found else "not convincing",
                "set": sets.get(c.effect, ""),
                "kind": kind_of(c.effect),
                "place": "all" if place == FAMILY else clean(place, 80),
                "joint": joint_of(story, kind_of(c.effect), place),
                "shown": BEST if c.effect in heads else ELSEWHERE,
                "says": _says(story, c.effect),
            }
        )
    return Table.from_rows(rows).without(_needless(story))


def _needless(story: Story) -> list[str]:
    """List the columns that would be empty."""
    columns = [] if _sets(story) else ["set"]
    return columns + ([] if has_places(story) else ["kind", "place", "joint", "shown"])


def _sets(story: Story) -> dict[str, str]:
    """Return, by effect, the set of effects that it is indistinguishable from."""
    found: dict[str, str] = {}
    for cause in story.verdict.causes:
        if cause.alternatives:
            members = [cause.effect, *cause.alternatives]
            found |= dict.fromkeys(members, clean(of_set(members), 160))
    return found


def _says(story: Story, name: str) -> str:
    """Return the description of an effect; for a cause, the one in the verdict."""
    for cause in story.verdict.causes:
        if cause.effect == name:
            return sentence(without_place(clean(cause.says, 400)))
    try:
        return sentence(effects.get(parted(name)[0]).says)
    except InputError:
        # The effect belongs to a plugin that is not loaded, or is a time step or integrator.
        return ""


def candidates_grid(frame: Table) -> Grid:
    """Make the grid of candidates; for a robot it first shows the best place of each effect."""
    digits = {"score": 3, "p_value": 2, "heldout_gain": 3}
    heads = {
        "effect": "name",
        "p_value": "p",
        "heldout_gain": "held-out gain",
        "says": "what it does",
        "set": "not to be told apart",
    }
    says = {
        "score": "evidence that the simulation lacks it: twice the gain in log likelihood",
        "p_value": "how probable as much evidence is by chance",
        "heldout_gain": "share of the gap on runs that no fit has seen that it closes by itself",
    }
    columns = tuple(
        Column(name, heads.get(name, name), digits.get(name, 0), says.get(name, ""))
        for name in frame.columns
        if name not in ("kind", "joint", "shown")
    )
    filters = tuple(name for name in ("standing", "kind", "joint", "shown") if name in frame)
    placed = "shown" in frame
    return Grid(
        "candidates-table",
        "Every candidate",
        CANDIDATES,
        columns,
        filters,
        only={"shown": BEST} if placed else {},
        sort="score,down",
        marked=("standing", "found"),
        lights="joint" if placed else "",
    )


def places_table(story: Story) -> Table:
    """Build a table with one row per part of the data: its RMS residual in units of the noise."""
    rows = []
    for p in story.places:
        row = {"kind": p.kind, "part": clean(p.label, 80), "samples": p.samples, "before": p.before}
        if changed(story):
            row["after"] = p.after
        if by_joint(story):
            name = p.label if p.kind == "channel" else ""
            row["joint"] = joint_of(story, "channel", name)
        rows.append(row)
    return Table.from_rows(rows)


def places_grid(frame: Table) -> Grid:
    """Make the grid of the parts of the data, the largest gap first."""
    after = "after" in frame
    heads = {"before": "RMS before" if after else "RMS", "after": "RMS after"}
    digits = {"samples": 7, "before": 3, "after": 3}
    columns = tuple(
        Column(name, heads.get(name, name), digits.get(name, 0))
        for name in frame.columns
        if name != "joint"
    )
    return Grid(
        "where-table",
        "Parts of the data",
        PLACES,
        columns,
        ("kind",),
        sort="before,down",
        lights="joint" if "joint" in frame else "",
    )


def follows_table(story: Story) -> Table:
    """Build the table of residual profiles, with one row per bin."""
    rows = []
    for p in story.profiles:
        about = {"channel": clean(p.channel, 80), "variable": clean(p.variable, 80)}
        whens = {"before": p.before} | ({"after": p.after} if changed(story) else {})
        for when, means in whens.items():
            for centre, mean, error in zip(p.centres, means, p.error, strict=True):
                bars = {"mean": mean, "low": mean - 2 * error, "high": mean + 2 * error}
                rows.append({**about, "when": when, "at": centre, **bars})
    return Table.from_rows(rows)


def follows_chart(story: Story) -> Chart:
    """Make the chart of residual profiles; the most informative ones are shown first."""
    units = {c.name: c.unit for c in story.channels}
    looks = {"before": BEFORE, "after": AFTER}
    first = {id(p) for p in telling(story.profiles)}
    panels = []
    names: list[str] = []
    # The most informative profiles come first.
    for p in sorted(story.profiles, key=lambda one: id(one) not in first):
        about = {"channel": clean(p.channel, 80), "variable": clean(p.variable, 80)}
        series = []
        for when in ("after", "before") if changed(story) else ("before",):
            where = {**about, "when": when}
            look = looks[when]._replace(marker={"before": "s", "after": "o"}[when])
            series.append(Series(f"simulated {when}", "mean", look, where, "low", "high"))
        # The title contains the full names; axes have no space for long ones.
        name = f"{clean(p.channel, 80)} against {clean(p.variable, 80)}"
        variable = brief(clean(p.variable), MOST_LETTERS)
        channel = clean(p.channel)
        residual = f"residual of {channel}" if len(channel) <= MOST_LETTERS else "residual"
        names += [name] * (id(p) not in first)
        panels.append(
            Panel(
                name,
                FOLLOWS,
                "at",
                tuple(series),
                Axis(labelled(variable, p.unit), scales=("linear",)),
                Axis(
                    labelled(residual, units.get(p.channel, "1"), 60),
                    scales=("linear",),
                    holds=(0.0,),
                ),
                {"residual of": name},
                height=230,
            )
        )
    return Chart(
        FOLLOWS,
        "What the residual follows",
        "Mean residual in bins of what it may follow; bands: ±2 standard errors.",
        tuple(panels),
        toggles=("residual of",),
        off={"residual of": tuple(names)},
    )
