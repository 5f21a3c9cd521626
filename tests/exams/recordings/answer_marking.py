"""Compare an answer of `simgap explain` with the expected one in recordings.toml."""

from __future__ import annotations

import math
import re


def find_answer_errors(expected, outcome):
    """Return the errors of an answer; empty for a right one, None if no answer is expected.

    Args:
        expected: table of a recording in recordings.toml.
        outcome: `tests.exams.explain_calls.Outcome`.
    """
    if "plain" in expected:
        return None
    found = []
    if "exit" in expected and outcome.code != expected["exit"]:
        found.append(f"exit code {outcome.code}, not {expected['exit']}")
    if "message" in expected:
        text = outcome.output + str(outcome.verdict or "")
        if not re.search(expected["message"], text, re.IGNORECASE):
            found.append("no such finding in the output")
    if not {"verdicts", "causes", "parameters"} & expected.keys():
        return found
    if outcome.verdict is None:
        return [*found, "no answer"]
    verdict = outcome.verdict
    if "verdicts" in expected and verdict["verdict"] not in expected["verdicts"]:
        found.append(f"verdict {verdict['verdict']}, not {' or '.join(expected['verdicts'])}")
    if verdict["verdict"] in ("unknown", "unidentifiable") and expected.get("causes"):
        found.append("causes are listed, not named")
    found += _find_cause_errors(expected, verdict["causes"])
    for name, number in expected.get("parameters", {}).items():
        stated = verdict["parameters"].get(name)
        if stated is None:
            found.append(f"no parameter {name}")
        elif not _is_near(stated["value"], number):
            found.append(f"{name} = {stated['value']:.4g}, not {number['value']:g}")
    return found


def _find_cause_errors(expected, causes):
    found, matched = [], []
    for wanted in expected.get("causes", []):
        cause = next(
            (c for c in causes if {c["effect"], *c["alternatives"]} & set(wanted["effect"])), None
        )
        if cause is None:
            found.append(f"without {' or '.join(wanted['effect'])}")
            continue
        matched.append(cause["effect"])
        allowed = {*wanted["effect"], *wanted.get("alternatives", [])}
        strange = {cause["effect"], *cause["alternatives"]} - allowed
        if strange and "*" not in allowed:
            found.append(f"alternatives {', '.join(sorted(strange))}")
        if "value" in wanted and cause["effect"] in wanted["effect"]:
            values = [c["value"] for c in cause["coefficients"].values()]
            if not all(_is_near(value, wanted) for value in values):
                found.append(f"{cause['effect']} = {values[0]:.4g}, not {wanted['value']:g}")
    others = [cause["effect"] for cause in causes if cause["effect"] not in matched]
    if others and not expected.get("others", False):
        found.append(f"in addition {', '.join(others)}")
    return found


def _is_near(value, wanted):
    absolute = wanted.get("absolute", 0.0)
    return math.isclose(
        value, wanted["value"], rel_tol=wanted.get("tolerance", 0.0), abs_tol=absolute
    )
