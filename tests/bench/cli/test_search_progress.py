"""Tests of the progress display of `simgap explain` on a terminal and in a log."""

import fcntl
import io
import os
import pty
import re
import signal
import struct
import sys
import termios
from itertools import pairwise

import pytest

from bench.api.explain import explain
from bench.cli.progress_display import (
    BUDGET_HINT,
    HINT_AFTER,
    LOG_INTERVAL,
    TERMINAL_INTERVAL,
    ProgressDisplay,
    format_clock,
)
from bench.diagnosis.evaluation.search_control import SearchControl
from tests.bench.diagnosis.explained_samples import recording
from tests.command_output import run_command


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self):
        return True

    def screen(self):
        """Return the final lines as a terminal displays them."""
        lines = []
        for line in self.getvalue().split("\n"):
            cells, column = [], 0
            for character in line:
                if character in "\r\b":
                    column = 0 if character == "\r" else column - 1
                    continue
                cells[column : column + 1] = [character]
                column += 1
            lines.append("".join(cells).rstrip())
        return lines


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")


def display(clock, stream=None, **options):
    """Create a display without a timer signal, because that signal depends on real time."""
    return ProgressDisplay(clock=clock, stream=Terminal() if stream is None else stream, **options)


def test_the_line_names_stage_count_best_model_and_times(clock):
    shown = display(clock)
    shown.stage("fitting pairs of effects", 8)
    shown.advance(3)
    shown.found(["friction.coulomb@elbow", "backlash@m_elbow"], 0.974)
    clock.now += 12.0
    shown.completed(0.25)
    assert shown._stream.screen() == [
        "simgap  25% |██░░░░░░░░| 0:12, about 0:36 left; fitting pairs of effects, 3 of 8; "
        "best so far friction.coulomb@elbow + backlash@m_elbow closes 97 % of the gap"
    ]


