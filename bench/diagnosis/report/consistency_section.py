"""Consistency of each parameter between runs, and physics that would explain a trend.

A parameter belongs to a physical law. If its value depends on load, speed or time, the law is
incomplete, and the kind of dependence shows which law is missing.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

from bench.diagnosis.report.effect_and_unit_text import (
    append_unit,
    format_estimate,
    format_number,
    format_p_value,
    format_sentence,
    joined,
    sanitise,
)
from bench.diagnosis.report.report_data import DiagnosisReportData
from bench.diagnosis.validation.gain_and_intervals import Z95
from bench.diagnosis.validation.run_consistency import (
    SIGNIFICANCE_LEVEL,
    CovariateKind,
    ParameterConsistency,
)
from bench.pages.page_table import IntervalDrawing, draw_intervals

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
    base_name = number.partition("@")[0]
    family = next((law for law, prefix in LAW_PREFIXES.items() if base_name.startswith(prefix)), "")
    explanation = MISSING_PHYSICS_NAMES.get((family, kind), "")
    text = explanation if isinstance(explanation, str) else explanation[0 if is_increasing else 1]
    # The text ends with the name of the effect in parentheses.
    effect = text.partition("(")[2].rstrip(")")
    if not text or any(known_effect.partition("@")[0] == effect for known_effect in known_effects):
        return f"{LAW_NAMES.get(family, 'something')} that depends on {name}"
    return text


MAX_TABLE_ROWS = 12
"""Maximum number of rows of the table, the least consistent first."""
MAX_NAMED_PARAMETERS = 4
"""Maximum number of parameters that a sentence names."""
AGREEMENT_COLUMNS = ("model", "number", "unit", "by", "group", "value", "low", "high")
"""Columns of the file apart.csv."""


def format_consistency(report: DiagnosisReportData) -> list[str]:
    """Format sentences on whether groups of runs (runs, logs or loads) agree on each parameter.

    They report which parameters are consistent with the causes only, whether another effect would
    be less consistent than the cause, which parameters differ between groups, and which drift from
    log to log.

    Args:
        report: Report data, with the estimates of each parameter by group (a spread).
    """
    before = {(spread.number, spread.by): spread for spread in report.consistency.before}
    after = report.consistency.after
    effects = [cause.effect for cause in report.verdict.causes]
    causes = joined([sanitise(effect, 60) for effect in effects])
    sentences = []
    reconciled_spreads = [
        spread
        for spread in after
        if spread.is_consistent
        and (spread_before := before.get((spread.number, spread.by))) is not None
        and not spread_before.is_consistent
    ]
    if reconciled_spreads and causes:
        names = list(dict.fromkeys(_get_number_name(spread) for spread in reconciled_spreads))
        sentences.append(
            f"without {causes}, {joined(names[:MAX_NAMED_PARAMETERS])} differed between "
            f"{_pluralise_group(reconciled_spreads[0].by)} by more than the intervals"
        )
    competitors = [s for s in report.consistency.alternative_effect if not s.is_consistent]
    for competitor in _select_clearest(competitors)[:1]:
        trend = ""
        if _has_trend(competitor):
            trend = (
                f", and it {_get_trend_direction(competitor)} with {sanitise(competitor.by, 40)}"
            )
        sentences.append(
            f"with {_get_number_name(competitor)} instead of {causes}, its value would differ "
            f"between {_pluralise_group(competitor.by)}, {_format_span(competitor)} "
            f"({format_p_value(competitor.p_value)}){trend}; "
            f"this difference speaks for {causes}"
        )
    inconsistent_spreads = _select_clearest(
        [spread for spread in after if not spread.is_consistent]
    )
    named_spreads = inconsistent_spreads[:MAX_NAMED_PARAMETERS]
    sentences += [_format_inconsistency(spread, effects) for spread in named_spreads]
    if len(inconsistent_spreads) > len(named_spreads):
        count = len(inconsistent_spreads) - len(named_spreads)
        sentences.append(f"{count} more numbers differ between their groups")
    if after and not inconsistent_spreads:
        groups = _pluralise_group(after[0].by)
        sentences.append(f"all {groups} agree on every number within its interval")
    return [format_sentence(text) for text in (*sentences, *_format_drifts(after))]


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


def _format_inconsistency(spread: ParameterConsistency, effects: Sequence[str]) -> str:
    """Say that a parameter differs between runs, how uncertain it is for a new run, and why.

    If the parameter has a trend with a covariate, such as a load, the sentence names the kind of
    effect that could explain it.

    Args:
        spread: estimates of the parameter from each group of runs.
        effects: names of the effects of the model.
    """
    text = (
        f"{_get_number_name(spread)} differs between {_pluralise_group(spread.by)}, "
        f"{_format_span(spread)} "
        f"({format_p_value(spread.p_value)}): for a new run its 95 % interval is "
        f"±{format_number(Z95 * spread.prediction_sigma)}, not "
        f"±{format_number(Z95 * spread.error)}"
    )
    covariate = spread.trend_covariate
    if covariate is None:
        return f"{text}; an effect that changes it is missing"
    increases = covariate.trend.slope > 0
    names = (covariate.name, *covariate.indistinguishable_covariates[:2])
    text += f"; it {'increases' if increases else 'decreases'} with "
    text += " or ".join(sanitise(name, 40) for name in names)
    missing = name_missing_physics(
        spread.number, covariate.kind, sanitise(covariate.name, 40), increases, effects
    )
    return f"{text}: {missing} is missing"


def _format_span(spread: ParameterConsistency) -> str:
    values = [part.value for part in spread.group_estimates]
    return append_unit(f"{format_number(min(values))} to {format_number(max(values))}", spread.unit)


def _format_drifts(after: Sequence[ParameterConsistency]) -> Iterator[str]:
    """Yield sentences on the parameters that increase or decrease from log to log.

    A drift counts if its p-value, corrected for the number of parameters, is significant, and the
    logs do not agree on the parameter.
    """
    logs = [spread for spread in after if spread.by == "log" and spread.trend is not None]
    if not logs:
        return
    level = SIGNIFICANCE_LEVEL / len(logs)
    drifting = [
        (spread, spread.trend)
        for spread in logs
        if spread.trend is not None and spread.trend.p_value < level and not spread.is_consistent
    ]
    for spread, trend in drifting[:MAX_NAMED_PARAMETERS]:
        size = f"{format_number(abs(trend.slope))} ± {format_number(Z95 * trend.error)}"
        change = append_unit(size, spread.unit)
        direction = _get_trend_direction(spread)
        yield f"{_get_number_name(spread)} {direction} from log to log by {change}"
    if not drifting:
        count = len(logs[0].group_estimates)
        yield f"no number changes steadily over the {count} logs, in the order given"


def _get_trend_direction(spread: ParameterConsistency) -> str:
    return "increases" if spread.trend is not None and spread.trend.slope > 0 else "decreases"


def _get_number_name(spread: ParameterConsistency) -> str:
    return sanitise(spread.number, 60)


def _pluralise_group(grouping: str) -> str:
    return f"{grouping}s" if grouping in ("run", "log") else f"values of {sanitise(grouping, 40)}"


class AgreementRow(NamedTuple):
    """Row of the table of the report: one number, and how well its groups agree.

    Attributes:
        name: Name of the number.
        is_consistent: Whether the groups agree within their intervals.
        fitted: Value of the joint fit with its 95 % interval.
        predicted: Value in a run or log that is not yet recorded, with its 95 % interval.
        groups: Number and kind of the groups.
        p_value: P-value of equal values in all groups.
        drawing: Intervals of the groups, over the interval of the joint fit.
    """

    name: str
    is_consistent: bool
    fitted: str
    predicted: str
    groups: str
    p_value: float
    drawing: IntervalDrawing | None


def build_agreement_rows(report: DiagnosisReportData) -> list[AgreementRow]:
    """Build the rows of the table, the least consistent number first.

    Each row has a parameter, its joint estimate, the interval expected for a further group, and the
    estimates of all groups drawn on one line.

    Args:
        report: Data of the report, with the consistency of the extended model.
    """
    rows = []
    for spread in sorted(report.consistency.after, key=lambda spread: spread.p_value):
        # Value and half of the 95 % interval of each group.
        estimates = [(part.value, Z95 * part.error) for part in spread.group_estimates]
        rows.append(
            AgreementRow(
                name=spread.number,
                is_consistent=spread.is_consistent,
                fitted=_format_interval(spread, spread.error),
                predicted=_format_interval(spread, spread.prediction_sigma),
                groups=f"{len(estimates)} {_pluralise_group(spread.by)}",
                p_value=spread.p_value,
                drawing=draw_intervals(
                    [
                        ("after", value, value - half_width, value + half_width)
                        for value, half_width in estimates
                    ],
                    (spread.value - Z95 * spread.error, spread.value + Z95 * spread.error),
                    distance=8,
                ),
            )
        )
    return rows


def _format_interval(spread: ParameterConsistency, error: float) -> str:
    """Format the joint estimate of a parameter with a 95 % interval.

    Args:
        spread: estimate of the parameter, with its unit.
        error: standard error, in the same unit.
    """
    half_width = Z95 * error
    text = format_estimate(spread.value, spread.value - half_width, spread.value + half_width)
    return append_unit(text, spread.unit)


def build_consistency_rows(report: DiagnosisReportData) -> list[tuple[object, ...]]:
    """Build the rows of `AGREEMENT_COLUMNS`: joint fit and groups, with 95 % intervals.

    Each parameter has a row "all" for the joint fit, one for each group of runs, and a row
    "another" with the prediction interval of a further group.

    Args:
        report: Data of the report, with the consistency of the base and the extended model.
    """
    models = [("base", report.consistency.before)]
    if report.verdict.causes:
        models.append(("extended", report.consistency.after))
    rows: list[tuple[object, ...]] = []
    for model, spreads in models:
        for spread in spreads:
            estimates = [("all", spread.value, spread.error)]
            estimates += [(part.group, part.value, part.error) for part in spread.group_estimates]
            estimates.append(("another", spread.value, spread.prediction_sigma))
            for group, value, error in estimates:
                half_width = Z95 * error
                estimate_with_interval = (value, value - half_width, value + half_width)
                rows.append(
                    (model, spread.number, spread.unit, spread.by, group, *estimate_with_interval)
                )
    return rows
