"""Sparse regression of acceleration residuals on the library of effects.

Two methods of PySINDy select few of many terms: sequentially thresholded least squares (S. L.
Brunton, J. L. Proctor, J. N. Kutz, PNAS 113(15), 3932, 2016, doi:10.1073/pnas.1517384113) and
forward regression with orthogonal least squares (S. Chen, S. A. Billings, W. Luo, Int. J. Control
50(5), 1873, 1989, doi:10.1080/00207178908953472). The held-out runs decide the number of terms: the
smallest that predicts their accelerations about as well as the best.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from typing import ClassVar, NamedTuple

import numpy as np

from bench.core.diagnoser import Answer, Diagnoser, DiagnosisCase, NamedCause
from bench.diagnosis_benchmark.diagnosers.regression_evidence import (
    EffectColumn,
    RegressionEvidence,
    compute_block_means,
    compute_standard_error,
    find_strongest_columns,
)
from sims.core.simulator import Array

POLYNOMIAL_WINDOWS_SECONDS = (0.15, 0.4, 1.0)
"""Windows of the local polynomials, seconds: long for slow effects, short for fast ones."""
MIN_IMPROVEMENT_STANDARD_ERRORS = 2.5
"""Minimum decrease of the held-out error, in standard errors."""
SAME_CAUSE_CORRELATION = 0.95
"""Correlation above which two columns count as the same cause."""
DUPLICATE_COLUMN_CORRELATION = 0.999
"""Correlation above which one of two columns is excluded from the regression."""
RIDGE_PENALTY = 1e-6
"""Ridge penalty of the least squares, for columns with unit variance."""
HELD_OUT_BLOCK_COUNT = 10
"""Number of blocks of the held-out runs, from which the standard error is estimated."""
MAX_TERMS = 3
"""Maximum number of terms."""


class _RegressionResult(NamedTuple):
    """Significance of the prediction of one regression in standard errors, and its named causes."""

    sigmas: float
    causes: tuple[NamedCause, ...]


class _SparseRegression(Diagnoser):
    """Base class of the sparse regressions."""

    requires: ClassVar[tuple[str, ...]] = ("pysindy",)

    def diagnose(self, case: DiagnosisCase) -> Answer:
        """Name the terms that predict the accelerations of the held-out runs.

        The regression is repeated with windows of several lengths, and the one whose prediction is
        most significant gives the answer. No term means "adequate", more than `MAX_TERMS` terms
        mean that no small model exists: "unknown". With too few samples for any window the answer
        is "unidentifiable".

        Args:
            case: recording, simulator and effects, without the hidden causes.
        """
        with closing(RegressionEvidence.collect(case)) as evidence:
            results = [
                self._run_regression(evidence, window) for window in POLYNOMIAL_WINDOWS_SECONDS
            ]
        valid_results = [result for result in results if result is not None]
        if not valid_results:
            return Answer("unidentifiable")
        # `sigmas` is the improvement of the prediction in standard errors.
        best = max(valid_results, key=lambda result: result.sigmas)
        if not best.causes:
            return Answer("adequate")
        if len(best.causes) > MAX_TERMS:
            return Answer("unknown")
        has_alternatives = any(cause.alternatives for cause in best.causes)
        return Answer("ambiguous" if has_alternatives else "named", best.causes)

    def _run_regression(
        self, evidence: RegressionEvidence, window: float
    ) -> _RegressionResult | None:
        """Run the regression with one window of the local polynomials.

        One column is used for each effect, the one that explains most of the residual. Models with
        different numbers of terms are fitted to the runs for fitting, and the held-out runs select
        one.

        Args:
            evidence: fitted base model and directions of the effects.
            window: length of the window, s.

        Returns:
            The named causes and their significance; None if there are too few samples.
        """
        rows = evidence.build_acceleration_regression(window)
        fitting_rows = rows.select_runs(evidence.fitted)
        held_out_rows = rows.select_runs(evidence.held_out)
        row_count = min(len(fitting_rows.residual), len(held_out_rows.residual))
        if row_count <= fitting_rows.base.shape[1] + 2 * HELD_OUT_BLOCK_COUNT:
            return None
        residual, effects = fitting_rows.project_out_base()
        strongest_columns = find_strongest_columns(residual, effects, evidence.effect_columns)
        chosen_columns = [strongest.column for strongest in strongest_columns.values()]
        terms, library = _drop_duplicate_columns(
            [
                (column.effect, column_index)
                for column in chosen_columns
                for column_index in column.places
            ],
            effects,
        )
        if not terms:
            return _RegressionResult(0.0, ())
        columns = [column_index for _, column_index in terms]
        # Unit mean square in the runs for fitting, so that coefficients are comparable.
        scale = np.sqrt(np.square(library).mean(axis=0))
        held_out_residual, held_out_effects = held_out_rows.project_out_base()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            models = [
                coefficients
                for coefficients in self._iterate_models(library / scale, residual)
                if np.isfinite(coefficients).all()
            ]
        model, sigmas = _select_by_one_standard_error(
            models, held_out_residual, held_out_effects[:, columns] / scale
        )
        # An effect with several directions may have several terms.
        selected_effects = list(
            dict.fromkeys(
                effect
                for (effect, _), coefficient in zip(terms, model, strict=True)
                if coefficient != 0
            )
        )
        causes = [
            NamedCause(
                name, _find_equivalent_effects(name, selected_effects, chosen_columns, effects)
            )
            for name in selected_effects
        ]
        return _RegressionResult(sigmas, tuple(causes))

    @abstractmethod
    def _iterate_models(self, library: Array, residual: Array) -> Iterator[Array]:
        """Yield the coefficients (K,) of models with different numbers of terms.

        Args:
            library: columns of K candidate terms with unit mean square, (N, K).
            residual: residual of N samples, (N,).
        """


class SequentialThresholdedLeastSquares(_SparseRegression):
    """Acceleration residuals on the library: sequentially thresholded least squares (PySINDy)."""

    name = "stlsq"

    def _iterate_models(self, library: Array, residual: Array) -> Iterator[Array]:
        """Yield the coefficients (K,) for 16 thresholds.

        They go from the largest least-squares coefficient down to 0.1 % of it. The method sets
        coefficients below the threshold to zero and fits the others again, until none changes; a
        smaller threshold keeps more terms.

        Args:
            library: columns of K candidate terms with unit mean square, (N, K).
            residual: residual of N samples, (N,).
        """
        from pysindy import optimizers

        # Terms that equal a sum of others to six digits would get huge coefficients.
        coefficients, *_ = np.linalg.lstsq(library, residual, rcond=1e-6)
        size = float(np.abs(coefficients).max())
        # The threshold of the best model is unknown, so it is varied over three decades.
        for threshold in size * np.geomspace(1.0, 1e-3, 16):
            model = optimizers.STLSQ(threshold=threshold, alpha=RIDGE_PENALTY * len(residual))
            yield model.fit(library, residual[:, None]).coef_[0]


class ForwardOrthogonalLeastSquares(_SparseRegression):
    """Acceleration residuals on the library: forward orthogonal least squares (PySINDy)."""

    name = "frols"

    def _iterate_models(self, library: Array, residual: Array) -> Iterator[Array]:
        """Yield the coefficients (K,) of models with one term, two terms, and so on.

        PySINDy fails if too many terms are requested for nearly dependent columns. The largest
        number for which it succeeds is used.

        Args:
            library: columns of K candidate terms with unit mean square, (N, K).
            residual: residual of N samples, (N,).
        """
        from pysindy import optimizers

        # More terms than `MAX_TERMS` are allowed, because they show that no small model exists.
        for max_terms in range(min(2 * MAX_TERMS, library.shape[1]), 0, -1):
            model = optimizers.FROLS(max_iter=max_terms, alpha=RIDGE_PENALTY * len(residual))
            # FROLS raises an error if all other terms depend linearly on the selected ones.
            with suppress(ValueError):
                model.fit(library, residual[:, None])
                yield from (coefficients[0] for coefficients in model.history_)
                return


def _drop_duplicate_columns(
    terms: Sequence[tuple[str, int]], effects: Array
) -> tuple[list[tuple[str, int]], Array]:
    """Select the terms whose column differs from those of earlier terms.

    Nearly equal columns would get arbitrary coefficients of opposite sign.

    Args:
        terms: name of the effect and index of its column, for each term.
        effects: columns of all K directions with N rows, (N, K).

    Returns:
        The selected terms in their order, and their columns, (N, number of selected terms).
    """
    kept_terms: list[tuple[str, int]] = []
    columns: list[Array] = []
    for effect, column_index in terms:
        column = effects[:, column_index]
        size = float(np.sqrt(column @ column))
        # A column that is zero up to rounding has no term.
        if size < 1e-9 * max(len(column), 1):
            continue
        unit = column / size
        if all(
            abs(float(unit @ kept_column)) < DUPLICATE_COLUMN_CORRELATION for kept_column in columns
        ):
            kept_terms.append((effect, column_index))
            columns.append(unit)
    library = effects[:, [column_index for _, column_index in kept_terms]]
    return kept_terms, library


def _select_by_one_standard_error(
    models: Sequence[Array], residual: Array, library: Array
) -> tuple[Array, float]:
    """Select the simplest model whose held-out error is within one standard error of the best.

    Noise alone can make a more complex model better by less. Errors are means over blocks of the
    held-out runs; their scatter gives the standard error.

    Args:
        models: coefficients of each model for K terms, (K,).
        residual: residual of N samples of the held-out runs, (N,).
        library: columns of the terms in the held-out runs, (N, K).

    Returns:
        Coefficients of the selected model (zero if no model is significantly better than none),
        and the improvement of the best model over no terms in standard errors.
    """
    zero_model = np.zeros(library.shape[1])
    candidates = [zero_model, *models]
    errors = np.array(
        [
            compute_block_means(np.square(residual - library @ coefficients), HELD_OUT_BLOCK_COUNT)
            for coefficients in candidates
        ]
    )
    best = int(errors.mean(axis=1).argmin())
    gain = errors[0] - errors[best]  # over no terms, by block
    sigmas = float(gain.mean() / max(compute_standard_error(gain), 1e-12)) if best else 0.0
    if sigmas < MIN_IMPROVEMENT_STANDARD_ERRORS:
        return zero_model, sigmas
    allowed_models = []
    for coefficients, error in zip(models, errors[1:], strict=True):
        excess = error - errors[best]  # by block
        if excess.mean() <= compute_standard_error(excess):
            allowed_models.append(coefficients)
    # The simplest model has the fewest terms, which are the coefficients that are not zero.
    return min(allowed_models or [candidates[best]], key=np.count_nonzero), sigmas


def _find_equivalent_effects(
    name: str, selected_effects: Sequence[str], columns: Sequence[EffectColumn], effects: Array
) -> tuple[str, ...]:
    """List effects that were not selected but are nearly collinear with a selected effect.

    The recording does not tell them apart from it, so they are the alternatives of the cause, the
    most similar first. Effects with several columns are compared by their best pair.

    Args:
        name: the selected effect.
        selected_effects: all selected effects.
        columns: one column for each effect.
        effects: all K directions with N rows, (N, K), of which a column names its own.
    """
    selected_units = next(
        column.select_directions(effects) for column in columns if column.effect == name
    )
    correlations = {}
    for column in columns:
        if column.effect not in selected_effects:
            column_units = column.select_directions(effects)
            correlations[column.effect] = (
                float(np.abs(selected_units.T @ column_units).max()) if column_units.size else 0.0
            )
    order = sorted(correlations, key=lambda effect: -correlations[effect])
    return tuple(effect for effect in order if correlations[effect] >= SAME_CAUSE_CORRELATION)
