import subprocess
import sys

LOADED = """
import sys
from bench.figures import figure_settings
if sys.argv[1] == "command":
    figure_settings.mark_as_command()
from bench.figures.notebook_figure import NotebookFigure
import matplotlib.artist
from matplotlib.axes import Axes
print("linestyle" in Axes.plot.__doc__, "zorder" in Axes.plot.__doc__.split("Properties")[-1])
print(len(matplotlib.artist.kwdoc(NotebookFigure())) > 100)
import inspect
from matplotlib.lines import Line2D
line = Line2D([0, 1], [0, 1])
line.set(color="red", lw=3)
print((line.get_color(), line.get_linewidth()) == ("red", 3))
print("color" in inspect.signature(Line2D.set).parameters)
"""


def loaded(how):
    call = [sys.executable, "-c", LOADED, how]
    return subprocess.run(call, check=True, capture_output=True, text=True).stdout.split()


def test_a_session_has_the_tables_of_properties_in_docstrings():
    assert loaded("session") == ["True"] * 5


def test_a_command_loads_matplotlib_without_them_and_changes_it_for_nobody():
    _, table, kept, is_set, signature = loaded("command")
    assert (table, kept, is_set, signature) == ("False", "True", "True", "False")
