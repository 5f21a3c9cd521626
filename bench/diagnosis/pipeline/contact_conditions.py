"""Conditions on a diagnosis that depend on the contacts of a robot with its environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bench.diagnosis.explain_options import ExplainOptions
from sims.core.simulator import Simulator

if TYPE_CHECKING:
    from bench.diagnosis.kalman.linearised_filter import FollowedRuns

MAX_FORCE_SHARE_AT_CONTACTS = 1.0
"""Maximum missing force of a filter, as a share of the typical force, if the robot has contacts."""
MAX_JOINTS_OF_NONLINEAR_FILTER = 8
"""Maximum number of joints of a robot whose states in contact a cubature filter estimates."""
CONTACT_SEGMENT_SECONDS = 0.5
"""Duration in seconds of the segments of a robot on the ground."""


@dataclass(frozen=True)
class ContactConditions:
    """Conditions that depend on whether a simulated robot touches something.

    A robot on the ground has a recorded pose and stands or drives. Other robots may touch something
    with a gripper or a foot.

    Attributes:
        kind: class of the simulator, which need not be a robot.
    """

    kind: type[Simulator]

    @property
    def is_on_ground(self) -> bool:
        """Return whether the recorded pose is that of a robot that stands or drives."""
        return self.kind.has_model and bool(self._robot.is_on_ground)

    @property
    def has_contacts(self) -> bool:
        """Return whether geoms of a robot touch in the recording."""
        return self.kind.has_model and bool(self._robot.contacts)

    @property
    def has_contacts_off_ground(self) -> bool:
        """Return whether a robot touches something but does not stand on the ground."""
        return self.has_contacts and not self.is_on_ground

    @property
    def _robot(self) -> Any:
        kind: Any = self.kind
        return kind.robot

    @property
    def is_divisible(self) -> bool:
        """Return whether runs may be cut into segments: those of a robot with a recorded pose.

        Those of a robot on the ground are short already.
        """
        kind: Any = self.kind
        has_unknown_states = kind.has_model and bool(kind.system.required_state_units)
        return kind.has_model and not has_unknown_states and not self.is_on_ground

    def get_segment_duration(self, options: ExplainOptions) -> float | None:
        """Return the duration in seconds of the segments of each run; None for the usual ones.

        Runs of a robot on the ground are cut unless the user requests otherwise: a linear model
        about a simulated motion is not valid for long where contacts begin and end.
        """
        if options.pieces is not None or options.whole or not self.is_on_ground:
            return options.pieces
        return CONTACT_SEGMENT_SECONDS

    def needs_nonlinear_filter(self, filtered_runs: FollowedRuns) -> bool:
        """Return whether a robot is in contact, and its linear model fails there.

        The depth of a contact is smaller than the noise of most encoders, so that a model that is
        linearised about the readings has wrong contact forces. The filter then needs a missing
        force that is larger than all typical forces. A robot on the ground is linearised about a
        simulated motion instead. Another robot with many joints keeps the linear model, with
        process noise at its contacts: the nonlinear filter, whose time grows with the square of the
        number of joints, would take hours.

        Args:
            filtered_runs: the runs, followed by a Kalman filter with the linear model. It has the
                missing force (standard deviation of the process noise) and the typical force of
                each joint.
        """
        force_share = float((filtered_runs.force / filtered_runs.typical).max())
        has_few_joints = len(filtered_runs.typical) <= MAX_JOINTS_OF_NONLINEAR_FILTER
        # Negated, so that the NaN of a filter that diverged counts as wrong.
        is_wrong = not force_share <= MAX_FORCE_SHARE_AT_CONTACTS
        return self.has_contacts_off_ground and has_few_joints and is_wrong
