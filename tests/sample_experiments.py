"""Build a small experiment on the test simulator."""

from bench.benchmark.problem.experiment_config import parse_experiment

SPRING = {
    "simulator": "spring",
    "observe": ["x"],
    "targets": 4,
    "seeds": 2,
    "budget": 12,
    "timeout": 60,
    "sampling": {"rate": 20.0, "samples": 60},
    "initial": {"x": [0.8, 1.2]},
    "salt": "public",
    "tuners": {"random": {}},
}


def spring_experiment(path="spring-test.toml", **changes):
    from pathlib import Path

    return parse_experiment("spring-test", {**SPRING, **changes}, Path(path))
