"""Begins a comparison in a new folder, or finishes one that was interrupted; what `simgap compare`
and `status` do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.store.folder import Configuration, configuration, create, free_folder, write_results
from bench.store.journal import FOLDER, Journal, finished, read_plan, write_plan
from sims.base import InputError
from sims.files import write

if TYPE_CHECKING:
    from bench.problem.experiment import Experiment
    from bench.runs.pools import Pool
    from bench.runs.runner import Progress, Results

Say = Callable[[str], None]


def begin(
    experiment: Experiment, plugins: Sequence[str], out: str | None, jobs: int
) -> tuple[Path, Results]:
    """A new folder and the results that will be kept there.

    Raises:
        InputError: a fault in the experiment, or the folder is not free.
    """
    from bench.runs.identity import fingerprint
    from bench.runs.runner import prepare

    folder = free_folder(experiment, Path(out) if out else None)
    results = prepare(experiment)
    create(folder, Configuration(experiment, list(plugins), fingerprint(experiment, plugins)), jobs)
    _attach(folder, results)
    return folder, results


def resume(folder: Path, plugins: Sequence[str]) -> tuple[list[str], Results]:
    """The plugins and results of a folder that was interrupted: what is finished is kept, what is
    missing remains.

    Raises:
        InputError: it is no such folder, it is damaged, or something that matters has changed since
            it was begun.
    """
    from bench.registry import load_plugins
    from bench.runs.identity import fingerprint, refuse_changes
    from bench.runs.runner import prepare

    held = configuration(folder)
    given = {str(Path(p).resolve()) for p in plugins}
    everything = held.plugins + sorted(given - set(held.plugins))
    load_plugins(everything)
    refuse_changes(folder, held.fingerprint, fingerprint(held.experiment, everything))
    results = prepare(held.experiment)
    _attach(folder, results)
    return everything, results


def only_resume(options: object) -> None:
    """Refuse options of the command line that would change what is resumed.

    Raises:
        InputError: there are some.
    """
    names = (
        "experiment",
        "tuners",
        "targets",
        "seeds",
        "budget",
        "training_budget",
        "timeout",
        "memory",
        "out",
    )
    given = [name for name in names if getattr(options, name) is not None]
    if given:
        raise InputError(
            f"--resume takes the configuration of its folder as it is; leave out {', '.join(given)}"
        )


def _attach(folder: Path, results: Results) -> None:
    """Open the journal of the folder, write or check the plan."""
    ids = [job.order.run for job in results.plan]
    if not (folder / FOLDER).exists():
        results.kept.statuses = _complete(folder, ids)
        return
    planned = read_plan(folder)
    journal = Journal(folder)
    if planned is None:
        write_plan(folder, ids)
    foreign = [
        place for place, s in journal.statuses.items() if place >= len(ids) or ids[place] != s.run
    ]
    if foreign or (planned is not None and planned != ids):
        journal.close()
        raise InputError(
            f"{folder}: its plan is not the one that its configuration gives; start a new comparison"
        )
    results.kept = journal


def _complete(folder: Path, ids: list[str]) -> dict[int, Any]:
    """The statuses of a folder that says it is finished.

    Raises:
        InputError: it holds other runs than those planned.
    """
    from bench.store.folder import read

    stored = [
        str(name)
        for name in read(folder, ["run", "tuner", "k"]).statuses.query("status != 'skipped'")["run"]
    ]
    if stored != ids:
        raise InputError(
            f"{folder}: expected {len(ids)} runs, found {len(stored)} or others; start a new comparison"
        )
    return dict.fromkeys(range(len(ids)))


def make(
    folder: Path,
    results: Results,
    plugins: Sequence[str],
    jobs: int,
    bar: Progress,
    pool: Pool | None,
) -> bool:
    """Make what is missing and write the results; returns whether the comparison is complete.

    Raises:
        InputError: workers cannot be had; what was finished is kept.
    """
    from bench.runs.runner import run

    journal = results.kept
    if not isinstance(journal, Journal):  # complete before we came
        return True
    try:
        run(results, plugins, jobs, bar, pool)
    finally:
        write_results(folder, journal, results.training_rows(), results.skipped_rows())
        _write_spectra(folder, results)
        complete = len(journal.statuses) == len(results.plan)
        if complete:
            journal.discard()
        else:
            journal.close()
    return complete


def _write_spectra(folder: Path, results: Results) -> None:
    """Write identifiability.csv, a row a target and direction, where there are several parameters."""
    if results.spectra:
        from bench.analysis.spectra import spectra_table

        table = spectra_table(
            results.problem.experiment, results.spectra, results.problem.cube.parameters
        )
        write(folder / "identifiability.csv", table.to_csv(index=False))


def status(folder: Path, every: bool, say: Say) -> bool:
    """Say what a folder holds and what is missing; returns whether it is complete.

    Raises:
        InputError: it is not the folder of a comparison, or it is damaged.
    """
    held = configuration(folder)
    planned, ends = _ends(folder)
    missing = len(planned) - len(ends)
    say(
        f"{held.experiment.name}: {len(ends)} of {len(planned)} runs finished"
        + (", complete" if not missing else "")
    )
    say("  " + ", ".join(f"{what} {value}" for what, value in held.fingerprint.items()))
    tuners = dict.fromkeys(name.split("/")[0] for name in planned)
    counts = Counter((run.split("/")[0], status) for run, (status, _) in ends.items())
    total = Counter(name.split("/")[0] for name in planned)
    width = max([len(t) for t in tuners], default=0)
    for tuner in tuners:
        parts = [f"{n} {status}" for (name, status), n in sorted(counts.items()) if name == tuner]
        left = total[tuner] - sum(n for (name, _), n in counts.items() if name == tuner)
        say(f"  {tuner:{width}}  {', '.join(parts + [f'{left} missing'] * (left > 0))}")
    shown = [(run, *ends.get(run, ("missing", ""))) for run in planned]
    if not every:
        unfinished = [line for line in shown if line[1] not in ("done", "converged")]
        shown = (unfinished or shown)[:20]
    for run, end, reason in shown:
        say(f"{end:10} {run}  {(reason.strip().splitlines() or [''])[-1]}".rstrip())
    if not every and len(planned) > len(shown):
        say(f"({len(shown)} of {len(planned)} runs listed; --runs lists all)")
    if missing:
        say(f"to finish it: simgap compare --resume {folder}")
    return not missing


def _ends(folder: Path) -> tuple[list[str], dict[str, tuple[str, str]]]:
    """Ids of all planned runs, and status and reason of the finished ones."""
    if (folder / FOLDER).exists():
        planned = read_plan(folder) or []
        return planned, {s.run: (s.status, s.reason) for s in finished(folder).values()}
    from bench.store.folder import read

    rows = read(folder, ["run", "tuner", "k"]).statuses
    rows = rows[rows["status"] != "skipped"]
    ends = {
        str(run): (str(s), str(r))
        for run, s, r in zip(rows["run"], rows["status"], rows["reason"], strict=True)
    }
    return list(ends), ends
