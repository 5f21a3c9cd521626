"""Data without noise give no false alarm: differences of the integrators are not explained."""

from dataclasses import replace

import numpy as np
import pytest

from bench.gap.explain import explain
from bench.gap.model.floor import PRECISION, noise_floor, range_of
from bench.gap.model.noise_free import add_least_noise
from tests.bench.gap.made import changed, recording, world


@pytest.mark.parametrize("system", ["pendulum", "servo", "ball"])
def test_noise_free_data_of_the_simulator_itself_are_explained_by_it(system):
    answer = explain(recording(system, runs=4, seconds=2)).answer
    assert (answer.verdict, answer.causes) == ("adequate", ())


def test_a_cause_in_noise_free_data_is_named_with_its_number():
    made = recording(
        runs=4, seconds=2, observe=["q"], effects=["drag.linear=2e-4"], initial=["q=0.5:1.5"]
    )
    answer = explain(made).answer
    (cause,) = answer.causes
    assert (answer.verdict, cause.effect) == ("named", "drag.linear")
    assert cause.coefficients["coefficient"].value == pytest.approx(2e-4, rel=5e-3)


def test_noise_is_added_where_there_is_none_and_nowhere_else():
    made = recording(runs=2, seconds=2, noise=["q=0.002"])
    again, names = add_least_noise(made, ["q", "qd"])
    assert names == ["qd"]
    for before, after in zip(made.runs, again.runs, strict=True):
        np.testing.assert_array_equal(before.channels["q"], after.channels["q"])
        added = after.channels["qd"] - before.channels["qd"]
        size = PRECISION * range_of(np.concatenate([run.channels["qd"] for run in made.runs]))
        assert np.std(added) == pytest.approx(size, rel=0.2)


def test_the_added_noise_is_the_same_each_time():
    made = recording(runs=2, seconds=1)
    once, twice = (add_least_noise(made, ["q"])[0] for _ in range(2))
    np.testing.assert_array_equal(once.runs[1].channels["q"], twice.runs[1].channels["q"])
    assert not np.array_equal(once.runs[0].channels["q"], once.runs[1].channels["q"])


@pytest.mark.parametrize("digits", [6, 8])
def test_rounding_of_a_file_is_not_noise(digits):
    made = recording(runs=2, seconds=2)
    rounded = [changed(run, q=lambda v: np.round(v, digits)) for run in made.runs]
    assert add_least_noise(replace(made, runs=tuple(rounded)), ["q"])[1] == ["q"]


def test_a_channel_that_never_changes_has_the_noise_of_what_no_sample_tells_of():
    made = recording(runs=2, seconds=1, noise=["0.001"])
    still = [changed(run, qd=lambda v: np.zeros_like(v)) for run in made.runs]
    made = replace(made, runs=tuple(still), noise={})
    assert add_least_noise(made, ["qd"])[1] == []
    assert noise_floor(world(made, candidates=[]), made).sigma[1] == pytest.approx(1e-3 * 10.0)
