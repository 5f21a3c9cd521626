"""Helpers to test the functions of the compiled engine as plain Python."""

from types import SimpleNamespace

from sims.engines.compiled import element_stepping, lockstep_stepping, step_size

PLAIN = SimpleNamespace(
    choose_step_divisions=step_size.choose_step_divisions,
    step_block=element_stepping.step_block,
    step_in_lockstep=lockstep_stepping.step_in_lockstep,
)


def lanes_of(simulator, theta, scenarios, monkeypatch):
    """Return the batch that the simulator passes to its engine."""
    seen = []
    engine = simulator.engine
    whole = engine.integrate
    monkeypatch.setattr(engine, "integrate", lambda lanes: seen.append(lanes) or whole(lanes))
    simulator.simulate_batch(theta, scenarios)
    return seen[0]
