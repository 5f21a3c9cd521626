"""A comparison is not taken up again after a file that it was begun with has changed."""

import pytest

import simgap
from bench.compare import Comparison
from bench.problem.experiment import parse
from bench.registry import load_plugins
from bench.store.folder import read
from bench.store.journal import finished
from sims.base import InputError
from tests.conftest import PLUGINS
from tests.experiments import spring_experiment

EFFECT = """
from sims.effects.drag import Linear

class Mine(Linear):
    name = "drag.mine"
    number = 1
"""
RECORDING = "run,t,q\n" + "".join(
    f"{run},{0.05 * i:.2f},{0.5 - 0.01 * i * run}\n" for run in (1, 2) for i in range(20)
)
DESCRIPTION = """
system = "pendulum"
[channels.q]
unit = "rad"
noise = 0.01
[constants]
mass = 0.15
[runs.2]
held_out = true
"""

pytestmark = pytest.mark.usefixtures("fresh_registries")


class Interrupting(simgap.Tuner):
    """As Ctrl-C does, before its first simulation."""

    name = "interrupting"
    source_digest = "interrupting"
    left = 1

    def tune(self, task, rng):
        if Interrupting.left:
            Interrupting.left -= 1
            raise KeyboardInterrupt
        yield task.start


def begun(experiment, plugins, folder):
    """A folder whose first run is finished and whose second was interrupted."""
    Interrupting.left = 1
    made = Comparison.begin(experiment, plugins, folder, jobs=0).make(jobs=0)
    assert made.interrupted
    assert len(finished(folder)) == 1
    return folder


def refused(folder, what):
    """Resuming is refused for this, in one line, and nothing in the folder changes."""
    before = {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    with pytest.raises(InputError, match=f"its {what} changed since it was begun") as caught:
        Comparison.resume(folder)
    assert "\n" not in str(caught.value)
    assert before == {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def goes_on(folder):
    """Resumed, it makes what is missing and no more."""
    kept = finished(folder)
    made = Comparison.resume(folder).make(jobs=0)
    assert made.complete
    statuses = read(folder, ["run", "tuner", "k"]).statuses
    assert statuses["status"].tolist() == ["done", "converged"]
    assert all(kept[0].seconds == s for s in statuses["seconds"][:1])


@pytest.mark.parametrize("name", ["hung.py", "mine.py"])
def test_a_changed_plugin_is_refused_and_the_same_one_goes_on(name, tmp_path):
    """Also one that holds neither simulator nor tuner, and so is in no other hash."""
    from bench.registry import tuners

    tuners.register(Interrupting)
    simulator = (PLUGINS / "spring.py").read_text().replace('name = "spring"', 'name = "hung"')
    (tmp_path / "hung.py").write_text(simulator)
    (tmp_path / "mine.py").write_text(EFFECT)
    plugins = [str(tmp_path / "hung.py"), str(tmp_path / "mine.py")]
    load_plugins(plugins)
    experiment = spring_experiment(
        simulator="hung", targets=1, seeds=1, ranges=["in"], tuners=["random", "interrupting"]
    )
    folder = begun(experiment, plugins, tmp_path / "out")
    text = (tmp_path / name).read_text()
    (tmp_path / name).write_text(text + "\n# another word\n")
    refused(folder, "plugins")
    (tmp_path / name).write_text(text)
    goes_on(folder)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("swing.csv", "1,0.30,0.44", "1,0.30,0.45"),
        ("swing.csv", "2,0.30,0.38", "2,0.30,0.39"),  # held out: it measures alone
        ("swing.toml", "mass = 0.15", "mass = 0.16"),
        ("swing.toml", "noise = 0.01", "noise = 0.02"),
        ("swing.toml", 'system = "pendulum"', '# words\nsystem = "pendulum"'),
    ],
)
def test_a_changed_recording_is_refused_and_the_same_one_goes_on(name, old, new, tmp_path):
    from bench.registry import tuners

    tuners.register(Interrupting)
    (tmp_path / "swing.csv").write_text(RECORDING)
    (tmp_path / "swing.toml").write_text(DESCRIPTION)
    document = {
        "simulator": "pendulum", "observe": ["q"], "ranges": ["real"], "targets": 1, "seeds": 1,
        "budget": 2, "settings": {"engine": "batch"}, "recording": {"path": "swing.csv"},
        "tuners": ["random", "interrupting"],
    }  # fmt: skip
    experiment = parse("swing", document, tmp_path / "swing-experiment.toml")
    folder = begun(experiment, [], tmp_path / "out")
    text = (tmp_path / name).read_text()
    assert text.count(old) == 1
    (tmp_path / name).write_text(text.replace(old, new))
    refused(folder, "recording")
    (tmp_path / name).write_text(text)
    goes_on(folder)
