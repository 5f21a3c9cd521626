"""Hand-written schema of verdict.json: the exact keys and their types."""

import json
from math import isfinite

VERDICTS = {"adequate", "named", "ambiguous", "partial", "unknown", "unidentifiable"}
KEYS = {
    "verdict", "system", "engine", "causes", "parameters", "heldout", "candidates",
    "next_experiment", "simulations",
    "seconds", "cut",
}  # fmt: skip
QUESTIONS = {"base_fit", "search", "rivals", "held_out", "structure", "alternatives"}
CAUSE = {"effect", "alternatives", "says", "coefficients", "p_value"}
HELD_OUT = {"rmse_base", "rmse_extended", "noise_floor", "gap_closed", "low", "high"}
CANDIDATE = {"effect", "score", "p_value", "heldout_gain"}


def number(value, low=float("-inf"), high=float("inf")):
    assert isinstance(value, int | float), value
    assert not isinstance(value, bool)
    assert isfinite(value)
    assert low <= value <= high


def maybe(value, *bounds):
    assert value is None or number(value, *bounds) is None


def estimate(value):
    optional = {"at_bound", "stated", "total", "total_unit", "usual_range"}
    assert set(value) - optional == {"value", "unit", "low", "high"}
    assert ("stated" in value) == ("total" in value)
    for key in {"stated", "total"} & set(value):
        number(value[key])
    if "usual_range" in value:
        low, high = value["usual_range"]
        assert not low <= value["value"] <= high
    if "at_bound" in value:
        assert value["at_bound"] in ("low", "high")
        assert value["low"] is value["high"] is None
    number(value["value"])
    assert isinstance(value["unit"], str)
    maybe(value["low"])
    maybe(value["high"])
    assert (value["low"] is None) == (value["high"] is None)
    assert value["low"] is None or value["low"] <= value["value"] <= value["high"]


def check(text):
    """Check the text of a verdict.json; return its content."""

    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    found = json.loads(text, parse_constant=refuse)
    assert set(found) - {"recording_faults", "recording_notes"} == KEYS
    assert found["verdict"] in VERDICTS
    assert isinstance(found["system"], str)
    assert isinstance(found["engine"], str)
    for cause in found["causes"]:
        assert set(cause) - {"form"} == CAUSE
        assert cause.get("form", "soft") == "soft"
        assert all(isinstance(name, str) for name in (cause["effect"], *cause["alternatives"]))
        assert cause["effect"] not in cause["alternatives"]
        assert len(cause["says"]) >= 10
        assert cause["coefficients"]
        for coefficient in cause["coefficients"].values():
            estimate(coefficient)
        number(cause["p_value"], 0, 1)
    for parameter in found["parameters"].values():
        estimate(parameter)
    if found["heldout"] is not None:
        assert set(found["heldout"]) - {"unit"} == HELD_OUT
        for key in HELD_OUT:
            maybe(
                found["heldout"][key],
                float("-inf") if key in ("gap_closed", "low", "high") else 0.0,
            )
    for candidate in found["candidates"]:
        assert set(candidate) == CANDIDATE
        assert isinstance(candidate["effect"], str)
        number(candidate["score"])
        number(candidate["p_value"], 0, 1)
        maybe(candidate["heldout_gain"])
    scores = [candidate["score"] for candidate in found["candidates"]]
    assert scores == sorted(scores, reverse=True)
    assert found["next_experiment"] is None or isinstance(found["next_experiment"]["says"], str)
    assert isinstance(found["simulations"], int)
    assert found["simulations"] >= 1
    number(found["seconds"], 0)
    if found["cut"] is not None:
        assert set(found["cut"]) == {"by", "during", "not_asked"}
        assert found["cut"]["by"] in ("budget", "interrupt")
        assert isinstance(found["cut"]["during"], str)
        assert set(found["cut"]["not_asked"]) <= QUESTIONS
        assert found["cut"]["not_asked"]
        assert found["verdict"] in ("partial", "unknown"), "the vocabulary of what is not settled"
        early = set(found["cut"]["not_asked"]) - {"structure", "alternatives"}
        assert not early or found["verdict"] == "unknown"
    named, none = {"named", "ambiguous", "partial"}, {"adequate", "unidentifiable"}
    assert found["causes"] or found["verdict"] not in named, "a name needs a cause"
    assert not found["causes"] or found["verdict"] not in none
    assert (found["verdict"] == "ambiguous") <= any(
        cause["alternatives"] for cause in found["causes"]
    )
    return found
