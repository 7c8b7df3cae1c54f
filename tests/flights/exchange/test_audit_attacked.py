"""Attacks on `keepout audit`: files by another writer, of flights whose contact is known in closed form.

The writer is text templates, and the truth the closed form of a box on fine points; neither shares code with the
reader or the audit. Whatever a file leaves out, cuts off or contradicts, a flight in contact is never called clear.
"""

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from truths.command_line import keepout_command
from truths.message_files import (
    CHASER,
    TARGET,
    base,
    instant,
    judged,
    meshed,
    message,
    ndm,
    orbits,
    resting,
    segment,
    turning,
    xml_of,
)

from keepout.core.errors import KeepoutError
from keepout.flights.exchange.audited import Given, audit_files
from keepout.flights.exchange.passage import SampleBounds, Samples, audit_passage


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    return meshed(tmp_path_factory.mktemp("box"), (2.0, 2.0, 2.0))


HALVES = np.array([8.0, 0.5, 0.5])
"""Of a beam: a wrong attitude carries its ends a long way."""


@pytest.fixture(scope="module")
def beam(tmp_path_factory):
    return meshed(tmp_path_factory.mktemp("beam"), 2.0 * HALVES)


def flown_past(seed):
    """A straight way past an end of a beam, and its centre's least distance from it, between samples too.

    In two of three encounters the beam does not turn, so that all samples are rounded alike; in one of three the chaser
    rests too.
    """
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, 12.0, 1.0)
    axis = generator.normal(size=3)
    rate, first = generator.uniform(0.0, 0.005) * (seed % 3 == 0), generator.uniform(0.0, 6.0)
    drift = generator.uniform(-0.02, 0.02, 3) * (seed % 3 != 1)
    around = generator.uniform(0.0, 2.0 * np.pi)
    beside = generator.uniform(1.5, 2.5) * np.array([0.0, np.cos(around), np.sin(around)])

    def turned(t):
        return Rotation.from_rotvec(np.multiply.outer(first + rate * t, axis / np.linalg.norm(axis)))

    along = generator.choice([-1.0, 1.0]) * generator.uniform(5.0, 8.0)
    start = turned(0.0).apply(beside + np.array([along, 0.0, 0.0]))
    fine = np.linspace(time[0], time[-1], 4000)
    # Rows are attitudes body → inertial, as in the standard; a point goes the other way.
    beyond = np.abs(turned(fine).inv().apply(start + np.outer(fine, drift))) - HALVES
    assert (beyond.max(axis=1) > 0.0).all()
    least = np.linalg.norm(np.maximum(beyond, 0.0), axis=1).min()
    return time, start + np.outer(time, drift), np.tile(drift, (len(time), 1)), turned(time).as_quat(), least


def encounter(folder, seed, digits, *, cut=False):
    """Files of an encounter, and how near the chaser's centre truly came."""
    time, relative, velocity, quaternions, least = flown_past(seed)
    files = orbits(folder, time, relative, velocity, digits=digits["orbits"], cut=cut)
    rows = segment("AEM", TARGET, time, quaternions, digits=digits["attitude"], cut=cut)
    return files | {"target_attitude": message(folder / "a.aem", "AEM", rows)}, least


