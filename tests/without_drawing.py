"""simgap whose comparisons write their tables alone; figures and pages have tests of their own."""

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
"""`simgap` in a process of its own, wherever it is started."""


@contextmanager
def undrawn():
    """Comparisons of this process draw nothing meanwhile."""
    from bench.benchmark import results_report

    before = results_report._drawn, results_report.render_page
    results_report._drawn, results_report.render_page = lambda *_: {}, lambda _: ""
    try:
        yield
    finally:
        results_report._drawn, results_report.render_page = before
