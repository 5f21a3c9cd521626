"""Convex hulls of collision meshes, and exclusion of spurious contacts.

A compiled mesh consists of vertices, faces, normals and a bounding volume hierarchy of its faces.
Contacts of convex geoms only read the vertices of the convex hull, the graph of the hull's edges
and its polygons (MuJoCo's documentation, "Computation", collision detection). The rest, nine tenths
of the memory, is for rendering, rays and signed distances.

MuJoCo's compiler would compute another hull from rounded vertices, and contacts would differ in
their eighth digit. So the graph, the polygons and the bounds of the original mesh are copied into
each compiled model, and contacts are bitwise equal.

The excluded contacts are those between the fixed base and the bodies attached to it, and those
between bodies that overlap at the zero position.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array
from sims.robot.mujoco_messages import format_name_list

MIN_FACES = 200
"""Minimum number of faces of a mesh that is replaced by its hull to save memory."""
CORE_SIZE_SHARE = 2.0**-6
"""Size of the box inside a hull that replaces its faces, as a share of the hull's half sizes."""
CORE_FACES = (
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
)  # fmt: skip
"""Triangles of a box whose corners are numbered by the signs of x, y and z."""
RESERVE_PREFIX = "simgap.reserve"
"""Prefix of the names of meshes that reserve memory for hulls that are copied into a model."""
BUFFER_SIZE_FIELDS = ("npolygonmax", "nmeshdegmax")
"""Size fields by which MuJoCo allocates buffers.

They are the maximum number of corners of a polygon, and of polygons at a vertex.
"""
TESTED_VERSION_PREFIX = "4.0."
"""Version prefix of MuJoCo whose compiled meshes have the layout that `write_hulls` writes.

With other versions, colliding meshes are kept unchanged.
"""

DOUBLE_PRECISION_GEOM_FIELDS = ("geom_size", "geom_aabb", "geom_rbound")
"""Geom fields that MuJoCo computes from vertices before it rounds them to single precision."""

Integers = NDArray[np.int32]


COMPARED_POSE_COUNT = 20
"""Number of poses in which contacts of whole meshes and of their hulls are compared."""


class Lists(NamedTuple):
    """Lists of integers, concatenated in one array.

    Attributes:
        values: all values.
        sizes: size of each list.
    """

    values: Integers
    sizes: Integers


@dataclass(frozen=True, eq=False)
class Hull:
    """The convex hull of a compiled mesh.

    Attributes:
        vertices: (V, 3) float32, in the mesh's own frame.
        graph: MuJoCo's `mesh_graph` of the hull; vertices are numbered from 0 to V - 1.
        normals: (P, 3) normals of its polygons.
        polygons: vertices of each polygon.
        around: polygons around each vertex.
        extrema: (27,) start vertices of the search for the furthest vertex in a direction.
    """

    vertices: NDArray[np.float32]
    graph: Integers
    normals: Array
    polygons: Lists
    around: Lists
    extrema: Integers


