"""Long recordings are searched with fewer samples, and all of them have the last word."""

import numpy as np
import pytest

from bench.gap.causes import foresee
from bench.gap.causes.foresee import sought
from bench.gap.causes.search import Search
from bench.gap.causes.settle import settle
from bench.gap.model import thinning
from bench.gap.model.watch import EndedError, Watch
from tests.bench.gap.made import recording, searched

SIGMA = [0.003]
RUBBED = {"effects": ["friction.coulomb=0.3"], "observe": ["x"], "noise": ["x=0.003"]}


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    """What is long is short here."""
    monkeypatch.setattr(thinning, "LONG", 600)
    monkeypatch.setattr(thinning, "LEFT", 100)


@pytest.fixture(scope="module")
def log():
    return recording("slider", runs=2, seconds=1.5, rate=400.0, seed=3, **RUBBED)


@pytest.fixture
def search(log):
    return searched(log, SIGMA)[0]


@pytest.mark.slow
def test_what_few_samples_show_is_fitted_to_all_of_them(search, log, monkeypatch):
    found = settle(search, sought(search))
    assert found.names == ("friction.coulomb",)
    assert found.fit.simulated.shape == search.world.observed.shape
    assert search.settled == {"friction.coulomb"}
    monkeypatch.setattr(thinning, "LONG", 10_000)
    usual = searched(log, SIGMA)[0]
    same = settle(usual, sought(usual))
    assert same.names == found.names
    (place,) = search.world.places("friction.coulomb")
    assert found.fit.theta[place] == pytest.approx(same.fit.theta[place], rel=1e-3)
    assert len(search.models) < len(usual.models), "few of them are fitted to all samples"


def test_where_all_samples_show_more_the_search_is_made_on_all(search, monkeypatch):
    monkeypatch.setattr(foresee, "_confirmed", lambda search, model: False)
    asked = []
    run = Search.run

    def counted(self):
        asked.append(self.world.observed.shape[1])
        return run(self)

    monkeypatch.setattr(Search, "run", counted)
    assert sought(search).names == ("friction.coulomb",)
    assert asked == [150, 600]
    assert search.settled is None


def test_what_shows_nothing_is_not_searched_with_fewer_samples(monkeypatch):
    clean = recording(
        "slider", runs=2, seconds=1.5, rate=400.0, seed=3, observe=["x"], noise=["x=0.003"]
    )
    search, base = searched(clean, SIGMA)
    monkeypatch.setattr(foresee, "settle", None)
    assert sought(search) is base


def test_a_search_that_has_to_end_tells_what_few_samples_support(search, monkeypatch):
    ended = Watch(stop=lambda: any(len(m.names) > 0 for m in foreseen))
    foreseen = []
    enter = Search.enter

    def watched(self, fit):
        model = enter(self, fit)
        if self is not search:
            foreseen.append(model)
        return model

    monkeypatch.setattr(Search, "enter", watched)
    search.world.watch = ended
    with pytest.raises(EndedError):
        sought(search)
    assert search.supported is not None
    assert np.isfinite(search.supported.merit)
    assert search.so_far() is search.supported