@pytest.mark.long
@pytest.mark.parametrize("digits", [3, 4])
@pytest.mark.parametrize("coarse", ["attitude", "orbits"])
def test_few_digits_never_call_a_contact_clear(coarse, digits, beam, tmp_path):
    """24 encounters in contact by 3 mm and 0.5 mm, which decimals that are rounded or cut off hide."""
    verdicts = []
    depth, many = {3: 3e-3, 4: 5e-4}[digits], {"attitude": 12, "orbits": 12} | {coarse: digits}
    for seed in range(24):
        files, least = encounter(tmp_path, seed, many, cut=seed % 2 == 0)
        answer = judged(beam, files, radius=least + depth, turning_acceleration_bound=0.0, bound=0.0)
        assert answer["minimum_clearance_m"] <= -depth + 1e-6
        verdicts.append(answer["contact_verdict"])
    assert "no" not in verdicts
    assumed = answer["assumptions"]
    if coarse == "attitude":
        assert assumed["attitude_error_rad"] == pytest.approx(2 * np.arcsin(2 * 10.0**-digits))
        assert any("axes have few digits" in remark for remark in answer["remarks"])
    else:
        assert assumed["sample_error_m"] == pytest.approx(2 * np.sqrt(3) * 10.0 ** (3 - digits), rel=1e-6)
        assert any("positions have few digits" in remark for remark in answer["remarks"])


@pytest.mark.long
def test_many_digits_still_call_a_clear_flight_clear(beam, tmp_path):
    """The other side: the same encounters with 5 cm to spare and twelve decimals are decided."""
    for seed in range(8):
        files, least = encounter(tmp_path, seed, {"attitude": 12, "orbits": 12})
        options = {"turning_acceleration_bound": 0.0, "bound": 1e-9, "sample_error": 1e-4}
        answer = judged(beam, files, radius=least - 0.05, **options)
        assert answer["contact_verdict"] == "no", answer["remarks"]
        assert answer["minimum_clearance_m"] <= 0.05 <= answer["measured_clearance_m"] + 1e-3
        # What the user says of the errors holds where it is more than what the digits say.
        assert answer["assumptions"]["sample_error_m"] == 1e-4
        worse = judged(beam, files, radius=least - 0.05, attitude_error=0.02, **options)
        assert worse["assumptions"]["attitude_error_rad"] == 0.02
        assert worse["minimum_clearance_m"] <= answer["minimum_clearance_m"] - 0.08
        assert worse["contact_verdict"] != "no"


@pytest.mark.parametrize("seed", range(6))
def test_a_wrong_attitude_within_its_error_is_bounded(seed, beam):
    """Samples turned from the truth by the error, each about another axis: bound and find hold the true clearance."""
    time, relative, velocity, quaternions, least = flown_past(seed)
    generator = np.random.default_rng(seed)
    axes = generator.normal(size=(len(time), 3))
    error = 0.01
    wrong = Rotation.from_rotvec(error * axes / np.linalg.norm(axes, axis=1)[:, None])
    turn = (wrong * Rotation.from_quat(quaternions).inv()).as_matrix()
    bounds = SampleBounds(1e-9, 0.0, attitude_error=error)
    found = audit_passage(Samples(time, relative, velocity, turn), beam, chaser_radius=0.0, bounds=bounds)
    reach = error * np.linalg.norm(relative, axis=1).max()
    assert found.minimum_clearance <= least <= found.measured_clearance
    assert found.minimum_clearance >= least - 2.2 * reach - 2e-3 - found.uncertainty


def test_axes_of_the_orbit_are_no_better_than_the_states_they_come_from(box, tmp_path):
    fine = judged(box, resting(tmp_path), target_fixed_in="vvlh")["assumptions"]
    assert fine["attitude_error_rad"] < 1e-11
    coarse = judged(box, resting(tmp_path, digits=3), target_fixed_in="vvlh")["assumptions"]
    # Truth: the same axes of states that are wrong by the last digit.
    right, wrong = base([0.0])[0], base([0.0])[0] + 1.0
    planes = [np.cross(state[:3], state[3:]) for state in (right, wrong)]
    planes = [plane / np.linalg.norm(plane) for plane in planes]
    assert coarse["attitude_error_rad"] >= np.linalg.norm(planes[0] - planes[1])
    assert coarse["attitude_error_rad"] < 5e-4


# ---- segments, objects, frames: what contradicts itself is refused, and what is said of it is listed

FIRST, THEN, NEAR = (0.0, 1.0, 2.0), (2.0, 3.0, 4.0), (1.7, 0.0, 0.0)


