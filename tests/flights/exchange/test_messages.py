"""OEM and AEM files: what another program reads in them is what was flown, and damage is one clear line."""

import contextlib
import dataclasses
import datetime
import re
from pathlib import Path
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st
from oem import OrbitEphemerisMessage
from truths.command_line import keepout_command
from truths.frames import eci_from_vvlh, vvlh_from_body
from truths.message_files import CHASER, base, instant, ndm, resting, xml_of
from truths.messages import GEOSTATIONARY, TUMBLING, toy_flight

from keepout.core.errors import ExchangeError
from keepout.core.mission.scenario import Scenario
from keepout.core.motion.orbit import J2
from keepout.core.motion.rotation import orbital_rate, vvlh_axes
from keepout.flights.exchange.ephemeris import Orbit, read_aem, read_oem, write_aem, write_oem


@pytest.fixture(scope="module", params=[GEOSTATIONARY, TUMBLING], ids=["vvlh", "tumbling"])
def flown(request, tmp_path_factory):
    scenario, record = toy_flight(request.param)
    return scenario, record, record.save(tmp_path_factory.mktemp("flown") / "flight.parquet")


def independent_states(scenario, record):
    """Every tenth state of target and chaser in ECI by the conversions of the tests, which the exports do not use."""
    target = record.target_orbit
    if target is None:
        mean, radius = np.sqrt(3.986004418e14 / 42_164_000.0**3), 42_164_000.0
        cosine, sine, zero = np.cos(mean * record.time), np.sin(mean * record.time), 0.0 * record.time
        target = radius * np.stack([cosine, sine, zero, -mean * sine, mean * cosine, zero], axis=1)
    centre = np.asarray(scenario.target.centre_of_mass)
    columns = (record.position - centre, record.velocity, record.attitude, record.angular_velocity)

    @jax.jit
    def chaser(orbit, *row):
        position, velocity = orbit[:3], orbit[3:]
        pull = 0.0
        if scenario.orbit.j2:
            normal = jnp.cross(position, velocity)
            pull = J2().of_target(position, velocity) @ normal / jnp.linalg.norm(normal)
        rate = vvlh_axes(position, velocity) @ orbital_rate(position, velocity, pull)
        return jnp.concatenate(eci_from_vvlh(*vvlh_from_body(*row, rate), position, velocity, pull))

    states = [chaser(*rows) for rows in zip(target[::10], *(column[::10] for column in columns))]
    return target[::10], np.array(states)


@pytest.mark.long
@pytest.mark.parametrize("form", ["oem", "xml"])
def test_the_oem_package_reads_what_was_flown(flown, form, tmp_path):
    scenario, record, path = flown
    truth = dict(zip(("target", "chaser"), independent_states(scenario, record)))
    for craft, states in truth.items():
        out = tmp_path / f"{craft}.{form}"
        summary = keepout_command("export", path, "--to", "oem", "--of", craft, "-o", out, "--json").json
        assert (summary["frame"], summary["time_system"], summary["rows"]) == ("EME2000", "UTC", len(record.time))
        [segment] = OrbitEphemerisMessage.open(out).segments
        assert segment.metadata["REF_FRAME"] == "EME2000"
        assert segment.metadata["CENTER_NAME"] == "EARTH"
        assert segment.metadata["OBJECT_NAME"] == f"KEEPOUT-{craft.upper()}"
        read = list(segment.states)
        start = Time(scenario.epoch.removesuffix("Z"), scale="utc")
        assert np.abs([(s.epoch - start).sec for s in read] - record.time).max() < 1e-9
        position = np.array([s.position for s in read])[::10] * 1000.0
        velocity = np.array([s.velocity for s in read])[::10] * 1000.0
        assert np.abs(position - states[:, :3]).max() <= 1e-6
        assert np.abs(velocity - states[:, 3:]).max() <= 1e-9


