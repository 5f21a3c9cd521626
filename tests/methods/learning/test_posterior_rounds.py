"""A posterior network with nearly all of its mass outside the bounds still gives points in them."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from methods.learning.posterior_rounds import PosteriorRounds  # noqa: E402


class Posterior:
    """Stands for the posterior of sbi: normal draws about a mean, rejection never ends."""

    def __init__(self, mean):
        self.mean = mean

    def sample(self, shape, **options):
        assert not any(options.values()), "rejection would not end"
        generator = torch.Generator().manual_seed(0)
        draws = self.mean + 0.1 * torch.randn((*shape, 2), generator=generator)
        return draws.requires_grad_()  # as those of a network


def draw_points(mean, count=1000):
    rounds = PosteriorRounds(None)
    rounds._posterior = Posterior(mean)
    return rounds._draw_points(count)


def test_points_outside_the_bounds_are_left_out_where_enough_are_inside():
    points = draw_points(0.95)
    assert 300 < len(points) < 700
    assert 0.0 <= points.min() < points.max() < 1.0


def test_points_are_moved_to_the_bounds_where_nearly_all_are_outside():
    points = draw_points(5.0)
    assert points.shape == (1000, 2)
    np.testing.assert_allclose(points, 1.0, atol=1e-5)
    # A prior of sbi does not contain its upper bound.
    assert (points.astype(np.float32) < 1.0).all()