def two_segments(folder, second=NEAR, *, first=NEAR, between=FIRST, after=THEN, jump=0.0, own_more="", more=""):
    """A chaser's OEM of two segments, at the places `first` and `second`."""
    one, other = base(between, beside=first), base(after, beside=second)
    other[:, 3] += jump
    parts = zip((between, after), (one, other), (own_more, more))
    segments = [segment("OEM", CHASER, time, rows / 1e3, more=extra) for time, rows, extra in parts]
    return resting(folder) | {"chaser": message(folder / "c.oem", "OEM", *segments)}


overlapping = partial(two_segments, between=(*FIRST, 3.0))


def jumping_attitude(folder):
    turned = [np.tile([0.0, 0.0, np.sin(angle), np.cos(angle)], (3, 1)) for angle in (0.0, 0.05)]
    both = [segment("AEM", TARGET, time, rows, digits=9) for time, rows in zip((FIRST, THEN), turned)]
    return resting(folder) | {"target_attitude": message(folder / "a.aem", "AEM", *both)}


def useable_from(**times):
    return "".join(f"\nUSEABLE_{which.upper()}_TIME = {instant(time)}" for which, time in times.items())


def useable(folder, start, stop):
    rows, more = base(np.arange(5.0), beside=(9.0, 0.0, 0.0)) / 1e3, useable_from(start=start, stop=stop)
    chaser = segment("OEM", CHASER, np.arange(5.0), rows, more=more)
    return resting(folder) | {"chaser": message(folder / "c.oem", "OEM", chaser)}


def all_in_one(folder):
    """Orbits of three objects and attitudes of two in one file."""
    time, third, turns = np.arange(5.0), ("DEBRIS", "1999-025ABC"), np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
    states = ((TARGET, base(time)), (CHASER, base(time, beside=(9.0, 0.0, 0.0))), (third, base(time + 100.0)))
    path = ndm(
        folder / "all.xml",
        *(xml_of("OEM", who, time, rows / 1e3) for who, rows in states),
        xml_of("AEM", CHASER, time, np.roll(turns, 1, axis=1)),
        xml_of("AEM", TARGET, time, turns),
    )
    return dict.fromkeys(("chaser", "target_orbit", "target_attitude"), path)


def swapped(folder, files=resting):
    given = files(folder)
    return given | {"chaser": given["target_orbit"], "target_orbit": given["chaser"]}


def twice(folder):
    return dict.fromkeys(("chaser", "target_orbit"), resting(folder)["chaser"])


two_epochs, other = partial(turning, time=np.arange(2.0)), partial(turning, who=("SAT", "12345"))


