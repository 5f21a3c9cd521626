"""Installs the wheel into empty environments and uses it there, away from the checkout.

    python -m tests.packaging [--without torch,pybullet] PYTHON ...

prints what each step took. Packages come from pip's own index; --without leaves some out, as where
there is no wheel for a version of Python.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from tests.packaging.wheel_in_environment import build, environment, find_wheel_errors, requirements

SMALL = """simulator = "pendulum"
observe = ["q"]
tuners = ["random", "nelder_mead"]
targets = 2
budget = 4
[settings]
engine = "batch"
[initial]
q = [0.5, 1.0]
[sampling]
rate = 50.0
samples = 50
"""
"""An experiment that needs only simgap's own engine."""


def steps():
    """Return the commands of the check, each of which must succeed."""
    log, told = "swing.csv", "told"
    hidden = ["--effect", "drag.linear=4e-4", "--noise", "q=0.01", "--observe", "q"]
    simulated = ["simulate", "pendulum", *hidden, "--runs", "2", "--seconds", "2", "--rate", "50"]
    return [
        ["--version"],
        ["list", "tuners"],
        ["list", "references"],
        ["list", "experiments"],
        ["download"],
        ["info"],
        ["schema", "verdict"],
        ["completion", "bash"],
        ["compare", "small.toml", "--jobs", "1", "--out", "run"],
        ["plot", "run", "--behind", "run"],
        ["diff", "run", "run", "--fail-on", "change"],
        ["verify", "run"],
        ["bundle", "run"],
        ["verify", "run.zip"],
        [*simulated, "--out", log],
        ["explain", log, "--jobs", "1", "--out", told],
        ["score", f"{told}/extended.toml", log],
        ["bundle", told, "--with", log],
        ["verify", f"{told}.zip"],
        ["check", "drag.linear"],
    ]


def used(python, wheel, without, place):
    """Install the wheel, use it, and return the errors."""
    own = environment(place / "env", python)
    pip = [str(own), "-m", "pip", "install", "--quiet", "--prefer-binary"]
    begun = perf_counter()
    if without:
        subprocess.run([*pip, *requirements(wheel, without)], check=True)
        pip.append("--no-deps")
    subprocess.run([*pip, str(wheel)], check=True)
    print(f"{python}: installed in {perf_counter() - begun:.0f} s", flush=True)
    away = place / "away"
    away.mkdir()
    (away / "small.toml").write_text(SMALL)
    wrong = []
    for step in steps():
        begun = perf_counter()
        done = subprocess.run(
            [str(own.parent / "simgap"), *step],
            cwd=away,
            capture_output=True,
            text=True,
            check=False,
        )
        mark = "ok" if done.returncode == 0 else f"EXIT {done.returncode}"
        print(f"  {mark:8} {perf_counter() - begun:6.1f} s  {' '.join(step)[:70]}", flush=True)
        if done.returncode:
            wrong.append(" ".join(step))
            print(f"{done.stdout[-400:]}{done.stderr[-1500:]}")
    told = subprocess.run(
        [str(own.parent / "simgap"), "info", "--json"], cwd=away, capture_output=True, check=True
    )
    found = json.loads(told.stdout)
    for each in (*found["engines"], *found["packages"]):
        if each["missing"] and not each.get("of"):
            print(f"  {each['name']}: {each['missing']}")
    return wrong


def main():
    """Build the wheel, check its content, and use it with every Python."""
    reader = argparse.ArgumentParser(description=__doc__)
    reader.add_argument("pythons", nargs="*", metavar="PYTHON", default=[sys.executable])
    reader.add_argument("--without", default="", metavar="A,B")
    options = reader.parse_args()
    without = [name for name in options.without.split(",") if name]
    with TemporaryDirectory() as place:
        wheel = build(Path(place))
        wrong = find_wheel_errors(wheel)
        print(f"{wheel.name}: {wheel.stat().st_size} bytes; {wrong or 'it holds what it should'}")
        for number, python in enumerate(options.pythons):
            folder = Path(place, str(number))
            folder.mkdir()
            wrong += used(python, wheel, without, folder)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
