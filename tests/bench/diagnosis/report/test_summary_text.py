import re
from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis.report.cause_and_value_text import (
    format_effect,
    format_effect_name,
    format_estimate,
    format_number,
    format_p_value,
    format_percent,
    format_sentence,
    format_unit,
    joined,
)
from bench.diagnosis.report.detectable_gap import compute_detectable_gap
from bench.diagnosis.report.report_data import ChannelInfo, DataSplit
from bench.diagnosis.report.summary_text import (
    format_headline,
    format_summary,
    get_held_out_unit,
)
from tests.bench.diagnosis.sample_report_data import (
    DRAG,
    EITHER,
    HELD_OUT,
    NEXT,
    TILT,
    evil,
    gain_text,
    make_report,
    summary_text,
)

VERDICTS = ("adequate", "named", "ambiguous", "partial", "unknown", "unidentifiable")


@pytest.mark.parametrize(
    ("verdict", "headline"),
    [
        ("adequate", "These data show no effect that the simulation lacks."),
        ("named", "The simulation lacks linear drag: motion is resisted in proportion to speed."),
        (
            "ambiguous",
            "The simulation lacks linear drag or Coulomb friction: these data do not show which.",
        ),
        (
            "partial",
            "The simulation lacks linear drag, and something else that no known cause explains.",
        ),
        (
            "unknown",
            "Something is missing from the simulation, and none of the 6 known causes explains it.",
        ),
        (
            "unidentifiable",
            "These data do not identify inertia: it is not known what the simulation lacks.",
        ),
    ],
)
def test_each_verdict_has_its_headline(verdict, headline):
    report = make_report(verdict)
    assert format_headline(report) == headline
    assert headline in summary_text(report)


def test_only_found_causes_are_said_to_be_lacking():
    for verdict in ("adequate", "unknown", "unidentifiable"):
        assert "lacks linear drag" not in summary_text(make_report(verdict))


def test_several_causes_are_named_together():
    report = make_report(causes=[DRAG, TILT])
    assert format_headline(report) == "The simulation lacks linear drag and a tilt of gravity."
    assert "Together they close 90 % of the gap" in gain_text(report)
    assert "gravity has a horizontal component" in summary_text(report)


def test_an_ambiguous_cause_with_a_certain_one():
    report = make_report("ambiguous", causes=[EITHER, TILT])
    expected = (
        "The simulation lacks a tilt of gravity, and linear drag or Coulomb friction: "
        "these data do not show which."
    )
    assert format_headline(report) == expected


def test_a_partial_verdict_keeps_what_cannot_be_distinguished():
    assert "linear drag or Coulomb friction, and something else" in format_headline(
        make_report("partial", causes=[EITHER])
    )


def test_the_gain_of_a_partial_verdict_is_that_of_the_named_cause():
    assert gain_text(make_report("partial")).startswith("Linear drag closes 90 % of the gap")


def test_unidentifiable_names_the_unidentified_parameters():
    assert format_headline(
        make_report("unidentifiable", unidentified_parameters=("mass", "inertia"))
    ).startswith("These data do not identify mass and inertia:")


def test_the_gain_is_reported_with_its_interval_and_units():
    said = gain_text(make_report())
    assert "closes 90 % of the gap (85 to 94 %)" in said
    assert "0.37 rad before and 0.045 rad after" in said
    assert said.endswith("the sensor noise alone would give 0.01 rad.")


def test_without_held_out_runs_the_gain_is_not_claimed():
    report = make_report(heldout=None, held_out=None)
    side = report.fitting
    before = np.sqrt(np.nanmean(((side.observed - side.before) / [0.01, 0.05]) ** 2))
    assert "No run is held out" in gain_text(report)
    assert f"{before:.3g} times the noise before" in gain_text(report)
    assert "of the gap" not in gain_text(report)


def test_nothing_is_called_closed_where_no_share_is_known():
    found = {**HELD_OUT, "gap_closed": None, "low": None, "high": None}
    assert "of the gap" not in gain_text(make_report(heldout=found))
    assert "0.045 rad after" in gain_text(make_report(heldout=found))


def test_a_weak_cause_under_unknown_is_not_sold_as_the_answer():
    report = make_report(
        "unknown", causes=[DRAG], heldout={**HELD_OUT, "gap_closed": 0.3, "low": 0.1, "high": 0.5}
    )
    assert format_headline(report).startswith("Something is missing")
    assert gain_text(report).startswith(
        "The best of them, linear drag, closes only 30 % of the gap (10 to 50 %)"
    )


