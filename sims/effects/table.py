"""The table of the project's own effects in this folder's README: ``python -m sims.effects.table``
prints it.
"""

from __future__ import annotations

import sys

from sims import effects
from sims.system import KINDS, Coefficient, Effect


def table() -> str:
    """The table, in Markdown: an effect's sentence, then a row for each coefficient with its
    plausible ranges.
    """
    rows = ["| effect, hook | coefficient | " + " | ".join(KINDS) + " |", "|---|---|---|---|---|"]
    for name in effects.names():
        effect = effects.get(name)
        if effect.__module__.startswith("sims.effects."):
            rows += _rows(effect)
    return "\n".join(rows) + "\n"


def _rows(effect: type[Effect]) -> list[str]:
    head = f"`{effect.name}` ({effect.hook}): {effect.says}"
    rows = []
    for c in effect.coefficients:
        rows.append(
            f"| {head} | {c.name} | " + " | ".join(_range(c, i) for i in range(len(KINDS))) + " |"
        )
        head = ""
    return rows


def _range(c: Coefficient, place: int) -> str:
    unit, (low, high) = c.units[place], c.plausible[place]
    if unit is None:
        return "–"
    return f"{low:g} … {high:g}" + ("" if unit == "1" else f" {unit}") + (" (*)" if c.of else "")


if __name__ == "__main__":
    sys.stdout.write(table())
