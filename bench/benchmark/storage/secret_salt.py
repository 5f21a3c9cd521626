"""Secret salt of a study: draw it, commit to it by its hash, and reveal it when all is complete.

While runs are missing, the salt is in a separate file that only its owner can read; when the study
is complete, it is in experiment.toml.
"""

from __future__ import annotations

from pathlib import Path

from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.storage.result_folder import SALT_FILE, read_configuration, write_configuration
from bench.benchmark.storage.run_journal import SEGMENTS_FOLDER
from bench.core.random_streams import (
    PUBLIC_SALT,
    check_commitment,
    compute_commitment,
    generate_salt,
)
from sims.core.simulator import InputError


def draw_salt_if_needed(experiment: Experiment, salt: str | None) -> tuple[Experiment, str | None]:
    """Draw or take the secret salt of a new study, and commit to it by its hash.

    The salt determines the random targets. As long as it is secret, no tuner can be made for these
    targets; its hash proves afterwards that it was not chosen after the results.

    Args:
        experiment: The experiment; a salt in it is public.
        salt: Salt given by the user; None for a fresh one.

    Returns:
        The experiment with the secret's hash, and the secret; None if the salt is public.

    Raises:
        InputError: Two salts were given, or an invalid one.
    """
    if experiment.salt and salt not in (None, experiment.salt):
        raise InputError(
            f"experiment {experiment.name}: states a public salt; leave out the salt, or "
            "remove it from the experiment"
        )
    # A public salt has no hash, because nothing is committed.
    if experiment.salt or salt == PUBLIC_SALT:
        return experiment.chosen(salt=experiment.salt or PUBLIC_SALT, salt_sha256=""), None
    secret = generate_salt() if salt is None else salt
    if not secret:
        raise InputError("salt: expected a text, found none; leave it out for a fresh one")
    # There is no earlier hash (""), so this only checks the length of the salt.
    check_commitment("salt", secret, "")
    return experiment.chosen(salt_sha256=compute_commitment(secret)), secret


def read_salt(folder: Path, experiment: Experiment) -> str | None:
    """Read the secret salt of a study to be resumed; None if it is public or revealed.

    Args:
        folder: Folder of the study.
        experiment: Its configuration, with the hash of the salt.

    Raises:
        InputError: It is missing, or differs from the committed one.
    """
    # A revealed or public salt is in the configuration; only a secret one has a hash.
    if experiment.salt or not experiment.salt_sha256:
        return None
    path = folder / SEGMENTS_FOLDER / SALT_FILE
    try:
        secret = path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        raise InputError(
            f"{path}: expected the salt that the targets are drawn from, found none; restore it, "
            "or start a new comparison"
        ) from None
    check_commitment(str(path), secret, experiment.salt_sha256)
    return secret


def reveal_salt(folder: Path, secret: str | None) -> None:
    """Write the salt to experiment.toml, since the study is complete.

    Args:
        folder: Folder of the study.
        secret: The salt; None if it is public, then nothing is done.
    """
    if secret is None:
        return
    write_configuration(folder, read_configuration(folder).experiment.chosen(salt=secret))
    (folder / SEGMENTS_FOLDER / SALT_FILE).unlink(missing_ok=True)
