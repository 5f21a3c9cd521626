"""Convex hulls of collision meshes.

A compiled mesh consists of vertices, faces, normals and a bounding volume hierarchy of its faces.
Contacts of convex geoms only read the vertices of the convex hull, the graph of the hull's edges
and its polygons (MuJoCo's documentation, "Computation", collision detection). The rest, nine tenths
of the memory, is for rendering, rays and signed distances.

MuJoCo's compiler would compute another hull from rounded vertices, and contacts would differ in
their eighth digit. So the graph, the polygons and the bounds of the original mesh are copied into
each compiled model, and contacts are bitwise equal.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sims.core.simulator import Array

if TYPE_CHECKING:
    from typing_extensions import Self

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
    """Read the convex hull of a compiled mesh: all that contacts read of the mesh.

    A model that contains the hulls instead of the meshes needs less memory, and its contacts are
    bitwise equal. The steps are:

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
    # MuJoCo's graph of n vertices and f faces is one array of integers: n and f; the address of the
    # edges of each vertex (n); the number of each vertex in the mesh (n); the edges (n + 3 f); and
    # three vertices for each face (3 f).
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
    # The two parts of the graph that have numbers of vertices in the mesh: the list of vertices and
    # the faces. They get the new numbers.
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

        They are rounded differently in a model that is compiled from hulls.

        Args:
            model: compiled model with the whole meshes.
            hulls: hulls by name of the mesh.
            geoms: numbers of the geoms that have such a mesh, by name.
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
        """Write the data into a compiled model with meshes of `add_hull` and `add_memory_reserve`.

        The original hulls, geom fields and bounds replace those of the compiler, which are rounded
        differently.

        Args:
            model: compiled MuJoCo model (`mujoco.MjModel`); changed in place.
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
    """Add a mesh with a hull's vertices to an editable model, so that compilation keeps them.

    When MuJoCo compiles a mesh, it moves the vertices into the principal frame of the faces (that
    of their inertia), which would round them. So the only faces are those of a small box around the
    origin of the mesh and along its axes. The principal frame of the box is the frame of the mesh,
    and no vertex moves. Contacts use the vertices of the hull, and not the faces.

    Args:
        spec: editable MuJoCo model (`mujoco.MjSpec`); it is changed in place.
        name: name of the mesh.
        hull: hull to add.
    """
    import mujoco

    box_size = float(np.abs(hull.vertices).max()) * CORE_SIZE_SHARE
    # The principal moments must decrease from x to z, else MuJoCo would exchange the axes. Powers
    # of two are exact.
    half_sides = 2.0 ** np.floor(np.log2(box_size)) * np.array([0.25, 0.5, 1.0])
    corner_signs = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    vertices = np.concatenate([hull.vertices.astype(float), half_sides * np.array(corner_signs)])
    faces = np.array(CORE_FACES) + len(hull.vertices)
    mesh = spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT


def add_memory_reserve(spec: Any, model: Any, full_model: Any, hulls: Mapping[str, Hull]) -> None:
    """Add unused meshes to a model, so that its arrays are large enough for `write_hulls`.

    MuJoCo allocates memory for the hulls that it computes when it compiles. These can be smaller
    than the original ones, which are written over them later. Two additional meshes reserve the
    difference, where it is needed:

    * A sphere with many vertices makes the arrays of all hulls longer.
    * A pyramid, whose base has many corners, makes the buffers for single polygons longer.

    Args:
        spec: editable MuJoCo model with the meshes of `add_hull`; it is changed in place.
        model: model compiled from `spec`.
        full_model: model with the whole meshes.
        hulls: hulls by name of the mesh.
    """
    compiled_hulls = [read_hull(model, model.mesh(name).id) for name in hulls]
    # Graph integers, polygons and polygon corners.
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

    The model's size fields ``n...max`` state them. With smaller buffers MuJoCo would write beyond
    their ends.

    Args:
        model: model with hulls.
        full_model: model with the whole meshes.
    """
    sizes = [name for name in dir(full_model) if name.startswith("n") and name.endswith("max")]
    return all(getattr(model, name) >= getattr(full_model, name) for name in sizes)