@pytest.mark.parametrize(
    ("made", "options", "said"),
    [
        # The second segment begins at the last epoch of the first, and is 0.2 m in contact there.
        (partial(two_segments, second=(1.3, 0.0, 0.0)), {}, r"7000001\.7.* and .*7000001\.3.* are 0\.4 m apart"),
        (partial(two_segments, jump=0.5), {}, r"velocities .* and .* are 0\.5 m/s apart"),
        (jumping_attitude, {}, r"quaternions .* are 0\.1 rad apart"),
        (partial(overlapping, after=(2.5, 3.5, 4.0)), {}, "two segments overlap"),
        (partial(overlapping, second=(1.9, 0.0, 0.0)), {}, r"are 0\.2 m apart"),
        (partial(useable, start=4, stop=3), {}, "USEABLE_START_TIME is after USEABLE_STOP_TIME"),
        (all_in_one, {}, r"several objects, SATELLITE \(2026-001A\), VISITOR \(2026-002A\), DEBRIS"),
        (all_in_one, {"chaser_object": "ROCKET", "target_object": "SATELLITE"}, r"is of .*, not of ROCKET"),
        (swapped, {"chaser_object": "VISITOR"}, r"t\.oem: is of SATELLITE \(2026-001A\), not of VISITOR"),
        # With an attitude of the target, the swap shows by itself.
        (partial(swapped, files=turning), {}, r"a\.aem: is of SATELLITE \(2026-001A\), not of VISITOR \(2026-002A\)"),
        (twice, {}, "chaser and target must be two objects"),
        (other, {}, r"a\.aem: is of SAT \(12345\), not of SATELLITE"),
        (other, {"attitude_object": "DEBRIS"}, "not of DEBRIS"),
        *(
            (partial(turning, frames=("EME2000", frame)), {}, rf"REF_FRAME_B is {frame}; it must be")
            for frame in ("INSTRUMENT_A", "STARTRACKER_1", "SENSOR_2", "ACTUATOR_3", "RTN", "GCRF")
        ),
        (partial(turning, frames=("GCRF", "SC_BODY_1")), {}, "one of them must be EME2000"),
        (partial(turning, more="\nCENTER_NAME = MARS"), {}, r"a\.aem: CENTER_NAME is MARS; it must be EARTH"),
        (two_epochs, {}, "--turning-acceleration-bound: not given, and 2 epochs"),
        (resting, {"attitude_object": "SAT"}, "--attitude-object SAT: only with --target-attitude"),
        *((resting, {"tolerance": value}, "tolerance is") for value in (float("nan"), -1.0, 0.0, float("inf"))),
        *(
            (resting, {option: value}, f"{option} is {value}")
            for option in ("sample_error", "attitude_error", "turning_acceleration_bound")
            for value in (float("nan"), -1.0, float("inf"))
        ),
    ],
)
def test_what_contradicts_itself_is_refused_in_a_line(made, options, said, box, tmp_path):
    with pytest.raises(KeepoutError, match=said) as refusal:
        judged(box, made(tmp_path), **options)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("made", "options", "found"),
    [
        (two_segments, {}, {"epochs": 5}),
        (overlapping, {}, {"epochs": 5}),
        # What only serves an interpolation is no truth: beyond the useable times it may be anything.
        (
            partial(overlapping, second=(1.701, 0.0, 0.0), own_more=useable_from(stop=2), more=useable_from(start=3)),
            {},
            {"epochs": 5, "rows_outside_useable_times": 2},
        ),
        (
            partial(useable, start=1, stop=3),
            {},
            {"start_epoch": f"{instant(1)}000", "stop_epoch": f"{instant(3)}000", "rows_outside_useable_times": 2},
        ),
        (
            all_in_one,
            {"chaser_object": "visitor", "target_object": "2026-001A"},
            {"chaser_object_id": "2026-002A", "target_object": "SATELLITE"},
        ),
        (
            partial(turning, frames=("EME2000", "RTN")),
            {"attitude_frame": "RTN"},
            {"overrides": ["--attitude-frame RTN: taken as the frame in which the mesh lies"]},
        ),
        (turning, {}, {"overrides": []}),
        # Where an identifier is not known, names decide.
        (partial(turning, who=("satellite", "UNKNOWN")), {}, {"overrides": []}),
        (partial(turning, frames=("SC_BODY_1", "J2000")), {}, {"overrides": []}),
        (two_epochs, {"turning_acceleration_bound": 1e-3}, {"epochs": 2}),
    ],
)
def test_what_agrees_is_read_and_judged(made, options, found, box, tmp_path):
    answer = judged(box, made(tmp_path), **options)
    assert {"contact_verdict": "no", **found}.items() <= answer.items()
    rows = answer["rows_outside_useable_times"]
    assert bool(rows) == any(f"{rows} rows outside its useable times are not judged" in of for of in answer["remarks"])


def test_who_says_that_samples_may_be_wrong_by_so_much_is_answered_but_never_with_no(box, tmp_path):
    files = two_segments(tmp_path, (1.3, 0.0, 0.0))
    assert judged(box, files, sample_error=0.5)["contact_verdict"] != "no"


