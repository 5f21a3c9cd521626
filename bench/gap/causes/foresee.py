"""Search of long recordings on thinned runs first, confirmed on all samples.

The model found and its close rivals are fitted to all samples. The search is repeated on all
samples only if these show more than the thinned runs did.
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
"""Number of best single-effect models that are fitted to all samples in addition."""


def sought(search: Search) -> Model:
    """Return the model of all effects that the data show; long runs are thinned first.

    Args:
        search: the search, which contains the fitted base model.

    Raises:
        EndedError: the search had to end early.
    """
    few = thinned(search.world)
    if few is None:
        return search.run()
    try:
        return _foreseen(search, few)
    finally:
        few.close()


def _foreseen(search: Search, few: World) -> Model:
    """Search on thinned runs, then confirm the result on all samples."""
    # If the scores of the base model, which all merits need anyway, show nothing, no search is
    # needed.
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
    """Store the model that the thinned runs support without a fit, for lack of time."""
    fitter = Fitter(search.world, search.noise, search.frozen)
    (fit,) = fitter.fit([model.fit.start()], iterations=0)
    search.supported = search.enter(fit)


def _starts(sketch: Search, found: Model) -> list[Start]:
    """Return starts of fits to all samples: the result, its rivals and parts, and best singles."""
    near = [found, *rivals(sketch, found), *smaller(sketch, found)]
    near += [sketch.without(found, name) for name in found.names]
    near += of_size(sketch, 1)[:SINGLES]
    chosen = {model.names: model.fit.start() for model in near if model.names}
    return list(chosen.values())


def _likeliest(search: Search, found: Model) -> Model:
    """Return the fit to all samples of the model that was found.

    Near the noise, return the best model of its size, because thinned runs distinguish rivals less
    well.
    """
    model = search.models[frozenset(found.names)]
    best = search.best(len(found.names))
    if best is None or search.excess(model) >= FAR:
        return model
    return best


def _confirmed(search: Search, model: Model) -> bool:
    """Return whether all samples show no more effects than the thinned runs did."""
    # Far from the noise, more samples of the same runs show nothing new.
    if search.excess(model) >= FAR:
        return True
    return search.plain(model, DOUBTFUL if model.names else UNLIKELY)
