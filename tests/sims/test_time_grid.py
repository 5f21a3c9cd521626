"""Tests of step times, sample times and applied inputs against numbers computed by hand."""

from dataclasses import replace

import numpy as np
import pytest

from sims.core.effect import Coefficient, Input, Sensor
from sims.core.simulator import InputError, Scenario
from sims.effects import get_effect
from sims.effects.input_effects import InputBacklash, InputDelay
from sims.effects.sensor_effects import ClockSkew
from sims.effects.sensor_effects import SensorDelay as Late
from sims.engines.scenario_groups import group_scenarios
from sims.engines.step_inputs import compute_applied_inputs
from sims.engines.time_grid import TimeGrid, build_time_grid
from sims.recording.recording import Run
from sims.systems.slider import Slider


def coefficients(*values):
    """Return one coefficient for each element, (1, L, 1)."""
    return np.array(values, dtype=float)[None, :, None]


def planned(*times, largest=0.01, acting=(), commands=None):
    runs = group_scenarios([Scenario(np.array(t)) for t in times])
    return build_time_grid(runs, commands or [{} for _ in runs.unique_scenarios], acting, largest)


def test_intervals_are_divided_into_equal_steps_and_samples_show_their_ends():
    plan = planned([5.0, 5.02, 5.04], largest=0.008)
    assert plan.steps_per_sample == 3
    np.testing.assert_allclose(plan.steps, [[0.02 / 3] * 6], rtol=1e-12)
    np.testing.assert_allclose(plan.ends[0, [2, 5]], [0.02, 0.04], rtol=1e-12)
    assert plan.rows.tolist() == [[0, 1, 2]]


def test_an_interval_that_is_an_exact_multiple_is_not_divided_once_more():
    assert planned(np.arange(50) / 100.0, largest=0.005).steps.shape == (1, 98)


def test_a_gap_costs_only_its_own_steps():
    plan = planned([0.0, 0.02, 0.04, 0.09, 0.11])
    assert plan.steps_per_sample == 2
    steps = [0.01] * 4 + [0.01] * 5 + [0.0] + [0.01] * 2  # the last block of the interval is padded
    np.testing.assert_allclose(plan.steps, [steps], atol=1e-15)
    assert plan.rows.tolist() == [[0, 1, 2, 5, 6]]
    np.testing.assert_allclose(plan.ends[0, 8:10], [0.09, 0.09], rtol=1e-15)


def test_elements_of_unequal_rate_and_length_do_not_share_steps():
    plan = planned([0.0, 0.01, 0.02], [0.0, 0.03])
    assert plan.steps_per_sample == 1
    np.testing.assert_allclose(plan.steps, [[0.01, 0.01, 0.0], [0.01, 0.01, 0.01]], atol=1e-15)
    assert plan.rows.tolist() == [[0, 1, 2], [0, 3, 3]]
    np.testing.assert_allclose(plan.ends, [[0.01, 0.02, 0.02], [0.01, 0.02, 0.03]], rtol=1e-12)


def test_effects_on_time_move_the_instants_of_their_elements_only():
    times = [0.0, 0.01, 0.02, 0.03]
    plan = planned(times, times, times, acting=((Late(), coefficients(0.015, 0.0, -0.005)),))
    kept = np.concatenate(
        [np.zeros((3, 1)), plan.ends[:, plan.steps_per_sample - 1 :: plan.steps_per_sample]], axis=1
    )
    sampled = np.take_along_axis(kept, plan.rows, axis=1)
    np.testing.assert_allclose(
        sampled,
        [[0, 0, 0.005, 0.015], [0, 0.01, 0.02, 0.03], [0.005, 0.015, 0.025, 0.035]],
        atol=1e-15,
    )
    skewed = planned(times, acting=((ClockSkew(), coefficients(0.5)),))
    np.testing.assert_allclose(skewed.ends[0, -1], 0.045, rtol=1e-12)
    assert skewed.steps.max() <= 0.01


