"""The bounds of random networks over random triangles and boxes, against samples and gradient ascent in them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from keepout.fields import mlp
from keepout.proof import bounds
from truths.networks import in_numpy, random_layers

SIZES, SHARPNESS = (3, 24, 24, 24, 1), (100.0, 5.0, 400.0)
ELEMENTS, EACH = 64, 64


@functools.partial(jax.jit, static_argnames="beta")
def evaluated(layers, beta, x):
    """The network as it is flown: in its own float type."""
    return mlp.value(layers, beta, x.astype(layers.weights[0].dtype))


def random_network(seed):
    """Sharpness 5 to 400, and weights 0.3 to 2 times the usual size."""
    layers, size = random_layers(seed, SIZES, jnp.float32), np.random.default_rng(seed).uniform(0.3, 2.0)
    weights = tuple(jnp.asarray(np.asarray(W) * np.float32(size)) for W in layers.weights)
    return mlp.Layers(weights, layers.biases), SHARPNESS[seed % len(SHARPNESS)]


def random_elements(kind, rng, count, size):
    if kind == "triangle":
        return bounds.triangles(rng.uniform(-0.7, 0.7, (count, 1, 3)) + size * rng.normal(size=(count, 3, 3)))
    return bounds.boxes(rng.uniform(-0.7, 0.7, (count, 3)), size * rng.uniform(0.2, 1.0, (count, 3)))


def random_places(elements, rng, each):
    """Random places of each element (each, m, 3), by the weights of its columns; corners among them."""
    m = elements.columns.shape[1]
    if elements.kind == "triangle":
        places = rng.dirichlet(np.full(3, 0.5), size=(each, m))
        places[:3] = np.eye(3)[:, None, :]
        return places
    places = rng.uniform(-1.0, 1.0, size=(each, m, 3))
    places[: each // 4] = np.sign(places[: each // 4])
    return places


def points_at(elements, places):
    if elements.kind == "triangle":
        return np.einsum("emk,kmi->emi", places, elements.columns)
    return elements.columns[0] + np.einsum("emk,kmi->emi", places, elements.columns[1:])


def climbed(layers, beta, elements, places):
    """Largest value that gradient ascent inside each element finds from the places."""
    shape, best = places.shape[:2], np.full(places.shape[1], -np.inf)
    for step in np.geomspace(1.0, 0.02, 20):
        found, gradient = in_numpy(layers, beta, points_at(elements, places).reshape(-1, 3))
        best = np.maximum(best, found.reshape(shape).max(axis=0))
        gradient = gradient.reshape(*shape, 3)
        if elements.kind == "triangle":  # exponentiated gradient keeps the weights of the corners on the simplex
            rise = np.einsum("emi,kmi->emk", gradient, elements.columns)
            rise -= rise.max(axis=2, keepdims=True)
            places = places * np.exp(10.0 * step * rise / np.maximum(np.abs(rise).max(axis=2, keepdims=True), 1e-12))
            places /= places.sum(axis=2, keepdims=True)
        else:
            rise = np.einsum("emi,kmi->emk", gradient, elements.columns[1:])
            places = np.clip(places + step * np.sign(rise), -1.0, 1.0)
    return best


def check_random_networks_are_never_above_their_bound(kind, networks=range(16), rounds=1, starts=8):
    """No sample and no ascent beats an element's bound, nor the error of float32 the bound of that."""
    gaps = []
    for seed in networks:
        rng = np.random.default_rng(1000 + seed)
        layers, beta = random_network(seed)
        elements = random_elements(kind, rng, ELEMENTS, 10 ** rng.uniform(-3.0, -0.4))
        answer = bounds.upper_bounds(bounds.Network.of(layers, beta), elements)
        best = climbed(layers, beta, elements, random_places(elements, rng, starts))
        for _ in range(rounds):
            x = points_at(elements, random_places(elements, rng, EACH)).reshape(-1, 3)
            exact, _ = in_numpy(layers, beta, x)
            best = np.maximum(best, exact.reshape(EACH, -1).max(axis=0))
            off = np.abs(np.asarray(evaluated(layers, beta, x), np.float64) - exact).reshape(EACH, -1).max(axis=0)
            assert (answer.evaluation_error - off).min() >= 0.0
        assert (answer.upper - best).min() >= 0.0
        gaps.append(np.median(answer.upper - best))
    assert min(gaps) < 0.01  # small elements are bounded tightly, so the bound says something