@given(
    numbers=st.lists(st.floats(-1e9, 1e9, allow_subnormal=False), min_size=6, max_size=6),
    seconds=st.floats(1e-6, 1e6),
    xml=st.booleans(),
)
def test_numbers_and_epochs_come_back_as_they_were(tmp_path_factory, numbers, seconds, xml):
    path = tmp_path_factory.mktemp("one") / "orbit"
    rows = np.array([numbers, numbers[::-1]])
    epochs = np.array([0, round(seconds * 1e9)], np.int64) + 1_780_000_000_123_456_789
    told = {"name": "A", "centre": "EARTH", "frame": "GCRF", "time_system": "TAI"}
    orbit = Orbit(path=path, **told, epochs=epochs, position=rows[:, :3], velocity=rows[:, 3:])
    write_oem(orbit, comments=["of a test"], xml=xml)
    back = read_oem(path)
    assert np.array_equal(back.epochs, epochs)
    assert np.allclose(back.position, orbit.position, rtol=1e-15, atol=1e-300)
    assert np.allclose(back.velocity, orbit.velocity, rtol=1e-15, atol=1e-300)
    assert (np.linalg.norm(back.position - orbit.position, axis=1) <= back.position_error).all()
    assert (np.linalg.norm(back.velocity - orbit.velocity, axis=1) <= back.velocity_error).all()
    # CCSDS 502.0-B allows a number 16 digits.
    mantissas = re.findall(r"(-?\d\.\d+)e[+-]\d+", path.read_text())
    assert len(mantissas) == 12
    assert max(len(mantissa.lstrip("-").replace(".", "")) for mantissa in mantissas) <= 16
    assert (back.name, back.centre, back.frame, back.time_system) == ("A", "EARTH", "GCRF", "TAI")


STANDARD_USEABLE = (Path(__file__).parent / "annex_g.oem").read_text()
"""After the examples of an OEM printed in annex G of CCSDS 502.0-B."""
STANDARD = re.sub(r"USEABLE.*\n", "", STANDARD_USEABLE)


def test_an_example_after_the_standard_is_read(tmp_path):
    path = tmp_path / "mgs.oem"
    path.write_text(STANDARD)
    orbit = read_oem(path)
    assert (orbit.centre, orbit.frame, orbit.time_system) == ("MARS BARYCENTER", "EME2000", "UTC")
    assert orbit.position[0].tolist() == pytest.approx([2_789_619.0, -280_045.0, -1_746_755.0])
    assert orbit.velocity[-1].tolist() == pytest.approx([-3533.28, -2884.52, 885.35])
    first = datetime.datetime(1996, 12, 18, 12, 0, 0, 331_000, tzinfo=datetime.UTC)
    assert orbit.epochs[0] == round(first.timestamp() * 1000) * 1_000_000
    assert len(orbit.epochs) == 6
    # With the useable times printed there, none of the first segment's rows that are shown may be used.
    path.write_text(STANDARD_USEABLE)
    useable = read_oem(path)
    assert useable.unuseable == 4
    assert np.array_equal(useable.epochs, orbit.epochs[4:])


