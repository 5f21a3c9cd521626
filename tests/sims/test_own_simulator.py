import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

from bench.cli.main import main
from bench.conformance import SIMULATOR_CHECKS
from sims import effects
from sims.core.simulator import Channel, Constant, InputError, Parameter, Scenario
from sims.own_simulator import OwnSimulator

EXAMPLES = Path(__file__).parents[2] / "examples"
PUCK = EXAMPLES / "puck.py"


def example(name, kind):
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return getattr(module, kind)


class Block(OwnSimulator):
    """A block that an input pushes along a level track, stepped exactly."""

    name = "block"
    parameters = (Parameter("mass", "kg", 2.0, (0.5, 5.0)),)
    constants = (Constant("wind", "N", 0.0), Constant("gravity", "m/s^2", 9.81))
    inputs = (Channel("push", "N"),)
    channels = (Channel("x", "m"), Channel("v", "m/s"), Channel("charge", "V"))
    states = {"charge": 1.0, "x": 0.0, "v": 0.0}  # noqa: RUF012
    coordinates, rates = ("x",), ("v",)
    time_step = 0.01

    def reset(self, theta, constants, initial):
        self.mass, self.wind, self.state, self.extra = (
            theta["mass"],
            constants["wind"],
            dict(initial),
            0.0,
        )
        self.steps = []

    def step(self, inputs, seconds):
        a = (inputs["push"] + self.wind + self.extra) / self.mass
        self.state["x"] += self.state["v"] * seconds + a * seconds**2 / 2
        self.state["v"] += a * seconds
        self.extra = 0.0
        self.steps.append(seconds)

    def observe(self):
        return self.state

    def apply_force(self, force):
        self.extra += force[0]

    def inertia(self):
        return self.mass


TIMES = np.arange(51) / 50
PUSHED = Scenario(
    TIMES, {"v": 1.0, "charge": 3.0}, {"push": np.where(TIMES < 0.5, 2.0, 0.0)}, {"wind": 1.0}
)


def test_it_is_a_simulator_like_any_other():
    block = Block(observe=["v", "charge", "x"])
    seen = block.simulate(np.array([[1.0], [2.0]]), PUSHED)
    assert seen.shape == (2, 51, 3)
    assert Block.says == "A block that an input pushes along a level track, stepped exactly."
    np.testing.assert_allclose(
        seen[:, -1, 0], [1 + 1.0 + 1.0, 1 + 0.5 + 0.5], rtol=1e-12
    )  # 0.5 s of push, 1 s of wind
    np.testing.assert_array_equal(seen[:, :, 1], 3.0)
    np.testing.assert_allclose(seen[0, 25, 2], 0.5 + 3 * 0.125, rtol=1e-12)
    np.testing.assert_allclose(block.steps, 0.01, rtol=1e-9)
    assert len(block.steps) == 100
    assert len(Block(time_step=1.0).simulate(np.array([[1.0]]), PUSHED)[0]) == 51
    np.testing.assert_array_equal(block.simulate(np.array([[2.0]]), PUSHED)[0], seen[1])


def test_runs_that_miss_samples_or_fail():
    uneven = Scenario(np.array([0.0, 0.013, 0.5]), {"v": 2.0})
    np.testing.assert_allclose(
        Block().simulate(np.array([[1.0]]), uneven)[0, :, 0], [0.0, 0.026, 1.0], rtol=1e-12
    )
    seen = Block().simulate(
        np.array([[np.nan], [1.0], [0.0]]) + 1e-300, Scenario(TIMES[:2], {"v": 1.0})
    )
    assert np.isnan(seen[0]).all()
    np.testing.assert_allclose(seen[1, 1], [0.02, 1.0, 1.0])
    assert Block().simulate(np.array([[1.0]]), Scenario(np.array([7.0]), {"x": 4.0})).tolist() == [
        [[4.0, 0.0, 1.0]]
    ]


def test_effects_through_the_force_hook():
    theta, coast = np.array([[2.0]]), Scenario(TIMES, {"v": 1.0})
    dragged = Block(fixed={"drag.linear": 3.0}, time_step=1e-3).simulate(theta, coast)[0, -1, 1]
    assert dragged == pytest.approx(math.exp(-1.5), rel=2e-3)
    slowed = Block(fixed={"friction.coulomb": 4.0}).simulate(theta, coast)[0]
    np.testing.assert_allclose(
        slowed[:, 1], np.maximum(0.0, 1 - 2 * TIMES), atol=0.021
    )  # tolerance for a step of 0.01 s
    assert slowed[-1, 0] == pytest.approx(0.25, abs=0.011)
    np.testing.assert_allclose(slowed[30:, 1], 0.0, atol=1e-12, err_msg="it holds still")


