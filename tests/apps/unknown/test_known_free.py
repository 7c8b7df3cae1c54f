"""The map as a whole: what it refuses, that order does not matter, that it only grows, and what it takes."""

import dataclasses
import itertools
import json
import math
import tracemalloc

import numpy as np
import pytest
import safetensors
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st
from truths.depth_views import Ball, Box, axes_towards, cube_centres, view_of

from keepout.apps.led.camera import Pinhole
from keepout.apps.unknown import map_file
from keepout.apps.unknown.distance_transform import squares_of
from keepout.apps.unknown.known_free import KnownFreeMap, ViewStatus
from keepout.apps.unknown.map_file import fingerprint, load, save
from keepout.apps.unknown.map_file import settings as file_settings
from keepout.apps.unknown.view import SensorBounds, View
from keepout.core.errors import KeepoutError, MapError
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import broken_assumptions

CAMERA = Pinhole(40, 30, math.radians(60.0))
BOUNDS = SensorBounds(surely_returned_width=0.12)
BODIES = (Ball((0.1, -0.2, 0.0), 0.4), Box((0.3, 0.0, -0.5), (0.5, 0.6, 0.4)))


def begin(**changes):
    given = {"spacing": 0.1, "cap": 0.3, "bounds": BOUNDS, "name": "bodies"} | changes
    return KnownFreeMap.begin(np.zeros(3), 1.0, **given)


def view_from(position, time=0.0):
    position = np.asarray(position, dtype=float)
    view = view_of(BODIES, CAMERA, BOUNDS, position, axes_towards(-position))
    return dataclasses.replace(view, time=time)


PLACES = [(2.0, 0.3, 0.2), (0.1, -2.2, 0.4), (-1.5, 1.2, 0.3), (0.2, 0.3, 1.9)]


def bits(known):
    """All that a map holds, for comparison."""
    return (
        known.free.tobytes(),
        known.squares.tobytes(),
        known.returned.keys.tobytes(),
        known._unknown.tobytes(),
        [(seen.time, seen.position.tobytes(), seen.axes.tobytes()) for seen in known.seen],
    )


def changed(view, **entries):
    return dataclasses.replace(view, **entries)


def with_pixel(view, value):
    ranges = view.ranges.copy()
    ranges[3, 4] = value
    return changed(view, ranges=ranges)


FAR = view_from((2.0, 0.3, 0.2))
REFUSED = {
    "from unknown room": (view_from((0.0, 0.0, 0.9)), ViewStatus.FROM_UNKNOWN),
    "a jump": (view_from((-2.0, 0.3, 0.2), time=1.0), ViewStatus.POSE_JUMP),
    "no place": (changed(FAR, position=np.array([np.nan, 0.0, 2.0])), ViewStatus.NOT_FINITE),
    "no time": (changed(FAR, time=math.nan), ViewStatus.NOT_FINITE),
    "axes that are no rotation": (changed(FAR, axes=1.01 * FAR.axes), ViewStatus.NOT_FINITE),
    "mirrored axes": (changed(FAR, axes=FAR.axes * [1.0, 1.0, -1.0]), ViewStatus.NOT_FINITE),
    "a range below zero": (with_pixel(FAR, -0.1), ViewStatus.NOT_FINITE),
    "nothing said": (changed(FAR, ranges=np.full(CAMERA.shape, np.nan)), ViewStatus.EMPTY),
}


@pytest.mark.long
@pytest.mark.parametrize("case", REFUSED)
def test_a_refused_view_leaves_the_map_as_it_was(case):
    view, status = REFUSED[case]
    known = begin(speed_limit=0.5)
    known.see(view_from((2.1, 0.3, 0.2), time=0.5))
    before = bits(known)
    report = known.see(view)
    assert (report.status, report.opened) == (status, 0)
    assert bits(known) == before


@pytest.mark.long
def test_a_view_is_no_jump_as_far_as_speed_and_pose_error_explain_or_in_another_flight():
    known = begin(speed_limit=0.5)
    known.see(view_from((2.0, 0.0, 0.0), time=10.0))
    step = 0.5 * 2.0 + 2.0 * BOUNDS.position_error
    assert known.see(view_from((2.0, step + 0.001, 0.0), time=12.0)).status is ViewStatus.POSE_JUMP
    assert known.see(view_from((2.0, step - 0.001, 0.0), time=12.0)).status is ViewStatus.SEEN
    known.begin_flight()
    assert known.see(view_from((2.0, -2.0, 0.0), time=0.0)).status is ViewStatus.SEEN
    assert known.see(view_from((2.0, 2.0, 0.0), time=1.0)).status is ViewStatus.POSE_JUMP


def test_every_order_of_views_gives_the_same_map():
    views = [view_from(place, float(time)) for time, place in enumerate(PLACES)]
    maps = set()
    for order in itertools.permutations(views):
        known = begin()
        assert all(known.see(view).status is ViewStatus.SEEN for view in order)
        maps.add(bits(known)[:4])
    assert len(maps) == 1


