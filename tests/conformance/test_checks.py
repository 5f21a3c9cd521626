"""Tests of every conformance check with a subject that violates only this check, and a valid
subject that passes all.
"""

import os
import random
import re

import numpy as np
import pytest

from bench.conformance import (
    EFFECT_CHECKS,
    SIMULATOR_CHECKS,
    TUNER_CHECKS,
    CheckError,
    parametrize,
    simulator_checks,
    tuner_checks,
)
from bench.conformance.check_suites import SUITES, failed_need, run_check
from methods.tuner import Proposal, Tuner
from sims.core.effect import Coefficient, Force
from sims.core.simulator import Channel, Constant, Parameter, Simulator
from sims.own_simulator import OwnSimulator
from tests.conftest import PLUGINS


class ValidTuner(Tuner):
    """Shrink a cloud of points around the best point."""

    def tune(self, task, rng):
        best, best_loss, width = task.start, np.inf, 0.3
        while True:
            seen = yield np.clip(best + width * rng.normal(size=(3, task.dim)), 0, 1)
            if seen.losses.min() < best_loss:
                best, best_loss = seen.proposals[seen.losses.argmin()], seen.losses.min()
            width *= 0.9


class OneDimensional(ValidTuner):
    def tune(self, task, rng):
        while True:
            yield np.array([float(np.asarray(task.start).item())])


class ChokesOnSmallBudgets(ValidTuner):
    def tune(self, task, rng):
        if task.budget < 5:
            raise ValueError("needs five")
        yield from super().tune(task, rng)


class LeavesTheCube(ValidTuner):
    def tune(self, task, rng):
        yield Proposal(task.start, recommend=task.start + 2.0)
        yield from super().tune(task, rng)


class NeedsAnOption(ValidTuner):
    def __init__(self, width):
        self.width = width


class SortsWhatItIsShown(ValidTuner):
    def tune(self, task, rng):
        while True:
            seen = yield rng.uniform(size=(3, task.dim))
            seen.losses.sort()


class DependsOnItsProcess(ValidTuner):
    def tune(self, task, rng):
        while True:
            yield rng.uniform(size=(1, task.dim)) * (os.getpid() % 1000) / 1000


class NoBetterThanRandom(ValidTuner):
    def tune(self, task, rng):
        while True:
            yield rng.uniform(size=(1, task.dim))


class DrawsGlobally(ValidTuner):
    def tune(self, task, rng):
        while True:
            yield np.random.uniform(size=(1, task.dim))  # noqa: NPY002


class KeepsState(ValidTuner):
    def __init__(self):
        self.best = None

    def tune(self, task, rng):
        self.best = task.start * 0.5 if self.best is not None else task.start
        while True:
            yield self.best


class SeedsGlobally(ValidTuner):
    def tune(self, task, rng):
        random.seed(0)
        yield from super().tune(task, rng)


class CallsItselfDeterministic(ValidTuner):
    stochastic = False


class ChokesOnFailures(ValidTuner):
    def tune(self, task, rng):
        seen = yield task.start
        while True:
            seen = yield np.clip(
                task.start + rng.normal(size=task.dim) * (1 + seen.losses.min() * 0), 0, 1
            )


class NeverBetter(ValidTuner):
    def tune(self, task, rng):
        while True:
            yield Proposal(rng.uniform(size=(1, task.dim)), recommend=task.start)


class ForgetsWhatItLearned(ValidTuner):
    learned = True

    def fit(self, simulator, rng, budget):
        self.weights = {"shift": np.full(simulator.dim, 0.1)}

    def state(self):
        return {"shift": np.zeros(2)}

    def restore(self, state):
        self.weights = state

    def tune(self, task, rng):
        while True:
            yield np.clip(task.start + self.weights["shift"], 0, 1)


class HoldsAFunction(ValidTuner):
    def __init__(self):
        self.helper = lambda x: x


