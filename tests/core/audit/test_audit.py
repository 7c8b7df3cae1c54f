"""The audit against closed-form distances and densely integrated flights."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.audited import BOUNDS, MASS, Mesh, judged, straight

from keepout.core.audit.audit import Contact, Limits, audit_campaign, proved_outside
from keepout.core.audit.tube import FlightBounds, Tube, nearest
from keepout.core.errors import FlightError


def flown(rng, steps, *, start, velocity, thrust=0.1, period=1.0, fine=20):
    """A flight integrated at fine steps under held forces, a wandering disturbance and a rotating frame's drift."""
    spin = np.array([[0.0, 0.0, -1.1e-3], [0.0, 0.0, 0.0], [1.1e-3, 0.0, 0.0]])
    gradient = rng.normal(size=(3, 3))
    gradient *= 2.5e-6 / np.linalg.norm(gradient, 2)
    stiffness = -spin @ spin - gradient
    r, v = np.array(start, float), np.array(velocity, float)
    samples, dense = [], []
    h = period / fine
    for k in range(steps + 1):
        force = rng.uniform(-thrust, thrust, 3)
        samples.append((k * period, r.copy(), v.copy(), force))
        if k == steps:
            break
        disturbance = rng.normal(size=3)
        disturbance *= 0.0149 / np.linalg.norm(disturbance)

        def rate(r, v, push=(force + disturbance) / MASS):
            return v, stiffness @ r - 2 * (spin @ v) + push

        for _ in range(fine):
            dense.append(r.copy())
            k1 = rate(r, v)
            k2 = rate(r + h / 2 * k1[0], v + h / 2 * k1[1])
            k3 = rate(r + h / 2 * k2[0], v + h / 2 * k2[1])
            k4 = rate(r + h * k3[0], v + h * k3[1])
            r = r + h / 6 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0])
            v = v + h / 6 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1])
    dense.append(r.copy())
    time, position, velocity, force = (np.array([s[i] for s in samples]) for i in range(4))
    return SimpleNamespace(time=time, position=position, velocity=velocity, force=force), np.array(dense)


@pytest.mark.long
@given(seed=st.integers(0, 2**32 - 1), period=st.sampled_from([1.0, 2.0, 0.37]))
def test_tube_holds_the_dense_path_and_its_minimum(seed, period):
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    record, dense = flown(rng, 150, start=3.0 * direction, velocity=-0.03 * direction, period=period)
    mesh = Mesh(1.0)
    tube = Tube.of(record.time, record.position[None], record.velocity[None], record.force[None], BOUNDS)
    assert tube.inconsistency().max() < 1e-12
    # Of the lines between dense samples, which the path keeps to within 2e-5 m: the edge of a box is passed in between.
    along = np.linspace(0.0, 1.0, 20, endpoint=False)[:, None]
    finest = (dense[:-1, None] + along * np.diff(dense, axis=0)[:, None]).reshape(-1, 3)
    assert np.linalg.norm(np.diff(finest, axis=0), axis=1).max() < 2e-3
    truth = mesh.distance_to(finest).min()
    bound = nearest(tube, mesh.distance.distance, tolerance=1e-3)
    remainder = 0.125 * (tube.residual * np.diff(record.time) ** 2).max()
    assert bound.lower[0] <= truth <= bound.upper[0] + 1e-3 + 2 * remainder
    assert bound.upper[0] - bound.lower[0] <= 1e-3 + 2.2 * remainder
    index = np.floor(bound.time[0] / period * 20).astype(int)
    near = np.linalg.norm(dense[max(index - 20, 0) : index + 21] - bound.position[0], axis=-1).min()
    assert near < 0.05


def dipping():
    """Clear by 0.82 m and 0.42 m of a box at its two samples, and by 0.1 m between them, 1.2 s after the first."""
    return SimpleNamespace(
        time=np.array([0.0, 2.0]),
        position=np.array([[0.0, 0.0, 1.82], [0.0, 0.0, 1.42]]),
        velocity=np.array([[0.0, 0.0, -1.2], [0.0, 0.0, 0.8]]),
        force=np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 20.0]]),
    )


