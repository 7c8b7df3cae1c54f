"""OEM files: what another program reads in them is what was flown, and damage is one clear line."""

import contextlib
import datetime
import re

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
from truths.messages import GEOSTATIONARY, TUMBLING, toy_flight

from keepout.errors import ExchangeError
from keepout.exchange.orbit_message import Orbit, read_oem, write_oem
from keepout.mission.scenario import Scenario
from keepout.motion.frames import orbital_rate, vvlh_axes
from keepout.motion.perturbation import J2


@pytest.fixture(scope="module", params=[GEOSTATIONARY, TUMBLING], ids=["vvlh", "tumbling"])
def flown(request, tmp_path_factory):
    scenario, record = toy_flight(request.param)
    return scenario, record, record.save(tmp_path_factory.mktemp("flown") / "flight.parquet")


def independent_states(scenario, record):
    """Chaser and target in ECI by the conversions of the tests, which the exports do not use."""
    if record.target_orbit is None:
        mean, radius = np.sqrt(3.986004418e14 / 42_164_000.0**3), 42_164_000.0
        angle = mean * record.time
        zero = np.zeros_like(angle)
        target = np.stack(
            [
                *(radius * np.cos(angle), radius * np.sin(angle), zero),
                *(-radius * mean * np.sin(angle), radius * mean * np.cos(angle), zero),
            ],
            axis=1,
        )
    else:
        target = record.target_orbit
    centre = np.asarray(scenario.target.centre_of_mass)
    states = []
    for k in range(0, len(record.time), 10):
        position, velocity = jnp.asarray(target[k, :3]), jnp.asarray(target[k, 3:])
        pull = 0.0
        if scenario.orbit.j2:
            normal = jnp.cross(position, velocity)
            pull = J2().of_target(position, velocity) @ normal / jnp.linalg.norm(normal)
        rate = vvlh_axes(position, velocity) @ orbital_rate(position, velocity, pull)
        in_vvlh = vvlh_from_body(
            jnp.asarray(record.position[k] - centre),
            jnp.asarray(record.velocity[k]),
            jnp.asarray(record.attitude[k]),
            jnp.asarray(record.angular_velocity[k]),
            rate,
        )
        states.append(np.concatenate(jax.device_get(eci_from_vvlh(*in_vvlh, position, velocity, pull))))
    return target[::10], np.array(states)


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
    orbit = Orbit(path, "A", "EARTH", "GCRF", "TAI", epochs, rows[:, :3], rows[:, 3:])
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


