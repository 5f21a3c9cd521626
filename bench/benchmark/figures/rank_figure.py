"""Draw the critical-difference diagram of mean ranks over several problems."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.figures.style import NEUTRAL_MARK, get_colour, make_panel_grid

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def draw_critical_difference_figure(
    ranked: pd.DataFrame, p_values: pd.DataFrame, friedman: float
) -> Figure:
    """Draw the critical-difference diagram: mean ranks over problems.

    Bars join tuners that do not differ significantly at 5 %.

    Args:
        ranked: Ranks, one row per problem, one column per tuner.
        p_values: P-values of Nemenyi's test of each pair of tuners.
        friedman: P-value of Friedman's test.
    """
    from scikit_posthocs import critical_difference_diagram

    figure, axes = make_panel_grid(1, 1, (8.5, 1.6 + 0.28 * ranked.shape[1]))
    axis = axes[0, 0]
    # Each tuner has its colour of every other figure; text stays dark, since light colours are hard
    # to read.
    colours = {str(name): get_colour(index) for index, name in enumerate(ranked.columns)}
    artists = critical_difference_diagram(
        ranked.mean(axis=0), p_values, ax=axis, label_props={"fontsize": 9}, color_palette=colours
    )
    for label in artists["labels"]:
        label.set_color(NEUTRAL_MARK)
    tests = f"Friedman p = {friedman:.2g}; bars: Nemenyi p > 0.05"
    axis.set_title(f"Mean rank over {len(ranked)} problems, 1 is best ({tests})", fontsize=10)
    return figure
