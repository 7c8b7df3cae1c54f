"""What became of each unit, and why: against the made-up inspection, and for any verdicts."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from truths.made_up_inspection import box_patches, made_up

from keepout.apps.inspection.inspection import Fate, fates, first_frames, shares, unseen
from keepout.apps.inspection.seeing.seeable import Hidden, Seeable, Verdict


@pytest.fixture(scope="module")
def base():
    return made_up()


def test_the_reasons_are_those_that_the_box_was_given(base):
    """-z is 12 of 52 m², half of it enclosed; of the undecided row of +z (3 of 12 m²) two ends were seen."""
    found = shares(base)
    assert found["enclosed_by_rays"] == pytest.approx(6.0 / 52.0)
    assert found["narrow_by_rays"] == pytest.approx(6.0 / 52.0)
    assert found["undecided"] == pytest.approx(1.5 / 52.0)
    assert found["seen"] == pytest.approx(base.coverage)
    assert found["shadowed"] == found["seen_beyond_proof"] == 0.0


def test_the_first_frame_is_the_first_that_holds_the_unit():
    lit = made_up(light=True)
    first = first_frames(lit)
    for unit in range(lit.patches.units):
        holding = [number for number, frame in enumerate(lit.frames) if unit in frame.units]
        assert first[unit] == (holding[0] if holding else -1)
    assert len(np.unique(first)) > 3


def test_the_list_holds_every_unit_that_was_not_seen_once_and_says_where_it_is(base):
    listed = json.loads(json.dumps(unseen(base), allow_nan=False))
    patches, areas = base.patches, base.patches.unit_areas()
    units = [2 * entry["patch"] + entry["side"] for entry in listed]
    assert sorted(units) == np.flatnonzero(patches.counted & ~base.seen).tolist()
    for unit, entry in zip(units, listed):
        np.testing.assert_allclose(entry["centre"], patches.corners[unit // 2].mean(axis=0), atol=1e-4)
        np.testing.assert_allclose(entry["normal"], patches.unit_normals()[unit], atol=1e-4)
        assert entry["area"] == pytest.approx(areas[unit])
    order = [(Fate[entry["reason"].upper()], -entry["area"]) for entry in listed]
    assert order == sorted(order)


@given(seed=st.integers(0, 2**32 - 1))
def test_whatever_the_verdicts_each_unit_has_one_fate_and_the_shares_add_up(base, seed):
    rng = np.random.default_rng(seed)
    patches = box_patches(2)
    patches = dataclasses.replace(patches, counted=np.append(True, rng.random(patches.units - 1) < 0.7))
    count = patches.units
    verdict = rng.integers(0, 3, count).astype(np.int8)
    why = np.where(verdict == Verdict.HIDDEN, rng.integers(1, 3, count), Hidden.NOT).astype(np.int8)
    possible, seen = (verdict != Verdict.HIDDEN) & (rng.random(count) < 0.5), rng.random(count) < 0.3
    seeable = Seeable(patches, verdict, why, np.full((count, 3), np.nan))
    told = dataclasses.replace(base, patches=patches, seeable=seeable, possible=possible, seen=seen)
    reasons = {
        (Verdict.SEEABLE, True): Fate.MISSED,
        (Verdict.SEEABLE, False): Fate.SHADOWED,
        (Verdict.UNDECIDED, False): Fate.UNDECIDED,
        (Verdict.UNDECIDED, True): Fate.UNDECIDED,
    }
    fate = fates(told)
    for unit in range(count):
        hidden = Fate.ENCLOSED_BY_RAYS if why[unit] == Hidden.ENCLOSED else Fate.NARROW_BY_RAYS
        expected = reasons.get((Verdict(verdict[unit]), bool(possible[unit])), hidden)
        expected = Fate.SEEN if seen[unit] else expected
        assert fate[unit] == (expected if patches.counted[unit] else Fate.NOT_COUNTED)
    found = shares(told)
    assert sum(found[kind.name.lower()] for kind in Fate if kind != Fate.NOT_COUNTED) == pytest.approx(1.0)
    assert len(unseen(told)) == (patches.counted & ~seen).sum()
