"""Tests of the declarations of systems: their default recordings."""

from dataclasses import replace

import numpy as np
import pytest

from bench.core.input_signals import evaluate_signal
from bench.core.plugin_registries import simulators
from bench.logs.synthetic_recording import simulate_recording
from sims.core.simulator import InputError
from sims.core.system import DefaultRecording
from sims.system_simulator import SystemSimulator
from sims.systems.slider import SliderSystem
from tests.sims.simulation_cases import SIMULATORS
from tests.simulation_arguments import simulation_spec

SYSTEMS = {name: kind.system for name, kind in SIMULATORS.items()}


def missing(system):
    """Return the names in the default recording that the system lacks or that cannot be
    evaluated.
    """
    usual = system.usual_recording
    channels, inputs = ({c.name for c in there} for there in (system.channels, system.inputs))
    names = {
        *(set(usual.observe) - channels),
        *(set(usual.initial) - set(system.states)),
        *(set(usual.inputs) - inputs),
    }
    names |= {name for name, (low, high) in usual.initial.items() if not low <= high}
    for name, text in usual.inputs.items():
        try:
            evaluate_signal(text, np.arange(10) / 10, np.random.default_rng(0))
        except InputError:
            names.add(name)
    return names


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_usual_recording_names_what_the_system_has(name):
    assert not missing(SYSTEMS[name])


def test_nobody_writes_into_a_usual_recording():
    usual = SYSTEMS["ball"].usual_recording
    with pytest.raises(TypeError):
        usual.initial["z"] = (0.0, 1.0)
    with pytest.raises(TypeError):
        usual.inputs["u"] = "1"
    given = {"x": (0.0, 1.0)}
    own = DefaultRecording(initial=given)
    given["x"] = (5.0, 6.0)
    assert own.initial["x"] == (0.0, 1.0)
    assert replace(own, observe=("x",)).initial == own.initial


def test_a_recording_of_a_system_is_made_from_its_declaration(fresh_registries):
    """A system works without an entry in any list of the product."""

    class TestedSystem(SliderSystem):
        name = "slider-tested"
        usual_recording = DefaultRecording(("v",), {"x": (4.0, 4.5)}, {"u": "0.25"})

    class Tested(SystemSimulator):
        system = TestedSystem

    simulators.register(Tested)
    made = simulate_recording(simulation_spec("slider-tested", runs=2, seconds=0.1))
    assert [c.name for c in made.simulator.channels] == ["v"]
    for run in made.recording.runs:
        assert 4.0 <= made.truth["runs"][run.name]["initial"]["x"] <= 4.5
        assert (run.inputs["u"] == 0.25).all()
    assert made.truth["inputs"] == {"u": "0.25"}
