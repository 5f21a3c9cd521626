"""Identifiability check before a fit: parameters and causes that a recording can identify."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import fit_base_model
from bench.diagnosis.identifiability import ParameterIdentifiability, assess_identifiability
from bench.diagnosis.validation.confidence_intervals import compute_central_jacobian
from bench.logs.filter_settling import leave_out_settling
from bench.logs.recording_loading import load_recording
from bench.logs.segmentation import segment_recording
from sims.core.simulator import InputError
from sims.recording.recording import Recording
from sims.system_simulator import SystemSimulator


def check_identifiability(
    source: str | Path | Recording,
    system: str | None = None,
    model: str | Path | None = None,
    free: Sequence[str] = (),
) -> tuple[ParameterIdentifiability, ...]:
    """Assess which free numbers and which causes a recording can identify.

    The base model is fitted first. The derivatives of the runs at the fit then show what the
    recording can determine; white noise is assumed, so no correlation is estimated.

    Args:
        source: Recording, or the path of its table.
        system: Name of the system to use instead of the one in the description.
        model: Model file of a robot to use instead of the one in the description.
        free: Numbers of a robot's model file, or constants of a system, that are estimated.

    Returns:
        Identifiability of each free number, then of each cause.

    Raises:
        InputError: The recording cannot be read, or its simulator takes no effects.
    """
    recording, kind = load_recording(source, system, model, free)
    if not issubclass(kind, SystemSimulator):
        raise InputError(f"{recording.path}: simulator {recording.system} takes no effects")
    recording, _ = leave_out_settling(recording, kind)
    recording, _ = segment_recording(recording, kind)
    engine = kind.default_engine if kind.own_engine else "batch"
    constants = () if kind.has_model else tuple(free)
    with closing(ForkedWorkerPool(1)) as worker_pool:
        evaluator = RunEvaluator(kind, recording, recording.training(), engine, (), constants)
        evaluator.worker_pool = worker_pool
        worker_pool.register(evaluator)
        noise = NoiseModel.make_white(compute_noise_floor(evaluator, recording).sigma)
        base = fit_base_model(evaluator, noise)
        if not np.isfinite(base.fit.cost):
            raise InputError(
                f"{recording.path}: the simulation fails at every starting point of the fit; "
                "check constants, units, inputs and initial states"
            )
        # Derivatives of the runs at the fit.
        numbers = assess_identifiability(
            evaluator, noise, compute_central_jacobian(evaluator, base.fit, noise)
        )
        evaluator.close()
    return numbers
