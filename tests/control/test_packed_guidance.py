"""Packed directions are the directions: against sums of B-splines written out in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

from keepout.control.guidance.guidance import GeodesicGuidance, packed

SHAPE, ORIGIN, SPACING = (9, 8, 10), np.array([-2.0, -1.5, -2.5]), 0.5
DIRECTIONS = np.random.default_rng(2).integers(-127, 128, (*SHAPE, 3)).astype(np.int8)


def guidance():
    numbers = {"speed": 0.1, "slowing_length": 1.0, "spacing": SPACING, "inner": 0.6, "outer": 1.2}
    return GeodesicGuidance(
        goal=jnp.zeros(3),
        directions=jnp.asarray(packed(DIRECTIONS)),
        nodes=jnp.asarray(SHAPE, dtype=jnp.float64),
        origin=jnp.asarray(ORIGIN),
        **{name: jnp.asarray(value) for name, value in numbers.items()},
    )


def direction(position):
    """Sum every node's direction times its cubic B-spline, wherever it is not zero."""
    spline = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    at = (position - ORIGIN) / SPACING
    x, y, z = (np.nan_to_num(spline(at[axis] - np.arange(SHAPE[axis]))) for axis in range(3))
    blended = np.einsum("i,j,k,ijka->a", x, y, z, DIRECTIONS.astype(float))
    return blended / np.linalg.norm(blended)


POSITIONS = ORIGIN + SPACING * np.random.default_rng(3).uniform(1.0, np.array(SHAPE) - 2.0, (40, 3))


def test_three_numbers_of_a_byte_are_kept():
    whole = packed(DIRECTIONS)
    kept = whole[: SHAPE[0], : SHAPE[1], : SHAPE[2]]
    assert whole.shape == (32, 32, 32)
    for axis, shift in enumerate((24, 16, 8)):
        np.testing.assert_array_equal((kept << shift) >> 24, DIRECTIONS[..., axis])


def test_the_blend_is_the_sum_of_splines_alone_and_in_a_batch():
    law = guidance()
    truth = np.stack([direction(position) for position in POSITIONS])
    np.testing.assert_allclose(jax.jit(jax.vmap(law.direction))(POSITIONS), truth, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose([law.direction(jnp.asarray(p)) for p in POSITIONS[:3]], truth[:3], rtol=0.0, atol=1e-13)


@pytest.mark.long
def test_its_derivative_is_that_of_the_blend():
    law, step = guidance(), 1e-5
    found = jax.vmap(jax.jacfwd(law.direction))(jnp.asarray(POSITIONS[:5]))
    for position, jacobian in zip(POSITIONS[:5], found, strict=True):
        for axis in range(3):
            shift = step * np.eye(3)[axis]
            difference = (direction(position + shift) - direction(position - shift)) / (2 * step)
            np.testing.assert_allclose(jacobian[:, axis], difference, rtol=0.0, atol=1e-6)
