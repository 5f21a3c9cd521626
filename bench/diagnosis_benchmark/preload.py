"""Modules that the fork server preloads, so that no diagnosis has to import or compile them.

They are numerical packages, the search for causes, the effects and the compiled integration steps.
No recording of a case is loaded: each system is simulated and searched once with made-up data.
"""

from __future__ import annotations

from contextlib import closing

import scipy.signal
import scipy.special
import scipy.stats  # noqa: F401 - loaded ahead

import bench.diagnosis.explain
import bench.diagnosis_benchmark.diagnoser_process  # noqa: F401 - loaded ahead
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import fit_base_model
from bench.diagnosis.search.candidate_directions import compute_directions
from bench.diagnosis_benchmark.case_generation.case_sampling import SYSTEMS
from bench.logs.synthetic_recording import SimulationSpec, simulate_recording
from sims.engines.compiled import element_stepping
from sims.system_simulator import SystemSimulator

_NOISE_SIGMA = 1e-3
"""Noise standard deviation of the recordings used for the warm-up."""


def _warm_up_search(system: str) -> None:
    """Fit a simulated recording of a system and compute the direction of each effect.

    A direction is the first-order change of the recording by an effect. The result is discarded:
    the call makes Python import and compile what every diagnosis needs, once for all processes that
    are forked from this one.

    Args:
        system: name of the system, such as ``pendulum``.
    """
    specification = SimulationSpec(
        system=system, noise={"*": _NOISE_SIGMA}, runs=2, seconds=0.5, rate=50.0, engine="batch"
    )
    simulated = simulate_recording(specification)
    simulator_class = type(simulated.simulator)
    assert issubclass(simulator_class, SystemSimulator)  # for the type checker
    with closing(
        RunEvaluator(simulator_class, simulated.recording, simulated.recording.training(), "batch")
    ) as evaluator:
        noise = NoiseModel.make_white(compute_noise_floor(evaluator, simulated.recording).sigma)
        compute_directions(evaluator, fit_base_model(evaluator, noise).fit, evaluator.library)


element_stepping.COMPILED.load()
for _system in SYSTEMS:
    _warm_up_search(_system)
