"""Read XML model files with their parts.

The parser opens no other files. Each line of the formatted text can be traced back to a line of the
user's files.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring
from xml.parsers import expat

from sims.core.files import require_file
from sims.core.simulator import InputError

MAX_MODEL_BYTES = 50 * 2**20
"""Maximum size of a model file including all included files, in bytes."""
MAX_ASSET_BYTES = 500 * 2**20
"""Maximum size of a mesh or an image file, in bytes."""
MAX_ELEMENT_DEPTH = 400
"""Maximum nesting depth of XML elements."""

SCHEMA_REMEDY = "; correct or remove it (MuJoCo's XML reference lists what is allowed)"
"""End of MuJoCo's messages about an unknown element or attribute."""


@dataclass
class ModelFileReader:
    """Reader of the files of one model.

    Attributes:
        path: the model file; included files are relative to its folder.
        description: file that states additions to the model, for messages; None without one.
        places: file and line of each element.
        included: the model file and all included files.
        size: total size of these files in bytes.
        digest: SHA-256 digest of everything that was read.
        given: elements in the text given to MuJoCo, one for each line of the text.
    """

    path: Path
    description: Path | None = None
    places: dict[Element, str] = field(default_factory=dict)
    included: list[Path] = field(default_factory=list)
    size: int = 0
    digest: Any = field(default_factory=hashlib.sha256)
    given: list[Element] = field(default_factory=list)

    def make_error(self, element: Element | None, message: str) -> InputError:
        """Make the error for an element of the file; the message begins with file and line.

        Args:
            element: the element; None for the file as a whole.
            message: what is wrong.
        """
        place = self.places.get(element) if element is not None else None
        return InputError(f"{place or self.path}: {message}")

    def make_mujoco_error(self, message: str) -> InputError:
        """Make the error for a message of MuJoCo about the text that it was given.

        The line in that text is replaced by the line in the user's file.

        Args:
            message: message of MuJoCo in one line, such as ``...; Element 'joint', line 6``.
        """
        line = re.search(r", line (\d+)", message)
        number = int(line[1]) if line else 0
        # One element begins in each line of the text.
        element = self.given[number - 1] if 0 < number <= len(self.given) else None
        remedy = SCHEMA_REMEDY if message.startswith("Schema violation") else ""
        return self.make_error(element, re.sub(r", line \d+", "", message) + remedy)

    def read_content(self, path: Path, max_bytes: int) -> bytes:
        """Read a file, and add its bytes to the digest.

        Args:
            path: path of the file.
            max_bytes: maximum size in bytes.

        Raises:
            InputError: the file cannot be read, or is too large.
        """
        require_file(path)
        try:
            size = path.stat().st_size
            if size > max_bytes:
                raise InputError(f"{path}: {size} bytes; a file of a model has at most {max_bytes}")
            data = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None
        self.add_to_digest(data)
        return data

    def add_to_digest(self, data: bytes) -> None:
        """Add bytes to the digest."""
        self.digest.update(f"{len(data)}:".encode())
        self.digest.update(data)


def parse_tree(files: ModelFileReader, path: Path) -> Element:
    """Parse a model file safely, and return its root element.

    Python's own reader does not tell the lines of elements, and repeats entities that a hostile
    file declares. So a parser is used whose calls for each tag build the tree, note the line of
    every element for messages, and refuse declarations.

    Args:
        files: reader of the model, which records the file, its size and the lines of elements.
        path: path of the file.

    Raises:
        InputError: the file cannot be read, is too large or is not XML, or it declares something
            that an XML parser would fetch or repeat (a document type, an entity).
    """
    file_content = files.read_content(path, MAX_MODEL_BYTES)
    files.included.append(path.resolve())
    files.size += len(file_content)
    if files.size > MAX_MODEL_BYTES:
        raise InputError(
            f"{files.path}: with what it includes it has more than {MAX_MODEL_BYTES} bytes"
        )
    # Like MuJoCo's parser, accept blank lines before the declaration and zero bytes after the end.
    text = file_content.rstrip(b"\0").lstrip(b" \t\r\n")
    # Number of lines above the text, which the parser does not see.
    skipped_lines = file_content[: file_content.find(text[:1])].count(b"\n") if text else 0
    parser = expat.ParserCreate()
    builder = _LineTrackingTreeBuilder(files, path, parser, skipped_lines)
    try:
        parser.Parse(text, True)
    except InputError:  # A handler of the builder refuses something; the message is complete.
        raise
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        line = error.lineno + skipped_lines
        expectation = "a robot's model file is MJCF or URDF"
        raise InputError(f"{path}:{line}: not well-formed XML: {reason}; {expectation}") from None
    except (ValueError, LookupError) as error:  # The declared encoding does not exist.
        raise InputError(f"{path}: not XML: {error}") from None
    return builder.root


