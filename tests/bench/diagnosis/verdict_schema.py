"""Check verdict.json by its published schema, without further keys, and relations between keys."""

import json

from jsonschema import Draft202012Validator

from tests.docs.documentation_pages import ROOT

SCHEMA = json.loads((ROOT / "bench/schemas/verdict.schema.json").read_text(encoding="utf-8"))
VERDICTS = set(SCHEMA["properties"]["verdict"]["enum"])
OPTIONAL_KEYS = {"recording_faults", "recording_notes"}


def close_objects(schema):
    """Return the schema with no further keys in objects whose keys it lists."""
    if isinstance(schema, list):
        return [close_objects(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    closed = {key: close_objects(value) for key, value in schema.items()}
    return closed | ({"additionalProperties": False} if "properties" in closed else {})


CLOSED_SCHEMA = close_objects(SCHEMA)
VALIDATOR = Draft202012Validator(CLOSED_SCHEMA)
ESTIMATE_VALIDATOR = Draft202012Validator(CLOSED_SCHEMA["$defs"]["estimate"])


def estimate(value):
    """Check a number with its interval."""
    ESTIMATE_VALIDATOR.validate(value)
    assert ("stated" in value) == ("total" in value)
    if "usual_range" in value:
        low, high = value["usual_range"]
        assert not low <= value["value"] <= high
    if "at_bound" in value:
        assert value["low"] is value["high"] is None
    assert (value["low"] is None) == (value["high"] is None)
    assert value["low"] is None or value["low"] <= value["value"] <= value["high"]


def check(text):
    """Check the text of a verdict.json; return its content."""

    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    found = json.loads(text, parse_constant=refuse)
    VALIDATOR.validate(found)
    assert set(SCHEMA["properties"]) - set(found) <= OPTIONAL_KEYS
    for cause in found["causes"]:
        assert cause["effect"] not in cause["alternatives"]
        for coefficient in cause["coefficients"].values():
            estimate(coefficient)
    for parameter in found["parameters"].values():
        estimate(parameter)
    scores = [candidate["score"] for candidate in found["candidates"]]
    assert scores == sorted(scores, reverse=True)
    if found["cut"] is not None:
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