def test_the_map_only_grows_and_a_view_seen_again_changes_nothing():
    known = begin()
    for place in PLACES:
        free, squares = known.free.copy(), known.squares.copy()
        report = known.see(view_from(place))
        assert report.opened == (known.free & ~free).sum() > 0
        assert not (free & ~known.free).any()
        assert (known.squares >= squares).all()
        np.testing.assert_array_equal(known.squares, squares_of(known.free, 3))
    before = bits(known)
    assert known.see(view_from(PLACES[0])).opened == 0
    assert bits(known)[:4] == before[:4]


def test_before_the_first_view_the_cubes_that_meet_the_ball_are_unknown():
    known = begin()
    gap = np.maximum(np.abs(cube_centres(known)) - 0.05, 0.0)
    # Cubes that only touch the ball count as meeting it.
    np.testing.assert_array_equal(known.free, (gap**2).sum(axis=-1) > 1.0 + 1e-9)
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.2], [50.0, 0.0, 0.0], [0.0, 0.99, 0.0]])
    np.testing.assert_array_equal(known.is_free(points), [False, True, True, False])
    assert known.views == len(known.returns) == 0


def test_returns_lie_on_the_bodies_and_each_place_counts_once():
    known = begin()
    for place in (*PLACES, *PLACES):
        known.see(view_from(place))
    points = known.returns
    assert points.dtype == np.float32
    assert len(np.unique(points, axis=0)) == len(points) > 100
    to_ball = np.abs(np.linalg.norm(points - np.array(BODIES[0].centre), axis=1) - 0.4)
    low, high = np.array(BODIES[1].lower), np.array(BODIES[1].upper)
    outside = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)
    # A pixel's middle ray at the range of its first ray, on a lattice of 0.025 m.
    assert np.quantile(np.minimum(to_ball, outside), 0.9) < 0.05


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: begin(spacing=0.001, cap=0.003), "spacing"),
        (lambda: begin(cap=0.25), "cap"),
        (lambda: begin(cap=6.5), "64 whole spacings"),
        (lambda: begin(speed_limit=0.0), "speed_limit"),
        (lambda: KnownFreeMap.begin(np.full(3, np.nan), 1.0, bounds=BOUNDS, name="t"), "centre"),
        (lambda: KnownFreeMap.begin(np.zeros(3), -1.0, bounds=BOUNDS, name="t"), "radius"),
        (lambda: SensorBounds(range_error=-0.1), "range_error.* -0.1"),
        (lambda: SensorBounds(least_range=2.0, greatest_range=1.0), "greatest_range"),
        (lambda: SensorBounds(rays_across=0), "rays_across"),
        (lambda: Pinhole(10, 10, math.pi), "horizontal_angle"),
        (lambda: View(CAMERA, np.zeros(3), np.eye(3), np.zeros((40, 30))), r"\(30, 40\)"),
    ],
)
def test_numbers_out_of_range_are_refused_by_name(make, named):
    with pytest.raises(KeepoutError, match=named) as refusal:
        make()
    assert "\n" not in str(refusal.value)


@pytest.mark.long
def test_a_map_of_a_thirty_metre_target_takes_less_than_250_megabytes():
    camera = Pinhole(160, 120, math.radians(60.0))
    bodies = (Ball((0.0, 0.0, 0.0), 12.0),)
    tracemalloc.start()
    try:
        known = KnownFreeMap.begin(np.zeros(3), 15.0, bounds=SensorBounds(), name="large")
        for position in (np.array([16.0, 0.0, 0.0]), np.array([0.0, 16.5, 3.0])):
            view = view_of(bodies, camera, known.bounds, position, axes_towards(-position))
            assert known.see(view).opened > 10_000
        held, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(known.free) >= 330
    # What is traced is at least what the two large arrays hold.
    assert known.free.nbytes + known.squares.nbytes < held < most < 250e6


# --- Files: read back bit for bit, gone on with as if never written, refused where they are damaged or of another -----


def saw(places=PLACES, known=None):
    """A map after these views."""
    known = begin(speed_limit=5.0) if known is None else known
    for place in places:
        assert known.see(view_from(place, float(PLACES.index(place)))).status is ViewStatus.SEEN
    return known


