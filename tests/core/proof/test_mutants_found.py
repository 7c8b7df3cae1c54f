"""Proofs by pieces: what lies at a piece's edge counts, where its middle alone would say that nothing does."""

import jax.numpy as jnp
import numpy as np
import pytest
from truths import small_box
from truths.networks import numbers, random_layers

from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.neural import NeuralField
from keepout.core.geometry.level_set import level_points
from keepout.core.proof import certificate, grid, slope

pytestmark = pytest.mark.long


def test_boxes_cut_in_two_still_hold_the_whole_level_and_few_that_do_not_meet_it():
    distance, radius = small_box.target().distance, 0.3
    points = level_points(distance, radius, 3000, np.random.default_rng(0))
    boxes = certificate._cover(distance, radius, 0.5)
    for _ in range(5):
        held, holds = np.zeros(len(points), bool), np.zeros(len(boxes), bool)
        for number, (centre, half, *_) in enumerate(boxes):
            inside = (np.abs(points - centre) <= half + 1e-9).all(axis=1)
            held |= inside
            holds[number] = inside.any()
        assert held.all()
        boxes = certificate._split(boxes, distance, radius)
    assert holds.mean() > 0.5


def test_a_slanted_box_holds_what_its_box_holds_of_the_level():
    """Flat boxes and long ones, within the target and through it, too, whose far side is as much of the level."""
    distance, generator = small_box.target().distance, np.random.default_rng(0)
    for radius in (0.02, 0.3, 2.0):
        points = level_points(distance, radius, 4000, generator)
        centres = points[:300] + radius * generator.normal(size=(300, 3))
        halves = 10.0 ** generator.uniform(-2.0, 0.5, centres.shape)
        held = 0
        for centre, half in zip(centres, halves):
            inside = points[(np.abs(points - centre) <= half).all(axis=1)]
            left = certificate._slanted(centre[None], half[None], distance, radius)
            assert len(left) == 1 or len(inside) == 0
            for middle, cut, inner, *edges in left:
                assert (np.abs(inside - middle) <= cut).all()
                assert np.abs(np.linalg.solve(np.transpose(edges), (inside - inner).T)).max(initial=0.0) <= 1.0
            held += len(inside) > 0
        assert held > 50


def test_a_steep_spot_beyond_the_clearance_counts_in_a_cube_whose_middle_is_nearer(monkeypatch):
    """A slope of 10 within some centimetres of a place 1.6 m from the box, in a cube whose middle is 1.48 m from it."""
    scale, spot = 4.25, np.array([2.6, 0.35, 0.35])

    def steepness(away):
        return 1.0 + 9.0 * np.exp(-((away / 0.05) ** 2))

    def of_cubes(prepared, centres, half):
        return steepness(np.linalg.norm(np.maximum(np.abs(scale * centres - spot) - scale * half, 0.0), axis=1))

    def at_points(field, points):
        return None, steepness(np.linalg.norm(points - spot, axis=1))[:, None] * [[1.0, 0.0, 0.0]]

    monkeypatch.setattr(slope, "FIRST_CUBES", 6)
    monkeypatch.setattr(slope, "_bounds", of_cubes)
    monkeypatch.setattr(slope, "values_and_gradients", at_points)
    continuation = RadialContinuation(jnp.zeros(3), *numbers(1.25, 3.25, 5.25, 0.0))
    field = NeuralField(random_layers(0, (3, 4, 1), np.float32), jnp.asarray(scale), continuation, 5.0)
    distance = small_box.target().distance
    for clearance, largest in ((1.55, 10.0), (2.0, 0.0)):
        proved = slope.prove_lipschitz(field, distance, found=0.5, clearance=clearance).proved
        assert largest <= proved <= max(1.5 * largest, 3.0)


def test_a_lowering_counts_where_it_is_steepest_in_a_cell():
    """The slope of a plane less a steep lowering, in cells as wide as a third of the way that the lowering takes."""
    continuation = RadialContinuation(jnp.zeros(3), *numbers(1.0, 2.0, 3.0, 0.5))
    zones, rng, side = grid._Zones.of(continuation), np.random.default_rng(0), 0.3
    direction, gradient = rng.normal(size=(2, 200, 3))
    middle = rng.uniform(1.3, 1.7, (200, 1)) * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    nodes = side * (np.stack(np.meshgrid(*[np.arange(4) - 1.5] * 3, indexing="ij"), axis=-1).reshape(-1, 3))
    bound, found = zones.slopes(grid._Cells(gradient @ nodes.T, middle, np.full(200, side)))
    places = middle[:, None] + side * (rng.uniform(-0.5, 0.5, (1, 2000, 3)))
    lowering = continuation._lowering(jnp.asarray(places.reshape(-1, 3)))[1].reshape(places.shape)
    within = np.linalg.norm(places, axis=2) < 2.0
    steepest = np.where(within, np.linalg.norm(gradient[:, None] - lowering, axis=2), 0.0).max(axis=1)
    assert (steepest <= bound).all()
    assert (steepest > found + 0.05).any()
