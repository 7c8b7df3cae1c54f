"""Rivals of `benchmarks/rivals.py`: each steers to a goal in free space, and rows and envelopes say what they must."""

import dataclasses
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rivals_laws import rows
from rivals_laws.envelope_fields import CapsuleField, EllipsoidField
from rivals_laws.flying import stacked
from rivals_laws.observed import Plant
from rivals_laws.potential_field import ArtificialPotential, PotentialField
from rivals_laws.registry import RIVALS
from rivals_laws.rival import Rival
from rivals_laws.sampling_mpc import PathIntegral, SamplingMPC, Weights

from keepout.control import profiles
from keepout.control.guidance.plan import Straight
from keepout.control.operation import Operation
from keepout.fields.analytic import SphereField
from keepout.flight.batches import fly_batches
from keepout.flight.loop import fly
from keepout.flight.setup import FlightSetup
from keepout.motion import Chaser, paper_disturbance
from keepout.motion.orbit import Orbit
from keepout.motion.relative import RelativeMotion

CHASER = Chaser(mass=20.0, radius=0.5, force_limit=0.1, speed_limit=0.1)
MOTION = RelativeMotion(Orbit(6_778_137.0))
GOAL, START = np.array([4.0, 0.5, 0.0]), np.array([6.0, 1.0, 0.5])
FIELD = SphereField(jnp.zeros(3), jnp.asarray(1.0))
OFFSET = 0.6


@pytest.fixture(scope="module")
def default_law():
    operation = Operation(CHASER, MOTION, error_bound=0.0, disturbance_bound=paper_disturbance().bound)
    return profiles.default(FIELD, operation, [0.0, 0.0, 20.0], guidance=Straight())


@pytest.fixture(scope="module")
def plant(default_law):
    speed = default_law.velocity.speed
    force_limit = default_law.force_limit
    return Plant(MOTION, default_law.observer, default_law.mass, force_limit, speed.limit, speed.authority)


def setup_of(law):
    return FlightSetup(MOTION, paper_disturbance(), CHASER.thrusters, law, GOAL, CHASER.mass)


def potential_field(plant):
    tuned = ArtificialPotential()
    numbers = (tuned.gain, tuned.slowing_length, tuned.influence, tuned.stand_off)
    return PotentialField(plant, FIELD, OFFSET, jnp.asarray(GOAL), *numbers)


def sampling_mpc(plant):
    tuned = PathIntegral()
    spread = tuned.spread_of_authority * float(plant.authority)
    costs = (tuned.room_m, tuned.collision, tuned.speeding)
    weights = Weights(tuned.temperature_s, spread, tuned.held_s, *costs)
    return SamplingMPC(plant, FIELD, OFFSET, jnp.asarray(GOAL), weights, tuned.knots, 64)


@pytest.mark.long
@pytest.mark.parametrize(("make", "tolerance"), [(potential_field, 0.1), (sampling_mpc, 0.3)])
def test_a_rival_reaches_a_goal_in_free_space_within_the_speed_limit(plant, make, tolerance):
    log = fly(setup_of(make(plant)), MOTION.initial_state(START, np.zeros(3)), 200, jax.random.key(0))
    assert np.linalg.norm(log.position[-1] - GOAL) < tolerance
    assert np.linalg.norm(log.velocity, axis=-1).max() < 0.11


@pytest.mark.long
def test_a_batch_flies_each_flight_as_it_flies_alone(plant):
    goals = np.array([GOAL, [4.0, -1.0, 0.0], [3.0, 2.0, 1.0]])
    prototype = potential_field(plant)
    laws = [eqx.tree_at(lambda law: law.towards, prototype, jnp.asarray(goal)) for goal in goals]
    law, select = stacked(laws)
    assert len(select(law)) == 1
    setup = eqx.tree_at(lambda s: (s.controller, s.goal), setup_of(laws[0]), (law, jnp.asarray(goals)))
    initial = eqx.filter_vmap(MOTION.initial_state)(jnp.tile(START, (3, 1)), jnp.zeros((3, 3)))
    columns = {}
    fly_batches(
        setup,
        initial,
        50,
        vary=lambda s: [s.goal, *select(s.controller)],
        columns=("position",),
        landed=lambda first, log: columns.update(log),
    )
    alone = fly(setup_of(laws[2]), MOTION.initial_state(START, np.zeros(3)), 50, jax.random.key(0))
    np.testing.assert_allclose(columns["position"][2], alone.position, atol=1e-9)
    assert np.linalg.norm(columns["position"][2, -1] - columns["position"][0, -1]) > 0.5


