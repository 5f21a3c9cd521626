import numpy as np
from scipy.spatial.transform import Rotation

from sims.robot.inertia_tensors import compute_inertia_tensors


def test_tensors_are_rotated_as_by_scipy_for_quaternions_of_any_length():
    rng = np.random.default_rng(0)
    quaternions, moments = rng.standard_normal((6, 4)), rng.uniform(0.1, 2.0, (6, 3))
    axes = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    expected = axes @ (moments[:, :, None] * np.swapaxes(axes, 1, 2))
    np.testing.assert_allclose(
        compute_inertia_tensors(quaternions, moments), expected, rtol=1e-12, atol=1e-12
    )
