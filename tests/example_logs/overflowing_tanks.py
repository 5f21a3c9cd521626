"""Make the recording of examples/tanks again: `python -m tests.example_logs.overflowing_tanks`.

The recording shows two tanks, of which the upper one overflows at a low rim; with --clean,
clean.csv is written, in which the rim is out of reach. SciPy's LSODA integrates the tanks from one
change of the voltage to the next, without the project's own code, and stops where the upper level
reaches the rim. At the rim

    h1' = 0    while the inflow exceeds the outflow                                              (1)
"""

import csv
import sys
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

AREA, G = 2.8e-3, 9.81
PUMP, UPPER, LOWER = 3.4e-6, 7.4e-6, 7.8e-6
RIM, NOISE = 0.2, 1e-3
STEP, SAMPLES, HOLD = 4.0, 120, 15  # sampling interval in s; samples; samples per voltage
STARTS = ((0.05, 0.04), (0.1, 0.12), (0.03, 0.06))
RUNS = (
    (5.0, 2.0, 3.5, 5.5, 3.0, 4.5, 1.5, 4.0),
    (4.0, 5.2, 2.5, 3.0, 5.0, 3.5, 2.0, 4.5),
    (3.0, 4.8, 5.5, 2.0, 4.0, 1.5, 5.0, 2.5),
)


def flow(outlet, level):
    """Return the flow through an outlet, m^3/s, by Torricelli's law."""
    return outlet * np.sqrt(2 * G * max(level, 0.0))


def solved(volts, start, rim):
    """Return the levels (SAMPLES, 2) of one run, m."""
    rows, state = [np.array(start)], np.array(start)
    for u in volts:
        times = STEP * np.arange(1, HOLD + 1)
        seen = _held(PUMP * u, state, times, rim)
        rows.extend(seen)
        state = seen[-1]
    return np.array(rows[:SAMPLES])


def _held(inflow, state, times, rim):
    """Return the levels at `times` under a constant inflow."""
    over = inflow > flow(UPPER, rim)

    def rates(_, h):
        full = over and h[0] >= rim  # (1)
        through, away = flow(UPPER, h[0]), flow(LOWER, h[1])
        return [0.0 if full else (inflow - through) / AREA, (through - away) / AREA]

    def meets(_, h):
        return h[0] - rim

    meets.terminal, meets.direction = True, 1.0
    exact = {"method": "LSODA", "rtol": 1e-10, "atol": 1e-12}
    rows, now = [], 0.0
    while now < times[-1]:
        left = times[times > now]
        full = over and state[0] >= rim
        events = None if full else meets
        part = solve_ivp(rates, (now, times[-1]), state, t_eval=left, events=events, **exact)
        rows.extend(part.y.T)
        now = times[-1]
        if part.status == 1:
            now, state = float(part.t_events[0][0]), np.array([rim, part.y_events[0][0][1]])
    return rows


def rows(rim, seed):
    """Iterate over the rows of the table: run, t, volts, upper, lower."""
    rng = np.random.default_rng(seed)
    for run, (volts, start) in enumerate(zip(RUNS, STARTS, strict=True)):
        seen = solved(volts, start, rim) + NOISE * rng.normal(size=(SAMPLES, 2))
        held = np.repeat(volts, HOLD)
        for i, (upper, lower) in enumerate(seen):
            yield run, STEP * i, held[i], f"{upper:.6f}", f"{lower:.6f}"


TOML = f"""system = "tanks"

[channels.upper]
unit = "m"
noise = {NOISE}

[channels.lower]
unit = "m"
noise = {NOISE}

[inputs.volts]
unit = "V"
"""


def write(path, rim=RIM, seed=2):
    """Write the table to `path`, and its description next to it."""
    with open(path, "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["run", "t", "volts", "upper", "lower"])
        table.writerows(rows(rim, seed))
    Path(path).with_suffix(".toml").write_text(TOML)


if __name__ == "__main__":
    clean = "--clean" in sys.argv
    folder = Path(__file__).resolve().parents[2] / "examples" / "tanks"
    write(folder / ("clean.csv" if clean else "overflow.csv"), 1.0 if clean else RIM)