STANDARD = """CCSDS_OEM_VERS = 3.0
CREATION_DATE = 1996-11-04T17:22:31
ORIGINATOR = NASA/JPL

META_START
OBJECT_NAME = MARS GLOBAL SURVEYOR
OBJECT_ID = 1996-062A
CENTER_NAME = MARS BARYCENTER
REF_FRAME = EME2000
TIME_SYSTEM = UTC
START_TIME = 1996-12-18T12:00:00.331
USEABLE_START_TIME = 1996-12-18T12:10:00.331
USEABLE_STOP_TIME = 1996-12-28T21:23:00.331
STOP_TIME = 1996-12-28T21:28:00.331
INTERPOLATION = HERMITE
INTERPOLATION_DEGREE = 7
META_STOP

COMMENT This file was produced by M.R. Somebody, MSOO NAV/JPL, 1996NOV 04. It is
COMMENT to be used for DSN scheduling purposes only.

1996-12-18T12:00:00.331 2789.619 -280.045 -1746.755 4.73372 -2.49586 -1.04195
1996-12-18T12:01:00.331 2783.419 -308.143 -1877.071 5.18604 -2.42124 -1.99608
1996-12-18T12:02:00.331 2776.033 -336.859 -2008.682 5.63678 -2.33951 -1.94687

1996-12-28T21:28:00.331 -3881.024 563.959 -682.773 -3.28827 -3.66735 1.63861

META_START
OBJECT_NAME = MARS GLOBAL SURVEYOR
OBJECT_ID = 1996-062A
CENTER_NAME = MARS BARYCENTER
REF_FRAME = EME2000
TIME_SYSTEM = UTC
START_TIME = 1996-12-28T21:29:07.267
STOP_TIME = 1996-12-30T01:28:02.267
META_STOP

1996-12-28T21:29:07.267 -2432.166 -063.042 1742.754 7.33702 -3.495867 -1.041945
1996-12-30T01:28:02.267 2164.375 1115.811 -688.131 -3.53328 -2.88452 0.88535

COVARIANCE_START
EPOCH = 1996-12-28T21:29:07.267
COV_REF_FRAME = RTN
3.3313494e-04
4.6189273e-04 6.7824216e-04
COVARIANCE_STOP
"""
"""After the examples of an OEM printed in annex G of CCSDS 502.0-B."""
STANDARD_USEABLE = STANDARD
STANDARD = re.sub(r"USEABLE.*\n", "", STANDARD)


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


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("CCSDS_OEM_VERS = 3.0", "CCSDS_OEM_VERS = 7.0", "CCSDS_OEM_VERS is 7.0; valid: 1.0, 2.0, 3.0"),
        ("CCSDS_OEM_VERS", "CCSDS_OPM_VERS", "line 1: 'CCSDS_OPM_VERS = 3.0'; an OEM begins with CCSDS_OEM_VERS"),
        ("REF_FRAME = EME2000", "COMMENT none", "REF_FRAME is missing"),
        ("TIME_SYSTEM = UTC", "TIME_SYSTEM = MET", "TIME_SYSTEM is MET; valid: UTC, TAI"),
        (
            "CENTER_NAME = MARS BARYCENTER\nREF_FRAME = EME2000\nTIME_SYSTEM = UTC\nSTART_TIME = 1996-12-28",
            "CENTER_NAME = SUN\nREF_FRAME = EME2000\nTIME_SYSTEM = UTC\nSTART_TIME = 1996-12-28",
            "CENTER_NAME is MARS BARYCENTER in one segment and SUN in another",
        ),
        ("2783.419", "2783.4l9", "holds '2783.4l9'; it must be a finite number"),
        ("2783.419", "nan", "holds 'nan'; it must be a finite number"),
        ("-308.143 -1877.071 5.18604 -2.42124 -1.99608", "-308.143", "has 2 numbers; it must have 6 or 9"),
        ("12:01:00.331 ", "11:01:00.331 ", "EPOCH 1996-12-18T11:01:00.331 does not come after"),
        ("12:01:00.331 ", "12:01:60.331 ", "EPOCH '1996-12-18T12:01:60.331' lies within a leap second"),
        ("1996-12-18T12:01:00.331 ", "yesterday ", "EPOCH 'yesterday' must be an instant"),
        ("META_STOP\n\nCOMMENT", "COMMENT", "a keyword = value must stand there"),
        (
            "1996-12-28T21:28:00.331 -",
            "COMMENT ",
            "the rows end at 1996-12-18T12:02:00.331, before STOP_TIME",
        ),
        ("STOP_TIME = 1996-12-28T21:28:00.331", "STOP_TIME = never", "STOP_TIME 'never' must be an instant"),
        ("OBJECT_ID = 1996-062A", "OBJECT_NAME = X", "OBJECT_NAME must stand there once"),
        ("OBJECT_ID = 1996-062A\n", "", "OBJECT_ID is missing"),
        ("START_TIME = 1996-12-18T12:00:00.331\n", "", "START_TIME is missing"),
        (
            "START_TIME = 1996-12-18T12:00",
            "START_TIME = 1996-12-18T11:00",
            "but the first row is of 1996-12-18T12:00:00",
        ),
        ("2783.419", "2_783.419", "holds '2_783.419'; it must be a finite number"),
        ("2783.419", "2783.419d0", "holds '2783.419d0'; it must be a finite number"),
        ("2783.419", "0e999", "holds '0e999'; it must be a finite number"),
        ("2783.419", "\u0662\u0667\u0668\u0663.419", "only ASCII may stand there"),
        ("12:01:00.331 ", "12:01:0\u0660.331 ", "only ASCII may stand there"),
        ("COMMENT This file", "COMMENT\nMETA_START\nCOMMENT This file", "a keyword = value must stand there"),
        ("1996-12-18T12:01:00.331 ", "9999-12-18T12:01:00.331 ", "must lie from 1677-09-22 to 2262-04-11"),
        ("1996-12-18T12:01:00.331 ", "2200-12-18T12:01:00.331 ", "must lie between 1824 and 2116"),
        (
            "1996-12-28T21:28:00.331 -3881.024 563.959 -682.773 -3.28827 -3.66735 1.63861",
            "1996-12-28T21:28:00.331 -3881.024 563.959 -682.773 -3.28827 -3.66735 1.63861 1.0",
            "has 7 numbers; it must have 6 or 9",
        ),
    ],
)
def test_damage_is_one_line_that_names_it(tmp_path, old, new, said):
    assert old in STANDARD
    path = tmp_path / "damaged.oem"
    path.write_text(STANDARD.replace(old, new, 2 if old.startswith("TIME_SYSTEM") else 1))
    with pytest.raises(ExchangeError) as refusal:
        read_oem(path)
    assert "\n" not in str(refusal.value)
    assert str(path) in str(refusal.value)
    assert said in str(refusal.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"<oem", "damaged or not XML"),
        (b"<opm/>", "its element is 'opm'"),
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
    path = tmp_path / "x"
    path.write_bytes(content)
    with pytest.raises(ExchangeError, match=said):
        read_oem(path)


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
        ("yesterday Z", "an instant"),
        ("1969-01-01T00:00:00Z", "1972-01-01"),
        (3, "ends in Z"),
    ],
)
def test_an_epoch_that_is_none_is_refused(epoch, said):
    with pytest.raises(ValueError, match=said) as refusal:
        Scenario.parse({"epoch": epoch})
    assert str(epoch) in str(refusal.value)


def test_a_toml_time_is_an_epoch(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("epoch = 2026-05-06T07:08:09.25Z\n")
    assert Scenario.load(path).epoch == "2026-05-06T07:08:09.250000Z"


def test_a_flight_over_a_leap_second_is_refused(tmp_path):
    _, record = toy_flight(GEOSTATIONARY | {"epoch": "2016-12-31T23:59:30Z"}, steps=60)
    path = record.save(tmp_path / "flight.npz")
    answer = keepout_command("export", path, "--to", "oem", "-o", tmp_path / "a.oem")
    assert answer.code == 1
    assert "epoch: 2016-12-31T23:59:30Z" in answer.err
    assert "leap second before 2017-01-01" in answer.err
    assert not (tmp_path / "a.oem").exists()
