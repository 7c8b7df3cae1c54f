"""`keepout audit` of flights around meshes that a scenario turns and shifts: the way over files and back."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from truths.command_line import keepout_command
from truths.messages import toy_flight

from keepout.core.audit.audit import audit
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.mission.target import load_target

ROTATION = Rotation.from_euler("zyx", [0.4, -0.3, 0.7]).as_matrix()
SCENARIO = """
name = "placed"
[target]
source = "block.stl"
units = "mm"
origin = [0.6, -0.4, 0.2]
centre_of_mass = [0.1, -0.2, 0.15]
rotation = {rotation}
"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A flight past a block whose file is in mm, turned and shifted: its folder, scenario and audit."""
    folder = tmp_path_factory.mktemp("placed")
    trimesh.creation.box((3000.0, 1000.0, 400.0)).export(folder / "block.stl")
    (folder / "mission.toml").write_text(SCENARIO.format(rotation=ROTATION.tolist()))
    tree = Scenario.load(folder / "mission.toml").model_dump(mode="json")
    scenario, record = toy_flight(tree, start=(0.0, 3.4, 0.5), goal=(1.5, 3.2, -0.5))
    flight = record.save(folder / "placed.parquet")
    for name, options in (("c.oem", ("oem",)), ("t.oem", ("oem", "--of", "target")), ("t.aem", ("aem",))):
        assert keepout_command("export", flight, "--to", *options, "-o", folder / name).code == 0
    bounds = Surroundings(scenario).flight_bounds
    own = audit(
        record, load_target(scenario.target), chaser_radius=0.5, bounds=bounds, force_limit=0.1, speed_limit=10.0
    )
    return folder, scenario, own


def audited(flown, *target):
    folder, scenario, _ = flown
    bounds = Surroundings(scenario).flight_bounds
    acceleration = np.sqrt(3) * 0.1 / 20.0 + bounds.disturbance_force / 20.0 + 20.0 * bounds.gravity_gradient
    return keepout_command(
        *("audit", *target, "--chaser", folder / "c.oem", "--target-orbit", folder / "t.oem"),
        *("--target-attitude", folder / "t.aem", "--chaser-radius", 0.5, "--acceleration-bound", acceleration),
        "--json",
    )


def placed(folder):
    return (
        *("--target", folder / "block.stl", "--target-units", "mm", "--target-origin", 0.6, -0.4, 0.2),
        *("--target-rotation", *ROTATION.ravel(), "--centre-of-mass", 0.1, -0.2, 0.15),
    )


@pytest.mark.long
@pytest.mark.parametrize("by", ["scenario", "options"])
def test_a_turned_and_shifted_mesh_is_audited_to_the_clearance_of_the_flights_own_audit(flown, by):
    folder, scenario, own = flown
    answer = audited(flown, *(["--target", folder / "mission.toml"] if by == "scenario" else placed(folder))).json
    assert answer["target_sha256"] == load_target(scenario.target).sha256
    assert answer["contact_verdict"] == str(own.contact) == "no"
    gap = 2e-3 + 2.0 * answer["assumptions"]["path_uncertainty_m"]
    assert gap < 0.01
    assert answer["minimum_clearance_m"] == pytest.approx(own.minimum_clearance, abs=gap)
