"""`benchmarks/mapping.py`: NumPy's answer to the rule and to the transform is the map's."""

import mapping
import numpy as np
import pytest

from keepout.mapping import KnownFreeMap, SensorBounds


@pytest.mark.long
def test_numpy_gives_the_same_bits():
    row = mapping.measure(radius=7.0, views=4, width=0.05, repeated=4)
    assert row["same"]
    assert row["opened_median"] > 1000
    assert row["views"] == 4


def test_numpy_frees_cubes_that_the_map_frees_and_some():
    known = KnownFreeMap.begin(np.zeros(3), 2.5, bounds=SensorBounds(), name="small")
    view = mapping.view_towards(np.array([0.0, -6.5, 0.5]), np.zeros(3), known.bounds)
    before = known.free.copy()
    freed = mapping.freed_by_numpy(known, view)
    known.open(view)
    assert len(freed) > 100
    before[tuple(freed.T)] = True
    np.testing.assert_array_equal(before, known.free)
