"""Tests of anomalous recordings: a verdict or a one-line error, no traceback, no wrong cause."""

import json
from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from bench.core.plugin_registries import load_plugins, simulators
from bench.diagnosis.explain import explain
from bench.diagnosis.pipeline import base_model
from bench.diagnosis.verdict import Verdict
from bench.logs.synthetic_recording import simulate_recording
from sims.core.simulator import InputError, Scenario
from sims.systems.pendulum import Pendulum
from tests.bench.diagnosis import verdict_schema
from tests.bench.diagnosis.report_tables import swing, table
from tests.conftest import PLUGINS
from tests.simulation_arguments import simulation_spec, write

EXAMPLES = PLUGINS.parents[1] / "examples"
TIMES = np.arange(90) / 60
NOISE = {"q": 0.003, "qd": 0.02}


pytestmark = pytest.mark.usefixtures("fresh_registries")


def explained(path, **options):
    """Return the result of explain after checking its verdict against the schema."""
    found = explain(path, **options)
    document = found.answer.to_document()
    verdict_schema.check(json.dumps(document, allow_nan=False))
    assert found.story.verdict == found.answer
    assert Verdict.from_document(document) == found.answer
    return found


def check_refused(path, message):
    """Check that explain refuses a recording with a message."""
    with pytest.raises(InputError, match=message):
        explain(path)


def names(found):
    return [cause.effect for cause in found.causes]


def noisy(seed=0, sigma=(0.003, 0.02)):
    rng = np.random.default_rng(seed)
    return sigma[0] * rng.standard_normal(TIMES.size), sigma[1] * rng.standard_normal(TIMES.size)


def swings(times=TIMES, count=3, effects=None, seed=0):
    """Return simulated free swings with noise, as columns."""
    rng, runs = np.random.default_rng(seed), []
    for angle in np.linspace(0.4, 1.2, count):
        seen = Pendulum(fixed=effects).simulate(
            np.array([[3.3e-3]]), Scenario(times, {"q": angle})
        )[0]
        seen = seen + rng.standard_normal(seen.shape) * [0.003, 0.02]
        runs.append((times, *seen.T))
    return runs


def test_too_short_a_recording_is_one_line(tmp_path):
    rng = np.random.default_rng(0)
    short = table(tmp_path, [swing(TIMES[:6], rng=rng)])
    check_refused(
        short, r"odd.csv: too short: 8 samples for fitting, expected at least 10 for 3 par"
    )
    check_refused(
        table(tmp_path, [swing(TIMES[:3], rng=rng)]),
        r"odd.toml: the only run is too short to hold its last third out: 3 rows",
    )


def test_many_runs_of_few_samples_have_a_verdict(tmp_path):
    runs = [part for k in range(4) for part in swings(np.arange(5) / 20, 3, seed=k)]
    found = explained(table(tmp_path, runs, noise=NOISE))
    assert found.verdict in ("adequate", "ambiguous")
    assert found.answer.parameters["inertia"].value == pytest.approx(3.3e-3, rel=0.1)


@pytest.mark.parametrize("place", [0.0, 0.5])
def test_a_recording_in_which_nothing_changes_says_so(tmp_path, place):
    found = explained(table(tmp_path, [(TIMES, 0 * TIMES + place, 0 * TIMES)] * 3))
    assert found.verdict == "unidentifiable"
    assert found.story.unidentified_parameters == ("inertia",)
    assert found.answer.next_experiment.says == (
        "Measure inertia separately, or record runs in which it changes the motion"
    )


def test_a_pendulum_that_is_held_aside_is_not_explained_by_one_name(tmp_path):
    runs = [(TIMES, 0.5 + q, qd) for q, qd in map(noisy, range(3))]
    found = explained(table(tmp_path, runs, noise=NOISE))
    assert found.verdict != "named"
    if found.causes:
        assert {"force.bias", "input.bias"} <= {
            names(found)[0],
            *found.causes[0].alternatives,
        }


def test_channels_without_samples_are_one_line(tmp_path):
    for columns in ((np.nan * TIMES, np.nan * TIMES), (0.1 * np.sin(8 * TIMES), np.nan * TIMES)):
        path = table(tmp_path, [(TIMES, *columns)] * 3)
        check_refused(path, r"column qd? has no sample; leave the channel out")


def test_a_run_without_samples_is_one_line_and_one_without_a_channel_is_used(tmp_path):
    runs = swings(count=3)
    empty = [runs[0], (TIMES, np.nan * TIMES, np.nan * TIMES), runs[2]]
    path = table(tmp_path, empty, noise=NOISE)
    check_refused(path, "run '2' has no sample of any channel")
    found = explained(
        table(tmp_path, [runs[0], (*runs[1][:2], np.nan * TIMES), runs[2]], noise=NOISE)
    )
    assert found.answer.parameters["inertia"].value == pytest.approx(3.3e-3, rel=5e-3)
    assert found.verdict in ("adequate", "ambiguous")