BROKEN_TUNERS = {
    "check_api_is_complete": NeedsAnOption,
    "check_arguments_are_not_changed": SortsWhatItIsShown,
    "check_same_run_in_other_processes": DependsOnItsProcess,
    "check_beats_random_search": NoBetterThanRandom,
    "check_runs_in_one_and_in_ten_dimensions": OneDimensional,
    "check_budget_is_exact": ChokesOnSmallBudgets,
    "check_proposals_stay_in_the_unit_cube": LeavesTheCube,
    "check_same_seed_gives_the_same_run": DrawsGlobally,
    "check_runs_do_not_touch_each_other": KeepsState,
    "check_global_random_state_is_left_alone": SeedsGlobally,
    "check_stochastic_is_declared": CallsItselfDeterministic,
    "check_failed_simulations_are_survived": ChokesOnFailures,
    "check_easy_problem_is_improved": NeverBetter,
    "check_what_was_learned_can_be_stored": ForgetsWhatItLearned,
    "check_instances_can_be_sent_to_workers": HoldsAFunction,
    "check_same_run_when_sealed": "spawning",  # a plugin file: a class in a test has none
}


@pytest.mark.parametrize("check", TUNER_CHECKS, ids=lambda check: check.__name__)
def test_tuner_check_rejects_its_broken_subject_and_no_sound_one(check):
    check(ValidTuner)
    broken = BROKEN_TUNERS[check.__name__]
    if isinstance(broken, str):
        from bench.core.plugin_registries import load_plugins
        from bench.core.plugin_registries import tuners as registered

        load_plugins([PLUGINS / "awkward.py"])
        check(registered.get("over_asking"))
        broken = registered.get(broken)
    with pytest.raises(CheckError, match=r"(?s)expected .*; found .*; see ") as error:
        check(broken)
    isolated = check.__name__ == "check_same_run_when_sealed"
    assert isolated == ("use --trust while developing" in str(error.value))


def test_a_learned_tuner_without_storage_and_a_tune_that_does_not_yield_are_rejected():
    class Unfinished(ValidTuner):
        learned = True

        def fit(self, simulator, rng, budget):
            pass

    class Returns(ValidTuner):
        def tune(self, task, rng):
            return [task.start]

    with pytest.raises(CheckError, match="no state, restore"):
        tuner_checks.check_api_is_complete(Unfinished)
    with pytest.raises(CheckError, match=r"expected a generator .* found list"):
        tuner_checks.check_api_is_complete(Returns)


def test_training_outside_the_training_range_or_beyond_the_budget_is_rejected():
    class Greedy(ValidTuner):
        learned = True

        def fit(self, simulator, rng, budget):
            simulator.simulate(rng, np.full((1, simulator.dim), 0.9))

    with pytest.raises(CheckError, match="training range"):
        tuner_checks.check_budget_is_exact(Greedy)


class Wave(Simulator):
    """A valid simulator."""

    name, says = "wave", "a wave"
    parameters = (
        Parameter("rate", "rad/s", 3.0, (1.0, 5.0)),
        Parameter("height", "m", 1.0, (0.5, 2.0)),
    )
    channels = (Channel("x", "m"), Channel("v", "m/s"))
    constants = (Constant("shift", "m", 0.0),)

    def simulate(self, theta, scenario):
        self.run_inputs(scenario), self.run_initial(scenario)
        shift, t = self.run_constants(scenario)["shift"], scenario.times
        wave = np.stack([np.sin(theta[:, :1] * t), np.cos(theta[:, :1] * t)], axis=2)
        return (shift + theta[:, 1:, None] * wave)[:, :, self.columns]


class NoSentence(Wave):
    says = ""


class Raises(Wave):
    def simulate(self, theta, scenario):
        return theta[:, 7]


class UnknownUnit(Wave):
    channels = (Channel("x", "m"), Channel("v", "furlongs/fortnite"))


class WrongShape(Wave):
    def simulate(self, theta, scenario):
        return super().simulate(theta, scenario)[:, :, 0]


class WarmStarted(Wave):
    calls = 0

    def simulate(self, theta, scenario):
        self.calls += 1
        return super().simulate(theta, scenario) * (1.0 + 1e-15 * (self.calls > 1))


class Clobbers(Wave):
    def simulate(self, theta, scenario):
        result = super().simulate(theta, scenario)
        theta[:] = 0.0
        return result


class SpoilsNeighbours(Wave):
    def simulate(self, theta, scenario):
        return super().simulate(theta, scenario) + 0.0 * theta.sum()


class IgnoresHeight(Wave):
    def simulate(self, theta, scenario):
        return super().simulate(
            np.column_stack([theta[:, 0], np.where(np.isnan(theta[:, 1]), np.nan, 1.0)]), scenario
        )


class TakesAnything(Wave):
    def run_inputs(self, scenario):
        return {}


class WrongColumns(Wave):
    def simulate(self, theta, scenario):
        return np.sort(super().simulate(theta, scenario), axis=2)


