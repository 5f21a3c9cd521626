"""Tests that the code blocks of the page on Python and the notebooks run unchanged."""

import importlib
import json
import os

import pytest

import simgap
from tests.docs.documentation_pages import DOCS, ROOT, blocks, text_of

NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def test_every_public_name_is_on_the_page():
    page = text_of("python.md")
    assert [name for name in dir(simgap) if name not in page and not name.startswith("_")] == []


@pytest.mark.long
def test_the_blocks_of_the_page_run(tmp_path, monkeypatch, capsys):
    code = "\n".join(text for _, text in blocks(text_of("python.md"), "python"))
    (tmp_path / "page_on_python.py").write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    # The page becomes a module, because a tuner's class needs a source file.
    page = importlib.import_module("page_on_python")
    assert set(page.run.statuses["status"]) == {"done"}
    said = capsys.readouterr().out
    assert "99.8 % of the gap closed" in said
    assert "unknown effect 'drag.lienar'" in said


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) > 4
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("default")  # of the packages of Jupyter
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    notebook = nbformat.read(path, as_version=4)
    run = nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": tmp_path}})
    run.execute()
    # Only figures that can display themselves without pyplot become images.
    shown = [set(o.get("data", {})) for cell in notebook.cells for o in cell.get("outputs", [])]
    assert {"image/png"} <= set().union(*shown), "no figure was shown"
