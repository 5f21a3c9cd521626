"""Compare two explanations: verdict, causes, settings, and numbers that changed significantly.

Half of a 95 % interval is 1.96 standard errors. The standard error of the difference of two numbers
is the root of the sum of squares if the explanations use different recordings. For the same
recording the numbers are not independent and the difference is known more accurately, so the test
is conservative. Holm's correction is over all numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.benchmark.statistics.paired_tests import correct_holm
from bench.benchmark.storage.provenance import read_environment
from bench.diagnosis.verdict import Verdict
from bench.pages.template import render_text
from bench.studies.explanation_verification import EXTENDED_MODEL_FILE, read_verdict
from sims.core.simulator import InputError
from sims.core.toml_validation import read_toml
from sims.extended_simulator import FittedValue

_TEMPLATE = Path(__file__).with_name("diff.txt")
FAMILYWISE_ERROR_RATE = 0.05
"""Familywise error rate: probability of any false alarm among all comparisons."""
_MAX_CHANGES = 12
"""Maximum number of changes that are printed."""
RESULT_RELEVANT_KEYS = ("simgap", "python", "platform", "machine", "stepping", "seals", "packages")
"""Keys of an environment that may influence the results."""


def find_changes(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Find the differences between two trees of values.

    Args:
        a: first tree.
        b: second tree.

    Returns:
        For each dotted key that differs, the values in both; None where the key does not exist.
    """
    flat_a, flat_b = dict(_flatten_table(a)), dict(_flatten_table(b))
    return [
        {"what": key, "a": flat_a.get(key), "b": flat_b.get(key)}
        for key in sorted({*flat_a, *flat_b})
        if flat_a.get(key) != flat_b.get(key)
    ]


