"""Convert notebooks to pages of the site, with text, code and optionally the outputs of a run."""

import base64
import tempfile

LONGEST = 100_000
"""Maximum number of characters of an HTML output on the page; a longer one becomes a
separate file.
"""


def page(path, run=False):
    """Convert a notebook to Markdown and the additional files that it needs, by name.

    Args:
        path: the notebook, which is stored without outputs.
        run: whether to run it in an empty folder and display its outputs.
    """
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    if run:
        execute(notebook)
    parts, files = [], {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.get("outputs", []):
            name = f"{path.stem}-{len(files)}"
            parts.append(shown(output, name, files))
    return "\n\n".join(parts) + "\n", files


def execute(notebook):
    """Run a notebook in a temporary folder."""
    import nbclient

    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        nbclient.NotebookClient(notebook, timeout=300, resources=resources).execute()


def shown(output, name, files):
    """Convert the output of a cell to Markdown, and add the files that it needs to `files`."""
    data = output.get("data", {})
    if "image/png" in data:
        files[f"{name}.png"] = base64.b64decode(data["image/png"])
        return f"![What the cell shows]({name}.png)"
    html = data.get("text/html", "")
    if len(html) > LONGEST:
        files[f"{name}.html"] = html.encode()
        return f"[What the cell shows]({name}.html), a page of its own."
    if html:
        return f'<div markdown="0" class="shown">{html}</div>'
    return f"```text\n{data.get('text/plain', output.get('text', ''))}\n```"
