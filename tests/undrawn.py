"""simgap whose comparisons write their tables alone; figures and pages have tests of their own."""

import sys
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
_CODE = f"""
import sys
sys.path.append({str(ROOT)!r})
from tests.undrawn import undrawn
from bench.cli import main
with undrawn():
    sys.exit(main())
"""
COMMAND = [sys.executable, "-c", _CODE]
"""`simgap` in a process of its own, wherever it is started."""


@contextmanager
def undrawn():
    """Comparisons of this process draw nothing meanwhile."""
    from bench import report

    before = report._drawn, report.comparison_page
    report._drawn, report.comparison_page = lambda *_: {}, lambda _: ""
    try:
        yield
    finally:
        report._drawn, report.comparison_page = before
