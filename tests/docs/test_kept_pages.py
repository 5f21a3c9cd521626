"""Tests that stored report pages have the numbers of the tables next to them."""

import base64
import hashlib
import io
import json
import re

import pandas as pd
import pytest

from tests.docs.documentation_pages import ROOT

REFERENCE = ROOT / "results" / "reference"
PAGES = sorted(page.parent for page in REFERENCE.rglob("report.html"))
COMPARED = [folder for folder in PAGES if not (folder / "verdict.json").exists()]
_OLDER = ("ball_drops/blue_basketball", "smartphone_fall/fall", "emps/explained", "so101/explained")
"""Explanations below real/ that are older than the present page; their README states this."""
TODAY = [folder for folder in PAGES if folder not in {REFERENCE / "real" / each for each in _OLDER}]
DATA = re.compile(r'<script type="application/json" id="data">(.*?)</script>', re.S)


def tables(folder):
    """Return the tables of a page by name."""
    text = (folder / "report.html").read_text(encoding="utf-8")
    kept = json.loads(DATA.search(text)[1])["tables"]
    return {name: pd.read_csv(io.StringIO(csv)) for name, csv in kept.items()}


@pytest.mark.parametrize("folder", COMPARED, ids=lambda f: f.relative_to(REFERENCE).as_posix())
def test_a_stored_page_has_the_numbers_of_its_tables(folder):
    compared = 0
    for name, shown in tables(folder).items():
        path = folder / f"{name}.csv"
        if path.exists():
            beside = pd.read_csv(path)
            # Tables written before tuners were isolated have one column fewer.
            common = [column for column in beside if column in shown]
            assert len(common) >= len(beside.columns) - 1
            # A chart's table may have additional lines at the end for comparison, such as an ideal
            # curve.
            shown = shown[common].head(len(beside))
            pd.testing.assert_frame_equal(shown, beside[common], rtol=1e-5, check_dtype=False)
            compared += 1
    assert compared >= 1


@pytest.mark.parametrize("folder", TODAY, ids=lambda f: f.relative_to(REFERENCE).as_posix())
def test_a_stored_page_requests_nothing_and_runs_only_its_own_script(folder):
    text = (folder / "report.html").read_text(encoding="utf-8")
    script = re.findall(r"<script>(.*?)</script>", text, re.S)[-1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    assert f'<meta http-equiv="Content-Security-Policy" content="{policy}">' in text
