"""Tests that `explain` finds a wrong command time, together with another hidden cause."""

import pytest

from bench.diagnosis.explain import explain
from bench.diagnosis_benchmark.case_generation import joint_reference
from bench.diagnosis_benchmark.case_set import write_case
from tests.exams.systems.system_cases import questions

EARLY = {"input.hold", "input.delay"}
CASES = (
    ("slider", "friction.load", 2), ("slider", "wind", 2), ("pendulum", "spring.cubic", 3),
    ("slider", "input.bias", 3),
)  # fmt: skip
LONG = ("spring.cubic", "input.bias")
"""Effects of the cases that take more than twenty seconds."""
COMPUTE_APPLIED_INPUT = joint_reference.compute_applied_input


def drawn(system, effect, index):
    name = f"marks/single/{system}/{effect}/{index}"
    (question,) = [q for q in questions() if q.name == name]
    return question.draw().item


def moved(monkeypatch, **further_effects):
    """Add input effects to the simulation that the recorded table does not show."""

    def compute_with_further_effects(scenario, effects, until):
        return COMPUTE_APPLIED_INPUT(scenario, {**further_effects, **effects}, until)

    monkeypatch.setattr(joint_reference, "compute_applied_input", compute_with_further_effects)


def sets_of(explained):
    return [{cause.effect, *cause.alternatives} for cause in explained.causes]


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=case[1], marks=[pytest.mark.long] if case[1] in LONG else [])
        for case in CASES
    ],
)
def test_interpolated_commands_and_the_hidden_cause_are_both_named(case, tmp_path, monkeypatch):
    item = drawn(*case)
    moved(monkeypatch, **{"input.hold": (1.0,)})
    sets = sets_of(explain(write_case(item, tmp_path)))
    assert any(names & EARLY for names in sets), sets
    for hidden in item.effects:
        assert any(hidden in names for names in sets), sets


@pytest.mark.slow
@pytest.mark.parametrize("late", [-0.02, 0.02])
def test_a_clock_offset_of_two_samples_is_a_delay_of_either_sign(late, tmp_path, monkeypatch):
    item = drawn("slider", "friction.load", 2)
    moved(monkeypatch, **{"input.delay": (late,)})
    explained = explain(write_case(item, tmp_path))
    (delay,) = [c for c in explained.causes if "input.delay" in {c.effect, *c.alternatives}]
    assert any("friction.load" in names for names in sets_of(explained))
    if delay.effect == "input.delay":
        (number,) = delay.coefficients.values()
        assert number.value == pytest.approx(late, abs=2e-3)


def test_a_stated_offset_is_not_estimated_again(tmp_path, monkeypatch):
    item = drawn("slider", "friction.load", 2)
    moved(monkeypatch, **{"input.hold": (1.0,)})
    path = write_case(item, tmp_path)
    description = path.with_suffix(".toml")
    text = description.read_text()
    assert "[inputs.u]" in text
    description.write_text(text.replace("[inputs.u]", '[inputs.u]\nhold = "linear"'))
    (names,) = sets_of(explain(path))
    assert "friction.load" in names
