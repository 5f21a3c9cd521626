"""Tests of the segmentation of long robot logs: number, length, position and notes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.core.plugin_registries import simulators
from bench.diagnosis.explain import explain
from bench.logs import segmentation
from bench.logs.segmentation import segment_recording
from sims.core.simulator import Scenario
from sims.recording.recording import Recording, Run
from tests.bench.diagnosis.simulated_logs import describe, write_log
from tests.bench.diagnosis.test_parameter_freezing import DAMPING, MODEL
from tests.bench.logs.test_log_quality import multisine
from tests.sims.robot.test_robot_motion import kind_of


def recording_of(seconds, held_out=20.0):
    rng = np.random.default_rng(1)
    runs = []
    for name, length in (("a", seconds), ("b", seconds / 2), ("c", held_out)):
        t = np.arange(0.0, length, 0.02)
        # The command is active for 1 s and zero for the next 1 s.
        u = np.where(t % 2.0 < 1.0, multisine(t, rng), 0.0)
        q = {"q.hip": u, "q.knee": 0.5 * u}
        inputs = {"u.m_hip": u, "u.m_knee": 0 * u}
        runs.append(Run(name, t, q, inputs, {}, {"q.hip": 0.0}, name == "c"))
    return Recording(Path("log.csv"), "two", "", {}, {}, tuple(runs))


def test_a_short_log_is_whole(kind):
    recording = recording_of(30.0)
    found = segment_recording(recording, kind)
    assert found.recording is recording
    assert found.note == ""


def test_a_system_is_never_cut():
    recording = recording_of(1e4)
    assert segment_recording(recording, simulators.get("pendulum")).recording is recording


def test_a_long_log_is_cut_evenly_and_where_it_is_quiet(kind):
    whole = recording_of(4000.0)
    found = segment_recording(whole, kind)
    parts = found.recording.training()
    budget = segmentation.MAX_RECORDING_COST * 0.002 / (2 + 3)
    seconds = sum(run.times[-1] - run.times[0] for run in parts)
    assert seconds == pytest.approx(budget, rel=0.03)
    by_run = {name: [p for p in parts if p.name.startswith(f"{name} ")] for name in "ab"}
    assert len(by_run["a"]) == pytest.approx(2 * len(by_run["b"]), abs=1)
    for name, own in by_run.items():
        begins = np.array([p.times[0] for p in own])
        (run,) = [r for r in whole.runs if r.name == name]
        gaps = np.diff(np.concatenate([[run.times[0]], begins, [run.times[-1]]]))
        # The segments cover the whole run: no gap is as long as two average intervals.
        assert gaps.max() < 2.0 * run.times[-1] / len(own) + segmentation.SEGMENT_SECONDS
        # Segments start QUIET_LEAD_SECONDS after the command stops, in the second half of each 2 s.
        assert np.all(
            (begins % 2.0 >= 1.0 + segmentation.QUIET_LEAD_SECONDS - 0.04) | (begins % 2.0 == 0.0)
        )
        for part in own:
            first = np.flatnonzero(run.times == part.times[0])[0]
            rows = slice(first, first + part.times.size)
            np.testing.assert_array_equal(part.channels["q.hip"], run.channels["q.hip"][rows])
            np.testing.assert_array_equal(part.inputs["u.m_hip"], run.inputs["u.m_hip"][rows])
            # Only the segment at the start of a run has the known initial state of the run.
            assert bool(part.initial) == (first == 0)
    assert found.recording.held_out() == whole.held_out()
    assert "63.4 s of 6000 s for fitting, in 32 pieces" in found.note
    assert "measuring" not in found.note


def test_held_out_runs_are_cut_for_themselves(kind):
    found = segment_recording(recording_of(30.0, held_out=3000.0), kind)
    assert [run.name for run in found.recording.training()] == ["a", "b"]
    assert all(run.held_out for run in found.recording.held_out())
    assert len(found.recording.held_out()) > 10
    assert "for measuring, in " in found.note


def test_pieces_that_are_asked_for(kind):
    """A requested segment length also applies to built-in systems; the segments cover each run."""
    whole = recording_of(30.0)
    for simulator in (kind, simulators.get("pendulum")):
        found = segment_recording(whole, simulator, seconds=1.5)
        parts = [p for p in found.recording.training() if p.name.startswith("a ")]
        assert len(parts) == 20
        assert all(p.times[-1] - p.times[0] == pytest.approx(1.5, abs=0.021) for p in parts)
        assert "in 30 pieces" in found.note
    assert segment_recording(whole, kind, whole=True).recording is whole


def test_many_short_runs_are_all_there(kind):
    whole = recording_of(30.0)
    runs = [replace(whole.runs[0], name=str(i)) for i in range(400)]
    found = segment_recording(replace(whole, runs=(*runs, whole.runs[2])), kind)
    assert {p.name.split(" ")[0] for p in found.recording.training()} == {r.name for r in runs}
    assert all(p.times.size >= 2 for p in found.recording.training())


@pytest.mark.slow
def test_explain_reports_it_and_an_option_takes_the_whole(tmp_path, monkeypatch):
    """In a clean log of the pendulum, no effect is missing, with segments or with the whole log."""
    times = np.arange(0.0, 12.0, 0.02)
    model = MODEL.replace('damping="0.1"', f'damping="{DAMPING}"')
    simulator, rng, runs = kind_of(model)({}, ["q.hinge"]), np.random.default_rng(2), []
    for run in range(3):
        scenario = Scenario(times, {"q.hinge": 0.5 + 0.1 * run, "qd.hinge": 0.0}, {})
        seen = simulator.simulate(np.zeros((1, 0)), scenario)[0, :, 0]
        runs.append((times, seen + 0.01 * rng.standard_normal(times.size)))
    description = describe({"q.hinge": "rad"}, 0.01, model="swing")
    path = write_log(tmp_path, description, "q.hinge", runs, "swing", swing=model)
    monkeypatch.setattr(segmentation, "MAX_RECORDING_COST", 32000.0)
    said = []
    found = explain(path, say=said.append)
    assert found.verdict == "adequate"
    (note,) = [text for text in said if "pieces" in text]
    # All three runs are fitted, and each is validated with the other two.
    assert note.startswith("of the recording 5.94 s of 35.94 s for fitting")
    assert note in found.story.lack_of_fit
    samples = sum(len(t) for t in found.story.fitting.times)
    said.clear()
    whole = explain(path, say=said.append, whole=True)
    assert not [text for text in said if "pieces" in text]
    assert sum(len(t) for t in whole.story.fitting.times) > 2 * samples