def test_friction_holds_against_a_constant_pull_and_lets_go_of_a_greater_one():
    held = Scenario(TIMES, {}, {}, {"wind": 1.5})
    friction = Block(fixed={"friction.coulomb": 2.0})
    assert np.abs(friction.simulate(np.array([[2.0]]), held)[0, :, 1]).max() < 0.01, (
        "one step of pull, then none"
    )
    pulled = Scenario(TIMES, {}, {}, {"wind": 6.0})
    assert friction.simulate(np.array([[2.0]]), pulled)[0, -1, 1] == pytest.approx(2.0, rel=0.02)


class Coupled(OwnSimulator):
    """Two joints coupled by their inertia, stepped exactly between forces."""

    name = "coupled"
    parameters = (Parameter("scale", "1", 1.0, (0.5, 2.0)),)
    channels = (Channel("q1", "rad"), Channel("q2", "rad"))
    states = {"q1": 0.0, "q2": 0.0, "w1": 1.0, "w2": -2.0}  # noqa: RUF012
    kind, coordinates, rates, time_step = "rotary", ("q1", "q2"), ("w1", "w2"), 1e-3
    given = np.array([[2.0, 0.8], [0.8, 1.0]])

    def reset(self, theta, constants, initial):
        self.q = np.array([initial["q1"], initial["q2"]])
        self.w = np.array([initial["w1"], initial["w2"]])
        self.matrix, self.force = theta["scale"] * Coupled.given, np.zeros(2)

    def step(self, inputs, seconds):
        a = np.linalg.solve(self.matrix, self.force)
        self.q, self.w = self.q + seconds * self.w + seconds**2 / 2 * a, self.w + seconds * a
        self.force = np.zeros(2)

    def observe(self):
        return {"q1": self.q[0], "q2": self.q[1], "w1": self.w[0], "w2": self.w[1]}

    def apply_force(self, force):
        self.force = force

    def inertia(self):
        return self.given


def test_dry_friction_of_coupled_joints_takes_the_inertia_matrix():
    (seen,) = Coupled(fixed={"friction.coulomb": 3.0}).simulate(np.array([[1.0]]), Scenario(TIMES))
    start = np.array([1.0, -2.0])
    # The force has constant magnitude and opposes the momentum, so it keeps the direction.
    momentum = Coupled.given @ start
    rest = np.linalg.norm(momentum) / 3.0
    np.testing.assert_allclose(seen[-1], start * rest / 2, rtol=2e-3)
    assert TIMES[-1] > rest
    np.testing.assert_array_equal(seen[-1], seen[-5])


def test_an_inertia_of_another_shape_is_refused_with_the_one_that_is_expected():
    wrong = type("Wrong", (Coupled,), {"name": "wrong", "given": np.eye(1)})
    says = (
        r"simulator wrong: inertia: expected shape \(2, 2\) \(coordinates × coordinates; "
        r"here: q1, q2\) or a number, found \(1, 1\)"
    )
    with pytest.raises(InputError, match=says):
        wrong(fixed={"friction.coulomb": 3.0}).simulate(np.array([[1.0]]), Scenario(TIMES))
    as_matrix = type("Matrix", (Block,), {"inertia": lambda self: np.array([[self.mass]])})
    kinds = (Block, as_matrix)
    seen = [kind(fixed={"friction.coulomb": 1.0}).simulate(THETA, PUSHED) for kind in kinds]
    np.testing.assert_array_equal(*seen)


THETA = np.array([[2.0]])


def test_effects_at_zero_change_nothing_and_tuned_ones_are_parameters():
    plain = Block().simulate(np.array([[2.0]]), PUSHED)
    block = Block(effects=["friction.coulomb", "drag.linear", "input.gain", "sensor.bias"])
    assert [p.name for p in block.parameters] == [
        "mass", "friction.coulomb", "drag.linear", "input.gain", "sensor.bias"
    ]  # fmt: skip
    np.testing.assert_array_equal(block.simulate(np.array([[2.0, 0, 0, 0, 0]]), PUSHED), plain)
    gained = block.simulate(np.array([[2.0, 0, 0, 0.5, 0.25]]), PUSHED)
    np.testing.assert_allclose(
        gained[0, -1, 1] - plain[0, -1, 1], 0.25, rtol=1e-9
    )  # 50 % more of 2 N for 0.5 s on 2 kg
    np.testing.assert_allclose(gained[0, 0, 0], 0.25, rtol=1e-12)


