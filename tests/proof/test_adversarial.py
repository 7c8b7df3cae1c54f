"""The certificate attacked at full size: many random networks, every shipped field, and one weight bumped.

The bound is broken if any of ten million random points, or any of ten thousand gradient ascents, finds a larger value.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.elements import points_in, random_elements
from truths.networks import random_layers

from keepout.errors import FieldError
from keepout.fields import mlp
from keepout.fields.evaluate import values, values_and_gradients
from keepout.fields.model import FieldModel
from keepout.fields.shipped import load_shipped, shipped_names
from keepout.geometry.level_points import surface_points
from keepout.geometry.target import Target
from keepout.learning.shipped import CHASER_RADII
from keepout.proof import bounds
from keepout.proof.certificate import certify

SHAPES = ((3, 8, 1), (3, 16, 16, 1), (3, 32, 32, 1), (3, 16, 16, 16, 16, 1))
SHARPNESS = (100.0, 1.0, 20.0, 400.0, 5.0, 100.0, 200.0, 50.0)
ELEMENTS = 50


@functools.partial(jax.jit, static_argnames=("beta", "wide"))
def evaluated(layers, beta, x, wide):
    layers = jax.tree.map(lambda a: a.astype(jnp.float64), layers) if wide else layers
    return mlp.value_and_gradient(layers, beta, x if wide else x.astype(jnp.float32))


@functools.partial(jax.jit, static_argnames=("beta", "wide"))
def value(layers, beta, x, wide):
    layers = jax.tree.map(lambda a: a.astype(jnp.float64), layers) if wide else layers
    return mlp.value(layers, beta, x if wide else x.astype(jnp.float32))


def random_network(seed):
    """Various widths and depths, sharpness 1 to 400, and weights 0.3 to 2 times the usual size."""
    rng = np.random.default_rng(seed)
    layers = random_layers(seed, SHAPES[seed % len(SHAPES)], jnp.float32)
    weights = tuple(W * np.float32(rng.uniform(0.3, 2.0)) for W in layers.weights)
    return mlp.Layers(weights, layers.biases), SHARPNESS[seed % len(SHARPNESS)]


def ascend(layers, beta, elements, rng, each):
    """Largest value that gradient ascent inside each element finds, from `each` starts an element."""
    columns = elements.columns
    m = columns.shape[1]
    triangle = elements.kind == "triangle"
    t = rng.dirichlet(np.ones(3), size=(each, m)) if triangle else rng.uniform(-1.0, 1.0, size=(each, m, 3))
    best = np.full(m, -np.inf)
    for step in np.geomspace(1.0, 0.02, 25):
        if triangle:
            x = np.einsum("emk,kmi->emi", t, columns)
        else:
            x = columns[0] + np.einsum("emk,kmi->emi", t, columns[1:])
        found, gradient = (np.asarray(a) for a in evaluated(layers, beta, x.reshape(-1, 3), True))
        best = np.maximum(best, found.reshape(each, m).max(axis=0))
        gradient = gradient.reshape(each, m, 3)
        if triangle:  # exponentiated gradient keeps the weights of the corners on the simplex
            rise = np.einsum("emi,kmi->emk", gradient, columns)
            rise -= rise.max(axis=2, keepdims=True)
            t = t * np.exp(10.0 * step * rise / np.maximum(np.abs(rise).max(axis=2, keepdims=True), 1e-12))
            t /= t.sum(axis=2, keepdims=True)
        else:
            rise = np.einsum("emi,kmi->emk", gradient, columns[1:])
            t = np.clip(t + step * np.sign(rise), -1.0, 1.0)
    return best


def attack_network(seed, points, starts):
    """Smallest of bound - value over all elements, and of the float32 bound less the float32 error."""
    rng = np.random.default_rng(1000 + seed)
    layers, beta = random_network(seed)
    network = bounds.Network.of(layers, beta)
    margins, roundings = [], []
    for kind in ("triangle", "box"):
        elements = random_elements(kind, rng, ELEMENTS, 10 ** rng.uniform(-3.0, -0.3))
        answer = bounds.upper_bounds(network, elements)
        best = ascend(layers, beta, elements, rng, starts // (2 * ELEMENTS))
        piece = min(200, points // (2 * ELEMENTS))
        for _ in range(points // (2 * ELEMENTS * piece)):
            x = points_in(elements, rng, piece).reshape(-1, 3)
            exact = np.asarray(value(layers, beta, x, True))
            best = np.maximum(best, exact.reshape(piece, -1).max(axis=0))
        rough = np.asarray(value(layers, beta, x, False), np.float64)
        off = np.abs(rough - exact).reshape(piece, -1).max(axis=0)
        margins.append((answer.upper - best).min())
        roundings.append((answer.evaluation_error - off).min())
    return min(margins), min(roundings)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_a_few_random_networks(seed):
    margin, rounding = attack_network(seed, points=20_000, starts=1000)
    assert margin >= 0.0
    assert rounding >= 0.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(50))
def test_fifty_random_networks_at_full_size(seed):
    margin, rounding = attack_network(seed, points=10_000_000, starts=10_000)
    print(f"network {seed}: smallest margin {margin:.3e}, of the float32 error {rounding:.3e}")
    assert margin >= 0.0
    assert rounding >= 0.0


def on_contact(distance, x, radius):
    """The points moved onto {d = radius} along the distance's gradient, less those that do not arrive."""
    if radius == 0.0:
        return distance.closest(x)[1]
    for _ in range(3):
        d, away = distance.distance_and_gradient(x)
        x = x + (radius - d)[:, None] * away
    return x[np.abs(distance.distance(x) - radius) < 1e-9]


