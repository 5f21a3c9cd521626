import warnings
from dataclasses import replace
from io import BytesIO

import matplotlib.image
import numpy as np
import pytest

from bench.diagnosis.report.candidate_ranking import (
    MAX_SHOWN_CANDIDATES,
    get_candidate_status,
    select_shown_candidates,
)
from bench.diagnosis.report.explanation_figures import draw_figure, render_figures
from bench.diagnosis.report.explanation_page import render_report
from bench.diagnosis.report.report_data import GapLocation
from bench.diagnosis.report.residual_figure import (
    draw_profile_panel,
    select_gap_locations,
    select_informative_profiles,
)
from bench.diagnosis.report.run_selection import select_worst_run
from bench.figures.figure_settings import pdf_figures
from tests.bench.diagnosis.sample_report_data import evil, make_report

NAMES = ["overview", "where", "candidates"]


def pixels(png):
    return matplotlib.image.imread(BytesIO(png))[:, :, :3]


@pytest.fixture(scope="module")
def named():
    with pdf_figures():
        return render_figures(make_report())


def test_each_figure_is_there_in_every_format_and_shows_something(named):
    assert list(named) == NAMES
    for png, svg, pdf, spots in named.values():
        assert svg.startswith(b"<?xml")
        assert spots == ()
        assert pdf.startswith(b"%PDF-")
        assert len(pdf) > 5_000
        image = pixels(png)
        assert image.std() > 0.1
        assert min(image.shape[:2]) > 300
        edge = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        assert edge.min() == 1.0  # nothing is cut off


def test_before_and_after_are_both_drawn_where_there_is_an_after(named):
    def share(png, red, green, blue):
        return (np.abs(pixels(png) - np.array([red, green, blue]) / 255).max(axis=2) < 0.02).mean()

    blue = (0x00, 0x72, 0xB2)
    assert share(named["overview"].png, *blue) > 5e-3
    adequate = render_figures(make_report("adequate"))["overview"].png
    assert share(adequate, *blue) == 0.0
    assert share(adequate, 0xD5, 0x5E, 0x00) > 1e-3


def test_figures_are_the_same_again(named):
    with pdf_figures():
        assert render_figures(make_report()) == named


def test_a_page_with_its_figures_stays_small(named):
    assert 100_000 < len(render_report(make_report(), named).encode()) < 2_000_000


def test_any_text_can_be_a_label():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(render_figures(evil())) == NAMES


def test_what_is_not_there_is_not_drawn():
    bare = make_report(
        "unidentifiable", candidates=[], gap_locations=(), profiles=(), held_out=None, heldout=None
    )
    assert list(render_figures(bare)) == NAMES[:1]


def test_the_run_shown_has_the_largest_gap_of_the_held_out_ones():
    told = make_report()
    shot = select_worst_run(told)
    assert shot.held_out
    assert shot.name == "held 2"
    rest = select_worst_run(replace(told, held_out=None))
    assert not rest.held_out
    assert rest.name == "4"


def test_a_run_without_samples_is_never_the_worst():
    told = make_report()
    observed = told.held_out.observed.copy()
    observed[1] = np.nan
    shot = select_worst_run(replace(told, held_out=replace(told.held_out, observed=observed)))
    assert shot.row == 0


def test_of_many_channels_the_worst_ten_are_shown():
    told = make_report()
    tiles = (1, 1, 6)
    wide = {
        side: replace(
            getattr(told, side),
            **{
                name: np.tile(getattr(getattr(told, side), name), tiles)
                for name in ("observed", "before", "after")
            },
        )
        for side in ("fitting", "held_out")
    }
    figure = draw_figure(replace(told, channels=told.channels * 6, **wide), "overview")
    assert len(figure.axes) == 2 * 10
    assert "the worst 10 of 12 channels" in figure.get_suptitle()
    assert "joint by joint" not in figure.get_suptitle()
    assert figure.axes[1].get_title(loc="left") == "residual [σ]"


def test_profiles_are_chosen_by_how_much_they_stand_out_one_a_variable_first():
    chosen = select_informative_profiles(make_report().profiles)
    assert [p.variable for p in chosen] == ["speed", "position", "time", "speed"]
    empty = replace(chosen[0], before=np.full(12, np.nan))
    assert select_informative_profiles([empty, chosen[1]]) == [chosen[1]]


def test_bars_of_a_profile_are_two_standard_errors_long():
    from matplotlib.figure import Figure

    axis = Figure().subplots()
    profile = make_report().profiles[0]
    draw_profile_panel(axis, profile, "rad", extended=False)
    (lines,) = axis.containers[0].lines[2]
    lengths = [segment[1, 1] - segment[0, 1] for segment in lines.get_segments()]
    assert lengths == pytest.approx([4 * 0.01 / 12] * 11)


def test_the_worst_places_are_shown_in_their_order():
    places = [GapLocation("run", str(i), 100, float(i % 10), 1.0) for i in range(30)] + [
        GapLocation("run", "x", 0, 99.0, 1.0)
    ]
    shown = select_gap_locations(places)
    assert [p.label for p in shown] == ["7", "8", "9", "17", "18", "19", "28", "29"]


def test_what_is_found_is_among_the_candidates_shown_although_it_scores_low():
    names = [f"e{i}" for i in range(40)] + ["drag.linear"]
    told = make_report(
        candidates=[
            {"effect": n, "score": 100.0 - i, "p_value": 0.5, "heldout_gain": None}
            for i, n in enumerate(names)
        ]
    )
    shown = [c.effect for c in select_shown_candidates(told)]
    assert len(shown) == MAX_SHOWN_CANDIDATES
    assert shown[0] == "e0"
    assert shown[-1] == "drag.linear"


def test_the_standing_of_a_candidate():
    assert [
        get_candidate_status(make_report(), n) for n in ("drag.linear", "friction.coulomb")
    ] == [
        "found",
        "not needed",
    ]
    told = make_report("ambiguous")
    assert {get_candidate_status(told, n) for n in ("drag.linear", "friction.coulomb")} == {
        "found, but not distinguishable"
    }
    assert get_candidate_status(told, "my.plugin") == "not needed"
