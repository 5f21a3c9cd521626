"""Small recordings, run evaluators and constructed fits for the tests of explain."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.core.plugin_registries import simulators
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import fit_base_model
from bench.diagnosis.fitting.levenberg_marquardt import FitStart, TrajectoryFit
from bench.diagnosis.fitting.trajectory_fit import TrajectoryFitter
from bench.diagnosis.search.effect_search import EffectSearch
from bench.logs.synthetic_recording import simulate_recording
from sims.core.simulator import Scenario
from sims.recording.recording import Recording, Run
from sims.recording.recording_writer import write_recording
from sims.systems.slider import Slider
from tests.simulation_arguments import simulation_spec


def recording(system="pendulum", **options):
    """Simulate a recording without writing a file."""
    return simulate_recording(simulation_spec(system, **options)).recording


def recorded(simulator, theta, starts, times, noise=0.0, seed=0, stated=True):
    """Simulate runs with any simulator; a start is an initial state or (initial state, inputs)."""
    rng, runs = np.random.default_rng(seed), []
    names = [c.name for c in simulator.channels]
    sigma = np.broadcast_to(np.asarray(noise, dtype=float), (len(names),))
    for number, start in enumerate(starts, start=1):
        initial, inputs = start if isinstance(start, tuple) else (start, {})
        scenario = Scenario(times, initial, inputs)
        seen = simulator.simulate(np.array([theta], dtype=float), scenario)[0]
        seen = seen + sigma * rng.standard_normal(seen.shape)
        columns = dict(zip(names, seen.T.copy(), strict=True))
        runs.append(Run(str(number), times, columns, dict(scenario.inputs), {}, {}, False))
    kept = {n: float(s) for n, s in zip(names, sigma, strict=True) if s and stated}
    return Recording(
        Path("made.csv"), simulator.name, "made", simulator.constant_values, kept, tuple(runs)
    )


def write_slider_log(path, effect, theta, forces, seed=0):
    """Write runs of a slider from rest, sampled at 50 Hz, of which the last one is held out.

    Args:
        path: path of the table.
        effect: effect that the simulated slider has in addition.
        theta: its mass and the coefficient of the effect.
        forces: force of each run (T,), N.
        seed: seed of the noise of the encoder, 1 mm.

    Returns:
        The path of the table.
    """
    starts = [({}, {"u": force}) for force in forces]
    slider = Slider(observe=["x"], effects=[effect])
    made = recorded(slider, theta, starts, np.arange(len(forces[0])) / 50.0, 1e-3, seed)
    runs = (*made.runs[:-1], replace(made.runs[-1], held_out=True))
    write_recording(path, replace(made, path=path, runs=runs), Slider)
    return path


def changed(run, **changes):
    """Return the run with changed channels: name=function of the recorded values."""
    channels = {n: changes.get(n, lambda v: v)(v.copy()) for n, v in run.channels.items()}
    return replace(run, channels=channels)


def with_runs(recorded, runs):
    """Return the recording with these runs, renamed 1, 2, ..."""
    return replace(
        recorded, runs=tuple(replace(run, name=str(i)) for i, run in enumerate(runs, start=1))
    )


def evaluator(recorded, **options):
    """Return the run evaluator of all runs of a recording."""
    return RunEvaluator(simulators.get(recorded.system), recorded, recorded.runs, **options)


def white(evaluator, sigma):
    """Return a white noise model with one sigma for all channels or one per channel."""
    return autoregressive(evaluator, sigma, 0.0)


def autoregressive(evaluator, sigma, phi):
    """Return an AR(1) noise model; sigma and phi are for all channels, or one per channel."""
    shape = (len(evaluator.channels),)
    sigmas, correlations = (
        np.broadcast_to(np.asarray(value, dtype=float), shape).copy() for value in (sigma, phi)
    )
    return NoiseModel(sigmas, correlations)


def fit_model(
    evaluator, noise, effects=(), theta=None, states=None, iterations=20, **fitter_options
):
    """Fit one model, by default from its nominal parameters and the estimated initial states."""
    if theta is None:
        theta = evaluator.get_nominal_theta()
    if states is None:
        states = evaluator.initial_state_guesses
    start = FitStart(effects, np.array(theta), states)
    (fit,) = TrajectoryFitter(evaluator, noise, **fitter_options).fit_models([start], iterations)
    return fit


def make_search(evaluator, noise, rng=0, fixed_parameters=frozenset(), stated=True):
    """Return a search without fits.

    Args:
        evaluator: run evaluator.
        noise: noise model.
        rng: random generator or its seed.
        fixed_parameters: indices of the parameters that are not fitted.
        stated: whether the noise of all channels, or of each of them, is stated.
    """
    shape = (len(evaluator.channels),)
    is_stated = np.broadcast_to(np.asarray(stated, dtype=bool), shape).copy()
    return EffectSearch(evaluator, noise, fixed_parameters, np.random.default_rng(rng), is_stated)


def searched(recorded, sigma, seed=0, stated=True, **options):
    """Return a search that contains the fitted base model, and that model."""
    there = evaluator(recorded, **options)
    noise = white(there, sigma)
    base = fit_base_model(there, noise)
    search = make_search(there, noise, seed, base.insensitive_parameters, stated)
    return search, search.add_fit(base.fit)


def linear_fit(jacobian, q, free=None):
    """Return a fit with this Jacobian (R, T, C, q + s); all other values are zero."""
    runs, samples, channels, size = jacobian.shape
    places = np.arange(q) if free is None else np.asarray(free)
    return TrajectoryFit(
        (),
        np.zeros(q),
        np.zeros((runs, size - q)),
        places,
        np.zeros((runs, samples, channels)),
        jacobian,
        0.0,
    )


def correlated(rng, phi, sigma, shape):
    """Return stationary AR(1) noise (R, T, C); sigma and phi are numbers or arrays (C,)."""
    made = rng.standard_normal(shape)
    for t in range(1, shape[1]):
        made[:, t] = phi * made[:, t - 1] + np.sqrt(1 - np.square(phi)) * made[:, t]
    return made * sigma


def covariance_of(seen, phi):
    """Return the (n, n) AR(1) correlations of the samples present in one channel (R, T).

    Samples on different sides of a hole are uncorrelated.
    """
    stretch = np.cumsum(~(seen & np.pad(seen, ((0, 0), (1, 0)))[:, :-1]).ravel())[seen.ravel()]
    time = np.tile(np.arange(seen.shape[1]), len(seen))[seen.ravel()]
    near = stretch[:, None] == stretch[None]
    return (
        np.where(near, float(phi) ** np.abs(time[:, None] - time), 0.0)
        if phi
        else np.eye(time.size)
    )


def everything(values):
    """Return an observed mask without missing samples."""
    return np.ones(values.shape, dtype=bool)


def holes(shape, share, seed):
    """Return an observed mask in which this fraction of samples is missing."""
    return np.random.default_rng(seed).random(shape) > share


def autocorrelation(values, lag):
    """Return the autocorrelation of values (..., T, C) at this lag in samples."""
    length = values.shape[-2]
    here, later = values[..., : length - lag, :], values[..., lag:, :]
    return float((here * later).mean() / np.square(values).mean())
