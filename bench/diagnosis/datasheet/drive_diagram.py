"""Drive and back-drive diagram: forces at which a drive at rest moves a load, holds it, or slips.

U is the force of the motor, and P is the load that it works against, both along the joint. Dry
friction holds the joint while the net force is below the total limit F of all friction laws at rest
(M. Duclusaud et al., 2024, arXiv:2410.08650, section III). F may depend on U and P. f is the sum of
all other forces at rest:

    U - P + f >  F(U, P)    moves forward                                                       (1)
    U - P + f < -F(U, P)    moves back: where P > 0 the load drives the motor                   (2)

In between, the joint holds. The laws are those of the registered effects, evaluated at rest.
`compute_drive_diagram` finds the boundaries, and `draw_diagram` draws them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from bench.diagnosis.datasheet.datasheet_joint import SheetSubject
from bench.diagnosis.report.cause_and_value_text import format_number, format_unit
from bench.figures import style
from sims import effects as library
from sims.core.effect import Effect, Force, Friction, HiddenStateEffect
from sims.core.simulator import Array
from sims.core.system import StateSnapshot, System, SystemKind
from sims.extended_simulator import ExtendedSimulator

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOAD_POINT_COUNT = 201
"""Number of loads on the diagram."""
BISECTION_STEPS = 80
"""Number of bisection steps for each boundary."""
MAX_FORCE_FACTOR = 1e3
"""Range in which boundary forces are searched, as a multiple of the diagram's range."""
ROUNDING_SHARE = 1e-12
"""Share of the search range below which a force counts as zero."""
DEFAULT_LOAD_FACTOR = 4.0
"""Range of the diagram for a drive without a force limit, as a multiple of the friction without
load.
"""


class _StaticJoint(System):
    """Joint at rest with given drive force and load, at which effects are evaluated."""

    name = "bench"
    says = "a joint between a drive and a load"
    kind: ClassVar[SystemKind] = "rotary"
    coordinates = ("q",)
    rates = ("qd",)

    def weight(self, moment: StateSnapshot) -> Array:
        """Return the load as a force that acts against the drive."""
        return -self.passive(moment)

    def drive(self, moment: StateSnapshot) -> Array:
        """Return the given drive force."""
        return moment.inputs["drive"]

    def passive(self, moment: StateSnapshot) -> Array:
        """Return the given load."""
        return moment.inputs["load"]


class _Slide(_StaticJoint):
    """Prismatic joint at rest with given drive force and load."""

    kind: ClassVar[SystemKind] = "linear"


