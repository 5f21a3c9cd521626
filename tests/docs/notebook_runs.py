"""Notebooks as pages of the site: text, code, and what it showed where the notebook was run."""

import base64
import tempfile

LONGEST = 100_000
"""Characters of HTML that stand on the page itself; more becomes a file of its own."""


def page(path, run=False):
    """A notebook as (Markdown, files beside it by name).

    Args:
        path: the notebook, which is kept without outputs.
        run: run it, in an empty folder, and show what its cells show.
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
    """Run a notebook where it leaves nothing behind."""
    import nbclient

    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        nbclient.NotebookClient(notebook, timeout=300, resources=resources).execute()


def shown(output, name, files):
    """What a cell shows, as Markdown; files that it needs are added to `files`."""
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
