"""Update requirements-explain.txt from requirements.lock:

    python -m tests.packaging.explain_requirements

It needs uv (``pip install uv``), which resolves versions for all supported Pythons at once.
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from packaging.requirements import Requirement

from sims.core.toml_validation import read_toml

ROOT = Path(__file__).parents[2]
FILE = ROOT / "requirements-explain.txt"
LOCK = ROOT / "requirements.lock"
WITHOUT = ("torch", "pybullet")


def direct():
    """Return simgap's direct requirements in pyproject.toml, without the two large packages."""
    project = read_toml(ROOT / "pyproject.toml")["project"]
    return [line for line in project["dependencies"] if Requirement(line).name not in WITHOUT]


def pins(path):
    """Return (name, version, marker) of each line of a file with pinned versions."""
    lines = [line for line in path.read_text().splitlines() if line and line[0] != "#"]
    found = [Requirement(line) for line in lines]
    return [(each.name, str(each.specifier).removeprefix("=="), each.marker) for each in found]


def main():
    """Write the pinned versions below the header comment of the file."""
    comment = [line for line in FILE.read_text().splitlines() if line.startswith("#")]
    options = ["--quiet", "--universal", "--python-version", "3.10", "--no-header", "--no-annotate"]
    with TemporaryDirectory() as place:
        wanted = Path(place, "explain.in")
        wanted.write_text("\n".join(direct()))
        command = ["uv", "pip", "compile", *options, "--constraint", str(LOCK), str(wanted)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    FILE.write_text("\n".join([*comment, done.stdout.strip(), ""]))


if __name__ == "__main__":
    sys.exit(main())
