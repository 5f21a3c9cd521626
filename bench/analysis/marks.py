"""What every table says of how its runs were made: whether tuners were trusted, and whether
everybody could draw the targets.
"""

from __future__ import annotations

import pandas as pd

from bench.problem.experiment import Experiment


def marked(frame: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """The table with a column that says whether the tuners were trusted."""
    return frame.assign(trusted=experiment.trusted)


def with_salt(frame: pd.DataFrame, experiment: Experiment) -> pd.DataFrame:
    """The table with a column that says what its targets were drawn from: ``secret`` until all was
    done, or ``public``.
    """
    return frame.assign(salt="secret" if experiment.salt_sha256 else "public")
