"""Tests that the pages on measured recordings agree with their verdicts and data sheets."""

import re

import pytest

from sims.core.toml_validation import read_toml
from tests.benchmarks import real_recordings as measured
from tests.docs.documentation_pages import tables
from tests.docs.page_numbers.number_sources import NUMBER, Account
from tests.docs.page_numbers.source_tables import REFERENCE, document

REAL = REFERENCE / "real"
ELSEWHERE = "of a run, fit or publication that is not kept here"


def value(verdict, effect, name="coefficient"):
    """Return a coefficient of a diagnosed cause."""
    causes = {cause["effect"]: cause["coefficients"] for cause in verdict["causes"]}
    return causes[effect][name]["value"]


def recordings():
    """Check results/reference/real/table.md."""
    page = Account("results/reference/real/table.md")
    page.written(rows(page.text))
    return page


def rows(text):
    """Build the table rows from the verdicts, for every recording that has a row in the text."""
    names = re.findall(r"^\| \[([\w/]+)\]", text, re.M)
    assert len(names) == 16
    return "\n".join(measured.row(REAL, REAL / name) for name in names)


def so101_rows():
    """Build the rows of the SO-101's table: error by motion, model and joint."""
    (head, *body) = tables((REAL / "so101" / "table.md").read_text(encoding="utf-8"))[0]
    return {
        (row[0].strip("*"), row[1], joint): cell
        for row in body
        for joint, cell in zip(head[2:], row[2:], strict=True)
    }


def so101():
    """Check results/reference/real/so101/table.md."""
    page = Account("results/reference/real/so101/table.md")
    verdict = document("real/so101/explained/verdict.json")
    names = "; ".join(cause["effect"] for cause in verdict["causes"])
    page.says(f"partial: {names}; {{}} s", verdict["seconds"])
    cells = so101_rows()
    motions = sorted({motion for motion, *_ in cells} - {"all six"})

    def expected(row, heading):
        """Return the expected error; the last two rows are the root mean square of the others."""
        motion, model = row["motion (not fitted)"].strip("*"), row["model"]
        if heading in ("motion (not fitted)", "model"):
            return None
        if motion != "all six":
            return [cells[motion, model, heading]]
        squares = [float(cells[one, model, heading]) ** 2 for one in motions]
        mean = (sum(squares) / len(squares)) ** 0.5
        # The rows are rounded, so their mean agrees only to within one digit.
        text = cells[motion, model, heading]
        return [text if abs(mean - float(text)) < 0.06 + 0.005 * mean else mean]

    assert page.table("motion (not fitted)", expected) == 14 * 6
    return page


def summary():
    """Check results/reference/real/README.md."""
    page = Account("results/reference/real/README.md")
    page.written(rows(page.text))
    drops = {
        f"ball_drops/{name}": document(f"real/ball_drops/{name}/verdict.json")["heldout"]
        for name in ("green_basketball", "blue_basketball", "golf_ball")
    }
    basket = [drops[f"ball_drops/{n}_basketball"]["rmse_extended"] for n in ("green", "blue")]
    page.says("too ({} m, below the floor)", basket[0])
    page.says("the held-out drop ({} m): a cause", basket[1])
    page.known("3.3 times the noise of the fitted drop", "of the search, which is not kept")
    page.known("there (1.3 times) and", "of the search, which is not kept")
    page.known("a cause of 40 samples", "the recording")
    golf = drops["ball_drops/golf_ball"]
    page.says("shows {} times the floor", golf["rmse_base"] / golf["noise_floor"])
    servo = document("real/servo_pendulum/recording/verdict.json")["heldout"]
    page.says("on unseen gains {} rad", servo["rmse_extended"])
    page.says("gave 0.065, Coulomb's 0.086 and none {}.", servo["rmse_base"])
    page.known("gave 0.065, Coulomb's 0.086", ELSEWHERE)
    fall = document("real/smartphone_fall/fall/verdict.json")["heldout"]
    page.says("which do as well; {} m/s²", fall["rmse_extended"])
    page.known("a quick fit gave 0.071", ELSEWHERE)
    page.known("(0.0034 rad)", ELSEWHERE)
    page.known("Run on 23 November with 55 effects", "the version")
    page.known("the others with 54)", "the version")
    page.known("within 3 % of the published values", "the percentages below")
    page.known("Open loop over 25 s", "the recording")
    page.known("one drop of some 40 samples", "the recording")
    page.known("No single further effect takes off more than 15 %", ELSEWHERE)
    page.known("(90 times the encoder's step there)", ELSEWHERE)
    thorough(page, document("real/servo_pendulum/recording/verdict.json"))
    carriage(page)
    arm(page)
    return page


