"""Draw a robot at a pose, rendered or as links and joints, with places of a verdict marked.

The robot is rendered if this machine can do so, else drawn as links and joints; places are marked
identically in both. Labels are arranged in columns at both sides, each connected to its place by a
line, so that no label covers another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.figures.camera_view import Projection, choose_projection, make_posed_data
from bench.figures.figure_layout import make_panel_grid
from bench.figures.label_text import break_name
from bench.figures.offscreen_rendering import render_robot
from bench.figures.style import BLUE, CAPTION_GREY, NEUTRAL_MARK, NULL_LEVEL_GREY
from sims.core.simulator import Array, InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sims.robot.robot_model import Joint, RobotModel


JOINT_AXIS_LENGTH_SHARE = 0.07
"""Length of a joint's axis to either side, as a fraction of the picture's size."""
MIN_VISIBLE_AXIS_SHARE = 0.25
"""Minimum length of the projected joint axis of length 1; a shorter axis points at the viewer."""


def draw_skeleton(axis: Axes, robot: RobotModel, data: Any, view: Projection) -> None:
    """Draw links as lines between joint anchors, and joints as dots with a tick along each axis.

    Args:
        axis: Axes to draw on.
        robot: Model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        data: MuJoCo data at the pose.
        view: Camera view.
    """
    for start, end in compute_link_segments(robot, data):
        line = view.project(np.stack([start, end]))
        axis.plot(
            *line.T,
            color=NULL_LEVEL_GREY,
            linewidth=5,
            solid_capstyle="round",
            zorder=1,
            clip_on=False,
        )
    for point in _find_base_points(robot, data):
        x, y = view.project(point[None])[0]
        axis.plot(x, y, "s", color=CAPTION_GREY, markersize=11, zorder=2)
    for joint in robot.joints:
        _draw_joint(axis, joint, data, view)


def compute_link_segments(robot: RobotModel, data: Any) -> list[tuple[Array, Array]]:
    """Compute the end points (3,) of each link in the world, in m.

    A link extends from the joint of a moving body to that of each child body. The link of a body
    without child bodies extends to the end of the body. Static bodies have no links.

    Args:
        robot: Model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        data: MuJoCo data at the pose.
    """
    model = robot.compiled
    # A body that is welded to the world, body 0, is static.
    moving_bodies = [body for body in range(1, model.nbody) if int(model.body_weldid[body])]
    parents = [int(model.body_parentid[body]) for body in moving_bodies]
    # No link is drawn from the origin of the world.
    segments = [
        (_find_link_start(model, data, parent), _find_link_start(model, data, body))
        for body, parent in zip(moving_bodies, parents, strict=True)
        if parent
    ]
    for body in moving_bodies:
        if body not in parents:
            start = _find_link_start(model, data, body)
            segments.append((start, _find_link_end(model, data, body, start)))
    return segments


def _find_link_start(model: Any, data: Any, body: int) -> Array:
    """Return (3,) the anchor of a body's first joint, or the body's origin without a joint.

    Args:
        model: compiled model (`mujoco.MjModel`).
        data: its state at the pose (`mujoco.MjData`).
        body: number of the body.
    """
    first = int(model.body_jntadr[body])
    return np.array(data.xanchor[first] if first >= 0 else data.xpos[body])


def _find_link_end(model: Any, data: Any, body: int, start: Array) -> Array:
    """Return (3,) the end of a body without child bodies.

    It is the middle of a face of its shapes' bounding boxes, the one furthest from the joint;
    without shapes, it is the joint mirrored at the centre of mass.

    Args:
        model: compiled model (`mujoco.MjModel`).
        data: its state at the pose (`mujoco.MjData`).
        body: number of the body.
        start: (3,) anchor of its first joint, m.
    """
    # Middles of the faces of the bounding boxes of its shapes.
    face_points: list[Array] = []
    for geom in range(model.ngeom):
        if int(model.geom_bodyid[geom]) != body:
            continue
        rotation = data.geom_xmat[geom].reshape(3, 3)
        middle = data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3]
        half_extents = rotation * model.geom_aabb[geom, 3:]
        face_points += [*(middle + half_extents.T), *(middle - half_extents.T)]
    if not face_points:
        return np.array(2 * data.xipos[body] - start)

    def distance(point: Array) -> float:
        # Without rounding, numerical errors would decide between equally distant points.
        return round(float(np.linalg.norm(point - start)), 9)

    return np.array(max(face_points, key=distance))


def _find_base_points(robot: RobotModel, data: Any) -> list[Array]:
    """Return the (3,) points where moving bodies are fixed to static ones, without free bodies.

    Args:
        robot: model of the robot.
        data: state at the pose (`mujoco.MjData`).
    """
    model = robot.compiled
    free_bodies = {
        int(model.jnt_bodyid[joint.id]) for joint in robot.joints if joint.kind == "free"
    }
    points = []
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        # A body that is welded to the world, body 0, is static.
        is_moving, has_static_parent = model.body_weldid[body] != 0, model.body_weldid[parent] == 0
        if is_moving and has_static_parent and body not in free_bodies:
            # The origin of the world may be far away, so the body's own joint is used for it.
            points.append(
                np.array(data.xpos[parent]) if parent else _find_link_start(model, data, body)
            )
    return points


def _draw_joint(axis: Axes, joint: Joint, data: Any, view: Projection) -> None:
    """Draw a joint as a circle, or as a square if it is prismatic, with its axis as a dashed line.

    `data` is the mujoco.MjData of the pose: `xanchor` and `xaxis` have the position (m) and the
    axis of each joint in the world.

    Args:
        axis: Axes to draw on.
        joint: Joint of the robot.
        data: State of MuJoCo in the drawn pose.
        view: Projection to the picture.
    """
    anchor = data.xanchor[joint.id]
    x, y = view.project(anchor[None])[0]
    if joint.has_one_coordinate:
        projected_axis = view.axes[:2] @ data.xaxis[joint.id]
        # An axis that points at the viewer has no direction to draw.
        if float(np.linalg.norm(projected_axis)) > MIN_VISIBLE_AXIS_SHARE:
            reach = JOINT_AXIS_LENGTH_SHARE * max(view.width, view.height) * projected_axis
            middle = np.array([x, y])
            end_points = np.stack([middle - reach, middle + reach])
            axis.plot(
                *end_points.T, color=NEUTRAL_MARK, linewidth=1.3, linestyle=(0, (3, 1.2)), zorder=3
            )
    shape = "s" if joint.kind == "slide" else "o"
    axis.plot(
        x,
        y,
        shape,
        color=NEUTRAL_MARK,
        markerfacecolor="white",
        markersize=7,
        markeredgewidth=1.4,
        zorder=4,
    )


MAX_SIDE_INCHES = 4.4
"""Length of the longer side of the drawing, in inches."""
MIN_LABEL_COLUMN_INCHES = 1.0
"""Minimum width of a column of labels, in inches."""
LETTER_WIDTH_INCHES = 0.083
"""Average width of a letter of a label, in inches."""
SCALE_BAR_HEIGHT_INCHES = 0.55
"""Height below the drawing for the scale bar, in inches."""
MAX_NAMED_JOINTS = 12
"""Maximum number of joints that are all named; with more, only marked joints are named."""
MAX_LABEL_LINE_LENGTH = 34
"""Maximum length of a line of a label, in characters."""
MAX_LABEL_LENGTH = 120
"""Maximum length of a text in a label, which may have several lines, in characters."""
_LINE_SPACING = 0.155
"""Distance between lines of a label, in inches."""
_LABEL_SPACING = 0.09
"""Distance between labels, in inches."""
_MARKER_BY_PLACE_KIND: Mapping[str, tuple[str, float]] = {
    "joint": ("o", 17.0),
    "actuator": ("s", 22.0),
    "body": ("D", 17.0),
    "channel": ("^", 25.0),
}
"""Marker shape and size in points by the kind of place.

