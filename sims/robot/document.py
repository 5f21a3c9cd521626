"""An MJCF as its author wrote it, with what it includes: the elements that a compiled model
numbers, and where they stand in which file.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sims.robot.markup import Markup, Tag, UnfitError
from sims.robot.stated import Element

_TWICE = ("replicate", "attach", "composite", "flexcomp", "model")
"""Elements that stand for several, or for those of another file."""

FILES = ("mesh", "texture", "hfield", "skin")
"""Elements that name a file."""

_DIRECTORIES = ("assetdir", "meshdir", "texturedir")


class Document:
    """An MJCF with all its files.

    Attributes:
        main: the outer file.
        root: its outermost element.

    Raises:
        UnfitError: a file is no XML, or is missing.
    """

    def __init__(self, text: bytes, path: Path) -> None:
        self.path = path
        self.main = Markup(text, path)
        self.root = self.main.root
        self._included: dict[Tag, Markup] = {}
        self._include(self.root)

    def _include(self, root: Tag) -> None:
        for tag in root.walk():
            name = tag.attributes.get("file")
            if tag.name != "include" or not name:
                continue
            path = self.path.parent / name
            try:
                inner = Markup(path.read_bytes(), path)
            except OSError:
                raise UnfitError(f"{name} cannot be read") from None
            self._included[tag] = inner
            self._include(inner.root)

    def children(self, tag: Tag) -> Iterator[Tag]:
        """The elements in an element, those of included files among them."""
        for child in tag.children:
            if child in self._included:
                yield from self.children(self._included[child].root)
            else:
                yield child

    def walk(self, tag: Tag | None = None) -> Iterator[Tag]:
        """All elements below one."""
        for child in self.children(tag or self.root):
            yield child
            yield from self.walk(child)

    def under(self, *names: str) -> list[Tag]:
        """All elements to which these names lead from the root."""
        found = [self.root]
        for name in names:
            found = [child for tag in found for child in self.children(tag) if child.name == name]
        return found

    def numbered(self, model: Any) -> dict[Element, Tag]:
        """The elements by their numbers in the compiled model.

        Raises:
            UnfitError: they are not those of the file.
        """
        for tag in self.walk():
            if tag.name in _TWICE:
                raise UnfitError(f"it has an element <{tag.name}>")
        bodies: list[Tag] = []
        joints: list[Tag] = []
        for world in self.under("worldbody"):
            self._body(world, bodies, joints)
        actuators = [child for tag in self.under("actuator") for child in self.children(tag)]
        found = {Element("body", i + 1): tag for i, tag in enumerate(bodies)}
        found |= {Element("joint", i): tag for i, tag in enumerate(joints)}
        found |= {Element("actuator", i): tag for i, tag in enumerate(actuators)}
        _compare(found, model, (len(bodies) + 1, len(joints), len(actuators)))
        return found

    def _body(self, tag: Tag, bodies: list[Tag], joints: list[Tag]) -> None:
        """Bodies depth first, and the joints of each before those of its children."""
        below: list[Tag] = []
        self._within(tag, below, joints)
        for body in below:
            bodies.append(body)
            self._body(body, bodies, joints)

    def _within(self, tag: Tag, bodies: list[Tag], joints: list[Tag]) -> None:
        for child in self.children(tag):
            if child.name == "body":
                bodies.append(child)
            elif child.name in ("joint", "freejoint"):
                joints.append(child)
            elif child.name == "frame":
                self._within(child, bodies, joints)

    def rooted(self, folder: Path) -> bool:
        """Let files be found from wherever the text is; whether it names any."""
        named = any(
            tag.name in FILES and any(key.startswith("file") for key in tag.attributes)
            for tag in self.walk()
        )
        if named:
            self._directories(folder)
        return named

    def _directories(self, folder: Path) -> None:
        stated: dict[str, str] = {}
        compilers = self.under("compiler")
        for compiler in compilers:
            stated |= {
                key: compiler.attributes[key] for key in _DIRECTORIES if key in compiler.attributes
            }
        both = stated.get("assetdir", "")
        found = {key: str(folder / stated.get(key, both)) for key in ("meshdir", "texturedir")}
        # What the last one says holds.
        if compilers:
            compilers[-1].new |= found
        else:
            said = " ".join(f'{key}="{value}"' for key, value in found.items())
            self.root.within.append(([], f"<compiler {said}/>"))

    def written(self) -> str:
        """The text with all changes; a file that changes stands in the place of its include."""
        self._settle(self.root)
        return self.main.whole().decode()

    def _settle(self, root: Tag) -> None:
        for tag in root.walk():
            inner = self._included.get(tag)
            if inner is None:
                continue
            self._settle(inner.root)
            name = tag.attributes["file"]
            if inner.root.changed:
                tag.before = [f"from here: {name}, with changes"]
                tag.text = inner.inner() + f"<!-- to here: {name} -->".encode()
            else:
                tag.new["file"] = str((self.path.parent / name).resolve())


def _compare(found: dict[Element, Tag], model: Any, counts: tuple[int, int, int]) -> None:
    """Refuse elements that are not those of the compiled model."""
    wanted = (model.nbody, model.njnt, len(model.actuator_ctrlnum))
    if counts != wanted:
        raise UnfitError("the compiled model has other elements")
    for (kind, i), tag in found.items():
        name = str(getattr(model, kind)(i).name)
        if tag.attributes.get("name", "") != name:
            raise UnfitError(f"the compiled model has its elements in another order ({name})")
