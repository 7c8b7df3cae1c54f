"""The audit against closed-form distances and densely integrated flights."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.audited import (
    BOUNDS,
    MASS,
    Mesh,
    check_a_cavity_is_not_called_safe,
    check_a_dip_between_samples_is_found,
    check_a_push_not_recorded_leaves_room,
    check_an_edited_position_is_caught,
    judged,
    straight,
)

from keepout.audit import audit
from keepout.audit.audit import Contact, audit_campaign
from keepout.audit.outside import proved_outside
from keepout.audit.tube import FlightBounds, Tube, nearest
from keepout.errors import FlightError


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
    truth = mesh.distance_to(dense).min()
    bound = nearest(tube, mesh.distance.distance, tolerance=1e-3)
    remainder = 0.125 * (tube.residual * np.diff(record.time) ** 2).max()
    assert bound.lower[0] <= truth <= bound.upper[0] + 1e-3 + 2 * remainder
    assert bound.upper[0] - bound.lower[0] <= 1e-3 + 2.2 * remainder
    index = np.floor(bound.time[0] / period * 20).astype(int)
    near = np.linalg.norm(dense[max(index - 20, 0) : index + 21] - bound.position[0], axis=-1).min()
    assert near < 0.05


# The audit broken on purpose: what must be said of flights known in closed form is then no longer said.


def look_at_samples_only(monkeypatch):
    """Between two samples the chaser is taken to be at the nearer one: the tube is nothing."""

    def piece(self, flight, index, start, end):
        sample = index + np.where(0.5 * (start + end) <= 0.5, 0, 1)
        nothing = np.zeros(len(index))
        return self.position[flight, sample], nothing, nothing

    monkeypatch.setattr(Tube, "piece", piece)


def take_the_middle_for_the_whole(monkeypatch):
    """A piece of path is taken for its middle: its radius is nothing."""
    whole = Tube.piece

    def piece(self, *arguments):
        point, error, _ = whole(self, *arguments)
        return point, error, error

    monkeypatch.setattr(Tube, "piece", piece)


def forget_what_is_not_recorded(monkeypatch):
    """Disturbance and drift are taken for nothing."""
    whole = Tube.piece

    def piece(self, flight, index, start, end):
        point, error, radius = whole(self, flight, index, start, end)
        return point, np.zeros_like(error), radius - error

    monkeypatch.setattr(Tube, "piece", piece)


def believe_every_step(monkeypatch):
    """Samples are never asked whether a motion joins them."""
    monkeypatch.setattr(Tube, "inconsistency", lambda self: np.full(self.residual.shape, -1.0))


def believe_every_start(monkeypatch):
    """A flight is taken to be outside wherever it is."""
    monkeypatch.setattr(audit, "proved_outside", lambda *_, **__: True)


@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (look_at_samples_only, check_a_dip_between_samples_is_found),
        (take_the_middle_for_the_whole, check_a_dip_between_samples_is_found),
        (forget_what_is_not_recorded, check_a_push_not_recorded_leaves_room),
        (believe_every_step, check_an_edited_position_is_caught),
        (believe_every_start, check_a_cavity_is_not_called_safe),
    ],
)
def test_what_must_be_said_is_said_and_a_break_is_noticed(broken, check, monkeypatch):
    check()
    broken(monkeypatch)
    with pytest.raises(AssertionError):
        check()


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
    together = audit_campaign(
        records[0].time,
        *(np.stack([getattr(r, n) for r in records]) for n in ("position", "velocity", "force")),
        mesh,
        chaser_radius=0.1,
        bounds=BOUNDS,
        force_limit=0.1,
        speed_limit=0.2,
        consistency=1e-3,
    )
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