def test_a_delayed_command_changes_between_steps():
    runs = group_scenarios(
        [Scenario(np.array([0.0, 0.01, 0.02, 0.03]), {}, {"u": [1.0, 3.0, 3.0, 3.0]})] * 2
    )
    commands, delay = (
        [dict(runs.unique_scenarios[0].inputs)],
        ((InputDelay(), coefficients(0.004, 0.0)),),
    )
    plan = build_time_grid(runs, commands, delay, 0.01)
    np.testing.assert_allclose(
        plan.steps, [[0.01, 0.004, 0.006, 0.01], [0.01, 0.01, 0.01, 0.0]], atol=1e-15
    )
    assert plan.rows.tolist() == [[0, 1, 3, 4], [0, 1, 2, 3]]
    felt = compute_applied_inputs(plan, runs, commands, delay)["u"]
    np.testing.assert_allclose(felt, [[1, 1, 3, 3], [1, 3, 3, 3]], rtol=1e-12)


def test_the_applied_input_is_the_mean_of_the_command_over_the_step():
    runs = group_scenarios([Scenario(np.array([0.0, 0.01, 0.02]), {}, {"u": [1.0, 5.0, 2.0]})])
    steps = np.array([[0.015, 0.01, 0.0, 0.02]])
    plan = TimeGrid(steps, np.cumsum(steps, axis=1), 1, np.array([[0, 1, 2]]))
    felt = compute_applied_inputs(plan, runs, [dict(runs.unique_scenarios[0].inputs)], ())["u"]
    first, second = (1.0 * 0.01 + 5.0 * 0.005) / 0.015, (5.0 * 0.005 + 2.0 * 0.005) / 0.01
    np.testing.assert_allclose(felt, [[first, second, 2.0, 2.0]], rtol=1e-12)


def test_input_effects_act_in_order_on_the_first_input_and_where_they_are_on():
    class Doubled(Input):
        name, says, coefficients = "doubled", "", ()

        def feel(self, c, signal):
            return 2.0 * signal.values

    class Raised(Input):
        name, says, coefficients = "raised", "", ()

        def feel(self, c, signal):
            return signal.values + c[0]

    run = Scenario(np.array([0.0, 0.01]), {}, {"u": [1.0, 1.0], "w": [7.0, 7.0]})
    runs = group_scenarios([run, run, run])
    commands = [dict(run.inputs)]
    acting = ((Raised(), coefficients(1.0, 1.0, 0.0)), (Doubled(), coefficients(1.0, 0.0, 1.0)))
    felt = compute_applied_inputs(
        build_time_grid(runs, commands, acting, 0.01), runs, commands, acting
    )
    assert felt["u"].tolist() == [[4.0], [2.0], [2.0]]
    assert felt["w"].tolist() == [[7.0], [7.0], [7.0]]


def test_signal_effects_are_evaluated_only_on_elements_where_they_are_active():
    asked = []

    class Raised(Input):
        name, says = "raised", ""
        coefficients = (Coefficient("coefficient", ("N", "N", "N"), ((-1, 1),) * 3),)

        def feel(self, c, signal):
            asked.append(len(signal.values))
            return signal.values + c[0]

    class Shown(Sensor):
        name, says = "shown", ""
        coefficients = (Coefficient("coefficient", ("m", "m", "m"), ((-1, 1),) * 3),)

        def read(self, c, signal):
            asked.append(len(signal.values))
            return signal.values + c[0]

    slider = Slider(observe=["x"], engine="batch", effects=[Raised, Shown])
    run = Scenario(np.arange(3) / 10, {}, {"u": np.zeros(3)})
    theta = [[1.0, 0.0, 0.0], [1.0, 0.5, 0.0], [1.0, 0.0, 0.25], [1.0, 0.5, 0.5], [1.0, 0.5, 0.0]]
    seen = slider.simulate_batch(np.array(theta), [run] * 5)[:, 0, 0]
    assert set(asked) == {3, 2}
    assert seen.tolist() == [0.0, 0.0, 0.25, 0.5, 0.0]


