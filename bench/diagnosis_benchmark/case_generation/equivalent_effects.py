"""Effects that no recording of a system can distinguish.

Two effects are equivalent if they give exactly the same motion for some base parameters and initial
states. An answer that names an equivalent effect is graded apart from a wrong one
(`bench.diagnosis_benchmark.grading`), and a case never hides two equivalent effects.
"""

from __future__ import annotations

from typing import NamedTuple


class EquivalenceClass(NamedTuple):
    """Effects of a system that are equivalent to each other.

    Attributes:
        system: name of the system, such as ``pendulum``.
        driven: whether there is an input.
        effects: names of the effects, on a robot with their places: ``force.bias@elbow``.
    """

    system: str
    driven: bool
    effects: frozenset[str]


EQUIVALENT_EFFECTS = (
    # No accelerometer is recorded, so all accelerations of a ball are relative.
    EquivalenceClass("ball", False, frozenset({"force.bias", "gravity.scale", "clock.skew"})),
    EquivalenceClass("pendulum", True, frozenset({"force.bias", "input.bias"})),
    # The inertia absorbs what the two effects do not have in common.
    EquivalenceClass("pendulum", True, frozenset({"input.gain", "gravity.scale"})),
    EquivalenceClass("pendulum", False, frozenset({"force.bias", "input.bias"})),
    # A tilted gravity is rotated and scaled; the inertia absorbs the scale.
    EquivalenceClass("pendulum", False, frozenset({"gravity.tilt", "sensor.bias"})),
    EquivalenceClass("slider", True, frozenset({"gravity.tilt", "force.bias", "input.bias"})),
    # A motor that never reaches its limit converts an offset of the goal into a torque.
    EquivalenceClass("servo", True, frozenset({"force.bias", "input.bias"})),
    EquivalenceClass("arm2", True, frozenset({"force.bias@shoulder", "input.bias@m_shoulder"})),
    EquivalenceClass("arm2", True, frozenset({"force.bias@elbow", "input.bias@m_elbow"})),
    # The upper arm only turns about the shoulder, as the armature does.
    EquivalenceClass(
        "arm2", True, frozenset({"inertia.armature@shoulder", "inertia.scale@upper_arm"})
    ),
)
"""Classes of equivalent effects; the machines always have an input."""


def find_equivalent_effects(system: str, driven: bool, effect: str) -> frozenset[str]:
    """Return an effect and all effects that are equivalent to it: no recording distinguishes them.

    Args:
        system: name of the system, such as ``pendulum``.
        driven: whether there is an input; servo and arm2 always have one.
        effect: name of the effect, with its place on a robot: ``drag.linear@elbow``.
    """
    classes = (
        equivalence.effects
        for equivalence in EQUIVALENT_EFFECTS
        if (equivalence.system, equivalence.driven) == (system, driven)
        and effect in equivalence.effects
    )
    return frozenset({effect}).union(*classes)
