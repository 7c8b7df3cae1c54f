"""A field learned from a map, and a flight by it around what only the map knows; the truth is the box's own."""

import numpy as np
import pytest
from truths.boxes import HALF, box_distance
from truths.command_line import keepout_command

from keepout.audit.audit import Contact, audit
from keepout.errors import FieldError
from keepout.fields.evaluate import values
from keepout.fields.model import FieldModel
from keepout.geometry.first_hit import FirstHit
from keepout.geometry.target import Target
from keepout.mapping.known_free import KnownFreeMap
from keepout.mapping.map_file import load, save
from keepout.mission import environment
from keepout.mission.build import prepare
from keepout.mission.flight import fly
from keepout.mission.scenario import Scenario
from keepout.sensing.depth.camera import DepthCamera
from keepout.sensing.depth.depth import take
from keepout.sensing.depth.errors import ErrorDraw
from keepout.sensing.depth.pointing import axes_towards

pytestmark = [pytest.mark.xdist_group("learned-map"), pytest.mark.long]

RADIUS = 0.5
MISSION = """
name = "mapped"
duration = 260.0
target.source = "box.keepmap"
field.source = "box.keepout"
start.position = [0.0, 4.5, 1.5]
goal.position = [0.5, -4.0, -1.5]
"""


def seen_from(known: KnownFreeMap, views: int, seed: int) -> None:
    """Look at the box from all round at adversarial errors."""
    target, generator, camera = Target.load("box"), np.random.default_rng(seed), DepthCamera()
    first_hit = FirstHit(target.vertices, target.faces)
    for _ in range(views):
        direction = generator.normal(size=3)
        position = direction * (4.5 / np.linalg.norm(direction))
        axes = axes_towards(0.6 * generator.normal(size=3) - position, np.array([0.0, 0.0, 1.0]))
        known.see(take(camera, first_hit, position, axes, generator, ErrorDraw("adversarial")))


@pytest.fixture(scope="module")
def known() -> KnownFreeMap:
    """A map of the box."""
    made = KnownFreeMap.begin(np.zeros(3), 2.9, spacing=0.1, cap=1.2, bounds=DepthCamera().bounds, name="box")
    seen_from(made, 60, 0)
    return made


@pytest.fixture(scope="module")
def place(tmp_path_factory, known):
    folder = tmp_path_factory.mktemp("learned-map")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KEEPOUT_CACHE", str(folder / "cache"))
        patch.chdir(folder)
        (folder / "mission.toml").write_text(MISSION, encoding="utf-8")
        save(known, folder / "box.keepmap")
        yield folder


@pytest.fixture(scope="module")
def fitted(place):
    options = ("--profile", "quick", "--certify", "--chaser-radius", RADIUS, "--json")
    return keepout_command("fit", "box.keepmap", "-o", "box.keepout", *options).json


def test_the_map_left_room_and_holds_the_box(known):
    assert (~known.free).sum() * known.spacing**3 < 2.2 * float(np.prod(2.0 * HALF))
    points = np.random.default_rng(0).uniform(-HALF, HALF, (20_000, 3))
    assert not known.is_free(points).any()


def test_a_map_file_is_fitted_and_certified_against_its_own_obstacle(place, fitted):
    certificate = fitted["certificate"]
    assert certificate["kind"] == "certified"
    assert certificate["chaser_radius_m"] == RADIUS
    assert certificate["sampled_maximum_m"] <= certificate["error_bound_m"] < 0.3
    obstacle = Target.load(place / "box.keepmap")
    assert certificate["target_sha256"] == fitted["target_sha256"] == obstacle.sha256
    model = FieldModel.load(place / "box.keepout", target=obstacle)
    # What the certificate is for: where a chaser would touch the box itself, the field claims its keep-out zone.
    points = np.random.default_rng(1).uniform(-HALF - RADIUS, HALF + RADIUS, (50_000, 3))
    touching = points[box_distance(points) <= RADIUS]
    assert values(model.field, touching).max() <= RADIUS + certificate["error_bound_m"]


def test_a_flight_by_map_and_field_reaches_its_goal_and_does_not_touch_the_box(place, fitted):
    scenario = Scenario.load(place / "mission.toml")
    flight = fly(scenario)
    assert flight.audit.contact is Contact.NO
    assert flight.outcome.reached
    assert flight.start_certified
    truth = audit(
        flight.record,
        Target.load("box"),
        chaser_radius=RADIUS,
        bounds=environment.flight_bounds(scenario),
        force_limit=scenario.chaser.force_limit,
        speed_limit=scenario.chaser.speed_limit,
    )
    assert truth.contact is Contact.NO
    # The map's obstacle holds the box, so the box is farther away.
    assert truth.minimum_clearance >= flight.audit.minimum_clearance - 1e-3


def test_a_field_is_refused_for_the_map_that_has_grown_since(place, fitted, known):
    grown = KnownFreeMap.begin(np.zeros(3), 2.9, spacing=0.1, cap=1.2, bounds=DepthCamera().bounds, name="box")
    grown.fill(known.free.copy())
    seen_from(grown, 20, 1)
    assert grown.free.sum() > known.free.sum()
    save(grown, place / "grown.keepmap")
    with pytest.raises(FieldError, match="another target"):
        FieldModel.load(place / "box.keepout", target=Target.load(place / "grown.keepmap"))


def test_a_mission_by_a_map_that_was_made_under_a_broken_sensor_says_so(place, fitted, known):
    told = load(save(known, place / "told.keepmap"))
    told.broken, told.contradicting = ("depth_sensor.broken pose",), 3
    mission = prepare(Scenario.load("mission.toml"), target=Target.load(save(told, place / "told.keepmap")))
    assert mission.assumptions_broken == told.assumptions_broken
    assert len(mission.assumptions_broken) == 2
    assert mission.start_certified is False
    assert prepare(Scenario.load("mission.toml")).start_certified is True