def test_a_score_that_simulations_do_not_confirm_is_not_called_insignificant():
    report = make_report("adequate")
    candidates = [replace(candidate, p_value=1e-9) for candidate in report.verdict.candidates]
    report = replace(report, verdict=replace(report.verdict, candidates=candidates))
    said = gain_text(report)
    assert "tested and none improves the simulation significantly; the most promising is" in said
    assert "p <" not in said
    assert "p = " not in said


def test_adequate_says_what_was_looked_for_and_what_could_hide():
    said = gain_text(make_report("adequate"))
    assert "6 possible causes were tested" in said
    assert "p = 0.4" in said
    assert re.search(
        r"Noise could conceal a gap of up to 0\.00\d+ rad in q .* and 0\.0\d+ rad/s in qd .* "
        "RMS",
        said,
    )


def test_a_gap_that_hides_is_smaller_with_more_samples_and_larger_than_a_true_one():
    rng = np.random.default_rng(0)

    def limit(samples, true, stated=True):
        times = np.arange(samples) / 100.0
        residual = (
            rng.normal(size=(1, samples, 1)) + true * np.sqrt(2) * np.sin(times)[None, :, None]
        )
        side = DataSplit(
            ("1",), (times,), residual, np.zeros_like(residual), np.zeros_like(residual)
        )
        return compute_detectable_gap(
            make_report(
                fitting=side, held_out=None, channels=(ChannelInfo("q", "rad", 1.0, stated, 0.0),)
            )
        )[0]

    assert 0.1 < limit(10_000, 0.0) < limit(300, 0.0) < 0.6
    assert limit(300, 0.0, stated=False) > limit(300, 0.0)
    for true in (0.3, 1.0, 3.0):
        assert true < limit(3000, true) < true + 0.3


def test_ambiguous_proposes_the_experiment_and_says_so_if_there_is_none():
    assert "To distinguish them: Release it from 1.5 rad" in summary_text(make_report("ambiguous"))
    assert "no experiment is proposed" in summary_text(
        make_report("ambiguous", next_experiment=None)
    )
    assert "Next experiment: Release it" in summary_text(
        make_report("unidentifiable", next_experiment=NEXT)
    )


def test_the_unit_of_the_gain_is_that_of_the_channels_whose_noise_is_its_floor():
    assert get_held_out_unit(make_report()) == "rad"
    assert get_held_out_unit(make_report(heldout={**HELD_OUT, "noise_floor": 0.05})) == "rad/s"
    assert get_held_out_unit(make_report(heldout={**HELD_OUT, "noise_floor": 1.0})) == "1"
    assert get_held_out_unit(make_report(heldout={**HELD_OUT, "unit": "m"})) == "m"


def test_parameters_tell_what_they_had_absorbed():
    said = summary_text(make_report())
    assert (
        "inertia 0.00333 (0.00325 to 0.00341) kg·m² before, "
        "0.00351 (0.00345 to 0.00357) kg·m² after (+5.4 %)" in said
    )
    assert "it had absorbed part of the gap" in said
    assert "restitution does not influence these data and stays at its nominal 0.7." in said


def test_the_largest_gap_is_located():
    said = summary_text(make_report())
    assert (
        "run 4 (13 before, 1.1 after); channel qd (11 before, 1.1 after); "
        "phase last third (16 before, 1.2 after)" in said
    )
    assert "gap is largest" not in summary_text(make_report("adequate"))


@pytest.mark.parametrize("verdict", VERDICTS)
def test_the_account_is_short_and_fits_a_terminal(verdict):
    lines = format_summary(make_report(verdict))
    assert len(lines) <= 32
    assert max(len(line) for line in lines) <= 100
    assert "nan" not in summary_text(make_report(verdict)).lower()
    assert "None" not in summary_text(make_report(verdict))


def test_a_terminal_obeys_nothing_in_the_data():
    assert all(line.isprintable() for line in format_summary(evil()))


