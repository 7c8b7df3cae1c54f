"""Attacks on `keepout audit`: files by another writer, of flights whose contact is known in closed form.

The writer is text templates, and the truth the closed form of a box on fine points; neither shares code with the
reader or the audit. Whatever a file leaves out, cuts off or contradicts, a flight in contact is never called clear.
"""

import datetime

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from truths.command_line import keepout_command

from keepout.audit.passage import audit_passage
from keepout.errors import ExchangeError, FlightError, KeepoutError
from keepout.exchange.audited import audit_files
from keepout.exchange.orbit_message import Orbit, read_oem, write_oem
from keepout.geometry.target import Target

START = datetime.datetime(2026, 5, 28, 12, 0, 0)
TARGET, CHASER = ("SATELLITE", "2026-001A"), ("VISITOR", "2026-002A")


def instant(second):
    return (START + datetime.timedelta(seconds=float(second))).isoformat(timespec="milliseconds")


def printed(number, digits, *, cut):
    """A number with so many decimals: rounded, or cut off."""
    return f"{number:.{digits + 4}f}"[:-4] if cut else f"{number:.{digits}f}"


def segment(kind, who, time, rows, *, digits, cut=False, more="", frames=("EME2000", "SC_BODY_1"), centre="EARTH"):
    """One segment of metadata and rows, numbers with so many decimals (in km where they are of an orbit)."""
    name, identifier = who
    where = (
        f"CENTER_NAME = {centre}\nREF_FRAME = {frames[0]}"
        if kind == "OEM"
        else f"REF_FRAME_A = {frames[0]}\nREF_FRAME_B = {frames[1]}\nATTITUDE_TYPE = QUATERNION"
    )
    lines = [
        f"{instant(t)} " + " ".join(printed(number, digits, cut=cut) for number in row) for t, row in zip(time, rows)
    ]
    data = lines if kind == "OEM" else ["DATA_START", *lines, "DATA_STOP"]
    return "\n".join(
        [
            *("META_START", f"OBJECT_NAME = {name}", f"OBJECT_ID = {identifier}", where, "TIME_SYSTEM = UTC"),
            *(f"START_TIME = {instant(time[0])}", f"STOP_TIME = {instant(time[-1])}{more}", "META_STOP"),
            *data,
        ]
    )


def message(path, kind, *segments, comment=""):
    version = {"OEM": "2.0", "AEM": "2.0"}[kind]
    head = f"CCSDS_{kind}_VERS = {version}\n{comment}CREATION_DATE = 2026-01-01T00:00:00\nORIGINATOR = TEST\n"
    path.write_text(head + "\n".join(segments) + "\n")
    return path


def xml_of(kind, who, time, rows, *, digits=12):
    """An `<oem>` or `<aem>` of one segment."""
    name, identifier = who
    keys = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT") if kind == "OEM" else ("Q1", "Q2", "Q3", "QC")

    def state(t, row):
        numbers = "".join(f"<{key}>{number:.{digits}f}</{key}>" for key, number in zip(keys, row))
        if kind == "OEM":
            return f"<stateVector><EPOCH>{instant(t)}</EPOCH>{numbers}</stateVector>"
        quaternion = f"<EPOCH>{instant(t)}</EPOCH><quaternion>{numbers}</quaternion>"
        return f"<attitudeState><quaternionEphemeris>{quaternion}</quaternionEphemeris></attitudeState>"

    where = (
        "<CENTER_NAME>EARTH</CENTER_NAME><REF_FRAME>EME2000</REF_FRAME>"
        if kind == "OEM"
        else "<REF_FRAME_A>EME2000</REF_FRAME_A><REF_FRAME_B>SC_BODY_1</REF_FRAME_B>"
        "<ATTITUDE_TYPE>QUATERNION</ATTITUDE_TYPE>"
    )
    return (
        f'<{kind.lower()} id="CCSDS_{kind}_VERS" version="2.0"><body><segment><metadata>'
        f"<OBJECT_NAME>{name}</OBJECT_NAME><OBJECT_ID>{identifier}</OBJECT_ID>{where}<TIME_SYSTEM>UTC</TIME_SYSTEM>"
        f"<START_TIME>{instant(time[0])}</START_TIME><STOP_TIME>{instant(time[-1])}</STOP_TIME></metadata><data>"
        + "".join(state(t, row) for t, row in zip(time, rows))
        + f"</data></segment></body></{kind.lower()}>"
    )