def same(one, two):
    assert file_settings(one) == file_settings(two)
    assert one.bounds == two.bounds
    assert (one.broken, one.contradicting) == (two.broken, two.contradicting)
    for name in ("free", "squares", "returns", "origin", "_unknown"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert [(s.time, *s.position, *s.axes.flat) for s in one.seen] == [
        (s.time, *s.position, *s.axes.flat) for s in two.seen
    ]


@pytest.mark.parametrize(("limit", "places"), [(5.0, PLACES), (math.inf, PLACES), (5.0, [])])
def test_a_map_reads_back_bit_for_bit(tmp_path, limit, places):
    known = saw(places, begin(speed_limit=limit))
    assert known.views == len(places)
    same(load(save(known, tmp_path / "a.keepmap"), name="bodies", spacing=0.1), known)


def test_what_was_broken_when_it_was_made_reads_back(tmp_path):
    known = saw()
    known.broken, known.contradicting = ("depth_sensor.broken pose", "a wire"), 7
    read = load(save(known, tmp_path / "a.keepmap"))
    same(read, known)
    assert "map: a wire" in read.assumptions_broken
    assert any("7 returns" in line for line in read.assumptions_broken)
    broken = Target.load(tmp_path / "a.keepmap").broken
    assert broken == read.assumptions_broken
    assert set(broken) <= set(broken_assumptions(Scenario(), Target.load(tmp_path / "a.keepmap")))


def test_a_file_of_version_1_says_nothing_and_that_is_said(tmp_path):
    def older(header, tensors):
        header["version"] = 1
        del header["broken"], header["contradicting"]

    known = saw()
    read = load(rewritten(save(known, tmp_path / "a.keepmap"), older))
    assert np.array_equal(read.free, known.free)
    [line] = read.assumptions_broken
    assert "version 1" in line
    assert load(save(read, tmp_path / "b.keepmap")).assumptions_broken == (line,)


def test_a_resumed_map_is_the_map_that_was_never_written(tmp_path):
    whole = saw(PLACES)
    resumed = saw(PLACES[2:], load(save(saw(PLACES[:2]), tmp_path / "a.keepmap")))
    same(resumed, whole)
    assert save(resumed, tmp_path / "b.keepmap").read_bytes() == save(whole, tmp_path / "c.keepmap").read_bytes()


def test_a_map_of_something_else_and_what_is_no_map_file_are_refused(tmp_path):
    path = save(begin(), tmp_path / "a.keepmap")
    for wanted, words in (({"name": "hubble"}, "'bodies'.*'hubble'"), ({"spacing": 0.2}, r"0\.1 m.*0\.2 m")):
        with pytest.raises(MapError, match=f"^[^\n]*{words}[^\n]*$"):
            load(path, **wanted)
    with pytest.raises(MapError, match=r"ends in \.keepmap"):
        save(begin(), tmp_path / "a.npz")
    path.write_bytes(safetensors.numpy.save({"a": np.zeros(3)}, {"format": "keepout-field"}))
    with pytest.raises(MapError, match="not a map file"):
        load(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return save(saw(), tmp_path_factory.mktemp("map") / "whole.keepmap")


@given(data=st.data())
def test_damage_is_refused_in_one_line_or_changes_nothing(whole, data):
    damaged = bytearray(whole.read_bytes())
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(damaged) - 1)) :]
    else:
        place = data.draw(st.integers(0, len(damaged) - 1) | st.integers(0, 1500))
        damaged[place] ^= data.draw(st.integers(1, 255))
    path = whole.with_name("damaged.keepmap")
    path.write_bytes(damaged)
    refusal = f"{path}: "
    try:
        same(load(path), load(whole))  # another white space between entries
    except MapError as error:
        refusal = str(error)
    assert refusal.startswith(f"{path}: ")
    assert "\n" not in refusal


def rewritten(path, change):
    """The file again with other arrays or settings and a checksum that fits: made by someone else."""
    with safetensors.safe_open(path, framework="numpy") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = file.metadata()
    header = json.loads(json.loads(metadata["keepout-map"])["header"])
    change(header, tensors)
    text = json.dumps(header)
    envelope = json.dumps({"sha256": map_file._digest(text, tensors), "header": text})
    path.write_bytes(safetensors.numpy.save(tensors, {"keepout-map": envelope}))
    return path


def _set(place, key, value):
    def change(header, tensors):
        (header["settings"] if place == "settings" else header if place == "header" else tensors)[key] = value

    return change


FOREIGN = {
    "another ball under the old fingerprint": (_set("settings", "radius", 2.0), "fingerprint"),
    "an endless grid": (_set("settings", "spacing", 1e-9), "spacing"),
    "a later version": (_set("header", "version", 3), "version 3"),
    "a word for what was broken": (_set("header", "broken", "range"), "no list of lines"),
    "fewer cubes": (_set("tensors", "free", np.zeros(5, dtype=np.uint8)), "cubes need"),
    "no free room outside the ball": (_set("tensors", "free", np.zeros(4096, dtype=np.uint8)), "outside the declared"),
    "returns beyond the box": (_set("tensors", "returns", np.array([2**60])), "map's box"),
    "more times than places": (_set("tensors", "times", np.zeros(3)), "3 times"),
    "a pose that is not finite": (_set("tensors", "times", np.full(4, np.nan)), "not finite"),
    "numbers of another kind": (_set("tensors", "times", np.zeros(4, dtype=np.float32)), "damaged|holds"),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_file_that_fits_its_checksum_and_not_itself_is_refused(tmp_path, case):
    change, words = FOREIGN[case]
    path = rewritten(save(saw(), tmp_path / "a.keepmap"), change)
    with pytest.raises(MapError, match=words) as refusal:
        load(path)
    assert "\n" not in str(refusal.value)


def test_the_fingerprint_is_of_every_setting():
    changes = ({"name": "other"}, {"spacing": 0.15}, {"cap": 0.4}, {"speed_limit": 1.0}, {"bounds": SensorBounds()})
    prints = {fingerprint(begin()), *(fingerprint(begin(**change)) for change in changes)}
    assert len(prints) == 1 + len(changes)
    assert fingerprint(saw(known=begin())) == fingerprint(begin())
