"""Edit an XML text in place: only changed elements differ, all other text stays byte for byte."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import escape

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
        within: comments and the text of an element (may be empty) to insert as its first children.
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
        """True if the element or any of its descendants is to be written with changes."""
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

    def insert_within(self, element: str, comments: Iterable[str] = ()) -> None:
        """Insert comments and the text of an element after those inserted as first children."""
        self.within.append((list(comments), element))

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

        Its end is that of the start tag until the end tag is parsed.

        Args:
            name: name of the element.
            attributes: its attributes.
        """
        tag = XmlElement(name, attributes, self._parser.CurrentByteIndex)
        tag.inside = tag.end = self._find_end_of_tag(tag.begin)
        # Elements whose end tag has not been reached are open; the last one is the parent.
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

    def _find_end_of_tag(self, begin: int) -> int:
        """Return the byte offset after a tag: after the first ``>`` that is not within quotes.

        Args:
            begin: offset of the ``<`` of the tag.

        Raises:
            NotEditableError: the text ends within the tag.
        """
        quote = b""  # the quote that has been opened; empty outside of quotes
        for offset in range(begin, len(self.text)):
            character = self.text[offset : offset + 1]
            if quote:
                quote = b"" if character == quote else quote
            elif character in (b'"', b"'"):
                quote = character
            elif character == b">":
                return offset + 1
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
        return tag.inside if self._is_self_closing(tag) else self._find_end_of_tag(tag.end)

    def _render_element(self, tag: XmlElement) -> bytes:
        """Return the text of an element with its comments, changed attributes and new elements.

        The parts are, in order: comments before it, its start tag, inserted children, its own
        content (rendered recursively), its end tag, and elements after it. If the element is
        replaced by another text, only the comments and this text. All text that has not changed is
        kept byte for byte.

        Args:
            tag: element with its changes.

        Raises:
            NotEditableError: new elements belong into an element with a self-closing tag.
        """
        indent = self._get_indentation(tag.begin)
        comments = [self._render_comment(text) + self._newline + indent for text in tag.before]
        if tag.text is not None:  # a text that replaces the element
            return b"".join([*comments, tag.text])
        if self._is_self_closing(tag) and (tag.within or tag.inserted):
            raise NotEditableError(f"{tag.name} has nothing in it")
        # A self-closing tag has no end tag, and `tag.end` is its end.
        closing = self.text[tag.end : self._find_end_of_element(tag)]
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
        """Return the text of the comments and elements that are inserted before all children.

        Each gets a line with the indentation of the other children.

        Args:
            tag: element with `within` and `inserted`.
            indent: indentation of the element itself; new children without others get two more
                blanks.
        """
        child_indent = (
            self._get_indentation(tag.children[0].begin) if tag.children else indent + b"  "
        )
        fragments = []
        inserted = [(child.before, format_element(child.name, child.new)) for child in tag.inserted]
        for comments, element in [*tag.within, *inserted]:
            lines = [self._render_comment(comment) for comment in comments]
            lines += [element.encode()] if element else []
            for line in lines:
                fragments += [self._newline + child_indent, line]
        return b"".join(fragments)

    def _render_start_tag(self, tag: XmlElement) -> bytes:
        """Return the changed start tag; unchanged attributes keep their spaces and quotes.

        Attributes are copied, replaced or left out in their order; new ones follow at the end.

        Args:
            tag: element with its new and removed attributes, and where it stands in the text.
        """
        text = self.text[tag.begin : tag.inside]
        offset = 1 + len(tag.name.encode())  # after "<" and the name
        fragments = [b"<", (tag.renamed or tag.name).encode()]
        written_names = set()
        while attribute_match := _ATTRIBUTE.match(text, offset):
            spaces, encoded_name, _ = attribute_match.groups()
            name = encoded_name.decode()
            if name in tag.new:
                fragments.append(spaces + _render_attribute(name, tag.new[name]))
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
