"""The command `simgap status`."""

from __future__ import annotations

import argparse
from collections import Counter
from typing import TYPE_CHECKING

from bench.commands.answer import DONE, WRONG, Answer, Document, Say
from bench.commands.options import place

if TYPE_CHECKING:
    from bench.store.standing import End, Standing
    from bench.study import Study

_FEW = 20
"""Maximum number of runs that are listed without ``--runs``."""


def add_status(status: argparse.ArgumentParser) -> None:
    """Add the options of `simgap status`."""
    status.add_argument(
        "run",
        metavar="DIR",
        type=place,
        nargs="?",
        help="the folder of a comparison or bounce shot; without it: which seals hold around "
        "tuners on this machine",
    )
    status.add_argument("--runs", action="store_true", help="list every run or shot")
    status.set_defaults(command=_status)


def _status(options: argparse.Namespace, say: Say) -> Answer:
    from bench.study import opened, parts_of

    if options.run is None:
        return Answer({"seals": _seals(say)})
    studies = [_stands(opened(part), options.runs, say) for part in parts_of(options.run)]
    complete = all(study["complete"] for study in studies)
    return Answer({"studies": studies}, DONE if complete else WRONG)


def _seals(say: Say) -> list[Document]:
    """Print which isolation layers are available on this machine."""
    from bench.runs.housing import seals
    from bench.sealing.seals import SEALS

    there = seals()
    say("seals around a tuner's process on this machine (docs/sealing.md)")
    for name, says in SEALS.items():
        say(f"  {name:10} {'holds' if name in there else 'DOES NOT HOLD':14} {says}")
    return [{"name": name, "holds": name in there, "says": says} for name, says in SEALS.items()]


def _seal(study: Study) -> Document:
    """Describe how the tuners of a study are isolated from the true parameters."""
    from bench.sealing.seals import SEALS

    held = study.configuration
    experiment = held.experiment
    missing = [name for name in SEALS if name not in held.seals]
    return {
        "trusted": experiment.trusted,
        "isolation": experiment.isolation,
        "missing": [] if experiment.trusted else missing,
        "salt": "secret" if experiment.salt_sha256 else "public",
        "salt_sha256": experiment.salt_sha256 or None,
        "revealed": bool(experiment.salt_sha256 and experiment.salt),
    }


def _sealed(seal: Document) -> str:
    """Format the isolation of a study as text."""
    if seal["trusted"]:
        return "trusted: its tuners run inside the harness"
    missing, salt = seal["missing"], seal["salt_sha256"]
    kept = "sealed: a process for each "
    kept += "run" if seal["isolation"] == "run" else "tuner and seed"
    without = f", WITHOUT the seals {', '.join(missing)}" if missing else ", every seal holds"
    told = f"; salt with SHA-256 {salt[:12]}" if salt else "; its salt is public"
    return kept + without + told + (", revealed" if seal["revealed"] else "")


def _stands(study: Study, every: bool, say: Say) -> Document:
    """Print the progress of a study, and return it as a document."""
    standing = study.status()
    planned, what = len(standing.ends), standing.what
    seal, groups = _seal(study), _counts(standing)
    resume = None if standing.complete else f"simgap compare --resume {study.folder}"
    shown = standing.ends if every else _telling(standing)

    complete = ", complete" if standing.complete else ""
    say(f"{standing.name}: {standing.finished} of {planned} {what}{complete}")
    say("  " + ", ".join(f"{name} {value}" for name, value in standing.hashes.items()))
    say(f"  {_sealed(seal)}")
    for line in _counted(groups):
        say(f"  {line}")
    for end in shown:
        say(f"{end.status:10} {end.name}  {_reason(end)}".rstrip())
    if len(standing.ends) > len(shown):
        say(f"({len(shown)} of {len(standing.ends)} listed; --runs lists all)")
    if resume:
        say(f"to finish it: {resume}")
    return {
        "name": standing.name,
        "folder": study.folder,
        "what": what,
        "finished": standing.finished,
        "planned": planned,
        "complete": standing.complete,
        "hashes": dict(standing.hashes),
        "seal": seal,
        "groups": groups,
        "runs": [end._asdict() for end in shown],
        "resume": resume,
    }


def _counts(standing: Standing) -> dict[str, dict[str, int]]:
    """Count the runs of each tuner or kind of ball by status."""
    groups: dict[str, Counter[str]] = {}
    for end in standing.ends:
        groups.setdefault(end.group, Counter())[end.status] += 1
    return {group: dict(sorted(ends.items())) for group, ends in groups.items()}


def _counted(groups: dict[str, dict[str, int]]) -> list[str]:
    """Format the counts as text, missing runs last."""
    from bench.store.standing import MISSING

    width = max(map(len, groups), default=0)
    lines = []
    for group, ends in groups.items():
        ordered = sorted(ends, key=lambda status: (status == MISSING, status))
        lines.append(f"{group:{width}}  {', '.join(f'{ends[s]} {s}' for s in ordered)}")
    return lines


def _telling(standing: Standing) -> tuple[End, ...]:
    """Select the runs to list: those without success, or all; at most `_FEW`."""
    from bench.store.standing import FINE

    telling = tuple(end for end in standing.ends if end.status not in FINE)
    return (telling or standing.ends)[:_FEW]


def _reason(end: End) -> str:
    # The last line of a traceback names the error.
    return (end.reason.strip().splitlines() or [""])[-1]
