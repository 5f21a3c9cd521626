"""Tests of the answers of a diagnoser and of the cost of its simulations."""

import pytest

from bench.core.diagnoser import Answer, Diagnoser, NamedCause
from bench.diagnosis_benchmark.diagnoser_process import diagnose_case, get_simulator
from bench.logs.synthetic_recording import SimulationSpec, simulate_recording
from sims.core.simulation_counter import (
    SIMULATION_COUNTER,
    SimulationBudgetExceededError,
    SimulationCounter,
)
from sims.core.simulator import InputError, Scenario


def test_answers_may_be_strings_dictionaries_or_answers():
    assert Answer.of("adequate") == Answer("adequate")
    cause = {"effect": "wind", "alternatives": ["drag.linear"], "p_value": 0.5}
    cause["coefficients"] = {"speed": {"low": 1.0, "high": None}}
    answer = Answer.of({"verdict": "ambiguous", "causes": [cause]})
    assert answer.causes == (NamedCause("wind", ("drag.linear",), {"speed": (1.0, None)}, 0.5),)
    assert Answer.of(answer.document()) == answer


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (None, "expected an Answer"),
        ("perhaps", "verdict: expected one of adequate"),
        ({"verdict": "named", "causes": [3]}, "expected effects' names"),
        ({"verdict": "named", "causes": ["a"] * 30}, "a list of up to 20"),
        ({"verdict": "adequate", "p_value": 1.5}, "from 0 to 1"),
        ({"verdict": "adequate", "parameters": {"mass": (1.0,)}}, r"expected \(low, high\)"),
    ],
)
def test_an_invalid_answer_is_one_message(given, message):
    with pytest.raises(InputError, match=message) as error:
        Answer.of(given)
    assert "\n" not in str(error.value)


def test_a_batch_beyond_the_budget_is_refused_as_a_whole():
    tally = SimulationCounter()
    tally.reset(10)
    tally.count(8)
    with pytest.raises(
        SimulationBudgetExceededError, match="11 simulations requested, 10 are allowed"
    ):
        tally.count(3)
    assert tally.used == 8


def test_every_simulation_of_a_batch_is_counted():
    kind = get_simulator("slider")
    made = kind(engine="batch", effects=["drag.linear"])
    SIMULATION_COUNTER.reset()
    run = Scenario([0.0, 0.1], {"x": 0.0, "v": 1.0}, {"u": [0.0, 0.0]})
    made.simulate([[1.0, 0.0], [1.0, 0.5], [2.0, 0.0]], run)
    assert SIMULATION_COUNTER.used == 3


class Counts(Diagnoser):
    """Diagnoser that simulates each run once and checks the result."""

    name = "counts"

    def diagnose(self, case):
        self.case = case
        for run in case.recording.runs:
            seen = case.simulate(run, {"mass": 1.0}, {"drag.linear": (0.3,)})
            assert seen["x"].shape == run.times.shape
        return "unknown"


def test_a_case_contains_only_the_files_of_a_user(tmp_path):
    made = simulate_recording(
        SimulationSpec(system="slider", noise={"x": 0.01}, observe=("x",), runs=3, seconds=1.0)
    )
    path = tmp_path / "made.csv"
    made.write(path)
    question = {
        "table": path.read_text(),
        "description": path.with_suffix(".toml").read_text(),
        "system": "slider",
        "budget": 10,
        "seconds": 5.0,
        "seed": [1],
    }
    folder = tmp_path / "own"
    folder.mkdir()
    counts = Counts()
    said = diagnose_case(question, folder, {}, counts)
    assert said["answer"]["verdict"] == "unknown"
    assert said["simulations"] == 3
    case = counts.case
    assert case.recording.noise == {"x": 0.01}
    assert [run.held_out for run in case.recording.runs] == [False, False, True]
    assert "input.delay" in case.library
    assert "restitution.speed" not in case.library
    assert {path.name for path in folder.iterdir()} == {"recording.csv", "recording.toml"}
    with pytest.raises(SimulationBudgetExceededError):
        diagnose_case({**question, "budget": 2}, folder, {}, counts)
