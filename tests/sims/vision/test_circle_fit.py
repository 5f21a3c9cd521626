"""Tests of fitting circles to edges of known centre and radius, partly replaced by a shadow's
edge.
"""

import numpy as np
import pytest

from sims.vision import circle_fit

ANGLES = np.linspace(0, 2 * np.pi, 36, endpoint=False)
TRUE = (21.3, 17.8, 7.4)


def edge(outliers=0, seed=0):
    """Return points of the true circle, the first `outliers` of them on a larger, shifted circle,
    as at a shadow's edge.
    """
    points = np.array(TRUE[:2]) + TRUE[2] * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    points += 0.05 * np.random.default_rng(seed).standard_normal(points.shape)
    aside = np.array([3.0, 4.0]) + np.array(TRUE[:2])
    points[:outliers] = (
        aside + 1.2 * TRUE[2] * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)[:outliers]
    )
    return points


@pytest.mark.parametrize("start", [(21.0, 18.0, None), (19.0, 15.0, None), (22.0, 17.0, 6.0)])
def test_fit_of_a_clean_edge_does_not_depend_on_where_it_begins(start):
    found, rest = circle_fit.fit_circle(edge(), start)
    assert found == pytest.approx(TRUE, abs=0.03)
    assert np.sqrt(np.mean(rest**2)) == pytest.approx(0.05, rel=0.3)
    assert circle_fit.find_inliers((found, rest)).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_arc_finds_the_ball_where_its_shadow_spoils_a_side(seed):
    points = edge(outliers=10, seed=seed)
    plain = circle_fit.fit_circle(points, (22.5, 19.5, None))
    by_arc = circle_fit.fit_circle(points, circle_fit.fit_arc(points))
    best = circle_fit.select_better_fit(plain, by_arc)
    assert best[0] == pytest.approx(TRUE, abs=0.1)
    assert np.abs(np.array(plain[0]) - TRUE).max() > 0.5, (
        "a subject that the plain fit gets right shows nothing"
    )


def test_no_circle_gives_no_detection():
    line = np.stack([np.arange(36.0), np.zeros(36)], axis=1)
    assert circle_fit.fit_circle(line, None) is None
    assert circle_fit.fit_arc(np.ones((36, 2))) is None
    assert circle_fit.select_better_fit(None, None) is None
    one = circle_fit.fit_circle(edge(), (21.0, 18.0, None))
    assert circle_fit.select_better_fit(one, None) is one
