"""Tests of the simulator interface: unit cube, parameters, scenarios, and the checks of every
simulator.
"""

import numpy as np
import pytest

from bench.benchmark.problem.tuning_problem import apply_parameter_changes
from sims.core.simulator import Channel, Constant, InputError, Parameter, Scenario, Simulator
from sims.core.unit_cube import UnitCube

LINEAR = Parameter("stiffness", "N/m", 3.0, (-1.0, 4.0), (0.0, 2.0))
LOG = Parameter("inertia", "kg*m^2", 0.01, (1e-3, 1e-1), (1e-3, 1e-2), log=True)


class Spring(Simulator):
    name = "spring"
    parameters = (LINEAR,)
    channels = (Channel("x", "m"), Channel("v", "m/s"), Channel("a", "m/s^2"))
    constants = (Constant("mass", "kg", 2.0, positive=True), Constant("gravity", "m/s^2", 9.81))
    inputs = (Channel("u", "N"),)
    states = {"x": 0.5, "v": 0.0}  # noqa: RUF012 (a mapping, never written)

    def simulate(self, theta, scenario):
        raise NotImplementedError


def test_unit_cube_is_linear_over_the_bounds():
    cube = UnitCube([LINEAR])
    assert cube.dim == 1
    np.testing.assert_allclose(
        cube.to_physical(np.array([[0.0], [0.2], [1.0]])), [[-1.0], [0.0], [4.0]], atol=1e-15
    )
    np.testing.assert_allclose(cube.to_unit_cube(np.array([1.5])), [0.5], atol=1e-15)


def test_unit_cube_is_logarithmic_where_asked():
    cube = UnitCube([LINEAR, LOG])
    np.testing.assert_allclose(cube.to_physical(np.array([0.5, 0.5])), [1.5, 1e-2], rtol=1e-14)
    np.testing.assert_allclose(cube.to_physical(np.array([0.5, 0.25])), [1.5, 10**-2.5], rtol=1e-14)
    np.testing.assert_allclose(cube.to_unit_cube(np.array([-1.0, 1e-1])), [0.0, 1.0], atol=1e-14)


@pytest.mark.parametrize(
    "parameters", [[LINEAR], [LOG], [LINEAR, LOG]], ids=["linear", "log", "both"]
)
def test_unit_cube_maps_are_inverse_also_outside(parameters):
    cube = UnitCube(parameters)
    points = np.random.default_rng(5).uniform(-0.2, 1.2, size=(3, 40, cube.dim))
    np.testing.assert_allclose(cube.to_unit_cube(cube.to_physical(points)), points, atol=1e-13)


def test_unit_cube_knows_the_training_box():
    cube = UnitCube([LINEAR, LOG])
    np.testing.assert_allclose(cube.training, [[0.2, 0.0], [0.6, 0.5]], atol=1e-14)
    np.testing.assert_allclose(cube.compute_training_widths(), [2.0, 9e-3], rtol=1e-14)
    assert not cube.training.flags.writeable


def test_training_range_defaults_to_the_bounds():
    assert Parameter("a", "1", 0.5, (0.0, 1.0)).training_range == (0.0, 1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bounds": (1.0, 0.0)}, "bounds must be finite and increasing"),
        ({"bounds": (0.0, np.inf)}, "bounds must be finite and increasing"),
        ({"bounds": (0.0, 1.0), "log": True}, "needs positive bounds"),
        ({"nominal": 1.5}, "nominal 1.5 lies outside"),
        ({"nominal": float("nan")}, "nominal nan lies outside"),
        ({"training": (0.5, 1.5)}, "must increase inside"),
        ({"training": (0.6, 0.5)}, "must increase inside"),
    ],
)
def test_impossible_parameters_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        Parameter(**{"name": "a", "unit": "1", "nominal": 0.5, "bounds": (0.0, 1.0), **change})


