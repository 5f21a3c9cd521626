"""Long recordings: the search goes over fewer of their samples, and all of them confirm it.

What it finds is fitted to all samples, with everything that came near it. Only where they show more
than the few did, the search is made again on all of them.
"""

from __future__ import annotations

from bench.gap.causes.search import DOUBTFUL, FAR, UNLIKELY, Search, of_size
from bench.gap.causes.settle import rivals, settle, smaller
from bench.gap.model.fit import Fitter
from bench.gap.model.models import Model
from bench.gap.model.problem import Start
from bench.gap.model.thinning import thinned
from bench.gap.model.watch import EndedError
from bench.gap.model.world import World

SINGLES = 6
"""So many of the best models with one effect are fitted to all samples besides."""


def sought(search: Search) -> Model:
    """The model of all effects that the data show: `Search.run`, with fewer steps where runs are
    long.

    Args:
        search: with the base model entered.

    Raises:
        EndedError: the search has to end before.
    """
    few = thinned(search.world)
    if few is None:
        return search.run()
    try:
        return _foreseen(search, few)
    finally:
        few.close()


def _foreseen(search: Search, few: World) -> Model:
    """`sought`, in a world of fewer samples first."""
    # what shows nothing at the first look, whose scores all merits need, takes no search
    if search.plain(search.base, UNLIKELY):
        return search.run()
    rng = search.drawing("fewer samples")
    given = few, search.noise, search.frozen, rng, search.stated
    sketch = Search(*given, thorough=search.thorough)
    sketch.refit([search.base.fit.start()])
    try:
        found = settle(sketch, sketch.run())
    except EndedError:
        _enter(search, sketch.so_far())
        raise
    starts = _starts(sketch, found)
    if starts:
        search.refit(starts)
    model = _likeliest(search, found)
    if not _confirmed(search, model):
        return search.run()
    search.settled = frozenset(model.names)
    search.supported = model
    return model


def _enter(search: Search, model: Model) -> None:
    """Take over what the few samples support as it stands: there is no time to fit it to all."""
    fitter = Fitter(search.world, search.noise, search.frozen)
    (fit,) = fitter.fit([model.fit.start()], iterations=0)
    search.supported = search.enter(fit)


def _starts(sketch: Search, found: Model) -> list[Start]:
    """Where fits to all samples begin: what was found, its rivals, its parts, the best singles."""
    near = [found, *rivals(sketch, found), *smaller(sketch, found)]
    near += [sketch.without(found, name) for name in found.names]
    near += of_size(sketch, 1)[:SINGLES]
    chosen = {model.names: model.fit.start() for model in near if model.names}
    return list(chosen.values())


def _likeliest(search: Search, found: Model) -> Model:
    """The model that was found, as fitted to all samples; near the noise the best of its size, as
    few samples tell rivals apart less well.
    """
    model = search.models[frozenset(found.names)]
    best = search.best(len(found.names))
    if best is None or search.excess(model) >= FAR:
        return model
    return best


def _confirmed(search: Search, model: Model) -> bool:
    """Whether all samples show no more than the few did."""
    # far from the noise more samples of the same runs show nothing new
    if search.excess(model) >= FAR:
        return True
    return search.plain(model, DOUBTFUL if model.names else UNLIKELY)
