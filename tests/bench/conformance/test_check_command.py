"""Tests of `simgap check NAME` with correct and with broken plugins."""

import json

import pytest
from jsonschema import validate

from bench.schemas import load_schema
from tests.command_output import run_command
from tests.conftest import PLUGINS
from tests.docs.documentation_pages import blocks, text_of

CHAOS = ["--plugin", str(PLUGINS / "chaos.py")]
SPRING = ["--plugin", str(PLUGINS / "spring.py")]


def checked(*arguments, code=0):
    """Return what the check of a plugin prints."""
    return run_command("check", *arguments, code=code).out


@pytest.mark.slow
def test_the_tuner_of_the_page_passes_every_check(tmp_path):
    plugin = tmp_path / "my_tuner.py"
    plugin.write_text(dict(blocks(text_of("add-a-tuner.md")))["my_tuner.py"], encoding="utf-8")
    said = checked("narrowing", "--plugin", plugin)
    assert said.count("ok    ") == 14
    assert (
        "-       stochastic is declared\n        not applicable: it declares that it is random"
        in said
    )
    assert (
        "-       what was learned can be stored\n        not applicable: it does not learn" in said
    )
    assert said.endswith(
        "tuner narrowing (simgap_plugin_my_tuner.Narrowing): all 14 checks passed, "
        "2 not applicable\n"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("chaos_raise", "found crashed: Traceback"),
        (
            "chaos_exit",
            "expected the process to survive; found WorkerDiedError: the worker process exited "
            "with code 7",
        ),
        ("chaos_hang", "expected an end within 2 s; found none"),
        ("chaos_nan", "found diverged: the tuner gave proposals that are not finite"),
    ],
)
def test_chaos_tuner_fails_with_what_was_expected_and_where_to_look(name, expected, monkeypatch):
    monkeypatch.setattr("bench.conformance.check_suites.CALL_TIMEOUT_SECONDS", 2.0)
    monkeypatch.setattr("bench.benchmark.runner.worker_pools.HARD_LIMIT_GRACE_SECONDS", 0.0)
    said = checked(name, *CHAOS, code=1)
    assert expected in said
    assert "FAILED  runs in one and in ten dimensions" in said
    assert "; see " in said
    assert f"(simgap_plugin_chaos.{''.join(w.title() for w in name.split('_'))}): " in said


@pytest.mark.slow
def test_simulators_and_effects_are_checked_by_name():
    said = checked("drag.linear")
    assert said.splitlines()[-1] == (
        "effect drag.linear (sims.effects.drag.LinearDrag): all 10 checks passed"
    )
    said = checked("slider")
    assert said.splitlines()[-1] == (
        "simulator slider (sims.systems.slider.Slider): all 10 checks passed, 4 not applicable"
    )
    said = checked("spring", *SPRING)


LEAKY = """from simgap import Channel, OwnSimulator, Parameter


class Leaky(OwnSimulator):
    \"\"\"A motor whose winding is still warm when the next run begins.\"\"\"

    name = "leaky"
    parameters = (Parameter("friction", "1/s", 0.5, (0.1, 1.0)),)
    inputs, channels = (Channel("volts", "V"),), (Channel("speed", "rad/s"),)
    states = {"speed": 1.0}
    warmth = 0.0

    def reset(self, theta, constants, initial):
        self.friction, self.speed = theta["friction"], initial["speed"]

    def step(self, inputs, seconds):
        self.warmth += inputs["volts"] ** 2 * seconds
        self.speed += (inputs["volts"] / (1 + self.warmth) - self.friction * self.speed) * seconds

    def observe(self):
        return {"speed": self.speed}
"""


@pytest.mark.usefixtures("fresh_registries")
def test_state_left_over_between_runs_is_one_failure_for_people_and_programs(tmp_path):
    plugin = tmp_path / "leaky.py"
    plugin.write_text(LEAKY)
    said = checked("leaky", "--plugin", plugin, code=1)
    assert said.count("FAILED") == 1
    assert "FAILED  same proposal gives the same bits\n        expected the same numbers" in said
    assert "see Leaky.reset: it must set everything that a run has changed" in said
    needs = "not tested: needs 'same proposal gives the same bits'"
    assert f"-       initial states show\n        {needs}" in said
    assert said.splitlines()[-1].endswith(": 1 of 7 checks failed, 7 not tested")
    document = json.loads(checked("leaky", "--plugin", plugin, "--json", code=1))
    assert not document["passed"]
    outcomes = [check["outcome"] for check in document["checks"]]
    assert [outcomes.count(what) for what in ("passed", "failed", "not tested")] == [6, 1, 7]
    validate(document, load_schema("check"))


@pytest.mark.usefixtures("fresh_registries")
def test_an_exception_of_the_subject_names_its_line(tmp_path):
    plugin = tmp_path / "leaky.py"
    plugin.write_text(LEAKY.replace('theta["friction"]', 'theta["fiction"]'))
    said = checked("leaky", "--plugin", plugin, code=1)
    assert said.count("FAILED") == 1
    assert "simulator leaky: KeyError: 'fiction' (leaky.py, line 14, in reset)" in said


def test_unknown_name_is_one_line():
    error = run_command("check", "cma_ess", code=2).err
    assert error.startswith(
        "simgap: unknown tuner, simulator, effect or diagnoser 'cma_ess'; did you mean cma_es?"
    )
    assert error.count("\n") == 1
