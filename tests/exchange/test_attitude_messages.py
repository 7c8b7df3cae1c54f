"""AEM files: Q1, Q2, Q3, QC turn frame A into frame B, in the standard's order, whoever reads or writes them."""

import re

import numpy as np
import pytest
from lxml import etree
from scipy.spatial.transform import Rotation
from truths.command_line import keepout_command
from truths.messages import GEOSTATIONARY, TUMBLING, toy_flight

from keepout.errors import ExchangeError
from keepout.exchange.attitude_message import Attitude, read_aem, write_aem

# After the example of an AEM with quaternions printed in the annex of CCSDS 504.0-B-1 and, without the two
# keywords that went, of 504.0-B-2.
FIRST_EDITION = """CCSDS_AEM_VERS = 1.0
CREATION_DATE = 2002-11-04T17:22:31
ORIGINATOR = NASA/JPL

META_START
COMMENT This file was produced by M.R. Somebody, MSOO NAV/JPL, 2002 OCT 04.
COMMENT It is to be used for attitude reconstruction only. The relative accuracy of these
COMMENT attitudes is 0.1 degrees per axis.
OBJECT_NAME = MARS GLOBAL SURVEYOR
OBJECT_ID = 1996-062A
CENTER_NAME = MARS BARYCENTER
REF_FRAME_A = EME2000
REF_FRAME_B = SC_BODY_1
ATTITUDE_DIR = A2B
TIME_SYSTEM = UTC
START_TIME = 1996-11-28T21:29:07.2555
USEABLE_START_TIME = 1996-11-28T22:08:02.5555
USEABLE_STOP_TIME = 1996-11-30T01:18:02.5555
STOP_TIME = 1996-11-30T01:28:02.5555
ATTITUDE_TYPE = QUATERNION
QUATERNION_TYPE = LAST
INTERPOLATION_METHOD = HERMITE
INTERPOLATION_DEGREE = 7
META_STOP

DATA_START
1996-11-28T21:29:07.2555 0.56748 0.03146 0.45689 0.68427
1996-11-28T22:08:03.5555 0.42319 -0.45697 0.23784 0.74533
1996-11-28T22:08:04.5555 -0.84532 0.26974 -0.06532 0.45652
1996-11-30T01:28:02.5555 0.74563 -0.45375 0.36875 0.31964
DATA_STOP
"""
WITH_USEABLE_TIMES = FIRST_EDITION
FIRST_EDITION = re.sub(r"USEABLE.*\n", "", FIRST_EDITION)
SECOND_EDITION = (
    FIRST_EDITION.replace("VERS = 1.0", "VERS = 2.0")
    .replace("ATTITUDE_DIR = A2B\n", "")
    .replace("QUATERNION_TYPE = LAST\n", "")
)
PRINTED = np.array(
    [
        [0.56748, 0.03146, 0.45689, 0.68427],
        [0.42319, -0.45697, 0.23784, 0.74533],
        [-0.84532, 0.26974, -0.06532, 0.45652],
        [0.74563, -0.45375, 0.36875, 0.31964],
    ]
)


def direction_cosines(q1, q2, q3, qc):
    """The matrix from components in A to components in B, as textbooks of attitude determination print it."""
    return np.array(
        [
            [q1**2 - q2**2 - q3**2 + qc**2, 2 * (q1 * q2 + q3 * qc), 2 * (q1 * q3 - q2 * qc)],
            [2 * (q1 * q2 - q3 * qc), -(q1**2) + q2**2 - q3**2 + qc**2, 2 * (q2 * q3 + q1 * qc)],
            [2 * (q1 * q3 + q2 * qc), 2 * (q2 * q3 - q1 * qc), -(q1**2) - q2**2 + q3**2 + qc**2],
        ]
    )


def read_text(tmp_path, text):
    path = tmp_path / "a.aem"
    path.write_text(text)
    return read_aem(path)


@pytest.mark.parametrize("text", [FIRST_EDITION, SECOND_EDITION], ids=["B-1", "B-2"])
def test_the_printed_example_is_read_and_written_again(text, tmp_path):
    attitude = read_text(tmp_path, text)
    assert (attitude.frame_a, attitude.frame_b, attitude.time_system) == ("EME2000", "SC_BODY_1", "UTC")
    assert np.abs(attitude.quaternion - PRINTED).max() < 1e-5  # made unit from five digits
    assert np.diff(attitude.epochs)[1] == 1_000_000_000
    for xml in (False, True):
        again = Attitude(tmp_path / f"b{xml}", *list(attitude.__dict__.values())[1:])
        write_aem(again, centre="MARS BARYCENTER", comments=[], xml=xml)
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
    assert np.abs(read_text(tmp_path, first).quaternion - PRINTED).max() < 1e-5
    back = read_text(tmp_path, FIRST_EDITION.replace("A2B", "B2A"))
    assert (back.frame_a, back.frame_b) == ("SC_BODY_1", "EME2000")


def test_rows_outside_the_useable_times_are_left_out(tmp_path):
    attitude = read_text(tmp_path, WITH_USEABLE_TIMES)
    assert attitude.unuseable == 2
    assert np.abs(attitude.quaternion - PRINTED[1:3]).max() < 1e-5


def test_the_standards_quaternion_is_scipys_from_b_to_a():
    for quaternion in PRINTED:
        unit = quaternion / np.linalg.norm(quaternion)
        assert np.allclose(direction_cosines(*unit), Rotation.from_quat(unit).as_matrix().T, atol=1e-15)


@pytest.mark.parametrize("form", ["kvn", "xml"])
@pytest.mark.parametrize("tree", [GEOSTATIONARY, TUMBLING], ids=["vvlh", "tumbling"])
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
            states = etree.fromstring(text.encode()).iter("stateVector", "quaternionEphemeris")
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
        ("= A2B", "= C2D", "ATTITUDE_DIR is C2D; valid: A2B, B2A"),
        ("ATTITUDE_DIR = A2B\n", "", "ATTITUDE_DIR is missing"),
        ("0.56748", "0.96748", "the quaternion of 1996-11-28T21:29:07.255500 has length 1.2"),
        ("DATA_STOP\n", "", "ends in its rows; it is cut off"),
        ("DATA_START\n", "", "rows stand between DATA_START and DATA_STOP"),
        ("DATA_START", "DATA_START\nREF_FRAME_A = X", "'REF_FRAME_A = X'; a row of an epoch and numbers"),
    ],
)
def test_what_cannot_be_used_is_named(old, new, said, tmp_path):
    assert old in FIRST_EDITION
    with pytest.raises(ExchangeError) as refusal:
        read_text(tmp_path, FIRST_EDITION.replace(old, new, 1))
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)
