"""Tests of the conditions on a diagnosis of a robot that touches something."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.pipeline.contact_conditions import (
    MAX_JOINTS_OF_NONLINEAR_FILTER,
    ContactConditions,
)


@pytest.mark.parametrize(
    ("contacts", "is_on_ground", "joints", "force_share", "expected"),
    [
        (("floor/finger",), False, 3, 2.0, True),
        (("floor/finger",), False, 3, 0.5, False),
        (("floor/finger",), False, 3, np.nan, True),
        (("floor/finger",), False, MAX_JOINTS_OF_NONLINEAR_FILTER, 2.0, True),
        # The nonlinear filter of a large robot would take hours.
        (("floor/finger",), False, MAX_JOINTS_OF_NONLINEAR_FILTER + 1, 2.0, False),
        (("floor/foot",), True, 3, 2.0, False),
        ((), False, 3, 2.0, False),
    ],
)
def test_contacts_that_need_a_large_force_need_a_nonlinear_filter(
    contacts, is_on_ground, joints, force_share, expected
):
    robot = SimpleNamespace(contacts=contacts, is_on_ground=is_on_ground)
    force = np.zeros(joints)
    force[-1] = force_share
    filtered_runs = SimpleNamespace(force=force, typical=np.ones(joints))
    conditions = ContactConditions(SimpleNamespace(has_model=True, robot=robot))
    assert conditions.needs_nonlinear_filter(filtered_runs) == expected