def _flatten_table(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables, each with its path such as ``noise.q``.

    `prefix` is the path of the table with its final dot. A tuple becomes a list, so that it equals
    the list read from a file.
    """
    for key, item in value.items():
        if isinstance(item, Mapping):
            yield from _flatten_table(item, f"{prefix}{key}.")
        elif isinstance(item, list | tuple):
            yield f"{prefix}{key}", list(item)
        else:
            yield f"{prefix}{key}", item


def select_relevant_environment(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Select the part of an environment that may influence results, with the hash of the code."""
    selected = {key: environment[key] for key in RESULT_RELEVANT_KEYS if key in environment}
    code = environment.get("fingerprint", {}).get("code")
    return {**selected, **({"code": code} if code else {})}


def describe_side(folder: Any, name: str, environment: Mapping[str, Any]) -> dict[str, Any]:
    """Describe one of the two compared results for the JSON document.

    Args:
        folder: its folder.
        name: name of the experiment, or title of the explanation.
        environment: content of its environment.json.
    """
    return {
        "folder": folder,
        "name": name,
        "simgap": environment.get("simgap", ""),
        "started": environment.get("started"),
    }


def format_diff(document: Mapping[str, Any], **values: Any) -> list[str]:
    """Format a document of the schema ``diff`` as text lines.

    Args:
        document: differences between two comparisons or two explanations.
        **values: further values of the template.
    """
    # Lists of changes that only one of the two kinds of documents has.
    changes: dict[str, Any] = {"configuration": (), "environment": (), "settings": ()}
    return render_text(_TEMPLATE, **{**changes, **document, **values}, max_changes=_MAX_CHANGES)


_MAX_COMPARED_CANDIDATES = 5
"""Number of the best candidates of each explanation that are compared."""
_HELD_OUT = ("rmse_base", "rmse_extended", "noise_floor", "gap_closed", "low", "high")
_NORMAL_95 = 1.96
"""Half width of a 95 % interval, in standard errors."""


@dataclass(frozen=True)
class ExplanationSide:
    """One of two explanations.

    Attributes:
        folder: its folder.
        verdict: its verdict.
        title: title of its extended simulator.
        environment: versions, settings and machine with which it was made.
    """

    folder: Path
    verdict: Verdict
    title: str
    environment: Mapping[str, Any]

    @property
    def settings(self) -> dict[str, Any]:
        """System, settings, recordings, versions and machine of the explanation.

        Two explanations can only be expected to agree if these are equal.
        """
        environment = self.environment
        recordings = {
            recording["file"]: recording["sha256"]
            for recording in environment.get("recordings", [])
        }
        base_settings = {"system": self.verdict.system, "engine": self.verdict.engine}
        return {
            **base_settings,
            "settings": environment.get("settings", {}),
            "recordings": recordings,
            **select_relevant_environment(environment),
        }

    def classify_effect(self, effect: str) -> str:
        """Return whether an effect is a cause, an alternative to one, or neither."""
        if any(cause.effect == effect for cause in self.verdict.causes):
            return "cause"
        if any(effect in cause.alternatives for cause in self.verdict.causes):
            return "alternative"
        return "no"


def load_side(folder: Path) -> ExplanationSide:
    """Load one of two explanations.

    Raises:
        InputError: the folder has no explanation, or it is damaged.
    """
    verdict = read_verdict(folder)
    title = str(read_toml(folder / EXTENDED_MODEL_FILE).get("title", ""))
    return ExplanationSide(folder, verdict, title, read_environment(folder))


@dataclass(frozen=True)
class ExplanationDiff:
    """Differences between two explanations.

    Attributes:
        a: first explanation.
        b: second explanation.
    """

    a: ExplanationSide
    b: ExplanationSide

    @cached_property
    def causes(self) -> list[dict[str, Any]]:
        """All effects that either explanation names, with their roles in both.

        Roles are those of `ExplanationSide.classify_effect`: a cause, an alternative of a cause, or
        neither.
        """
        effect_names = [
            effect
            for side in (self.a, self.b)
            for cause in side.verdict.causes
            for effect in (cause.effect, *cause.alternatives)
        ]
        return [
            {
                "effect": effect,
                "in_a": self.a.classify_effect(effect),
                "in_b": self.b.classify_effect(effect),
            }
            for effect in dict.fromkeys(effect_names)
        ]

    @cached_property
    def numbers(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Coefficients and parameters of either explanation, with intervals and significance.

        A difference is significant if its p-value, with Holm's correction over all numbers, is
        below `FAMILYWISE_ERROR_RATE`.

        Returns:
            Rows of coefficients, and rows of parameters.
        """
        coefficients = _pair_coefficients(
            _collect_coefficients(self.a), _collect_coefficients(self.b)
        )
        parameters = _pair_coefficients(self.a.verdict.parameters, self.b.verdict.parameters)
        # The rows of both lists, which are extended in place.
        rows = [*coefficients, *parameters]
        corrected = correct_holm(np.array([_compute_p_value(row) for row in rows]))
        for row, value in zip(rows, corrected, strict=True):
            # Without a p-value, because a number is missing or uncertain, it is not known.
            row["significant"] = bool(value < FAMILYWISE_ERROR_RATE) if np.isfinite(value) else None
        return coefficients, parameters

    @property
    def has_changed(self) -> bool:
        """True if verdict or causes differ, or a number differs significantly."""
        has_other_verdict = self.a.verdict.verdict != self.b.verdict.verdict
        has_other_numbers = any(row["significant"] for rows in self.numbers for row in rows)
        # An effect is a cause in one explanation, and not in the other one.
        has_other_causes = any(
            "cause" in pair and len(set(pair)) > 1 for pair in self._list_cause_places()
        )
        return has_other_verdict or has_other_numbers or has_other_causes

    def _list_cause_places(self) -> list[tuple[str, str]]:
        return [(cause["in_a"], cause["in_b"]) for cause in self.causes]

    @property
    def is_worse(self) -> bool:
        """Unavailable: of two explanations, neither is worse.

        Raises:
            InputError: always.
        """
        raise InputError("--fail-on worse: only for comparisons; for explanations use change")

    def _list_held_out_errors(self) -> list[dict[str, Any]]:
        """List errors on held-out runs and the closed gap of both explanations; None if missing."""
        errors = [side.verdict.heldout for side in (self.a, self.b)]
        return [
            {"name": name, "a": getattr(errors[0], name, None), "b": getattr(errors[1], name, None)}
            for name in _HELD_OUT
        ]

    def _compare_candidates(self) -> list[dict[str, Any]]:
        """Return the best candidates of either explanation, with score and rank in both.

        A candidate that one of the explanations does not rank has None as its score and rank there.
        """
        # Rank and score of each candidate by its effect, for both explanations.
        ranked = [
            {c.effect: (rank, c.score) for rank, c in enumerate(side.verdict.candidates, 1)}
            for side in (self.a, self.b)
        ]
        names = [
            effect
            for side in ranked
            for effect, (rank, _) in side.items()
            if rank <= _MAX_COMPARED_CANDIDATES
        ]
        rows = []
        for name in dict.fromkeys(names):
            (rank_a, score_a), (rank_b, score_b) = (side.get(name, (None, None)) for side in ranked)
            scores = {"score_a": score_a, "score_b": score_b}
            rows.append({"effect": name, **scores, "rank_a": rank_a, "rank_b": rank_b})
        return rows

    @cached_property
    def notes(self) -> list[str]:
        """Notes on limitations of the comparison."""
        notes = []
        if not (self.a.environment and self.b.environment):
            notes.append("settings and versions of the older explanation are not known")
        units = [side.verdict.heldout.unit for side in (self.a, self.b) if side.verdict.heldout]
        if len(set(units)) > 1:
            notes.append(f"held-out errors are in {units[0]} and in {units[1]}")
        if self.a.verdict.system != self.b.verdict.system:
            notes.append(f"different systems: {self.a.verdict.system} and {self.b.verdict.system}")
        return notes

    def to_document(self) -> dict[str, Any]:
        """Convert the differences between two explanations to a JSON document.

        The document follows the schema ``diff``; `a` and `b` are the two explanations.
        """
        coefficients, parameters = self.numbers
        side_documents = [
            describe_side(side.folder, side.title, side.environment) for side in (self.a, self.b)
        ]
        return {
            "kind": "explanation",
            "changed": self.has_changed,
            "a": side_documents[0],
            "b": side_documents[1],
            "verdict": {"a": self.a.verdict.verdict, "b": self.b.verdict.verdict},
            "causes": self.causes,
            "coefficients": coefficients,
            "parameters": parameters,
            "heldout": self._list_held_out_errors(),
            "candidates": self._compare_candidates(),
            "settings": find_changes(self.a.settings, self.b.settings),
            "notes": self.notes,
        }

    def format_lines(self) -> list[str]:
        """Format the differences as text lines.

        The lines have the verdict, causes, fitted numbers, held-out errors, ranks of candidates,
        settings and notes.
        """
        return format_diff(self.to_document())

    def to_table(self) -> pd.DataFrame:
        """Return the table for a CSV file."""
        coefficients, parameters = self.numbers
        held_out = [
            {**row, "name": f"heldout {row['name']}"} for row in self._list_held_out_errors()
        ]
        return pd.DataFrame([*coefficients, *parameters, *held_out])


def _collect_coefficients(side: ExplanationSide) -> dict[str, FittedValue]:
    """Return the coefficients of all causes of an explanation, by effect and coefficient name."""
    return {
        f"{cause.effect} {name}": value
        for cause in side.verdict.causes
        for name, value in cause.coefficients.items()
    }


def _pair_coefficients(
    a: Mapping[str, FittedValue], b: Mapping[str, FittedValue]
) -> list[dict[str, Any]]:
    """Write the numbers of two explanations into one row per name.

    A row has name and unit, and for each explanation the value and its 95 % interval (low, high).
    An explanation without this number has None in all three columns.

    Args:
        a: numbers of the first explanation, by name.
        b: numbers of the second one.
    """
    rows = []
    for name in dict.fromkeys([*a, *b]):
        value_a, value_b = a.get(name), b.get(name)
        any_value = value_a or value_b
        assert any_value is not None
        row: dict[str, Any] = {"name": name, "unit": any_value.unit}
        for side_name, value in (("a", value_a), ("b", value_b)):
            row |= {
                side_name: value.value if value else None,
                f"low_{side_name}": value.low if value else None,
                f"high_{side_name}": value.high if value else None,
            }
        rows.append(row)
    return rows


def _compute_p_value(row: Mapping[str, Any]) -> float:
    """Compute the p-value of no difference; NaN if an interval is open or a number is missing.

    The standard errors follow from the 95 % intervals of both numbers; the difference is assumed to
    be normally distributed.

    Args:
        row: Values `a` and `b` with the limits `low_a`, `high_a`, `low_b` and `high_b`.
    """
    numbers = [row[key] for key in ("low_a", "high_a", "low_b", "high_b", "a", "b")]
    if any(number is None for number in numbers):
        return math.nan
    standard_errors = [
        (row[f"high_{side}"] - row[f"low_{side}"]) / (2 * _NORMAL_95) for side in ("a", "b")
    ]
    difference = abs(row["a"] - row["b"])
    # Standard error of the difference of two independent numbers.
    difference_error = math.hypot(*standard_errors)
    if difference_error == 0:
        return 1.0 if difference == 0 else 0.0
    # Two-sided tail of the normal distribution.
    return math.erfc(difference / difference_error / math.sqrt(2))
