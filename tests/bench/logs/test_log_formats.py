"""Tests of every log format: a raw folder gives a verdict in two commands, and a damaged folder one
line.
"""

import json

import numpy as np
import pytest

from bench.cli.main import main
from bench.logs.recording_loading import load_recording
from tests.bench.logs.log_writers import (
    JOINTS,
    NEEDED,
    OPTIONS,
    WITH_RATES,
    WRITERS,
    motion_with_rates,
    write_folder,
)
from tests.command_output import run_command
from tests.malformed_input.input_strategies import log_folders, run_cases
from tests.malformed_input.malformed_case import tried

DAMAGES = 6
"""Number of damaged folders of each format; `make malformed KINDS=logs` makes thousands."""


def skip_without(kind):
    if kind in NEEDED:
        pytest.importorskip(NEEDED[kind], reason=f"{kind} is written with it")


@pytest.mark.parametrize("kind", WRITERS)
def test_the_numbers_of_a_folder_are_those_that_were_logged(kind, tmp_path):
    skip_without(kind)
    logs, model = write_folder(tmp_path, kind)
    out = tmp_path / "log.toml"
    run_command("import", logs, "--model", model, "--out", out, *OPTIONS.get(kind, ()))
    recording, _ = load_recording(out, divide=False)
    assert len(recording.runs) == 3
    for number, run in enumerate(recording.runs):
        times, q, v, u = motion_with_rates(number, 200)
        for k, joint in enumerate(JOINTS):
            seen = run.channels[f"q.{joint}"]
            own = np.isfinite(seen)
            np.testing.assert_allclose(seen[own], q[:, k], atol=1e-6)
            assert (f"qd.{joint}" in run.channels) == (kind in WITH_RATES)
            if kind in WITH_RATES:
                np.testing.assert_allclose(run.channels[f"qd.{joint}"][own], v[:, k], atol=1e-6)
            np.testing.assert_allclose(run.inputs[f"u.m_{joint}"][own], u[:, k], atol=1e-6)
        np.testing.assert_allclose(run.times[own] - run.times[own][0], times, atol=1e-6)


def test_two_commands_give_a_verdict(tmp_path, capsys):
    """The test above shows that the other formats give the same recording."""
    logs, model = write_folder(tmp_path, "csv")
    out, answer = tmp_path / "log.toml", tmp_path / "answer"
    assert main(["import", str(logs), "--model", str(model), "--out", str(out)]) == 0
    assert main(["explain", str(out), "--out", str(answer), "--jobs", "1"]) == 0
    verdict = json.loads((answer / "verdict.json").read_text())
    assert verdict["verdict"] == "adequate", capsys.readouterr().out


@pytest.mark.parametrize("kind", WRITERS)
def test_a_damaged_folder_is_one_line_and_nothing_is_written(kind, tmp_path):
    skip_without(kind)
    codes = []

    def act(case):
        codes.append(tried(case, tmp_path / str(len(codes)), {}).code)

    run_cases(log_folders(kind), DAMAGES, act)
    assert 2 in codes, "no folder was damaged"