@dataclass(frozen=True)
class DriveDiagram:
    """Drive and back-drive diagram.

    Attributes:
        unit: Unit of all forces.
        load: (N,) loads that the drive works against.
        forward: (N,) drive forces above which the joint moves forward; infinite if it locks itself.
        back: (N,) drive forces below which the joint moves back.
        breakaway: Drive force that moves the joint without a load.
        backdrive: Load that moves the joint without drive force; infinite if no load does.
        laws: Names of the effects that are included.
        axis_limit: Range of the axes.
        without: Names of effects at the joint that have a hidden state, so no law at rest.
    """

    unit: str
    load: Array
    forward: Array
    back: Array
    breakaway: float
    backdrive: float
    laws: tuple[str, ...]
    axis_limit: float
    without: tuple[str, ...] = ()

    def to_document(self) -> dict[str, Any]:
        """Return the diagram with the names of its laws as TOML data.

        Of each curve, about ten evenly spaced points are returned.
        """
        return {
            "unit": self.unit,
            "laws": list(self.laws),
            "breakaway": self.breakaway,
            "backdrive": self.backdrive,
            "load": self.load[:: LOAD_POINT_COUNT // 10].tolist(),
            "forward": self.forward[:: LOAD_POINT_COUNT // 10].tolist(),
            "back": self.back[:: LOAD_POINT_COUNT // 10].tolist(),
        }


def compute_drive_diagram(
    subject: SheetSubject, extended: ExtendedSimulator, force_limit: float | None
) -> DriveDiagram:
    """Compute the diagram of a joint: the drive forces at which it starts to move, for each load.

    With the motor's force U, the load P, all other forces f at rest and the friction limit F, the
    joint moves forward if U - P + f > F(U, P) (1), and back if U - P + f < -F(U, P) (2). The
    boundaries are the zeros of these balances, found by bisection, since F may depend on U and P.

    Args:
        subject: Joint or system.
        extended: Extended simulator.
        force_limit: Force limit of the drive; None if it has none.
    """
    joint = _Joint(subject, extended)
    zero = np.zeros(1)
    no_load_friction = float(joint.compute_friction_limit(zero, zero).item())
    # Without friction either, any range shows the diagram.
    load_range = force_limit or DEFAULT_LOAD_FACTOR * no_load_friction or 1.0
    load = np.linspace(-load_range, load_range, LOAD_POINT_COUNT)
    search_range = MAX_FORCE_FACTOR * load_range

    def forward_balance(u: Array, p: Array) -> Array:
        """Return U - P + f - F, positive where the joint moves forward."""
        return u - p + joint.sum_other_forces(u, p) - joint.compute_friction_limit(u, p)  # (1)

    def backward_balance(u: Array, p: Array) -> Array:
        """Return U - P + f + F, negative where the joint moves back."""
        return u - p + joint.sum_other_forces(u, p) + joint.compute_friction_limit(u, p)  # (2)

    def unpowered_balance(p: Array) -> Array:
        """Return a balance that is zero where a load p starts to drive the unpowered motor.

        The sign is reversed, so that it increases with the load, as the bisection requires.
        """
        return -backward_balance(np.zeros_like(p), p)

    return DriveDiagram(
        unit="N" if joint.system.kind == "linear" else "N*m",
        load=load,
        forward=_find_roots(lambda u: forward_balance(u, load), search_range, LOAD_POINT_COUNT),
        back=_find_roots(lambda u: backward_balance(u, load), search_range, LOAD_POINT_COUNT),
        breakaway=_find_roots(lambda u: forward_balance(u, zero), search_range, 1).item(),
        backdrive=_find_roots(unpowered_balance, search_range, 1).item(),
        laws=joint.names,
        axis_limit=load_range,
        without=joint.without,
    )


def _find_roots(function: Callable[[Array], Array], search_range: float, count: int) -> Array:
    """Find zeros (N,) of increasing functions by bisection, all at once.

    A function that is still not positive at the upper end has its zero at infinity; one that is
    positive at the lower end, at minus infinity.

    Args:
        function: values (N,) of N increasing functions at points (N,).
        search_range: largest absolute value of a zero.
        count: number N of functions.
    """
    low, high = np.full(count, -search_range), np.full(count, search_range)
    # Tested before the bisection, which moves both ends.
    is_never_positive, is_always_positive = function(high) <= 0, function(low) > 0
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (low + high)
        is_positive = function(middle) > 0
        low, high = np.where(is_positive, low, middle), np.where(is_positive, middle, high)
    # A root within the rounding error of the bisection is set to exactly zero.
    root: Array = np.where(np.abs(high) < ROUNDING_SHARE * search_range, 0.0, 0.5 * (low + high))
    root[is_always_positive] = -np.inf
    root[is_never_positive] = np.inf
    return root


class _Joint:
    """Friction and force laws of a joint, evaluated at rest."""

    def __init__(self, subject: SheetSubject, extended: ExtendedSimulator) -> None:
        """Collect the static force and friction laws that the extended simulator has at the joint.

        `laws` has each law with its K coefficients (K, 1, 1). `without` names the laws with a
        hidden state, which have no fixed force at rest; the diagram omits them. `stated` is the
        Coulomb friction in the model file, in N or N·m; 0 if there is none.

        Args:
            subject: joint or system of the data sheet.
            extended: extended simulator with the fitted effects.
        """
        self.system = _Slide() if subject.is_prismatic else _StaticJoint()
        self.laws: list[tuple[Effect, Array]] = []
        self.without: tuple[str, ...] = ()
        values_by_effect: dict[str, dict[str, float]] = {}
        for name, coefficients in extended.effects.items():
            for effect, coefficient, fitted_value in subject.localise_effect(name, coefficients):
                values_by_effect.setdefault(effect, {})[coefficient] = fitted_value.value
        for name, values in values_by_effect.items():
            law = library.get_effect(name.partition("@")[0])
            if issubclass(law, HiddenStateEffect):
                self.without = (*self.without, law.name)
            # The law of a drive changes the drive force, which is given here.
            elif law.at == "joint" and issubclass(law, Friction | Force):
                law_values = np.array([values.get(c.name, 0.0) for c in law.coefficients])
                self.laws.append((law(), law_values[:, None, None]))
        file_friction = None
        if subject.joint:
            file_friction = subject.get_model_file_value(f"friction.coulomb@{subject.joint}")
        self.stated = 0.0 if file_friction is None else file_friction.value
        self.names = tuple(law.name for law, _ in self.laws)

    def compute_friction_limit(self, drive: Array, load: Array) -> Array:
        """Compute the largest force (N,) that the friction of the joint can hold at rest.

        It is the sum over all friction laws.

        Args:
            drive: (N,) forces of the drive, in N or N·m.
            load: (N,) loads that it works against.
        """
        moment = self._make_rest_state(drive, load)
        limits = [np.full(len(drive), self.stated)]
        for law, coefficients in self.laws:
            if isinstance(law, Friction):
                limits.append(law.limit(_expand_coefficients(coefficients, drive), moment)[:, 0])
        holding_force: Array = np.maximum(np.sum(limits, axis=0), 0.0)
        return holding_force

    def sum_other_forces(self, drive: Array, load: Array) -> Array:
        """Compute the sum (N,) of the forces on the joint at rest that are not friction.

        An example is a constant bias. The drive force and the load are not included.

        Args:
            drive: (N,) forces of the drive, in N or N·m.
            load: (N,) loads that it works against.
        """
        moment = self._make_rest_state(drive, load)
        forces = [np.zeros(len(drive))]
        for law, coefficients in self.laws:
            if isinstance(law, Force):
                forces.append(law.force(_expand_coefficients(coefficients, drive), moment)[:, 0])
        total_force: Array = np.sum(forces, axis=0)
        return total_force

    def _make_rest_state(self, drive: Array, load: Array) -> StateSnapshot:
        """Build the state of the joint at rest, under N pairs of drive force and load.

        Friction and force laws are evaluated at this state, a batch of N elements with position,
        velocity and time zero.

        Args:
            drive: (N,) forces of the drive, in N or N·m.
            load: (N,) loads that it works against.
        """
        zeros = np.zeros((len(drive), 1))
        inputs = {"drive": drive[:, None], "load": load[:, None]}
        return StateSnapshot(
            self.system, np.zeros((len(drive), 0)), {}, zeros, zeros, zeros, inputs
        )


def _expand_coefficients(c: Array, drive: Array) -> Array:
    """Expand coefficients (K, 1, 1) to (K, N, 1), one for each force.

    Args:
        c: (K, 1, 1) coefficients of a law.
        drive: (N,) forces of the drive, of which only the number counts.
    """
    return np.broadcast_to(c, (len(c), len(drive), 1))


def draw_diagram(axes: Axes, diagram: DriveDiagram) -> None:
    """Draw the diagram: where the joint moves, holds and slips, by load and motor force.

    The region above the forward boundary is forward motion, below the backward boundary back
    motion; in between the joint holds. The dotted diagonal is the force that balances the load.
    Marks show the break-away force and the load that moves the joint back.

    Args:
        axes: Axes to draw on.
        diagram: Diagram to draw.
    """
    load_range, unit = diagram.axis_limit, format_unit(diagram.unit)
    load = diagram.load
    # Infinite boundaries are drawn beyond the axes.
    beyond_axes = 2 * load_range
    forward, backward = (
        np.clip(boundary, -beyond_axes, beyond_axes) for boundary in (diagram.forward, diagram.back)
    )
    axes.fill_between(load, forward, beyond_axes, color=style.PALE_BLUE, linewidth=0)
    axes.fill_between(load, backward, forward, color=style.HELD_OUT_GREY, linewidth=0)
    axes.fill_between(load, -beyond_axes, backward, color=style.PALE_RUST, linewidth=0)
    axes.plot(load, forward, color=style.BLUE, linewidth=1.5)
    axes.plot(load, backward, color=style.VERMILION, linewidth=1.5, linestyle=(0, (5, 2)))
    axes.plot(load, load, color=style.CONNECTOR_GREY, linewidth=0.8, linestyle=":")
    axes.axhline(0.0, color=style.ZERO_LINE_GREY, linewidth=0.6)
    axes.axvline(0.0, color=style.ZERO_LINE_GREY, linewidth=0.6)
    for force, position, marker in (
        (diagram.breakaway, (0.0, diagram.breakaway), "o"),
        (diagram.backdrive, (diagram.backdrive, 0.0), "s"),
    ):
        if 0 < force <= load_range:
            axes.plot(
                *position, marker=marker, color=style.NEUTRAL_MARK, markersize=5, linestyle="none"
            )
            text = f" {format_number(force)} {unit}"
            axes.annotate(text, position, xytext=(4, 4), textcoords="offset points")
    text_style: dict[str, Any] = {"ha": "center", "va": "center", "color": style.CAPTION_GREY}
    # Places of the labels in the regions of the diagram, as shares of the range of its axes.
    axes.text(-0.55 * load_range, 0.75 * load_range, "moves forward", **text_style)
    axes.text(0.55 * load_range, -0.75 * load_range, "moves back", **text_style)
    axes.text(0.72 * load_range, 0.25 * load_range, "back-driven:\nthe load slips", **text_style)
    # The region in which the joint holds is labelled where it is wide enough.
    middle = 0.62 * load_range
    if np.interp(middle, load, forward - backward) > 0.15 * load_range:
        axes.text(middle, middle, "holds", **text_style)
    axes.set(
        xlim=(-load_range, load_range),
        ylim=(-load_range, load_range),
        xlabel=f"load [{unit}]",
        ylabel=f"force of the motor [{unit}]",
    )
    axes.set_title("Drive and back-drive, at rest", fontsize=9, loc="left")
