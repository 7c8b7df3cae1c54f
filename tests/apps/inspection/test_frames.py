"""Frames as flown, against closed forms: around a box nothing hides an outer side but the side's own plane."""

import dataclasses
import math
import re

import numpy as np
import pytest
from truths.invented_flight import record_of
from truths.made_up_inspection import seen_of_box

from keepout.apps.inspection.frames import Frame, Shot, as_flown, camera_breaches, load_frames, save_frames
from keepout.apps.inspection.light import Camera, Light, ever_lit
from keepout.apps.inspection.seeing.patches import cut
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import SeeingRules
from keepout.core.errors import InspectionError
from keepout.core.geometry.target import Target
from keepout.core.mission.task_entries import CameraEntry

# Its kernels take ten seconds to compile.
pytestmark = pytest.mark.long

RULES = SeeingRules(greatest_range=6.0)


class Sun(Light):
    """A sun that stands still, turns, or is none."""

    def __init__(self, direction=None, *, dark=None, turning=0.0):
        vars(self).update(direction=direction, dark=dark, turning=turning)

    @property
    def matters(self):
        return self.direction is not None

    def sun(self, time):
        if self.direction is None or (self.dark is not None and self.dark[0] <= time <= self.dark[1]):
            return None
        turn = self.turning * time
        x, y, z = self.direction
        return np.array([x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn), z])


@pytest.fixture(scope="module")
def parts():
    target = Target.load("box")
    patches = cut(target, 0.25)
    return target, patches, Sightlines(target.vertices, target.faces, patches)


def camera_of(parts, sun):
    return Camera(parts[2], RULES, sun)


def test_a_frame_shows_what_closed_forms_say(parts):
    generator = np.random.default_rng(1)
    camera, shown = camera_of(parts, Sun()), 0
    for _ in range(12):
        place = generator.standard_normal(3)
        place *= generator.uniform(2.5, 5.0) / np.linalg.norm(place)
        boresight = -place / np.linalg.norm(place) + 0.2 * generator.standard_normal(3)
        boresight /= np.linalg.norm(boresight)
        expected = seen_of_box(parts[1], RULES, place, boresight)
        # A unit counts a little later than it might, where its spread bounds its corners: conservative, and seldom.
        found = camera.units(0.0, place, boresight)
        assert np.isin(found, expected).all()
        assert len(found) >= 0.8 * len(expected)
        shown += len(found)
    assert shown > 100


def test_sun_and_shadow_decide_what_counts(parts):
    sun = np.array([0.6, 0.0, 0.8])
    place, boresight = np.array([2.5, 0.0, 2.5]), np.array([-1.0, 0.0, -1.0]) / math.sqrt(2.0)
    plain = camera_of(parts, Sun()).units(0.0, place, boresight)
    lit = camera_of(parts, Sun(sun)).units(0.0, place, boresight)
    assert np.array_equal(np.sort(lit), np.sort(plain))  # both sides that it sees are lit
    away = camera_of(parts, Sun(-sun)).units(0.0, place, boresight)
    assert len(plain)
    assert not len(away)
    dark = camera_of(parts, Sun(sun, dark=(5.0, 9.0)))
    assert not len(dark.units(7.0, place, boresight))
    assert np.array_equal(dark.units(10.0, place, boresight), lit)
    # What is kept of the light is forgotten when the sun moves.
    ahead = np.array([1.0, 0.0, 0.0])
    turning = camera_of(parts, Sun(ahead, turning=math.pi / 100.0))
    assert [len(turning.units(now, 3.0 * ahead, -ahead)) > 0 for now in (0.0, 100.0, 200.0)] == [True, False, True]


def test_what_is_ever_lit_is_every_side_that_the_suns_circle_meets(parts):
    _, patches, _ = parts
    units = patches.counted
    circling = camera_of(parts, Sun(np.array([1.0, 0.0, 0.0]), turning=2.0 * math.pi / 5000.0))
    lit = ever_lit(circling, units, 5000.0)
    across = np.abs(patches.unit_normals()[:, 2]) < 0.5
    assert np.array_equal(lit, units & across)
    assert np.array_equal(ever_lit(camera_of(parts, Sun()), units, 5000.0), units)
    still = camera_of(parts, Sun(np.array([0.0, 0.0, 1.0])))
    assert np.array_equal(ever_lit(still, units, 5000.0), units & (patches.unit_normals()[:, 2] > 0.5))


