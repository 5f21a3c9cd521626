"""Choose the kind of study of an experiment or result folder; begin, resume and open studies.

Comparisons of tuners, comparisons of diagnosers, bounce shots and studies of a missing effect
implement the interface of `bench.benchmark.runner.study_base.Study`. Only this module decides which
of them an experiment describes.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.benchmark.storage.result_folder import (
    CONFIGURATION_FILE,
    choose_free_folder,
    read_configuration,
)
from bench.core.random_streams import generate_salt

if TYPE_CHECKING:
    from bench.benchmark.problem.experiment_config import Experiment
    from bench.benchmark.runner.study_base import PrintLine, Study


def begin_studies(
    experiment: Experiment,
    plugins: Sequence[str] = (),
    folder: Path | None = None,
    jobs: int = 2,
    salt: str | None = None,
) -> list[Study]:
    """Check and plan one study, or several if the experiment sweeps or names other experiments.

    Args:
        experiment: configuration of the study or studies.
        plugins: plugin files that they need; the caller has loaded them.
        folder: folder of the study; for several studies the folder that contains one subfolder for
            each, with the name of its experiment.
        jobs: number of worker processes; 0 for none, and tuners without isolation.
        salt: salt of the targets, secret until the study is complete; None for a new one. Several
            studies of one sweep share it, so that they have the same targets.

    Returns:
        The studies in their new folders, without any run.

    Raises:
        InputError: one of the studies has an error, or the folder is not free; no files are left
            behind.
    """
    from bench.benchmark.problem.experiment_config import expand_sweep
    from bench.benchmark.runner.study_base import prepare_study

    def begin(part: Experiment, study_folder: Path | None) -> Study:
        return get_study_class(part).begin(prepare_study(part, plugins, study_folder, jobs, salt))

    experiments = expand_sweep(experiment)
    if len(experiments) == 1:
        return [begin(experiments[0], folder)]
    # Separate experiments have separate salts, so that a complete one does not reveal another's.
    if salt is None and not experiment.salt and not experiment.experiments:
        salt = generate_salt()
    parent = choose_free_folder(experiment, folder)
    studies: list[Study] = []
    try:
        # All are planned before the first is run, so that an error in the last one shows at once.
        for part in experiments:
            studies.append(begin(part, parent / part.name))
    except BaseException:
        # Folders that were created before the error are deleted.
        for study in studies:
            study.close()
            shutil.rmtree(study.folder, ignore_errors=True)
        if parent.is_dir() and not any(parent.iterdir()):
            parent.rmdir()
        raise
    return studies


def list_study_folders(folder: Path) -> list[Path]:
    """Return the folders of the studies in a folder: itself, or the subfolders of a sweep."""
    if (folder / CONFIGURATION_FILE).exists() or not folder.is_dir():
        return [folder]
    subfolders = sorted(path for path in folder.iterdir() if (path / CONFIGURATION_FILE).exists())
    return subfolders or [folder]


def report_jointly(folder: Path, print_line: PrintLine) -> None:
    """Write and print the joint results of the studies in a folder, if their kind has any.

    Several misspecification studies (with a table [calibration], on the effect of physics that the
    simulator lacks), and the problems of a suite (a versioned set of problems), have joint results.

    Args:
        folder: folder that was given to `begin_studies`.
        print_line: callback that prints one line.
    """
    parts = list_study_folders(folder)
    experiments = [read_configuration(part).experiment for part in parts]
    if len(parts) > 1 and all(experiment.calibration for experiment in experiments):
        from bench.misspecification.misspecification_report import write_joint_report

        write_joint_report(folder, parts, print_line)
    if experiments and all(experiment.suite for experiment in experiments):
        from bench.suite.suite_report import report_suite

        report_suite(folder, print_line)


def resume_study(folder: Path, plugins: Sequence[str] = ()) -> Study:
    """Open an interrupted study to complete it; see `Study.resume`.

    Args:
        folder: result folder.
        plugins: additional plugin files.
    """
    return _find_study_class(folder).resume(folder, plugins)


def open_study(folder: Path) -> Study:
    """Open the study in a folder, for status and report.

    Raises:
        InputError: there is no study, or it is damaged.
    """
    return _find_study_class(folder)(folder)


def get_study_class(experiment: Experiment) -> type[Study]:
    """Return the kind of study that an experiment describes.

    Args:
        experiment: Experiment whose tables [shot], [calibration] or [diagnosis] select the kind.

    Returns:
        The class; an ordinary comparison of tuners if none of these tables exists.
    """
    # The classes are imported here, because a comparison does not need the other studies' modules.
    if experiment.shot:
        from bench.bounce_shot.shot_study import BounceShotStudy

        return BounceShotStudy
    if experiment.calibration:
        from bench.misspecification.misspecification_study import MisspecificationStudy

        return MisspecificationStudy
    if experiment.diagnosis:
        from bench.diagnosis_benchmark.diagnoser_study import DiagnosisStudy

        return DiagnosisStudy
    from bench.benchmark.comparison_study import Comparison

    return Comparison


def _find_study_class(folder: Path) -> type[Study]:
    return get_study_class(read_configuration(folder).experiment)
