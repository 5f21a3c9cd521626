"""Find the parameter combinations that a target's data identify, and the errors along them.

For N samples with white noise, each with its own standard deviation, the derivatives with respect
to the parameters in units of their training ranges are the Jacobian

    J_nk = (d y_n / d theta_k) / sigma_n                            (1)
    F = J^T J = V diag(lambda) V^T                                  (2)

with F the Fisher information. Along the eigenvector v_k no unbiased estimate has a smaller standard
deviation than (Cramer-Rao bound)

    sigma(v_k) = 1 / sqrt(lambda_k)                                 (3)

A direction with a small sigma is well determined by the data (stiff), one with a large sigma is not
(sloppy): R. N. Gutenkunst et al., PLoS Comput. Biol. 3(10), e189 (2007),
doi:10.1371/journal.pcbi.0030189; M. K. Transtrum et al., J. Chem. Phys. 143, 010901 (2015),
doi:10.1063/1.4923066. An error along a sloppy direction is not the tuner's fault, because the data
do not contain the information.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array, Parameter

if TYPE_CHECKING:
    import pandas as pd

    from bench.benchmark.problem.experiment_config import Experiment
    from bench.benchmark.problem.targets import Target
    from bench.benchmark.problem.tuning_problem import TuningProblem

STIFF_SIGMA_THRESHOLD = 0.1
"""Upper limit of the standard deviation of a stiff direction, in training ranges.