The sizes differ so that two marks at one place are both visible.
"""


@dataclass(frozen=True)
class PlaceMark:
    """A place to mark.

    Attributes:
        kind: ``joint``, ``actuator``, ``body`` or ``channel``.
        name: Name of the place.
        says: Effect at the place, such as ``Coulomb friction``; may be empty.
        is_certain: Whether the place is certain; it is drawn dashed if it may be another place.
    """

    kind: str
    name: str
    says: str = ""
    is_certain: bool = True


class _Label(NamedTuple):
    """A label of a place.

    Attributes:
        lines: Its lines.
        point: (2,) place in the picture, in metres.
        kind: Kind of the place, as of a `PlaceMark`.
        is_marked: Whether the place is marked.
        is_certain: Whether a mark of the place is certain.
    """

    lines: tuple[str, ...]
    point: Array
    kind: str
    is_marked: bool
    is_certain: bool

    @property
    def height(self) -> float:
        """Height in inches."""
        return _LINE_SPACING * len(self.lines) + _LABEL_SPACING


def draw_robot_figure(
    robot: RobotModel,
    positions: Mapping[str, float],
    marks: Sequence[PlaceMark] = (),
) -> Figure:
    """Draw the robot at a pose, with places marked.

    The robot is rendered if it has shapes, otherwise drawn as a skeleton. Labels of joints and
    marked places are in two columns at its sides, with a scale bar below. The axes are in metres,
    the layout is in inches.

    Args:
        robot: Robot to draw.
        positions: Positions by joint, rad or m; other joints keep the position of the model file.
        marks: Places to mark; places that the robot does not have are ignored.
    """
    data = make_posed_data(robot, dict(positions))
    projection = choose_projection(robot, data)
    labels = _make_labels(robot, data, projection, marks)
    left_labels, right_labels = _divide_labels(labels)
    # Scale of the picture in inches per metre; all other sizes are in inches.
    scale = MAX_SIDE_INCHES / max(projection.width, projection.height)
    width, height = scale * projection.width, scale * projection.height
    left_width, right_width = map(_compute_column_width, (left_labels, right_labels))
    drawing_height = max(
        height, _compute_column_height(left_labels), _compute_column_height(right_labels)
    )
    figure_width = left_width + width + right_width
    # 0.15 inches are the space above the scale bar.
    figure_height = drawing_height + SCALE_BAR_HEIGHT_INCHES + 0.15
    figure, axes = make_panel_grid(1, 1, (figure_width, figure_height), layout=None)
    axis = axes[0, 0]
    # Left, bottom, width and height as shares of the figure; the picture is centred vertically.
    bottom = SCALE_BAR_HEIGHT_INCHES + (drawing_height - height) / 2
    axis.set_position(
        (
            left_width / figure_width,
            bottom / figure_height,
            width / figure_width,
            height / figure_height,
        )
    )
    axis.set_axis_off()
    half_width, half_height = projection.width / 2, projection.height / 2
    axis.set(xlim=(-half_width, half_width), ylim=(-half_height, half_height))
    axis.set_autoscale_on(False)

    _draw_robot(axis, robot, data, projection)
    _draw_place_rings(axis, labels)
    gap = 0.12 / scale  # 0.12 inches between the picture and its labels
    _draw_label_column(axis, left_labels, -half_width - gap, scale, drawing_height)
    _draw_label_column(axis, right_labels, half_width + gap, scale, drawing_height)
    _draw_scale_bar(axis, projection, scale, drawing_height)
    return figure


def _draw_robot(axis: Axes, robot: RobotModel, data: Any, projection: Projection) -> None:
    """Draw the rendered robot with thin lines along its links, or else its skeleton.

    The skeleton is drawn if the robot has no shapes, or this machine cannot render it.

    Args:
        axis: axes to draw on, in metres.
        robot: model of the robot.
        data: state at the pose (`mujoco.MjData`).
        projection: camera.
    """
    image = None
    if _has_shapes(robot):
        image = render_robot(robot.compiled, data.qpos.copy(), projection)
    if image is None:
        draw_skeleton(axis, robot, data, projection)
        return
    half_width, half_height = projection.width / 2, projection.height / 2
    axis.imshow(
        image,
        extent=(-half_width, half_width, -half_height, half_height),
        zorder=0,
        aspect="auto",
    )
    # Shapes may be missing between joints, if their meshes are absent or were never drawn.
    for segment in compute_link_segments(robot, data):
        line = projection.project(np.stack(segment))
        axis.plot(*line.T, color=CAPTION_GREY, linewidth=0.7, zorder=3)
    dots = projection.project(np.array([data.xanchor[joint.id] for joint in robot.joints]))
    axis.plot(*dots.T, "o", color=NEUTRAL_MARK, markersize=3.5, zorder=4)


def compute_joint_positions(
    figure: Figure, robot: RobotModel, positions: Mapping[str, float]
) -> list[tuple[str, float, float]]:
    """Compute the positions of the joints in a figure of the robot, to highlight them on a page.

    Args:
        figure: Figure made by `draw_robot_figure`.
        robot: Model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        positions: Positions by joint of that figure.

    Returns:
        Name of each joint, and its position as fractions of width and height from the top left.
    """
    data = make_posed_data(robot, dict(positions))
    projection = choose_projection(robot, data)
    axis = figure.axes[0]
    joint_positions = []
    for joint in robot.joints:
        point = projection.project(data.xanchor[joint.id][None])[0]
        pixels = axis.transData.transform(point)
        x_share, y_share = (pixels / figure.bbox.size).tolist()
        joint_positions.append((joint.name, x_share, 1.0 - y_share))
    return joint_positions


def _has_shapes(robot: RobotModel) -> bool:
    """Return whether there is anything to render; a robot without its meshes has no shapes."""
    model = robot.compiled
    return any(int(model.body_weldid[body]) for body in model.geom_bodyid.tolist())


def _make_labels(
    robot: RobotModel, data: Any, projection: Projection, marks: Sequence[PlaceMark]
) -> list[_Label]:
    """Make a label for each marked place, and for the other joints if the robot has few.

    Several marks of one place share a label, with a line for each. A mark at a place that the
    robot does not have is left out.

    Args:
        robot: model of the robot.
        data: state at the pose (`mujoco.MjData`), from which places are located.
        projection: camera.
        marks: places that the verdict names.
    """
    marks_by_place: dict[tuple[str, str], list[PlaceMark]] = {}
    for mark in marks:
        marks_by_place.setdefault((mark.kind, mark.name), []).append(mark)
    if len(robot.joints) <= MAX_NAMED_JOINTS:
        for joint in robot.joints:
            if joint.name not in robot.base_joints:
                marks_by_place.setdefault(("joint", joint.name), [])
    labels = []
    for (kind, name), place_marks in marks_by_place.items():
        place = locate_place(robot, data, kind, name)
        if place is None:
            continue
        # A name without a kind is a joint's.
        title = name if kind == "joint" else f"{kind} {name}"
        texts = dict.fromkeys([title, *(mark.says for mark in place_marks if mark.says)])
        lines = [
            line
            for text in texts
            for line in break_name(text[:MAX_LABEL_LENGTH], MAX_LABEL_LINE_LENGTH).split("\n")
        ]
        point = projection.project(place[None])[0]
        is_certain = any(mark.is_certain for mark in place_marks)
        labels.append(_Label(tuple(lines), point, kind, bool(place_marks), is_certain))
    return labels


def _divide_labels(labels: Sequence[_Label]) -> tuple[list[_Label], list[_Label]]:
    """Divide labels between the left and the right column, each from top to bottom.

    Each label is on the side of its place in the picture. But a column is not longer than the
    drawing, unless both columns are: then labels near the middle move to the other side.
    """

    def get_sort_key(label: _Label) -> tuple[float, float]:
        """Return a sort key from left to right, and from top to bottom."""
        x, y = label.point.tolist()
        return x, -y

    def is_too_long(column: Sequence[_Label], other: Sequence[_Label]) -> bool:
        return _compute_column_height(column) > max(MAX_SIDE_INCHES, _compute_column_height(other))

    from_left = sorted(labels, key=get_sort_key)
    left = [label for label in from_left if label.point[0] < 0]
    right = from_left[len(left) :]
    # The last label on the left and the first one on the right are nearest to the middle.
    while is_too_long(left, right):
        right.insert(0, left.pop())
    while is_too_long(right, left):
        left.append(right.pop(0))
    return _sort_downwards(left), _sort_downwards(right)


def _compute_column_height(labels: Sequence[_Label]) -> float:
    return sum(label.height for label in labels)


def _compute_column_width(labels: Sequence[_Label]) -> float:
    """Return the width of a column in inches: its longest line and the connecting line."""
    if not labels:
        return 0.3
    longest = max(len(line) for label in labels for line in label.lines)
    # 0.3 inches are margins at both sides of the letters.
    return max(MIN_LABEL_COLUMN_INCHES, 0.3 + LETTER_WIDTH_INCHES * longest)


def _sort_downwards(labels: Sequence[_Label]) -> list[_Label]:
    return sorted(labels, key=lambda label: -label.point[1])


def arrange_labels(
    wanted_positions: Sequence[float], sizes: Sequence[float], low: float, high: float
) -> Array:
    """Compute (N,) middles of labels that do not overlap, close to the wanted ones.

    A pass from the top moves each label down until it is below the previous one. A pass from the
    bottom then moves those up that left the column.

    Args:
        wanted_positions: (N,) wanted middles, from top to bottom.
        sizes: (N,) heights of the labels.
        low: Lower end of the column.
        high: Upper end of the column, which has space for all labels.
    """
    middles = np.array(wanted_positions, dtype=np.float64)
    ceiling = high
    for label_index, size in enumerate(sizes):
        middles[label_index] = min(middles[label_index], ceiling - size / 2)
        ceiling = middles[label_index] - size / 2
    floor = low
    for label_index in reversed(range(len(middles))):
        middles[label_index] = max(middles[label_index], floor + sizes[label_index] / 2)
        floor = middles[label_index] + sizes[label_index] / 2
    return middles


def _draw_label_column(
    axis: Axes, labels: Sequence[_Label], x: float, scale: float, drawing_height: float
) -> None:
    """Write a column of labels, and a line from each to its place in the picture.

    The labels keep the heights of their places as far as they do not overlap.

    Args:
        axis: axes of the figure, in metres.
        labels: labels from top to bottom.
        x: horizontal position of the column, m.
        scale: inches per metre.
        drawing_height: height of the drawing, and of the column, in inches.
    """
    # Heights in metres of the picture.
    sizes = [label.height / scale for label in labels]
    half_height = drawing_height / scale / 2
    place_heights = [float(y) for _, y in (label.point for label in labels)]
    middles = arrange_labels(place_heights, sizes, -half_height, half_height)
    for label, y in zip(labels, middles.tolist(), strict=True):
        colour = "black" if label.is_marked else CAPTION_GREY
        axis.annotate(
            "\n".join(label.lines),
            tuple(label.point),
            (x, y),
            ha="right" if x < 0 else "left",
            va="center",
            fontsize=9 if label.is_marked else 8,
            weight="bold" if label.is_marked else "normal",
            color=colour,
            annotation_clip=False,
            parse_math=False,
            zorder=6,
            arrowprops={
                "arrowstyle": "-",
                "color": colour,
                "linewidth": 0.9 if label.is_marked else 0.5,
                "shrinkA": 2,
                "shrinkB": 9 if label.is_marked else 3,
            },
        )


def _draw_place_rings(axis: Axes, labels: Sequence[_Label]) -> None:
    """Draw a ring around each marked place: dashed if the data allow other places as well.

    Args:
        axis: axes to draw on.
        labels: labels of all places.
    """
    for label in labels:
        if not label.is_marked:
            continue
        shape, size = _MARKER_BY_PLACE_KIND.get(label.kind, _MARKER_BY_PLACE_KIND["joint"])
        x, y = label.point.tolist()
        # Markers cannot be dashed, so a ring is a scatter plot of one point.
        axis.scatter(
            x,
            y,
            s=size**2,
            marker=shape,
            facecolors="none",
            edgecolors=BLUE,
            linewidths=2.4,
            linestyles="-" if label.is_certain else (0, (1.6, 1.0)),
            zorder=5,
            clip_on=False,
        )


def _draw_scale_bar(
    axis: Axes, projection: Projection, scale: float, drawing_height: float
) -> None:
    """Draw a scale bar with a round length below the drawing.

    Args:
        axis: axes to draw on.
        projection: camera, with the displayed width in metres.
        scale: inches per metre.
        drawing_height: height of the drawing in inches.
    """
    # In metres; the bar is at most 0.3 of the picture's width, and 0.2 inches below it.
    length = round_down_length(0.3 * projection.width)
    left_edge = -projection.width / 2
    y = -drawing_height / scale / 2 - 0.2 / scale
    axis.plot(
        [left_edge, left_edge + length],
        [y, y],
        color=NEUTRAL_MARK,
        linewidth=2.2,
        solid_capstyle="butt",
        clip_on=False,
    )
    axis.text(
        left_edge + length / 2, y - 0.06 / scale, f"{length:g} m", ha="center", va="top", fontsize=8
    )


def round_down_length(length: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most `length`, in metres."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length))


def locate_place(robot: RobotModel, data: Any, kind: str, name: str) -> Array | None:
    """Return (3,) the position of a place of the robot in metres.

    Args:
        robot: Model of the robot: joints, bodies, actuators, and the compiled MuJoCo model.
        data: MuJoCo data at the pose.
        kind: ``joint``, ``actuator``, ``body`` or ``channel``.
        name: Name of the place.

    Returns:
        The position; None if the robot has no such place.
    """
    # The robot raises an InputError for a name that it does not have.
    try:
        if kind == "body":
            return np.array(data.xipos[robot.body(name).id])
        if kind == "actuator":
            return _get_actuator_position(robot, data, name)
        if kind == "channel":
            return _place_of_channel(robot, data, name)
        return np.array(data.xanchor[robot.joint(name).id])
    except InputError:
        return None


def _get_actuator_position(robot: RobotModel, data: Any, name: str) -> Array | None:
    """Return the position (3,) in the world of the joint or the site that an actuator drives.

    The figure marks an effect of the actuator there. An actuator on a tendon or a body has no
    single point, so the result is None.

    Args:
        robot: model of the robot.
        data: state at the pose (`mujoco.MjData`).
        name: name of the actuator.
    """
    import mujoco

    actuator = robot.actuator(name)
    if actuator.joint is not None:
        return np.array(data.xanchor[robot.joint(actuator.joint).id])
    # MuJoCo's `trntype` and `trnid` are the kind and the index of the element that is driven.
    if int(robot.compiled.actuator_trntype[actuator.id]) != int(mujoco.mjtTrn.mjTRN_SITE):
        return None
    return np.array(data.site_xpos[int(robot.compiled.actuator_trnid[actuator.id, 0])])


def _place_of_channel(robot: RobotModel, data: Any, name: str) -> Array | None:
    """Return the position (3,) in the world that belongs to a channel; None if it has none.

    It is that of the joint, or of the body or site on which a sensor is mounted.

    Args:
        robot: model of the robot.
        data: state at the pose (`mujoco.MjData`).
        name: name of the channel, such as ``q.elbow`` or ``s.gyro``.
    """
    import mujoco

    quantity, _, place_name = name.partition(".")
    # The names of sensors' channels begin with "s."; all other channels are those of joints.
    if quantity != "s":
        return locate_place(robot, data, "joint", place_name)
    sensor = next((sensor for sensor in robot.sensors if sensor.name == place_name), None)
    if sensor is None:
        return None
    model = robot.compiled
    # MuJoCo's sensor whose data contain this address; the name may be that of one component.
    sensor_id = int(np.searchsorted(model.sensor_adr, sensor.address, side="right")) - 1
    object_id, object_type = (
        int(model.sensor_objid[sensor_id]),
        int(model.sensor_objtype[sensor_id]),
    )
    positions_by_type = {
        int(mujoco.mjtObj.mjOBJ_SITE): data.site_xpos,
        int(mujoco.mjtObj.mjOBJ_JOINT): data.xanchor,
        int(mujoco.mjtObj.mjOBJ_BODY): data.xipos,
        int(mujoco.mjtObj.mjOBJ_XBODY): data.xpos,
    }
    if object_type in positions_by_type:
        return np.array(positions_by_type[object_type][object_id])
    return None
