"""MJCF source document with its included files.

It relates the elements of the source text to their numbers in the compiled model, and compiles it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sims.core.freed_memory import release_free_memory
from sims.robot.export.mjcf_attributes import ModelElement
from sims.robot.export.xml_editing import NotEditableError, XmlElement, XmlText, format_element
from sims.robot.mujoco_messages import capture_mujoco_warnings

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

        Args:
            root: root element of a file whose include elements are followed.
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

        So a change of the compiled model leads to the element in the text. Bodies, joints and
        actuators are found by their order, which is that of the text. Geoms are found by their
        names, and contact pairs by those of their geoms; unnamed ones are left out.

        Args:
            model: compiled MuJoCo model (`mujoco.MjModel`).

        Returns:
            Element of the text by kind and number in the compiled model.

        Raises:
            NotEditableError: the compiled model has other elements than the text, or the text has
                elements that generate others.
        """
        for tag in self.walk():
            if tag.name in _UNSUPPORTED_ELEMENTS:
                raise NotEditableError(f"it has an element <{tag.name}>")
        # By order.
        bodies: list[XmlElement] = []
        joints: list[XmlElement] = []
        for world in self.find_elements("worldbody"):
            self._collect_bodies(world, bodies, joints)
        actuators = [
            child for tag in self.find_elements("actuator") for child in self.children(tag)
        ]
        # Body 0 is the world.
        tags_by_element = {ModelElement("body", i): tag for i, tag in enumerate(bodies, start=1)}
        tags_by_element |= {ModelElement("joint", i): tag for i, tag in enumerate(joints)}
        tags_by_element |= {ModelElement("actuator", i): tag for i, tag in enumerate(actuators)}
        # The world counts as a body of the model.
        _check_elements_match_model(
            tags_by_element, model, (len(bodies) + 1, len(joints), len(actuators))
        )
        # By name. A pair is known by the names of its two geoms, in any order.
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
        """Collect the bodies and joints below a body, in the order in which MuJoCo numbers them.

        It is depth first; the joints of a body come before those of its child bodies.

        Args:
            tag: the body, whose own joints are included.
            bodies: list to which bodies are appended.
            joints: list to which joints are appended.
        """
        child_bodies: list[XmlElement] = []
        self._append_children(tag, child_bodies, joints)
        for body in child_bodies:
            bodies.append(body)
            self._collect_bodies(body, bodies, joints)

    def _append_children(
        self, tag: XmlElement, bodies: list[XmlElement], joints: list[XmlElement]
    ) -> None:
        """Append the bodies and joints directly within a body to two lists, in document order.

        An element ``<frame>`` only groups its contents, so they count as contents of the body.

        Args:
            tag: the body, or a frame in it.
            bodies: list to which child bodies are appended.
            joints: list to which joints are appended.
        """
        for child in self.children(tag):
            if child.name == "body":
                bodies.append(child)
            elif child.name in ("joint", "freejoint"):
                joints.append(child)
            elif child.name == "frame":
                self._append_children(child, bodies, joints)

    def make_paths_absolute(self, folder: Path) -> bool:
        """Make the folders of assets absolute, so that the text can be loaded from anywhere.

        Without asset files, nothing is changed.

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
        """State absolute mesh and texture folders, so that the document can be stored elsewhere.

        They are written into the last compiler element, or into a new one. The folder of meshes or
        textures is that of its own attribute, else ``assetdir``, else that of the model file.

        Args:
            folder: folder of the model file, to which stated folders are relative.
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
            self.root.insert_within(format_element("compiler", absolute_folders))

    def to_text(self) -> str:
        """Return the text with all changes; changed files replace their include elements."""
        self._prepare_includes(self.root)
        return self.main.to_text().decode()

    def _prepare_includes(self, root: XmlElement) -> None:
        """Prepare each include element below an element for writing.

        A changed file is inserted in place of its include element, between two comments. An
        unchanged file stays included, with its absolute path. Files that an included file includes
        are prepared before it, since they may change it.

        Args:
            root: root element of a file.
        """
        for tag in root.walk():
            inner = self._included.get(tag)
            if inner is None:  # not an include element
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
    for (kind, number), tag in tags_by_element.items():
        # The model has methods with the names of the kinds: body, joint and actuator.
        name = str(getattr(model, kind)(number).name)
        if tag.attributes.get("name", "") != name:
            raise NotEditableError(f"the compiled model has its elements in another order ({name})")


def compile_mjcf(text: str) -> Any:
    """Compile an MJCF text without printing MuJoCo's warnings.

    Raises:
        NotEditableError: MuJoCo rejects the text.
    """
    import mujoco

    try:
        with capture_mujoco_warnings():
            model = mujoco.MjSpec.from_string(text).compile()
    except ValueError as error:
        message = " ".join(str(error).split()).removeprefix("Error: ")
        raise NotEditableError(f"MuJoCo does not compile it ({message})") from None
    # The discarded spec held all meshes a second time.
    release_free_memory()
    return model
