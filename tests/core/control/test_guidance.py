"""Fast marching and guidance against closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from scipy.interpolate import BSpline
from truths.box_unions import box_union

from keepout.core.control.barrier_grid import BarrierGrid, _refined, downhill, travel_time
from keepout.core.control.geodesic import GeodesicGuidance, geodesic_guidance, packed
from keepout.core.control.guidance import ComponentwiseGuidance, StraightGuidance
from keepout.core.control.velocity import SwitchingCirculation, skew
from keepout.core.errors import ControlError
from keepout.core.fields.own import SphereField

SPHERE = SphereField(jnp.zeros(3), jnp.asarray(2.0))


def test_travel_time_ends_where_it_is_said_to_and_is_the_same_before():
    generator = np.random.default_rng(2)
    speed = ndimage.gaussian_filter(generator.random((30, 30, 30)), 1.0)
    walls = generator.random((3, 30, 30, 30)) < 0.2
    goal, start = np.array([[5, 6, 7]]), np.array([8, 8, 8])
    whole = travel_time(speed, walls, goal, np.zeros(1), 0.5)
    part = travel_time(speed, walls, goal, np.zeros(1), 0.5, towards=start, beyond=1.0)
    limit = 2.0 * whole[tuple(start)] + 1.0
    assert 100 < np.count_nonzero(whole <= limit) < 0.5 * whole.size
    np.testing.assert_array_equal(part[whole <= limit], whole[whole <= limit])
    assert np.isinf(part[whole > limit]).all()


def test_travel_time_goes_round_a_wall():
    """A wall between two columns of nodes with one opening: the way is the sum of the two legs."""
    n, spacing = 41, 0.1
    walls = np.zeros((3, n, n, 3), dtype=bool)
    walls[0, 20, :35, :] = True
    start, end = np.array([10, 5, 1]), np.array([30, 5, 1])
    time = travel_time(np.ones((n, n, 3)), walls, start[None], np.zeros(1), spacing)
    corner = np.array([20.5, 35.0])
    legs = np.hypot(*(corner - start[:2])) + np.hypot(*(corner - end[:2]))
    assert time[tuple(end)] == pytest.approx(legs * spacing, rel=0.06)
    directions = np.zeros((n, n, 3, 3), dtype=np.int8)
    downhill(time, walls, directions)
    # From beside the wall the way leads along it to the opening, and back along the other side: never across.
    assert (directions[[20, 21], :35, :, 0] <= 0).all()
    assert (directions[21, 5:34, 1, 1] > 0).all()
    assert (directions[20, 6:34, 1, 1] < 0).all()
    walls[0, 20, :, :] = True
    shut = travel_time(np.ones((n, n, 3)), walls, start[None], np.zeros(1), spacing)
    assert np.isinf(shut[tuple(end)])


@pytest.mark.long
def test_geodesic_leads_round_a_sphere():
    goal, start = np.array([0.0, -5.0, 0.0]), np.array([0.0, 5.0, 0.1])
    grid = BarrierGrid.build(SPHERE, 0.5, np.full(3, -7.0), np.full(3, 7.0), spacing=0.35)
    guidance = geodesic_guidance(grid, SPHERE, 0.5, goal, speed=0.1, slowing_length=2.0, start=start)
    move = jax.jit(lambda r: r + 2.0 * guidance.desired_velocity(r))
    position, length = jnp.asarray(start), 0.0
    for _ in range(150):
        moved = move(position)
        length += float(jnp.linalg.norm(moved - position))
        position = moved
        assert float(SPHERE.value(position)) > 0.45
        if float(jnp.linalg.norm(position - goal)) < 0.1:
            break
    assert float(jnp.linalg.norm(position - goal)) < 0.1
    # Shortest way round a sphere of radius 2.5: two tangents and an arc.
    tangent = np.sqrt(25.0 - 6.25)
    shortest = 2.0 * tangent + 2.5 * (np.pi - 2.0 * np.arccos(2.5 / 5.0))
    assert shortest - 0.15 < length < 1.15 * shortest
    outside = guidance.desired_velocity(jnp.asarray([20.0, 5.0, 0.0]))
    assert float(outside[0]) < -0.05


def union(lower, upper):
    """Boxes, of which there are four or more for all fields to share their programs."""
    rows = np.resize(np.arange(len(lower)), max(len(lower), 4))
    corners = (jnp.asarray(np.array(side, float)[rows]) for side in (lower, upper))
    return box_union(*corners, jnp.asarray(0.005))


def slid(field, offset, guidance, start, steps):
    """Follow v_c a second at a time, less what a safe velocity takes off it: where it ends, and the least barrier."""
    return _slid(field, jnp.asarray(offset), guidance, jnp.asarray(start), steps)


@eqx.filter_jit
def _slid(field, offset, guidance, start, steps):
    def move(position, _):
        value, normal = field.value_and_gradient(position)
        desired = guidance.desired_velocity(position)
        into = jnp.minimum(jnp.sum(desired * normal) + 0.08 * (value - offset), 0.0) / jnp.sum(normal * normal)
        return position + desired - into * normal, value - offset

    return jax.lax.scan(move, start, length=steps)


START, GOAL = np.array([0.9, 2.5, -0.7]), np.array([0.3, -2.5, 0.2])


def guided(wall, spacing=0.5, *, reach=4.0, goal=GOAL, start=START):
    grid = BarrierGrid.build(wall, 0.5, np.full(3, -reach), np.full(3, reach), spacing=spacing)
    return geodesic_guidance(grid, wall, 0.5, goal, speed=0.1, slowing_length=1.0, start=start)


def holed(half_width, aside=0.0):
    """A wall 1 m thick with a square hole."""
    near, far = aside - half_width, aside + half_width
    lower = [[-4, -0.5, -4], [far, -0.5, -4], [-4, -0.5, -4], [-4, -0.5, far]]
    return union(lower, [[near, 0.5, 4], [4, 0.5, 4], [4, 0.5, near], [4, 0.5, 4]])


@pytest.mark.long
@pytest.mark.parametrize(("half_width", "aside"), [(0.55, 0.0), (0.75, 0.12), (0.9, 0.12), (1.1, 0.0)])
def test_geodesic_goes_through_a_gap_of_a_node_or_two(half_width, aside):
    """Of the hole the chaser is left 0.1 to 1.2 m, on a grid of 0.5 m."""
    wall = holed(half_width, aside)
    end, barrier = slid(wall, 0.5, guided(wall), START, 400)
    np.testing.assert_allclose(end, GOAL, atol=1e-3)
    assert float(jnp.min(barrier)) > 0.0


@pytest.mark.long
def test_a_finer_grid_finds_a_gap_between_nodes():
    """A slot of 0.3 m for the chaser, between two layers of nodes that are 0.5 m apart."""
    wall = union([[-4, -0.5, -4], [0.9, -0.5, -4]], [[-0.4, 0.5, 4], [4, 0.5, 4]])
    with pytest.raises(ControlError, match=r"not connected .* a smaller spacing may find a wider one"):
        guided(wall)
    np.testing.assert_allclose(slid(wall, 0.5, guided(wall, 0.25), START, 400)[0], GOAL, atol=1e-3)


@pytest.mark.long
def test_geodesic_leads_round_sheets_from_both_sides():
    """Two crossed sheets: from every chamber to every other, also from close to a sheet to right behind it."""
    cross = union([[-3, -0.01, -3], [-0.01, -3, -3]], [[3, 0.01, 3], [0.01, 3, 3]])
    places = np.array([[1.5, 0.7, 0.2], [-0.7, 1.4, -1.0], [-2.0, -0.6, 0.5], [0.6, -0.6, 1.2]])
    for goal in places:
        guidance = guided(cross, 0.45, reach=6.0, goal=goal, start=None)
        for start in places:
            end, barrier = slid(cross, 0.5, guidance, start, 400)
            np.testing.assert_allclose(end, goal, atol=1e-3)
            assert float(jnp.min(barrier)) > 0.0


def test_says_how_far_inside_a_goal_lies():
    for goal, start, said in (
        (2.2, None, r"goal: .* lies 0\.3 m inside the keep-out zone"),
        (4.0, 2.0, r"start: .* lies 0\.5 m inside"),
        (9.0, None, "outside the guidance bounds"),
    ):
        with pytest.raises(ControlError, match=said):
            guided(SPHERE, reach=5.0, goal=goal * np.eye(3)[1], start=start and start * np.eye(3)[1])


def test_says_how_much_too_narrow_the_way_is():
    """A hole of 0.6 m: too narrow by 0.2 m for a clearance of 0.5 m."""
    with pytest.raises(ControlError, match=r"not connected .* misses 0\.(19|2)\d* m"):
        guided(holed(0.3), 0.1)


@pytest.mark.long
def test_straight_guidance_is_capped_in_norm_and_the_papers_in_components():
    goal = jnp.zeros(3)
    numbers = (goal, jnp.asarray(0.1), jnp.asarray(1.5))
    far = jnp.asarray([50.0, 50.0, -50.0])
    assert float(jnp.linalg.norm(StraightGuidance(*numbers).desired_velocity(far))) == pytest.approx(0.1)
    np.testing.assert_allclose(ComponentwiseGuidance(*numbers).desired_velocity(far), [-0.1, -0.1, 0.1], atol=1e-12)
    slope = jax.jacfwd(StraightGuidance(*numbers).desired_velocity)(goal)
    np.testing.assert_allclose(slope, -np.eye(3) * 0.1 / 1.5, atol=1e-12)


def test_switching_circulation_holds_its_axis_until_the_obstacle_is_left():
    law = SwitchingCirculation(jnp.asarray(0.1), jnp.asarray(1.0), jnp.asarray(1.0), jnp.asarray(0.3))
    normal, rest = jnp.asarray([0.0, 1.0, 0.0]), jnp.zeros(3)
    far = law.update(rest, jnp.asarray(0.5), normal, jnp.asarray([0.0, -0.1, 0.0]), rest)
    np.testing.assert_array_equal(far, 0.0)
    # Straight against the surface: some axis, with a tangent of unit length.
    axis = law.update(rest, jnp.asarray(0.05), normal, jnp.asarray([0.0, -0.1, 0.0]), rest)
    tangent = np.asarray(skew(axis) @ normal)
    assert np.linalg.norm(tangent) == pytest.approx(1.0)
    assert tangent @ np.asarray(normal) == pytest.approx(0.0, abs=1e-15)
    # The desired velocity now points back along the surface; the axis stays.
    kept = law.update(axis, jnp.asarray(0.15), normal, -jnp.asarray(tangent), jnp.asarray(tangent) * 0.05)
    np.testing.assert_array_equal(kept, axis)
    left = law.update(axis, jnp.asarray(0.25), normal, -jnp.asarray(tangent), rest)
    np.testing.assert_array_equal(left, 0.0)
    # Around an edge the axis would meet the normal: flight goes on the way it went.
    onwards = law.update(axis, jnp.asarray(0.05), axis, jnp.asarray([0.0, -0.1, 0.0]), jnp.asarray(tangent) * 0.05)
    np.testing.assert_allclose(skew(onwards) @ axis, tangent, atol=1e-12)


@pytest.mark.parametrize("shape", [(2, 2, 2), (5, 7, 3), (31, 40, 26)])
def test_a_refined_grid_is_trilinear_interpolation_to_the_bit(shape):
    coarse = np.random.default_rng(0).normal(size=shape)
    where = np.meshgrid(*[np.arange(2 * count - 1) / 2.0 for count in shape], indexing="ij")
    assert np.array_equal(_refined(coarse), ndimage.map_coordinates(coarse, where, order=1))


SHAPE, ORIGIN, SPACING = (9, 8, 10), np.array([-2.0, -1.5, -2.5]), 0.5
DIRECTIONS = np.random.default_rng(2).integers(-127, 128, (*SHAPE, 3)).astype(np.int8)


def blended_guidance():
    numbers = {"speed": 0.1, "slowing_length": 1.0, "spacing": SPACING, "inner": 0.6, "outer": 1.2}
    return GeodesicGuidance(
        goal=jnp.zeros(3),
        directions=jnp.asarray(packed(DIRECTIONS)),
        nodes=jnp.asarray(SHAPE, dtype=jnp.float64),
        origin=jnp.asarray(ORIGIN),
        **{name: jnp.asarray(value) for name, value in numbers.items()},
    )


def summed(position):
    """Sum every node's direction times its cubic B-spline, wherever it is not zero."""
    spline = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    at = (position - ORIGIN) / SPACING
    x, y, z = (np.nan_to_num(spline(at[axis] - np.arange(SHAPE[axis]))) for axis in range(3))
    blended = np.einsum("i,j,k,ijka->a", x, y, z, DIRECTIONS.astype(float))
    return blended / np.linalg.norm(blended)


POSITIONS = ORIGIN + SPACING * np.random.default_rng(3).uniform(1.0, np.array(SHAPE) - 2.0, (40, 3))


@pytest.mark.long
def test_the_blend_is_the_sum_of_splines_alone_and_in_a_batch():
    law = blended_guidance()
    truth = np.stack([summed(position) for position in POSITIONS])
    np.testing.assert_allclose(jax.jit(jax.vmap(law.direction))(POSITIONS), truth, rtol=0.0, atol=1e-13)
    alone = jax.jit(lambda p: law.direction(p))
    np.testing.assert_allclose([alone(p) for p in POSITIONS[:3]], truth[:3], rtol=0.0, atol=1e-13)


@pytest.mark.long
def test_its_derivative_is_that_of_the_blend():
    law, step = blended_guidance(), 1e-5
    found = jax.jit(jax.vmap(jax.jacfwd(law.direction)))(POSITIONS[:5])
    for position, jacobian in zip(POSITIONS[:5], found, strict=True):
        for axis in range(3):
            shift = step * np.eye(3)[axis]
            difference = (summed(position + shift) - summed(position - shift)) / (2 * step)
            np.testing.assert_allclose(jacobian[:, axis], difference, rtol=0.0, atol=1e-6)
