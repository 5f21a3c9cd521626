"""Build the wheel, check its content, and install it into an environment."""

import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

from sims.core.toml_validation import read_toml

ROOT = Path(__file__).parents[2]
PACKAGES = ("bench", "methods", "sims")
LARGEST = 3_200_000
"""Maximum size of a wheel in bytes; a larger one contains unwanted files."""
DEVELOPER_PAGES = {"bench/pages/README.md", "sims/effects/README.md"}
"""Pages on how to extend a folder; readers find them in the repository."""


def build(folder):
    """Build the wheel of this checkout with the installed tools."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
    subprocess.run([*command, "--no-build-isolation", "-w", str(folder), str(ROOT)], check=True)
    (made,) = folder.glob("*.whl")
    return made


def wanted():
    """Return the files that the wheel must contain in addition to its metadata."""
    code = {p.relative_to(ROOT).as_posix() for name in PACKAGES for p in (ROOT / name).rglob("*")}
    kept = {name for name in code if (ROOT / name).is_file() and "__pycache__" not in name}
    kept -= DEVELOPER_PAGES
    reference = ROOT / "results" / "reference"
    tables = [path.parent for path in reference.rglob("table.csv") if drawn(path)]
    files = ("table.csv", "experiment.toml", "environment.json")
    data = {
        f"bench/reference/{t.relative_to(reference).as_posix()}/{f}" for t in tables for f in files
    }
    return kept | data | {"simgap.py", "simgap-stubs/__init__.pyi"}


def drawn(table):
    """Return whether a table is a comparison's table with a configuration, so figures
    can be drawn.
    """
    head = table.read_text(encoding="utf-8").partition("\n")[0]
    return (table.parent / "experiment.toml").exists() and "metric" in head.split(",")


def find_wheel_errors(wheel):
    """Return the faults in a wheel's content."""
    with zipfile.ZipFile(wheel) as packed:
        names = {name for name in packed.namelist() if ".dist-info/" not in name}
        licences = [name for name in packed.namelist() if "dist-info/licenses/" in name]
    found = [f"missing: {name}" for name in sorted(wanted() - names)]
    spare = {name for name in names - wanted() if not name.startswith("bench/reference/")}
    found += [f"nobody asked for: {name}" for name in sorted(spare)]
    project = read_toml(ROOT / "pyproject.toml")["project"]
    extras = set(read_metadata(wheel, "Provides-Extra"))
    if extras != set(project["optional-dependencies"]):
        found.append(f"extras: {sorted(extras)}")
    if not licences:
        found.append("no licence")
    if (size := wheel.stat().st_size) > LARGEST:
        found.append(f"{size} bytes")
    return found


def environment(folder, python=sys.executable):
    """Create an environment in a folder and return its interpreter."""
    if python == sys.executable:
        venv.create(folder, with_pip=False)
    else:
        subprocess.run([str(python), "-m", "venv", str(folder)], check=True)
    return folder / "bin" / "python"


def read_metadata(wheel, field):
    """Return the values of a field of the wheel's metadata."""
    with zipfile.ZipFile(wheel) as packed:
        (about,) = [name for name in packed.namelist() if name.endswith("dist-info/METADATA")]
        return re.findall(rf"^{field}: (.*)$", packed.read(about).decode(), re.M)


def requirements(wheel, without):
    """Return the requirements in the wheel's metadata without extras and without some packages."""
    named = [line for line in read_metadata(wheel, "Requires-Dist") if "extra ==" not in line]
    return [line for line in named if re.split(r"[^\w.-]", line)[0] not in without]


def run_simgap(python, folder, *arguments, code=0):
    """Run a command of the simgap of an environment in a folder; return the finished process."""
    run = "import sys, simgap; sys.exit(simgap.main(sys.argv[1:]))"
    command = [str(python), "-c", run, *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    return done
