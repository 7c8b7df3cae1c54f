"""Map files read back bit for bit, go on as if never written, and are refused where they are damaged or of another."""

import dataclasses
import json
import math

import numpy as np
import pytest
import safetensors
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st
from truths.depth_views import Ball, axes_towards, view_of

from keepout.errors import MapError
from keepout.geometry import Target
from keepout.mapping import KnownFreeMap, Pinhole, SensorBounds, ViewStatus
from keepout.mapping.map_file import fingerprint, load, save
from keepout.mapping.map_file import settings as settings_of
from keepout.mission.assumptions import broken_assumptions
from keepout.mission.scenario import Scenario

CAMERA = Pinhole(40, 30, math.radians(60.0))
BOUNDS = SensorBounds(surely_returned_width=0.12)
BODIES = (Ball((0.1, -0.2, 0.0), 0.4),)
PLACES = [(2.0, 0.3, 0.2), (0.1, -2.2, 0.4), (-1.5, 1.2, 0.3), (0.2, 0.3, 1.9)]


def begin(name="bodies", spacing=0.1, **changes):
    given = {"cap": 3 * spacing, "bounds": BOUNDS, "speed_limit": 5.0} | changes
    return KnownFreeMap.begin(np.zeros(3), 1.0, name=name, spacing=spacing, **given)


def see(known, places):
    for place in places:
        position = np.array(place)
        view = view_of(BODIES, CAMERA, BOUNDS, position, axes_towards(-position))
        report = known.see(dataclasses.replace(view, time=float(PLACES.index(place))))
        assert report.status is ViewStatus.SEEN
    return known


def same(one, two):
    assert settings_of(one) == settings_of(two)
    assert one.bounds == two.bounds
    assert (one.broken, one.contradicting) == (two.broken, two.contradicting)
    for name in ("free", "squares", "return_keys", "origin", "_unknown"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert [(s.time, *s.position, *s.axes.flat) for s in one.seen] == [
        (s.time, *s.position, *s.axes.flat) for s in two.seen
    ]


@pytest.mark.parametrize(("limit", "places"), [(5.0, PLACES), (math.inf, PLACES), (5.0, [])])
def test_a_map_reads_back_bit_for_bit(tmp_path, limit, places):
    known = see(begin(speed_limit=limit), places)
    assert known.views == len(places)
    same(load(save(known, tmp_path / "a.keepmap"), name="bodies", spacing=0.1), known)


def test_what_was_broken_when_it_was_made_reads_back(tmp_path):
    known = see(begin(), PLACES)
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

    known = see(begin(), PLACES)
    read = load(rewritten(save(known, tmp_path / "a.keepmap"), older))
    assert np.array_equal(read.free, known.free)
    [line] = read.assumptions_broken
    assert "version 1" in line
    assert load(save(read, tmp_path / "b.keepmap")).assumptions_broken == (line,)


def test_a_resumed_map_is_the_map_that_was_never_written(tmp_path):
    whole = see(see(begin(), PLACES[:2]), PLACES[2:])
    resumed = see(load(save(see(begin(), PLACES[:2]), tmp_path / "a.keepmap")), PLACES[2:])
    same(resumed, whole)
    assert save(resumed, tmp_path / "b.keepmap").read_bytes() == save(whole, tmp_path / "c.keepmap").read_bytes()


def test_an_old_file_stays_where_a_new_one_cannot_be_written(tmp_path):
    path = save(begin(), tmp_path / "a.keepmap")
    with pytest.raises(MapError, match="cannot be written"):
        save(begin(), path / "b.keepmap")
    same(load(path), begin())


@pytest.mark.parametrize(
    ("wanted", "words"), [({"name": "hubble"}, "'bodies'.*'hubble'"), ({"spacing": 0.2}, r"0\.1 m.*0\.2 m")]
)
def test_a_map_of_something_else_is_refused(tmp_path, wanted, words):
    with pytest.raises(MapError, match=f"^[^\n]*{words}[^\n]*$"):
        load(save(begin(), tmp_path / "a.keepmap"), **wanted)


def test_endings_and_missing_files_are_said(tmp_path):
    with pytest.raises(MapError, match=r"ends in \.keepmap"):
        save(begin(), tmp_path / "a.npz")
    with pytest.raises(MapError, match="no such file"):
        load(tmp_path / "none.keepmap")
    path = tmp_path / "field.keepmap"
    path.write_bytes(safetensors.numpy.save({"a": np.zeros(3)}, {"format": "keepout-field"}))
    with pytest.raises(MapError, match="not a map file"):
        load(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return save(see(begin(), PLACES), tmp_path_factory.mktemp("map") / "whole.keepmap")


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
    refusal = ""
    try:
        read = load(path)
    except MapError as error:
        refusal = str(error)
    if refusal:
        assert refusal.startswith(f"{path}: ")
        assert "\n" not in refusal
    else:  # another white space between entries
        same(read, load(whole))


def rewritten(path, change):
    """The file again with other arrays or settings and a checksum that fits: made by someone else."""
    from keepout.mapping import map_file

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
    "no spacing": (_set("settings", "spacing", None), "misused"),
    "an endless grid": (_set("settings", "spacing", 1e-9), "spacing"),
    "settings that are a list": (_set("header", "settings", []), "misused"),
    "a later version": (_set("header", "version", 3), "version 3"),
    "a word for what was broken": (_set("header", "broken", "range"), "no list of lines"),
    "a count below zero": (_set("header", "contradicting", -1), "no list of lines"),
    "fewer cubes": (_set("tensors", "free", np.zeros(5, dtype=np.uint8)), "cubes need"),
    "no free room outside the ball": (_set("tensors", "free", np.zeros(4096, dtype=np.uint8)), "outside the declared"),
    "returns beyond the box": (_set("tensors", "returns", np.array([2**60])), "map's box"),
    "returns out of order": (_set("tensors", "returns", np.array([5, 4])), "rising order"),
    "more times than places": (_set("tensors", "times", np.zeros(3)), "3 times"),
    "a pose that is not finite": (_set("tensors", "times", np.full(4, np.nan)), "not finite"),
    "numbers of another kind": (_set("tensors", "times", np.zeros(4, dtype=np.float32)), "damaged|holds"),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_file_that_fits_its_checksum_and_not_itself_is_refused(tmp_path, case):
    change, words = FOREIGN[case]
    path = rewritten(save(see(begin(), PLACES), tmp_path / "a.keepmap"), change)
    with pytest.raises(MapError, match=words) as refusal:
        load(path)
    assert "\n" not in str(refusal.value)


def test_the_fingerprint_is_of_every_setting():
    prints = [
        fingerprint(begin()),
        fingerprint(begin(name="other")),
        fingerprint(begin(spacing=0.2)),
        fingerprint(begin(cap=0.4)),
        fingerprint(begin(speed_limit=1.0)),
        fingerprint(begin(bounds=SensorBounds())),
    ]
    assert len(set(prints)) == len(prints)
    assert fingerprint(see(begin(), PLACES)) == prints[0]
