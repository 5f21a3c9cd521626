"""Runs of tuners in processes of their own, without a comparison around them."""

from dataclasses import replace

import pytest

from bench.problem.experiment import Entry
from bench.runs import housing
from bench.runs.survey import admit
from bench.runs.training import Lesson
from bench.runs.worker import Order, perform, problem_of
from bench.sealing.outside import Tuned
from bench.sealing.seals import SEALS
from tests.conftest import PLUGINS
from tests.experiments import spring_experiment

PROBE = str(PLUGINS / "probe.py")


def told(code, files=(), memory=0):
    """What a sealed process makes of a piece of code, as text."""
    tuned = Tuned("probe", "", PROBE, {"code": code})
    house = housing.nursery()
    child = house.start("bench.sealing.inside:serve", [PROBE, *map(str, files)], memory)
    try:
        trace = _run(child, tuned)
    finally:
        child.end()
    assert trace.status == "converged", trace.reason
    return trace.reason


def _run(child, tuned):
    import numpy as np

    from bench.runs.drive import drive
    from bench.sealing.outside import Sealed, SealedTuner
    from methods.base import Task

    observed, scale = np.zeros((3, 1)), np.ones(1)
    start, training = np.full(2, 0.5), np.array([[0.0, 0.0], [1.0, 1.0]])
    task = Task(2, start, observed, scale, training, 3, (3,))

    def evaluate(points):
        return np.zeros((len(points), 3, 1)), np.zeros(len(points))

    run = Sealed(SealedTuner(child, tuned), np.zeros(8, np.uint32), 20.0)
    return drive(run, task, evaluate, np.random.default_rng(0))


def held():
    """The seals that hold on this machine."""
    child = housing.nursery().start("bench.sealing.inside:serve")
    child.ready()
    child.end()
    return child.seals


def need(seal):
    """Skip a test, visibly, where a seal does not hold."""
    if seal not in held():
        pytest.skip(f"no seal {seal} on this machine: {SEALS[seal]}")


def experiment(name, **changes):
    """An experiment of one of the plugin's tuners, which is known afterwards."""
    tuners = {name: {}}
    made = spring_experiment(tuners=tuners, targets=2, ranges=["in"], budget=4, **changes)
    admit([PROBE], made)
    return made


def outcome(made, seed=0, target=0):
    """One run of it."""
    (entry,) = made.tuners
    sealed = problem_of(made).targets()[target].sealed
    order = Order("run", entry, seed, sealed, made.budget)
    return perform(made, replace(order, tuned=housing.tuned_of(entry)))


def lesson(name, **options):
    """One training of a known tuner."""
    entry = Entry(name, name, options)
    return Lesson(entry, 0, housing.tuned_of(entry))
