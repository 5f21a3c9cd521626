import numpy as np
from scipy.spatial.transform import Rotation

from sims.robot.inertia_tensors import compute_inertia_tensors, compute_principal_axes


def test_tensors_are_rotated_as_by_scipy():
    rng = np.random.default_rng(0)
    quaternions, moments = rng.standard_normal((6, 4)), rng.uniform(0.1, 2.0, (6, 3))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    axes = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    expected = axes @ (moments[:, :, None] * np.swapaxes(axes, 1, 2))
    np.testing.assert_allclose(
        compute_inertia_tensors(quaternions, moments), expected, rtol=1e-12, atol=1e-12
    )


def test_principal_axes_give_the_tensors_again():
    rng = np.random.default_rng(1)
    half_turns = Rotation.from_matrix([np.diag([1, -1, -1]), np.diag([-1, -1, 1]), np.eye(3)])
    rotations = Rotation.concatenate([Rotation.random(50, random_state=0), half_turns])
    axes, moments = rotations.as_matrix(), rng.uniform(0.1, 2.0, (len(rotations), 3))
    tensors = axes @ (moments[:, :, None] * np.swapaxes(axes, 1, 2))
    found, quaternions = compute_principal_axes(tensors)
    np.testing.assert_allclose(found, np.sort(moments, axis=1), rtol=1e-12)
    np.testing.assert_allclose(compute_inertia_tensors(quaternions, found), tensors, atol=1e-14)
