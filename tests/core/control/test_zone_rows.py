"""Barrier rows of several things in one velocity program: against Clarabel, and in the law between two zones."""

import dataclasses

import clarabel
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse

from keepout.core.control.guidance import StraightGuidance
from keepout.core.control.unit_program import Circulation, HalfSpaces, VelocityProgram
from keepout.core.control.velocity import ClassK, SafeVelocity, printed_circulation
from keepout.core.control.velocity_program import ConeStatus, solve
from keepout.core.fields.own import SphereField
from keepout.core.fields.zones import Box, Zone, ZonedField

LIMIT, ROWS, COUNT = 0.1, 6, 200


def programs(seed):
    """Programs as the paper's law asks them, with 1 to 6 rows that act: skew, coinciding and opposite ones."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(COUNT, 1 + ROWS, 3))
    pairs = rng.integers(1, 1 + ROWS, COUNT)
    turn = rng.choice([0, 1, 2, 3], COUNT, p=[0.4, 0.3, 0.15, 0.15])
    first = normals[np.arange(COUNT), pairs - 1]
    near = first + 1e-4 * rng.normal(size=(COUNT, 3))
    normals[np.arange(COUNT), pairs] = np.choose(turn[:, None], [normals[np.arange(COUNT), pairs], first, -first, near])
    normals *= rng.uniform(0.5, 1.5, (COUNT, 1 + ROWS, 1)) / np.linalg.norm(normals, axis=-1, keepdims=True)
    rates = rng.choice([0.1, 0.01, 0.001], (COUNT, 1 + ROWS)) * rng.uniform(0.01, 1.0, (COUNT, 1 + ROWS))
    # Rows of zones that have ended, and two that say the same.
    ended = np.arange(ROWS) >= rng.integers(1, 1 + ROWS, COUNT)[:, None]
    rates[:, 1:][ended], normals[:, 1:][ended] = 1e100, 0.0
    same = (turn == 1) & (rng.random(COUNT) < 0.5) & (rates[:, 1] < 1.0)
    normals[same, 1], rates[same, 1] = normals[same, 0], rates[same, 0]
    return {
        "desired": rng.normal(size=(COUNT, 3)) * rng.choice([0.02, 0.1, 0.4], (COUNT, 1)),
        "normals": normals,
        "rates": rates,
        "tangent": np.cross(normals[:, 0], rng.normal(size=(COUNT, 3))),
        "circulation_rate": rng.uniform(-0.3, 0.12, COUNT),
        "turn": turn.astype(float),
    }


def _program(one):
    return VelocityProgram(
        desired=one["desired"],
        normal=one["normals"][0],
        barrier_rate=one["rates"][0],
        circulation=Circulation(one["tangent"], one["circulation_rate"], jnp.asarray(1.0)),
        box=jnp.asarray(LIMIT),
        half_spaces=HalfSpaces(one["normals"][1:], one["rates"][1:]),
    )


@jax.jit
@jax.vmap
def _solved(data, along):
    """Solutions, and the derivatives of their velocities along a direction."""

    def velocity(data):
        answer = solve(_program(data))
        return answer.velocity, answer

    return jax.jvp(velocity, (data,), (along,), has_aux=True)[1:]


def solved(data, along=None):
    """Solve programs: derivatives along a direction, and the answers."""
    return jax.device_get(_solved(data, jax.tree.map(np.zeros_like, data) if along is None else along))


def optimum(data, i, rates):
    """Solve one program with Clarabel, in units of the limit; w = −σ is the fourth unknown."""
    rates = np.minimum(rates, 1e3) / LIMIT
    rows = np.vstack(
        [
            np.append(-data["tangent"][i], -1.0),
            np.eye(3, 4),
            -np.eye(3, 4),
            np.pad(-data["normals"][i], ((0, 0), (0, 1))),
        ]
    )
    offsets = np.concatenate([[-data["circulation_rate"][i] / LIMIT], np.ones(6), rates])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    answer = clarabel.DefaultSolver(
        sparse.csc_matrix(np.diag([1.0, 1.0, 1.0, 2.0])),
        np.append(-data["desired"][i] / LIMIT, 0.0),
        sparse.csc_matrix(rows),
        offsets,
        [clarabel.NonnegativeConeT(len(rows))],
        settings,
    ).solve()
    return np.array(answer.x[:3]) * LIMIT if str(answer.status) == "Solved" else None


def check_against_clarabel(data, rates):
    velocity = solved(data)[1].velocity
    truths = [optimum(data, i, rates[i]) for i in range(COUNT)]
    found = [i for i, truth in enumerate(truths) if truth is not None]
    assert len(found) > 0.9 * COUNT
    np.testing.assert_allclose(velocity[found], np.array([truths[i] for i in found]), atol=1e-7 * LIMIT)


@pytest.mark.long
def test_rows_agree_with_clarabel():
    data = programs(seed=1)
    answer = solved(data)[1]
    assert np.all(answer.status == ConeStatus.SOLVED)
    slack = np.einsum("nij,nj->ni", data["normals"], answer.velocity) + data["rates"]
    assert slack.min() > -1e-11 * LIMIT
    # Corners are among them: where two, three rows act at once.
    acting = (slack < 1e-9 * LIMIT).sum(axis=1)
    assert min((acting == number).sum() for number in (0, 1, 2, 3)) > 5
    check_against_clarabel(data, data["rates"])


@pytest.mark.long
def test_inside_of_something_its_row_is_met_and_the_others_give_way_only_as_far_as_they_must():
    data, rng = programs(seed=2), np.random.default_rng(3)
    inside = rng.integers(0, 2, COUNT)
    rates, places = data["rates"], np.arange(COUNT)
    rates[places, inside] = (
        -0.03 * rng.uniform(0.0, 1.0, COUNT) * np.linalg.norm(data["normals"][places, inside], axis=1)
    )
    lengths = np.linalg.norm(data["normals"], axis=-1)
    nearest = np.argmin(rates / np.where(lengths > 0.0, lengths, 1.0), axis=1)
    assert np.array_equal(nearest, inside)
    # Straight out, twice as fast as that row asks for; the others let that velocity pass.
    normal = data["normals"][places, inside]
    way = -2.0 * (rates[places, inside] / np.sum(normal**2, axis=1))[:, None] * normal
    relaxed = np.maximum(rates, -np.einsum("nij,nj->ni", data["normals"], way))
    relaxed[places, inside] = rates[places, inside]
    assert np.any(relaxed > rates, axis=1).sum() > 20
    answer = solved(data)[1]
    assert np.all(answer.status == ConeStatus.SOLVED)
    check_against_clarabel(data, relaxed)


@pytest.mark.long
def test_where_the_nearest_row_cannot_be_met_the_fastest_way_out_is_its_own():
    data = programs(seed=4)
    normal = data["normals"][:, 1]
    least = np.abs(normal).sum(axis=1) * LIMIT
    data["rates"][:, 1] = -1.2 * least
    answer = solved(data)[1]
    assert np.all(answer.status == ConeStatus.INFEASIBLE)
    np.testing.assert_allclose(answer.velocity, np.sign(normal) * LIMIT, atol=1e-12)
    np.testing.assert_allclose(answer.room, -0.2 * least, rtol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("below", [0.0, -0.004])
def test_derivative_is_the_central_difference(below):
    data, rng, step = programs(seed=5), np.random.default_rng(6), 1e-7
    data["rates"][:, 1] += below
    along = {name: rng.normal(size=value.shape) * 0.1 for name, value in data.items()}
    moved = [solved({n: v + sign * step * along[n] for n, v in data.items()})[1].velocity for sign in (1.0, -1.0)]
    derivative = solved(data, along)[0]
    central = (moved[0] - moved[1]) / (2.0 * step)
    # Where rows that coincide are moved apart, the solution has a derivative on each side.
    skew = data["turn"] == 0
    scale = np.maximum(np.linalg.norm(central, axis=1), 1.0)
    error = np.linalg.norm(derivative - central, axis=1) / scale
    np.testing.assert_array_less(error[skew], 1e-5)
    assert np.all(np.isfinite(derivative))


def _walls(*bounds):
    """Zones that stand until 100 s, as a field of a chaser of half a metre has them."""
    stands = {"rotations": np.eye(3)[None], "ends": [100.0], "turned": 0.0, "shift": 0.0}
    return tuple(Zone(Box(lower, upper), **stands) for lower, upper in bounds)


FLOOR, WALL = ([-9.0, -9.0, -9.0], [9.0, 0.0, 9.0]), ([-9.0, -9.0, -9.0], [0.0, 9.0, 9.0])
BALL = SphereField(jnp.asarray([3.0, 3.0, 3.0]), jnp.asarray(1.0))


def _law(*bounds, **changes):
    """The paper's law, led into the corner of two walls beside a ball."""
    return SafeVelocity(
        field=ZonedField(BALL, _walls(*bounds)),
        offset=jnp.asarray(0.3),
        guidance=StraightGuidance(jnp.asarray([-6.0, -5.0, 0.5]), jnp.asarray(0.1), jnp.asarray(2.0)),
        class_k=ClassK(jnp.asarray(0.08)),
        box=jnp.asarray(0.1),
        **{"circulation": printed_circulation(), "row_per_zone": True, **changes},
    )


