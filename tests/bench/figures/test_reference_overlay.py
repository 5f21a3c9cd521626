"""Tests of reference results drawn in grey behind the user's own: search, curves and legend."""

import json
import re
import shutil

import numpy as np
import pytest

from bench.benchmark.comparison_printed_figures import draw_figure, make_reference_id
from bench.benchmark.storage.reference_results import find_reference, list_reference_names
from bench.benchmark.storage.table_schemas import ERROR_FLOOR
from bench.figures.style import REFERENCE_GREYS
from sims.core.simulator import InputError
from tests.bench.figures.sample_comparisons import BUDGET, LABELS, stored

REFERENCE = "ball-crossengine"


def grey_lines(drawn, reference):
    """Return, for each tuner, the lines of a reference, one per panel."""
    named = {make_reference_id(reference, tuner): tuner for tuner in reference.tuners}
    found = {}
    for axis in drawn.axes:
        for line in axis.get_lines():
            if line.get_gid() in named:
                found.setdefault(named[line.get_gid()], []).append(line)
    return found


def legend(drawn):
    return [text.get_text() for text in drawn.legends[0].get_texts()]


def test_references_are_found_by_name_by_their_last_name_and_by_folder(tmp_path):
    assert {"ball-drop", "comparison/ball-wind", "multi/arm-swing"} <= set(list_reference_names())
    assert not {name for name in list_reference_names() if name.startswith("bounce-shot")}, (
        "it has no curves"
    )
    assert find_reference("ball-wind").folder == find_reference("comparison/ball-wind").folder
    # An exact name takes precedence over a name that ends with it.
    assert find_reference("ball-drop").name == "ball-drop"
    shutil.copytree(find_reference("ball-wind").folder, tmp_path / "mine")
    assert find_reference(str(tmp_path / "mine")).table.equals(find_reference("ball-wind").table)
    with pytest.raises(
        InputError, match=r"unknown reference 'ball-drip'; did you mean ball-drop\?"
    ):
        find_reference("ball-drip")


@pytest.mark.parametrize("name", ["environment.json", "table.csv", "experiment.toml"])
def test_what_is_damaged_is_said_in_a_line(name, tmp_path):
    folder = tmp_path / "mine"
    shutil.copytree(find_reference("ball-wind").folder, folder)
    (folder / name).write_text("{")
    with pytest.raises(InputError, match=re.escape(name)):
        find_reference(str(folder))


@pytest.mark.parametrize(
    ("name", "metric"), [("error", "param_abs_error"), ("misfit", "obs_error")]
)
def test_grey_lines_are_the_medians_of_the_table_up_to_the_budget(name, metric):
    reference = find_reference(REFERENCE)
    drawn = draw_figure(stored(), LABELS, name, references=[reference])
    found = grey_lines(drawn, reference)
    assert set(found) == set(reference.tuners)
    for tuner, lines in found.items():
        for line, kind in zip(lines, ("in", "wide"), strict=True):
            part = reference.table[
                (reference.table["tuner"] == tuner)
                & (reference.table["range"] == kind)
                & (reference.table["metric"] == metric)
                & (reference.table["simulations"] <= BUDGET)
            ]
            assert list(line.get_xdata()) == [0, 1, 2, 3, 5, 10]
            expected = np.maximum(part.set_index("simulations")["median"], ERROR_FLOOR)
            np.testing.assert_allclose(line.get_ydata(), expected[[0, 1, 2, 3, 5, 10]])
            assert line.get_color() == REFERENCE_GREYS[0]
    # All lines of the user are drawn after (above) the reference.
    own = [line for line in drawn.axes[0].get_lines() if line.get_gid() is None]
    assert min(line.get_zorder() for line in own) > found["random"][0].get_zorder()
    # A tuner has the same marker in both results.
    mine = next(line for line in own if line.get_label() == "random")
    assert mine.get_marker() == found["random"][0].get_marker()


def test_the_legend_and_the_caption_name_the_reference_with_its_version_and_how_it_differs():
    reference = find_reference(f"comparison/{REFERENCE}")
    drawn = draw_figure(stored(), LABELS, "error", references=[reference])
    assert f"thin, grey: {reference.name},\nsimgap {reference.simgap}" in legend(drawn)
    assert legend(drawn).count("random") == 2
    caption = drawn.get_supxlabel().replace("\n", " ")
    made = json.loads((reference.folder / "environment.json").read_text())
    assert made["started"][:10] in caption
    assert made["fingerprint"]["code"] in caption
    assert f"budget: {reference.document['budget']}, here {BUDGET}" in caption
    assert "Grey" not in draw_figure(stored(), LABELS, "error").get_supxlabel()


def test_two_references_have_two_greys_and_a_third_is_refused():
    two = [find_reference(REFERENCE), find_reference(f"comparison/{REFERENCE}")]
    drawn = draw_figure(stored(), LABELS, "error", references=two)
    shades = {grey_lines(drawn, each)["random"][0].get_color() for each in two}
    assert shades == set(REFERENCE_GREYS)
    with pytest.raises(InputError, match="expected 2 references at most, found 3"):
        draw_figure(stored(), LABELS, "error", references=[*two, two[0]])


def test_another_problem_and_another_figure_are_refused():
    with pytest.raises(InputError, match=r"of another problem than .*: simulator is pendulum"):
        draw_figure(stored(), LABELS, "error", references=[find_reference("pendulum-real")])
    with pytest.raises(
        InputError, match=r"figure runtime: expected one of error, misfit, directions"
    ):
        draw_figure(stored(), LABELS, "runtime", references=[find_reference(REFERENCE)])
