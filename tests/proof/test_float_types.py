"""The certificate's evaluation error against evaluation: right for float32 and float64, not for any shorter type."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from truths.networks import random_field

from keepout.errors import FieldError
from keepout.fields.evaluate import values
from keepout.fields.model import FieldModel
from keepout.geometry.level_points import surface_points
from keepout.geometry.target import Target
from keepout.proof.bounds import Network, boxes, upper_bounds
from keepout.proof.certificate import certify


def cast(field, dtype):
    layers = field.layers
    return dataclasses.replace(
        field, layers=type(layers)(*(tuple(array.astype(dtype) for array in group) for group in layers))
    )


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 5])
def test_a_half_float_network_breaks_the_bound_of_its_own_numbers(seed):
    """Why it is refused: the same numbers, certified in a type that is certified, do not bound what it evaluates."""
    target = Target.load("box", parameters={"length": 2.0, "width": 1.0, "height": 1.0})
    points = surface_points(target.distance, 50_000, np.random.default_rng(0))
    field = random_field(seed)
    # Its largest value on the surface near 0, where the certificate has little slack.
    high = float(values(field, points).max()) / float(field.scale)
    biases = field.layers.biases
    field = dataclasses.replace(field, layers=field.layers._replace(biases=(*biases[:-1], biases[-1] - high)))
    rounded = cast(field, jnp.float16)
    model = FieldModel(cast(rounded, jnp.float64), target.name, target.sha256, 0.03, {})
    proof = certify(model, target).certificate(0.0)
    exact, evaluated = values(model.field, points), values(rounded, points)
    assert exact.max() <= proof.error_bound
    over, off = evaluated.max() - proof.error_bound, np.abs(evaluated - exact).max()
    print(f"float16 exceeds e_h by {1e3 * over:.1f} mm, and is off by up to {1e3 * off:.1f} mm")
    assert over > 1e-3
    assert off > 1e6 * proof.evaluation_error
    with pytest.raises(FieldError, match="a network must be float32 or float64"):
        dataclasses.replace(model, field=rounded)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_evaluation_error_covers_each_type(dtype):
    """Against the same numbers in long doubles."""
    field = random_field(3, dtype=dtype)
    generator = np.random.default_rng(0)
    x = generator.uniform(-1.0, 1.0, (2000, 3))
    if dtype == jnp.float32:
        x = x.astype(np.float32).astype(np.float64)
    a = x.astype(np.longdouble)
    numbers = [
        (np.asarray(W, np.longdouble), np.asarray(b, np.longdouble))
        for W, b in zip(field.layers.weights, field.layers.biases)
    ]
    for W, b in numbers[:-1]:
        z = field.beta * (a @ W.T + b)
        a = (np.maximum(z, 0) + np.log1p(np.exp(-np.abs(z)))) / field.beta
    exact = (a @ numbers[-1][0].T + numbers[-1][1])[:, 0]
    centre, scale = np.asarray(field.continuation.centre), float(field.scale)
    inside = np.linalg.norm(x * scale, axis=1) < float(field.continuation.target_radius)
    evaluated = values(field, centre + scale * x) / scale
    answer = upper_bounds(Network.of(field.layers, field.beta), boxes(x, np.zeros_like(x)))
    off = np.abs(evaluated - np.asarray(exact, np.float64))[inside]
    bound = answer.evaluation_error[inside]
    # The normalisation's own rounding is a term apart in the certificate.
    assert (off <= bound + 1e-12).all()
    assert off.max() > 1e-3 * bound.max()
    if dtype == jnp.float64:
        assert bound.max() < 1e-9


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16, jnp.float32])
def test_a_continuation_of_shorter_floats_is_refused(dtype):
    """The proof takes its radii as float64 numbers; squared in float16, 300 m is infinite and nothing is outside."""
    field = random_field(3)
    names = [entry.name for entry in dataclasses.fields(field.continuation)]
    FieldModel(field, "any", "0" * 64, 0.03, {})
    for name in names:
        short = dataclasses.replace(
            field.continuation, **{name: jnp.asarray(getattr(field.continuation, name)).astype(dtype)}
        )
        with pytest.raises(FieldError, match=f"continuation.{name} is .*; it must be float64"):
            FieldModel(dataclasses.replace(field, continuation=short), "any", "0" * 64, 0.03, {})


@pytest.mark.parametrize("beta", [1e-42, 1e39])
def test_a_sharpness_that_float32_does_not_hold_is_refused(beta):
    """Of such a network nothing finite is evaluated, and the proof of a tiny one even fell to -inf."""
    field = dataclasses.replace(random_field(3, dtype=jnp.float32), beta=beta)
    with pytest.raises(FieldError, match="a float32 holds"):
        FieldModel(field, "any", "0" * 64, 0.03, {})