def write_hulls(model: Any, hulls: Mapping[str, Hull]) -> None:
    """Replace the hulls that MuJoCo's compiler has computed by those of the original meshes.

    The compiler computes them from rounded vertices, so contacts would differ in their eighth
    digit. MuJoCo stores the hulls of all meshes one after another in common arrays, with the
    address of each mesh. So all of them are written again, mesh after mesh: first the graph, then
    the polygons, then for each vertex the polygons around it. Meshes without a hull, and those that
    only reserve memory, get the address -1 for the graph, and no polygons.

    Args:
        model: model compiled from a spec with meshes of `add_hull` and `add_memory_reserve`;
            changed in place.
        hulls: original hulls by name of the mesh; other meshes keep their own.
    """
    names = [model.mesh(i).name for i in range(model.nmesh)]
    # All hulls are read before the first is written, since they move within MuJoCo's arrays. Meshes
    # without an original hull keep that of the compiler.
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
        # Graph.
        model.mesh_graphadr[i] = graph_end
        model.mesh_extrema[i] = hull.extrema
        model.mesh_graph[graph_end : graph_end + hull.graph.size] = hull.graph
        graph_end += hull.graph.size
        # Polygons. The indices and counts are views, in which `_write_lists` writes.
        polygon_rows = slice(polygon_end, polygon_end + hull.polygons.sizes.size)
        model.mesh_polynum[i] = hull.polygons.sizes.size
        model.mesh_polynormal[polygon_rows] = hull.normals
        first_indices = model.mesh_polyvertadr[polygon_rows]
        counts = model.mesh_polyvertnum[polygon_rows]
        corner_end = _write_lists(
            model.mesh_polyvert, first_indices, counts, hull.polygons, corner_end
        )
        polygon_end = polygon_rows.stop
        # Polygons around each vertex; vertices that are not on the hull have none.
        first_vertex = int(model.mesh_vertadr[i])
        model.mesh_polymapnum[first_vertex : first_vertex + int(model.mesh_vertnum[i])] = 0
        vertex_rows = slice(first_vertex, first_vertex + hull.around.sizes.size)
        first_indices = model.mesh_polymapadr[vertex_rows]
        counts = model.mesh_polymapnum[vertex_rows]
        polygon_list_end = _write_lists(
            model.mesh_polymap, first_indices, counts, hull.around, polygon_list_end
        )


def _count_hull_elements(hulls: Iterable[Hull]) -> Array:
    """Return the total numbers (3,) of graph integers, polygons and polygon corners of hulls."""
    sizes = [(h.graph.size, h.polygons.sizes.size, h.polygons.values.size) for h in hulls]
    total: Array = np.sum(np.array(sizes, dtype=float).reshape(-1, 3), axis=0)
    return total


def _gather_lists(values: Integers, first_indices: Integers, sizes: Integers) -> Lists:
    """Copy lists, which lie anywhere in a flat array, into one array without gaps.

    Args:
        values: flat array that contains the lists.
        first_indices: (n,) index of the first entry of each of n lists.
        sizes: (n,) number of its entries.
    """
    list_ends = np.cumsum(sizes)
    # Distance by which each list lies further back in `values` than in the result.
    offsets = first_indices - (list_ends - sizes)
    indices = np.repeat(offsets, sizes) + np.arange(list_ends[-1] if list_ends.size else 0)
    return Lists(values[indices], sizes.copy())


def _write_lists(
    values: Integers, first_indices: Integers, sizes: Integers, lists: Lists, first: int
) -> int:
    """Write lists one after another into an array of MuJoCo.

    Args:
        values: flat array, changed in place.
        first_indices: (n,) index of the first entry of each list, set in place.
        sizes: (n,) number of its entries, set in place.
        lists: the n lists.
        first: index in `values` at which the first list begins.

    Returns:
        Index after the last entry.
    """
    list_ends = first + np.cumsum(lists.sizes)
    first_indices[:], sizes[:] = list_ends - lists.sizes, lists.sizes
    values[first : first + lists.values.size] = lists.values
    return first + lists.values.size


def has_equal_contacts(
    model: Any,
    reduced_model: Any,
    numbers: Mapping[str, int],
    joint_ranges: Mapping[int, tuple[float, float]],
) -> bool:
    """Return whether contacts with convex hulls equal those with whole meshes, in random poses.

    The test is needed since other versions of MuJoCo may read more of a mesh than hulls contain.
    Number, geoms, distances, points and frames of the contacts must be bitwise equal. The random
    poses are the same in every call.

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
