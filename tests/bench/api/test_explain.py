import pytest

import simgap


@pytest.fixture(scope="module")
def swing():
    return simgap.simulate(
        "pendulum", effects={"drag.linear": 8e-4}, noise={"q": 0.003, "qd": 0.02}, runs=3,
        seconds=1.5, rate=60
    )  # fmt: skip


@pytest.fixture(scope="module")
def explained(swing):
    return simgap.explain(swing)


def test_a_recording_is_explained_from_memory_as_from_its_file(swing, explained, tmp_path):
    swing.write(tmp_path / "swing.csv")
    found = [explained, *map(simgap.explain, (swing.recording, tmp_path / "swing.csv"))]
    assert [one.verdict for one in found] == ["named"] * 3
    (cause,) = found[0].causes
    assert cause.effect == "drag.linear"
    drag = cause.coefficients["coefficient"]
    assert drag.low < 8e-4 < drag.high
    # Numbers in the file have nine digits.
    values = [one.extended.effects["drag.linear"]["coefficient"].value for one in found]
    assert values[0] == values[1] == pytest.approx(values[2], rel=1e-5)


def test_a_single_run_in_memory_is_divided_as_one_that_is_read():
    recording = simgap.simulate("pendulum", runs=1, noise=0.003).recording
    assert len(recording.runs) == 1
    found = simgap.explain(recording)
    assert found.verdict == "adequate"
    assert found.story.held_out is not None


def test_what_a_cell_shows_is_one_line(swing):
    assert repr(swing.recording) == (
        "<recording pendulum-simulated.csv: pendulum, 3 runs, 1 of them held out, channels q, qd>"
    )
    assert repr(swing.recording.runs[0]) == "<run 1: 90 samples, 1.483 s, for fitting>"
    assert "\n" not in repr(swing)
    assert len(repr(swing)) < 200


def test_the_extended_simulator_scores_and_simulates(swing, explained, tmp_path):
    explained.write(tmp_path / "out")
    swing.write(tmp_path / "swing.csv")
    errors = simgap.score(tmp_path / "out" / "extended.toml", tmp_path / "swing.csv")
    assert errors["normalised_rmse"] == pytest.approx(1.0, abs=0.1)
    simulator = explained.extended.simulator()
    assert [p.name for p in simulator.parameters] == ["inertia", "drag.linear"]


def test_faults_speak_python():
    for wrong, message in [
        ({"parameters": {"inertia": 1.0}}, "parameter inertia = 1: expected "),
        ({"effects": {"drag.linear": {"c": 1.0}}}, "unknown coefficient of effect drag.linear 'c'"),
        ({"noise": -1}, "noise of q = -1: expected at least 0"),
        ({"noise": "large"}, "noise: expected a number or .*, found 'large'"),
        ({"initial": {"q": (1.0, 0.0)}}, "initial state q = 1:0: expected low <= high"),
        ({"initial": {"q": (1.0, 2.0, 3.0)}}, r"initial\[.q.\]: expected a number or \(low,"),
        ({"runs": 0}, "runs = 0: expected at least 1"),
    ]:
        with pytest.raises(simgap.InputError, match=message) as caught:
            simgap.simulate("pendulum", **wrong)
        assert "--" not in str(caught.value)
    assert (
        simgap.simulate(
            "pendulum", effects={"friction.stribeck": {"coulomb": 0.01}}, runs=2, seconds=0.1
        ).truth["effects"]["friction.stribeck"][0]
        == 0.01
    )
