"""Define classes as in a notebook."""

import linecache
import sys


def define_in_cell(monkeypatch, text, file="<cell>", **names):
    """Run the text of a cell that defines the class Mine; return the class.

    IPython stores the text of a cell in linecache, and its classes belong to ``__main__``.

    Args:
        monkeypatch: fixture that undoes the changes of ``__main__``.
        text: text of the cell.
        file: name of the cell; in Jupyter, ``__main__`` has no file, which None stands for.
        names: names that are defined before the cell runs.
    """
    main, cell = sys.modules["__main__"], file or f"<cell {hash(text)}>"
    linecache.cache[cell] = (len(text), None, text.splitlines(keepends=True), cell)
    space = {"__name__": "__main__", **names}
    exec(compile(text, cell, "exec"), space)
    monkeypatch.setattr(main, "Mine", space["Mine"], raising=False)
    if file:
        monkeypatch.setattr(main, "__file__", file, raising=False)
    return space["Mine"]