def ndm(path, *messages):
    path.write_text(f'<?xml version="1.0"?>\n<ndm>{"".join(messages)}</ndm>')
    return path


def base(time):
    """Where the target is: along a straight line, m and m/s."""
    time = np.asarray(time, float)
    line = np.stack([7e6 + 0.0 * time, 7500.0 * time, 0.0 * time], axis=1)
    return np.concatenate([line, np.tile([0.0, 7500.0, 0.0], (len(time), 1))], axis=1)


def orbits(folder, time, relative, velocity, *, digits=12, comment="", cut=False):
    rows = base(time)
    chaser = rows + np.concatenate([relative, velocity], axis=1)
    return {
        "target_orbit": message(
            folder / "t.oem", "OEM", segment("OEM", TARGET, time, rows / 1e3, digits=digits, cut=cut), comment=comment
        ),
        "chaser": message(folder / "c.oem", "OEM", segment("OEM", CHASER, time, chaser / 1e3, digits=digits, cut=cut)),
    }


def resting(folder, place=(9.0, 0.0, 0.0), **options):
    time = np.arange(5.0)
    return orbits(folder, time, np.tile(place, (5, 1)), np.zeros((5, 3)), **options)


def attitude(folder, *, who=TARGET, digits=12, quaternion=(0.0, 0.0, 0.0, 1.0), time=(0.0, 1.0, 2.0, 3.0, 4.0), **more):
    rows = np.tile(quaternion, (len(time), 1))
    return message(folder / "a.aem", "AEM", segment("AEM", who, time, rows, digits=digits, **more))


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    path = tmp_path_factory.mktemp("box") / "box.stl"
    trimesh.creation.box((2.0, 2.0, 2.0)).export(path)
    return Target.load(path, units="m")


def judged(box, files, *, radius=0.5, bound=0.01, **options):
    if "target_attitude" not in options and "target_attitude" not in files:
        options.setdefault("fixed_in", "inertial")
    return audit_files(box, **files, chaser_radius=radius, acceleration_bound=bound, **options)


HALVES = np.array([8.0, 0.5, 0.5])
"""Of a beam: a wrong attitude carries its ends a long way."""


@pytest.fixture(scope="module")
def beam(tmp_path_factory):
    path = tmp_path_factory.mktemp("beam") / "beam.stl"
    trimesh.creation.box(2.0 * HALVES).export(path)
    return Target.load(path, units="m")


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


@pytest.mark.long
@pytest.mark.parametrize("digits", [3, 4])
@pytest.mark.parametrize("coarse", ["attitude", "orbits"])
def test_few_digits_never_call_a_contact_clear(coarse, digits, beam, tmp_path):
    """60 encounters in contact by 3 mm and 0.5 mm, which decimals that are rounded or cut off hide."""
    verdicts = []
    depth = {3: 3e-3, 4: 5e-4}[digits]
    for seed in range(60):
        time, relative, velocity, quaternions, least = flown_past(seed)
        files = orbits(
            tmp_path, time, relative, velocity, digits=digits if coarse == "orbits" else 12, cut=seed % 2 == 0
        )
        rows = segment(
            "AEM", TARGET, time, quaternions, digits=digits if coarse == "attitude" else 12, cut=seed % 2 == 0
        )
        files["target_attitude"] = message(tmp_path / "a.aem", "AEM", rows)
        answer = judged(beam, files, radius=least + depth, turning_acceleration_bound=0.0, bound=0.0)
        assert answer["minimum_clearance_bound_m"] <= -depth + 1e-6
        verdicts.append(answer["contact_verdict"])
    assert "no" not in verdicts
    assumed = answer["assumptions"]
    if coarse == "attitude":
        assert assumed["attitude_error_rad"] == pytest.approx(2 * np.arcsin(2 * 10.0**-digits))
        assert any("axes have few digits" in remark for remark in answer["remarks"])
    else:
        assert assumed["sample_error_m"] == pytest.approx(2 * np.sqrt(3) * 10.0 ** (3 - digits), rel=1e-6)
        assert any("positions have few digits" in remark for remark in answer["remarks"])


