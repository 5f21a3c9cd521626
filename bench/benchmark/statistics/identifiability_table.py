"""Build the table identifiability.csv: which parameter combinations the data identify."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from bench.benchmark.problem.experiment import Experiment
from bench.benchmark.problem.fisher_information import InformationSpectrum
from sims.core.simulator import Parameter

IDENTIFIABILITY_COLUMNS = [
    "experiment",
    "target",
    "range",
    "direction",
    "eigenvalue",
    "sigma",
    "stiff",
]


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
    lines = [
        [
            experiment.name,
            target,
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
    return pd.DataFrame(lines, columns=[*IDENTIFIABILITY_COLUMNS, *(p.name for p in parameters)])
