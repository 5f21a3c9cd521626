"""Hypothesis strategies for malformed inputs of every kind."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.bench.logs.log_writers import NEEDED, OPTIONS, WRITERS
from tests.malformed_input import valid_input
from tests.malformed_input.corruption import bytes_of, corrupted, documents, tables
from tests.malformed_input.malformed_arguments import vectors
from tests.malformed_input.malformed_case import Case

SHARES = {
    "experiments": 2400, "plugins": 800, "folders": 2000, "recordings": 2000, "models": 700,
    "weights": 300, "films": 100, "arguments": 1700, "logs": 2000,
}  # fmt: skip
"""Number of cases of each kind; 12,000 in total."""
PLUGIN_LINES = [
    "from methods.tuner import Tuner", "import numpy as np", "class Good(Tuner):\n    pass",
    "class Random(Tuner): pass", "class Odd(Tuner):\n    name = 3",
    "class Odd(Tuner):\n    name = 'a b'", "class Odd(Tuner):\n    name = ''",
    "class Odd(Tuner):\n    requires = 5", "raise ValueError('a\\nb')", "raise SystemExit(3)",
    "1/0", "def f(:", "\tx = 1", "import no_such_thing",
    "from sims.core.simulator import Simulator", "assert False", "x = (",
    "class S(Simulator):\n    name = 's'",
    "class S(Simulator):\n    def simulate(self, a, b): pass",
    "from sims.core.system import Effect", "class E(Effect):\n    name = 'drag.linear'",
    "class E(Effect): pass",
    "def recurse(): recurse()\nrecurse()", "exit()", "class Odd(Tuner, metaclass=5): pass",
    "'\\ud800'", "# \x00", "raise KeyboardInterrupt", "raise BaseException('x' * 5000)",
    "class Own(Tuner):\n    name = 'own'\n    def tune(self, task, rng): yield task.start",
    "class Own(Tuner):\n    name = 'x' * 5000\n    def tune(self, task, rng): yield task.start",
    "class Own(Tuner):\n    name = 'own\\n'\n    def tune(self, task, rng): yield task.start",
    "class Own(Tuner):\n    name = 'own'\n    learned = 'x'\n    stochastic = 7",
    "class Own(Tuner):\n    name = 'own'\n    def __init__(self): raise OSError('a\\nb')",
    "raise type('E', (Exception,), {'__str__': lambda s: 1 / 0})()", "print('a\\x1b[31m')",
    "from sims.core.simulator import Channel, Parameter", "Channel('x', 3)",
    "Parameter(1, 2, 3, 4, 5)",
]  # fmt: skip
"""Pieces of plugin files."""


@st.composite
def experiments(draw):
    whole = draw(st.sampled_from([valid_input.SWING, valid_input.WORLDLY]))
    data = draw(documents(whole, valid_input.MORE))
    more = draw(st.sampled_from([
        ["--jobs", "0"], ["--jobs", "0", "--salt", "s"], ["--trust"], ["--targets", "1"], [],
    ]))  # fmt: skip
    return Case(("compare", "spoilt.toml", "--out", "out", *more), {"spoilt.toml": data},
                owns=("out",))  # fmt: skip


@st.composite
def plugins(draw):
    pieces = draw(st.lists(st.sampled_from(PLUGIN_LINES), max_size=5))
    text = "\n".join(pieces).encode("utf-8", "surrogatepass")
    if draw(st.integers(0, 5)) == 0:
        text += draw(st.binary(max_size=30))
    command = draw(st.sampled_from([
        *[("list", "tuners")] * 6, ("list", "systems"), ("list", "effects"), ("list", "simulators"),
        ("check", "own"), ("check", "s"), ("inspect", "data.csv"), ("compare", "swing.toml"),
        ("compare", "swing.toml", "--tuners", "own"), ("compare", "swing.toml", "--jobs", "0"),
        ("score", "extended.toml", "data.csv"),
    ]))  # fmt: skip
    files = {"plugin.py": text, "swing.toml": valid_input.toml(valid_input.SWING),
             **valid_input.recorded("pendulum"),
             "extended.toml": valid_input.toml(valid_input.model())}  # fmt: skip
    name = draw(
        st.sampled_from(["plugin.py", "plugin.py", "plugin.py", "none.py", ".", "data.csv"])
    )
    out = ("--out", "out") if command[0] in ("compare", "inspect") else ()
    return Case((*command, *out, "--plugin", name), files, owns=("out",))


def files_of(base: Path) -> list[str]:
    found = [path for path in base.rglob("*") if path.is_file() and path.suffix != ".lock"]
    return sorted(str(path.relative_to(base)) for path in found)


@st.composite
def folders(draw, bases):
    base = draw(st.sampled_from(["done", "done", "public", "half"]))
    name = draw(st.sampled_from(files_of(bases[base])))
    held = (bases[base] / name).read_bytes()
    how = draw(st.sampled_from(["gone", "bytes", "bytes", "meaning", "meaning", "meaning"]))
    if how == "gone":
        data = None
    elif how == "bytes" or not name.endswith((".toml", ".csv")):
        data = draw(bytes_of(held))
    elif name.endswith(".csv"):
        data = draw(tables(held))
    else:
        data = draw(documents(_parsed(held), valid_input.MORE))
    command = draw(st.sampled_from([
        ("status", "run"), ("status", "run", "--runs"), ("plot", "run"), ("plot", "run"),
        ("compare", "--resume", "run"), ("compare", "--resume", "run", "--jobs", "0"),
        ("plot", "run", "run", "--out", "both"), ("verify", "run"),
    ]))  # fmt: skip
    return Case(command, {f"run/{name}": data}, base, owns=("run", "both"))


def _parsed(data):
    import sys

    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    return tomllib.loads(data.decode())


@st.composite
def recordings(draw):
    system = draw(st.sampled_from(["pendulum", "pendulum", "ball"]))
    files = dict(valid_input.recorded(system))
    if draw(st.booleans()):
        files["data.csv"] = draw(tables(files["data.csv"]))
    else:
        files["data.toml"] = draw(documents(_parsed(files["data.toml"]), RECORDED))
    files["extended.toml"] = valid_input.toml(valid_input.model())
    command = draw(st.sampled_from([
        ("inspect", "data.csv", "--out", "out"), ("inspect", "data.csv", "--out", "out"),
        ("explain", "data.csv", "--out", "out"), ("explain", "data.csv", "--force", "--out", "out"),
        ("score", "extended.toml", "data.csv"), ("score", "extended.toml", "data.csv", "--json"),
        ("film", "data.csv", "--out", "film.mp4", "--size", "32"),
        ("datasheet", "data.csv", "--out", "out"), ("design", "data.csv", "--out", "out"),
        ("inspect", "data.csv", "--system", "slider", "--out", "out"),
    ]))  # fmt: skip
    return Case(command, files, owns=("out", "film"), numbers=command[0] in ("score", "inspect"))


@st.composite
def logs(draw):
    """Draw a corrupted log of any format, or a corrupted description of one."""
    if draw(st.integers(0, 3)):
        return draw(log_folders(draw(st.sampled_from(list(LOG_FORMATS)))))
    files = {"arm.xml": valid_input.ARM, "log.csv": valid_input.MAPPED_LOG}
    files["mapped.toml"] = draw(documents(valid_input.MAPPED, MAPPED))
    if draw(st.booleans()):
        files["log.csv"] = draw(tables(files["log.csv"]))
    return Case(("inspect", "mapped.toml", "--out", "out"), files, owns=("out",))


@st.composite
def log_folders(draw, kind):
    """Draw logs of a format, of which one file is damaged, and the command that imports them."""
    files = dict(valid_input.log_folder(kind))
    name = draw(st.sampled_from([name for name in files if name.startswith("logs/")]))
    files[name] = draw(tables(files[name]) if name.endswith(".csv") else bytes_of(files[name]))
    # A file that is named must be readable; of a folder, it may be left out.
    given = name if name.count("/") == 1 else "logs"
    command = ("import", given, "--model", "arm.xml", "--out", "made.toml", *OPTIONS.get(kind, ()))
    return Case(command, files, owns=("made.toml",))


LOG_FORMATS = [kind for kind in WRITERS if find_spec(NEEDED.get(kind, "numpy"))]
"""Log formats that can be written with the installed packages."""
MAPPED = ("free", "time", "file", "column", "unit", "offset", "hold", "folder", "model", "engine",
          "actuators", "oops")  # fmt: skip
RECORDED = ("constants", "noise", "inputs", "initial", "runs", "extra", "parameters", "effects",
            "held_out", "units", "system", "oops")  # fmt: skip


@st.composite
def models(draw):
    data = draw(documents(valid_input.model(), ("constants", "effects", "parameters", "oops")))
    command = draw(st.sampled_from([
        ("score", "extended.toml", "data.csv"), ("score", "extended.toml", "data.csv", "--json"),
        ("list", "simulators", "--plugin", "extended.toml"),
        ("compare", "swing.toml", "--plugin", "extended.toml", "--jobs", "0", "--out", "out"),
        ("inspect", "data.csv", "--plugin", "extended.toml", "--out", "out"),
    ]))  # fmt: skip
    document = {**valid_input.SWING, "simulator": valid_input.model()["name"]}
    files = {**valid_input.recorded("pendulum"), "extended.toml": data,
             "swing.toml": valid_input.toml(document)}  # fmt: skip
    return Case(command, files, owns=("out",), numbers=command[0] == "score")


@st.composite
def weights(draw, bases):
    (name,) = files_of(bases["weights"])
    data = draw(bytes_of((bases["weights"] / name).read_bytes()))
    files = {f"run/{name}": data, "learned.toml": valid_input.toml(valid_input.LEARNED)}
    return Case(
        tuple(valid_input.trains("learned.toml", "out")), files, "weights", owns=("out", "run")
    )


@st.composite
def films(draw, bases):
    files = {}
    for name in ("drop.mp4", "drop.camera.toml"):
        held = (bases["film"] / name).read_bytes()
        if name == "drop.mp4":
            spoil = bytes_of(held)
        else:
            spoil = st.one_of(documents(_parsed(held)), corrupted(held, 2))
        if draw(st.booleans()):
            files[f"run/{name}"] = draw(spoil)
    more = draw(st.sampled_from([[], ["--scale", "camera"], ["--scale", "fall"], ["--fps", "1e9"],
                                 ["--fps", "nan"], ["--ball-diameter", "1e-9"],
                                 ["--ball-diameter", "0.1"]]))  # fmt: skip
    return Case(("track", "run/drop.mp4", "--out", "track.csv", *more), files, "film",
                owns=("track",))  # fmt: skip


def files_of_arguments():
    """Return the files in the folder of a command with malformed arguments."""
    return {
        "swing.toml": valid_input.toml(valid_input.SECRET),
        "learner.py": valid_input.LEARNER.read_bytes(),
        "spring.py": valid_input.SPRING.read_bytes(),
        "extended.toml": valid_input.toml(valid_input.model()),
        **valid_input.recorded("pendulum"),
        **{f"ball{Path(name).suffix}": data for name, data in valid_input.recorded("ball").items()},
    }


def arguments():
    files = files_of_arguments()
    # A command that succeeds may write to any path in its arguments.
    return vectors().map(lambda words: Case(tuple(words), files, "done", owns=("",)))


def strategies(bases):
    """Return the strategy for the cases of each kind."""
    return {
        "experiments": experiments(),
        "plugins": plugins(),
        "folders": folders(bases),
        "recordings": recordings(),
        "logs": logs(),
        "models": models(),
        "weights": weights(bases),
        "films": films(bases),
        "arguments": arguments(),
    }


def run_cases(strategy, count, act):
    """Run `act` on a number of cases, which are the same in every run."""
    checks = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example]
    whole = settings(
        max_examples=count, deadline=None, derandomize=True, database=None,
        suppress_health_check=checks,
    )  # fmt: skip
    whole(given(strategy)(lambda case: act(case)))()


def share(kind: str, of: int | None = None) -> int:
    """Return the number of cases of a kind, for a total of `of`, $MALFORMED or 600 (as in CI)."""
    total = of or int(os.environ.get("MALFORMED", "600"))
    return max(SHARES[kind] * total // sum(SHARES.values()), 1)