class Mute(Block):
    name = "mute"
    coordinates = rates = ()
    apply_force, inertia = OwnSimulator.apply_force, OwnSimulator.inertia


class Light(Block):
    name = "light"
    inertia = OwnSimulator.inertia


@pytest.mark.parametrize(
    ("kind", "effect", "reason"),
    [
        (Mute, "drag.linear", "system mute cannot have effect drag.linear: it takes no forces"),
        (Light, "friction.coulomb", "it does not define its inertia"),
        (Block, "gravity.scale", "it does not define the effect of gravity"),
        (Block, "friction.load", "it does not define the effect of its inputs"),
        (Block, "gravity.tilt", "it does not define the effect of horizontal acceleration"),
        (Block, "restitution.speed", "it has no contact with a ground"),
    ],
)
def test_what_it_cannot_have_says_why(kind, effect, reason):
    with pytest.raises(InputError, match=reason):
        kind(fixed={effect: 0.1})
    assert effect not in effects.list_effects_for(kind.system)
    assert "drag.linear" in effects.list_effects_for(Block.system)
    assert "input.delay" in effects.list_effects_for(Mute.system)


def test_faulty_declarations_are_one_line():
    def declared(**changes):
        return type("Faulty", (Block,), {"name": "faulty", **changes})

    for changes, message in [
        ({"name": 3}, "class Faulty: expected name"),
        ({"channels": ()}, "at least one parameter and one channel"),
        ({"kind": "slide"}, "kind: expected point, linear, rotary, found 'slide'"),
        ({"rates": ()}, r"expected a rate for each of \('x',\), found \(\)"),
        ({"coordinates": ("y",)}, "y is not among its states charge, x, v"),
        ({"levels": ("y",)}, "level y must be a state and a channel"),
    ]:
        with pytest.raises(InputError, match=message):
            declared(**changes)
    for settings, message in [
        ({"engine": "mujoco"}, "simulator block steps itself; it has no engine 'mujoco'"),
        ({"time_step": 0.0}, "time_step must be a positive number of seconds, found 0.0"),
        ({"steps": 3}, "simulator block has no setting 'steps'; there is: time_step"),
    ]:
        with pytest.raises(InputError, match=message):
            Block(**settings)
    with pytest.raises(InputError, match=r"observe\(\) gave no 'charge'; it gave: x, v"):
        declared(observe=lambda self: {"x": 0.0, "v": 0.0})().simulate(np.array([[1.0]]), PUSHED)
    for value, message in [(np.zeros(3), r"found shape \(3,\)"), ("fast", "found 'fast'")]:
        seen = {"x": value, "v": 0.0, "charge": 0.0}
        with pytest.raises(InputError, match=r"observe\(\), x: expected a number, " + message):
            declared(observe=lambda self, seen=seen: seen)().simulate(np.array([[1.0]]), PUSHED)
    with pytest.raises(InputError, match="the attribute 'engine' belongs to the base class"):
        declared(reset=lambda self, *_: setattr(self, "engine", 1))().simulate(
            np.array([[1.0]]), PUSHED
        )


def test_examples_are_short():
    for path in EXAMPLES.glob("*.py"):
        assert len(path.read_text().splitlines()) <= 40, path


@pytest.mark.parametrize(("name", "kind"), [("puck", "Puck"), ("bob", "Bob"), ("tanks", "Tanks")])
def test_examples_conform(name, kind):
    for check in SIMULATOR_CHECKS:
        check(example(name, kind))


@pytest.mark.parametrize("incline", [0.3, 0.6])
def test_puck_slides_as_the_closed_form_says(incline):
    puck = example("puck", "Puck")({"incline": incline})
    friction = np.array([[0.0], [0.1], [0.2], [0.29]])
    seen = puck.simulate(friction, Scenario(TIMES))
    expected = 9.81 * (math.sin(incline) - friction * math.cos(incline))
    np.testing.assert_allclose(seen[:, :, 1], expected * TIMES, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        seen[:, :, 0], expected * TIMES**2 / 2, atol=0.012
    )  # distance covered in half a step, due to Bullet's integration order
    assert puck.simulate(np.array([[0.8]]), Scenario(TIMES))[0, -1, 0] < 2e-4, (
        "steep friction holds it"
    )
    more = example("puck", "Puck")({"incline": incline}, fixed={"friction.coulomb": 0.08})
    slower = more.simulate(friction[:2], Scenario(TIMES))
    np.testing.assert_allclose(slower[:, -1, 1], expected[:2, 0] - 0.5, atol=0.01)


