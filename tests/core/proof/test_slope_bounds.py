"""Bounds of the gradient's norm attacked: by points, by ascent, by the continuation, and by a planted steep spot."""

import jax.numpy as jnp
import numpy as np
import pytest
from truths import small_box
from truths.networks import in_numpy, numbers, random_layers
from truths.slopes import steepest

from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.neural import NeuralField
from keepout.core.proof import slope as lipschitz
from keepout.core.proof.bounds import Network
from keepout.core.proof.slope import Prepared, prove_lipschitz, slope_bounds

pytestmark = pytest.mark.long


def exact_slopes(layers, beta, x):
    return np.linalg.norm(in_numpy(layers, beta, x)[1], axis=1)


def test_random_networks_are_nowhere_steeper_than_their_bound():
    rng = np.random.default_rng(0)
    ratios = []
    for seed in range(30):
        beta = float(rng.choice([1.0, 10.0, 100.0, 400.0]))
        widths = (3, *rng.choice([8, 24, 48], size=int(rng.integers(1, 5))).tolist(), 1)
        layers, size = random_layers(seed, widths, np.float32), np.float32(rng.choice([0.5, 1.0, 3.0]))
        layers = layers._replace(weights=tuple(np.asarray(W) * size for W in layers.weights))
        half = np.full(40, 10 ** rng.uniform(-4.0, -0.5))
        centres = rng.uniform(-0.7, 0.7, (40, 3))
        bound = slope_bounds(Prepared.of(Network.of(layers, beta)), centres, half)
        offsets = rng.uniform(-1.0, 1.0, (40, 40, 3))
        offsets[:16] = np.sign(offsets[:16])
        slopes = exact_slopes(layers, beta, (centres + offsets * half[:, None]).reshape(-1, 3)).reshape(40, 40)
        assert (bound - slopes.max(axis=0)).min() >= 0.0
        ratios.append(np.median(bound / slopes.max(axis=0)))
    assert min(ratios) < 1.01  # tight on small cubes


def test_a_point_is_bounded_to_rounding_and_the_excess_shrinks_with_the_square_of_the_size():
    layers = random_layers(5, (3, 32, 32, 32, 1), np.float32)
    prepared = Prepared.of(Network.of(layers, 20.0))
    x = np.random.default_rng(2).uniform(-0.5, 0.5, (200, 3))
    at_point, exact = slope_bounds(prepared, x, np.zeros(200)), exact_slopes(layers, 20.0, x)
    assert 0.0 <= (at_point - exact).min() <= (at_point - exact).max() < 1e-6
    corners = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 1, 3)
    excess = []
    for half in (4e-3, 2e-3, 1e-3):
        near = exact_slopes(layers, 20.0, (x + half * corners).reshape(-1, 3)).reshape(27, -1).max(axis=0)
        excess.append(np.median(slope_bounds(prepared, x, np.full(200, half)) - near))
    assert excess[1] < 0.35 * excess[0]
    assert excess[2] < 0.35 * excess[1]


@pytest.fixture(autouse=True)
def _few_cubes(monkeypatch):
    monkeypatch.setattr(lipschitz, "FIRST_CUBES", 6)


def random_field(seed, spike=0.0):
    """A field round the small box; a spike is the first neuron's weight of x."""
    layers = random_layers(seed, (3, 12, 12, 1), np.float32)
    if spike:
        first = np.asarray(layers.weights[0]).copy()
        first[0] = [spike, 0.0, 0.0]
        layers = layers._replace(weights=(jnp.asarray(first), *layers.weights[1:]))
    continuation = RadialContinuation(jnp.zeros(3), *numbers(1.25, 3.25, 5.25, 0.4))
    return NeuralField(layers, jnp.asarray(4.25), continuation, 5.0)


def proved(field, **arguments):
    return prove_lipschitz(field, small_box.target().distance, **{"found": 0.0, **arguments})


