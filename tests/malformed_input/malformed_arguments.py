"""Draw argument vectors of all commands with one to three errors."""

from __future__ import annotations

from hypothesis import strategies as st

VECTORS = (
    "compare swing.toml --out out --jobs 0 --salt secret --isolation run",
    "compare swing.toml --out out --trust --force --targets 1 --seeds 1 --budget 2",
    "compare swing.toml --tuners random,cma --timeout 5 --memory 500 --out out",
    "compare --resume run --jobs 0", "compare swing.toml --cluster tcp://127.0.0.1:1 --out out",
    "compare ball-drop --targets 1 --seeds 1 --tuners random --jobs 0 --out out",
    "status run --runs", "plot run", "plot run run --out both", "verify run",
    "list tuners", "list experiments --plugin spring.py", "list simulators --plugin extended.toml",
    "check random", "check spring --plugin spring.py", "check drag.linear",
    "simulate pendulum --runs 1 --seconds 1 --rate 20 --noise 0.01 --seed 3 --out new.csv",
    "simulate pendulum --theta inertia=0.005 --effect drag.linear=1e-3 --initial q=0.5:1 --runs 2 "
    "--seconds 1 --out new.csv",
    "simulate slider --input u=sine:1:2 --observe x --runs 1 --seconds 1 "
    "--engine batch --held-out 0 --out new.csv",
    "simulate ball --theta 0.5 --constant gravity=9 --initial z=1 --seconds 1 --rate 20 --force "
    "--out new.csv",
    "inspect data.csv --system pendulum --out out", "inspect ball.csv --out out",
    "explain data.csv --out out --engine batch --seed 1 --free gravity --tuner random --force",
    "datasheet data.csv --name servo --out out", "design data.csv --seconds 1 --out new.csv",
    "score extended.toml data.csv --json --held-out", "score extended.toml data.csv --force",
    "film ball.csv --out new.mp4 --run 1 --size 32 --camera-seed 1 --force",
    "track none.mp4 --out new.csv --ball-diameter 0.1 --fps 30 --scale fall",
    "train learner pendulum --experiment swing.toml --budget 5 --seeds 1 --out out "
    "--plugin learner.py --trust",
    "download", "download so101 --from run --out out", "download all --from none",
    "--version", "--help", "compare --help",
)  # fmt: skip
WORDS = st.sampled_from([
    "", " ", "-", "--", "-1", "0", "1", "2", "1e400", "-1e400", "nan", "inf", "-inf", "9" * 40,
    "9" * 5000, "0x10", "1_0", "１２", "½", "1e-320", "1e18", "x" * 5000,
    "é", "\u202eabc", "\x1b[31m",
    "a\nb", "\u2028", "\udcff", "..", ".", "swing.toml", "data.csv", "data.toml", "run", "none",
    "none/none.csv", "data.csv/x", "/dev/null", "/dev/full", "/proc/1/x", "x=", "=1", "q=1", "q=x",
    "q=1:0", "q=nan", "q=1e400", "q=1,2", "public", "secret", "random", "learner", "ball-drop",
    "pendulum", "mujoco", "nothing", "tuner", "run,run", ",", "a,b", "sine:1", "sine:1:1e9",
    "steps:1:1e-9", "chirp:1:2", "u=sine:nan:1", "u=square:1:0", "drag.linear=nan",
    "drag.linear=1,2,3", "drag.linear=-1", "length=0", "length=-1", "length=1e300", "gravity=1e6",
    "0.001", "1e6", "new.csv", "out", "100", "19", "camera",
])  # fmt: skip
OPTIONS = st.sampled_from([
    "--salt", "--isolation", "--trust", "--force", "--resume", "--jobs", "--out", "--plugin",
    "--targets", "--seeds", "--budget", "--training-budget", "--timeout", "--memory", "--tuners",
    "--allow-failures", "--runs", "--theta", "--effect", "--constant", "--noise", "--input",
    "--initial", "--observe", "--seconds", "--rate", "--engine", "--seed", "--held-out", "--system",
    "--free", "--tuner", "--json", "--run", "--size", "--camera-seed", "--fps", "--scale",
    "--experiment", "--again", "--oops", "--sal", "-o", "--salt=", "--out=", "--jobs=x",
    "--every", "--help",
])  # fmt: skip


@st.composite
def vectors(draw):
    """Draw an argument vector."""
    words = draw(st.sampled_from(VECTORS)).split()
    for _ in range(draw(st.integers(1, 3))):
        act, place = draw(st.integers(0, 6)), draw(st.integers(0, max(len(words) - 1, 0)))
        if act == 0 and words:
            del words[place]
        elif act == 1 and words:
            words.insert(draw(st.integers(0, len(words))), words[place])
        elif act in (2, 3) and words:
            # In half of the cases the name of the command is protected.
            words[max(place, draw(st.integers(0, 1)) and min(1, len(words) - 1))] = draw(WORDS)
        elif act == 4:
            words[place + 1 : place + 1] = [draw(OPTIONS), draw(WORDS)]
        elif act == 5:
            words.insert(place + 1, draw(OPTIONS))
        else:
            words.insert(place + 1, draw(WORDS))
    return words