def test_many_digits_still_call_a_clear_flight_clear(beam, tmp_path):
    """The other side: the same encounters with 5 cm to spare and twelve decimals are decided."""
    for seed in range(8):
        time, relative, velocity, quaternions, least = flown_past(seed)
        files = orbits(tmp_path, time, relative, velocity)
        rows = segment("AEM", TARGET, time, quaternions, digits=12)
        files["target_attitude"] = message(tmp_path / "a.aem", "AEM", rows)
        options = {"turning_acceleration_bound": 0.0, "bound": 1e-9, "sample_error": 1e-4}
        answer = judged(beam, files, radius=least - 0.05, **options)
        assert answer["contact_verdict"] == "no", answer["remarks"]
        assert answer["minimum_clearance_bound_m"] <= 0.05 <= answer["minimum_clearance_m"] + 1e-3
        # What the user says of the errors holds where it is more than what the digits say.
        assert answer["assumptions"]["sample_error_m"] == 1e-4
        worse = judged(beam, files, radius=least - 0.05, attitude_error=0.02, **options)
        assert worse["assumptions"]["attitude_error_rad"] == 0.02
        assert worse["minimum_clearance_bound_m"] <= answer["minimum_clearance_bound_m"] - 0.08
        assert worse["contact_verdict"] != "no"


@pytest.mark.parametrize("seed", range(6))
def test_a_wrong_attitude_within_its_error_is_bounded(seed, beam):
    """Samples turned from the truth by the error, each about another axis: bound and find hold the true clearance."""
    time, relative, velocity, quaternions, least = flown_past(seed)
    generator = np.random.default_rng(seed)
    axes = generator.normal(size=(len(time), 3))
    error = 0.01
    wrong = Rotation.from_rotvec(error * axes / np.linalg.norm(axes, axis=1)[:, None])
    found = audit_passage(
        *(time, relative, velocity, (wrong * Rotation.from_quat(quaternions).inv()).as_matrix(), beam),
        chaser_radius=0.0,
        acceleration_bound=1e-9,
        turning_acceleration_bound=0.0,
        attitude_error=error,
    )
    reach = error * np.linalg.norm(relative, axis=1).max()
    assert found.minimum_clearance_bound <= least <= found.minimum_clearance
    assert found.minimum_clearance_bound >= least - 2.2 * reach - 2e-3 - found.uncertainty


def test_axes_of_the_orbit_are_no_better_than_the_states_they_come_from(box, tmp_path):
    fine = judged(box, resting(tmp_path), fixed_in="vvlh")["assumptions"]
    assert fine["attitude_error_rad"] < 1e-11
    coarse = judged(box, resting(tmp_path, digits=3), fixed_in="vvlh")["assumptions"]
    # Truth: the same axes of states that are wrong by the last digit.
    right, wrong = base([0.0])[0], base([0.0])[0] + 1.0
    planes = [np.cross(state[:3], state[3:]) for state in (right, wrong)]
    planes = [plane / np.linalg.norm(plane) for plane in planes]
    assert coarse["attitude_error_rad"] >= np.linalg.norm(planes[0] - planes[1])
    assert coarse["attitude_error_rad"] < 5e-4


# ---- segments


def two_segments(folder, first, second, *, between=(0.0, 1.0, 2.0), after=(2.0, 3.0, 4.0), more="", own_more=""):
    """A chaser's OEM of two segments, at the places `first` and `second`."""
    files = resting(folder)
    rows = []
    for time, place in ((between, first), (after, second)):
        states = base(time)
        states[:, :3] += place
        rows.append(states / 1e3)
    message(
        folder / "c.oem",
        "OEM",
        segment("OEM", CHASER, between, rows[0], digits=12, more=own_more),
        segment("OEM", CHASER, after, rows[1], digits=12, more=more),
    )
    return files


def test_segments_that_meet_with_other_states_are_refused_with_both(box, tmp_path):
    """The second segment begins at the last epoch of the first, and is 0.2 m in contact there."""
    files = two_segments(tmp_path, (1.7, 0.0, 0.0), (1.3, 0.0, 0.0))
    with pytest.raises(ExchangeError, match=r"7000001\.7.* and .*7000001\.3.* are 0\.4 m apart; at most"):
        judged(box, files)
    # A user who says that samples may be wrong by so much is answered, never with "no".
    answer = judged(box, files, sample_error=0.5)
    assert answer["contact_verdict"] != "no"
    same = judged(box, two_segments(tmp_path, (1.7, 0.0, 0.0), (1.7, 0.0, 0.0)))
    assert (same["contact_verdict"], same["epochs"]) == ("no", 5)


