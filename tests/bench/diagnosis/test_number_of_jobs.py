"""Tests that the answer does not depend on the number of processes."""

import json
import sys

import pytest

from bench.api import explain as api
from bench.diagnosis.evaluation import forked_workers, run_evaluator
from bench.diagnosis.evaluation.forked_workers import ForkedWorkerPool
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.explain import explain
from bench.diagnosis.fitting import trajectory_fit
from sims.core.simulator import InputError
from tests.bench.diagnosis.explained_samples import recording


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux alone")
def test_the_answer_is_the_same_to_the_last_bit_with_one_and_eight(monkeypatch):
    # Use small chunks and force workers for all of them, so that the pool is tested.
    monkeypatch.setattr(forked_workers, "can_fork", lambda: True)
    monkeypatch.setattr(RunEvaluator, "is_cheap_to_split", True)
    monkeypatch.setattr(trajectory_fit, "GROUP_COST_SAMPLES", 10_000)
    monkeypatch.setattr(run_evaluator, "MAX_CHUNK_SAMPLES", 4_000)
    monkeypatch.setattr(forked_workers, "PARALLEL_THRESHOLD_SECONDS", 0.0)
    shared = []
    usual = ForkedWorkerPool._distribute

    def counted(self, *given):
        shared.append(len(self._workers))
        return usual(self, *given)

    monkeypatch.setattr(ForkedWorkerPool, "_distribute", counted)
    swing = recording(
        effects=["drag.linear=1e-3", "friction.coulomb=2e-3", "force.bias=0.02"],
        noise=["q=0.003", "qd=0.02"],
        runs=3, seconds=1.0, rate=60.0,
    )  # fmt: skip
    documents = []
    for jobs in (1, 8):
        shared.clear()
        document = explain(swing, jobs=jobs).answer.to_document()
        document.pop("seconds")
        documents.append(json.dumps(document))
        assert set(shared) == ({jobs} if jobs > 1 else set())
        assert jobs == 1 or len(shared) > 10
    assert documents[0] == documents[1]


@pytest.mark.parametrize("jobs", [0, -2])
def test_there_is_at_least_one_process(jobs):
    with pytest.raises(InputError, match="jobs: expected a whole number of at least 1, found"):
        api.explain("missing.csv", jobs=jobs)
