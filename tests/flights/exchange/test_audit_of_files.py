"""`keepout audit`: the clearance of flights told by files, against flights whose clearance is known otherwise."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from truths.audited import Mesh
from truths.command_line import keepout_command
from truths.message_files import judged, meshed, orbits, resting, turning
from truths.messages import GEOSTATIONARY, TUMBLING, toy_flight

from keepout.core.audit.audit import Contact, audit
from keepout.core.errors import ExchangeError
from keepout.core.geometry.target import Target
from keepout.core.mission.surroundings import Surroundings
from keepout.flights.exchange.audited import measured_turning_acceleration
from keepout.flights.exchange.passage import Chords, SampleBounds, Samples, angles, audit_passage

PLATE = (4.0, 4.0, 0.01)


def judged_past(folder, sides, time, relative, velocity, *, radius, **options):
    """Judge a flight past a box, by files."""
    files = orbits(folder, time, np.asarray(relative), np.asarray(velocity))
    return lambda bound, **more: judged(meshed(folder, sides), files, radius=radius, bound=bound, **options, **more)


@pytest.mark.long
@pytest.mark.parametrize(("tree", "every"), [(GEOSTATIONARY, 1), (TUMBLING, 5)], ids=["vvlh", "tumbling"])
def test_a_flight_of_keepout_is_bounded_as_by_its_own_audit(tree, every, tmp_path):
    """The gap: the tolerance of 1 mm, and how far the path can be from its chords."""
    scenario, record = toy_flight(tree, start=(0.0, 6.0, 4.0), goal=(3.0, -6.0, 2.0))
    flight = record.save(tmp_path / "flight.parquet")
    for craft in ("chaser", "target"):
        assert keepout_command("export", flight, "--to", "oem", "--of", craft, "-o", tmp_path / craft).code == 0
    assert keepout_command("export", flight, "--to", "aem", "-o", tmp_path / "turning").code == 0
    if every > 1:  # epochs that only two of the files have
        lines = (tmp_path / "turning").read_text().splitlines()
        start = lines.index("DATA_START") + 1
        (tmp_path / "turning").write_text("\n".join([*lines[:start], *lines[start:-1:every], lines[-1]]))
    bounds = Surroundings(scenario).flight_bounds
    acceleration = np.sqrt(3) * 0.1 / 20.0 + bounds.disturbance_force / 20.0 + 20.0 * bounds.gravity_gradient
    answer = keepout_command(
        *("audit", "--target", "box", "--chaser", tmp_path / "chaser", "--target-orbit", tmp_path / "target"),
        *("--target-attitude", tmp_path / "turning", "--chaser-radius", 0.5, "--acceleration-bound", acceleration),
        *("--centre-of-mass", *scenario.target.centre_of_mass, "--json"),
    ).json
    own = audit(record, Target.load("box"), chaser_radius=0.5, bounds=bounds, force_limit=0.1, speed_limit=10.0)
    assert own.contact is Contact.NO
    assert answer["epochs"] == 1 + 120 // every
    assert answer["epochs_left_out"] == 121 - answer["epochs"]
    assumed = answer["assumptions"]
    gap = 2e-3 + 2.0 * assumed["path_uncertainty_m"]
    assert gap < 0.005 * every**2
    assert answer["minimum_clearance_m"] <= own.measured_clearance
    assert answer["minimum_clearance_m"] >= own.minimum_clearance - gap
    assert answer["measured_clearance_m"] >= own.minimum_clearance
    assert answer["contact_verdict"] == "no"
    assert answer["contact"] is False
    assert 0.0 < assumed["least_acceleration_of_samples_mps2"] <= acceleration
    assert assumed["turning_acceleration_kind"] == "measured"
    assert json.dumps(answer, allow_nan=False)


def test_the_closed_form_of_a_straight_way_past_a_box(tmp_path):
    """Fixed in inertial axes, past a box of 2 m at 1.7 m: nearest between two samples, at 0.2 m from the ball."""
    time = np.arange(0.0, 61.0, 20.0)
    relative = np.stack([0.4 * time - 13.0, np.full(4, 0.3), np.full(4, 1.7)], axis=1)
    answer = judged_past(tmp_path, (2.0, 2.0, 2.0), time, relative, np.tile([0.4, 0.0, 0.0], (4, 1)), radius=0.5)
    exact = answer(0.0)
    assert exact["contact_verdict"] == "no"
    assert exact["minimum_clearance_m"] == pytest.approx(0.2, abs=1.1e-3)
    assert exact["measured_clearance_m"] == pytest.approx(0.2, abs=1e-5)
    assert 30.0 <= exact["minimum_time_s"] <= 35.0
    # With 1 mm/s² it can have swayed by 1e-3 · 20²/8 m = 5 cm; with 5 mm/s², by 0.25 m.
    loose = answer(1e-3)
    assert loose["assumptions"]["path_uncertainty_m"] == pytest.approx(0.05)
    assert loose["minimum_clearance_m"] == pytest.approx(0.15, abs=4e-3)
    open_ = answer(5e-3)
    assert open_["contact_verdict"] == "undecided"
    assert "too close to decide" in open_["remarks"][0]
    assert answer(0.0, sample_error=0.1)["minimum_clearance_m"] == pytest.approx(0.1, abs=1.1e-3)


def test_a_way_through_a_plate_between_samples_is_caught(tmp_path):
    relative = [[0.0, 0.0, 6.0], [0.0, 0.0, 2.0], [0.0, 0.0, -2.0]]
    time, velocity = np.array([0.0, 10.0, 20.0]), np.tile([0.0, 0.0, -0.4], (3, 1))
    answer = judged_past(tmp_path, PLATE, time, relative, velocity, radius=0.3)
    # With so much unknown that it may have gone round the middle of the plate, it is no "yes", but never a "no".
    assert answer(0.1)["contact_verdict"] == "undecided"
    sure = answer(0.01)
    assert (sure["contact_verdict"], sure["contact"]) == ("yes", True)
    assert sure["measured_clearance_m"] <= 0.0
    assert 10.0 < sure["minimum_time_s"] < 20.0


def test_a_dip_to_a_plate_between_samples_is_never_called_safe(tmp_path):
    """Clear at both samples, on the same side; in between 1 m/s² take it through the plate."""
    place, velocity = [[0.0, 0.0, 0.42]] * 2, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]
    answer = judged_past(tmp_path, PLATE, np.array([0.0, 2.0]), place, velocity, radius=0.3)
    assert answer(1.0)["contact_verdict"] == "undecided"
    # A bound that the files themselves deny is not believed.
    denied = answer(0.01)
    assert denied["minimum_clearance_m"] > 0.0
    assert denied["contact_verdict"] == "undecided"
    assert denied["assumptions"]["least_acceleration_of_samples_mps2"] == pytest.approx(1.0, rel=1e-4)
    assert "more than the acceleration bound, 0.01 m/s²" in denied["remarks"][0]


@pytest.mark.parametrize("seed", range(8))
def test_the_bound_is_never_above_the_truth(seed):
    """Smooth motions and turns with known bounds, a box in closed form, and 200 points between any two samples."""
    generator = np.random.default_rng(seed)
    step = generator.uniform(0.5, 4.0)
    samples = 12
    waves = generator.uniform(0.1, 0.6, 3)
    heights = generator.uniform(-0.5, 0.5, (3, 3))
    drift = generator.uniform(-0.05, 0.05, 3)
    place = generator.uniform(1.8, 2.5) * generator.choice([-1.0, 1.0], 3)
    axis = generator.normal(size=3)
    axis /= np.linalg.norm(axis)
    rate, swing, wave = generator.uniform(0.0, 0.1), generator.uniform(0.0, 0.1), generator.uniform(0.1, 0.5)

    def position(t):
        return place + np.multiply.outer(t, drift) + np.sin(np.multiply.outer(t, waves)) @ heights

    def velocity(t):
        return drift + (np.cos(np.multiply.outer(t, waves)) * waves) @ heights

    def turn(t):
        return Rotation.from_rotvec(np.multiply.outer(rate * t + swing * np.sin(wave * t), axis)).as_matrix()

    time = step * np.arange(samples)
    acceleration = float(np.sum(waves**2 * np.linalg.norm(heights, axis=1)))
    fine = np.linspace(0.0, time[-1], 200 * samples)
    mesh = Mesh(1.0)
    truth = mesh.distance_to(np.einsum("nij,nj->ni", turn(fine), position(fine))).min() - 0.1
    samples = Samples(time, position(time), velocity(time), turn(time))
    bounds = SampleBounds(acceleration, swing * wave**2)
    found = audit_passage(samples, mesh, chaser_radius=0.1, bounds=bounds)
    assert found.minimum_clearance <= truth + 1e-9
    assert found.minimum_clearance >= truth - 1.1e-3 - 2.0 * found.uncertainty
    assert found.measured_clearance >= truth - 1e-3
    assert found.least_acceleration <= acceleration
    fastest = rate + swing * wave
    assert rate + swing * wave * np.abs(np.cos(wave * fine)).max() <= fastest + 1e-12
    assert found.turning_rate >= np.abs(rate + swing * wave * np.cos(wave * fine)).max() - 1e-9


def test_turns_are_measured_to_rounding():
    time = np.arange(0.0, 20.0, 2.0)
    small = Rotation.from_rotvec(np.outer(1e-9 * time, [0.0, 0.6, 0.8])).as_matrix()
    assert angles(small) == pytest.approx(np.full(9, 2e-9), rel=1e-6)
    spun_up = Rotation.from_rotvec(np.outer(0.5 * 1e-3 * time**2, [0.0, 0.6, 0.8])).as_matrix()
    assert measured_turning_acceleration(time, spun_up) == pytest.approx(2e-3, rel=1e-6)


def test_a_target_that_turns_too_far_between_epochs_is_not_decided():
    time = np.arange(0.0, 50.0, 10.0)
    turn = Rotation.from_rotvec(np.outer(0.2 * time, [0.0, 0.0, 1.0])).as_matrix()
    place = np.tile([9.0, 0.0, 0.0], (5, 1))
    samples = Samples(time, place, np.zeros((5, 3)), turn)
    found = audit_passage(samples, Mesh(1.0), chaser_radius=0.1, bounds=SampleBounds(0.0, 0.0))
    assert found.contact is Contact.UNDECIDED
    assert "the target turns by 114.6 degrees" in found.remarks[0]


@pytest.mark.parametrize(
    ("names", "old", "new", "said"),
    [
        ("t", "CENTER_NAME = EARTH", "CENTER_NAME = MARS", "t.oem: CENTER_NAME is MARS; it must be EARTH, as in"),
        ("t", "REF_FRAME = EME2000", "REF_FRAME = GCRF", "t.oem: REF_FRAME is GCRF; it must be EME2000, as in"),
        ("ct", "REF_FRAME = EME2000", "REF_FRAME = ITRF2014", "REF_FRAME is ITRF2014; valid: EME2000"),
        ("t", "TIME_SYSTEM = UTC", "TIME_SYSTEM = TAI", "t.oem: TIME_SYSTEM is TAI; it must be UTC, as in"),
        ("a", "TIME_SYSTEM = UTC", "TIME_SYSTEM = TAI", "TIME_SYSTEM is TAI"),
        ("t", "2026-05-28T", "2026-05-29T", "0 epochs are common to all files"),
        ("t", "CCSDS_OEM_VERS", "CCSDS_AEM_VERS", "t.oem: line 1"),
    ],
)
def test_files_that_do_not_fit_are_refused(names, old, new, said, tmp_path):
    files = turning(tmp_path) if names == "a" else resting(tmp_path)
    for path in files.values():
        if path.stem in names:
            assert old in path.read_text()
            path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ExchangeError) as refusal:
        judged(Target.load("box"), files)
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_chord_to_far_away_is_as_wrong_as_its_far_end_makes_it():
    """A straight flight away from a target that turns: the turned chord misses it by nearly half of what is stated."""
    time, rate = np.array([0.0, 60.0]), 0.01

    def turned(angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    relative, turns = np.array([[1.0, 0.0, 0.0], [30.0, 0.0, 0.0]]), np.stack([turned(rate * t) for t in time])
    samples = Samples(time, relative, np.zeros((2, 3)), turns)
    chords = Chords.of(samples, SampleBounds(0.0, 0.0, sample_error=0.0), np.array([rate]), np.zeros(3))
    parts = np.linspace(0.0, 1.0, 41)
    none = np.zeros(41, int)
    point, error, _ = chords.piece(none, none, parts, parts)
    way = [turned(rate * 60.0 * p) @ ((1.0 - p) * relative[0] + p * relative[1]) for p in parts]
    away = np.linalg.norm(point - way, axis=1)
    assert (away <= error + 1e-12).all()
    assert away.max() > 0.4 * error.max()