def test_velocities_and_attitudes_that_jump_at_an_epoch_are_refused(box, tmp_path):
    files = resting(tmp_path)
    times = ((0.0, 1.0, 2.0), (2.0, 3.0, 4.0))
    states = [base(time) for time in times]
    for rows in states:
        rows[:, 0] += 9.0
    states[1][:, 3] += 0.5
    both = [segment("OEM", CHASER, time, rows / 1e3, digits=9) for time, rows in zip(times, states)]
    message(tmp_path / "c.oem", "OEM", *both)
    with pytest.raises(ExchangeError, match=r"velocities .* and .* are 0\.5 m/s apart"):
        judged(box, files)
    turned = [np.tile([0.0, 0.0, np.sin(angle), np.cos(angle)], (3, 1)) for angle in (0.0, 0.05)]
    both = [segment("AEM", TARGET, time, rows, digits=9) for time, rows in zip(times, turned)]
    with pytest.raises(ExchangeError, match=r"quaternions .* are 0\.1 rad apart"):
        judged(box, resting(tmp_path) | {"target_attitude": message(tmp_path / "a.aem", "AEM", *both)})


def test_segments_that_overlap_are_read_where_they_agree(box, tmp_path):
    def overlapping(after, place=(9.0, 0.0, 0.0), **more):
        times = {"between": (0.0, 1.0, 2.0, 3.0), "after": after}
        return two_segments(tmp_path, (9.0, 0.0, 0.0), place, **times, **more)

    assert judged(box, overlapping((2.0, 3.0, 4.0)))["epochs"] == 5
    with pytest.raises(ExchangeError, match="two segments overlap"):
        judged(box, overlapping((2.5, 3.5, 4.0)))
    with pytest.raises(ExchangeError, match=r"are 0\.2 m apart"):
        judged(box, overlapping((2.0, 3.0, 4.0), (9.2, 0.0, 0.0)))
    # What only serves an interpolation is no truth: beyond the useable times it may be anything.
    end, begin = (f"\nUSEABLE_{which}_TIME = {instant(2.0 + (which == 'START'))}" for which in ("STOP", "START"))
    answer = judged(box, overlapping((2.0, 3.0, 4.0), (9.001, 0.0, 0.0), own_more=end, more=begin))
    assert (answer["epochs"], answer["rows_outside_useable_times"]) == (5, 2)
    assert any("2 rows outside its useable times are not judged" in remark for remark in answer["remarks"])


def test_rows_beyond_the_useable_times_are_no_truth(box, tmp_path):
    files = resting(tmp_path)
    useable = f"\nUSEABLE_START_TIME = {instant(1)}\nUSEABLE_STOP_TIME = {instant(3)}"
    rows = base(np.arange(5.0))
    rows[:, 0] += 9.0
    message(tmp_path / "c.oem", "OEM", segment("OEM", CHASER, np.arange(5.0), rows / 1e3, digits=12, more=useable))
    answer = judged(box, files)
    assert (answer["start_epoch"], answer["stop_epoch"]) == tuple(instant(t) + "000" for t in (1, 3))
    assert answer["rows_outside_useable_times"] == 2
    message(
        tmp_path / "c.oem",
        "OEM",
        segment("OEM", CHASER, np.arange(5.0), rows / 1e3, digits=12, more=useable.replace(instant(1), instant(4))),
    )
    with pytest.raises(ExchangeError, match="USEABLE_START_TIME is after USEABLE_STOP_TIME"):
        judged(box, files)


# ---- several messages in one file


def test_all_messages_of_an_object_are_read(box, tmp_path):
    """The second `<oem>` of the `<ndm>` takes the chaser 0.3 m into the box."""
    time, later = np.arange(5.0), np.arange(5.0, 9.0)
    states, near = base(time), base(later)
    states[:, 0] += 1.7
    near[:, 0] += 1.2
    target = np.concatenate([time, later])
    files = {
        "target_orbit": ndm(tmp_path / "t.xml", xml_of("OEM", TARGET, target, base(target) / 1e3)),
        "chaser": ndm(
            tmp_path / "c.xml", xml_of("OEM", CHASER, time, states / 1e3), xml_of("OEM", CHASER, later, near / 1e3)
        ),
    }
    answer = judged(box, files, bound=1.0)
    assert answer["epochs"] == 9
    assert answer["contact_verdict"] == "yes"