def test_adjusted_replaces_what_the_experiment_gives():
    [narrow, untouched] = apply_parameter_changes(
        [LINEAR, LOG], {"stiffness": {"training": [1, 2], "nominal": 1.0}}
    )
    assert (narrow.training, narrow.nominal, narrow.bounds) == ((1, 2), 1.0, (-1.0, 4.0))
    assert untouched == LOG


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": {"nominal": 1.0}}, "unknown parameter 'mass'; there are: inertia, stiffness"),
        (
            {"inertia": {"unit": "g"}},
            "unknown attribute of parameter inertia 'unit'; there are: bounds, log",
        ),
    ],
)
def test_adjusted_lists_what_there_is(changes, message):
    with pytest.raises(InputError, match=message):
        apply_parameter_changes([LINEAR, LOG], changes)


@pytest.mark.parametrize(
    "times", [[], [0.0, 0.0], [0.0, 0.2, 0.1], [0.0, np.nan], [0.0, np.inf], [[0.0, 1.0]]], ids=repr
)
def test_scenario_times_must_increase(times):
    with pytest.raises(InputError, match="times must be finite and increasing"):
        Scenario(np.array(times))


def test_scenario_inputs_have_a_value_for_each_sample():
    with pytest.raises(InputError, match=r"input 'u' has shape \(2,\), the scenario has 3 samples"):
        Scenario(np.arange(3.0), inputs={"u": np.zeros(2)})


def test_scenario_keeps_read_only_copies():
    times, signal = np.arange(3.0), np.ones(3)
    scenario = Scenario(times, inputs={"u": signal})
    times[0], signal[0] = -7.0, -7.0
    assert scenario.times[0] == 0.0
    assert scenario.inputs["u"][0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        scenario.times[0] = 1.0


def test_a_run_overrides_the_simulator_which_overrides_the_defaults():
    spring = Spring({"mass": 3.0})
    scenario = Scenario(np.arange(2.0), {"v": 1.0}, {}, {"gravity": 1.62})
    assert spring.run_constants(scenario) == {"mass": 3.0, "gravity": 1.62}
    assert spring.run_initial(scenario) == {"x": 0.5, "v": 1.0}
    np.testing.assert_array_equal(spring.run_inputs(scenario)["u"], [0.0, 0.0])
    assert spring.constant_values == {"mass": 3.0, "gravity": 9.81}


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (
            lambda: Spring({"colour": 1.0}),
            "unknown constant of simulator spring 'colour'; there are: gravity, mass",
        ),
        (
            lambda: Spring({"mass": 0.0}),
            "constant 'mass' of simulator spring must be > 0, found 0.0",
        ),
        (
            lambda: Spring({"gravity": np.nan}),
            "constant 'gravity' of simulator spring must be finite",
        ),
        (
            lambda: Spring(observe=["x", "z"]),
            "unknown channel of simulator spring 'z'; there are: a, v, x",
        ),
        (lambda: Spring(observe=[]), "one or more different channels"),
        (lambda: Spring(observe=["x", "x"]), "one or more different channels"),
        (
            lambda: Spring().run_initial(Scenario([0.0], {"q": 1.0})),
            "unknown initial state .* there are: v, x",
        ),
        (
            lambda: Spring().run_initial(Scenario([0.0], {"x": np.inf})),
            "initial state 'x' .* must be finite",
        ),
        (
            lambda: Spring().run_inputs(Scenario([0.0], inputs={"w": [0.0]})),
            "unknown input .* there are: u",
        ),
        (
            lambda: Spring().run_inputs(Scenario([0.0], inputs={"u": [np.nan]})),
            "input 'u' .* must be finite",
        ),
        (
            lambda: Spring().run_constants(Scenario([0.0], constants={"mass": -1.0})),
            "must be > 0, found -1.0",
        ),
    ],
)
def test_simulators_refuse_what_they_cannot_use(refused, message):
    with pytest.raises(InputError, match=message):
        refused()


def test_observe_chooses_and_orders_the_channels():
    spring = Spring(observe=["a", "x"])
    assert [c.name for c in spring.channels] == ["a", "x"]
    assert spring.columns == [2, 0]
    assert Spring().columns == [0, 1, 2]
    assert len(Spring.channels) == 3