@pytest.mark.parametrize("columns", [40, 80, 100, 120, 160, 300])
def test_the_line_fits_the_terminal_and_keeps_what_matters_most(clock, columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    shown = display(clock)
    shown.found(["friction.coulomb@elbow"], 1.0)
    shown.stage("fitting pairs of effects", 8)
    clock.now += 15.0
    shown.completed(0.5)
    (line,) = shown._stream.screen()
    assert len(line) < columns
    assert "50% " in line
    assert "about 0:15 left" in line
    assert ("friction.coulomb@elbow" in line) == (columns > 80)
    assert ("closes 100 % of the gap" in line) == (columns > 120)


def test_the_estimate_moves_every_two_seconds_without_any_event(clock):
    progress = display(clock)
    clock.now += 20.0
    progress.completed(0.25)
    assert progress.remaining() == pytest.approx(60.0)
    said = []
    for _ in range(60):
        clock.now += 2.0
        said.append(format_clock(progress.remaining()))
    assert all(one != other for one, other in pairwise(said))
    assert said[4] == "0:50"


def test_a_bar_does_not_go_back(clock):
    progress = display(clock)
    clock.now += 10.0
    progress.completed(0.5)
    clock.now += 10.0
    progress.completed(0.3)
    assert " 50% " in progress.lines()[0]
    assert progress.remaining() == pytest.approx(5.0), "half of the time since the last event"
    progress.completed(0.99)
    assert "|█████████░|" in progress.lines()[0], "full only where all is done"


def test_the_live_line_is_written_at_most_five_times_a_second(clock):
    shown = display(clock)
    shown.stage("testing 38 effects", 1000)
    for _ in range(1000):
        clock.now += 0.001
        shown.advance()
    assert shown._stream.getvalue().count("\r") <= 1 + 1.0 / TERMINAL_INTERVAL


def test_a_log_has_a_line_at_most_every_ten_seconds(clock):
    stream = io.StringIO()
    shown = display(clock, stream)
    shown.stage("fitting the base model")
    for second in range(65):
        clock.now += 1.0
        shown.stage(f"testing {second} effects", 4)
        shown.completed(second / 100)
    lines = stream.getvalue().splitlines()
    assert lines[0] == "simgap: fitting the base model ..."
    assert len([line for line in lines if BUDGET_HINT not in line]) == 1 + 65 // LOG_INTERVAL
    assert re.fullmatch(
        r"simgap: testing 29 effects, 0 of 4; 0:30, about \d:\d\d left \.\.\.", lines[4]
    )
    assert "\r" not in stream.getvalue()


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_the_hint_at_a_budget_comes_once_and_only_without_one(clock, stream):
    for budget, hints in ((None, 1), (60.0, 0)):
        shown = display(clock, stream(), budget=budget)
        for _ in range(100):
            shown.stage("testing 38 effects")
            clock.now += 1.0
        assert shown._stream.getvalue().count(BUDGET_HINT) == hints
    early = display(clock, stream())
    clock.now += HINT_AFTER - 1.0
    early.stage("testing 38 effects")
    assert BUDGET_HINT not in early._stream.getvalue()


def test_a_budget_is_counted_down(clock):
    shown = display(clock, budget=60.0)
    clock.now += 22.0
    shown.stage("testing 38 effects")
    assert "0:22, at most 0:38 left" in shown._stream.screen()[-1]
    clock.now += 39.0
    shown.stage("measuring the gain")
    assert "1:01, budget used up" in shown._stream.screen()[-1]


def test_lines_that_stay_stand_above_and_the_end_is_clean(clock):
    with display(clock) as shown:
        shown.stage("fitting the base model")
        shown.note("frozen, as the recording cannot fix it: damping@elbow")
        assert shown._stream.screen()[-1].endswith("fitting the base model")
    assert shown._stream.screen() == [
        "simgap: frozen, as the recording cannot fix it: damping@elbow", ""
    ]  # fmt: skip
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_an_interrupt_while_the_line_is_written_leaves_a_clean_terminal(clock):
    class Interrupted(Terminal):
        def flush(self):
            if "testing" in self.getvalue() and not self.getvalue().endswith(" \r"):
                raise KeyboardInterrupt

    stream = Interrupted()
    with display(clock, stream) as shown:
        shown.stage("fitting the base model")
        clock.now += 1.0
        with pytest.raises(KeyboardInterrupt):
            shown.stage("testing 38 effects")
    assert stream.screen() == [""]


def test_a_closed_stderr_does_not_end_the_search(clock):
    class Broken(Terminal):
        def write(self, _):
            raise BrokenPipeError

    with display(clock, Broken()) as shown:
        shown.stage("fitting the base model")
        clock.now += 1.0
        shown.found(["drag.linear"], 1.0)


def test_nothing_is_shown_where_a_program_asks(clock):
    with display(clock, silent=True) as shown:
        shown.stage("fitting the base model")
        shown.note("something")
        clock.now += 60.0
        shown.completed(0.5)
    assert shown._stream.getvalue() == ""


class Events:
    """Listener that records all events."""

    def __init__(self):
        self.stages, self.finished, self.best, self.shares = [], [], [], []

    def stage(self, name, total=None):
        self.stages.append((name, total))
        self.finished.append(0)

    def advance(self, count=1):
        self.finished[-1] += count

    def found(self, effects, share):
        self.best.append((tuple(effects), share))

    def completed(self, share):
        self.shares.append(share)


def test_a_search_reports_its_stages_their_steps_and_the_best_model():
    swing = recording(
        effects=["drag.linear=1e-3"], noise=["q=0.003", "qd=0.02"], runs=3, seconds=1.0, rate=60.0
    )
    heard = Events()
    explain(swing, listener=heard, jobs=1)
    names = [name for name, _ in heard.stages]
    assert names[0] == "fitting the base model"
    tested = next(i for i, name in enumerate(names) if re.fullmatch(r"testing \d+ effects", name))
    assert tested < names.index("fitting single effects")
    held_out = next(i for i, name in enumerate(names) if "held-out runs with" in name)
    assert names.index("fitting single effects") < held_out
    assert heard.stages[held_out][1] == 4, "the held-out runs are fitted over four shares of them"
    assert names[-1] == "measuring the gain"
    for (name, total), finished in zip(heard.stages, heard.finished, strict=True):
        if total is not None:
            assert finished == total, name
    effects, share = heard.best[-1]
    assert effects == ("drag.linear",)
    assert share > 0.95
    assert 0.9 < max(heard.shares) <= 1.0


def test_a_watch_without_a_listener_is_silent():
    watch = SearchControl()
    watch.begin_stage("testing 38 effects", 1)
    watch.advance()
    watch.report_best_model(["drag.linear"], 1.0)


def terminal_output(command, columns=120, interrupt_at=None):
    """Run a command in a pseudo-terminal and return its output and exit code.

    Args:
        command: command line as a list of words.
        columns: width of the terminal.
        interrupt_at: text after whose first appearance Ctrl-C is pressed once.
    """
    child, terminal = pty.fork()
    if not child:
        os.execvp(command[0], command)
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    written = b""
    while True:
        try:
            part = os.read(terminal, 65536)
        except OSError:
            break
        if not part:
            break
        written += part
        if interrupt_at is not None and interrupt_at.encode() in written:
            os.write(terminal, b"\x03")
            interrupt_at = None
    os.close(terminal)
    return written.decode(), os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.fixture
def command(tmp_path):
    """Return the command line that explains a small recording."""
    log = str(tmp_path / "swing.csv")
    noise = ["--noise", "q=0.003", "qd=0.02"]
    make = ["simulate", "pendulum", "--effect", "drag.linear=1e-3", *noise]
    run_command(*make, "--runs", "3", "--seconds", "3", "--rate", "60", "--out", log)
    return [sys.executable, "-m", "bench.cli.main", "explain", log, "--out", str(tmp_path / "out")]


@pytest.mark.slow
def test_explain_shows_a_live_line_on_a_terminal_and_erases_it(command):
    written, code = terminal_output(command)
    assert code == 0, written
    shown, _, account = written.partition("pendulum, simulated")
    lines = [line.strip("\b ") for line in shown.split("\r")]
    assert len({line for line in lines if line}) >= 4
    assert any("fitting the base model" in line for line in lines)
    assert any("drawing the figures" in line for line in lines)
    assert max(len(line) for line in lines) < 120
    # The progress line is overwritten with spaces before anything else is printed.
    assert re.search(r"\r +\r$", shown)
    assert "\r " not in account


@pytest.mark.slow
def test_ctrl_c_on_a_terminal_leaves_whole_lines(command):
    written, code = terminal_output(command, interrupt_at="fitting the base model")
    assert code == 130, written
    terminal = Terminal()
    terminal.write(written.replace("\r\n", "\n"))
    screen = terminal.screen()
    assert screen[0] == "simgap: stopping with the results so far; Ctrl-C again stops at once"
    assert screen[1] == "pendulum, simulated"
    assert "The search was stopped by an interrupt" in " ".join(screen)