def test_one_file_of_several_objects_is_read_by_object_or_refused(box, tmp_path):
    time = np.arange(5.0)
    states = base(time)
    states[:, 0] += 9.0
    third = ("DEBRIS", "1999-025ABC")
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
    path = ndm(
        tmp_path / "all.xml",
        xml_of("OEM", TARGET, time, base(time) / 1e3),
        xml_of("OEM", CHASER, time, states / 1e3),
        xml_of("OEM", third, time, base(time + 100.0) / 1e3),
        xml_of("AEM", CHASER, time, np.roll(quaternions, 1, axis=1)),
        xml_of("AEM", TARGET, time, quaternions),
    )
    files = {"chaser": path, "target_orbit": path, "target_attitude": path}
    with pytest.raises(ExchangeError, match=r"several objects, SATELLITE \(2026-001A\), VISITOR \(2026-002A\), DEBRIS"):
        judged(box, files)
    answer = judged(box, files, chaser_object="visitor", target_object="2026-001A")
    assert answer["contact_verdict"] == "no"
    assert answer["minimum_position_m"][0] == pytest.approx(9.0, abs=1e-5)
    assert (answer["chaser_object_id"], answer["target_object"]) == ("2026-002A", "SATELLITE")
    with pytest.raises(ExchangeError, match=r"is of .*, not of ROCKET"):
        judged(box, files, chaser_object="ROCKET", target_object="SATELLITE")


# ---- who is who


def test_the_answer_names_who_is_who_and_options_check_it(box, tmp_path):
    files = resting(tmp_path)
    answer = judged(box, files)
    assert (answer["chaser_object"], answer["chaser_object_id"]) == CHASER
    assert (answer["target_object"], answer["target_object_id"]) == TARGET
    assert sum("was not given" in remark and "-object" in remark for remark in answer["remarks"]) == 2
    checked = judged(box, files, chaser_object="VISITOR", target_object="2026-001A")
    assert not any("-object" in remark for remark in checked["remarks"])
    swapped = {"chaser": files["target_orbit"], "target_orbit": files["chaser"]}
    with pytest.raises(ExchangeError, match=r"t\.oem: is of SATELLITE \(2026-001A\), not of VISITOR"):
        judged(box, swapped, chaser_object="VISITOR")
    # With an attitude of the target, the swap shows by itself.
    with pytest.raises(ExchangeError, match=r"a\.aem: is of SATELLITE \(2026-001A\), not of VISITOR \(2026-002A\)"):
        judged(box, swapped | {"target_attitude": attitude(tmp_path)})
    with pytest.raises(ExchangeError, match="chaser and target must be two objects"):
        judged(box, {"chaser": files["chaser"], "target_orbit": files["chaser"]})


def test_an_attitude_of_another_object_is_refused_or_listed(box, tmp_path):
    files = resting(tmp_path) | {"target_attitude": attitude(tmp_path, who=("SAT", "12345"))}
    with pytest.raises(ExchangeError, match=r"a\.aem: is of SAT \(12345\), not of SATELLITE"):
        judged(box, files)
    with pytest.raises(ExchangeError, match="not of DEBRIS"):
        judged(box, files, attitude_object="DEBRIS")
    answer = judged(box, files, attitude_object="12345")
    assert answer["overrides"] == [f"--attitude-object 12345: {tmp_path / 'a.aem'} is of SAT (12345)"]
    assert judged(box, resting(tmp_path) | {"target_attitude": attitude(tmp_path)})["overrides"] == []
    # Where an identifier is not known, names decide.
    known = attitude(tmp_path, who=("satellite", "UNKNOWN"))
    assert judged(box, resting(tmp_path) | {"target_attitude": known})["contact_verdict"] == "no"


@pytest.mark.parametrize("frame", ["INSTRUMENT_A", "STARTRACKER_1", "SENSOR_2", "ACTUATOR_3", "RTN"])
def test_the_frame_of_an_instrument_is_not_the_bodys(frame, box, tmp_path):
    turning = attitude(tmp_path, frames=("EME2000", frame))
    files = resting(tmp_path) | {"target_attitude": turning}
    with pytest.raises(ExchangeError, match=rf"REF_FRAME_B is {frame}; it must be the frame in which the mesh lies"):
        judged(box, files)
    answer = judged(box, files, attitude_frame=frame)
    assert answer["overrides"] == [f"--attitude-frame {frame}: taken as the frame in which the mesh lies"]