def test_the_input_does_not_change_while_an_element_waits():
    runs = group_scenarios([Scenario(np.array([0.0, 0.01, 0.02]), {}, {"u": [0.0, 1.0, 0.0]})])
    commands, play = (
        [dict(runs.unique_scenarios[0].inputs)],
        ((InputBacklash(), coefficients(0.2)),),
    )
    steps = np.array(
        [[0.01, 0.0, 0.01, 0.0]]
    )  # the command is 1 at the second step and 0 at the fourth
    plan = TimeGrid(steps, np.cumsum(steps, axis=1), 1, np.array([[0, 2, 4]]))
    felt = compute_applied_inputs(plan, runs, commands, play)["u"]
    np.testing.assert_allclose(felt, [[0.0, 0.0, 0.9, 0.9]], atol=1e-15)


def test_scenarios_with_the_same_content_are_one_run():
    t = np.arange(5) / 10
    runs = group_scenarios(
        [
            Scenario(t, {}, {"u": t}),
            Scenario(t, {"x": 1.0}, {"u": t.copy()}),
            Scenario(t, {}, {"u": 2 * t}),
        ]
    )
    assert len(runs.unique_scenarios) == 2
    assert runs.scenario_index.tolist() == [0, 0, 1]


def test_initial_states_may_be_given_by_element():
    slider, scenario = Slider(engine="batch"), Scenario(np.array([0.0, 0.5]), {"x": 9.0, "v": 2.0})
    seen = slider.simulate_batch(np.ones((2, 1)), [scenario] * 2, {"x": np.array([1.0, 3.0])})
    np.testing.assert_allclose(seen[:, :, 0], [[1.0, 2.0], [3.0, 4.0]], rtol=1e-13)
    with pytest.raises(InputError, match="unknown initial state of simulator slider 'z'"):
        slider.simulate_batch(np.ones((1, 1)), [scenario], {"z": np.zeros(1)})


def test_a_wrong_shape_is_refused():
    slider, scenario = (
        Slider(engine="batch", effects=["drag.linear"]),
        Scenario(np.array([0.0, 0.5])),
    )
    with pytest.raises(InputError, match=r"theta must have shape \(2, 2\), found \(2, 1\)"):
        slider.simulate_batch(np.ones((2, 1)), [scenario] * 2)


def test_sensor_effects_act_on_samples_and_filters_on_every_step():
    t = np.arange(6) / 10
    seen = Slider(engine="batch", fixed={"sensor.delay": 0.25, "sensor.gain": 0.5}).simulate(
        np.ones((1, 1)), Scenario(t, {"x": 2.0, "v": 1.0})
    )[0]
    np.testing.assert_allclose(seen[:, 0], 1.5 * (2.0 + np.maximum(t - 0.25, 0.0)), rtol=1e-12)
    assert seen[:, 1].tolist() == [1.0] * 6
    lag = 0.05
    seen = Slider(engine="batch", fixed={"sensor.lag": lag}).simulate(
        np.ones((1, 1)), Scenario(t, {"v": 1.0})
    )[0]
    np.testing.assert_allclose(seen[:, 0], t - lag * (1.0 - np.exp(-t / lag)), atol=1e-13)


REMEMBERING = {
    "input.lag": 0.2,
    "input.rate": 8.0,
    "input.delay": 0.13,
    "servo.profile": 60.0,
    "backlash": 0.5,
}
STAMPS = np.arange(0, 3, 0.02)
JUMPS = np.random.default_rng(5).uniform(-1, 1, 30).repeat(5)


def part(first, last=None, **more):
    """Return a part of a run that knows the earlier commands."""
    whole = Run("1", STAMPS, {}, {"u": JUMPS}, {}, {}, False, **more)
    return whole.part(slice(first, last))


def compute_applied_input(run, name, step=0.005):
    """Return the applied input of a drive with an effect over the steps of a run."""
    scenario = Scenario(run.times, {}, run.inputs, {}, run.linear, run.offset, run.before)
    runs, acting = (
        group_scenarios([scenario]),
        ((get_effect(name)(), coefficients(REMEMBERING[name])),),
    )
    steps = np.full((1, round((run.times[-1] - run.times[0]) / step)), step)
    rows = np.zeros((1, run.times.size), dtype=int)
    plan = TimeGrid(steps, np.cumsum(steps, axis=1), 1, rows, has_uniform_steps=True)
    return compute_applied_inputs(plan, runs, [dict(scenario.inputs)], acting)["u"][0]


