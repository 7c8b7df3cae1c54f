"""The composed law in flight round an obstacle with the paper's disturbance, and what its construction refuses."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from truths.operations import operation

from keepout.control import profiles
from keepout.control.circulation import NoCirculation
from keepout.control.guidance.geodesic import BarrierGrid
from keepout.control.guidance.guidance import StraightGuidance
from keepout.control.guidance.plan import Geodesic, Straight
from keepout.control.law import ControlStatus
from keepout.control.observer import constant_observer
from keepout.control.tuning import tune
from keepout.errors import ControlError
from keepout.fields.analytic import BoxUnionField
from keepout.motion.actuator import Thrusters
from keepout.motion.disturbance import paper_disturbance
from keepout.motion.orbit import Orbit
from keepout.motion.relative import RelativeMotion

PANELS = BoxUnionField(
    jnp.asarray([[-1.5, -1.5, -1.5], [-0.2, -8.0, -1.2], [-0.2, 1.5, -1.2]]),
    jnp.asarray([[1.5, 1.5, 1.5], [0.2, -1.5, 1.2], [0.2, 8.0, 1.2]]),
    jnp.asarray(0.02),
)
MOTION = RelativeMotion(Orbit(6_778_137.0))
PUSH = paper_disturbance()
CASE = operation(motion=MOTION, disturbance_bound=PUSH.bound)
GOAL, START = np.array([4.0, -4.0, 0.0]), np.array([-4.0, 3.0, 0.5])
ELSEWHERE = StraightGuidance(jnp.asarray([9.0, 0.0, 0.0]), jnp.asarray(0.1), jnp.asarray(1.5))


@pytest.fixture(scope="module")
def grid():
    return BarrierGrid.build(PANELS, 0.77, [-7.0, -12.0, -6.0], [7.0, 12.0, 6.0], spacing=0.4)


@pytest.fixture(scope="module")
def default(grid):
    return profiles.default(PANELS, CASE, GOAL, start=START, guidance=Geodesic(grid=grid))


def fly(controller, position, steps):
    def advance(carry, _):
        state, memory = carry
        memory, command = controller.step(memory, state)
        force = Thrusters(controller.force_limit).apply(command.force)
        row = (state.position, state.velocity, command, PUSH.force(state.time))
        return (MOTION.step(state, force, PUSH, 1.0, 20.0), memory), row

    state = MOTION.initial_state(position, jnp.zeros(3))
    return jax.lax.scan(advance, (state, controller.initial_state(state)), length=steps)[1]


flights = eqx.filter_jit(eqx.filter_vmap(fly, in_axes=(None, 0, None)))


@pytest.mark.long
def test_default_law_reaches_the_goal_without_contact_and_without_saturation(default):
    rng = np.random.default_rng(4)
    starts = rng.uniform([-6, -10, -5], [6, 10, 5], (400, 3))
    starts = jnp.asarray(starts[np.asarray(PANELS.value(jnp.asarray(starts))) > 1.3][:24])
    position, velocity, command, _ = flights(default, starts, 700)
    assert np.linalg.norm(position[:, -1] - GOAL, axis=-1).max() < 0.1
    # Nothing comes nearer than radius and margin; the law's own offset is on top of that.
    assert float(PANELS.value(position).min()) > 0.6
    assert np.mean(np.any(np.abs(command.force) >= 0.1 * (1 - 1e-9), axis=-1)) < 0.05
    assert np.linalg.norm(velocity, axis=-1).max() < 0.102
    assert np.isin(command.status, [ControlStatus.NOMINAL, ControlStatus.SATURATED]).all()
    np.testing.assert_allclose(command.barrier, PANELS.value(position) - 0.65, atol=1e-9)


def test_paper_law_says_what_it_violates():
    with pytest.warns(profiles.ControlWarning, match="observer outpaces filter violated"):
        law = profiles.paper(PANELS, CASE, GOAL)
    broken = {c.name for c in law.conditions if not c.satisfied}
    assert {
        "observer outpaces filter",
        "sampled tracking",
        "authority",
        "circulation tangent",
        "disturbance model",
    } <= broken


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::keepout.control.profiles.ControlWarning")
def test_paper_law_saturates_the_thrusters():
    law = profiles.paper(PANELS, CASE, GOAL)
    _, _, command, _ = eqx.filter_jit(fly)(law, jnp.asarray(START), 300)
    assert np.mean(np.any(np.abs(command.force) >= 0.1 * (1 - 1e-9), axis=-1)) > 0.9
    assert np.all(np.isfinite(command.force))


@pytest.mark.long
def test_goals_batch_by_vmap(default, grid):
    other = profiles.default(PANELS, CASE, [-4.0, -4.0, 2.0], guidance=Geodesic(grid=grid))
    one, two = (eqx.partition(dataclasses.replace(c, checked=()), eqx.is_array) for c in (default, other))
    both = eqx.combine(jax.tree.map(lambda a, b: jnp.stack([a, b]), one[0], two[0]), one[1])
    state = MOTION.initial_state(START, np.zeros(3))
    step = eqx.filter_jit(eqx.filter_vmap(lambda c: c.step(c.initial_state(state), state)[1].desired_velocity))
    together = step(both)
    for k, law in enumerate((default, other)):
        np.testing.assert_allclose(together[k], law.velocity.guidance.desired_velocity(state.position), atol=1e-12)
    assert np.linalg.norm(together[0] - together[1]) > 0.01


@pytest.mark.long
def test_a_sample_that_is_not_a_number_is_said_and_forgotten(default):
    step = eqx.filter_jit(lambda memory, state: default.step(memory, state))
    state = MOTION.initial_state(START, np.zeros(3))
    broken = MOTION.initial_state(START * np.nan, np.zeros(3))
    memory, _ = step(default.initial_state(state), state)
    memory, command = step(memory, broken)
    assert command.status == ControlStatus.NOT_FINITE
    np.testing.assert_array_equal(command.force, 0.0)
    _, command = step(memory, state)
    assert command.status == ControlStatus.NOMINAL
    assert np.all(np.isfinite(command.force))


@pytest.mark.long
def test_inside_the_keep_out_zone_it_flies_the_fastest_way_out(default):
    inside = MOTION.initial_state(np.array([0.0, 0.0, 1.6]), np.zeros(3))
    _, command = eqx.filter_jit(lambda s: default.step(default.initial_state(s), s))(inside)
    assert command.status == ControlStatus.OUTSIDE_SAFE_SET
    direction = np.asarray(command.safe_velocity) / np.linalg.norm(command.safe_velocity)
    normal = np.asarray(PANELS.value_and_gradient(inside.position)[1])
    np.testing.assert_allclose(direction, normal / np.linalg.norm(normal), atol=1e-9)


def test_observer_is_told_of_a_replaced_force(default):
    state = MOTION.initial_state(START, np.zeros(3))
    memory = default.with_applied_force(default.initial_state(state), jnp.asarray([0.01, 0.0, 0.0]))
    np.testing.assert_array_equal(memory.force, [0.01, 0.0, 0.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"guidance": ELSEWHERE}, r"guidance: leads to \[9\.0, 0\.0, 0\.0\], and the goal is"),
        ({"goal": [0.0, 0.0, 1.0]}, r"goal: .* inside the keep-out zone"),
        ({"goal": [0.0, np.nan, 1.0]}, r"goal: .* three finite numbers"),
        ({"tracking_gain": 3.0}, r"sampled tracking violated .* 1\.5 against 1"),
        ({"barrier_rate": 10.0}, "observer outpaces filter violated"),
        ({"braking": 0.01}, "authority violated"),
        ({"disturbance_bound": 0.2}, "authority: disturbance"),
        ({"speed_limit": 0.5}, r"speed_limit: .* at most 0\.1"),
        ({"period": -1.0}, "period: -1.0 s; it must be positive"),
        ({"tracking": 1.0}, "gains: tracking not known"),
    ],
)
def test_refuses_a_law_that_cannot_work(change, message):
    numbers = {"disturbance_bound", "speed_limit", "period"} & set(change)
    told = operation(**{"motion": MOTION, "disturbance_bound": PUSH.bound} | {name: change[name] for name in numbers})
    others = {name: value for name, value in change.items() if name not in numbers}
    arguments = {"goal": GOAL, "guidance": Straight(), "observer": constant_observer(mass=20.0, period=1.0)} | others
    with pytest.raises(ControlError, match=message):
        profiles.default(PANELS, told, **arguments)


def test_a_guidance_and_a_circulation_are_objects(default):
    made = StraightGuidance(jnp.asarray(GOAL), jnp.asarray(0.05), jnp.asarray(2.0))
    law = profiles.default(PANELS, CASE, GOAL, guidance=made, circulation=NoCirculation())
    assert law.velocity.guidance is made
    assert law.velocity.circulation is None
    assert np.all(np.asarray(law.goal) == GOAL)


def test_refuses_a_goal_that_turns_too_fast_to_hold():
    from keepout.motion.attitude import Tumbling

    spinning = RelativeMotion(Orbit(6_778_137.0), Tumbling(np.radians([0.0, 0.0, 3.0]), np.diag([1.0, 2.0, 2.5])))
    with pytest.raises(ControlError, match=r"authority: .* drift"):
        profiles.default(PANELS, operation(motion=spinning), GOAL, guidance=Straight())


def test_tuning_of_the_papers_case_is_the_prototypes():
    found = tune(operation(disturbance_bound=0.01414), drift_bound=3e-4)
    assert found.authority == pytest.approx(0.004, rel=0.01)
    assert found.braking == pytest.approx(0.002, rel=0.01)
    assert (found.tracking_gain, found.class_k_rate) == (1.0, 0.08)
    assert found.honoured_speed == pytest.approx(np.sqrt(2 * 0.004 * 3.0), rel=0.01)