def thorough(page, plain):
    """Check the statements on the thorough search in servo_pendulum."""
    found = document("real/servo_pendulum/thorough/verdict.json")
    before, after = plain["heldout"], found["heldout"]
    less = 100 * (1 - after["rmse_extended"] / before["rmse_extended"])
    page.says("in its place: {} rad on unseen gains, {} % less", after["rmse_extended"], less)
    shares = [100 * held["gap_closed"] for held in (after, before)]
    page.says("{} % of the gap instead of {}.", *shares)
    load = [value(verdict, "friction.load") for verdict in (plain, found)]
    page.says("load falls from {} to {} of the load", *load)
    winding = [verdict["parameters"]["resistance"]["value"] for verdict in (plain, found)]
    page.says("resistance from {} to {} Ω", *winding)


def carriage(page):
    """Check the lines on emps."""
    verdict = document("real/emps/explained/verdict.json")
    viscous = [value(verdict, "friction.direction@screw", f"viscous{way}") for way in "+-"]
    page.says("by direction, {} and {} N·s/m", *viscous)
    share = [
        100 * (ours / theirs - 1) for ours, theirs in zip(viscous, (166.7, 240.4), strict=True)
    ]
    page.says("(published 166.7 and 240.4: {} and {} % above)", *share)
    page.known("(published 166.7 and 240.4:", "published")
    dry = [value(verdict, "friction.position@screw", name) for name in ("least", "sine", "cosine")]
    page.says("between {} and {} N", dry[0], dry[0] + 2 * (dry[1] ** 2 + dry[2] ** 2) ** 0.5)
    mass = 100 * (1 + verdict["parameters"]["mass.scale@carriage"]["value"])
    page.says("mass {} kg, {} % below", mass, 100 * (1 - mass / 95.1))
    page.known("95.1; the error of", "published")
    held = verdict["heldout"]
    page.says("falls from {} to {} mm", 1e3 * held["rmse_base"], 1e3 * held["rmse_extended"])
    page.known(
        "With 54 effects the dry friction was told as the same everywhere, 21.4 N", ELSEWHERE
    )
    page.known("beside 157.7 and 229.1 N·s/m, with a ripple of 0.7 N", ELSEWHERE)
    page.known("and 0.114 mm were left.", ELSEWHERE)
    for words in (
        "at 1 kHz, a slide joint of 100 kg",
        "fitted on run 1 in pieces",
        "measured on run 2 with",
        "(published by direction 20.14 and 20.63 N)",
        "motion on run 2 falls",
        "(0.14 with one viscous",
        "The offset of −3.2 N",
        "8 to 16 minutes on",
        "known to ±2.4 %, not to the ±0.04 %",
        "in units of 50 N, since a slider's mass ends at 10 kg",
        "110 s, 35 s of a core. Fitted on run 1 it finds viscous friction of 158.0 and 238.2",
        "Coulomb friction of 21.0 N and 93.9 kg; run 2 goes from 1.49 to 0.116 mm.",
        "Fitted on run 2, with the pulses",
        "(19.9 N and a wave of 0.57 N that repeats every 0.20 m)",
        "(174 and 256 N·s/m), at 93.3 kg",
        "(run 1 then predicts run 2 to 0.116 mm as before, run 2 predicts run 1 to 0.121)",
        "4.5 times the encoder's step",
    ):
        page.known(words, ELSEWHERE)


def arm(page):
    """Check the lines on so101."""
    verdict = document("real/so101/explained/verdict.json")
    page.says("are {} ms late", 1e3 * value(verdict, "sensor.delay@*", "coefficient"))
    (load,) = (c["coefficients"] for c in verdict["causes"] if c["effect"] == "friction.load@*")
    shares = sorted(100 * number["value"] for number in load.values())
    assert shares[0] < 0.01, "of the gripper"
    page.says("({} to {} % of it)", shares[1], shares[-1])
    cells = so101_rows()
    page.table(
        "six motions not fitted",
        lambda row, joint: (
            None
            if joint.startswith("six")
            else [cells["all six", row["six motions not fitted, RMSE in mrad"], joint]]
        ),
    )
    base = [
        cells[m, "extended", "shoulder_pan"]
        for m in ("single_joint_rotation", "large_amplitude", "prbs_excitation")
    ]
    page.says("{} (single joint), {} (large amplitude) and {} mrad (prbs)", *base)
    worse = [
        joint
        for (motion, model, joint), cell in cells.items()
        if motion == "prbs_excitation"
        and model == "extended"
        and float(cell) > float(cells[motion, "as imported", joint])
    ]
    page.says("is predicted worse at {} of six", len(worse))
    for words in (
        "After 15 minutes",
        "(4.0, 6.0 and 20.5; 5.6, 16.1 and 17.2 without",
        "(5.5, 18.5, 16.1, 13.3, 9.2, 30.4)",
    ):
        page.known(words, ELSEWHERE)


