"""Tests of the choice of the filter for a robot that touches something."""

from types import SimpleNamespace

import numpy as np
import pytest

from bench.diagnosis.pipeline.run_filtering import (
    MAX_JOINTS_OF_NONLINEAR_FILTER,
    needs_nonlinear_filter,
)
from bench.diagnosis.pipeline.simulated_runs import ContactConditions


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
    runs = SimpleNamespace(contacts=conditions, nominal_filter=filtered_runs)
    assert needs_nonlinear_filter(runs) == expected