def closest_on_ellipsoid(point, semi_axes):
    """Brute force: the nearest of many surface points, then again in a patch round it."""
    centre, width = np.array([0.5 * np.pi, 0.0]), np.array([0.5 * np.pi, np.pi])
    for _ in range(12):
        theta, phi = np.meshgrid(*(c + w * np.linspace(-1.0, 1.0, 41) for c, w in zip(centre, width)), indexing="ij")
        unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
        distance = np.linalg.norm(unit * semi_axes - point, axis=-1)
        best = np.unravel_index(distance.argmin(), distance.shape)
        centre, width = np.array([theta[best], phi[best]]), 0.2 * width
    return distance.min()


@pytest.mark.long
def test_the_ellipsoid_fields_distance_is_the_distance():
    semi_axes = np.array([5.0, 2.0, 0.7])
    field = EllipsoidField(jnp.zeros(3), jnp.eye(3), jnp.asarray(semi_axes))
    directions = np.random.default_rng(0).normal(size=(40, 3))
    points = 1.2 * directions / np.linalg.norm(directions / semi_axes, axis=1, keepdims=True)
    value, gradient, hessian = field.value_gradient_hessian(jnp.asarray(points))
    np.testing.assert_allclose(value, [closest_on_ellipsoid(p, semi_axes) for p in points], atol=1e-6)
    # A distance: unit gradients, and nothing changes along them.
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", hessian, gradient), 0.0, atol=1e-9)


def test_the_capsule_fields_distance_is_the_distance():
    field = CapsuleField(jnp.array([-1.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0]), jnp.asarray(0.5))
    points = jnp.array([[0.3, 2.0, 0.0], [4.0, 0.0, 0.0], [-1.0, 0.0, 0.2]])
    np.testing.assert_allclose(field.value(points), [1.5, 2.5, -0.3], atol=1e-12)


class Prepared:
    """Just enough of a case for rows that fly nothing."""

    name, seed = "pocket", 0
    model = type("Model", (), {"sha256": "0" * 64})
    scenario = type("Scenario", (), {"model_dump": lambda self: {}})()


@dataclasses.dataclass(frozen=True)
class Absent(Rival):
    name = "absent"
    packages = ("no_such_package",)
    number: float = 1.0

    def law(self, case, start, goal):
        raise AssertionError("it must not be asked")


def test_a_rival_whose_package_is_missing_has_a_row_that_says_how_to_install_it():
    plan = rows.planned(Prepared(), Absent(), False, 5)
    row = rows.flown_row(Prepared(), Absent(), plan, None)
    assert list(row) == list(rows.COLUMNS)
    assert "pip install" in row["note"]
    assert "no_such_package" in row["note"]
    assert row["reached"] is None


def test_progress_of_a_row_ends_at_its_end_where_the_last_batch_is_not_full(monkeypatch):
    class Landed:
        first = None

        def __init__(self, case):
            pass

        def add(self, index, laws, guarded, size, progress):
            progress(1.0, "")

        def row(self):
            return {}

    class Present(Absent):
        packages, batch = (), 4

    monkeypatch.setattr(rows, "Flown", Landed)
    monkeypatch.setattr(rows, "laws_of", lambda case, rival, index: (list(index), [None for _ in index], [], [0.0]))
    monkeypatch.setattr(rows, "step_ms", lambda *_: 0.0)
    case, done = Prepared(), []
    case.pairs = np.zeros((10, 2, 3))
    plan = rows.planned(case, Present(), False, 10)
    rows.flown_row(case, Present(), plan, lambda fraction, _: done.append(fraction))
    assert done == pytest.approx([0.4, 0.8, 1.0])


def test_rows_are_kept_and_found_again_only_with_the_same_settings(tmp_path: Path):
    store = rows.Rows(tmp_path / "rows.json")
    plan = rows.planned(Prepared(), Absent(), True, 5)
    store.keep(rows.flown_row(Prepared(), Absent(), plan, None))
    again = rows.Rows(tmp_path / "rows.json")
    assert again.find(plan) is not None
    assert again.find(rows.planned(Prepared(), Absent(number=2.0), True, 5)) is None
    assert again.find(rows.planned(Prepared(), Absent(), True, 6)) is None
    # More flights take the place of fewer.
    again.keep(rows.flown_row(Prepared(), Absent(), rows.planned(Prepared(), Absent(), True, 6), None))
    assert [row["flights"] for row in json.loads((tmp_path / "rows.json").read_text())] == [6]


def test_rivals_have_names_of_their_own_and_settings_that_can_be_kept():
    names = [rival.name for rival in RIVALS]
    assert len(set(names)) == len(names)
    for rival in RIVALS:
        json.dumps(rival.settings)
