"""Consistency of each parameter between runs, and physics that would explain a trend.

A parameter belongs to a physical law. If its value depends on load, speed or time, the law is
incomplete, and the kind of dependence shows which law is missing.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from bench.diagnosis.report.cause_and_value_text import (
    format_sentence,
    joined,
    sanitise,
)
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.validation.confidence_intervals import Z95
from bench.diagnosis.validation.run_consistency import (
    SIGNIFICANCE_LEVEL,
    CovariateKind,
    ParameterConsistency,
)
from bench.pages.interval_drawing import IntervalDrawing, draw_intervals
from bench.pages.template import render_text

_TEMPLATE = Path(__file__).with_name("consistency.txt")
LAW_PREFIXES: Mapping[str, tuple[str, ...]] = {
    "viscous": ("drag.linear", "friction.direction"),
    "dry": ("friction.",),
    "resistance": ("drag.", "wind"),
    "spring": ("spring.",),
    "delay": ("input.delay", "input.lag", "sensor.delay", "sensor.lag"),
    "push": ("force.bias", "input.bias", "gravity.tilt"),
    "drive": ("input.gain", "actuator.", "torque", "winding", "servo."),
    "inertia": ("mass", "inertia", "armature"),
    "bounce": ("restitution",),
}
"""Prefixes of parameter names by law; the first law with a matching prefix applies."""
_WARMS = "friction that changes with time, as surfaces warm or wear,"
_LOAD = "friction that depends on the load (friction.load)"
_DIRECTION = "friction that differs by direction (friction.direction)"
_PLACE = "friction that depends on position"
_FASTER = "friction that grows faster than the speed (drag.quadratic)"
_FRICTION_BY_COVARIATE: Mapping[CovariateKind, str] = {
    "time": _WARMS, "load": _LOAD, "command": _LOAD, "direction": _DIRECTION, "position": _PLACE,
}  # fmt: skip
LAW_NAMES: Mapping[str, str] = {
    "viscous": "friction", "dry": "friction", "resistance": "a resistance",
    "spring": "a stiffness", "delay": "a delay", "push": "a force", "drive": "a drive",
    "inertia": "an inertia", "bounce": "restitution",
}  # fmt: skip
"""Names of the laws in words."""
MISSING_PHYSICS_NAMES: Mapping[tuple[str, CovariateKind], str | tuple[str, str]] = {
    **{
        (law, kind): text
        for law in ("viscous", "dry", "resistance")
        for kind, text in _FRICTION_BY_COVARIATE.items()
    },
    ("viscous", "speed"): (_FASTER, "friction that does not grow with speed (friction.coulomb)"),
    ("viscous", "amplitude"): (
        _FASTER,
        "friction that does not grow with speed (friction.coulomb)",
    ),
    ("dry", "speed"): (
        "friction that grows with speed (drag.linear)",
        "dry friction that falls with speed (friction.stribeck)",
    ),
    ("spring", "amplitude"): "a stiffness that changes with deflection (spring.cubic)",
    ("delay", "command"): ("a limit of the rate (input.rate)", "play (backlash)"),
    ("delay", "amplitude"): ("a limit of the rate (input.rate)", "play (backlash)"),
    ("delay", "time"): "clocks that drift apart (clock.skew)",
    ("push", "direction"): _DIRECTION,
    ("push", "load"): "a weight (gravity.scale)",
    ("push", "position"): "a force that depends on position (spring.linear)",
    ("push", "time"): "a force that drifts",
    ("drive", "command"): ("a dead zone (input.deadband)", "a limit (input.saturation)"),
    ("drive", "speed"): ("a drive that gains with speed", "a limit of the rate (input.rate)"),
    ("drive", "load"): "a supply that sags under load",
    ("drive", "supply"): "a drive that depends on its supply",
    ("drive", "time"): "a supply that sags, or a drive that warms",
    ("inertia", "time"): "a load that changes with time",
    ("bounce", "speed"): "restitution that depends on speed (restitution.speed)",
}
"""Missing effect by law and by covariate of the trend; two texts if an increasing and a decreasing
parameter have different explanations.
"""


def name_missing_physics(
    number: str, kind: CovariateKind, name: str, is_increasing: bool, known_effects: Collection[str]
) -> str:
    """Name the effect that would explain a trend, or else the dependence itself.

    For example, dry friction that increases with speed means that friction that grows with speed is
    missing. If that effect is in the model already, the text is ``friction that depends on speed``.

    Args:
        number: Name of the parameter; for a coefficient of a cause, it includes the effect.
        kind: Category of the covariate.
        name: Covariate in words.
        is_increasing: Whether the parameter increases with the covariate.
        known_effects: Effects in the model already, which cannot be missing.
    """
    # Physical law to which the parameter belongs, such as "dry" for dry friction.
    base_name, _, _ = number.partition("@")
    law = next((law for law, prefix in LAW_PREFIXES.items() if base_name.startswith(prefix)), "")
    explanation = MISSING_PHYSICS_NAMES.get((law, kind), "")
    # Some explanations depend on the direction of the trend.
    if isinstance(explanation, tuple):
        if_increasing, if_decreasing = explanation
        explanation = if_increasing if is_increasing else if_decreasing
    # An explanation by an effect of the library ends with its name in parentheses; otherwise
    # `effect` is empty, which no effect of the model is.
    effect = explanation.partition("(")[2].rstrip(")")
    known_names = {known_effect.partition("@")[0] for known_effect in known_effects}
    if not explanation or effect in known_names:
        return f"{LAW_NAMES.get(law, 'something')} that depends on {name}"
    return explanation


MAX_TABLE_ROWS = 12
"""Maximum number of rows of the table, the least consistent first."""
MAX_NAMED_PARAMETERS = 4
"""Maximum number of parameters that a sentence names."""
AGREEMENT_COLUMNS = ("model", "number", "unit", "by", "group", "value", "low", "high")
"""Columns of the file apart.csv."""


def format_consistency(report: DiagnosisReportData) -> list[str]:
    """Format sentences on whether groups of runs (runs, logs or loads) agree on each parameter.

    They report:

    - which parameters are consistent only once the causes are in the model (`reconciled`);
    - whether another effect would be less consistent than the cause (`competitor`);
    - which parameters differ between groups (`inconsistent`);
    - which parameters drift from log to log (`drifting`).

    Args:
        report: Report data. Its consistency has, before and after the causes are added, a
            `ParameterConsistency` for each parameter and grouping (a spread).
    """
    # By name of the parameter, and criterion of the groups: run, log or a constant such as a load.
    before = {(spread.number, spread.by): spread for spread in report.consistency.before}
    after = report.consistency.after
    effects = [cause.effect for cause in report.verdict.causes]
    alternatives = report.consistency.alternative_effect
    competitors = _select_clearest([spread for spread in alternatives if not spread.is_consistent])
    logs = [spread for spread in after if spread.by == "log" and spread.trend is not None]
    lines = render_text(
        _TEMPLATE,
        reconciled=[
            spread
            for spread in after
            if spread.is_consistent
            and (spread_before := before.get((spread.number, spread.by))) is not None
            and not spread_before.is_consistent
        ],
        competitor=competitors[0] if competitors else None,
        inconsistent=_select_clearest([spread for spread in after if not spread.is_consistent]),
        after=after,
        logs=logs,
        # Bonferroni correction: the level is divided by the number of tested parameters.
        drifting=[
            spread
            for spread in logs
            if spread.trend is not None
            and spread.trend.p_value < SIGNIFICANCE_LEVEL / len(logs)
            and not spread.is_consistent
        ],
        effects=effects,
        causes=joined([sanitise(effect, 60) for effect in effects]),
        groups=pluralise_group,
        has_trend=_has_trend,
        missing_physics=name_missing_physics,
        max_named=MAX_NAMED_PARAMETERS,
        z95=Z95,
    )
    return [format_sentence(line) for line in lines if line]


def _select_clearest(spreads: Sequence[ParameterConsistency]) -> list[ParameterConsistency]:
    """Return each parameter once, preferably with the grouping in which it has a trend."""
    by_number: dict[str, list[ParameterConsistency]] = {}
    for spread in spreads:
        by_number.setdefault(spread.number, []).append(spread)
    return [min(same_number, key=_make_sort_key) for same_number in by_number.values()]


def _make_sort_key(spread: ParameterConsistency) -> tuple[bool, int, float]:
    """Return a sort key: by trend first, then constants, logs and runs, then by p-value."""
    grouping = {"log": 1, "run": 2}.get(spread.by, 0)
    has_trend = _has_trend(spread) or spread.trend_covariate is not None
    return not has_trend, grouping, spread.p_value


def _has_trend(spread: ParameterConsistency) -> bool:
    trend = spread.trend
    return spread.by != "log" and trend is not None and trend.p_value < SIGNIFICANCE_LEVEL


def pluralise_group(grouping: str) -> str:
    """Return the name of the groups: runs, logs, or values of a constant."""
    return f"{grouping}s" if grouping in ("run", "log") else f"values of {sanitise(grouping, 40)}"


def build_agreement_rows(
    report: DiagnosisReportData,
) -> list[tuple[ParameterConsistency, IntervalDrawing | None]]:
    """Build the rows of the table of the page, the least consistent number first.

    Each row has a parameter, and a drawing: the 95 % intervals of all groups on one line, over that
    of the joint fit. It is None if an interval is infinite.

    Args:
        report: Data of the report, with the consistency of the extended model.
    """
    rows = []
    for spread in sorted(report.consistency.after, key=lambda spread: spread.p_value):
        intervals = [
            ("after", part.value, part.value - Z95 * part.error, part.value + Z95 * part.error)
            for part in spread.group_estimates
        ]
        joint = (spread.value - Z95 * spread.error, spread.value + Z95 * spread.error)
        rows.append((spread, draw_intervals(intervals, joint, distance=8)))
    return rows


def build_consistency_rows(report: DiagnosisReportData) -> list[tuple[object, ...]]:
    """Build the rows of `AGREEMENT_COLUMNS`: joint fit and groups, with 95 % intervals.

    Each parameter has a row "all" for the joint fit, one for each group of runs, and a row
    "another" with the interval in which the value of a group that is not yet recorded would lie.

    Args:
        report: Data of the report, with the consistency of the base and the extended model.
    """
    models = [("base", report.consistency.before)]
    if report.has_extended_model:
        models.append(("extended", report.consistency.after))
    rows: list[tuple[object, ...]] = []
    for model, spreads in models:
        for spread in spreads:
            estimates = [("all", spread.value, spread.error)]
            estimates += [(part.group, part.value, part.error) for part in spread.group_estimates]
            estimates.append(("another", spread.value, spread.prediction_sigma))
            for group, value, error in estimates:
                low, high = value - Z95 * error, value + Z95 * error
                rows.append((model, spread.number, spread.unit, spread.by, group, value, low, high))
    return rows