def test_an_attitude_about_another_centre_is_refused(box, tmp_path):
    turning = attitude(tmp_path, more="\nCENTER_NAME = MARS")
    with pytest.raises(ExchangeError, match=r"a\.aem: CENTER_NAME is MARS; it must be EARTH"):
        judged(box, resting(tmp_path) | {"target_attitude": turning})


# ---- what was not told


def test_remarks_tell_what_the_answer_depends_on(box, tmp_path):
    comment = "COMMENT Center of mass in body axes: 0.5 0 0 m\n"
    files = resting(tmp_path, comment=comment)
    told = " ".join(judged(box, files)["remarks"])
    assert "the centre of mass was not given" in told
    assert "t.oem says, unlike --centre-of-mass: Center of mass in body axes: 0.5 0 0 m" in told
    given = judged(box, files, centre_of_mass=(0.5, 0.0, 0.0))
    assert "centre of mass" not in " ".join(given["remarks"]).lower()
    assert given["minimum_clearance_bound_m"] > judged(box, files)["minimum_clearance_bound_m"] + 0.4
    other = " ".join(judged(box, files, centre_of_mass=(0.0, 0.1, 0.0))["remarks"])
    assert "unlike --centre-of-mass" in other
    unsaid = audit_files(box, **files, chaser_radius=0.5, acceleration_bound=0.01)["remarks"]
    assert any("axes are taken to be those of vvlh" in remark for remark in unsaid)


def test_a_spin_of_one_turn_a_sample_is_said(box, tmp_path):
    """From samples it is at rest; the answer says up to which rate that holds."""
    answer = judged(box, resting(tmp_path) | {"target_attitude": attitude(tmp_path)})
    assert answer["assumptions"]["unambiguous_turning_rate_radps"] == pytest.approx(np.pi)
    assert any("taken to turn at less than 3.142 rad/s" in remark for remark in answer["remarks"])
    stated = judged(box, resting(tmp_path) | {"target_attitude": attitude(tmp_path)}, turning_acceleration_bound=0.0)
    assert sum("turning acceleration was not given" in remark for remark in answer["remarks"]) == 1
    assert not any("turning acceleration was not given" in remark for remark in stated["remarks"])


def test_two_epochs_do_not_show_a_turning_acceleration(box, tmp_path):
    time = np.arange(2.0)
    files = orbits(tmp_path, time, np.tile([9.0, 0.0, 0.0], (2, 1)), np.zeros((2, 3)))
    files["target_attitude"] = attitude(tmp_path, time=time)
    with pytest.raises(ExchangeError, match="--turning-acceleration-bound: not given, and 2 epochs"):
        judged(box, files)
    assert judged(box, files, turning_acceleration_bound=1e-3)["contact_verdict"] == "no"


# ---- numbers and lines


@pytest.mark.parametrize("tolerance", [float("nan"), -1.0, 0.0, float("inf")])
def test_a_tolerance_that_is_none_is_refused(tolerance, box, tmp_path):
    with pytest.raises(FlightError, match="tolerance is"):
        judged(box, resting(tmp_path), tolerance=tolerance)


@pytest.mark.parametrize("option", ["sample_error", "attitude_error", "turning_acceleration_bound"])
@pytest.mark.parametrize("value", [float("nan"), -1.0, float("inf")])
def test_an_error_that_is_none_is_refused(option, value, box, tmp_path):
    with pytest.raises(KeepoutError, match=f"{option} is {value}"):
        judged(box, resting(tmp_path), **{option: value})


@pytest.mark.parametrize("number", ["1_000.5", "\u0661\u0660", "1e5_0", "0x10", "1,5", "infinity", "1.5D0", "1.5e3.0"])
@pytest.mark.parametrize("form", ["kvn", "xml"])
def test_what_looks_like_a_number_is_none(number, form, box, tmp_path):
    rows = base(np.arange(5.0)) / 1e3
    if form == "xml":
        path = ndm(tmp_path / "c.xml", xml_of("OEM", CHASER, np.arange(5.0), rows))
    else:
        path = resting(tmp_path)["chaser"]
    text = path.read_text()
    first = "<Z>0.000000000000</Z>" if form == "xml" else " 0.000000000000 "
    path.write_text(text.replace(first, first.replace("0.000000000000", number), 1))
    with pytest.raises(ExchangeError, match=r"it must be a finite number|only ASCII") as refusal:
        read_oem(path)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("inside", ["<!DOCTYPE oem [<!ENTITY e '3'>]>", "<X>7<b/>000</X>", "<X>7000.0</X><X>1.0</X>"])