def test_it_is_said_that_a_dip_between_samples_comes_nearer():
    """The least clearance lies between two samples; a chaser a centimetre larger touches there."""
    bounds = FlightBounds(MASS, 1e-6, 0.0, 0.0, 0.0)
    found = judged(dipping(), Mesh(1.0), radius=0.05, bounds=bounds)
    assert found.contact is Contact.NO
    assert found.minimum_clearance == pytest.approx(0.05, abs=1.1e-3)
    assert found.minimum_time == pytest.approx(1.2, abs=0.05)
    assert judged(dipping(), Mesh(1.0), radius=0.11, bounds=bounds).contact is Contact.YES


def test_it_is_said_that_a_push_not_recorded_leaves_room():
    """A force that the record does not hold could carry the chaser the last millimetres: not a "no" with it."""

    def verdict(push):
        bounds = FlightBounds(MASS, push, 0.0, 0.0, 0.0)
        return judged(dipping(), Mesh(1.0), radius=0.0985, bounds=bounds, tolerance=1e-5)

    assert verdict(1e-6).contact is Contact.NO
    # 0.1 N on 20 kg: 1.6 mm in the 0.8 s from the nearest point to the second sample.
    assert verdict(0.1).contact is Contact.UNDECIDED
    assert "too close" in verdict(0.1).remarks[0]


def test_it_is_said_where_a_position_was_edited():
    record = straight(0.1, 80)
    record.position[40] = [0.0, 0.0, 0.2]
    found = judged(record, Mesh(1.0), radius=0.3)
    assert found.contact is not Contact.NO
    assert {39, 40} <= set(found.inconsistent_steps)
    # Deep inside a closed body the unsigned distance is large again: the edit is still caught, by the dynamics.
    big = Mesh(5.0)
    far = straight(0.1, 80, start=(-4.0, 0.0, 6.0))
    assert judged(far, big, radius=0.3).contact is Contact.NO
    far.position[40] = [0.0, 0.0, 0.0]
    assert judged(far, big, radius=0.3).contact is not Contact.NO


@pytest.mark.long
def test_a_flight_in_a_cavity_is_not_said_to_be_safe():
    record = straight(0.02, 80, start=(-1.0, 0.0, 0.0))
    inside = judged(record, Mesh(5.0), radius=0.1)
    assert inside.minimum_clearance > 0.0
    assert inside.contact is Contact.UNDECIDED
    assert not inside.start_outside


def test_a_straight_pass_has_its_closed_form_clearance():
    found = judged(straight(0.1, 80), Mesh(1.0), radius=0.3)
    assert found.contact is Contact.NO
    assert 0.2 - 1.5e-3 <= found.minimum_clearance <= 0.2
    assert found.consistent
    assert found.force_violations == 0


@pytest.mark.parametrize(("name", "by"), [("position", 2e-3), ("position", 0.5), ("velocity", 5e-3), ("force", 0.1)])
def test_small_edits_are_caught_down_to_the_slack_of_the_bounds(name, by):
    record = straight(0.1, 80)
    getattr(record, name)[30, 2] += by
    assert not judged(record, Mesh(1.0), radius=0.3).consistent


def test_a_flight_through_a_wall_is_a_contact():
    found = judged(straight(0.1, 80, start=(-4.0, 0.0, 0.0)), Mesh(1.0), radius=0.05)
    assert found.contact is Contact.YES


