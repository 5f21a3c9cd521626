"""Tests of the hypotheses of reversed signs at a joint, by the signals that are recorded there."""

import pytest

from bench.diagnosis.conventions.convention_hypotheses import JointSignals, _generate_signs


def list_reversed_signals(quantities, inputs=()):
    """Return the set of reversed signals of each hypothesis about a hinge."""
    channels = {quantity: f"{quantity}.elbow" for quantity in quantities}
    joint = JointSignals("elbow", channels, inputs, (), None, True)
    return [set(hypothesis.changes) for hypothesis in _generate_signs(joint)]


@pytest.mark.parametrize("inputs", [(), ("u.motor",)])
@pytest.mark.parametrize("quantities", [("tau",), ("q", "tau"), ("qd", "tau"), ("q", "qd", "tau")])
def test_a_recorded_torque_may_be_reversed_alone(quantities, inputs):
    assert {"tau.elbow"} in list_reversed_signals(quantities, inputs)


@pytest.mark.parametrize("inputs", [(), ("u.motor",)])
@pytest.mark.parametrize("quantities", [("q",), ("qd",), ("tau",), ("qd", "tau"), ("q", "qd")])
def test_no_signals_are_reversed_together_twice(quantities, inputs):
    """Each hypothesis costs a filter."""
    hypotheses = list_reversed_signals(quantities, inputs)
    assert all(hypotheses.count(names) == 1 for names in hypotheses)
