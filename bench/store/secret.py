"""The secret salt of a study in its folder: apart and for its owner alone while there is work left,
in experiment.toml when all is done.
"""

from __future__ import annotations

from pathlib import Path

from bench.problem.experiment import Experiment
from bench.problem.salt import PUBLIC, check_commitment, commitment, fresh
from bench.store.folder import SALT, configuration, write_configuration
from bench.store.segments import FOLDER
from sims.base import InputError


def salted(experiment: Experiment, salt: str | None) -> tuple[Experiment, str | None]:
    """An experiment about to begin, and the secret that its targets are drawn from.

    Args:
        experiment: what is asked for; a salt in it is public.
        salt: given by a person; a fresh one where None.

    Returns:
        The experiment with the secret's hash, and the secret; None where the salt is public.

    Raises:
        InputError: two salts were given, or an impossible one.
    """
    if experiment.salt and salt not in (None, experiment.salt):
        raise InputError(
            f"experiment {experiment.name}: has a salt of its own, which is public; leave out the "
            "other, or take it from the experiment"
        )
    if experiment.salt or salt == PUBLIC:
        return experiment.chosen(salt=experiment.salt or PUBLIC, salt_sha256=""), None
    secret = fresh() if salt is None else salt
    if not secret:
        raise InputError("salt: expected a text, found none; leave it out for a fresh one")
    check_commitment("salt", secret, "")
    return experiment.chosen(salt_sha256=commitment(secret)), secret


def kept(folder: Path, experiment: Experiment) -> str | None:
    """The secret salt of a study that is to be resumed; None where it is public, or revealed.

    Raises:
        InputError: it is gone, or not the one that was committed.
    """
    if experiment.salt or not experiment.salt_sha256:
        return None
    path = folder / FOLDER / SALT
    try:
        secret = path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        raise InputError(
            f"{path}: expected the salt that the targets are drawn from, found none; restore it, "
            "or start a new comparison"
        ) from None
    check_commitment(str(path), secret, experiment.salt_sha256)
    return secret


def reveal(folder: Path, secret: str | None) -> None:
    """Write the salt where everybody can read it: nothing is left that it could help."""
    if secret is None:
        return
    write_configuration(folder, configuration(folder).experiment.chosen(salt=secret))
    (folder / FOLDER / SALT).unlink(missing_ok=True)