def test_all_messages_of_an_object_are_read(box, tmp_path):
    """The second `<oem>` of the `<ndm>` takes the chaser 0.3 m into the box."""
    time, later = np.arange(5.0), np.arange(5.0, 9.0)
    both = np.concatenate([time, later])
    states, near = base(time, beside=(1.7, 0.0, 0.0)), base(later, beside=(1.2, 0.0, 0.0))
    one, other = xml_of("OEM", CHASER, time, states / 1e3), xml_of("OEM", CHASER, later, near / 1e3)
    files = {
        "target_orbit": ndm(tmp_path / "t.xml", xml_of("OEM", TARGET, both, base(both) / 1e3)),
        "chaser": ndm(tmp_path / "c.xml", one, other),
    }
    answer = judged(box, files, bound=1.0)
    assert (answer["epochs"], answer["contact_verdict"]) == (9, "yes")


def test_the_answer_names_who_is_who_and_what_it_depends_on(box, tmp_path):
    files = resting(tmp_path, comment="COMMENT Center of mass in body axes: 0.5 0 0 m\n")
    answer = judged(box, files)
    assert (answer["chaser_object"], answer["chaser_object_id"]) == CHASER
    assert (answer["target_object"], answer["target_object_id"]) == TARGET
    assert sum("was not given" in remark and "-object" in remark for remark in answer["remarks"]) == 2
    told = " ".join(answer["remarks"])
    assert "the centre of mass was not given" in told
    assert "t.oem says, unlike --centre-of-mass: Center of mass in body axes: 0.5 0 0 m" in told
    who = {"chaser_object": "VISITOR", "target_object": "2026-001A"}
    given = judged(box, files, centre_of_mass=(0.5, 0.0, 0.0), **who)
    assert given["remarks"] == []
    assert given["minimum_clearance_m"] > answer["minimum_clearance_m"] + 0.4
    assert "unlike --centre-of-mass" in " ".join(judged(box, files, centre_of_mass=(0.0, 0.1, 0.0))["remarks"])
    unsaid = audit_files(box, Given(**files, chaser_radius=0.5, acceleration_bound=0.01))["remarks"]
    assert any("axes are taken to be those of vvlh" in remark for remark in unsaid)


def test_a_spin_of_one_turn_a_sample_is_said(box, tmp_path):
    """From samples it is at rest; the answer says up to which rate that holds, and what was measured."""
    for bound, measured in ((None, 1), (0.0, 0)):
        answer = judged(box, turning(tmp_path), turning_acceleration_bound=bound)
        assert answer["assumptions"]["unambiguous_turning_rate_radps"] == pytest.approx(np.pi)
        assert any("taken to turn at less than 3.142 rad/s" in remark for remark in answer["remarks"])
        assert sum("turning acceleration was not given" in remark for remark in answer["remarks"]) == measured


def test_the_command_has_the_options(tmp_path):
    files = turning(tmp_path, who=("SAT", "5"), frames=("EME2000", "BUS"))
    given = [text for name, path in files.items() for text in (f"--{name.replace('_', '-')}", path)]
    answer = keepout_command(
        *("audit", "--target", "box", *given, "--chaser-radius", 0.5, "--acceleration-bound", 0.01),
        *("--chaser-object", "VISITOR", "--target-object", "SATELLITE", "--attitude-object", "SAT"),
        *("--attitude-frame", "BUS", "--sample-error", 0.01, "--attitude-error", 0.002, "--json"),
    ).json
    assert (answer["contact_verdict"], len(answer["overrides"])) == ("no", 2)
    assert answer["overrides"][0] == f"--attitude-object SAT: {tmp_path / 'a.aem'} is of SAT (5)"
    assert answer["assumptions"]["sample_error_m"] == 0.01
    assert answer["assumptions"]["attitude_error_rad"] == 0.002
