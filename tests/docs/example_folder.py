"""Write the documentation pages as input of the site generator.

Links are changed to addresses within the site, formulas become MathML, and each linked source file
gets its own page.
"""

import re
import shutil
from collections.abc import Callable
from os.path import relpath
from pathlib import Path

from tests.docs import notebook_runs
from tests.docs.documentation_pages import DOCS, FENCE, LINK, ROOT, anchors, pages

PICTURES = {".gif", ".jpg", ".png", ".svg"}
FILES = {".csv", ".html", ".pdf", ".parquet", ".json"}
"""Suffixes of files that are copied unchanged; any other file is displayed as text."""
UNSEARCHED = "---\nsearch:\n  exclude: true\n---"
"""Front matter of pages that the search excludes."""
LANGUAGES = {".py": "python", ".toml": "toml", ".xml": "xml", ".urdf": "xml"}
FORMULA = re.compile(r"\$`([^`]+)`\$")
"""Pattern of an inline formula in GitHub's syntax."""
BEFORE_LIST = re.compile(r"^(?!\s*(?:[-*|]|\d+\.) )(?!\|)(\S.*)\n(?=(?:[-*]|1\.) )", re.M)
"""Pattern of a line of text directly before a list."""
HEADING = re.compile(r"^(#+ .*)$", re.M)


def place(path):
    """Return the path of a project file within the site."""
    path = path.resolve()
    if path.is_dir():
        readme = path / "README.md"
        if readme.exists():
            return place(readme)
        return Path("source", path.relative_to(ROOT), "index.md")
    if path.suffix == ".ipynb":
        return path.relative_to(DOCS).with_suffix(".md")
    if path.suffix == ".md":
        whole = path.relative_to(DOCS if DOCS in path.parents else ROOT)
        if whole.name == "README.md" and whole.parent != Path():
            return whole.with_name("index.md")
        return whole if DOCS in path.parents else whole.with_name(whole.name.lower())
    if path.suffix in PICTURES | FILES:
        return path.relative_to(ROOT)
    return Path("source", path.relative_to(ROOT).as_posix() + ".md")


class Stage:
    """The pages of the site, each written once into a folder.

    Attributes:
        folder: output folder.
        run: whether notebooks are run and the outputs of their cells displayed.
        shown: files of the project that have been written.
    """

    def __init__(self, folder, run=False):
        self.folder = folder
        self.run = run
        self.shown = set()

    def every_page(self):
        """Write all Markdown pages and notebooks of the project and the files they link to."""
        for path in [*pages(), *sorted((DOCS / "notebooks").glob("*.ipynb"))]:
            self.show(path)

    def show(self, path):
        """Write a file of the project unless it has been written already."""
        path = path.resolve()
        if path in self.shown:
            return
        self.shown.add(path)
        target = self.folder / place(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".md":
            target.write_text(self.page(path), encoding="utf-8")
        elif path.suffix == ".ipynb":
            text, files = notebook_runs.page(path, self.run)
            target.write_text(self.linked(text, path, files), encoding="utf-8")
            for name, content in files.items():
                target.with_name(name).write_bytes(content)
        elif path.suffix in PICTURES | FILES:
            shutil.copyfile(path, target)
        elif path.is_dir():
            if not (path / "README.md").exists():
                target.write_text(self.listing(path), encoding="utf-8")
        else:
            target.write_text(source(path), encoding="utf-8")

    def page(self, path):
        """Return a Markdown page in the form that the site generator expects."""
        names = iter(anchors(path))
        text = path.read_text(encoding="utf-8")
        return transform_prose(
            text,
            lambda part: with_anchors(spaced(self.linked(part, path)), names),
            code,
        )

    def linked(self, text, path, siblings=()):
        """Replace the links of a page by addresses within the site.

        Args:
            text: Markdown without fenced blocks, or the text of a notebook.
            path: file of the page, to which its links are relative.
            siblings: names of files in the same output folder as the page.
        """

        def turned(link):
            name, _, anchor = link[2].partition("#")
            if "://" in link[2] or not name or name in siblings:
                return link[0]
            target = (path.parent / name).resolve()
            self.show(target)
            way = relpath(place(target), place(path).parent)
            return f"{link[1]}({way}{'#' * bool(anchor)}{anchor})"

        return LINK.sub(turned, text)

    def listing(self, folder):
        """Return a page that lists the source files of a folder."""
        lines = [f"# `{folder.relative_to(ROOT)}`", ""]
        for file in sorted(folder.iterdir()):
            if file.is_file() and file.suffix in LANGUAGES:
                self.show(file)
                lines.append(f"- [`{file.name}`]({relpath(place(file), place(folder).parent)})")
        return "\n".join(lines) + "\n"


def transform_prose(text, change, fenced: Callable[[re.Match[str]], str]):
    """Apply `change` to the text between fenced blocks, and `fenced` to the blocks."""
    parts, end = [], 0
    for fence in FENCE.finditer(text):
        parts += [change(text[end : fence.start()]), fenced(fence)]
        end = fence.end()
    return "".join([*parts, change(text[end:])])


def with_anchors(text, names):
    """Give headings the anchors they have on GitHub, and convert inline formulas."""
    text = HEADING.sub(lambda heading: f"{heading[1]} {{#{next(names)}}}", text)
    return FORMULA.sub(lambda found: mathml(found[1], "inline"), text)


def spaced(text):
    """Insert the blank line before a list that GitHub does not need."""
    return BEFORE_LIST.sub(r"\1\n\n", text)


def code(fence):
    """Convert a fenced block: its name becomes its title, and formulas become MathML."""
    if fence["language"] == "math":
        return formula(fence["text"])
    title = f' title="{fence["name"]}"' if fence["name"] else ""
    return f"```{fence['language']}{title}\n{fence['text']}```"


def mathml(formula, display):
    """Convert a LaTeX formula to MathML, which browsers display without a script."""
    from latex2mathml.converter import convert

    return convert(formula, display=display)


def formula(text):
    """Convert a displayed formula to HTML."""
    return f'<div class="formula" markdown="0">{mathml(text.strip(), "block")}</div>'


def source(path):
    """Return a page that displays a source file of the project."""
    language = LANGUAGES.get(path.suffix, "text")
    text = path.read_text(encoding="utf-8")
    title = f"# `{path.relative_to(ROOT)}`"
    return f"{UNSEARCHED}\n\n{title}\n\n````{language}\n{text}````\n"
