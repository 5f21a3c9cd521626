"""Show progress on stderr: bars of counted steps, and the live line of a search."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

_TERMINAL_REFRESH_SECONDS = 0.2
"""Minimum time between two updates of a bar on a terminal, in seconds."""
_LOG_REFRESH_SECONDS = 30.0
"""Minimum time between two lines in a log, in seconds."""


class ProgressBars:
    """Progress bars, one after another; tqdm estimates the remaining time.

    Args:
        unit: What is counted.
    """

    def __init__(self, unit: str = "run") -> None:
        self._unit = unit
        self._close: Callable[[], None] = lambda: None

    def __enter__(self) -> ProgressBars:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def start_bar(self, title: str, total: int) -> Callable[[], None]:
        """Begin a bar that replaces the previous one.

        Args:
            title: Text in front of the bar.
            total: Number of steps.

        Returns:
            Function that advances the bar by one step.
        """
        from tqdm import tqdm

        self._close()
        bar = tqdm(
            total=total,
            desc=title,
            unit=self._unit,
            file=sys.stderr,
            dynamic_ncols=True,
            mininterval=_TERMINAL_REFRESH_SECONDS if sys.stderr.isatty() else _LOG_REFRESH_SECONDS,
        )
        self._close = bar.close

        def step() -> None:
            bar.update()

        return step


TERMINAL_INTERVAL = 0.2
"""Minimum time between two updates of the live line, in seconds."""
LOG_INTERVAL = 10.0
"""Minimum time between two lines if stderr is not a terminal, in seconds."""
UPDATE_INTERVAL = 0.5
"""Interval of the timer that updates the display between two events, in seconds."""
HINT_AFTER = 20.0
"""Elapsed time after which `BUDGET_HINT` is printed, in seconds."""
BUDGET_HINT = "add --budget 60 to stop after a minute with the best result so far"
MIN_SHARE_FOR_ESTIMATE = 0.02
"""Minimum share of the search that must be done before the remaining time is estimated."""
MIN_REMAINING_RATIO = 0.5
"""Minimum ratio of the estimated remaining time to the time since the last event."""
BAR_WIDTH = 10
"""Width of the bar, in characters."""


class ProgressDisplay:
    """Context that shows a search's progress on stderr: a `ProgressListener`.

    On a terminal it keeps one live line, which it erases at the end. Elsewhere it prints a line at
    most every `LOG_INTERVAL` seconds. Events only store values and read the clock, so that the
    search is not slowed down. A timer signal redraws between events instead of a thread, because a
    process with threads cannot fork workers safely.
    """

    def __init__(
        self,
        budget: float | None = None,
        *,
        silent: bool = False,
        hint: bool = True,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin with nothing done and no model found; nothing is shown before the first event.

        `_share` is the share of the search that is done, `_best` the effects of the best model so
        far and the percentage of the gap that it closes, both as text. `_shown` is the live line
        now on the terminal, `_shown_at` the time of the last output, and `_waiting` has permanent
        lines that are still to be printed.

        Args:
            budget: Seconds after which the search ends; None without such a limit.
            silent: Whether to show nothing.
            hint: Whether to print `BUDGET_HINT` in a long search without a budget.
            stream: Output stream; stderr if None.
            clock: Returns the time in seconds.
        """
        self._clock = clock
        self._budget = budget
        self._started = clock()
        self._name = ""
        self._total: int | None = None
        self._done = 0
        self._best: tuple[str, str] | None = None
        self._share = 0.0
        self._is_searching = True
        # The remaining time as estimated when the share last increased, and the time of that
        # estimate.
        self._estimate: float | None = None
        self._estimated_at = self._started
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._silent = silent
        self._hints = hint and budget is None
        self._interval = TERMINAL_INTERVAL if self._live else LOG_INTERVAL
        self._shown_at: float | None = None
        self._shown = ""
        # A signal may arrive while a line is written; its own output waits until that is done.
        self._busy = False
        self._waiting: list[str] = []
        self._has_timer = False
        self._is_stop_requested = False

    def __enter__(self) -> ProgressDisplay:
        """Start the timer that redraws the live line, where signals can be used.

        The timer is a signal, because the search itself may not return to Python for seconds.
        """
        if not self._silent and _can_use_timer():
            signal.signal(signal.SIGALRM, lambda *_: self._redraw_if_due())
            # System calls of libraries continue after the signal.
            signal.siginterrupt(signal.SIGALRM, False)
            signal.setitimer(signal.ITIMER_REAL, UPDATE_INTERVAL, UPDATE_INTERVAL)
            self._has_timer = True
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the timer, erase the live line, print what is waiting, and show nothing any more.

        The original handler of the signal is restored.
        """
        if self._has_timer:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
        # An exception may have occurred while a line was written.
        self._busy = False
        with self._block_timer_writes():
            self._write_live_line("")
            self._print_waiting()
        self._silent = True

    def note(self, text: str) -> None:
        """Print a permanent line: above the live line on a terminal."""
        if self._silent:
            return
        self._waiting.append(text)
        if not self._busy:
            with self._block_timer_writes():
                self._draw_lines()

    @contextmanager
    def handle_interrupts(self) -> Iterator[dict[str, Any]]:
        """Let the first Ctrl-C request a stop of the search; the second one interrupts as usual.

        Returns:
            Context that gives the arguments with which a search reports to this display: `say`,
            `stop` and `listener`.
        """
        # Python handles signals in the main thread only. SIGINT stays ignored if it is ignored, as
        # for background jobs of a shell.
        is_main = threading.current_thread() is threading.main_thread()
        if is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._request_stop)
        try:
            yield {"say": self.note, "stop": lambda: self._is_stop_requested, "listener": self}
        finally:
            if is_main and signal.getsignal(signal.SIGINT) == self._request_stop:
                signal.signal(signal.SIGINT, signal.default_int_handler)

    def _request_stop(self, *_: object) -> None:
        self._is_stop_requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.note("stopping with the results so far; Ctrl-C again stops at once")

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Erase the live line while something else is printed on the terminal."""
        with self._block_timer_writes():
            self._write_live_line("")
        self._busy = True
        try:
            yield
        finally:
            self._busy = False

    def _redraw_if_due(self) -> None:
        """Show the state, unless that was done less than an interval ago.

        On a terminal, the live line is drawn again; elsewhere, a new line is written. Once, after
        `HINT_AFTER` seconds of search, a hint about time limits is added.
        """
        if self._silent or self._busy or not self._name:
            return
        current_time = self._clock()
        if self._shown_at is not None and current_time - self._shown_at < self._interval:
            return
        with self._block_timer_writes():
            if self._hints and self.elapsed() >= HINT_AFTER and self._is_searching:
                self._hints = False
                self._waiting.append(BUDGET_HINT)
            self._shown_at = current_time
            if self._live:
                self._draw_lines()
            else:
                self._print_waiting()
                self._stream.write(f"simgap: {self.report()} ...\n")
                self._stream.flush()

    @contextmanager
    def _block_timer_writes(self) -> Iterator[None]:
        """Mark the time in which stderr is written, so that the timer signal does not write too."""
        self._busy = True
        try:
            yield
        except (OSError, ValueError):
            # stderr is closed or no longer read; the search continues without display.
            self._silent = True
        finally:
            self._busy = False

    def _draw_lines(self) -> None:
        """Write the waiting lines, then the live line on a terminal.

        The short form of the line is used if the long one does not fit into the terminal.
        """
        if self._waiting:
            # Permanent lines take the place of the live line, which follows below them.
            self._write_live_line("")
            self._print_waiting()
        if self._live and self._name:
            from tqdm.utils import disp_len, disp_trim

            columns = _get_terminal_width(self._stream) - 1
            long, short = self.lines()
            self._write_live_line(long if disp_len(long) <= columns else disp_trim(short, columns))

    def _print_waiting(self) -> None:
        while self._waiting:
            self._stream.write(f"simgap: {self._waiting.pop(0)}\n")
            self._stream.flush()

    def _write_live_line(self, line: str) -> None:
        """Replace the live line; an empty one erases it.

        Two more characters are overwritten, because a terminal echoes ^C at the end of the line.
        """
        if line or self._shown:
            from tqdm.utils import disp_len

            width = min(disp_len(self._shown) + 2, _get_terminal_width(self._stream) - 1)
            padding = max(width - disp_len(line), 0)
            # The cursor returns to the end of the new line.
            end = "\b" * padding if line else "\r"
            self._stream.write("\r" + line + " " * padding + end)
            self._stream.flush()
            self._shown = line

    def stage(self, name: str, total: int | None = None) -> None:
        """Show that a stage of the search begins, with a count of its steps.

        Args:
            name: name of the stage.
            total: number of its steps; None if it is unknown.
        """
        self._name, self._total, self._done = name, total, 0
        self._redraw_if_due()

    def advance(self, count: int = 1) -> None:
        """Finish steps of the stage; see `ProgressListener`."""
        self._done += count
        self._redraw_if_due()

    def found(self, effects: Sequence[str], share: float) -> None:
        """Show the best model so far.

        Args:
            effects: names of the effects of the model.
            share: share of the discrepancy that they explain, from 0 to 1.
        """
        # A share below 1 must not be shown as 100 %.
        percent = "over 99" if 0.99 < share < 1.0 else f"{100.0 * share:.0f}"
        self._best = " + ".join(effects), percent
        self._redraw_if_due()

    def completed(self, share: float) -> None:
        """Estimate the remaining time from the share of the search that is done.

        The remaining time is the elapsed time multiplied by (1 - share) / share.

        Args:
            share: Share of the work that is done, 0 to 1.
        """
        # A model with more effects makes the share smaller, but a bar must not go back.
        if share > self._share:
            self._share = min(share, 1.0)
            self._estimated_at = self._clock()
            if self._share >= MIN_SHARE_FOR_ESTIMATE:
                self._estimate = self.elapsed() * (1.0 - self._share) / self._share
        self._redraw_if_due()

    def elapsed(self) -> float:
        """Return the seconds since the search began."""
        return self._clock() - self._started

    def remaining(self) -> float | None:
        """Return the estimated remaining seconds; None if unknown or if the search has ended.

        The estimate assumes the mean speed so far. Between two events it counts down; if the next
        event is overdue, it grows with the time since the last one.
        """
        if self._estimate is None or not self._is_searching:
            return None
        estimate_age = self._clock() - self._estimated_at
        return max(self._estimate - estimate_age, MIN_REMAINING_RATIO * estimate_age)

    def finish(self, name: str) -> None:
        """End the search and begin a stage that follows it, such as drawing figures."""
        self._is_searching = False
        self.stage(name)

    def lines(self) -> tuple[str, str]:
        """Return the state of the search as one line, in a long form and in a short one."""
        percent, bar = f"{100 * self._share:3.0f}% ", ""
        if self._is_searching:
            empty, full = _choose_bar_characters(self._stream)
            # Rounded down: a full bar means that everything is done.
            filled_width = int(BAR_WIDTH * self._share)
            bar = f"|{full * filled_width}{empty * (BAR_WIDTH - filled_width)}| "
        else:
            # The share refers to the search, which may have ended early.
            percent = ""
        times, stage = self._format_times(), self._format_stage()
        long = self._join_parts(times, stage, self._format_best_so_far())
        short = self._join_parts(times, stage, self._format_best_so_far("best {1} % {0}"))
        return f"simgap {percent}{bar}{long}", f"{percent}{short}"

    def report(self) -> str:
        """Return the state as a line of a log."""
        times = self._format_times() if self.elapsed() >= 1.0 else ""
        return self._join_parts(self._format_stage(), self._format_best_so_far(), times)

    @staticmethod
    def _join_parts(*parts: str) -> str:
        return "; ".join(part for part in parts if part)

    def _format_best_so_far(self, form: str = "best so far {0} closes {1} % of the gap") -> str:
        return form.format(*self._best) if self._best is not None else ""

    def _format_stage(self) -> str:
        if self._total is None or self._total < 2:
            return self._name
        return f"{self._name}, {min(self._done, self._total)} of {self._total}"

    def _format_times(self) -> str:
        """Format the elapsed time, and the remaining time while the search is running.

        With a time budget the remaining time is an upper limit; otherwise it is an estimate, or
        missing.
        """
        elapsed = format_clock(self.elapsed())
        if not self._is_searching:
            return elapsed
        if self._budget is not None:
            remaining_seconds = self._budget - self.elapsed()
            remaining_text = (
                f"at most {format_clock(remaining_seconds)} left"
                if remaining_seconds > 0
                else "budget used up, finishing this step"
            )
            return f"{elapsed}, {remaining_text}"
        remaining = self.remaining()
        return elapsed if remaining is None else f"{elapsed}, about {format_clock(remaining)} left"


def format_clock(seconds: float) -> str:
    """Return a duration as ``0:07`` or ``1:02:03``."""
    minutes, seconds_part = divmod(round(max(seconds, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds_part:02}" if hours else f"{minutes}:{seconds_part:02}"


def _can_use_timer() -> bool:
    """Return whether this process has a timer signal that nothing else uses."""
    is_main = threading.current_thread() is threading.main_thread()
    has_timer = hasattr(signal, "setitimer") and hasattr(signal, "SIGALRM")
    return is_main and has_timer and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL


def _get_terminal_width(stream: Any) -> int:
    """Return the width of a terminal in columns."""
    try:
        columns = os.get_terminal_size(stream.fileno()).columns
    except (OSError, ValueError, AttributeError):
        columns = 0
    return columns or shutil.get_terminal_size().columns


def _choose_bar_characters(stream: Any) -> tuple[str, str]:
    """Return the bar's characters for the open part and the done part, in the stream's encoding."""
    try:
        "█░".encode(getattr(stream, "encoding", None) or "ascii")
    except (UnicodeEncodeError, LookupError):
        return "-", "#"
    return "░", "█"