class Cart(OwnSimulator):
    """A valid user-defined simulator: two carts with a spring between them, one on a heater."""

    name, says = "cart", "two carts that are coupled by a spring"
    parameters = (Parameter("stiffness", "N/m", 20.0, (5.0, 50.0)),)
    inputs = (Channel("push", "N"),)
    channels = (Channel("x1", "m"), Channel("x2", "m"), Channel("heat", "K"))
    states, time_step = {"x1": 0.0, "x2": 0.1, "v1": 0.0, "v2": 0.0, "heat": 0.0}, 0.01
    coordinates, rates, levels = ("x1", "x2"), ("v1", "v2"), ("heat",)

    def reset(self, theta, constants, initial):
        self.stiffness, self.now, self.force = theta["stiffness"], dict(initial), np.zeros(2)

    def step(self, inputs, seconds):
        now, pull = self.now, self.stiffness * (self.now["x2"] - self.now["x1"])
        now["heat"] += abs(inputs["push"]) * seconds
        now["v1"] += (pull + inputs["push"] + self.force[0]) * seconds
        now["v2"] += (self.force[1] - pull - 0.1 * now["heat"] * now["v2"]) * seconds
        now["x1"] += now["v1"] * seconds
        now["x2"] += now["v2"] * seconds
        self.force = np.zeros(2)

    def observe(self):
        return self.now

    def apply_force(self, force):
        self.force = force

    def inertia(self):
        return np.eye(2)

    def put(self, levels):
        self.now |= levels


class SmallInertia(Cart):
    name = "small_inertia"

    def inertia(self):
        return np.eye(1)


class NegativeInertia(Cart):
    name = "negative_inertia"

    def inertia(self):
        return np.diag([1.0, -1.0])


class ObservesArrays(Cart):
    name = "observes_arrays"

    def observe(self):
        return {**self.now, "v2": np.array([self.now["v2"]])}


class ForcesWithoutCoordinates(Cart):
    name = "forces_without_coordinates"
    coordinates = rates = ()


class KeepsHeat(Cart):
    """Heat from the inputs of a run, wrongly retained in the next run."""

    name = "keeps_heat"
    warmth = 0.0

    def reset(self, theta, constants, initial):
        super().reset(theta, constants, {**initial, "heat": initial["heat"] + self.warmth})

    def step(self, inputs, seconds):
        super().step(inputs, seconds)
        self.warmth = self.now["heat"]


class IgnoresStart(Cart):
    name = "ignores_start"

    def reset(self, theta, constants, initial):
        super().reset(theta, constants, {**initial, "v2": 0.0})


class OwnClock(Cart):
    name = "own_clock"

    def step(self, inputs, seconds):
        super().step(inputs, self.time_step)


class IgnoresForces(Cart):
    name = "ignores_forces"

    def apply_force(self, force):
        self.force[0] = force[0]


class SumsForces(Cart):
    """Add each force to the previous ones, and never remove one."""

    name = "sums_forces"

    def reset(self, theta, constants, initial):
        super().reset(theta, constants, initial)
        self.sum = np.zeros(2)

    def step(self, inputs, seconds):
        self.force = self.sum
        super().step(inputs, seconds)

    def apply_force(self, force):
        self.sum = self.sum + force


class KeepsForces(Cart):
    """Keep an applied force until the next one, also in the next run."""

    name = "keeps_forces"
    last = np.zeros(2)

    def step(self, inputs, seconds):
        self.force = self.last
        super().step(inputs, seconds)

    def apply_force(self, force):
        # Zero forces of later steps change nothing, as in a cache of active forces.
        if force.any():
            self.last = force


class IgnoresPut(Cart):
    name = "ignores_put"

    def put(self, levels):
        pass


BROKEN_SIMULATORS = {
    "check_declaration_is_complete": NoSentence,
    "check_units_are_known": UnknownUnit,
    "check_observations_have_the_declared_shape": WrongShape,
    "check_same_proposal_gives_the_same_bits": WarmStarted,
    "check_arguments_are_not_changed": Clobbers,
    "check_parameters_that_are_not_numbers_spoil_only_their_lane": SpoilsNeighbours,
    "check_every_parameter_shows": IgnoresHeight,
    "check_initial_states_show": IgnoresStart,
    "check_unknown_names_are_refused": TakesAnything,
    "check_chosen_channels_are_the_same_columns": WrongColumns,
    "check_hooks_have_the_declared_shapes": SmallInertia,
    "check_step_goes_on_by_its_seconds": OwnClock,
    "check_forces_act": IgnoresForces,
    "check_levels_can_be_set": IgnoresPut,
}


