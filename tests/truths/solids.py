"""Bodies of known exterior, as meshes with flipped and repeated faces, and what must hold of their offset solids."""

import numpy as np
import trimesh

from keepout.geometry import ExactDistance, OffsetSolid

QUERIES = 40_000


def boxes_mesh(boxes):
    parts = [
        trimesh.creation.box(
            extents=np.subtract(b, a), transform=trimesh.transformations.translation_matrix(np.add(a, b) / 2)
        )
        for a, b in boxes
    ]
    mesh = trimesh.util.concatenate(parts)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def distance_to_box(points, lower, upper):
    """Signed distance to a solid box, closed form."""
    q = np.maximum(np.subtract(lower, points), np.subtract(points, upper))
    return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)


def spoil(faces, seed):
    """Flip 5 % of the faces and repeat 50 of them."""
    rng = np.random.default_rng(seed)
    faces = faces.copy()
    flipped = rng.random(len(faces)) < 0.05
    faces[flipped] = faces[flipped][:, ::-1]
    return np.concatenate([faces, faces[rng.integers(len(faces), size=50)]])


def around(distance, seed, count=QUERIES):
    """Half uniform in the padded box, half within 0.15 m of the surface."""
    rng = np.random.default_rng(seed)
    uniform = rng.uniform(distance.lower - 1.0, distance.upper + 1.0, size=(count // 2, 3))
    seeds = rng.uniform(distance.lower - 0.2, distance.upper + 0.2, size=(count - count // 2, 3))
    _, closest, _ = distance.closest(seeds)
    return np.concatenate([uniform, closest + rng.normal(size=closest.shape) * 0.06])


def assert_sound(solid, points, exterior):
    """No false-free point, in the flag and in the sign."""
    free = solid.is_exterior(points)
    signed = solid.signed_distance(points)
    assert not (free & ~exterior).any()
    assert not ((signed > 0.0) & ~exterior).any()
    np.testing.assert_array_equal(free, signed > 0.0)
    d = solid.distance.distance(points)
    assert (signed <= d - solid.offset + 1e-12).all()
    return free


def assert_lipschitz(solid, points, seed):
    """No step changes the signed distance by more than its own length."""
    rng = np.random.default_rng(seed)
    before = solid.signed_distance(points)
    for length in (1e-3, 0.05, 1.0):
        step = rng.normal(size=points.shape)
        step *= length / np.linalg.norm(step, axis=1, keepdims=True)
        assert np.abs(solid.signed_distance(points + step) - before).max() <= length + 1e-9


def solid_angle(target, points):
    """Solid angle under which each point sees a mesh: 4π inside one that is closed and oriented, 0 outside."""
    total = np.zeros(len(points))
    for number, point in enumerate(points):
        a, b, c = np.moveaxis(target.vertices[target.faces] - point, 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        top = (a * np.cross(b, c)).sum(1)
        bottom = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        total[number] = 2.0 * np.arctan2(top, bottom).sum()
    return total


def hollow_box(half_hole):
    """A sheet box of half side 1.5 m with a square hole in its top, as loose triangles."""
    half = 1.5
    vertices, faces = boxes_mesh([((-half, -half, -half), (half, half, half))])
    top = (vertices[faces][:, :, 2] == half).all(axis=1)
    faces = faces[~top]
    outer = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    inner = outer * half_hole / half
    corners = np.concatenate([np.column_stack([ring, np.full(4, half)]) for ring in (outer, inner)])
    ring = np.array([t for i in range(4) for t in ((i, (i + 1) % 4, 4 + i), ((i + 1) % 4, 4 + (i + 1) % 4, 4 + i))])
    return np.concatenate([vertices, corners]), np.concatenate([faces, ring + len(vertices)]), half


def check_nested_shells_are_solid():
    """Closed shells within closed shells: all that is within the outermost is solid."""
    shells = [((-r, -r, -r), (r, r, r)) for r in (2.0, 1.4, 0.6)]
    vertices, faces = boxes_mesh(shells)
    solid = OffsetSolid.build(ExactDistance(vertices, spoil(faces, 2)))
    points = around(solid.distance, 6)
    truth = distance_to_box(points, *shells[0])
    free = assert_sound(solid, points, truth > solid.offset)
    assert free[truth > solid.offset + 1e-9].all()
    assert abs(solid.sealed_volume - 64.0) < 0.05 * 64.0


def check_a_narrow_hole_is_sealed(half_hole, **options):
    """A box with a hole that the chaser cannot pass is solid; returns the solid and the box's half side."""
    vertices, faces, half = hollow_box(half_hole)
    solid = OffsetSolid.build(ExactDistance(vertices, spoil(faces, 3)), **options)
    points = around(solid.distance, 7)
    inside = (np.abs(points) < half).all(axis=1)
    mouth = inside & (np.abs(points[:, :2]).max(axis=1) < half_hole) & (points[:, 2] > half - half_hole)
    d = solid.distance.distance(points)
    free = assert_sound(solid, points, (d > solid.offset) & (~inside | mouth))
    assert free[~inside & (d > 0.3)].all()
    return solid, half
