"""Replacements of `explain` for the tests of the exam and for a dry run."""

from types import SimpleNamespace

from bench.diagnosis.verdict import Verdict

ADEQUATE = {
    "verdict": "adequate", "system": "", "engine": "batch", "causes": [], "parameters": {},
    "heldout": None,
    "candidates": [], "next_experiment": None, "simulations": 1, "seconds": 0.0,
}  # fmt: skip


def sees_nothing(path, system=None, engine="batch"):
    """Return the verdict "adequate" for every recording."""
    assert path.exists()
    assert path.with_suffix(".toml").exists()
    return SimpleNamespace(answer=Verdict.from_document(ADEQUATE))


def crashes(path, system=None, engine="batch"):
    """Raise an error instead of an answer."""
    raise RuntimeError("no answer")
