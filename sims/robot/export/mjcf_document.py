"""MJCF source document with its included files, and edits of XML text in place.

It relates the elements of the source text to their numbers in the compiled model.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import escape

from sims.robot.export.mjcf_attributes import ModelElement

_ATTRIBUTE = re.compile(rb"(\s+)([\w:.-]+)\s*=\s*(\"[^\"]*\"|'[^']*')")


class NotEditableError(Exception):
    """A text cannot be edited in this way; the message states the reason as a clause."""


@dataclass(eq=False)
class XmlElement:
    """An XML element and the changes to make in it.

    Attributes:
        name: name of the element.
        attributes: attributes as read.
        begin: byte offset at which its start tag begins.
        inside: byte offset at which its start tag ends.
        end: byte offset at which its end tag begins; equal to `inside` if it has none.
        children: child elements in the order of the text.
        new: new attribute values.
        removed: attributes to remove.
        renamed: new name of the element.
        before: comments to insert before it.
        within: elements with comments to insert as its first children.
        inserted: new children, whose attributes may still change; written after `within`.
        after: elements to insert after it.
        text: text that replaces the element.
    """

    name: str
    attributes: dict[str, str]
    begin: int
    inside: int = 0
    end: int = 0
    children: list[XmlElement] = field(default_factory=list)
    new: dict[str, str] = field(default_factory=dict)
    removed: set[str] = field(default_factory=set)
    renamed: str = ""
    before: list[str] = field(default_factory=list)
    within: list[tuple[list[str], str]] = field(default_factory=list)
    inserted: list[XmlElement] = field(default_factory=list)
    after: list[str] = field(default_factory=list)
    text: bytes | None = None

    @property
    def has_changes(self) -> bool:
        """True if the element or any of its descendants has changes."""
        has_tag_changes = self.new or self.removed or self.renamed or self.before or self.after
        has_content_changes = self.within or self.inserted or self.text is not None
        return bool(has_tag_changes or has_content_changes) or any(
            child.has_changes for child in self.children
        )

    def get_attribute(self, name: str) -> str | None:
        """Return the value of an attribute, including changes; None if it is missing."""
        if name in self.new:
            return self.new[name]
        return None if name in self.removed else self.attributes.get(name)

    def walk(self) -> Iterator[XmlElement]:
        """Yield the element and all its descendants, in the order of the text."""
        yield self
        for child in self.children:
            yield from child.walk()


class XmlText:
    """An XML text with its elements.

    Raises:
        NotEditableError: the text is not XML in UTF-8, or has a document type.
    """

    def __init__(self, text: bytes, path: Path) -> None:
        """Parse the text with Expat, which gives the byte position of each element.

        Positions allow edits of single attributes that leave the rest of the file unchanged,
        comments included.

        Args:
            text: Content of the file, UTF-8.
            path: File name for messages.
        """
        self.text, self.path = text, path
        self._open: list[XmlElement] = []
        self._top: XmlElement | None = None
        self._parser = expat.ParserCreate("utf-8")
        self._parser.StartElementHandler = self._handle_start_tag
        self._parser.EndElementHandler = self._handle_end_tag
        self._parser.StartDoctypeDeclHandler = self._refuse_document_type
        try:
            self._parser.Parse(text, True)
        except expat.ExpatError as error:
            raise NotEditableError(f"{path.name} is not XML in UTF-8 ({error})") from None
        # Inserted lines end like those of the file.
        self._newline = b"\r\n" if b"\r\n" in text else b"\n"

    @property
    def root(self) -> XmlElement:
        """Root element."""
        assert self._top is not None, "well-formed XML has one"
        return self._top

    def _refuse_document_type(self, *what: object) -> None:  # noqa: ARG002
        raise NotEditableError(f"{self.path.name} has a document type")

    def _handle_start_tag(self, name: str, attributes: dict[str, str]) -> None:
        """Add an element to the tree at its start tag (called by the parser).

        Until its end tag is parsed, `inside` and `end` are the end of the start tag.
        """
        tag = XmlElement(name, attributes, self._parser.CurrentByteIndex)
        tag.inside = tag.end = self._end_of(tag.begin)
        if self._open:
            self._open[-1].children.append(tag)
        else:
            self._top = tag
        self._open.append(tag)

    def _handle_end_tag(self, name: str) -> None:  # noqa: ARG002
        """Store where the content of an element ends, at its end tag (called by the parser)."""
        tag = self._open.pop()
        if not self._is_self_closing(tag):
            tag.end = self._parser.CurrentByteIndex

    def _is_self_closing(self, tag: XmlElement) -> bool:
        """Return whether an element has a self-closing tag."""
        return self.text[tag.inside - 2 : tag.inside] == b"/>"

    def _end_of(self, begin: int) -> int:
        """Return the offset after a start tag, at the first ``>`` outside of quotes.

        Args:
            begin: Offset of the ``<`` of the tag.
        """
        quote = b""
        for i in range(begin, len(self.text)):
            character = self.text[i : i + 1]
            if quote:
                quote = b"" if character == quote else quote
            elif character in (b'"', b"'"):
                quote = character
            elif character == b">":
                return i + 1
        raise NotEditableError(f"{self.path.name} ends within a tag")

    def inner_text(self) -> bytes:
        """Return the content of the root element, with all changes."""
        return self._render_range(self.root.inside, self.root.end, self.root.children)

    def to_text(self) -> bytes:
        """Return the text with all changes."""
        return self._render_range(0, len(self.text), [self.root])

    def _render_range(self, begin: int, end: int, tags: list[XmlElement]) -> bytes:
        """Return the text between two byte positions, with changed elements replaced.

        Text between changed elements is copied byte for byte.

        Args:
            begin: offset of the first byte.
            end: offset after the last byte.
            tags: elements directly within this range, in document order.
        """
        parts, offset = [], begin
        for tag in tags:
            if tag.has_changes or tag.text is not None:
                parts += [self.text[offset : tag.begin], self._render_element(tag)]
                offset = self._find_end_of_element(tag)
        return b"".join([*parts, self.text[offset:end]])

    def _find_end_of_element(self, tag: XmlElement) -> int:
        return tag.inside if self._is_self_closing(tag) else self._end_of(tag.end)

    def _render_element(self, tag: XmlElement) -> bytes:
        """Return the text of an element with its comments, changed attributes and new elements.

        The parts are, in order: comments before it, its start tag, inserted children, its own
        content (rendered recursively), its end tag, and elements after it. All text that has not
        changed is kept byte for byte.

        Raises:
            NotEditableError: new elements belong into an element with a self-closing tag.
        """
        indent = self._get_indentation(tag.begin)
        comments = [self._render_comment(text) + self._newline + indent for text in tag.before]
        if tag.text is not None:
            return b"".join([*comments, tag.text])
        if self._is_self_closing(tag) and (tag.within or tag.inserted):
            raise NotEditableError(f"{tag.name} has nothing in it")
        closing = (
            self.text[tag.end : self._find_end_of_element(tag)]
            if not self._is_self_closing(tag)
            else b""
        )
        if tag.renamed:
            closing = closing.replace(tag.name.encode(), tag.renamed.encode(), 1)
        content = self._render_range(tag.inside, tag.end, tag.children)
        following_elements = [self._newline + indent + element.encode() for element in tag.after]
        element_parts = [
            self._render_start_tag(tag),
            self._render_inserted(tag, indent),
            content,
            closing,
        ]
        return b"".join([*comments, *element_parts, *following_elements])

    def _render_inserted(self, tag: XmlElement, indent: bytes) -> bytes:
        """Return the text of the elements inserted before all children.

        Each comment and each element gets a line with the indentation of the other children.
        """
        child_indent = (
            self._get_indentation(tag.children[0].begin) if tag.children else indent + b"  "
        )
        fragments = []
        inserted = [(child.before, format_element(child.name, child.new)) for child in tag.inserted]
        for comments, element in [*tag.within, *inserted]:
            for line in [
                *map(self._render_comment, comments),
                *([element.encode()] if element else []),
            ]:
                fragments += [self._newline + child_indent, line]
        return b"".join(fragments)

    def _render_start_tag(self, tag: XmlElement) -> bytes:
        """Return the changed start tag; unchanged attributes keep their spaces and quotes.

        Attributes are copied, replaced or left out in their order; new ones follow at the end.

        Args:
            tag: element with its new and removed attributes, and where it stands in the text.
        """
        text = self.text[tag.begin : tag.inside]
        offset = 1 + len(tag.name.encode())
        fragments = [b"<", (tag.renamed or tag.name).encode()]
        written_names = set()
        while attribute_match := _ATTRIBUTE.match(text, offset):
            name = attribute_match[2].decode()
            if name in tag.new:
                fragments.append(attribute_match[1] + _render_attribute(name, tag.new[name]))
                written_names.add(name)
            elif name not in tag.removed:
                fragments.append(attribute_match[0])
            offset = attribute_match.end()
        fragments += [
            b" " + _render_attribute(name, value)
            for name, value in tag.new.items()
            if name not in written_names
        ]
        return b"".join([*fragments, text[offset:]])

    def _render_comment(self, text: str) -> bytes:
        """Render text as an XML comment, with the line ends of the file."""
        return format_comment(text).encode().replace(b"\n", self._newline)

    def _get_indentation(self, begin: int) -> bytes:
        """Return the indentation of an element; empty if other text precedes it on its line."""
        line = self.text[self.text.rfind(b"\n", 0, begin) + 1 : begin]
        return line if not line.strip() else b""


def format_comment(text: str) -> str:
    """Format text as an XML comment."""
    # Two hyphens would end a comment early, and so would a hyphen at its end.
    escaped_text = re.sub(r"-(?=-)", "- ", text)
    return f"<!-- {escaped_text} -->"


def format_element(name: str, attributes: Mapping[str, str]) -> str:
    """Format an XML element without content.

    Args:
        name: name of the element.
        attributes: values by name, not escaped.
    """
    parts = [_render_attribute(key, value).decode() for key, value in attributes.items()]
    return f"<{' '.join([name, *parts])}/>"


def _render_attribute(name: str, value: str) -> bytes:
    return f'{name}="{escape(value, {chr(34): "&quot;"})}"'.encode()


def format_heading(path: Path, recording: str, notes: Iterable[str]) -> str:
    """Format the comment at the top of a written file: its origin, and notes.

    Args:
        path: model file from which it was made.
        recording: title of the recording to which its causes were fitted; empty if none.
        notes: a line for each note.
    """
    origin = f", with the causes found in {recording}" if recording else ""
    return "\n     ".join([f"{path.name}{origin}; written by simgap", *notes])


def strip_heading(text: str) -> str:
    """Remove the comment at the top of a written file."""
    return re.sub(
        r"<!-- (?:(?!-->).)*?; written by simgap.*?-->", "", text, count=1, flags=re.DOTALL
    )


def format_number(value: float) -> str:
    """Format a number with the fewest digits that are read back as the same number."""
    text = repr(float(value))
    return text[:-2] if text.endswith(".0") else text


def format_numbers(values: tuple[float, ...]) -> str:
    """Format numbers as a list of MJCF or URDF."""
    return " ".join(format_number(value) for value in values)


_UNSUPPORTED_ELEMENTS = ("replicate", "attach", "composite", "flexcomp", "model")
"""Elements that generate several elements, or refer to those of another file."""

FILE_ELEMENTS = ("mesh", "texture", "hfield", "skin")
"""Elements that refer to a file."""

_DIRECTORY_ATTRIBUTES = ("assetdir", "meshdir", "texturedir")


class MjcfDocument:
    """An MJCF with all its included files.

    Attributes:
        main: text of the outer file.
        root: root element of the outer file.

    Raises:
        NotEditableError: a file is missing, or is not XML.
    """

    def __init__(self, text: bytes, path: Path) -> None:
        """Parse the text of the outer file, and read all files that it includes."""
        self.path = path
        self.main = XmlText(text, path)
        self.root = self.main.root
        self._included: dict[XmlElement, XmlText] = {}
        self._read_included_files(self.root)

    def _read_included_files(self, root: XmlElement) -> None:
        """Read the included files below an element, and those that they include in turn.

        All names are relative to the folder of the outer file, as in MuJoCo.
        """
        for tag in root.walk():
            name = tag.attributes.get("file")
            if tag.name != "include" or not name:
                continue
            path = self.path.parent / name
            try:
                inner = XmlText(path.read_bytes(), path)
            except OSError:
                raise NotEditableError(f"{name} cannot be read") from None
            self._included[tag] = inner
            self._read_included_files(inner.root)

    def children(self, tag: XmlElement) -> Iterator[XmlElement]:
        """Yield the children of an element, including those from included files."""
        for child in tag.children:
            if child in self._included:
                yield from self.children(self._included[child].root)
            else:
                yield child

    def walk(self, tag: XmlElement | None = None) -> Iterator[XmlElement]:
        """Yield all descendants of an element; of the root if None."""
        for child in self.children(tag or self.root):
            yield child
            yield from self.walk(child)

    def find_elements(self, *names: str) -> list[XmlElement]:
        """Return all elements at a path of names from the root."""
        elements = [self.root]
        for name in names:
            elements = [
                child for tag in elements for child in self.children(tag) if child.name == name
            ]
        return elements

    def map_to_compiled_ids(self, model: Any) -> dict[ModelElement, XmlElement]:
        """Map the elements of the compiled model to those of the text.

        So a change of the compiled model leads to the place in the text. Bodies, joints and
        actuators are found by their order, which is that of the text; geoms (shapes) and contact
        pairs are found by their names.

        Args:
            model: Compiled model of MuJoCo.

        Raises:
            NotEditableError: the compiled model has other elements than the text.
        """
        for tag in self.walk():
            if tag.name in _UNSUPPORTED_ELEMENTS:
                raise NotEditableError(f"it has an element <{tag.name}>")
        bodies: list[XmlElement] = []
        joints: list[XmlElement] = []
        for world in self.find_elements("worldbody"):
            self._collect_bodies(world, bodies, joints)
        actuators = [
            child for tag in self.find_elements("actuator") for child in self.children(tag)
        ]
        tags_by_element = {ModelElement("body", i + 1): tag for i, tag in enumerate(bodies)}
        tags_by_element |= {ModelElement("joint", i): tag for i, tag in enumerate(joints)}
        tags_by_element |= {ModelElement("actuator", i): tag for i, tag in enumerate(actuators)}
        _check_elements_match_model(
            tags_by_element, model, (len(bodies) + 1, len(joints), len(actuators))
        )
        pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
        pair_ids = {
            frozenset(str(model.geom(geom).name) for geom in geoms): i
            for i, geoms in enumerate(pairs)
        }
        geom_ids = {str(model.geom(geom).name): geom for geom in range(model.ngeom)}
        tags_by_element |= {
            ModelElement("geom", geom_ids[name]): tag
            for tag in self.walk()
            if tag.name == "geom" and (name := tag.attributes.get("name")) in geom_ids
        }
        return tags_by_element | {
            ModelElement("pair", pair_ids[geoms]): tag
            for geoms, tag in self.find_pairs().items()
            if geoms in pair_ids
        }

    def find_pairs(self) -> dict[frozenset[str], XmlElement]:
        """Return the elements `<pair>` by the names of their two geoms."""
        return {
            frozenset((tag.attributes.get("geom1", ""), tag.attributes.get("geom2", ""))): tag
            for tag in self.find_elements("contact", "pair")
        }

    def _collect_bodies(
        self, tag: XmlElement, bodies: list[XmlElement], joints: list[XmlElement]
    ) -> None:
        """Collect bodies depth first, and the joints of each body before those of its children.

        MuJoCo numbers bodies and joints in this order.

        Args:
            tag: Body whose children are collected.
            bodies: List to which bodies are appended.
            joints: List to which joints are appended.
        """
        child_bodies: list[XmlElement] = []
        self._append_children(tag, child_bodies, joints)
        for body in child_bodies:
            bodies.append(body)
            self._collect_bodies(body, bodies, joints)

    def _append_children(
        self, tag: XmlElement, bodies: list[XmlElement], joints: list[XmlElement]
    ) -> None:
        """Append the bodies and joints directly within a body to the two lists, in document order.

        A frame only groups its contents, so they count as contents of the body.
        """
        for child in self.children(tag):
            if child.name == "body":
                bodies.append(child)
            elif child.name in ("joint", "freejoint"):
                joints.append(child)
            elif child.name == "frame":
                self._append_children(child, bodies, joints)

    def make_paths_absolute(self, folder: Path) -> bool:
        """Make asset folders absolute, so that the text can be loaded from anywhere.

        Args:
            folder: folder of the model file.

        Returns:
            Whether the text refers to any asset files.
        """
        has_files = any(
            tag.name in FILE_ELEMENTS and any(key.startswith("file") for key in tag.attributes)
            for tag in self.walk()
        )
        if has_files:
            self._write_absolute_folders(folder)
        return has_files

    def _write_absolute_folders(self, folder: Path) -> None:
        """Write absolute mesh and texture folders, so that the document can be stored elsewhere.

        `folder` is the folder of the model file; the stated directories are relative to it.
        """
        stated_folders: dict[str, str] = {}
        compilers = self.find_elements("compiler")
        for compiler in compilers:
            stated_folders |= {
                key: compiler.attributes[key]
                for key in _DIRECTORY_ATTRIBUTES
                if key in compiler.attributes
            }
        asset_folder = stated_folders.get("assetdir", "")
        absolute_folders = {
            key: str(folder / stated_folders.get(key, asset_folder))
            for key in ("meshdir", "texturedir")
        }
        # The last compiler element takes precedence.
        if compilers:
            compilers[-1].new |= absolute_folders
        else:
            self.root.within.append(([], format_element("compiler", absolute_folders)))

    def to_text(self) -> str:
        """Return the text with all changes; changed files replace their include elements."""
        self._prepare_includes(self.root)
        return self.main.to_text().decode()

    def _prepare_includes(self, root: XmlElement) -> None:
        """Prepare each include element for writing, included files first.

        A changed file is inserted in place of its include element, between two comments. An
        unchanged file stays included, with its absolute path.
        """
        for tag in root.walk():
            inner = self._included.get(tag)
            if inner is None:
                continue
            self._prepare_includes(inner.root)
            name = tag.attributes["file"]
            if inner.root.has_changes:
                tag.before = [f"start of {name}, with changes"]
                tag.text = inner.inner_text() + f"<!-- end of {name} -->".encode()
            else:
                tag.new["file"] = str((self.path.parent / name).resolve())


def _check_elements_match_model(
    tags_by_element: dict[ModelElement, XmlElement], model: Any, counts: tuple[int, int, int]
) -> None:
    """Check that the text has the elements of the compiled model, in the same order.

    Edits find the text of an element by its index in the compiled model. If the compiler added,
    removed or reordered elements, they would change the wrong element.

    Args:
        tags_by_element: element of the text for each body, joint and actuator of the model.
        model: compiled model.
        counts: numbers of bodies, joints and actuators in the text.

    Raises:
        NotEditableError: the numbers, the names or the order of the elements differ.
    """
    compiled_counts = (model.nbody, model.njnt, len(model.actuator_ctrlnum))
    if counts != compiled_counts:
        raise NotEditableError("the compiled model has other elements")
    for (kind, i), tag in tags_by_element.items():
        name = str(getattr(model, kind)(i).name)
        if tag.attributes.get("name", "") != name:
            raise NotEditableError(f"the compiled model has its elements in another order ({name})")