def test_bob_swings_as_the_closed_form_says():
    bob = example("bob", "Bob")()
    (seen,) = bob.simulate(np.array([[20.0, 0.1]]), Scenario(TIMES))[:, :, 0]
    decay, rate = 0.25, math.sqrt(100.0 - 0.25**2)
    expected = (
        0.1 * np.exp(-decay * TIMES) * (np.cos(rate * TIMES) + decay / rate * np.sin(rate * TIMES))
    )
    np.testing.assert_allclose(seen, expected, atol=6e-4)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_puck_is_compared_as_a_plugin(tmp_path, capsys):
    arguments = [
        "compare",
        str(EXAMPLES / "puck.toml"),
        "--plugin",
        str(PUCK),
        "--out",
        str(tmp_path / "out"),
    ]
    assert (
        main(
            [
                *arguments,
                "--targets",
                "2",
                "--seeds",
                "1",
                "--tuners",
                "least_squares",
                "--jobs",
                "1",
            ]
        )
        == 0
    )
    line = next(
        line for line in capsys.readouterr().out.splitlines() if line.startswith("least_squares")
    )
    assert float(line.split()[-2]) < 1e-3, "friction is found from a second of positions"


@pytest.mark.usefixtures("fresh_registries")
def test_an_exception_of_its_code_is_one_line_with_its_place(tmp_path, capsys):
    plugin, _ = extended_block(tmp_path)
    text = plugin.read_text().replace('constants["wind"]', 'constants["wid"]')
    plugin.write_text(text)
    line = 1 + text[: text.index('constants["wid"]')].count("\n")
    out = tmp_path / "log.csv"
    assert main(["simulate", "stored_block", "--plugin", str(plugin), "--out", str(out)]) == 2
    assert capsys.readouterr().err == (
        f"simgap: simulator stored_block: KeyError: 'wid' (blocks.py, line {line}, in reset)\n"
    )
    assert not out.exists()


def extended_block(folder):
    """Write the file of a block with a friction as found by explain, and its plugin."""
    plugin = folder / "blocks.py"
    text = Path(__file__).read_text()
    body = text[text.index("class Block(") : text.index("\n\n\nTIMES = ")]
    plugin.write_text(
        "from sims.core.simulator import Channel, Constant, Parameter\n"
        f"from sims.own_simulator import OwnSimulator\n\n\n{body}\n".replace(
            '"block"', '"stored_block"'
        )
    )
    file = folder / "extended.toml"
    file.write_text(
        'format = 1\nname = "block_extended"\nsystem = "stored_block"\nobserve = ["x", "v"]\n'
        '[parameters.mass]\nvalue = 2.5\nunit = "kg"\n'
        '[effects."friction.coulomb".coefficient]\nvalue = 0.25\nunit = "N"\n'
    )
    return plugin, file


@pytest.mark.usefixtures("fresh_registries", "undrawn")
def test_an_extended_own_simulator_is_simulated_checked_and_compared(tmp_path, capsys):
    plugin, file = extended_block(tmp_path)
    plugins = ["--plugin", str(file), "--plugin", str(plugin)]
    log = tmp_path / "log.csv"
    pushed = ["--input", "push=sine:2:1", "--seconds", "1", "--runs", "2"]
    assert main(["simulate", "block_extended", *plugins, *pushed, "--out", str(log)]) == 0
    from bench.core.plugin_registries import simulators

    kind = simulators.get("block_extended")
    assert [p.nominal for p in kind().parameters] == [2.5, 0.25]
    for check in SIMULATOR_CHECKS:
        check(kind)
    experiment = tmp_path / "e.toml"
    experiment.write_text(
        'simulator = "block_extended"\nobserve = ["v"]\ntargets = 1\nbudget = 3\n'
        "ranges = ['in']\n[sampling]\nrate = 20.0\nsamples = 20\n[initial]\nv = [0.5, 1.5]\n"
        "[tuners.random]\n"
    )
    out = ["--jobs", "1", "--out", str(tmp_path / "out")]
    capsys.readouterr()
    assert main(["compare", str(experiment), *plugins, *out]) == 0
    assert main(["score", str(file), str(log), "--plugin", str(plugin)]) == 0