PLACES = 201
"""Flown at once: every other number of them would be compiled anew."""


@eqx.filter_jit
def _flown_at_once(law, positions, time):
    at = law.at_time(time)
    return jax.vmap(lambda position: at(position, jnp.zeros(3), jnp.zeros(3))[0])(positions)


def _flown(law, positions, time):
    """Ask the law at up to `PLACES` places."""
    padded = np.resize(positions, (PLACES, 3))
    point = jax.device_get(_flown_at_once(law, padded, time))
    return jax.tree.map(lambda of_all: of_all[: len(positions)], point)


def _along_the_walls(step):
    """Places a few decimetres from two walls, across where both are equally near."""
    along = np.arange(-0.1, 0.1, step)
    return np.stack([0.5 + along, 0.5 - along, np.full_like(along, 0.2)], axis=1)


def _past_the_corner(row_per_zone):
    """The law along the walls, the largest step of its velocity, and the slack of each wall's row."""
    places = _along_the_walls(1e-3)
    point = _flown(_law(FLOOR, WALL, row_per_zone=row_per_zone), places, jnp.asarray(0.0))
    largest = np.linalg.norm(np.diff(point.velocity, axis=0), axis=1).max()
    return places, point, largest, (point.velocity[:, :2] + 0.08 * (places[:, :2] - 0.3)).min(axis=0)