@pytest.mark.parametrize("linear", [frozenset(), frozenset({"u"})])
@pytest.mark.parametrize("offset", [0.0, 0.03, -0.03])
@pytest.mark.parametrize("name", REMEMBERING)
def test_a_part_of_a_run_uses_the_commands_before_it(name, offset, linear):
    whole, later = part(0, linear=linear, offset=offset), part(111, linear=linear, offset=offset)
    wanted = compute_applied_input(whole, name)[-(later.times.size - 1) * 4 :]
    # Tolerance for the effect's result with another step size.
    close = {"input.lag": 0.03, "servo.profile": 0.01}.get(name, 1e-9)
    assert compute_applied_input(later, name) == pytest.approx(wanted, abs=close)
    forgets = compute_applied_input(replace(later, before={}), name)
    assert np.abs(forgets - wanted).max() > 0.15


def test_a_part_of_a_part_has_the_same_command_history():
    one, other = part(110, 140), part(60).part(slice(50, 80))
    np.testing.assert_allclose(other.before["u"], one.before["u"], atol=1e-12)
    assert one.before["u"][0, [0, -1]] == pytest.approx([-2.0, -0.02])
    assert not part(0).before["u"].size


def test_elements_with_and_without_a_command_history_share_a_batch():
    runs = [part(102), part(0, 30), part(20)]
    own = [compute_applied_input(run, "input.lag") for run in runs]
    scenarios = [Scenario(r.times, {}, r.inputs, before=r.before) for r in runs]
    together = group_scenarios(scenarios)
    counts = [values.size for values in own]
    steps = np.array([np.where(np.arange(max(counts)) < n, 0.005, 0.0) for n in counts])
    plan = TimeGrid(steps, np.cumsum(steps, axis=1), 1, np.zeros((3, 1), dtype=int))
    acting = ((get_effect("input.lag")(), coefficients(REMEMBERING["input.lag"], 0.2, 0.2)),)
    felt = compute_applied_inputs(plan, together, [dict(s.inputs) for s in scenarios], acting)["u"]
    for row, values in zip(felt, own, strict=True):
        np.testing.assert_allclose(row[: values.size], values, atol=1e-12)


def test_times_of_earlier_commands_must_be_negative():
    with pytest.raises(InputError, match="must be negative and increasing"):
        Scenario(STAMPS, {}, {"u": JUMPS}, before={"u": np.array([[-0.1, 0.0], [1.0, 2.0]])})


def test_stored_steps_and_inputs_give_the_same_motion_as_new_ones():
    times, rng = np.arange(30) / 100.0, np.random.default_rng(0)
    name = Slider.system.inputs[0].name
    scenarios = [Scenario(times, inputs={name: rng.standard_normal(30)}) for _ in range(3)]
    slider = Slider(engine="batch", effects=["input.delay"])
    theta = np.column_stack(
        [np.full(3, np.mean(p.bounds)) for p in slider.parameters[:-1]] + [np.zeros(3)]
    )
    first = slider.simulate_batch(theta, scenarios)
    assert len(slider._stored_steps) == 1
    order = [2, 0, 1]
    again = slider.simulate_batch(theta, [scenarios[i] for i in order])
    repeated = slider.simulate_batch(theta, scenarios)
    np.testing.assert_array_equal(again, first[order])
    np.testing.assert_array_equal(repeated, first)
    scenarios[0] = replace(scenarios[0], inputs={name: scenarios[0].inputs[name] + 1.0})
    assert np.abs(slider.simulate_batch(theta, scenarios)[0] - first[0]).max() > 1e-3
    delayed = theta + np.array([0.0] * (theta.shape[1] - 1) + [0.05])
    count = len(slider._stored_steps)
    slider.simulate_batch(delayed, scenarios)
    assert len(slider._stored_steps) == count
