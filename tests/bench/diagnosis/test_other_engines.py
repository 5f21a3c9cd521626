"""Tests that other engines find the same cause.

One external simulator explains what the other one recorded.
"""

import pytest

from bench.diagnosis.explain import explain
from tests.simulation_arguments import simulation_spec, write

CASES = [
    ("pendulum", "drag.linear=6e-4", "mujoco", ("q",), 1.0, 30.0),
    ("slider", "friction.coulomb=0.4", "pybullet", ("x",), 1.5, 40.0),
    ("ball", "drag.quadratic=0.05", "mujoco", ("z",), 1.0, 30.0),
]
OTHER_ENGINE = {"mujoco": "pybullet", "pybullet": "mujoco"}


@pytest.mark.slow
@pytest.mark.parametrize(("system", "effect", "source", "observe", "seconds", "rate"), CASES)
def test_the_same_cause_is_named(system, effect, source, observe, seconds, rate, tmp_path):
    engine = OTHER_ENGINE[source]
    wish = simulation_spec(
        system,
        effects=[effect],
        noise=["0.004"],
        observe=observe,
        runs=3,
        seconds=seconds,
        rate=rate,
        engine=source,
        seed=3,
    )
    path = tmp_path / "data.csv"
    write(wish, path)
    answer = explain(path, engine=engine).answer
    assert answer.engine == engine
    (cause,) = answer.causes
    name, size = effect.split("=")
    assert name in (cause.effect, *cause.alternatives)
    assert answer.verdict in ("named", "ambiguous")
    if cause.effect == name:
        found = cause.coefficients["coefficient"]
        assert found.value == pytest.approx(float(size), rel=0.2)
