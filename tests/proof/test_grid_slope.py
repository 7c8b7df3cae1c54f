"""The slope bound of the grid field holds for what the guard asks: spline, lowering, continuation, joints of blocks."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from truths.slopes import places, steepest, steepest_chord

from keepout.errors import FieldError
from keepout.fields.blocks import NODES
from keepout.fields.continuation import RadialContinuation
from keepout.fields.evaluate import values
from keepout.fields.grid import BLOCK, STORED, GridField
from keepout.fields.grid_build import build_grid
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.target import Target
from keepout.guard.field import guard_field
from keepout.proof import grid_slope as slopes
from keepout.proof.grid import ROUNDING, certify_grid
from keepout.proof.grid_slope import grid_slope, spline_slope
from keepout.proof.grid_spline import joined_spline

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def target():
    return Target.load("box", parameters={"length": 2.0, "width": 1.0, "height": 1.0})


@pytest.fixture(scope="module")
def model(target):
    """Of two levels, so that blocks of both meet."""
    return build_grid(target, spacing=0.08, band=0.4, solid=OffsetSolid.build(target.distance))


def spline_bound(field):
    """Bound the spline alone, by coefficient differences: what does not bound the field."""
    return spline_slope(joined_spline(field))


def linear_field(radii, allowance=0.0, blocks=5, spacing=0.5):
    """The function x on one level of blocks, exactly; ρ_T, ρ_0, ρ_1 are given."""
    table = np.arange(blocks**3, dtype=np.int32).reshape(3 * (blocks,))
    origin = -0.5 * blocks * BLOCK * spacing * np.ones(3)
    nodes = origin[0] + spacing * (BLOCK * np.argwhere(table >= 0)[:, :1] + NODES)
    c = np.broadcast_to(nodes[:, :, None, None], (blocks**3, STORED, STORED, STORED)).astype(np.float32)
    lengths = (jnp.asarray(value, jnp.float64) for value in (*radii, allowance))
    continuation = RadialContinuation(jnp.zeros(3), *lengths)
    return GridField(
        jnp.asarray(c.reshape(-1)), (jnp.asarray(table),), jnp.asarray(origin), jnp.asarray(spacing), continuation
    )


def test_two_levels_meet(model):
    assert len(model.field.tables) == 2
    assert (np.asarray(model.field.tables[0]) < 0).any()


def attack(field, target, proof, count):
    generator = np.random.default_rng(5)
    points = places(field, target.distance, count, generator)
    found, _ = steepest(field, points)
    step = 10.0 ** generator.uniform(-7.0, 1.0, (count, 1)) * generator.normal(size=points.shape)
    chord = steepest_chord(field, points, points + step, proof.evaluation_error)
    print(f"steepest {found:.4f}, chord {chord:.4f}, proved {proof.gradient_bound:.4f}")
    assert max(found, chord) <= proof.gradient_bound
    return found


@pytest.mark.parametrize("radius", [0.3])
def test_no_search_beats_the_bound_around_the_box(model, target, radius):
    proof = certify_grid(model, target, chaser_radius=radius).certificate(radius)
    found = attack(model.field, target, proof, 40_000)
    assert proof.gradient_bound <= max(slopes.LEAST, (1.0 + slopes.GAP) * proof.gradient_found) + 1e-8
    assert found > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("name", ["intelsat30", "tiangong", "iss"])
def test_no_search_beats_the_bound_around_a_target(name):
    target = Target.load(name)
    kept = guard_field(target, 0.5)
    proof = kept.certificate(0.5)
    found = attack(kept.field, target, proof, 1_000_000)
    assert proof.gradient_bound <= 1.35
    assert found > 0.9 * proof.gradient_found


def lowered(field):
    """Lowered by 4 m over 2 m: more steeply than the distance grows."""
    steep = dataclasses.replace(field.continuation, allowance=jnp.asarray(4.0))
    return dataclasses.replace(field, continuation=steep)


def test_a_steep_lowering_counts(model, target, monkeypatch):
    """A bound of the spline alone does not hold for a field that is lowered steeply."""
    monkeypatch.setattr(slopes, "MOST_CELLS", 200_000)
    field = lowered(model.field)
    found, _ = steepest(field, places(field, target.distance, 20_000, np.random.default_rng(0)))
    assert found > 1.3 * spline_bound(field)
    assert found <= grid_slope(field, joined_spline(field)).proved <= 1.2 * found


def test_the_continuation_of_a_linear_field_counts(monkeypatch):
    """Against the closed form of the continuation of f = x, by brute force over radius and angle."""
    monkeypatch.setattr(slopes, "MOST_CELLS", 200_000)
    target, domain, outer = 4.0, 5.0, 6.0
    field = linear_field((target, domain, outer))
    r = np.concatenate([np.linspace(domain, outer, 2001), outer * np.geomspace(1.0, 100.0, 2001)])
    t = np.clip((r - domain) / (outer - domain), 0.0, 1.0)
    psi, psi1 = domain + (outer - domain) * (t - t**3 + 0.5 * t**4), 1.0 - 3.0 * t**2 + 2.0 * t**3
    angle = np.linspace(0.0, np.pi, 721)[:, None]
    radial = psi1 * np.cos(angle) + np.sqrt(1.0 - (target / r) ** 2) - psi1 * np.sqrt(1.0 - (target / psi) ** 2)
    truth = np.hypot(psi / r * np.sin(angle), radial).max()
    assert truth > 1.15 > spline_bound(field) + 0.14
    assert truth <= grid_slope(field, joined_spline(field)).proved <= 1.1 * truth


def test_running_out_of_cells_stays_a_bound(model, monkeypatch):
    field = lowered(model.field)
    found, _ = steepest(field, places(field, Target.load("box").distance, 20_000, np.random.default_rng(0)))
    proved = []
    for most in (0, 20_000):
        monkeypatch.setattr(slopes, "MOST_CELLS", most)
        proved.append(grid_slope(field, joined_spline(field)).proved)
    assert found <= proved[1] <= proved[0] < 3.0 * found


def face_jumps(field, generator, count=200_000):
    """|f̃| differences across the faces of blocks, as evaluated, at random places on them."""
    side = BLOCK * float(field.spacing)
    radius = 0.99 * float(field.continuation.domain_radius)
    points = np.asarray(field.continuation.centre) + generator.uniform(-radius, radius, (count, 3)) / 3.0**0.5
    axis = generator.integers(3, size=count)
    rows = np.arange(count)
    origin = np.asarray(field.origin)[axis]
    points[rows, axis] = origin + side * np.round((points[rows, axis] - origin) / side)
    aside = np.zeros_like(points)
    aside[rows, axis] = 1e-10
    return np.abs(values(field, points + aside) - values(field, points - aside))


def test_what_is_lost_at_the_joints_is_stated(model, target):
    field = model.field
    proof = certify_grid(model, target, chaser_radius=0.3).certificate(0.3)
    jump = face_jumps(field, np.random.default_rng(1))
    # Far above what a slope of 1 gives over 2e-10 m: float32 coefficients do not join exactly.
    assert 1e-8 < jump.max() <= 2.0 * proof.evaluation_error + 4e-10
    spline = joined_spline(field)
    assert proof.evaluation_error == spline.difference + ROUNDING
    assert spline.difference <= 2.0**-23 * float(np.abs(np.asarray(field.coefficients)).max())


def test_the_joined_spline_is_one_c2_function(model):
    """Where the stored blocks jump, f* does not: neither its value nor its second derivative."""
    field, spline = model.field, joined_spline(model.field)
    # In float64 the coefficients of f* can be flown as they are.
    exact = object.__new__(GridField)
    for name in ("tables", "origin", "spacing", "continuation"):
        object.__setattr__(exact, name, getattr(field, name))
    object.__setattr__(exact, "coefficients", jnp.asarray(spline.coefficients.reshape(-1)))
    generator = np.random.default_rng(2)
    assert face_jumps(field, generator).max() > 1e-8
    assert face_jumps(exact, generator).max() < 4e-10


def test_a_block_that_does_not_join_is_stated(model, target):
    coefficients = np.asarray(model.field.coefficients).copy()
    number = int(np.asarray(model.field.tables[0]).max())
    coefficients.reshape(-1, STORED**3)[number] += np.float32(1e-3)
    field = dataclasses.replace(model.field, coefficients=jnp.asarray(coefficients))
    broken = dataclasses.replace(model, field=field)
    proof = certify_grid(broken, target, chaser_radius=0.3).certificate(0.3)
    jump = face_jumps(field, np.random.default_rng(1)).max()
    assert 0.9e-3 < jump <= 2.0 * proof.evaluation_error + 4e-10
    points = places(field, target.distance, 20_000, np.random.default_rng(3))
    step = 1e-4 * np.random.default_rng(4).normal(size=points.shape)
    assert steepest_chord(field, points, points + step, proof.evaluation_error) <= proof.gradient_bound


def test_blocks_that_hang_in_the_air_are_refused(model, target):
    tables = [np.asarray(table).copy() for table in model.field.tables]
    tables[-1][tuple(np.argwhere(tables[0] >= 0)[0] // 2)] = -1
    field = dataclasses.replace(model.field, tables=tuple(map(jnp.asarray, tables)))
    with pytest.raises(FieldError, match="its coarsest level has holes"):
        certify_grid(dataclasses.replace(model, field=field), target)


def test_a_grid_that_leaves_out_part_of_the_domain_is_refused(model, target):
    field = dataclasses.replace(model.field, origin=model.field.origin + 0.5)
    with pytest.raises(FieldError, match="does not hold the ball of"):
        certify_grid(dataclasses.replace(model, field=field), target)


def test_values_are_overstated_nowhere_beyond_and_little_within(model, target):
    """f̃ ≤ √(d² + h²) - δ, h the coarsest spacing, and f̃ ≤ d - δ from ρ_0 on."""
    field = model.field
    points = places(field, target.distance, 100_000, np.random.default_rng(6))
    away = np.linalg.norm(points - np.asarray(field.continuation.centre), axis=1)
    half = 0.5 * (target.vertices.max(axis=0) - target.vertices.min(axis=0))
    q = np.abs(points - 0.5 * (target.vertices.max(axis=0) + target.vertices.min(axis=0))) - half
    d = np.where((q > 0).any(axis=1), np.linalg.norm(np.maximum(q, 0.0), axis=1), -q.max(axis=1))
    f = values(field, points)
    coarsest = float(field.spacing) * 2.0 ** (len(field.tables) - 1)
    assert (f - np.hypot(d, coarsest)).max() <= -model.offset + 1e-9
    beyond = away >= float(field.continuation.domain_radius)
    excess = (f - d)[beyond].max()
    assert excess <= -model.offset + 1e-9
    # Without the allowance it would be.
    assert excess + float(field.continuation.allowance) > -model.offset
