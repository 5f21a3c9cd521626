"""`simgap check NAME` on sound and on broken subjects."""

import pytest

from bench.cli import main
from tests.conftest import PLUGINS

CHAOS = ["--plugin", str(PLUGINS / "chaos.py")]
SPRING = ["--plugin", str(PLUGINS / "spring.py")]
SOUND = """import numpy as np

from methods.base import Tuner


class Shrinking(Tuner):
    def tune(self, task, rng):
        best, best_loss, width = task.start, np.inf, 0.3
        while True:
            seen = yield np.clip(best + width * rng.normal(size=(1, task.dim)), 0, 1)
            if seen.losses[0] < best_loss:
                best, best_loss = seen.proposals[0], seen.losses[0]
            else:
                width *= 0.9
"""


def checked(capsys, *arguments):
    code = main(["check", *arguments])
    return code, capsys.readouterr().out


@pytest.mark.slow
def test_sound_plugin_tuner_passes_every_check(tmp_path, capsys):
    plugin = tmp_path / "shrinking.py"
    plugin.write_text(SOUND)
    code, said = checked(capsys, "shrinking", "--plugin", str(plugin))
    assert code == 0, said
    assert said.count("ok    ") == 14
    assert (
        "-       stochastic is declared\n        not applicable: it says that it uses chance"
        in said
    )
    assert (
        "-       what was learned can be stored\n        not applicable: it does not learn" in said
    )
    assert said.endswith(
        "tuner shrinking (simgap_plugin_shrinking.Shrinking): all 14 checks passed, "
        "2 not applicable\n"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("chaos_raise", "found crashed: Traceback"),
        (
            "chaos_exit",
            "expected to survive; found DeathError: the worker process exited with code 7",
        ),
        ("chaos_hang", "expected an end within 2 s; found none"),
        ("chaos_nan", "found diverged: the tuner gave proposals that are not finite"),
    ],
)
def test_chaos_tuner_fails_with_what_was_expected_and_where_to_look(
    name, expected, capsys, monkeypatch
):
    monkeypatch.setattr("bench.checks.command.LIMIT", 2.0)
    monkeypatch.setattr("bench.runs.pools.GRACE", 0.0)
    code, said = checked(capsys, name, *CHAOS)
    assert code == 1
    assert expected in said
    assert "FAILED  runs in one and in ten dimensions" in said
    assert "; see " in said
    assert f"(simgap_plugin_chaos.{''.join(w.title() for w in name.split('_'))}): " in said


@pytest.mark.slow
def test_simulators_and_effects_are_checked_by_name(capsys):
    code, said = checked(capsys, "drag.linear")
    assert (code, said.splitlines()[-1]) == (
        0,
        "effect drag.linear (sims.effects.drag.Linear): all 10 checks passed",
    )
    code, said = checked(capsys, "slider")
    assert (code, said.splitlines()[-1]) == (
        0, "simulator slider (sims.slider.simulator.Slider): all 8 checks passed"
    )  # fmt: skip
    code, said = checked(capsys, "spring", *SPRING)
    assert code == 0, said


def test_unknown_name_is_one_line(capsys):
    assert main(["check", "cma_ess"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        "simgap: unknown tuner, simulator, effect or diagnoser 'cma_ess'; "
        "there are: actuator.damping, actuator.limit, actuator.stiffness, arm, backlash, ball"
    )
    assert error.count("\n") == 1