class _LineTrackingTreeBuilder:
    """XML tree under construction by a parser."""

    def __init__(self, files: ModelFileReader, path: Path, parser: Any, skipped_lines: int) -> None:
        """Set the handlers of the parser, which call this object for each tag.

        Args:
            files: reader of the model, which records the line of each element.
            path: path of the file, for messages.
            parser: parser of Python's module expat.
            skipped_lines: number of lines of the file above the parsed text; it is added to line
                numbers.
        """
        self.files, self.path, self.parser = files, path, parser
        self.skipped_lines = skipped_lines
        # Elements whose end tag has not been reached; the last one is the parent of the next.
        self.open_elements: list[Element] = []
        self.top: Element | None = None
        parser.StartElementHandler = self.begin
        parser.EndElementHandler = self.end
        # An entity may stand for the content of another file, or for a huge text.
        parser.StartDoctypeDeclHandler = self.refuse
        parser.EntityDeclHandler = self.refuse

    @property
    def root(self) -> Element:
        assert self.top is not None, "a well-formed file has a root"
        return self.top

    @property
    def location(self) -> str:
        """File and line at the parser's position."""
        return f"{self.path}:{self.parser.CurrentLineNumber + self.skipped_lines}"

    def begin(self, name: str, attributes: dict[str, str]) -> None:
        """Add an element to the tree at its start tag, and store its file and line for messages.

        Args:
            name: name of the element.
            attributes: its attributes.
        """
        element = Element(name, attributes)
        self.files.places[element] = self.location
        if self.open_elements:
            self.open_elements[-1].append(element)
        else:
            self.top = element
        self.open_elements.append(element)
        if len(self.open_elements) > MAX_ELEMENT_DEPTH:
            raise self.files.make_error(element, f"elements more than {MAX_ELEMENT_DEPTH} deep")

    def end(self, _: str) -> None:
        self.open_elements.pop()

    def refuse(self, *_: Any) -> None:
        raise InputError(f"{self.location}: document types and entities are not read; remove them")


def resolve_includes(files: ModelFileReader, root: Element) -> None:
    """Replace ``include`` elements by the content of their files, as MuJoCo does.

    Names are relative to the model file's folder, and no file is included twice.

    Args:
        files: reader of the model.
        root: root element; it is changed in place, with all its descendants.
    """
    # The elements are listed first, since their children change.
    for parent in list(root.iter()):
        if any(child.tag == "include" for child in parent):
            parent[:] = _expand_includes(files, parent)


def _expand_includes(files: ModelFileReader, parent: Element) -> list[Element]:
    """Return the children of an element, with include elements replaced by the included children.

    Args:
        files: reader of the model, which parses the included files.
        parent: the element, which is not changed.

    Raises:
        InputError: an included file is not stated, absent, or included twice.
    """
    children: list[Element] = []
    for child in parent:
        if child.tag != "include":
            children.append(child)
            continue
        name = child.get("file")
        if not name:
            raise files.make_error(child, "an include states no file")
        path = files.path.parent / name.replace("\\", "/")
        if not path.is_file():
            raise files.make_error(child, f"the included file {name} is absent ({path})")
        if path.resolve() in files.included:
            raise files.make_error(
                child, f"{name} is included already: MuJoCo takes each file once"
            )
        included_root = parse_tree(files, path)
        resolve_includes(files, included_root)
        children += list(included_root)
    return children


def format_tree(root: Element) -> tuple[str, list[Element]]:
    """Format a tree as text in which exactly one element begins in each line.

    So the line in a message of MuJoCo about this text leads to the element, and to its line in the
    user's file.

    Args:
        root: root element; the texts between its elements are changed.

    Returns:
        The text, and the element that begins in each line.
    """
    elements = list(root.iter())
    # Line breaks are only before the first child, and between two children.
    for element in elements:
        element.text = "\n" if len(element) else None
        element.tail = None
    for element in elements:
        for child in element[:-1]:
            child.tail = "\n"
    return tostring(root, encoding="unicode"), elements


def find_children(element: Element, *path: str) -> list[Element]:
    """Find all elements at a path of tags below an element; each tag may occur repeatedly."""
    elements = [element]
    for tag in path:
        elements = [child for parent in elements for child in parent if child.tag == tag]
    return elements
