"""The map of an unknown target as the target: the skin is seen, and nothing touches it or the box within."""

import numpy as np
import pytest
from truths.boxes import box_distance

from keepout.audit.audit import Contact
from keepout.geometry.first_hit import FirstHit
from keepout.geometry.target import Target
from keepout.inspecting.inspect import inspect
from keepout.mapping.known_free import KnownFreeMap
from keepout.mapping.map_file import save
from keepout.mission.scenario import Scenario
from keepout.sensing.depth.camera import DepthCamera
from keepout.sensing.depth.depth import take
from keepout.sensing.depth.errors import ErrorDraw
from keepout.sensing.depth.pointing import axes_towards

pytestmark = pytest.mark.long

MISSION = """
name = "skin"
duration = 3500.0
target.source = "box.keepmap"
field.source = "grid"
chaser.radius = 0.4
start.position = [0.0, 5.5, 2.0]
disturbance.kind = "none"
camera.greatest_range = 6.0
inspect = {stand_off = 1.2, patch_size = 0.6, coverage = 0.8, candidates = 300}
"""


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """A map of the box, looked at from all round with errors at their bounds, and a mission that names it."""
    known = KnownFreeMap.begin(np.zeros(3), 2.9, spacing=0.2, cap=1.2, bounds=DepthCamera().bounds, name="box")
    target, generator, camera = Target.load("box"), np.random.default_rng(0), DepthCamera()
    first_hit = FirstHit(target.vertices, target.faces)
    for _ in range(60):
        direction = generator.normal(size=3)
        position = direction * (4.5 / np.linalg.norm(direction))
        axes = axes_towards(0.6 * generator.normal(size=3) - position, np.array([0.0, 0.0, 1.0]))
        known.see(take(camera, first_hit, position, axes, generator, ErrorDraw("adversarial")))
    folder = tmp_path_factory.mktemp("skin")
    save(known, folder / "box.keepmap")
    (folder / "mission.toml").write_text(MISSION)
    return folder


def test_the_skin_of_a_map_is_seen_as_a_mesh_is(mapped):
    found = inspect(Scenario.load(mapped / "mission.toml"))
    assert found.outcome in {"all seen", "80 % asked, seen"}, found.why
    assert found.coverage_seeable >= 0.79
    assert found.coverage <= found.seeable.upper + 1e-9
    assert found.audit.contact is Contact.NO
    # What was seen lies on the skin, which holds the box; what the chaser keeps from the skin it keeps from the box.
    corners = found.patches.centres[np.flatnonzero(found.seen) // 2]
    assert np.all(found.target.distance.distance(corners) < 1e-9)
    beyond = np.abs(corners) - [2.0, 1.5, 1.0]
    assert np.all(beyond.max(axis=1) > -1e-9)
    assert np.median(beyond.max(axis=1)) < 0.6
    assert box_distance(found.record.position).min() >= 1.2
    assert found.audit.minimum_clearance >= 0.8
