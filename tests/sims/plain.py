"""The compiled engine's functions as plain Python, and lanes to give them."""

from types import SimpleNamespace

from sims.engines.compiled import advance, lockstep, pace

PLAIN = SimpleNamespace(divide=pace.divide, advance=advance.advance, march=lockstep.march)


def lanes_of(simulator, theta, scenarios, monkeypatch):
    """What the simulator gives its engine."""
    seen = []
    engine = simulator.engine
    whole = engine.integrate
    monkeypatch.setattr(engine, "integrate", lambda lanes: seen.append(lanes) or whole(lanes))
    simulator.simulate_lanes(theta, scenarios)
    return seen[0]
