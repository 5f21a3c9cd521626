"""Stand-ins for `explain`: what the exam's own tests examine, and a dry run without it."""

from types import SimpleNamespace

from bench.diagnosis.verdict import Verdict

ADEQUATE = {
    "verdict": "adequate", "system": "", "engine": "batch", "causes": [], "parameters": {},
    "heldout": None,
    "candidates": [], "next_experiment": None, "simulations": 1, "seconds": 0.0,
}  # fmt: skip


def sees_nothing(path, system=None, engine="batch"):
    """Everything is adequate."""
    assert path.exists()
    assert path.with_suffix(".toml").exists()
    return SimpleNamespace(answer=Verdict.from_document(ADEQUATE))


def crashes(path, system=None, engine="batch"):
    """No answer."""
    raise RuntimeError("no answer")