def contact_points(distance, radius, count, rng):
    x = surface_points(distance, count, rng, by_area=0.5)
    return on_contact(distance, x + rng.normal(scale=1e-3, size=x.shape), radius) if radius > 0.0 else x


def attack_field(model, target, radius, points, starts, seed=0):
    """Largest f̃ - R that random points and ascents find on {d = R}."""
    rng, distance = np.random.default_rng(seed), target.distance
    best, seen = -np.inf, 0
    while seen < points:
        x = contact_points(distance, radius, min(500_000, points), rng)
        seen += len(x)
        best = max(best, float(values(model.field, x).max()))
    x = contact_points(distance, radius, 2 * starts, rng)[:starts]
    for step in np.geomspace(0.1, 0.001, 30):
        found, gradient = values_and_gradients(model.field, x)
        best = max(best, float(found.max()))
        x = x + step * gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
        x = on_contact(distance, x, radius)
    return best - radius


@pytest.mark.parametrize("name", shipped_names())
@pytest.mark.parametrize("radius", CHASER_RADII)
def test_shipped_certificates_hold(name, radius):
    target = Target.load(name)
    model = load_shipped(name, target=target)
    assert attack_field(model, target, radius, points=40_000, starts=500) <= model.certificate(radius).error_bound


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_names())
@pytest.mark.parametrize("radius", CHASER_RADII)
def test_shipped_certificates_hold_at_full_size(name, radius):
    target = Target.load(name)
    model = load_shipped(name, target=target)
    worst, bound = attack_field(model, target, radius, 10_000_000, 10_000), model.certificate(radius).error_bound
    print(f"{name}, R = {radius:g} m: largest found {worst:+.5f} m, certified {bound:+.5f} m")
    assert worst <= bound


def proved_slopes():
    """The shipped fields and radii whose bound of ‖∇f̃‖ is proved: the others' is the largest found plus a share."""
    cases = [(name, radius) for name in shipped_names() for radius in CHASER_RADII]
    return [case for case in cases if load_shipped(case[0]).certificate(case[1]).gradient_kind == "certified"]


def test_a_shipped_field_has_a_proved_slope_at_every_radius():
    assert {radius for name, radius in proved_slopes() if name == "intelsat30"} == set(CHASER_RADII)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "radius"), proved_slopes())
def test_no_search_beats_a_proved_slope(name, radius):
    target = Target.load(name)
    model = load_shipped(name, target=target)
    proof, distance = model.certificate(radius), target.distance
    rng = np.random.default_rng(0)
    points = surface_points(distance, 1_000_000, rng, by_area=0.5)
    points += (radius + rng.exponential(0.4, size=(len(points), 1))) * rng.normal(size=points.shape)
    for step in (0.0, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002):
        if step:
            moved = np.repeat(points, 8, axis=0)
            points = np.concatenate([points, moved + step * rng.normal(size=moved.shape)])
        points = points[distance.distance(points) >= radius]
        slope = np.linalg.norm(values_and_gradients(model.field, points)[1], axis=1)
        assert slope.max() <= proof.gradient_bound
        points = points[np.argsort(-slope)[:10_000]]
    print(f"{name}, R = {radius:g} m: steepest found {slope.max():.3f}, proved {proof.gradient_bound:.3f}")


def bumped(model, target, radius, least):
    """The model with one weight changed so that f̃ rises by at least `least` metres in a small part of {d = R}."""
    x = contact_points(target.distance, radius, 40_000, np.random.default_rng(3))
    before = values(model.field, x)
    W, b = model.field.layers
    for row in range(W[-2].shape[0]):
        for amount in (0.05, 0.2, 0.8):
            column = int(np.argmax(np.abs(W[-2][row])))
            weight = W[-2].at[row, column].add(amount)
            field = dataclasses.replace(model.field, layers=mlp.Layers((*W[:-2], weight, W[-1]), b))
            rise = values(field, x) - before
            if least < rise.max() and (rise > 0.5 * least).mean() < 0.1:
                return dataclasses.replace(model, field=field), x
    raise AssertionError("no such weight")


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_names()[:1])
def test_one_bumped_weight_of_a_shipped_field_is_found(name):
    target = Target.load(name)
    model = load_shipped(name, target=target)
    proof = model.certificate(0.0)
    worse, x = bumped(model, target, 0.0, least=0.1)
    again = certify(worse, target).certificate(0.0)
    print(f"{name}: certified {proof.error_bound:+.4f} m before, {again.error_bound:+.4f} m after")
    assert values(worse.field, x).max() <= again.error_bound
    assert again.error_bound > proof.error_bound


@pytest.mark.parametrize("name", shipped_names()[:1])
def test_a_field_with_one_bumped_weight_is_refused_with_its_old_certificates(name, tmp_path):
    model = load_shipped(name)
    path = tmp_path / "bumped.keepout"
    W, b = model.field.layers
    layers = mlp.Layers((*W[:-1], W[-1].at[0, 5].add(1e-6)), b)
    dataclasses.replace(model, field=dataclasses.replace(model.field, layers=layers)).save(path)
    with pytest.raises(FieldError, match="belongs to another field or target"):
        FieldModel.load(path)
    model.save(path)
    raw = bytearray(path.read_bytes())
    raw[-5] ^= 1  # one bit of one weight
    path.write_bytes(raw)
    with pytest.raises(FieldError, match="edited or damaged"):
        FieldModel.load(path)
