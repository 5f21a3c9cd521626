import numpy as np
from scipy.spatial.transform import Rotation

from sims.core.rotations import compute_quaternions
from sims.robot.inertia_tensors import compute_inertia_tensors


def test_tensors_are_rotated_as_by_scipy_for_quaternions_of_any_length():
    rng = np.random.default_rng(0)
    quaternions, moments = rng.standard_normal((6, 4)), rng.uniform(0.1, 2.0, (6, 3))
    axes = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    expected = axes @ (moments[:, :, None] * np.swapaxes(axes, 1, 2))
    np.testing.assert_allclose(
        compute_inertia_tensors(quaternions, moments), expected, rtol=1e-12, atol=1e-12
    )


def test_quaternions_of_rotation_matrices_are_those_of_scipy_up_to_their_sign():
    half_turns = Rotation.from_matrix([np.diag([1, -1, -1]), np.diag([-1, -1, 1]), np.eye(3)])
    rotations = Rotation.concatenate([Rotation.random(50, random_state=0), half_turns])
    found, expected = compute_quaternions(rotations.as_matrix()), np.roll(rotations.as_quat(), 1, 1)
    signs = np.sign(np.sum(found * expected, axis=1))[:, None]
    np.testing.assert_allclose(found * signs, expected, rtol=0, atol=1e-14)
