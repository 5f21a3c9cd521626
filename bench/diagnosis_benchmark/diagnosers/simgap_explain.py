"""`simgap explain` as a diagnoser (docs/explain.md)."""

from __future__ import annotations

from bench.core.diagnoser import Answer, Diagnoser, DiagnosisCase, NamedCause
from sims.extended_simulator import FittedValue


class SimgapExplain(Diagnoser):
    """simgap explain: scores effects in trajectory space, refits the best, validates the result."""

    name = "simgap"

    def diagnose(self, case: DiagnosisCase) -> Answer:
        """Return the verdict of `simgap explain` on the recording.

        Args:
            case: recording, and random generator from which the seed of the search is drawn.
        """
        from bench.diagnosis.explain import explain

        verdict = explain(case.path, seed=int(case.rng.integers(1 << 31))).answer
        # The p-values of candidates come from surrogate data and hold for the whole library, so the
        # smallest one tests whether anything is missing.
        p_value = min((candidate.p_value for candidate in verdict.candidates), default=None)
        causes = tuple(
            NamedCause(
                cause.effect,
                cause.alternatives,
                {name: _get_interval(number) for name, number in cause.coefficients.items()},
                cause.p_value,
            )
            for cause in verdict.causes
        )
        parameters = {name: _get_interval(number) for name, number in verdict.parameters.items()}
        return Answer(verdict.verdict, causes, parameters, p_value)


def _get_interval(number: FittedValue) -> tuple[float | None, float | None]:
    """Return the 95 % interval of a fitted value; None for an open end."""
    return number.low, number.high