def rows_of(positions):
    """Rows of a flight, as the frames ask for them."""
    return record_of({}, position=np.array(positions), time=np.arange(float(len(positions))))


@pytest.fixture
def flown(parts):
    record = rows_of([[3.0, 0.0, 0.0], [3.5, 0.0, 0.0], [0.0, 0.0, 3.0]])
    shots = [Shot(0, np.array([-1.0, 0.0, 0.0])), Shot(2, np.array([0.0, 0.0, -1.0]))]
    camera = camera_of(parts, Sun(np.array([0.0, 0.6, 0.8]), dark=(0.0, 1.0)))
    return as_flown(record, shots, camera)


def test_frames_are_those_of_the_records_positions(parts, flown):
    frames, seen = flown
    assert [frame.time for frame in frames] == [0.0, 2.0]
    assert frames[0].sun is None
    assert not len(frames[0].units)
    assert np.array_equal(np.flatnonzero(seen), np.sort(frames[1].units))
    assert np.isin(frames[1].units, seen_of_box(parts[1], RULES, frames[1].position, frames[1].boresight)).all()
    with pytest.raises(InspectionError, match="row 9"):
        as_flown(rows_of([[3.0, 0.0, 0.0]]), [Shot(9, np.array([1.0, 0.0, 0.0]))], camera_of(parts, Sun()))


def test_frames_come_back_from_their_file_bit_for_bit(tmp_path, flown):
    frames, _ = flown
    path = save_frames(tmp_path / "frames.parquet", frames, target_sha256="ab")
    again, sha256 = load_frames(path)
    assert sha256 == "ab"
    for one, other in zip(frames, again, strict=True):
        assert one.time == other.time
        assert (one.sun is None) == (other.sun is None)
        for name in ("position", "boresight", "units") + (("sun",) if one.sun is not None else ()):
            assert np.array_equal(getattr(one, name), getattr(other, name))


def test_frames_that_no_camera_takes_are_told_by_its_limits():
    camera = CameraEntry(period=5.0, turn_rate=math.radians(1.0))

    def at(time, degrees, length=1.0):
        ahead = length * np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0.0])
        return Frame(time, np.zeros(3), ahead, None, np.zeros(0, int))

    assert camera_breaches((at(0.0, 0.0), at(5.0, 5.0), at(20.0, -10.0)), camera) == ()
    wrong = {
        r"frame 1 at 5 s: the boresight turned by 0\.09076 rad in 5 s": (at(0.0, 0.0), at(5.0, 5.2)),
        r"frame 1 at 2\.5 s: frames are taken every camera\.period, 5 s": (at(0.0, 0.0), at(2.5, 0.0)),
        r"frame 1 at 5 s: frames are taken every": (at(5.0, 0.0), at(5.0, 0.0)),
        r"frame 0: a boresight of length 2,": (at(0.0, 0.0, 2.0),),
    }
    for words, frames in wrong.items():
        (line,) = camera_breaches(frames, camera)
        assert re.match(words, line)


def test_a_damaged_or_foreign_frames_file_is_refused_in_a_line(tmp_path, flown):
    frames, _ = flown
    path = save_frames(tmp_path / "frames.parquet", frames, target_sha256="ab")
    whole = path.read_bytes()
    (tmp_path / "cut.parquet").write_bytes(whole[: len(whole) // 2])
    moved = (dataclasses.replace(frames[0], time=frames[0].time + 1.0), *frames[1:])
    import pyarrow.parquet as pq

    table = pq.read_table(save_frames(tmp_path / "moved.parquet", moved, target_sha256="ab"))
    pq.write_table(table.replace_schema_metadata(pq.read_table(path).schema.metadata), tmp_path / "moved.parquet")
    pq.write_table(table.replace_schema_metadata({}), tmp_path / "foreign.parquet")
    for name in ("cut", "moved", "foreign", "absent"):
        with pytest.raises(InspectionError) as refusal:
            load_frames(tmp_path / f"{name}.parquet")
        assert f"{name}.parquet" in str(refusal.value)
        assert "\n" not in str(refusal.value)
