import numpy as np
import pytest

from methods.learning.history_transformer import (
    HistoryTransformerDesign,
    draw_binary_search,
    get_weight_shapes,
    make_ordered_histories,
    make_shuffled_histories,
    predict_proposals,
)
from methods.tuners.in_context import InContextTransformer
from tests.methods.test_tunenet import Toy, errors, run


@pytest.fixture(scope="module")
def fitted():
    tuner = InContextTransformer(scenarios=40, points=60, noise=0.0)
    tuner.fit(Toy(), np.random.default_rng(0), 10_000)
    return tuner


def test_a_first_guess_without_a_simulation_and_then_steps_that_fall(fitted):
    error = errors(fitted, Toy())
    assert error[0] < 0.02
    assert error[1] < 2e-3
    assert error[3] < 5e-5
    assert error[10] < 1e-8
    wide = errors(fitted, Toy(), wide=True)
    assert wide[1] < 0.05
    assert wide[10] < 1e-6


def test_what_was_tried_before_changes_what_is_proposed(fitted):
    network = fitted._fitted.clean
    rng = np.random.default_rng(1)
    target, *shown = rng.normal(size=(3, network.design.seen))
    points = [np.array([0.4]), np.array([0.6])]
    alone = network.propose_next(target, shown[1:], points[1:])
    assert not np.allclose(network.propose_next(target, shown, points), alone, atol=1e-6)
    # points before the window are ignored
    long = [shown[0]] * network.design.window
    for before in (shown[1:], shown[:1] * 3):
        found = network.propose_next(target, before + long, [points[0]] * (len(before) + len(long)))
        assert np.array_equal(found, network.propose_next(target, long, [points[0]] * len(long)))


def test_a_simulation_that_shows_the_target_is_where_it_stays(fitted):
    toy = Toy()
    truth, scenario = np.array([0.55]), np.array([1.3])
    network = fitted._fitted.clean
    row = network.apply_weights(
        network.input_features(toy.observe(truth[None], scenario), toy.lengths, toy.scene)
    )[0]
    far = network.apply_weights(
        network.input_features(toy.observe(truth[None] - 0.2, scenario), (60,), toy.scene)
    )
    found = network.propose_next(row, [*far, row], [truth - 0.2, truth])
    assert found == pytest.approx(truth, abs=1e-7)


def test_no_token_hears_a_later_one():
    design = HistoryTransformerDesign(published=True)
    rng = np.random.default_rng(0)
    w = {
        name: 0.3 * rng.normal(size=shape)
        for name, shape in get_weight_shapes(5, 2, design).items()
    }
    target, shown = rng.normal(size=design.seen), rng.normal(size=(4, design.seen))
    tried = rng.normal(size=(4, 2))
    whole = predict_proposals(np, w, design, target, shown, tried)
    for k in range(4):
        assert predict_proposals(np, w, design, target, shown[:k], tried[:k]) == pytest.approx(
            whole[: k + 1], abs=1e-12
        )


def test_the_published_aim_searches_and_begins_at_the_start():
    toy = Toy()
    tuner = InContextTransformer(
        published=True, window=3, scenarios=20, points=60, noise=0.0, epochs=20
    )
    tuner.fit(toy, np.random.default_rng(0), 10_000)
    assert toy.calls == [8] * 20
    trace, _ = run(tuner, toy, 0)
    assert np.array_equal(trace.proposals[0], trace.recommendations[0])
    assert len(trace.proposals) == 10


def test_histories_are_binary_searches_for_their_first_point():
    class Box:
        training = np.array([[0.2, 0.0], [0.6, 1.0]])

        def sample(self, rng, n):
            return rng.uniform(*self.training, size=(n, 2))

    widths = []
    for seed in range(200):
        target, *points = draw_binary_search(Box(), np.random.default_rng(seed), 8)
        low, high = Box.training.copy()
        for point in points:
            assert ((low <= point) & (point <= high)).all()
            low, high = np.where(point < target, point, low), np.where(point < target, high, point)
        widths.append((high - low) / [0.4, 1.0])
    # seven halvings leave 0.008; points that randomly miss the centre leave more
    assert 0.008 < np.median(widths) < 0.05


def test_histories_name_no_target_among_what_was_tried():
    drawn = make_shuffled_histories(np.random.default_rng(0), 8, 7)
    assert all(sorted([t, *rest]) == list(range(8)) for t, rest in zip(*drawn, strict=True))
    assert not np.array_equal(drawn.tried[0], np.sort(drawn.tried[0]))
    ordered = make_ordered_histories(8, 3)
    assert ordered.targets.tolist() == [0] * 5
    assert ordered.tried[[0, -1]].tolist() == [[1, 2, 3], [5, 6, 7]]
