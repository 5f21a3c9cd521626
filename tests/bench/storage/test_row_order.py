"""Test of the order of rows and statuses: it is that of the plan, not of the ends of runs."""

import pandas as pd

from bench.benchmark.storage.result_folder import write_results
from bench.benchmark.storage.run_journal import RunJournal
from tests.bench.storage.test_run_journal import filled


def test_results_stand_in_the_order_of_the_plan(tmp_path):
    order = [5, 0, 3, 1, 4, 2]
    filled(tmp_path, order).close()
    journal = RunJournal(tmp_path)
    trainings = [("b", 1, 7, 0.5), ("b", 0, 7, 0.5), ("a", 0, 7, 0.5)]
    skipped = [{"run": "c", "tuner": "c", "status": "skipped", "reason": "not installed"}]
    write_results(tmp_path, journal, trainings, skipped)
    journal.close()
    statuses = pd.read_csv(tmp_path / "status.csv")
    assert statuses["run"].tolist() == [f"t/{place}" for place in range(6)] + ["c"]
    runs = pd.read_parquet(tmp_path / "runs.parquet")
    assert runs["run"].tolist() == [f"t/{place}" for place in range(6) for _ in range(4)]
    assert runs["k"].tolist() == [0, 1, 2, 3] * 6
    training = pd.read_csv(tmp_path / "training.csv")
    assert training[["tuner", "seed"]].to_numpy().tolist() == [["a", 0], ["b", 0], ["b", 1]]