def refusal_of(read, path, content):
    """What reading the content says, in a line that names the file."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ExchangeError) as refusal:
        read(path)
    said = str(refusal.value)
    assert "\n" not in said
    assert str(path) in said
    return said


def damaged(whole, old, new):
    assert old in whole
    return whole.replace(old, new, 2 if old.startswith("TIME_SYSTEM") else 1)


NO_NUMBERS = ("0e999", "1_000.5", "\u0661\u0660", "1e5_0", "0x10", "1,5", "infinity", "1.5D0", "1.5e3.0")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("CCSDS_OEM_VERS = 3.0", "CCSDS_OEM_VERS = 7.0", "CCSDS_OEM_VERS is 7.0; valid: 1.0, 2.0, 3.0"),
        ("CCSDS_OEM_VERS", "CCSDS_OPM_VERS", "line 1: 'CCSDS_OPM_VERS = 3.0'; an OEM begins with CCSDS_OEM_VERS"),
        ("REF_FRAME = EME2000", "COMMENT none", "REF_FRAME is missing"),
        ("TIME_SYSTEM = UTC", "TIME_SYSTEM = MET", "TIME_SYSTEM is MET; valid: UTC, TAI"),
        ("CENTER_NAME = MARS BARYCENTER", "CENTER_NAME = SUN", "CENTER_NAME is SUN in one segment and MARS BARYCENTER"),
        ("-308.143 -1877.071 5.18604 -2.42124 -1.99608", "-308.143", "has 2 numbers; it must have 6 or 9"),
        ("12:01:00.331 ", "11:01:00.331 ", "EPOCH 1996-12-18T11:01:00.331 does not come after"),
        ("12:01:00.331 ", "12:01:60.331 ", "EPOCH '1996-12-18T12:01:60.331' lies within a leap second"),
        ("META_STOP\n\nCOMMENT", "COMMENT", "a keyword = value must stand there"),
        ("1996-12-28T21:28:00.331 -", "COMMENT ", "the rows end at 1996-12-18T12:02:00.331, before STOP_TIME"),
        ("OBJECT_ID = 1996-062A", "OBJECT_NAME = X", "OBJECT_NAME must stand there once"),
        ("= 1996-12-18T12:00", "= 1996-12-18T11:00", "but the first row is of 1996-12-18T12:00:00"),
        ("12:01:00.331 ", "12:01:0\u0660.331 ", "only ASCII may stand there"),
        ("1996-12-18T12:01:00.331 ", "9999-12-18T12:01:00.331 ", "must lie from 1677-09-22 to 2262-04-11"),
        ("1996-12-18T12:01:00.331 ", "2200-12-18T12:01:00.331 ", "must lie between 1824 and 2116"),
        *(("2783.419", no, "must be a finite number" if no.isascii() else "only ASCII") for no in NO_NUMBERS),
    ],
)
def test_damage_is_one_line_that_names_it(tmp_path, old, new, said):
    assert said in refusal_of(read_oem, tmp_path / "damaged.oem", damaged(STANDARD, old, new))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"<oem", "damaged or not XML"),
        (b"<oem version='3.0'/>", "has no segment"),
        (b"\xff\xfe\x00", "not a text file"),
        (b"", "ends in its start"),
        (
            b"<oem version='3.0'><body><segment><metadata/><data><stateVector><EPOCH>2020-01-01T00:00:00</EPOCH>"
            b"</stateVector></data></segment></body></oem>",
            "a stateVector has no X; it must have one each of",
        ),
    ],
)
def test_what_is_no_oem(tmp_path, content, said):
    assert said in refusal_of(read_oem, tmp_path / "x", content)


@given(cut=st.integers(0, len(STANDARD)))
def test_a_cut_off_file_never_breaks_the_reader(tmp_path_factory, cut):
    path = tmp_path_factory.mktemp("cut") / "cut.oem"
    path.write_text(STANDARD[:cut])
    with contextlib.suppress(ExchangeError):  # one line, as every refusal; nothing else may come out
        # A file that ends after its first segment is a whole one; rows are never missing.
        assert len(read_oem(path).epochs) == (4 if cut <= STANDARD.rindex("META_START") else 6)


@pytest.mark.parametrize(
    ("epoch", "said"),
    [
        ("2026-01-01T00:00:00", "ends in Z"),
        ("2026-02-30T00:00:00Z", "a day and time that there are"),
        ("1969-01-01T00:00:00Z", "1972-01-01"),
    ],
)
def test_an_epoch_that_is_none_is_refused(epoch, said):
    with pytest.raises(ValueError, match=said) as refusal:
        Scenario.parse({"epoch": epoch})
    assert str(epoch) in str(refusal.value)


def test_a_flight_over_a_leap_second_is_refused(tmp_path):
    _, record = toy_flight(GEOSTATIONARY | {"epoch": "2016-12-31T23:59:30Z"}, steps=60)
    path = record.save(tmp_path / "flight.npz")
    answer = keepout_command("export", path, "--to", "oem", "-o", tmp_path / "a.oem")
    assert answer.code == 1
    assert "epoch: 2016-12-31T23:59:30Z" in answer.err
    assert "leap second before 2017-01-01" in answer.err
    assert not (tmp_path / "a.oem").exists()


# ---- numbers and lines


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("<X>7000.000000000000</X>", "<X>7<b/>000</X>", "holds more than text"),
        ("<X>7000.000000000000</X>", "<X>7000.0</X><X>1.0</X>", "has 2 X"),
        ("<Z>0.000000000000</Z>", "<Z>1_000.5</Z>", "must be a finite number"),
        ("<?xml", "<!DOCTYPE oem [<!ENTITY e '3'>]><?xml", "DOCTYPE"),
    ],
)
def test_xml_that_reads_as_less_than_it_says_is_refused(old, new, said, tmp_path):
    rows = base(np.arange(5.0)) / 1e3
    path = ndm(tmp_path / "c.xml", xml_of("OEM", CHASER, np.arange(5.0), rows))
    assert said in refusal_of(read_oem, path, damaged(path.read_text(), old, new))


@pytest.mark.parametrize("name", ["N" * 300, "a\nCENTER_NAME = MARS", "Büro", "", " x"])
@pytest.mark.parametrize("xml", [False, True])
def test_a_name_that_is_no_line_is_refused(name, xml, tmp_path):
    orbit = dataclasses.replace(read_oem(resting(tmp_path)["chaser"]), path=tmp_path / "o", name=name)
    with pytest.raises(ExchangeError, match="OBJECT_NAME would be") as refusal:
        write_oem(orbit, comments=[], xml=xml)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "o").exists()


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


# ---- attitudes: Q1, Q2, Q3, QC turn frame A into frame B, in the standard's order, whoever reads or writes them

WITH_USEABLE_TIMES = (Path(__file__).parent / "quaternions.aem").read_text()
"""After the example of an AEM with quaternions printed in the annex of CCSDS 504.0-B-1.