@pytest.mark.long
def test_no_velocity_jumps_where_two_zones_are_equally_near():
    places, point, largest, slack = _past_the_corner(True)
    assert largest < 1e-3
    assert (slack > -1e-12).all()
    # The barrier and its normal are those of the nearer wall.
    np.testing.assert_allclose(point.barrier, places[:, :2].min(axis=1) - 0.3, atol=1e-14)
    apart = np.abs(places[:, 0] - places[:, 1]) > 1e-9
    np.testing.assert_allclose(point.normal[apart], np.eye(3)[places[apart, :2].argmin(axis=1)], atol=1e-14)


@pytest.mark.slow  # another law's program, to show that the rows are needed
@pytest.mark.long
def test_with_a_single_row_it_jumps_and_leads_into_the_other_wall():
    places, single, largest, slack = _past_the_corner(False)
    assert largest > 0.05
    assert (slack < -1e-12).all()
    rows = _past_the_corner(True)[1]
    np.testing.assert_allclose(rows.barrier, single.barrier, atol=1e-14)
    apart = np.abs(places[:, 0] - places[:, 1]) > 1e-9
    np.testing.assert_array_equal(rows.normal[apart], single.normal[apart])


@pytest.mark.long
def test_the_velocity_turns_as_its_jacobian_says():
    """Beside walls and ball, inside and outside, at corners whose zones' distances bend."""
    law, now, step = _law(([-9.0, -9.0, -9.0], [2.0, 2.0, 2.5]), WALL), jnp.asarray(0.0), 1e-6
    places = np.random.default_rng(7).uniform([0.2, 2.0, 2.4], [2.4, 3.5, 3.5], (60, 3))
    point = _flown(law, places, now)
    moved = [(_flown(law, places + d, now).velocity - _flown(law, places - d, now).velocity) for d in step * np.eye(3)]
    central = np.stack(moved, axis=-1) / (2.0 * step)
    error = np.abs(point.jacobian - central).max(axis=(1, 2))
    np.testing.assert_array_less(error, 1e-6)


@pytest.mark.long
def test_a_zone_that_has_ended_is_no_row():
    places = _along_the_walls(0.02)
    ended = _flown(_law(FLOOR, WALL), places, jnp.asarray(100.0))
    alone = _flown(dataclasses.replace(_law(FLOOR), field=BALL), places, jnp.asarray(100.0))
    assert np.all(np.isfinite(ended.jacobian))
    np.testing.assert_allclose(ended.velocity, alone.velocity, atol=1e-11)
    np.testing.assert_allclose(ended.jacobian, alone.jacobian, atol=1e-9)
    nowhere = _flown(_law(FLOOR, WALL), np.full((len(places), 3), np.nan), jnp.asarray(0.0))
    assert np.all(nowhere.status == ConeStatus.NOT_FINITE)
    assert np.all(nowhere.velocity == 0.0)
