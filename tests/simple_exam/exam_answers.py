"""Answer one question in a worker: draw the case, write and explain its recording, grade it."""

from __future__ import annotations

from dataclasses import asdict

from bench.diagnosis_benchmark.case_generation import competing_effects, effect_sizing
from bench.diagnosis_benchmark.case_generation.case_sampling import (
    BenchmarkCase,
    restore_conditions,
    write_case,
)
from bench.diagnosis_benchmark.grading import Grade, grade_answer
from tests.simple_exam.exam_questions import Question
from tests.simple_exam.explain_items import EXPLAIN, explained

MOST_RIVALS = 6


def answered(question, offset, known=None, explain=EXPLAIN):
    """Return the result row of a question: case, verdict and grade.

    Args:
        question: question as JSON.
        offset: offset of the seeds.
        known: case as JSON if it was drawn before, {} if no drawing is visible, None if it was not
            drawn.
        explain: module:function to examine.
    """
    asked = Question(**question)
    item = (
        asked.drawn(offset) if known is None else BenchmarkCase.from_json(known) if known else None
    )
    row = {"question": asked.name, "part": asked.part, "kind": asked.kind, "system": asked.system}
    row |= {"effect": asked.effect, "item": item.to_json() if item else {}}
    return row if item is None else row | _answer(item, explain)


def _answer(item, explain):
    row = explained(lambda folder: _written(item, folder), explain, system=None, engine="batch")
    mark = grade_answer(item, row["verdict"])
    row["mark"] = asdict(mark) | {
        "found": mark.is_correct,
        "found_class": mark.is_correct_up_to_equivalence,
    }
    return row | {"rivals": _rivals(item, row["verdict"], mark)}


def _written(item, folder):
    path = write_case(item, folder, truth=False)
    # The original name reveals the hidden cause.
    path = path.rename(path.with_name("recording.csv"))
    path.with_name(f"{item.name}.toml").rename(path.with_suffix(".toml"))
    return path


def lost(question, known, error):
    """Return the row of a question whose worker failed."""
    row = {name: question.json()[name] for name in ("part", "kind", "system", "effect")}
    mark = asdict(Grade("failed", 0, 0, "", {})) | {"found": False, "found_class": False}
    row |= {
        "question": question.name,
        "item": known or {},
        "verdict": None,
        "seconds": None,
        "error": error,
    }
    return row | {"mark": mark, "rivals": {}}


def _rivals(item, verdict, mark):
    """Test effects that were diagnosed but not hidden.

    Returns:
        By effect, the RMS residual in units of the noise and the sigmas of evidence against the
        effect. A small number of sigmas means that it explains the data as well as the truth does.
    """
    if item.kind != "single" or mark.is_correct or not verdict or len(verdict["causes"]) != 1:
        return {}
    (cause,) = verdict["causes"]
    names = [
        name for name in (cause["effect"], *cause["alternatives"]) if name not in item.effects
    ][:MOST_RIVALS]
    setting = restore_conditions(item)
    observed = effect_sizing.simulate_observations(setting, item.effects)
    phi = setting.noise.phi if item.noise == "ar1" else 0.0
    samples = observed.size * (1 - phi) / (1 + phi)  # Effective number of samples with AR(1) noise.
    left = {
        name: competing_effects.compute_refitted_residual(setting, observed, name) for name in names
    }
    return {name: {"leaves": rest, "sigmas": rest * samples**0.5} for name, rest in left.items()}
