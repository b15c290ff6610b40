"""Rotations agree with SciPy and round-trip through roll-pitch-yaw."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from morphgen.model import rotation
from morphgen.model.kinematics_torch import rotation_from_z

ANGLES = st.floats(-math.pi, math.pi, allow_nan=False)
RPY = st.tuples(ANGLES, st.floats(-math.pi / 2, math.pi / 2), ANGLES)


@given(RPY)
def test_rpy_follows_the_fixed_axis_convention_of_urdf(rpy):
    ours = np.array(rotation.to_matrix(rotation.from_rpy(rpy)))
    np.testing.assert_allclose(ours, Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-12)


@given(RPY)
def test_rpy_round_trips_through_quaternions_even_near_gimbal_lock(rpy):
    q = rotation.from_rpy(rpy)
    back = rotation.from_rpy(rotation.to_rpy(q))
    np.testing.assert_allclose(rotation.to_matrix(back), rotation.to_matrix(q), atol=1e-8)


@given(RPY, RPY)
def test_product_is_the_product_of_matrices(a, b):
    qa, qb = rotation.from_rpy(a), rotation.from_rpy(b)
    product = np.array(rotation.to_matrix(rotation.multiply(qa, qb)))
    expected = np.array(rotation.to_matrix(qa)) @ np.array(rotation.to_matrix(qb))
    np.testing.assert_allclose(product, expected, atol=1e-12)


@given(RPY)
def test_quaternions_round_trip_through_matrices(rpy):
    q = rotation.from_rpy(rpy)
    assert q[0] >= 0
    back = rotation.from_matrix(rotation.to_matrix(q))
    assert min(np.abs(np.subtract(back, q)).max(), np.abs(np.add(back, q)).max()) < 1e-7


def test_a_zero_quaternion_is_an_error():
    with pytest.raises(ValueError, match="invalid rotation quaternion"):
        rotation.normalize((0.0, 0.0, 0.0, 0.0))


def test_the_smallest_rotation_from_z_maps_z_to_any_axis():
    axes = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    axes = torch.cat([axes / axes.norm(dim=1, keepdim=True), torch.eye(3), -torch.eye(3)])
    R = rotation_from_z(axes)
    torch.testing.assert_close(R[..., 2], axes, atol=1e-5, rtol=0)
    torch.testing.assert_close(R @ R.transpose(1, 2), torch.eye(3).expand_as(R), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(R)), atol=1e-5, rtol=0)
    # It is the smallest: its angle is that between z and the axis.
    cosine = (R.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2
    torch.testing.assert_close(cosine, axes[:, 2], atol=1e-5, rtol=0)