def read_hull(model: Any, mesh: int, keeps_all_vertices: bool = False) -> Hull | None:
    """Read the convex hull of a compiled mesh, which is all that contacts read of it.

    A reduced model that contains the hull needs less memory, and its contacts are bitwise equal.

    1. Read the graph of the hull's edges.
    2. Renumber its vertices, so that the others can be left out.
    3. Read the polygons of the hull.

    Args:
        model: compiled MuJoCo model (`mujoco.MjModel`).
        mesh: index of the mesh.
        keeps_all_vertices: keep vertices that are not on the hull, and the numbers of all vertices.

    Returns:
        The hull; None if the mesh has none, since no geom with it collides.
    """
    # 1. Graph.
    # MuJoCo's graph: the numbers of vertices and faces, then per vertex the address of its edges
    # and its number in the mesh, then the edges, then three vertices for each face.
    graph_address = int(model.mesh_graphadr[mesh])
    if graph_address < 0:
        return None
    vertex_count, face_count = model.mesh_graph[graph_address : graph_address + 2].tolist()
    graph: Integers = model.mesh_graph[
        graph_address : graph_address + 2 + 3 * vertex_count + 6 * face_count
    ].copy()
    # 2. Vertices.
    all_vertices = np.arange(model.mesh_vertnum[mesh], dtype=np.int32)
    # The vertices keep their order, as MuJoCo may compare the numbers of two vertices.
    kept_vertices = (
        all_vertices
        if keeps_all_vertices
        else np.sort(graph[2 + vertex_count : 2 + 2 * vertex_count])
    )
    new_numbers = np.full(all_vertices.size, -1, dtype=np.int32)
    new_numbers[kept_vertices] = np.arange(kept_vertices.size)
    for vertex_entries in (
        slice(2 + vertex_count, 2 + 2 * vertex_count),
        slice(graph.size - 3 * face_count, graph.size),
    ):
        graph[vertex_entries] = new_numbers[graph[vertex_entries]]
    # 3. Polygons.
    first_polygon = int(model.mesh_polyadr[mesh])
    polygon_rows = slice(first_polygon, first_polygon + int(model.mesh_polynum[mesh]))
    vertex_rows = int(model.mesh_vertadr[mesh]) + kept_vertices
    polygons = _gather_lists(
        model.mesh_polyvert,
        model.mesh_polyvertadr[polygon_rows],
        model.mesh_polyvertnum[polygon_rows],
    )
    return Hull(
        vertices=model.mesh_vert[vertex_rows],
        graph=graph,
        normals=model.mesh_polynormal[polygon_rows].copy(),
        polygons=polygons._replace(values=new_numbers[polygons.values]),
        around=_gather_lists(
            model.mesh_polymap,
            model.mesh_polymapadr[vertex_rows],
            model.mesh_polymapnum[vertex_rows],
        ),
        extrema=model.mesh_extrema[mesh].copy(),
    )


@dataclass(frozen=True, eq=False)
class CollisionShapes:
    """Data that models compiled from hulls copy from the model with the whole meshes.

    Attributes:
        hulls: hulls by name of the mesh.
        geoms: fields of geoms that have such a mesh, by the geom's name and the field.
        bounds: (N, 6) `bvh_aabb` of the bounding volume hierarchies of bodies, by body number.
    """

    hulls: Mapping[str, Hull]
    geoms: Mapping[str, Mapping[str, Array]]
    bounds: Mapping[int, Array]

    @classmethod
    def read(cls, model: Any, hulls: Mapping[str, Hull], geoms: Mapping[str, int]) -> Self:
        """Read the data from the model with the whole meshes.

        Args:
            model: model with the whole meshes.
            hulls: hulls by name of the mesh.
            geoms: numbers of the geoms in that model, by geom name.
        """
        fields = {
            name: {field: getattr(model, field)[i].copy() for field in DOUBLE_PRECISION_GEOM_FIELDS}
            for name, i in geoms.items()
        }
        bodies = {int(model.geom_bodyid[i]) for i in geoms.values()}
        return cls(
            hulls, fields, {body: _get_bounding_volumes(model, body).copy() for body in bodies}
        )

    def write(self, model: Any) -> None:
        """Write the data into a model with meshes of `add_hull` and `add_memory_reserve`.

        The stored hulls replace those that the compiler would compute from the meshes, which takes
        long.

        Args:
            model: Compiled model of MuJoCo; changed in place.
        """
        write_hulls(model, self.hulls)
        for name, fields in self.geoms.items():
            for field, values in fields.items():
                getattr(model, field)[model.geom(name).id] = values
        for body, bounds in self.bounds.items():
            compiled_bounds = _get_bounding_volumes(model, body)
            # The numbers of bounds differ if geoms that cannot collide were removed; then the
            # compiler's own bounds are equally valid.
            if compiled_bounds.shape == bounds.shape:
                compiled_bounds[:] = bounds


def _get_bounding_volumes(model: Any, body: int) -> Array:
    """Return the bounding volumes (N, 6) of a body, as a view into the model."""
    first = int(model.body_bvhadr[body])
    view: Array = model.bvh_aabb[first : first + int(model.body_bvhnum[body])]
    return view


def add_hull(spec: Any, name: str, hull: Hull) -> None:
    """Add a mesh to a spec that compiles to the hull's vertices in the hull's frame.

    MuJoCo moves a mesh into the principal frame of its faces. The added faces are those of a small
    box around the origin, whose frame is the hull's, so that no vertex moves.

    Args:
        spec: the mujoco.MjSpec; it is changed in place.
        name: name of the mesh.
        hull: hull to add.
    """
    import mujoco

    core_size = float(np.abs(hull.vertices).max()) * CORE_SIZE_SHARE
    # The principal moments must decrease from x to z, else MuJoCo would exchange the axes.
    sides = 2.0 ** np.floor(np.log2(core_size)) * np.array([0.25, 0.5, 1.0])
    signs = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    vertices = np.concatenate([hull.vertices.astype(float), sides * np.array(signs)])
    faces = np.array(CORE_FACES) + len(hull.vertices)
    mesh = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT


def add_memory_reserve(spec: Any, model: Any, full_model: Any, hulls: Mapping[str, Hull]) -> None:
    """Add meshes to a MuJoCo model so that its arrays are large enough for `write_hulls`.

    MuJoCo computes its own hulls when it compiles, which can have fewer elements than the original
    ones. The additional meshes, a sphere and a pyramid, reserve the difference.

    Args:
        spec: editable MuJoCo model with the meshes of `add_hull`; it is changed in place.
        model: model compiled from `spec`.
        full_model: model with the whole meshes.
        hulls: hulls by name of the mesh.
    """
    compiled_hulls = [read_hull(model, model.mesh(name).id) for name in hulls]
    missing_sizes = _count_hull_elements(hulls.values()) - _count_hull_elements(
        hull for hull in compiled_hulls if hull
    )
    if missing_sizes.max() > 0:
        # A hull of n vertices in general position has 2 n - 4 triangles, and so 15 n - 22 integers
        # in its graph, 2 n - 4 polygons and 6 n - 12 corners. MuJoCo merges some of them.
        count = int(1.5 * np.max(missing_sizes / (15, 2, 6))) + 8
        # A Fibonacci lattice: equal steps in height, each turned by the golden angle.
        z = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
        x, y = np.sqrt(1.0 - z**2) * _compute_rotations(
            np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
        )
        sphere = np.stack([x, y, z], axis=1)
        spec.add_mesh(name=f"{RESERVE_PREFIX}.sphere", uservert=sphere.ravel())
    if any(getattr(model, size) < getattr(full_model, size) for size in BUFFER_SIZE_FIELDS):
        # The base of a pyramid is a polygon with as many corners as the apex has sides.
        count = 8 + max(getattr(full_model, size) for size in BUFFER_SIZE_FIELDS)
        x, y = _compute_rotations(2.0 * np.pi * np.arange(count) / count)
        base = np.stack([x, y, np.zeros(count)], axis=1)
        pyramid = np.concatenate([base, [[0.0, 0.0, 1.0]]])
        spec.add_mesh(name=f"{RESERVE_PREFIX}.pyramid", uservert=pyramid.ravel())


def _compute_rotations(angles: Array) -> Array:
    """Return cosines and sines, (2, n)."""
    return np.stack([np.cos(angles), np.sin(angles)])


def has_large_enough_buffers(model: Any, full_model: Any) -> bool:
    """Return whether MuJoCo's contact buffers for a model are at least those for the whole meshes.

    With smaller buffers MuJoCo would write beyond their ends.

    Args:
        model: model with hulls.
        full_model: model with the whole meshes.
    """
    sizes = [name for name in dir(full_model) if name.startswith("n") and name.endswith("max")]
    return all(getattr(model, name) >= getattr(full_model, name) for name in sizes)