def test_outside_is_proved_round_a_corner():
    # The start looks into an open box from its mouth; the way out is behind.
    def cup(points):
        walls = [((-1, -1, -1), (1, 1, -1)), ((-1, -1, -1), (-1, 1, 1)), ((1, -1, -1), (1, 1, 1))]
        walls += [((-1, -1, -1), (1, -1, 1)), ((-1, 1, -1), (1, 1, 1))]
        return np.min(
            [
                np.linalg.norm(np.maximum(np.maximum(np.array(a) - points, points - np.array(b)), 0), axis=-1)
                for a, b in walls
            ],
            axis=0,
        )

    lower, upper = -np.ones(3), np.ones(3)
    assert proved_outside(np.array([0.0, 0.0, -0.6]), cup, lower, upper, radius=0.2)
    assert not proved_outside(np.array([0.0, 0.0, -0.9]), cup, lower, upper, radius=0.2)

    def closed(points):
        return np.minimum(cup(points), np.linalg.norm(np.maximum(np.abs(points - [0, 0, 1]) - [1, 1, 0], 0), axis=-1))

    assert not proved_outside(np.array([0.0, 0.0, -0.6]), closed, lower, upper, radius=0.2)


def test_limits_and_interventions_are_counted():
    record = straight(0.25, 30)
    record.force[3, 1] = -0.3
    record.guard_status = np.array([0, 1, 1, 2] + [0] * 27)
    found = judged(record, Mesh(1.0))
    assert found.force_violations == 1
    assert found.force_excess == pytest.approx(0.2)
    assert found.speed_violations == 31
    assert found.guard_interventions == 3


def test_campaign_equals_single_audits_and_asks_few_distances():
    rng = np.random.default_rng(5)
    records = [
        flown(rng, 300, start=[-4.0, y, 1.4], velocity=[0.02, 0, 0], thrust=0.02, fine=1)[0] for y in (-0.5, 0, 0.7)
    ]
    mesh = Mesh(1.0)
    log = {name: np.stack([getattr(r, name) for r in records]) for name in ("time", "position", "velocity", "force")}
    together = audit_campaign(log, mesh, Limits(0.1, 0.1, 0.2), BOUNDS, consistency=1e-3)
    assert mesh.queries < 0.7 * 300 * len(records)
    for record, found in zip(records, together):
        alone = judged(record, mesh, radius=0.1, consistency=1e-3)
        assert alone.minimum_clearance == found.minimum_clearance
        assert alone.contact == found.contact


def test_unreadable_numbers_are_never_a_no():
    record = straight(0.1, 80)
    record.position[7, 0] = np.nan
    found = judged(record, Mesh(1.0))
    assert found.contact is Contact.UNDECIDED
    assert "7 s" in found.remarks[0]


def test_refusals_name_the_number():
    record = straight(0.1, 10)
    with pytest.raises(FlightError, match="mass is -1"):
        FlightBounds(-1.0, 0.0, 0.0, 0.0, 0.0)
    record.time[4] = 2.0
    with pytest.raises(FlightError, match="time must rise"):
        judged(record, Mesh(1.0))
    with pytest.raises(FlightError, match="at least 2"):
        judged(straight(0.1, 0), Mesh(1.0))
    with pytest.raises(FlightError, match="too coarse"):
        judged(straight(0.1, 10), Mesh(1.0), bounds=FlightBounds(MASS, 0.0, 1.0, 0.0, 0.0))


def test_a_flight_that_leaves_the_range_of_its_gravity_bound_is_not_called_safe():
    record, mesh = straight(0.1, 10), Mesh(1.0)
    furthest = np.linalg.norm(record.position, axis=1).max()
    safe = FlightBounds(**(vars(BOUNDS) | {"range_limit": furthest + 1.0}))
    assert judged(record, mesh, radius=0.05, bounds=safe).contact is Contact.NO
    left = judged(record, mesh, radius=0.05, bounds=FlightBounds(**(vars(BOUNDS) | {"range_limit": furthest - 0.01})))
    assert left.contact is Contact.UNDECIDED
    assert "where gravity is not bounded" in left.remarks[-1]
    with pytest.raises(FlightError, match="range_limit is nan"):
        FlightBounds(**(vars(BOUNDS) | {"range_limit": np.nan}))
