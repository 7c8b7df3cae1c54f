"""The counts of `benchmarks/explore.py` find what is wrong when it is made wrong by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from explore_approaches import SOUND, Sensor, _World, approach
from explore_counts import SeenSurface, _meets, bad_cubes, gaps, meeting, over_statements, under_statements

from keepout.fields.field import Field
from keepout.fields.map_field import MapField
from keepout.geometry.first_hit import FirstHit
from keepout.geometry.mesh_report import Surface, describe
from keepout.geometry.target import Target
from keepout.mapping import KnownFreeMap, SensorBounds
from keepout.sensing.depth import axes_towards

HALF = np.array([0.61, 0.42, 0.33])
"""Of the box, m."""


@pytest.fixture(scope="module")
def box():
    corners = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([t for q in quads for t in ([q[0], q[1], q[2]], [q[0], q[2], q[3]])])
    surface = Surface(corners * HALF, faces)
    return Target("box", surface.vertices, surface.faces, describe(surface))


def known_round(box):
    """A map in which all cubes that do not meet the box are free."""
    known = KnownFreeMap.begin(np.zeros(3), 1.0, bounds=SensorBounds(), name="box")
    centres = known.origin + known.spacing * (np.argwhere(np.ones_like(known.free)) + 0.5)
    beyond = (np.abs(centres) - 0.5 * known.spacing > HALF).any(axis=1)
    known.fill(beyond.reshape(known.free.shape))
    return known


def clipped(triangle, half):
    """Whether a triangle and a cube round the origin meet, by cutting the triangle with its six sides in turn."""
    polygon = list(triangle)
    for axis in range(3):
        for side in (-1.0, 1.0):
            cut = []
            for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                inside, after = half - side * a[axis], half - side * b[axis]
                if inside >= 0.0:
                    cut.append(a)
                if inside * after < 0.0:
                    cut.append(a + (b - a) * inside / (inside - after))
            polygon = cut
            if not polygon:
                return False
    return True


def test_triangle_meets_cube_as_cutting_says():
    generator = np.random.default_rng(0)
    answers = []
    for _ in range(2000):
        triangle = generator.normal(size=(3, 3)) * generator.choice([0.3, 1.0, 5.0]) + generator.normal(size=3)
        answers.append(clipped(triangle, 0.5))
        assert _meets(triangle, 0.5) == answers[-1]
    assert 0.1 < np.mean(answers) < 0.9


def test_every_cube_that_meets_the_box_is_found(box):
    known = known_round(box)
    found = meeting(box, known.origin, known.spacing, np.ones_like(known.free))
    # The surface of a box in closed form: the cube reaches it, and is not wholly inside.
    centres = known.origin + known.spacing * (np.argwhere(np.ones_like(known.free)) + 0.5)
    reaches = (np.abs(centres) - 0.05 <= HALF).all(axis=1)
    within = (np.abs(centres) + 0.05 < HALF).all(axis=1)
    assert len(found) == int((reaches & ~within).sum()) > 0


def test_a_sound_map_has_no_bad_cube_and_one_made_bad_by_hand_is_found(box):
    known = known_round(box)
    assert len(bad_cubes(known, box)) == 0
    corner = np.floor((HALF - known.origin) / known.spacing).astype(int)
    known.free[tuple(corner)] = True
    assert bad_cubes(known, box).tolist() == [corner.tolist()]


class Raised(Field):
    """A field raised by hand."""

    field: Field
    by: float

    def value(self, points):
        return self.field.value(points) + self.by

    def value_and_gradient(self, points):
        value, gradient = self.field.value_and_gradient(points)
        return value + self.by, gradient

    def value_gradient_hessian(self, points):
        raise NotImplementedError


class Bump(Field):
    """A field raised within a few centimetres of one place, where no point drawn at random comes to lie."""

    field: Field
    place: jnp.ndarray

    def value(self, points):
        return self.value_and_gradient(points)[0]

    def value_and_gradient(self, points):
        value, gradient = self.field.value_and_gradient(points)
        offset = points - self.place
        bump = 0.3 * jnp.exp(-jnp.sum(offset**2, axis=-1) / (2.0 * 0.04**2))
        return value + bump, gradient - bump[..., None] * offset / 0.04**2

    def value_gradient_hessian(self, points):
        raise NotImplementedError


def test_a_sound_field_over_states_nowhere_and_one_raised_by_hand_is_found(box):
    known = known_round(box)
    field = MapField.of(known.squares, known.origin, known.spacing)
    allowed = field.evaluation_error
    sound = over_statements(field, box, known.spacing, 100_000, np.random.default_rng(0), allowed=allowed)
    assert sound.found == 0
    assert sound.random + sound.by_ascent >= 100_000
    assert 0.4 < sound.by_ascent / (sound.random + sound.by_ascent) < 0.6
    assert sound.largest_excess < 0.0
    raised = Raised(field, 0.12)
    wrong = over_statements(raised, box, known.spacing, 100_000, np.random.default_rng(0), allowed=allowed)
    assert wrong.found > 0
    assert wrong.largest_excess == pytest.approx(sound.largest_excess + 0.12, abs=0.01)


def test_a_field_raised_near_one_corner_is_found(box):
    known = known_round(box)
    field = MapField.of(known.squares, known.origin, known.spacing)
    bump = Bump(field, jnp.asarray(HALF + 0.02))
    wrong = over_statements(bump, box, known.spacing, 100_000, np.random.default_rng(1))
    assert wrong.found > 0


def test_gaps_and_under_statements_of_a_map_in_closed_form(box):
    known = known_round(box)
    foot = np.array([[HALF[0], 0.05, 0.0], [-HALF[0], 0.05, 0.0]])
    seen = SeenSurface(foot, np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    face = known.origin[0] + known.spacing * np.ceil((HALF[0] - known.origin[0]) / known.spacing)
    assert gaps(known, seen)[0] == pytest.approx(face - HALF[0], abs=1e-9)
    field = MapField.of(known.squares, known.origin, known.spacing)
    under = under_statements(field, box, seen)
    # Off a flat wall the field is nearly the distance to the cubes, which is less by the gap.
    assert under == pytest.approx(gaps(known, seen), abs=0.01)


def test_an_approach_opens_room_and_a_broken_promise_makes_cubes_bad_or_is_refused(box):
    centre, radius = np.zeros(3), 5.0
    first_hit = FirstHit(box.vertices, box.faces)
    worlds = [_World(sensor, centre, radius, 0.1, "box", 0) for sensor in (SOUND, Sensor(broken="late"))]
    before = None
    for number in range(2):
        places, aims = approach(box, centre, radius, np.random.default_rng(number), views=4)
        assert np.linalg.norm(places[0] - centre) > radius
        assert 2.0 - 1e-6 < box.distance.distance(places[-1:])[0] < 3.0 + 1e-6
        for place, aim in zip(places, aims, strict=True):
            pose = place, axes_towards(aim - place, np.array([0.0, 0.0, 1.0]))
            for world in worlds:
                world.look(first_hit, pose, before, 0.0)
            before = pose
    sound, late = (len(bad_cubes(world.known, box)) for world in worlds)
    assert worlds[0].opened > 0
    assert sound == worlds[0].refused == 0
    assert late + worlds[1].refused > 0  # a map refuses what contradicts it