def sheets():
    """Check results/reference/real/datasheets."""
    page = Account("results/reference/real/datasheets/README.md")
    drive = read_toml(REAL / "datasheets" / "xl330" / "sheet.toml")["quantities"]
    servo = document("real/servo_pendulum/recording/verdict.json")
    ratio = drive["torque constant over resistance"]
    half = 100 * (ratio["high"] - ratio["low"]) / 2 / ratio["value"]
    page.says("over resistance {} N·m/V (±{} %)", ratio["value"], half)
    page.says("stall torque {} N·m", drive["stall torque"]["value"])
    page.says("armature {} kg·m²", drive["armature"]["value"])
    load = value(servo, "friction.load")
    page.says("grows with {} of the load", load)
    base = read_toml(REAL / "datasheets" / "so101-base" / "sheet.toml")["quantities"]
    zone = base["servo.deadband@m_shoulder_pan"]
    page.says(
        "a dead zone of {} mrad, ± {} (",
        1e3 * zone["value"],
        1e3 * (zone["high"] - zone["low"]) / 2,
    )
    page.says("stiffness, {} N·m/rad", base["actuator.stiffness@m_shoulder_pan"]["value"])
    slow = document("real/datasheets/so101-base/slow/verdict.json")
    (dry,) = (c for c in slow["causes"] if c["effect"] == "friction.coulomb@shoulder_pan")
    assert dry["alternatives"] == ["servo.deadband@m_shoulder_pan"]
    found = dry["coefficients"]["coefficient"]
    page.says(
        "names friction of {} N·m, ± {}, or",
        found["value"],
        (found["high"] - found["low"]) / 2,
    )
    page.says("noise, and {} % of the gap", 100 * slow["heldout"]["gap_closed"])
    for words in (
        "The library of 25 November (56 effects)",
        "in pieces of 8 s (`simgap explain slow.toml --jobs 1 --pieces 8`, 37 minutes",
        "is a start 2 rad away",
        "it needs 1.71 times the load's torque, and holds it with 0.59 of it",
        "none above 8 mrad; play: none above 16 mrad",
        "explained for 25 minutes",
        "fit: 11.2 mrad)",
        "inertia of 0.0127 kg·m²",
        "as 14 ± 4 mN·m",
        "few encoder steps (1.5 mrad)",
        "in pieces of 2 s the verdict was `unknown` (33 noises left)",
        "dry friction of 14 mN·m stood",
        "(13 noises left)",
        "Fitted to the first 80 s of `chirp_sweep` (`python -m tests.benchmarks.so101_base`)",
        "with a lead of 50 ms held",
        "(4.5 N·m/rad without, 2.1 and 1.6 with)",
        "leaves 2.9 mrad up to 80 s, then 4.6, 6.8 and 14.6, and 82.5 mrad beyond 112 s",
        "(0.29 N·m, tried once) takes that to 58 mrad",
        "254 times 100 encoder steps, is 38.96 rad/s², 2.7 % less",
        "reaches 2.05 rad/s within 25 ms",
        "it predicts `prbs_excitation` to 8.2 mrad, which the profile misses by 25.6",
        "the dead zone by 18.2 (by 10.4 where it never saw the fast end), and steps to 2.2",
        "follows better (9.4 mrad, 38.6 here)",
    ):
        page.known(words, ELSEWHERE)
    scores = (
        "rad, runs driven throughout",
        "mrad | backlash",
        "mrad | dead zone",
        "mrad, fitted to the whole",
        "mrad | fitted to",
    )
    for header in scores:
        for found in re.finditer(re.escape(f"| RMSE in {header}"), page.text):
            end = page.text.index("\n\n", found.start())
            numbers = NUMBER.finditer(page.text, found.start(), end)
            page.held.update(n.span() for n in numbers)  # numbers in the rows of scores
    return page


PAGES = {"table": recordings, "so101": so101, "summary": summary, "sheets": sheets}


@pytest.mark.parametrize("name", PAGES)
def test_every_number_is_that_of_the_tables(name):
    page = PAGES[name]()
    assert page.wrong == []
    assert page.left() == []