def test_numbers_read_well():
    numbers = (0.0, 0.0333333, 2.2e-4, 1234.5, 1.5e9, -0.5, np.nan, None)
    assert [format_number(v) for v in numbers] == [
        "0", "0.0333", "2.2×10⁻⁴", "1230", "1.5×10⁹", "−0.5", "–", "–"
    ]  # fmt: skip
    assert format_number(0.00099996) == "0.001"
    # The smallest float; no power of ten is as small.
    assert format_number(5e-324) == "4.94×10⁻³²⁴"
    assert format_estimate(1e-320, 0.0, 2e-320) == "1.0×10⁻³²⁰ (0.0×10⁻³²⁰ to 2.0×10⁻³²⁰)"
    assert [format_percent(v) for v in (0.9, 0.034, 0.998, 1.0, -0.2, None)] == [
        "90 %",
        "3.4 %",
        "99.8 %",
        "100 %",
        "−20 %",
        "–",
    ]
    assert [format_p_value(p) for p in (0.03, 1e-9, 0.0, None)] == [
        "p = 0.03",
        "p = 1×10⁻⁹",
        "p < 1×10⁻¹²",
        "p unknown",
    ]


def test_estimates_have_the_digits_of_their_intervals():
    assert format_estimate(0.00333, 0.0033, 0.0034) == "0.00333 (0.00330 to 0.00340)"
    assert format_estimate(2.2e-4, 2.0e-4, 2.4e-4) == "2.20×10⁻⁴ (2.00×10⁻⁴ to 2.40×10⁻⁴)"
    assert format_estimate(-0.1, -0.2, 0.05) == "−0.10 (−0.20 to 0.05)"
    assert format_estimate(1500.0, 1400.0, 1600.0) == "1500 (1400 to 1600)"
    assert (
        format_estimate(0.5, None, None)
        == format_estimate(0.5, np.nan, np.nan)
        == "0.5 (no interval)"
    )


def test_units_and_names_read_well():
    assert [format_unit(u) for u in ("kg*m^2", "1/(m^2*s^2)", "m*s^-2", "1")] == [
        "kg·m²",
        "1/(m²·s²)",
        "m·s⁻²",
        "",
    ]
    assert format_effect("drag.linear+wind") == "linear drag and wind"
    assert format_effect("my.plugin") == "my.plugin"
    assert joined(["a", "b", "c"], "or") == "a, b or c"
    assert format_sentence("drag.linear wins") == "drag.linear wins."
    assert format_sentence("no other does!") == "No other does!"


def test_a_plugin_says_its_own_noun_or_stands_with_what_it_says(fresh_registries):
    from sims import effects
    from sims.effects.external_force import LinearSpring

    class Magnet(LinearSpring):
        name = "spring.magnet"
        noun = "a magnet's pull"
        says = "a magnet holds it near zero, and lets go further away"

    class Plain(Magnet):
        name = "spring.plain"
        noun = ""

    effects.register_effect(Magnet)
    effects.register_effect(Plain)
    assert format_effect("spring.magnet+wind") == "a magnet's pull and wind"
    assert format_effect_name("spring.magnet") == "magnet's pull"
    assert format_effect("spring.plain") == "spring.plain (a magnet holds it near zero)"


def test_every_registered_effect_has_a_noun():
    from sims import effects

    assert [
        name for name in effects.list_names() if format_effect(name) == name and "." in name
    ] == []


CUT = {"by": "budget", "during": "refit of drag.linear and 3 more", "not_asked": ["rivals"]}


def test_an_early_end_is_reported_before_anything_else():
    report = summary_text(make_report("unknown", cut=CUT, causes=[DRAG]))
    assert "The search stopped before it identified what the simulation lacks; best" in report
    assert "by its time budget; last step: refit of drag.linear and 3 more. Not" in report
    assert "none of the 6 known causes" not in report, "they were not all asked"
    report = summary_text(make_report("unknown", cut={**CUT, "by": "interrupt"}))
    assert (
        "before it identified what the simulation lacks. The search was stopped by an in" in report
    )
    report = summary_text(make_report("partial", cut={**CUT, "not_asked": ["structure"]}))
    assert "lacks linear drag; the search stopped before testing for further causes." in report
    assert "something else that no known cause explains" not in report


def test_held_out_runs_that_were_not_asked_are_not_said_to_be_missing():
    cut = {**CUT, "not_asked": ["held_out", "structure"]}
    report = summary_text(make_report("unknown", cut=cut, heldout=None))
    assert "The gain was not measured on held-out runs" in report
    assert "No run is held out" not in report
