"""Elements that effects add to a robot's model: joints in series, tendons, and pairs of geoms."""

from __future__ import annotations

from sims.core.effect import ActiveEffects, Effect
from sims.robot.contact_pairs import add_contact_pairs
from sims.robot.coupled_drives import (
    COUPLING_EFFECT,
    COUPLING_PLACEHOLDER,
    list_coupling_places,
    make_coupled_robot,
)
from sims.robot.dynamics.series_joints import SeriesJoints, add_series_joints, is_series_effect
from sims.robot.model_simplification import strip_shapes
from sims.robot.mujoco_messages import format_mujoco_error
from sims.robot.robot_model import RobotModel, cache_per_robot

CONTACT_PAIR = "contact"
"""Name in `AddedElements`, in place of an effect, for the element `<pair>` of two geoms."""


AddedElements = tuple[tuple[str, str], ...]
"""Added elements, as pairs of place and effect.

`COUPLING_PLACEHOLDER` stands for the tendons of all coupled drives.
"""


def list_added_elements(effect: Effect | type[Effect]) -> AddedElements:
    """List the elements that the model needs for an effect at one place."""
    if effect.of == COUPLING_EFFECT:
        return (COUPLING_PLACEHOLDER,)
    if is_series_effect(effect):
        return ((effect.place, effect.of),)
    return tuple((pair, CONTACT_PAIR) for pair in effect.pairs)


def group_by_added_elements(acting: ActiveEffects, count: int) -> dict[AddedElements, list[int]]:
    """Group batch elements by the model elements that their effects add, such as a second joint.

    Each group needs a model and a batch of its own. Batch elements without such effects are a group
    too, with the key ().

    Args:
        acting: effects with K coefficients each, (K, L, 1).
        count: number L of batch elements.

    Returns:
        Indices of the batch elements of each group, by the elements to add to the model.
    """
    # Model elements that an effect adds, and in which batch elements (L,) the effect is active.
    additions = []
    for effect, c in acting:
        added = list_added_elements(effect)
        if added:
            # An effect in series with a joint is off where its first coefficient is not above zero,
            # any other one where all coefficients are zero.
            is_active = (c[0] > 0) if is_series_effect(effect) else (c != 0).any(axis=0)
            additions.append((added, is_active[:, 0]))
    groups: dict[AddedElements, list[int]] = {}
    for batch_index in range(count):
        # Several effects may add one element, which counts once. A dict keeps the order.
        elements = dict.fromkeys(
            element for added, is_active in additions if is_active[batch_index] for element in added
        )
        groups.setdefault(tuple(elements), []).append(batch_index)
    return groups


def add_elements(robot: RobotModel, added: AddedElements) -> RobotModel:
    """Add the model elements that effects need: contact pairs, coupling tendons, joints in series.

    The numbers of these elements are neutral, so that no motion changes until effects write them
    for each batch element. Existing names do not change.

    Args:
        robot: robot as read from its model file.
        added: the elements as pairs of place and effect: (contact, `CONTACT_PAIR`),
            (joint, effect in series), or `COUPLING_PLACEHOLDER` for the tendons of all coupled
            drives. With none of them, the robot itself is returned.
    """
    robot = add_contact_pairs(robot, [place for place, effect in added if effect == CONTACT_PAIR])
    if COUPLING_PLACEHOLDER in added:
        # With a coupling of zero a drive moves its own joint only.
        robot = make_coupled_robot(robot, dict.fromkeys(list_coupling_places(robot), 0.0))
    series: SeriesJoints = tuple(
        (place, effect) for place, effect in added if effect not in (CONTACT_PAIR, COUPLING_EFFECT)
    )
    return add_series_joints(robot, series) if series else robot


@cache_per_robot
def find_compile_error(robot: RobotModel, added: AddedElements) -> str:
    """Return MuJoCo's reason why the model with added elements does not compile; empty if it does.

    The model is compiled without shapes, which takes little time.

    Args:
        robot: robot as read from its model file.
        added: joints in series and tendons, as pairs of place and effect.
    """
    try:
        # The model is compiled when this property is first read.
        add_elements(strip_shapes(robot), added).compiled  # noqa: B018
    # MuJoCo raises several kinds of errors, and an effect of a user's plugin may raise any.
    except Exception as error:
        return format_mujoco_error(error) or type(error).__name__
    return ""
