"""Generate the table of the project's own effects for the README of this folder.

The command ``python -m sims.effects.readme_table`` prints it.
"""

from __future__ import annotations

import sys

from sims import effects
from sims.core.effect import Coefficient, Effect
from sims.core.system import SYSTEM_KINDS


def render_effects_table() -> str:
    """Return the table in Markdown.

    For each effect it contains the description, and a row for each coefficient with its plausible
    ranges.
    """
    head = "| effect, hook | coefficient | " + " | ".join(SYSTEM_KINDS) + " |"
    rows = [head, "|---|---|---|---|---|"]
    for name in effects.list_names():
        effect = effects.get_effect(name)
        # effects of installed plugins use the same entry points and have their own documentation
        if effect.__module__.startswith("sims.effects."):
            rows += _format_effect_rows(effect)
    return "\n".join(rows) + "\n"


def _format_effect_rows(effect: type[Effect]) -> list[str]:
    """Return the rows of one effect in the Markdown table, one for each of its coefficients.

    Args:
        effect: Effect with its coefficients and their ranges by kind of system.
    """
    head = f"`{effect.name}` ({effect.hook}): {effect.says}"
    rows = []
    for coefficient in effect.coefficients:
        ranges = [_format_range(coefficient, place) for place in range(len(SYSTEM_KINDS))]
        rows.append(f"| {head} | {coefficient.name} | " + " | ".join(ranges) + " |")
        head = ""  # the description is only in the row of the first coefficient
    return rows


def _format_range(c: Coefficient, kind_index: int) -> str:
    """Format the plausible range of a coefficient for one kind of system.

    A dash means that the effect does not exist on this kind of system, and (*) that the unit is
    that of another quantity, such as an input.

    Args:
        c: coefficient of the effect: name, units and plausible ranges.
        kind_index: index of the kind in `SYSTEM_KINDS`.
    """
    unit = c.units[kind_index]
    if unit is None:
        return "–"
    low, high = c.plausible[kind_index]
    text = f"{low:g} … {high:g}"
    if unit != "1":
        text += f" {unit}"
    # A time has its own unit on every system.
    return text + (" (*)" if c.of not in ("", "shift") else "")


if __name__ == "__main__":
    sys.stdout.write(render_effects_table())
