"""The page of an explanation: one file, readable without a network or scripts, in the light, in the
dark and in print.

Ten seconds come first: what is wrong, the gain, the run that shows it. Every text from a file or
plugin passes `safe`.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Mapping
from html import escape
from math import isfinite
from pathlib import Path

from bench.gap.report.account import closes, effort, following, headline, heldout_unit, interval
from bench.gap.report.sections import (
    candidates,
    numbers,
    reading,
    remains,
    safe,
    where,
    why,
    worst_first,
)
from bench.gap.report.story import Story
from bench.gap.report.words import clean, joined, name_of, number, percent, pretty, with_unit

_KINDS = {
    "adequate": "adequate: no gap found",
    "named": "named: the cause is found",
    "ambiguous": "ambiguous: one of several causes",
    "partial": "partial: a cause is found, and something remains",
    "unknown": "unknown: a gap, but no known cause",
    "unidentifiable": "unidentifiable: the data do not suffice",
}
_CAPTIONS = {
    "overview": "Above: measured and simulated; below: the residual, what is measured less what is simulated. "
    "In the grey band 95 % of the sensor's noise would lie.",
    "where": "Left: size of the residual by run, channel and phase; the dotted line at 1 is the noise floor, the grey "
    "bar what noise without memory gives by chance. Right: the variables that the residual follows most.",
    "candidates": "Left: evidence for each candidate, with the probability p of as much by chance. Right: what each "
    "gains on held-out runs.",
}


def framed(html: str) -> str:
    """A page as an element of another one: neither's styles reach the other, and no script runs."""
    source = escape(html, quote=True)
    style = "width: 100%; height: 46rem; border: 0"
    return f'<iframe title="report" sandbox="" style="{style}" srcdoc="{source}"></iframe>'


def page(story: Story, drawn: Mapping[str, bytes], for_print: bool = True) -> str:
    """The page as HTML.

    Args:
        story: what is told.
        drawn: the figures as PNG, by name.
        for_print: name the PDF that lies beside the page under each figure.
    """
    pictures = {name: _figure(story, name, png, for_print) for name, png in drawn.items()}
    style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    parts = [
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{safe(headline(story), 120)} {safe(story.title, 80)}</title>",
        f"<style>\n{style}</style>\n</head>\n<body>\n<main>",
        *_opening(story),
        pictures.get("overview", ""),
        *why(story),
        *where(story, pictures.get("where", "")),
        *candidates(story, pictures.get("candidates", "")),
        *numbers(story),
        *remains(story),
        *reading(),
        f"</main>\n{_footer(story)}\n</body>\n</html>\n",
    ]
    return "\n".join(part for part in parts if part)


def _opening(story: Story) -> Iterator[str]:
    yield f'<header>\n<p class="recording">{safe(story.title)}</p>'
    yield f'<p><span class="badge">{_KINDS[story.verdict["verdict"]]}</span></p>'
    yield f"<h1>{safe(headline(story))}</h1>"
    for text in following(story):
        yield f'<p class="lead">{safe(text, 1000)}</p>'
    yield "</header>"
    yield from _gain(story)


def _gain(story: Story) -> Iterator[str]:
    """Bars of the held-out error before, after and of the floor."""
    found = story.verdict["heldout"]
    if found is None:
        return
    tuned = "before: tuned simulation" if story.verdict["causes"] else "tuned simulation"
    rows = [("before", tuned, found["rmse_base"]), ("floor", "noise floor", found["noise_floor"])]
    if story.verdict["causes"]:
        rows.insert(1, ("after", "after: with what was found", found["rmse_extended"]))
    most = max(
        (value for _, _, value in rows if value is not None and isfinite(value)), default=0.0
    )
    yield '<section class="gain" aria-label="error on held-out runs">'
    if closes(found) and story.verdict["causes"]:
        share = percent(found["gap_closed"])
        yield f'<p class="closed"><strong>{share} of the gap closed</strong>{interval(found)}</p>'
    yield '<p class="soft">Error on held-out runs (RMSE): shorter is better, the noise floor is best.</p>'
    for kind, name, value in rows:
        width = 100.0 * value / most if value is not None and most > 0 else 0.0
        bar = f'<span><span class="bar {kind}" style="display:block;width:{width:.1f}%"></span></span>'
        amount = safe(with_unit(number(value), heldout_unit(story)))
        yield f'<div class="row"><span>{name}</span>{bar}<span class="value">{amount}</span></div>'
    yield "</section>"


def _figure(story: Story, name: str, png: bytes, for_print: bool) -> str:
    data = b64encode(png).decode("ascii")
    alt = safe(_alternative(story, name), 700)
    caption = _CAPTIONS.get(name, "")
    if for_print:
        caption += f" <span>For print: {safe(name)}.pdf</span>"
    image = f'<img src="data:image/png;base64,{data}" alt="{alt}">'
    return f"<figure>\n{image}\n<figcaption>{caption}</figcaption>\n</figure>"


def _alternative(story: Story, name: str) -> str:
    """What a figure shows, for those who do not see it."""
    if name == "overview":
        names = joined([clean(c.name, 30) for c in story.channels])
        return f"Measured and simulated {names} of the run that fits worst, with the residual. {headline(story)}"
    if name == "where":
        parts = [
            f"{p.kind} {clean(p.label, 30)} {number(p.before, 2)}"
            for p in worst_first(story.places)[:5]
        ]
        return (
            f"Size of the residual in units of the noise, the largest before: {'; '.join(parts)}."
        )
    best = [f"{name_of(c['effect'])} {number(c['score'])}" for c in story.verdict["candidates"][:5]]
    return f"Scores of the candidates, the best: {'; '.join(best)}."


def _footer(story: Story) -> str:
    units = safe(joined([pretty(c.unit) or "1" for c in story.channels]), 100)
    return (
        f'<footer class="soft">\n<p>Recording: <code>{safe(story.path, 300)}</code> (channels in {units}). '
        f"{safe(effort(story))} Made by simgap explain.</p>\n</footer>"
    )
