"""Tests in a real Jupyter kernel that executes one cell after another."""

import pytest

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")
pytest.importorskip("ipykernel")

TUNER = """
import simgap

class Careless(simgap.Tuner):
    def tune(self, task, rng):
        yield task.start
        distance = len(task.observed) / (task.dim - 2)
        yield task.start + distance
"""
COMPARE = """
run = simgap.compare("pendulum-swing", tuners=[Careless, "random"], targets=1, budget=4, jobs=0)
run.statuses.set_index("tuner").loc["careless", "reason"].iloc[0]
"""
REPAIRED_TUNER = TUNER.replace("task.dim - 2", "task.dim + 2")
AGAIN = """
run = simgap.compare("pendulum-swing", tuners=[Careless], targets=1, budget=4, jobs=0)
print(set(run.statuses["status"]))
run.figure("error")
"""
WORKERS = """
try:
    simgap.compare("pendulum-swing", tuners=[Careless], targets=1, budget=4, jobs=1)
except simgap.InputError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # warnings of Jupyter's own packages are not errors here
def test_a_cells_tuner_is_compared_its_fault_shows_its_line_and_figures_are_inline(
    tmp_path, monkeypatch
):
    """A real kernel provides `__main__`, the source text of cells and the display."""
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    cells = [
        nbformat.v4.new_code_cell(text) for text in (TUNER, COMPARE, REPAIRED_TUNER, AGAIN, WORKERS)
    ]
    notebook = nbformat.v4.new_notebook(cells=cells)
    nbclient.NotebookClient(
        notebook, timeout=120, resources={"metadata": {"path": tmp_path}}
    ).execute()
    _, faulty, _, mended, refused = (cell.outputs for cell in notebook.cells)

    said = "".join(output.text for output in faulty if output.output_type == "stream")
    reason = faulty[-1].data["text/plain"]
    for traceback in (said, reason):
        assert "distance = len(task.observed) / (task.dim - 2)" in traceback
        assert "ZeroDivisionError" in traceback

    assert "{'converged'}" in "".join(o.text for o in mended if o.output_type == "stream")
    assert mended[-1].data["image/png"]
    assert "jobs=0" in refused[-1].text
    assert len(refused[-1].text.strip().splitlines()) == 1