def searched(field):
    """The largest slope that a search finds in the ball and beyond."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(8000, 3))
    points *= (8.0 * rng.random((8000, 1)) ** (1 / 3)) / np.linalg.norm(points, axis=1, keepdims=True)
    return steepest(field, points)[0]


@pytest.mark.parametrize("seed", [0, 1])
def test_no_search_beats_the_proof_in_the_ball_and_beyond(seed):
    answer, found = proved(random_field(seed)), searched(random_field(seed))
    assert answer.proved is not None
    assert found <= answer.proved <= (1.0 + lipschitz.GAP) * max(answer.found, found) * (1.0 + 1e-6)
    assert answer.found <= answer.proved


def test_a_planted_steep_spot_raises_the_proof():
    before, after = proved(random_field(4)).proved, proved(random_field(4, spike=20.0)).proved
    assert after is not None
    assert before is not None
    assert after >= searched(random_field(4, spike=20.0)) > before


def straight(slope, allowance):
    """A network that is the linear function of a slope along x: its neurons are saturated."""
    W, b = ([np.zeros(np.shape(a), np.float32) for a in arrays] for arrays in random_field(0).layers)
    W[0][0, 0], W[1][0, 0], W[2][0, 0], b[0][0], b[2][0] = slope, 1.0, 1.0, 20.0, -20.0
    layers = random_field(0).layers._replace(weights=tuple(map(jnp.asarray, W)), biases=tuple(map(jnp.asarray, b)))
    return NeuralField(
        layers, jnp.asarray(4.25), RadialContinuation(jnp.zeros(3), *numbers(1.25, 3.25, 5.25, allowance)), 5.0
    )


@pytest.mark.parametrize(("slope", "allowance", "steepest"), [(0.0, 4.0, 3.75), (0.0, 0.0, 0.99), (1.0, 0.0, 1.01)])
def test_lowering_and_continuation_count_where_the_network_is_straight(slope, allowance, steepest):
    """The lowering's steepest slope is 15/8 of its mean; far away the continuation's is 1, or more where they add."""
    found = searched(straight(slope, allowance))
    assert steepest - 0.01 <= found <= proved(straight(slope, allowance)).proved <= 1.2 * max(found, 1.0)


def test_few_cubes_prove_a_looser_bound_and_one_that_is_too_loose_is_none(monkeypatch):
    field, found = random_field(0), searched(random_field(0))
    monkeypatch.setattr(lipschitz, "GAP", 0.02)
    bounds = []
    for most in (1_500, 3_000, 20_000):
        seen = []
        monkeypatch.setattr(lipschitz, "MOST_CUBES", most)
        bounds.append(proved(field, progress=lambda done, line, seen=seen: seen.append(int(line.split()[1]))).proved)
        assert seen[-1] <= most
    assert found <= bounds[2] < bounds[1] < bounds[0]
    # What few cubes came to is proved again by as many.
    assert found <= proved(field, found=bounds[2] / 1.02).proved <= bounds[2] * (1.0 + 1e-12)
    monkeypatch.setattr(lipschitz, "LOOSEST", 0.02)
    assert proved(field).proved is None


def test_a_cube_whose_bound_is_not_a_number_proves_nothing(monkeypatch):
    bounds = lipschitz._bounds
    monkeypatch.setattr(lipschitz, "_bounds", lambda *known: np.append(bounds(*known)[1:], np.nan))
    assert proved(random_field(0)).proved is None


def test_clearance_leaves_out_what_lies_nearer():
    said = {0.0: [], 1.5: []}
    whole, part = (
        proved(
            random_field(0), found=100.0, clearance=clearance, progress=lambda done, line, seen=seen: seen.append(line)
        )
        for clearance, seen in said.items()
    )
    assert part.proved <= whole.proved
    assert int(said[1.5][-1].split()[1]) < int(said[0.0][-1].split()[1])
