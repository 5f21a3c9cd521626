"""Tests of fitting circles to edges of known centre and radius; the tracker's have shadows."""

import numpy as np
import pytest

from sims.vision import circle_fit

TRUE = (21.3, 17.8, 7.4)


@pytest.mark.parametrize("start", [(21.0, 18.0, None), (19.0, 15.0, None), (22.0, 17.0, 6.0)])
def test_fit_of_a_clean_edge_does_not_depend_on_where_it_begins(start):
    angles = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    edge = np.array(TRUE[:2]) + TRUE[2] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    edge += 0.05 * np.random.default_rng(0).standard_normal(edge.shape)
    found, rest = circle_fit.fit_circle(edge, start)
    assert found == pytest.approx(TRUE, abs=0.03)
    assert np.sqrt(np.mean(rest**2)) == pytest.approx(0.05, rel=0.3)
    assert circle_fit.find_inliers((found, rest)).all()
