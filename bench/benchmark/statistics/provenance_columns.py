"""Columns of result tables that describe how the runs were made."""

from __future__ import annotations

import pandas as pd

from bench.benchmark.problem.experiment import Experiment


def add_trust_column(frame: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """Add the column `trusted`, True if the tuners ran without isolation."""
    return frame.assign(trusted=experiment.trusted)


def add_salt_column(frame: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """Add the column `salt`: ``secret`` if the salt is committed by a hash, else ``public``."""
    return frame.assign(salt="secret" if experiment.salt_sha256 else "public")