def test_clean_swings_are_adequate_and_their_files_stay_as_they_are(tmp_path):
    path = table(tmp_path, swings(), noise=NOISE)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    found = explained(path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
    assert found.verdict == "adequate"
    inertia = found.answer.parameters["inertia"]
    assert inertia.low < 3.3e-3 < inertia.high
    assert inertia.high - inertia.low < 0.02 * 3.3e-3
    assert found.answer.heldout.rmse_base == pytest.approx(0.003, rel=0.15)


def test_a_gain_of_a_thousand_is_not_named_wrongly(tmp_path):
    runs = [(times, 1e3 * q, 1e3 * qd) for times, q, qd in swings()]
    found = explained(table(tmp_path, runs))
    assert found.verdict in ("unknown", "unidentifiable", "partial")


def test_values_that_cannot_be_are_one_line(tmp_path):
    runs = [(times, 1e12 * q, qd) for times, q, qd in swings()]
    check_refused(
        table(tmp_path, runs),
        r"column q: expected values of about 1 rad, found 1.2e\+12; is the unit right",
    )


def test_what_does_not_fit_the_system_at_all_is_unknown(tmp_path):
    """The recording is a random walk that is described as a pendulum's angle."""
    rng = np.random.default_rng(1)
    walks = [np.cumsum(0.05 * rng.standard_normal(60)) for _ in range(2)]
    runs = [(TIMES[:60], walk, 0.3 * rng.standard_normal(60)) for walk in walks]
    found = explained(table(tmp_path, runs, noise=NOISE))
    assert found.verdict == "unknown"
    assert any("the residual of channel q is" in line for line in found.story.lack_of_fit)
    assert found.answer.candidates, "the nearest candidates are reported"
    assert found.answer.heldout.rmse_extended > 10 * 0.003


def test_a_single_run_holds_its_last_third_out(tmp_path):
    (run,) = swings(np.arange(180) / 60, 1, {"drag.linear": 1.5e-3})
    found = explained(table(tmp_path, [run], noise=NOISE))
    assert names(found) == ["drag.linear"]
    drag = found.causes[0].coefficients["coefficient"]
    assert drag.value == pytest.approx(1.5e-3, rel=0.03)
    assert drag.low < 1.5e-3 < drag.high
    held_out = found.answer.heldout
    assert held_out.gap_closed > 0.9
    assert held_out.low <= held_out.gap_closed <= held_out.high
    assert found.story.held_out.times[0][0] == pytest.approx(2.0)


def test_a_free_swing_does_not_identify_gravity_and_length_too(tmp_path):
    path = table(tmp_path, swings(), noise=NOISE)
    found = explained(path, free=("gravity", "length"))
    assert found.verdict == "unidentifiable"
    assert set(found.story.unidentified_parameters) >= {"gravity", "length"}
    says = found.answer.next_experiment.says
    assert says.startswith("Measure ")
    assert says.endswith("separately, or record runs in which their influences differ")
    for name in ("gravity", "length"):
        assert found.answer.parameters[name].low is None
    one = explained(path, free=("gravity",))
    assert one.verdict == "unidentifiable", "only the ratio to the inertia shows"
    assert one.story.unidentified_parameters == ("inertia", "gravity")
    assert one.answer.parameters["gravity"].low is None


def test_a_torque_that_is_known_fixes_gravity(tmp_path):
    rng, runs = np.random.default_rng(4), []
    for angle in (0.3, 0.5, -0.4):
        push = 0.05 * np.sign(np.sin(7 * TIMES + angle))
        seen = Pendulum({"gravity": 8.0}).simulate(
            np.array([[3.3e-3]]), Scenario(TIMES, {"q": angle}, {"u": push})
        )[0]
        runs.append((TIMES, *(seen + rng.standard_normal(seen.shape) * [0.003, 0.02]).T, push))
    found = explained(table(tmp_path, runs, noise=NOISE, inputs=("u",)), free=("gravity",))
    assert found.verdict == "adequate"
    assert found.answer.parameters["gravity"].value == pytest.approx(8.0, rel=0.01)
    assert found.answer.parameters["inertia"].value == pytest.approx(3.3e-3, rel=0.01)
    assert found.extended.constants["gravity"] == found.answer.parameters["gravity"].value


def test_other_engines_explain_too(tmp_path):
    path = table(tmp_path, swings(np.arange(40) / 40, 2), noise=NOISE)
    found = explained(path, engine="mujoco")
    assert found.answer.engine == "mujoco"
    assert found.verdict in ("adequate", "ambiguous")
    assert found.answer.parameters["inertia"].value == pytest.approx(3.3e-3, rel=0.02)


def test_what_takes_no_effects_is_refused(tmp_path, spring):
    write(simulation_spec("spring", runs=2, seconds=1), tmp_path / "spring.csv")
    message = "simulator spring takes no effects, so nothing can be missing from it"
    check_refused(tmp_path / "spring.csv", message)


@pytest.mark.slow
def test_a_plugins_simulator_without_forces_is_explained(tmp_path):
    pytest.importorskip("mujoco")
    load_plugins([EXAMPLES / "bob.py"])
    truth = simulation_spec(
        "bob",
        ["damping=0.3"],
        ["input.gain=0.3"],
        [],
        ["0.001"],
        ["pull=square:0.5:1"],
        [],
        [],
        3,
        1.0,
        50.0,
    )
    write(truth, tmp_path / "bob.csv")
    found = explained(tmp_path / "bob.csv")
    assert found.answer.engine == "its own"
    assert {"drag.linear", "friction.coulomb"}.isdisjoint(c.effect for c in found.answer.candidates)
    cause = found.causes[0]
    assert "input.gain" in (cause.effect, *cause.alternatives)
    assert {"stiffness", "damping"} == set(found.answer.parameters)


@pytest.mark.long
def test_a_plugins_simulator_with_forces_is_explained(tmp_path):
    pytest.importorskip("pybullet")
    load_plugins([EXAMPLES / "puck.py"])
    path = tmp_path / "puck.csv"
    truth = simulation_spec(
        "puck", ["0.3"], ["drag.linear=0.15"], noise=["0.002"], initial=["v=0.2:1"]
    )
    write(replace(truth, runs=2, seconds=0.6, rate=25), path)
    found = explained(path)
    cause = found.causes[0]
    assert "drag.linear" in (cause.effect, *cause.alternatives)


def test_an_extended_simulator_is_scored_and_explained_as_its_system(tmp_path):
    found = explained(table(tmp_path, swings(effects={"drag.linear": 1e-3}), noise=NOISE))
    assert names(found) == ["drag.linear"]
    (tmp_path / "out").mkdir()
    found.write(tmp_path / "out")
    model = tmp_path / "out" / "extended.toml"
    load_plugins([model])
    kind = simulators.get("pendulum_extended")
    theta = np.array([[p.nominal for p in kind.parameters]])
    numbers = found.answer.parameters["inertia"], found.causes[0].coefficients["coefficient"]
    assert theta[0].tolist() == [number.value for number in numbers]
    by_hand = Pendulum(found.extended.constants, engine="batch", effects=["drag.linear"])
    scenario = Scenario(TIMES, {"q": 0.7})
    np.testing.assert_array_equal(
        kind().simulate(theta, scenario), by_hand.simulate(theta, scenario)
    )
    np.testing.assert_array_equal(
        found.extended.simulator().simulate(theta, scenario), by_hand.simulate(theta, scenario)
    )
    made = simulate_recording(
        simulation_spec(
            "pendulum_extended", noise=["q=0.003", "qd=0.02"], runs=3, seconds=1.5, rate=60
        )
    ).recording
    columns = [(run.times, run.channels["q"], run.channels["qd"]) for run in made.runs]
    path = table(tmp_path, columns, system="pendulum_extended", noise=NOISE)
    message = "pendulum_extended is extended already; name the system it extends, pendulum"
    check_refused(path, message)
    again = explained(path, system="pendulum")
    assert names(again) == ["drag.linear"]
    drag = again.causes[0].coefficients["coefficient"]
    first = found.causes[0].coefficients["coefficient"]
    assert drag.low < first.value < drag.high


def test_a_mass_beyond_its_declared_range_is_fitted_and_reported(tmp_path):
    """The slide has 95 kg, above the system's limit of 10 kg; no gain must replace the mass."""
    rng, mass, step = np.random.default_rng(0), 95.0, 0.01
    times, runs = step * np.arange(200), []
    for force in (40.0, 60.0):
        u = force * np.where(times < 0.7, 1.0, -1.0)
        v = np.append(0.0, np.cumsum(u[:-1] * step / mass))
        x = np.append(0.0, np.cumsum(v[:-1] * step + u[:-1] * step**2 / (2 * mass)))
        runs.append((times, x + 1e-3 * rng.standard_normal(times.size), u))
    found = explained(table(tmp_path, runs, ["x"], "slider", {"x": 1e-3}, ["u"]))
    assert (found.verdict, found.causes, found.answer.recording_faults) == ("adequate", (), ())
    mass = found.answer.parameters["mass"]
    assert mass.value == pytest.approx(95.0, rel=5e-3)
    assert mass.low < mass.value < mass.high
    (said,) = found.story.lack_of_fit
    assert "lies outside its usual range, " in said
    assert "to 10 kg" in said


def test_arithmetic_has_one_thread_meanwhile_and_what_it_had_afterwards(tmp_path, monkeypatch):
    threads = []

    def count(*_, **__):
        threads.extend(pool["num_threads"] for pool in threadpool_info())
        raise InputError("enough")

    monkeypatch.setattr(base_model, "fit_base_model", count)
    path = table(tmp_path, swings(), noise=NOISE)
    with threadpool_limits(2):
        pools = threadpool_info()
        with pytest.raises(InputError, match="enough"):
            explain(path)
        assert threadpool_info() == pools
    assert threads
    assert set(threads) == {1}