@pytest.mark.parametrize("check", SIMULATOR_CHECKS, ids=lambda check: check.__name__)
def test_simulator_check_rejects_its_broken_subject_and_no_sound_one(check):
    check(Wave)
    assert check(Cart) is None
    with pytest.raises(CheckError, match=r"(?s)expected .*; found .*; see "):
        check(BROKEN_SIMULATORS[check.__name__])


@pytest.mark.parametrize(
    ("kind", "failing", "message"),
    [
        (NoSentence, "check_declaration_is_complete", "a sentence; found none"),
        (
            UnknownUnit,
            "check_units_are_known",
            "a unit for v .* found 'furlongs/fortnite'; see UnknownUnit",
        ),
        (
            SmallInertia,
            "check_hooks_have_the_declared_shapes",
            r"inertia: expected shape \(2, 2\) \(coordinates × coordinates; here: x1, x2\) or a "
            r"number; found \(1, 1\)",
        ),
        (NegativeInertia, "check_hooks_have_the_declared_shapes", "positive definite matrix"),
        (
            ObservesArrays,
            "check_hooks_have_the_declared_shapes",
            r"observe\(\), v2: expected a number; found shape \(1,\)",
        ),
        (
            ForcesWithoutCoordinates,
            "check_hooks_have_the_declared_shapes",
            "coordinates and rates with apply_force; found none",
        ),
        (
            KeepsHeat,
            "check_same_proposal_gives_the_same_bits",
            "after a run with other inputs; found heat = .* in place of .* at sample 0; see "
            "KeepsHeat.reset",
        ),
        (IgnoresStart, "check_initial_states_show", "initial state v2 = 0.01 in place of 0"),
        (
            OwnClock,
            "check_step_goes_on_by_its_seconds",
            "found 2.* times as far; see OwnClock.step",
        ),
        (IgnoresForces, "check_forces_act", "a force along x2 to change the motion"),
        (SumsForces, "check_forces_act", "along x1 to act in the next step alone"),
        (KeepsForces, "check_forces_act", "the same run after one with forces"),
        (IgnoresPut, "check_levels_can_be_set", r"after put\(heat\)"),
        (WarmStarted, "check_same_proposal_gives_the_same_bits", "in place of"),
        (Clobbers, "check_arguments_are_not_changed", "unchanged arguments"),
        (WrongShape, "check_observations_have_the_declared_shape", "observations of shape"),
        (
            Raises,
            "check_observations_have_the_declared_shape",
            r"no exception; found IndexError: .*; see test_checks.py, line \d+, in simulate",
        ),
    ],
)
def test_one_cause_gives_one_failure(kind, failing, message, fresh_registries):
    from bench.core.plugin_registries import simulators as registered

    registered.register(kind)
    failed = {}
    for check in SUITES["simulator"]:
        if failed_need(check, failed) is None:
            result = run_check("simulator", kind.name, check)
            if result.outcome == "failed":
                failed[check] = result.reason
    assert [check.__name__ for check in failed] == [failing], failed
    assert re.search(message, *failed.values())


def test_parametrized_tests_skip_what_means_nothing_without_a_check_that_failed():
    instance_count = {case.id: case.values[0] for case in parametrize(KeepsHeat).args[1]}
    ends = {}
    for name, check in instance_count.items():
        try:
            check()
        except CheckError:
            ends[name] = "failed"
        except pytest.skip.Exception as skipped:
            ends[name] = str(skipped)
    needs = "not tested: needs 'same proposal gives the same bits'"
    assert ends.pop("KeepsHeat-same_proposal_gives_the_same_bits") == "failed"
    assert ends.pop("KeepsHeat-initial_states_show") == needs
    assert set(ends.values()) == {needs}
    assert not {"KeepsHeat-units_are_known", "KeepsHeat-unknown_names_are_refused"} & set(ends)


def test_the_test_simulator_conforms(spring):
    for check in SIMULATOR_CHECKS:
        if (
            check is not simulator_checks.check_unknown_names_are_refused
        ):  # it takes neither inputs nor constants
            check(spring)


