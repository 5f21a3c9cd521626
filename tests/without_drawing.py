"""Run simgap without figures and pages, which have their own tests."""

import sys
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
_CODE = f"""
import sys
sys.path.append({str(ROOT)!r})
from tests.without_drawing import undrawn
from bench.cli.main import main
with undrawn():
    sys.exit(main())
"""
COMMAND = [sys.executable, "-c", _CODE]
"""Command line of `simgap` in a separate process, independent of the working directory."""


@contextmanager
def undrawn():
    """Make comparisons in this process draw nothing within the block."""
    from bench.benchmark import comparison_report

    before = comparison_report._render_figures, comparison_report.render_page
    comparison_report._render_figures, comparison_report.render_page = lambda *_: {}, lambda _: ""
    try:
        yield
    finally:
        comparison_report._render_figures, comparison_report.render_page = before
