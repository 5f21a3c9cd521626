"""Tests of the drive and back-drive diagram against closed-form solutions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from bench.core.plugin_registries import effects, simulators
from bench.diagnosis.datasheet.datasheet import DataSheet
from bench.diagnosis.datasheet.datasheet_joint import make_subject
from bench.diagnosis.datasheet.drive_diagram import DriveDiagram, compute_drive_diagram
from sims.extended_simulator import ExtendedSimulator, FittedValue
from tests.bench.diagnosis.datasheet.drive_recordings import FRICTION

DRY, LOADED, SIDEWAYS = 0.05, 0.25, 0.02


def of(effects: Mapping[str, Mapping[str, float]], strongest: float | None = 1.0) -> DriveDiagram:
    kind = simulators.get("servo")
    numbers = {
        name: {key: FittedValue(value, "1", None, None) for key, value in given.items()}
        for name, given in effects.items()
    }
    extended = ExtendedSimulator("x", "servo", "batch", "", {}, numbers, {}, ("q",), kind)  # type: ignore[arg-type]
    return compute_drive_diagram(make_subject(kind, None), extended, strongest)  # type: ignore[arg-type]


def test_dry_friction_holds_a_band() -> None:
    found = of({"friction.coulomb": {"coefficient": DRY}})
    np.testing.assert_allclose(found.forward, found.load + DRY, atol=1e-9)
    np.testing.assert_allclose(found.back, found.load - DRY, atol=1e-9)
    assert (found.breakaway, found.backdrive) == pytest.approx((DRY, DRY))


def test_friction_of_the_load_opens_a_cone() -> None:
    """U - P = c |U + P| + d, so the joint moves forward beyond U = (P (1 + c) + d) / (1 - c)."""
    found = of({"friction.coulomb": {"coefficient": DRY}, "friction.load": {"coefficient": LOADED}})
    against = found.load > 0
    ahead = (found.load * (1 + LOADED) + DRY) / (1 - LOADED)
    back = (found.load * (1 - LOADED) - DRY) / (1 + LOADED)
    np.testing.assert_allclose(found.forward[against], ahead[against], atol=1e-9)
    beyond = found.load > DRY / (1 - LOADED)
    np.testing.assert_allclose(found.back[beyond], back[beyond], atol=1e-9)
    # Without power, only the load presses on the gears.
    assert found.backdrive == pytest.approx(DRY / (1 - LOADED))


def test_a_drive_that_locks_itself_is_turned_by_no_load() -> None:
    found = of({"friction.load": {"coefficient": 1.2}})
    assert np.isinf(found.forward[found.load > 0]).all()
    assert np.isinf(found.backdrive)


def test_what_pulls_at_rest_shifts_it() -> None:
    effects = {
        "friction.coulomb": {"coefficient": DRY},
        "force.bias": {"coefficient": SIDEWAYS},
        "drag.linear": {"coefficient": 3.0},
    }
    found = of(effects)
    assert found.breakaway == pytest.approx(DRY - SIDEWAYS)
    assert found.backdrive == pytest.approx(DRY + SIDEWAYS)


def test_it_reaches_as_far_as_the_drive(sheet: DataSheet) -> None:
    stall = next(row.number for row in sheet.rows if row.name == "stall torque")
    assert stall is not None
    assert sheet.diagram.axis_limit == stall.value
    assert sheet.diagram.breakaway == pytest.approx(FRICTION, rel=0.05)
    assert sheet.document()["diagram"]["laws"] == ["friction.coulomb"]


@pytest.mark.parametrize(
    "name", [effect.name for effect in make_subject(simulators.get("servo"), None).list_effects()]
)
def test_every_effect_of_the_library_has_its_place_in_it(name: str) -> None:
    """Each effect, added to dry friction, gives a finite break-away torque and an ordered band."""
    coefficients = effects.get(name).on(simulators.get("servo").system)
    law = {c.name: 0.02 for c in coefficients}
    dry = {"friction.coulomb": {"coefficient": DRY}}
    found = of({**dry, name: law})
    assert np.isfinite(found.breakaway)
    assert found.breakaway > 0
    assert (found.forward >= found.back).all()


def test_what_has_a_state_of_its_own_is_said_to_be_left_out() -> None:
    law = {c.name: 0.02 for c in effects.get("friction.hysteresis").coefficients}
    found = of({"friction.hysteresis": law})
    assert found.without == ("friction.hysteresis",)
    assert found.laws == ()
