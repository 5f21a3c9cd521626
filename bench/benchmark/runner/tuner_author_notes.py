"""Notes for the authors of tuners: discarded files and slow imports of their runs."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from statistics import median

from bench.benchmark.runner.run_in_worker import RunOutcome

SLOW_IMPORTS = 1.0
"""Minimum import time of a run, in seconds, for suggesting one process for several runs."""
_MAX_NAMED_FILES = 3
"""Maximum number of file names in a note."""


@dataclass
class _TunerRuns:
    """Information about the runs of one tuner.

    Attributes:
        files: number of files that it wrote, and that were discarded.
        names: names of the first files, as keys.
        unnamed: True if there were further files without a name here.
        import_seconds: time for imports before each run that needed any, in seconds.
    """

    files: int = 0
    names: dict[str, None] = field(default_factory=dict)
    unnamed: bool = False
    import_seconds: list[float] = field(default_factory=list)


@dataclass
class Notes:
    """Collected information of runs, by tuner label.

    Attributes:
        isolation: isolation of the experiment, ``run`` or ``tuner``.
    """

    isolation: str
    _tuners: dict[str, _TunerRuns] = field(default_factory=lambda: defaultdict(_TunerRuns))

    def add(self, label: str, outcome: RunOutcome) -> None:
        """Add the information of one run.

        Args:
            label: label of the tuner.
            outcome: outcome of the run.
        """
        tuner = self._tuners[label]
        written = outcome.written
        tuner.files += written.files
        tuner.names |= dict.fromkeys(written.names)
        # A run names only the first files that its tuner has written.
        tuner.unnamed = tuner.unnamed or written.files > len(written.names)
        if outcome.import_seconds:
            tuner.import_seconds.append(outcome.import_seconds)

    def lines(self) -> list[str]:
        """Return a line for each tuner whose files were discarded or whose imports are slow."""
        lines = []
        for label, tuner in self._tuners.items():
            if tuner.files:
                files = "1 file" if tuner.files == 1 else f"{tuner.files} files"
                names = ", ".join(list(tuner.names)[:_MAX_NAMED_FILES])
                suffix = ", …" if tuner.unnamed or len(tuner.names) > _MAX_NAMED_FILES else ""
                were = "was" if tuner.files == 1 else "were"
                lines.append(
                    f"{files} written by tuner {label} ({names}{suffix}) {were} discarded with its "
                    "sandbox"
                )
            seconds = median(tuner.import_seconds or [0.0])
            runs = len(tuner.import_seconds)
            # With the isolation "run" each run has a new process, which imports everything again.
            if self.isolation == "run" and runs > 1 and seconds >= SLOW_IMPORTS:
                lines.append(
                    f"tuner {label}: its imports take {seconds:.1f} s in each of {runs} runs; with "
                    "--isolation tuner, all runs of one seed share them"
                )
        return lines
