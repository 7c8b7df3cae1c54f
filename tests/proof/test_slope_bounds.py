"""Bounds of the gradient's norm attacked: by points, by ascent, by the continuation, and by a planted steep spot."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from truths.networks import random_layers

from keepout.fields import mlp
from keepout.fields.continuation import RadialContinuation
from keepout.fields.evaluate import values_and_gradients
from keepout.fields.neural import NeuralField
from keepout.geometry.target import Target
from keepout.proof import slope as lipschitz
from keepout.proof.bounds import Network
from keepout.proof.slope import prove_lipschitz
from keepout.proof.slope_bounds import Prepared, slope_bounds


def exact_slopes(layers, beta):
    weights, biases = ([np.asarray(a, np.float64) for a in arrays] for arrays in layers)

    def slopes(x):
        a, tangents = x, [np.broadcast_to(e, x.shape) for e in np.eye(3)]
        for W, b in zip(weights[:-1], biases[:-1]):
            z = a @ W.T + b
            slope = 0.5 * (1.0 + np.tanh(0.5 * beta * z))
            a, tangents = np.logaddexp(0.0, beta * z) / beta, [slope * (t @ W.T) for t in tangents]
        return np.linalg.norm([t @ weights[-1][0] for t in tangents], axis=0)

    return slopes


@pytest.mark.long
def test_fifty_random_networks_are_nowhere_steeper_than_their_bound():
    rng = np.random.default_rng(0)
    ratios = []
    for seed in range(50):
        beta = float(rng.choice([1.0, 10.0, 100.0, 400.0]))
        widths = (3, *rng.choice([8, 24, 48], size=int(rng.integers(1, 5))).tolist(), 1)
        layers = random_layers(seed, widths, jnp.float32)
        layers = mlp.Layers(tuple(W * float(rng.choice([0.5, 1.0, 3.0])) for W in layers.weights), layers.biases)
        half = np.full(40, 10 ** rng.uniform(-4.0, -0.5))
        centres = rng.uniform(-0.7, 0.7, (40, 3))
        bound = slope_bounds(Prepared.of(Network.of(layers, beta)), centres, half)
        offsets = rng.uniform(-1.0, 1.0, (40, 40, 3))
        offsets[:16] = np.sign(offsets[:16])
        slopes = exact_slopes(layers, beta)((centres + offsets * half[:, None]).reshape(-1, 3)).reshape(40, 40)
        assert (bound - slopes.max(axis=0)).min() >= 0.0
        ratios.append(np.median(bound / slopes.max(axis=0)))
    assert min(ratios) < 1.01  # tight on small cubes


def test_a_point_is_bounded_to_rounding_and_the_excess_shrinks_with_the_square_of_the_size():
    layers = random_layers(5, (3, 32, 32, 32, 1), jnp.float32)
    prepared = Prepared.of(Network.of(layers, 20.0))
    x = np.random.default_rng(2).uniform(-0.5, 0.5, (200, 3))
    at_point = slope_bounds(prepared, x, np.zeros(200))
    exact = exact_slopes(layers, 20.0)(x)
    assert 0.0 <= (at_point - exact).min() <= (at_point - exact).max() < 1e-6
    corners = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 1, 3)
    excess = []
    for half in (4e-3, 2e-3, 1e-3):
        near = exact_slopes(layers, 20.0)((x + half * corners).reshape(-1, 3)).reshape(27, -1).max(axis=0)
        excess.append(np.median(slope_bounds(prepared, x, np.full(200, half)) - near))
    assert excess[1] < 0.35 * excess[0]
    assert excess[2] < 0.35 * excess[1]


@pytest.fixture(scope="module")
def target():
    return Target.load("box", parameters={"length": 2.0, "width": 1.0, "height": 1.0})


def random_field(seed, beta=5.0):
    layers = random_layers(seed, (3, 12, 12, 1), jnp.float32)
    continuation = RadialContinuation(jnp.zeros(3), *(jnp.asarray(v) for v in (1.25, 3.25, 5.25, 0.4)))
    return NeuralField(layers, jnp.asarray(4.25), continuation, beta)


def steepest_by_ascent(field, rng, count):
    points = rng.normal(size=(count, 3))
    points *= (8.0 * rng.random((count, 1)) ** (1 / 3)) / np.linalg.norm(points, axis=1, keepdims=True)
    for step in (0.3, 0.1, 0.03, 0.01):
        slope = np.linalg.norm(values_and_gradients(field, points)[1], axis=1)
        best = points[np.argsort(-slope)[: count // 8]]
        points = np.concatenate([best, np.repeat(best, 7, axis=0) + step * rng.normal(size=(7 * len(best), 3))])
    return np.linalg.norm(values_and_gradients(field, points)[1], axis=1).max()


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_no_search_beats_the_proof_in_the_ball_and_beyond(seed, target, monkeypatch):
    monkeypatch.setattr(lipschitz, "FIRST_CUBES", 6)
    field = random_field(seed)
    answer = prove_lipschitz(field, target.distance, found=0.0)
    steepest = steepest_by_ascent(field, np.random.default_rng(seed), 8000)
    assert answer.proved is not None
    assert steepest <= answer.proved <= (1.0 + lipschitz.GAP) * max(answer.found, steepest) * (1.0 + 1e-6)
    assert answer.found <= answer.proved


def test_a_planted_steep_spot_raises_the_proof(target, monkeypatch):
    monkeypatch.setattr(lipschitz, "FIRST_CUBES", 6)
    field = random_field(4)
    before = prove_lipschitz(field, target.distance, found=0.0)
    W, b = field.layers
    spike = np.zeros((1, 3), np.float32)
    spike[0, 0] = 20.0  # one more neuron of the first layer, and a way for it past the rest
    field = dataclasses.replace(
        field, layers=mlp.Layers((W[0].at[0].set(jnp.asarray(spike[0])), *W[1:]), b), beta=field.beta
    )
    after = prove_lipschitz(field, target.distance, found=0.0)
    assert before.proved is not None
    assert after.proved is not None
    assert after.proved >= steepest_by_ascent(field, np.random.default_rng(0), 8000) > before.proved


def test_giving_up_is_told_apart_from_a_proof(target, monkeypatch):
    monkeypatch.setattr(lipschitz, "MOST_CUBES", 100)
    assert prove_lipschitz(random_field(0), target.distance, found=1.0) == lipschitz.Lipschitz(1.0, None)


def test_clearance_leaves_out_what_lies_nearer(target, monkeypatch):
    monkeypatch.setattr(lipschitz, "FIRST_CUBES", 6)
    seen = []
    whole, part = (
        prove_lipschitz(
            random_field(0), target.distance, found=100.0, clearance=clearance, progress=lambda f, m: seen.append(m)
        )
        for clearance in (0.0, 1.5)
    )
    assert part.proved is not None
    assert whole.proved is not None
    assert part.proved <= whole.proved
    cubes = [int(message.split()[1]) for message in seen]
    assert cubes[-1] < cubes[0]