def test_awkward_tuners_do_not_conform():
    from bench.core.plugin_registries import load_plugins
    from bench.core.plugin_registries import tuners as registered

    load_plugins([PLUGINS / "awkward.py"])
    with pytest.raises(CheckError, match="boom"):
        tuner_checks.check_runs_in_one_and_in_ten_dimensions(registered.get("crashing"))
    with pytest.raises(CheckError, match="not finite"):
        tuner_checks.check_runs_in_one_and_in_ten_dimensions(registered.get("nan_proposing"))


class Breeze(Force):
    """A valid effect."""

    name, says, source = "breeze.sound", "a breeze pushes along the track", "any textbook"
    coefficients = (
        Coefficient("coefficient", ("m/s^2", "N", "N*m"), ((-1, 2), (-1, 2), (-0.1, 0.2))),
    )

    def force(self, c, moment):
        return c[0] + 0.0 * moment.x


class Nameless(Breeze):
    name, says = "breeze.nameless", ""


class NeverOff(Breeze):
    name = "breeze.never_off"

    def force(self, c, moment):
        return c[0] + 1e-9 + 0.0 * moment.x


class NeverOn(Breeze):
    name = "breeze.never_on"

    def force(self, c, moment):
        return 0.0 * c[0] * moment.x


class Mixes(Breeze):
    name = "breeze.mixes"

    def force(self, c, moment):
        return c[0].mean() * (c[0] != 0) + 0.0 * moment.x


class Elsewhere(Breeze):
    name = "breeze.elsewhere"
    needs = "input"

    @classmethod
    def misses(cls, system):
        return "says no, and yes" if cls.is_refusing else ""

    is_refusing = False


def of_robot(moment):
    """Return whether a force is computed at a joint of a robot; elsewhere these effects are
    valid.
    """
    return hasattr(moment, "carried")


class Unitless(Breeze):
    name = "breeze.unitless"
    coefficients = (
        Coefficient("coefficient", ("m/s^2", "N", ""), ((-1, 2), (-1, 2), (-0.1, 0.2))),
    )

    @classmethod
    def misses(cls, system):
        return "" if system.kind == "linear" else "it slides alone"


class NeverOffAtAJoint(Breeze):
    name = "breeze.never_off_at_a_joint"

    def force(self, c, moment):
        return c[0] + 1e-9 * of_robot(moment) + 0.0 * moment.x


class NeverOnAtAJoint(Breeze):
    name = "breeze.never_on_at_a_joint"

    def force(self, c, moment):
        return c[0] * (not of_robot(moment)) + 0.0 * moment.x


class GrowsWithItsNumber(Breeze):
    name = "breeze.grows_with_its_number"
    instance_count = 0

    def __init__(self):
        GrowsWithItsNumber.instance_count += 1
        self.number = GrowsWithItsNumber.instance_count

    def force(self, c, moment):
        return c[0] * (1.0 + self.number * of_robot(moment)) + 0.0 * moment.x


class MixesInARobot(Breeze):
    name = "breeze.mixes_in_a_robot"

    def force(self, c, moment):
        mean = c[0].mean() * (c[0] != 0)
        return (mean if of_robot(moment) else c[0]) + 0.0 * moment.x


BROKEN_EFFECTS = {
    "check_places_are_declared": Unitless,
    "check_nothing_at_zero_at_a_place": NeverOffAtAJoint,
    "check_it_acts_at_its_place_alone": NeverOnAtAJoint,
    "check_family_is_the_sum_of_its_members": GrowsWithItsNumber,
    "check_lanes_of_a_robot_are_independent": MixesInARobot,
    "check_declaration_is_complete": Nameless,
    "check_contribution_is_nothing_at_zero": NeverOff,
    "check_it_shows_and_stays_finite": NeverOn,
    "check_lanes_are_independent": Mixes,
    "check_impossible_hosts_are_refused": Elsewhere,
}


@pytest.mark.parametrize("check", EFFECT_CHECKS, ids=lambda check: check.__name__)
def test_effect_check_rejects_its_broken_subject_and_no_sound_one(
    check, monkeypatch, fresh_registries
):
    from sims import effects

    check(Breeze)
    broken = BROKEN_EFFECTS[check.__name__]
    if broken is Elsewhere:
        from sims.system_simulator import SystemSimulator

        broken.is_refusing = True
        monkeypatch.setattr(
            SystemSimulator, "_effect", lambda self, name: effects.get_effect(name)()
        )
    with pytest.raises(CheckError, match=r"(?s)expected .*; found .*; see "):
        check(broken)
