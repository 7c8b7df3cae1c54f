"""What a page's replay is drawn from."""

import base64

import numpy as np
from scipy.spatial import ConvexHull

from keepout.report.page import _packed, _sphere


def test_the_ball_of_a_replay_is_closed():
    vertices, faces = _sphere()
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0)
    hull = {tuple(sorted(face)) for face in ConvexHull(vertices).simplices.tolist()}
    assert {tuple(sorted(face)) for face in faces.tolist()} == hull
    assert len(faces) == len(hull)


def test_arrays_are_packed_with_all_their_bits():
    for array, kind in ((np.array([0.1, -1e300]), "f8"), (np.array([0, 65535]), "u2"), (np.array([0, 65536]), "u4")):
        packed = _packed(array)
        assert packed["dtype"] == kind
        assert np.array_equal(np.frombuffer(base64.b64decode(packed["bdata"]), f"<{kind}"), array)
