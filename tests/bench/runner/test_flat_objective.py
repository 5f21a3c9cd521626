"""Test of a comparison on a simulator whose parameter has no effect: all tuners are equal."""

import pytest

from bench.cli.main import main

FLAT = """from simgap import Channel, OwnSimulator, Parameter


class Flat(OwnSimulator):
    name, says = "flat", "its parameter does nothing"
    parameters = (Parameter("idle", "1", 0.5, (0.0, 1.0), (0.2, 0.8)),)
    channels = (Channel("x", "m"),)
    states = {"x": 0.1}

    def reset(self, theta, constants, initial):
        self.x = initial["x"]

    def step(self, inputs, seconds):
        pass

    def observe(self):
        return {"x": self.x}
"""
EXPERIMENT = """simulator = "flat"
observe = ["x"]
targets = 2
budget = 5
tuners = ["random", "least_squares", "nelder_mead"]
[sampling]
rate = 50.0
samples = 10
"""


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_registries")
def test_nothing_warns_where_the_parameter_does_nothing(tmp_path, capfd):
    (tmp_path / "flat.py").write_text(FLAT)
    (tmp_path / "flat.toml").write_text(EXPERIMENT)
    plugin = ["--plugin", str(tmp_path / "flat.py"), "--jobs", "0"]
    # The command runs in this process, where a warning is an error, with all tables and figures.
    code = main(["compare", str(tmp_path / "flat.toml"), *plugin, "--out", str(tmp_path / "out")])
    said = capfd.readouterr()
    assert code == 0, said.err
    assert "Warning" not in said.out + said.err
    assert (tmp_path / "out" / "report.html").is_file()