def write_hulls(model: Any, hulls: Mapping[str, Hull]) -> None:
    """Replace the hulls that MuJoCo's compiler has computed by those of the original meshes.

    The compiler computes them from rounded vertices, so contacts would differ in their eighth
    digit. The data of all hulls are written one after another into MuJoCo's arrays.

    Args:
        model: model compiled from a spec with meshes of `add_hull` and `add_memory_reserve`.
        hulls: hulls by name of the mesh.
    """
    names = [model.mesh(i).name for i in range(model.nmesh)]
    # All hulls are read before the first is written, since they move within MuJoCo's arrays.
    target_hulls = [
        hulls.get(name) or read_hull(model, i, keeps_all_vertices=True)
        for i, name in enumerate(names)
    ]
    # Ends of the data written so far in MuJoCo's arrays of graphs, polygons, polygon corners and
    # lists of the polygons at each vertex.
    graph_end = polygon_end = corner_end = polygon_list_end = 0
    for i, (name, hull) in enumerate(zip(names, target_hulls, strict=True)):
        model.mesh_graphadr[i] = -1
        model.mesh_polyadr[i], model.mesh_polynum[i] = polygon_end, 0
        if hull is None or name.startswith(RESERVE_PREFIX):
            continue
        model.mesh_graphadr[i] = graph_end
        model.mesh_extrema[i] = hull.extrema
        model.mesh_graph[graph_end : graph_end + hull.graph.size] = hull.graph
        graph_end += hull.graph.size
        address_range = slice(polygon_end, polygon_end + hull.polygons.sizes.size)
        model.mesh_polynum[i] = hull.polygons.sizes.size
        model.mesh_polynormal[address_range] = hull.normals
        first_indices, counts = (
            model.mesh_polyvertadr[address_range],
            model.mesh_polyvertnum[address_range],
        )
        corner_end = _write_lists(
            model.mesh_polyvert, first_indices, counts, hull.polygons, corner_end
        )
        polygon_end = address_range.stop
        first_vertex = int(model.mesh_vertadr[i])
        model.mesh_polymapnum[first_vertex : first_vertex + int(model.mesh_vertnum[i])] = 0
        address_range = slice(first_vertex, first_vertex + hull.around.sizes.size)
        first_indices, counts = (
            model.mesh_polymapadr[address_range],
            model.mesh_polymapnum[address_range],
        )
        polygon_list_end = _write_lists(
            model.mesh_polymap, first_indices, counts, hull.around, polygon_list_end
        )


def _count_hull_elements(hulls: Iterable[Hull]) -> Array:
    """Return the total numbers (3,) of graph integers, polygons and polygon corners of hulls."""
    sizes = [(h.graph.size, h.polygons.sizes.size, h.polygons.values.size) for h in hulls]
    total: Array = np.sum(np.array(sizes, dtype=float).reshape(-1, 3), axis=0)
    return total


def _gather_lists(values: Integers, first_indices: Integers, sizes: Integers) -> Lists:
    """Copy lists of the given begins and sizes out of a flat array.

    Args:
        values: flat array.
        first_indices: index of the first entry of each list.
        sizes: number of its entries.
    """
    list_ends = np.cumsum(sizes)
    indices = np.repeat(first_indices - list_ends + sizes, sizes) + np.arange(
        list_ends[-1] if list_ends.size else 0
    )
    return Lists(values[indices], sizes.copy())


def _write_lists(
    values: Integers, first_indices: Integers, sizes: Integers, lists: Lists, first: int
) -> int:
    """Write lists into an array from index `first` on; return the end index.

    Args:
        values: flat array, changed in place.
        first_indices: index of the first entry of each list, set in place.
        sizes: number of its entries, set in place.
        lists: the lists.
        first: index of the first entry of the first list.
    """
    list_ends = first + np.cumsum(lists.sizes)
    first_indices[:], sizes[:] = list_ends - lists.sizes, lists.sizes
    values[first : first + lists.values.size] = lists.values
    return first + lists.values.size


OVERLAP_DEPTH = 1e-4
"""Minimum overlap, in metres, at the zero position of two shapes that are not meant to touch."""


def exclude_spurious_contacts(spec: Any, model: Any) -> list[str]:
    """Exclude contacts of bodies that a model file lets overlap by construction.

    They would exert large forces that a real robot does not have. These are contacts between the
    fixed base and the bodies attached to it, and between bodies that overlap at the zero position.
    MuJoCo itself excludes contacts between a body and its parent, except if the parent is the
    world; the root of a URDF is fused to the world.

    Args:
        spec: editable MuJoCo model (`mujoco.MjSpec`), changed in place.
        model: compiled model of `spec`.

    Returns:
        Notes, one for each kind of excluded contact.
    """
    import mujoco

    bodies = model.geom_bodyid
    colliding_bodies = {
        int(body) for body, kind in zip(bodies, model.geom_contype, strict=True) if kind
    }
    base_children = []
    if 0 in colliding_bodies:
        base_children = [
            i for i in sorted(colliding_bodies) if i and int(model.body_parentid[i]) == 0
        ]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    overlapping_pairs = set()
    for contact in data.contact:
        pair = tuple(sorted(int(model.geom_bodyid[geom]) for geom in contact.geom))
        if contact.dist < -OVERLAP_DEPTH and not (pair[0] == 0 and pair[1] in base_children):
            overlapping_pairs.add(pair)
    names = [model.body(i).name for i in range(model.nbody)]
    for first, second in [*((0, i) for i in base_children), *sorted(overlapping_pairs)]:
        spec.add_exclude(bodyname1=names[first], bodyname2=names[second])
    notes = []
    if base_children:
        listing = format_name_list([names[i] for i in base_children])
        notes.append(f"no contacts between the fixed base and the bodies attached to it: {listing}")
    if overlapping_pairs:
        names[0] = "the base"
        pairs = [
            f"{names[first]} and {names[second]}" for first, second in sorted(overlapping_pairs)
        ]
        notes.append(
            "no contacts between parts that overlap at the zero position: "
            f"{format_name_list(pairs)}"
        )
    return notes


