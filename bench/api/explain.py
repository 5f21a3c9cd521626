"""Python API: `simgap.explain`."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from bench.api.recordings import Sources, list_sources
from bench.core.option_dataclasses import with_options
from bench.core.resource_estimates import count_available_cores
from bench.diagnosis import explain as explaining
from bench.diagnosis.explain_options import ExplainOptions
from bench.diagnosis.explanation import Explanation

SearchOptions = TypeVar("SearchOptions", bound=ExplainOptions)


@with_options(ExplainOptions)
def explain(recording: Sources, options: ExplainOptions) -> Explanation:
    """Find the effects that a simulator of a recorded system lacks, and add them to it.

    Args:
        recording: Path of ``NAME.csv``, a recording that was read or simulated, or a pandas
            DataFrame with the columns that `read_recording` describes. Several recordings of one
            system are explained together, and each also separately.
        options: Keyword arguments, the attributes of
            `bench.diagnosis.explain_options.ExplainOptions`.

    Returns:
        The verdict, its causes, the extended simulator and the figures.

    Raises:
        InputError: An argument is wrong; the recording cannot be read, is too short or is of a
            simulator that takes no effects; or the search ended before the first simulation.
    """
    return explaining.explain(list_sources(recording, options), with_all_cores(options))


def with_all_cores(options: SearchOptions) -> SearchOptions:
    """Replace the default number of worker processes by the number of cores."""
    return replace(options, jobs=options.jobs or count_available_cores())
