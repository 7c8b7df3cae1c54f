"""The velocity program against solvers that share no code with it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.velocity_programs import LIMIT, largest_rate, random_programs, reference

from keepout.control.velocity_program.cone import ConeStatus, solve
from keepout.control.velocity_program.program import Circulation, VelocityProgram
from keepout.errors import ControlError

KINDS = {
    # circulation, box, speed cone; with gradient error the barrier row is a cone, without it a half-space
    "all rows": (True, True, True),
    "paper": (True, True, False),
    "paper without circulation": (False, True, False),
    "circulation and norm": (True, False, True),
    "norm": (False, False, True),
}
MANY = 150
"""Programs solved at once: every other number of them is compiled anew."""


solve_alone = jax.jit(jax.vmap(solve))


@jax.jit
def solve_batch(program, direction):
    """Solutions, and the derivatives of their velocities along a direction, in units of the limit."""

    def one(program, direction):
        def velocity(program):
            answer = solve(program)
            return answer.velocity / LIMIT, answer

        return jax.jvp(velocity, (program,), (direction,), has_aux=True)[1:]

    derivative, answer = jax.vmap(one)(program, direction)
    return answer, derivative


def solved(data, kind, *, cone=True, direction=None):
    """Solve programs, with those of `KINDS`' rows, and give what `MANY` of them share a compiled program for."""
    count = len(data["normal"])
    places = np.arange(-(-count // MANY) * MANY) % count
    circulation, box, speed = KINDS[kind]
    parts = []
    for some in places.reshape(-1, MANY):
        program = build({n: v[some] for n, v in data.items()}, circulation=circulation, box=box, speed=speed, cone=cone)
        if kind == "all rows":
            along = jax.tree.map(jnp.zeros_like, program) if direction is None else direction(program)
            parts.append(jax.device_get(solve_batch(program, along)))
        else:
            parts.append((jax.device_get(solve_alone(program)), None))
    return jax.tree.map(lambda *columns: np.concatenate(columns)[:count], *parts)


def build(data, *, circulation, box, speed, cone=True):
    """Give one batched pytree of programs; without `cone` the barrier row is a half-space, as the laws fly it."""

    def single(one):
        return VelocityProgram(
            desired=one["desired"],
            normal=one["normal"],
            barrier_rate=one["barrier_rate"],
            gradient_error=one["gradient_error"] if cone else None,
            circulation=Circulation(one["tangent"], one["circulation_rate"], one["weight"]) if circulation else None,
            box=jnp.asarray(LIMIT, float) if box else None,  # as the other numbers: one program for all steps of them
            speed=one["speed"] if speed else None,
        )

    return jax.vmap(single)({name: jnp.asarray(value) for name, value in data.items()})


def check_against_references(kind, count, seed, *, cone=True, compared=None):
    """Compare statuses with a reference of the room, and the first `compared` velocities with one of the optimum."""
    _, box, speed = KINDS[kind]
    data = random_programs(np.random.default_rng(seed), count)
    if not cone:
        data["gradient_error"][:] = 0.0
    answer, _ = solved(data, kind, cone=cone)
    assert np.all(np.isfinite(answer.velocity))
    agreed = 0
    for i, status in enumerate(answer.status):
        one = {name: value[i] for name, value in data.items()}
        largest = largest_rate(one, box=box, speed=speed)
        room = largest + one["barrier_rate"]
        if abs(room) > 1e-7:
            assert (status in (ConeStatus.INFEASIBLE, ConeStatus.NO_WAY_OUT)) == (room < 0.0), (i, room)
        if status == ConeStatus.NO_WAY_OUT:
            assert largest < 1e-7, i
        if room < 1e-6:
            continue
        assert status == ConeStatus.SOLVED, i
        truth = reference(one, circulation=KINDS[kind][0], box=box, speed=speed) if i < (compared or count) else None
        if truth is None:
            continue
        error = np.linalg.norm(answer.velocity[i] - truth) / max(np.linalg.norm(truth), LIMIT)
        assert error <= 1e-8, (i, error)
        agreed += 1
    assert agreed > 0.75 * (compared or count)
    return answer.status


@pytest.mark.long
def test_agrees_with_scs_and_clarabel():
    status = check_against_references("all rows", MANY, seed=3, compared=60)
    assert {ConeStatus.INFEASIBLE, ConeStatus.NO_WAY_OUT} <= set(status.tolist())


@pytest.mark.long
def test_half_spaces_agree_with_scs_and_clarabel():
    check_against_references("paper", 60, seed=4, cone=False)


@pytest.mark.slow
@pytest.mark.parametrize("cone", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_agrees_with_scs_and_clarabel_on_many(kind, cone):
    check_against_references(kind, 1200 if cone else 300, seed=11, cone=cone)


@pytest.mark.long
def test_half_space_and_ball_have_their_closed_form():
    """Without e_∇h the answer is a projection in closed form; with e_∇h = 0 the interior point must find the same."""
    data = random_programs(np.random.default_rng(5), 3 * MANY)
    data["gradient_error"][:] = 0.0
    (general, _), (closed, _) = (solved(data, "norm", cone=cone) for cone in (True, False))
    assert np.array_equal(general.status, closed.status)
    np.testing.assert_allclose(general.velocity, closed.velocity, atol=1e-12 * LIMIT)


@pytest.mark.long
@pytest.mark.parametrize(
    ("desired", "normal", "rate", "error", "status", "expected"),
    [
        # Where no velocity is safe, the fastest way out; with e ≥ ‖n‖ none is known: zero.
        ([0.1, 0.0, 0.0], [0.0, 2.0, 0.0], -1.0, 0.0, ConeStatus.INFEASIBLE, [0.0, 0.1, 0.0]),
        ([0.1, 0.0, 0.0], [0.0, 1.0, 0.0], -0.001, 1.2, ConeStatus.NO_WAY_OUT, [0.0, 0.0, 0.0]),
        # At the apex of the cone n·v = e‖v‖ with n = z, e = 0.6: the ray at 36.87° above the plane.
        ([0.0, 0.0, -0.05], [0.0, 0.0, 1.0], 0.0, 0.6, ConeStatus.SOLVED, [0.0, 0.0, 0.0]),
        ([0.05, 0.0, 0.0], [0.0, 0.0, 1.0], 0.0, 0.6, ConeStatus.SOLVED, [0.05 * 0.64, 0.0, 0.05 * 0.48]),
        ([0.0, 0.0, 0.05], [0.0, 0.0, 1.0], 0.0, 0.6, ConeStatus.SOLVED, [0.0, 0.0, 0.05]),
    ],
)
def test_programs_with_an_answer_in_closed_form(desired, normal, rate, error, status, expected):
    data = {name: value[:1] for name, value in random_programs(np.random.default_rng(0), 1).items()}
    told = {"desired": [desired], "normal": [normal], "barrier_rate": [rate], "gradient_error": [error], "speed": [0.1]}
    answer, _ = solved(data | {name: np.array(value) for name, value in told.items()}, "norm")
    assert answer.status == status
    np.testing.assert_allclose(answer.velocity[0], expected, atol=1e-11)
    if status == ConeStatus.INFEASIBLE:
        assert float(answer.room[0]) == pytest.approx(0.2 - 1.0)


@pytest.mark.long
def test_says_when_data_are_not_numbers():
    data = random_programs(np.random.default_rng(1), MANY)
    data["normal"][0, 1] = np.nan
    data["barrier_rate"][1] = np.inf
    data["desired"][2, 0] = -np.inf
    answer, _ = solved(data, "all rows")
    assert answer.status[:3].tolist() == [ConeStatus.NOT_FINITE] * 3
    assert not np.any(answer.status[3:] == ConeStatus.NOT_FINITE)
    assert np.all(answer.velocity[:3] == 0.0)


def test_needs_a_speed_limit():
    with pytest.raises(ControlError, match="neither a box nor a speed limit"):
        VelocityProgram(jnp.zeros(3), jnp.ones(3), jnp.asarray(1.0))


@pytest.mark.long
def test_derivative_is_the_central_difference():
    rng, step = np.random.default_rng(8), 1e-6
    data = random_programs(rng, 2 * MANY)
    data["normal"][np.linalg.norm(data["normal"], axis=1) == 0.0] = [0.0, 0.7, 0.7]
    data["barrier_rate"] = np.where(data["barrier_rate"] == 0.0, 0.003, data["barrier_rate"])
    along = {name: rng.normal(size=value.shape) * 0.1 for name, value in data.items()}
    rows = [slice(MANY), slice(MANY, None)]

    def at(shift):
        moved = {name: value + shift * along[name] for name, value in data.items()}
        ways = iter([build({n: v[r] for n, v in along.items()}, circulation=True, box=True, speed=True) for r in rows])
        # The box is not moved.
        still = (eqx.tree_at(lambda w: w.box, way, jnp.zeros(MANY)) for way in ways)
        return solved(moved, "all rows", direction=lambda _: next(still))

    answer, derivative = at(0.0)
    central = (at(step)[0].velocity - at(-step)[0].velocity) / (2.0 * step * LIMIT)
    # With e = ‖n‖ and no room, the fastest way out is at full speed on one side of e = ‖n‖ and does not exist on the
    # other: the solution jumps there, and has no derivative.
    size = np.linalg.norm(data["normal"], axis=-1)
    jumps = (np.abs(data["gradient_error"] - size) < 1e-12) & (answer.room < 0.0)
    assert 0 < jumps.sum() <= 2
    error = np.linalg.norm(derivative - central, axis=-1) / np.maximum(np.linalg.norm(central, axis=-1), 1.0)
    np.testing.assert_array_less(error[~jumps], 1e-6)


def check_fuzz(rng, count):
    """Numbers over many magnitudes, with zeros: finite, within the limits, and safe where it is said so."""

    def wild(*shape):
        values = rng.normal(size=shape) * 10.0 ** rng.uniform(-9, 4, shape)
        return np.where(rng.random(shape) < 0.05, 0.0, values)

    data = {
        "desired": wild(count, 3),
        "normal": wild(count, 3),
        "barrier_rate": wild(count),
        "gradient_error": np.abs(wild(count)),
        "tangent": wild(count, 3),
        "circulation_rate": wild(count),
        "weight": np.abs(wild(count)) + 1e-12,
        "speed": np.abs(wild(count)) + 1e-9,
    }
    answer, _ = solved(data, "all rows")
    velocity, status = answer.velocity, answer.status
    assert np.all(np.isfinite(velocity))
    assert not np.any(status == ConeStatus.NOT_FINITE)
    speed = np.linalg.norm(velocity, axis=1)
    assert np.all(speed <= data["speed"] * (1 + 1e-9))
    assert np.all(np.abs(velocity) <= LIMIT * (1 + 1e-9))
    safe = status == ConeStatus.SOLVED
    slack = np.sum(data["normal"] * velocity, axis=1) + data["barrier_rate"] - data["gradient_error"] * speed
    fastest = np.minimum(data["speed"], np.sqrt(3.0) * LIMIT)
    size = (np.linalg.norm(data["normal"], axis=1) + data["gradient_error"]) * fastest
    assert np.all(slack[safe] >= -1e-9 * size[safe] - 1e-300)
    return np.mean(status == ConeStatus.STALLED)


@pytest.mark.long
def test_wild_numbers():
    """Of numbers spread over thirteen decades one program in a thousand may stay unverified, and then says so."""
    rng = np.random.default_rng(0)
    assert check_fuzz(rng, 27 * MANY) <= 1e-3


@pytest.mark.slow
def test_a_million_wild_numbers():
    assert np.mean([check_fuzz(np.random.default_rng(seed), 50_000) for seed in range(1, 21)]) <= 1e-3