The standard deviation is the Cramer-Rao bound.
"""

FINITE_DIFFERENCE_STEP = 1e-4
"""Step of the central differences, in training ranges."""

SPECTRUM_COLUMNS = [
    "experiment",
    "target",
    "range",
    "direction",
    "eigenvalue",
    "sigma",
    "stiff",
]
"""Columns of identifiability.csv, without those of the parameters."""


@dataclass(frozen=True)
class InformationSpectrum:
    """Fisher-information spectrum of one target's data, the stiffest direction first.

    Attributes:
        values: (dim,) eigenvalues of the Fisher information per squared training range, decreasing.
        vectors: (dim, dim) eigenvectors as columns, of length one, components in training ranges;
            the largest component is positive.
    """

    values: Array
    vectors: Array

    @property
    def sigmas(self) -> Array:
        """Cramer-Rao bound (dim,) along each direction, in training ranges.

        It is the smallest standard deviation of any unbiased estimate, and may be infinite.

        With the eigenvalue lambda_k of the Fisher information along direction k, sigma_k = 1 /
        sqrt(lambda_k) (3).
        """
        with np.errstate(divide="ignore"):  # an eigenvalue may be zero
            sigmas: Array = 1.0 / np.sqrt(self.values)  # (3)
        return sigmas

    @property
    def is_stiff(self) -> NDArray[np.bool_]:
        """Boolean mask (dim,) of the stiff directions."""
        is_below_threshold: NDArray[np.bool_] = self.sigmas < STIFF_SIGMA_THRESHOLD
        return is_below_threshold

    def compute_directional_errors(self, errors: Array) -> tuple[Array, Array]:
        """Compute RMS errors along the stiff and along the sloppy directions.

        The data determine the stiff directions of the parameter space well, and the sloppy ones
        badly, so that errors along sloppy directions say little about a tuner.

        Args:
            errors: (k, dim) recommended minus true parameters, in training ranges.

        Returns:
            Root mean squares (k,) along stiff and along sloppy directions; NaN if there are none.
        """
        squares = (errors @ self.vectors) ** 2
        return _compute_rms(squares[:, self.is_stiff]), _compute_rms(squares[:, ~self.is_stiff])


def _compute_rms(squares: Array) -> Array:
    """Return the root mean square (k,) over directions of squares (k, directions).

    NaN if there is no direction.
    """
    if squares.shape[1] == 0:  # numpy would warn of an empty mean
        return np.full(len(squares), np.nan)
    rms: Array = np.sqrt(squares.mean(axis=1))
    return rms


def compute_target_spectrum(problem: TuningProblem, target: Target) -> InformationSpectrum | None:
    """Compute the Fisher-information spectrum of a target's data at its true parameters.

    For a recording it is computed at the nominal parameters, and for the first start only, because
    all starts have the same data.

    Args:
        problem: tuning problem of the target.
        target: target with its true parameters.

    Returns:
        The spectrum; None if it is not requested or computed for another start.
    """
    # The name of the first start ends in 000.
    is_repeated = target.truth is None and target.blinded.name != f"{target.blinded.range}-000"
    if is_repeated or not problem.has_several_parameters:
        return None
    nominal = np.array([parameter.nominal for parameter in problem.cube.parameters])
    evaluation_point = nominal if target.truth is None else target.truth
    scenarios = target.blinded.fitting.scenarios

    def simulate(theta: Array) -> Array:
        # This bypasses `problem.simulate`, because these simulations are not part of any budget.
        return np.concatenate([problem.simulator.simulate(theta, s) for s in scenarios], axis=1)

    return compute_spectrum(simulate, evaluation_point, problem.cube.parameters, problem.scale)


def compute_spectrum(
    simulate: Callable[[Array], Array], truth: Array, parameters: Sequence[Parameter], scale: Array
) -> InformationSpectrum:
    """Compute the spectrum at the true parameters, by central differences within the bounds.

    A sample that is missing (NaN) in a simulation near the true parameters contributes no
    information about the changed parameter.

    The Jacobian is J_nk = (d y_n / d theta_k) / sigma_n (1), for sample n and parameter k in units
    of its training range.

    Shapes: T samples, C channels.

    Args:
        simulate: parameters (n, dim) in physical units -> observations (n, T, C).
        truth: (dim,) true parameters in physical units.
        parameters: parameters with their bounds and training ranges.
        scale: (C,) standard deviation of each channel's white noise, or its typical magnitude if
            the noise is not known.

    Returns:
        Eigenvalues and eigenvectors of the Fisher information J^T J.
    """
    low, high = np.array([p.bounds for p in parameters]).T
    ranges = np.array([p.training_range for p in parameters])
    widths = ranges[:, 1] - ranges[:, 0]
    dim = len(parameters)
    # One row for each simulated point: the first dim ones have one parameter increased, the others
    # have it decreased.
    steps = np.concatenate([np.diag(widths), -np.diag(widths)])
    shifted_parameters = np.clip(truth + FINITE_DIFFERENCE_STEP * steps, low, high)
    # Distance of both points in training ranges. At a bound only one side moves, and the difference
    # is divided by the shorter step.
    step_widths = np.diagonal(shifted_parameters[:dim] - shifted_parameters[dim:]) / widths
    observations = simulate(shifted_parameters)
    changes = (observations[:dim] - observations[dim:]) / scale
    # A failed simulation has no derivative.
    changes = np.nan_to_num(changes, nan=0.0, posinf=0.0, neginf=0.0)
    return compute_spectrum_from_jacobian(
        (changes.reshape(dim, -1) / step_widths[:, None]).T
    )  # (1)


def compute_spectrum_from_jacobian(jacobian: Array) -> InformationSpectrum:
    """Compute the spectrum of the Fisher information J^T J of a Jacobian.

    It is computed from the singular values of J, because rounding in J^T J would destroy the small
    eigenvalues.

    Args:
        jacobian: (N, dim) derivatives of the observations divided by their noise.
    """
    dim = jacobian.shape[1]
    # J = Q R, and Q is orthogonal, so R (dim, dim) has the singular values of J.
    _, singular_values, right_vectors = np.linalg.svd(np.linalg.qr(jacobian, mode="r"))
    values, vectors = np.zeros(dim), right_vectors.T
    values[: singular_values.size] = (
        singular_values**2
    )  # (2); with fewer samples than parameters the others are 0
    # The sign of an eigenvector is arbitrary; it is fixed so that results are reproducible.
    largest_rows = np.abs(vectors).argmax(axis=0)[None]
    largest_entries = np.take_along_axis(vectors, largest_rows, axis=0)
    return InformationSpectrum(values, vectors * np.where(largest_entries < 0, -1.0, 1.0))


def build_identifiability_table(
    experiment: Experiment,
    spectra: Mapping[str, InformationSpectrum],
    parameters: Sequence[Parameter],
) -> pd.DataFrame:
    """Build a table with one row per target and direction, the stiffest direction first.

    Args:
        experiment: experiment of the targets.
        spectra: identifiability spectrum by target.
        parameters: tuned parameters.

    Returns:
        Table of eigenvalues, standard deviations and the components of each parameter.
    """
    import pandas as pd

    lines = [
        [
            experiment.name,
            target,
            # The name of a target begins with its range, as in `wide-017`.
            target.split("-")[0],
            i + 1,
            spectrum.values[i],
            spectrum.sigmas[i],
            spectrum.is_stiff[i],
            *spectrum.vectors[:, i],
        ]
        for target, spectrum in spectra.items()
        for i in range(len(spectrum.values))
    ]
    return pd.DataFrame(lines, columns=[*SPECTRUM_COLUMNS, *(p.name for p in parameters)])