Without two keywords, that went, it is one of 504.0-B-2.
"""
FIRST_EDITION = re.sub(r"USEABLE.*\n", "", WITH_USEABLE_TIMES)
SECOND_EDITION = re.sub(r"(ATTITUDE_DIR|QUATERNION_TYPE) = .*\n", "", FIRST_EDITION.replace("VERS = 1.0", "VERS = 2.0"))
PRINTED = np.array([line.split()[1:] for line in FIRST_EDITION.splitlines() if line.startswith("1996-")], float)


def direction_cosines(q1, q2, q3, qc):
    """The matrix from components in A to components in B, as textbooks of attitude determination print it."""
    return np.array(
        [
            [q1**2 - q2**2 - q3**2 + qc**2, 2 * (q1 * q2 + q3 * qc), 2 * (q1 * q3 - q2 * qc)],
            [2 * (q1 * q2 - q3 * qc), -(q1**2) + q2**2 - q3**2 + qc**2, 2 * (q2 * q3 + q1 * qc)],
            [2 * (q1 * q3 + q2 * qc), 2 * (q2 * q3 - q1 * qc), -(q1**2) - q2**2 + q3**2 + qc**2],
        ]
    )


def read_attitude(tmp_path, text):
    path = tmp_path / "a.aem"
    path.write_text(text)
    return read_aem(path)


@pytest.mark.parametrize("text", [FIRST_EDITION, SECOND_EDITION], ids=["B-1", "B-2"])
def test_the_printed_example_is_read_and_written_again(text, tmp_path):
    attitude = read_attitude(tmp_path, text)
    assert (attitude.frame_a, attitude.frame_b, attitude.time_system) == ("EME2000", "SC_BODY_1", "UTC")
    assert np.abs(attitude.quaternion - PRINTED).max() < 1e-5  # made unit from five digits
    assert np.diff(attitude.epochs)[1] == 1_000_000_000
    for xml in (False, True):
        again = dataclasses.replace(attitude, path=tmp_path / f"b{xml}", centre="MARS BARYCENTER")
        write_aem(again, comments=[], xml=xml)
        back = read_aem(again.path)
        assert np.array_equal(back.epochs, attitude.epochs)
        for one, other in zip(back.quaternion, attitude.quaternion):
            assert np.abs(direction_cosines(*one) - direction_cosines(*other)).max() < 1e-14


def test_the_first_edition_may_put_the_scalar_first_and_turn_round(tmp_path):
    lines = []
    for line in FIRST_EDITION.splitlines():
        words = line.split()
        lines.append(" ".join([words[0], words[4], *words[1:4]]) if line[:5] == "1996-" else line)
    first = "\n".join(lines).replace("QUATERNION_TYPE = LAST", "QUATERNION_TYPE = FIRST")
    assert np.abs(read_attitude(tmp_path, first).quaternion - PRINTED).max() < 1e-5
    useable = read_attitude(tmp_path, WITH_USEABLE_TIMES)
    assert useable.unuseable == 2
    assert np.abs(useable.quaternion - PRINTED[1:3]).max() < 1e-5
    back = read_attitude(tmp_path, FIRST_EDITION.replace("A2B", "B2A"))
    assert (back.frame_a, back.frame_b) == ("SC_BODY_1", "EME2000")


@pytest.mark.long
@pytest.mark.parametrize(("tree", "form"), [(GEOSTATIONARY, "kvn"), (TUMBLING, "xml")], ids=["vvlh", "tumbling"])
def test_a_flights_attitude_takes_the_chaser_back_to_where_it_was(tree, form, tmp_path):
    """Read by a dozen lines of another reader: the difference of the two orbits, in body axes, is the record's."""
    scenario, record = toy_flight(tree, steps=30)
    path = record.save(tmp_path / "flight.npz")
    for to, craft, name in (("oem", "chaser", "c"), ("oem", "target", "t"), ("aem", None, "a")):
        of = () if craft is None else ("--of", craft)
        xml = ("--xml",) if form == "xml" else ()
        assert keepout_command("export", path, "--to", to, *of, *xml, "-o", tmp_path / name).code == 0

    def rows(name):
        text = (tmp_path / name).read_text()
        if form == "xml":
            states = ElementTree.fromstring(text).iter("quaternionEphemeris" if name == "a" else "stateVector")
            keys = ("Q1", "Q2", "Q3", "QC") if name == "a" else ("X", "Y", "Z")
            return np.array([[float(state.find(f".//{key}").text) for key in keys] for state in states])
        width = 4 if name == "a" else 3
        return np.array([line.split()[1 : 1 + width] for line in text.splitlines() if line[:2] == "20"], float)

    away = (rows("c") - rows("t")) * 1000.0
    quaternions = rows("a")
    in_body = np.array([direction_cosines(*q) @ r for q, r in zip(quaternions, away)])
    assert np.abs(in_body + scenario.target.centre_of_mass - record.position).max() < 1e-6
    assert np.abs(np.diff(quaternions, axis=0)).max() < 0.01  # no change of sign from row to row
    assert quaternions[0, 3] >= 0.0


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("VERS = 1.0", "VERS = 3.0", "CCSDS_AEM_VERS is 3.0; valid: 1.0, 2.0"),
        ("= QUATERNION\n", "= SPIN\n", "ATTITUDE_TYPE is SPIN; valid: QUATERNION"),
        ("= LAST", "= MIDDLE", "QUATERNION_TYPE is MIDDLE; valid: FIRST, LAST"),
        ("ATTITUDE_DIR = A2B\n", "", "ATTITUDE_DIR is missing"),
        ("0.56748", "0.96748", "the quaternion of 1996-11-28T21:29:07.255500 has length 1.2"),
        ("DATA_STOP\n", "", "ends in its rows; it is cut off"),
        ("DATA_START\n", "", "rows stand between DATA_START and DATA_STOP"),
        ("DATA_START", "DATA_START\nREF_FRAME_A = X", "'REF_FRAME_A = X'; a row of an epoch and numbers"),
    ],
)
def test_what_cannot_be_used_of_an_attitude_is_named(old, new, said, tmp_path):
    assert said in refusal_of(read_aem, tmp_path / "a.aem", damaged(FIRST_EDITION, old, new))