def can_collide(model: Any) -> bool:
    """Return whether any two shapes of a compiled model can collide."""
    return bool(model.nflex or find_colliding_geoms(model).any())


def find_colliding_geoms(model: Any) -> NDArray[np.bool_]:
    """Find the geoms of a compiled model that can collide with another geom.

    The pairs are filtered by MuJoCo's own rules (its documentation, "Computation", collision
    detection).

    Args:
        model: the mujoco.MjModel, without flexes.

    Returns:
        (ngeom,) whether each geom can collide.
    """
    import mujoco

    weld = np.asarray(model.body_weldid)
    bodies = np.asarray(model.geom_bodyid)
    geom_rows = (bodies, model.geom_contype, model.geom_conaffinity)
    # Many geoms of a body have equal masks; equal rows are merged to keep the matrices small.
    (body, contype, affinity), row_indices = np.unique(
        np.stack(geom_rows), axis=1, return_inverse=True
    )
    masks = contype[:, None] & affinity
    can_collide = (masks | masks.T) != 0
    weld_ids = weld[body]
    can_collide &= weld_ids[:, None] != weld_ids
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        # MuJoCo excludes contacts between a body and its parent, except if the parent is the world.
        parent_weld = weld[np.asarray(model.body_parentid)[weld_ids]]
        is_parent_pair = (
            (parent_weld[:, None] == weld_ids) & (weld_ids != 0) & (weld_ids[:, None] != 0)
        )
        can_collide &= ~(is_parent_pair | is_parent_pair.T)
    first, second = np.minimum(body[:, None], body), np.maximum(body[:, None], body)
    can_collide &= ~np.isin((first << 16) + second, model.exclude_signature)
    result: NDArray[np.bool_] = can_collide.any(axis=1)[row_indices.reshape(-1)]
    result[[*model.pair_geom1, *model.pair_geom2]] = True
    return result


def has_equal_contacts(
    model: Any,
    reduced_model: Any,
    numbers: Mapping[str, int],
    joint_ranges: Mapping[int, tuple[float, float]],
) -> bool:
    """Return whether contacts with convex hulls equal those with whole meshes, in random poses.

    The test is needed since other versions of MuJoCo may read more of a mesh than hulls contain.

    Args:
        model: compiled model with whole meshes.
        reduced_model: model with hulls.
        numbers: numbers of the whole model's geoms, by geom name.
        joint_ranges: ranges of hinges and slides in rad or m, by the address of their position.
    """
    import mujoco

    rng = np.random.default_rng(0)
    data, reduced_data = mujoco.MjData(model), mujoco.MjData(reduced_model)
    geom_numbers = np.array(
        [numbers[reduced_model.geom(i).name] for i in range(reduced_model.ngeom)]
    )
    for _ in range(COMPARED_POSE_COUNT):
        data.qpos[:] = model.qpos0
        for address, joint_range in joint_ranges.items():
            data.qpos[address] = rng.uniform(*joint_range)
        reduced_data.qpos[:] = data.qpos
        for posed_model, posed_data in ((model, data), (reduced_model, reduced_data)):
            mujoco.mj_fwdPosition(posed_model, posed_data)
        full_contacts, reduced_contacts = data.contact, reduced_data.contact
        if data.ncon != reduced_data.ncon or not (
            np.array_equal(full_contacts.geom, geom_numbers[reduced_contacts.geom])
            and np.array_equal(full_contacts.dist, reduced_contacts.dist)
            and np.array_equal(full_contacts.pos, reduced_contacts.pos)
            and np.array_equal(full_contacts.frame, reduced_contacts.frame)
        ):
            return False
    return True