def test_xml_that_reads_as_less_than_it_says_is_refused(inside, tmp_path):
    rows = base(np.arange(5.0)) / 1e3
    text = xml_of("OEM", CHASER, np.arange(5.0), rows)
    if inside.startswith("<!DOCTYPE"):
        text = inside + text.replace("<X>7000.0", "<X>7000.&e;", 1)
    else:
        text = text.replace("<X>7000.000000000000</X>", inside, 1)
    (tmp_path / "c.xml").write_text(text)
    with pytest.raises(ExchangeError, match=r"holds more than text|has 2 X"):
        read_oem(tmp_path / "c.xml")


def orbit(path, name, identifier=""):
    rows = base([0.0, 1.0])
    return Orbit(
        path, name, "EARTH", "EME2000", "UTC", np.array([0, 10**9]), rows[:, :3], rows[:, 3:], identifier=identifier
    )


@pytest.mark.parametrize("name", ["N" * 300, "a\nCENTER_NAME = MARS", "Büro", "", " x"])
def test_a_name_that_is_no_line_is_refused(name, tmp_path):
    for xml in (False, True):
        with pytest.raises(ExchangeError, match="OBJECT_NAME would be") as refusal:
            write_oem(orbit(tmp_path / "o", name), comments=[], xml=xml)
        assert "\n" not in str(refusal.value)
    assert not (tmp_path / "o").exists()


def test_lines_are_no_longer_than_the_standard_allows(tmp_path):
    """However long a scenario's name is, and whatever letters it has: comments go on in the next line."""
    comments = ["Scenario " + "long name " * 60 + "äöü\nCENTER_NAME = MARS", "x" * 700]
    write_oem(orbit(tmp_path / "o", "A", "2026-003C"), comments=comments, xml=False)
    lines = (tmp_path / "o").read_text().splitlines()
    assert max(map(len, lines)) <= 254
    assert "".join(lines).isascii()
    assert read_oem(tmp_path / "o").centre == "EARTH"
    assert read_oem(tmp_path / "o").identifier == "2026-003C"
    assert sum("x" in line and line.startswith("COMMENT x") for line in lines) == 3


# ---- how text is written


@pytest.mark.parametrize("newline", ["\r\n", "\r", "\n\n"])
def test_other_line_ends_and_a_byte_order_mark_change_nothing(newline, tmp_path):
    path = resting(tmp_path)["chaser"]
    plain = read_oem(path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_text().replace("\n", newline).encode())
    assert np.array_equal(read_oem(path).position, plain.position)


def test_what_ends_a_line_elsewhere_does_not_end_a_comment(tmp_path):
    """U+2028 and its like end a line for Python's `splitlines`, not for the standard: nothing after one is a row."""
    path = resting(tmp_path)["chaser"]
    for mark in ("\u2028", "\u0085", "\x0c", "\x1c"):
        text = path.read_text().replace("META_STOP\n", f"META_STOP\nCOMMENT a{mark}{instant(0)} 1 2 3 4 5 6\n")
        path.write_text(text)
        assert len(read_oem(path).epochs) == 5


def test_the_command_has_the_options(tmp_path):
    files = resting(tmp_path) | {"target_attitude": attitude(tmp_path, who=("SAT", "5"), frames=("EME2000", "BUS"))}
    given = [text for name, path in files.items() for text in (f"--{name.replace('_', '-')}", path)]
    answer = keepout_command(
        *("audit", "--target", "box", *given, "--chaser-radius", 0.5, "--acceleration-bound", 0.01),
        *("--chaser-object", "VISITOR", "--target-object", "SATELLITE", "--attitude-object", "SAT"),
        *("--attitude-frame", "BUS", "--sample-error", 0.01, "--attitude-error", 0.002, "--json"),
    ).json
    assert answer["contact_verdict"] == "no"
    assert len(answer["overrides"]) == 2
    assert answer["assumptions"]["sample_error_m"] == 0.01
    assert answer["assumptions"]["attitude_error_rad"] == 0.002
    alone = keepout_command(
        *("audit", "--target", "box", "--chaser", files["chaser"], "--target-orbit", files["target_orbit"]),
        *("--chaser-radius", 0.5, "--acceleration-bound", 0.01, "--attitude-object", "SAT"),
    )
    assert alone.code == 1
    assert "--attitude-object SAT: only with --target-attitude" in alone.err
