"""Every command, succeeding, as a program calls it: in a process of its own, with strict JSON on standard output.

`make test` compiles what they fly as quickly as it can, `make test-all` as users have it.

One small mission is fitted, certified and flown, and what comes after reads the files that this left. The truths are
the box's closed forms, and what the files say when read without the code that wrote them.
"""

import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
from truths.boxes import HALF, box_distance, contact_with_box
from truths.command_line import keepout_command, keepout_process, told_by_process
from truths.replay_page import ReplayPage
from truths.results import Page, check_picture

import keepout
from keepout.apps.inspection.frames import coverage_of_files
from keepout.apps.led.camera import axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown import equipment, map_file
from keepout.apps.unknown.depth_sensor import ErrorDraw, take
from keepout.cli.options import ORDER
from keepout.core.audit.audit import Audit, audit
from keepout.core.compiled.kept_programs import VARIABLE
from keepout.core.fields.field import values
from keepout.core.fields.model import FieldModel
from keepout.core.flight.record import FlightRecord
from keepout.core.geometry.builtin import BUILTINS
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.flights.pages.page import shown
from keepout.flights.pages.terminal import FLIGHT_COLUMNS

pytestmark = pytest.mark.long

README = Path(__file__).parents[1] / "README.md"

RADIUS = 0.5
START, GOAL, SECONDS = (0.0, 10.0, 6.0), (0.0, -10.0, -4.0), 500
"""Those of README, so that one compiled program serves both."""
MISSION = f"""
name = "boxed"
duration = {SECONDS}.0
target.source = "box"
field.source = "box.keepout"
start.position = {list(START)}
goal.position = {list(GOAL)}
"""
QUARTER_TURN = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
TURNED = f"""
target = {{source = "box", rotation = {QUARTER_TURN}}}
field.source = "second.keepout"
chaser.radius = 0.4
"""
"""A mission whose field is not there yet."""
RUNS = 3
DRAWN = f"""
name = "drawn"
duration = 20.0
target.source = "box"
field.source = "grid"
chaser.radius = {RADIUS}
start.position = [0.0, 5.0, 2.0]
goal.position = [0.0, -5.0, 2.0]
control.guidance = "straight"
guard.enabled = false
faults.position_noise_std = 0.05
campaign.runs = {RUNS}
campaign.dispersions = {{"chaser.mass" = {{uniform = [18.0, 22.0]}}}}
"""
EXPLORE = f"""
name = "unknown"
duration = 60.0
target.source = "box"
guard.enabled = false
explore = {{towards = "goal", most_views = 4}}
map = {{file = "kept.keepmap", radius = 6.0, spacing = 0.2}}
depth_sensor = {{width = 40, height = 30, period = 10.0}}
chaser.radius = {RADIUS}
start.position = [0.0, 8.0, 2.0]
goal.position = [0.0, 4.0, 2.0]
"""
INSPECT = f"""
name = "look"
duration = 60.0
target.source = "box"
field.source = "grid"
chaser.radius = {RADIUS}
disturbance.kind = "none"
camera.greatest_range = 6.0
guard.enabled = false
start.position = [0.0, 5.0, 2.0]
inspect = {{stand_off = 1.2, patch_size = 1.0, coverage = 0.5, candidates = 100, proof_time = 0.5}}
zone = [{{name = "beam", shape = "sphere", centre = [0.0, 0.0, 12.0], radius = 2.0}}]
"""
FEW = {"width": 16, "depth": 2, "samples": 4000, "batch": 400, "steps": 250, "tuning_steps": 50, "polish_steps": 50}
"""A fit of seconds; tests/core/proof/test_certificate.py says how good a fit is."""
ROUGH = f"""
from dataclasses import replace
from keepout.core.learning.losses import PROFILES
PROFILES["quick"] = replace(PROFILES["quick"], **{FEW})
from keepout.cli import main
main()
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("commands")
    files = {"mission": MISSION, "turned": TURNED, "drawn": DRAWN, "explore": EXPLORE, "inspect": INSPECT}
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("COLUMNS", "80")
        # As a user has it: a command takes the programs and surfaces that another one made, from a folder of its own.
        patch.setenv("JAX_COMPILATION_CACHE_DIR", "")
        patch.setenv(VARIABLE, str(folder / "kept"))
        yield folder


COARSE = """
from keepout.flights.pages import drawn
drawn._CELLS_ALONG //= 2
from keepout.cli import main
main()
"""
"""Surfaces with a quarter of the triangles that a page has, as `coarse_surfaces` has them in this process."""
CHOSEN = ("--profile", "quick", "--batch", 384)
FIT = ("fit", "box", "-o", "box.keepout", *CHOSEN, "--chaser-radius", RADIUS, "--certify", "--json")


@pytest.fixture(scope="module")
def fitted(folder):
    return keepout_process(folder, *FIT, program=ROUGH)


@pytest.fixture(scope="module")
def flown(folder, fitted):
    return keepout_process(folder, "fly", "mission.toml", "-o", "flight", "--json", program=COARSE)


@pytest.fixture(scope="module")
def campaign(folder):
    return keepout_process(folder, "campaign", "drawn.toml", "-o", "many", "--keep", "all", "--json", program=COARSE)


def written(folder: Path) -> Any:
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def judged(record: Any, scenario: Scenario) -> Audit:
    """Audit one flight around the box by the numbers of its scenario."""
    bounds, limits = Surroundings(scenario).flight_bounds, scenario.chaser
    limits = {"force_limit": limits.force_limit, "speed_limit": limits.speed_limit}
    return audit(record, Target.load("box"), chaser_radius=RADIUS, bounds=bounds, **limits)


def test_every_command_is_here():
    text = Path(__file__).read_text(encoding="utf-8")
    assert len(ORDER) == 16
    for command in ORDER:
        assert f'"{command}", ' in text


TWO_TARGETS = """
from keepout.core.geometry import builtin
builtin.BUILTINS = {name: builtin.BUILTINS[name] for name in ("box", "sphere")}
from keepout.cli import main
main()
"""


def test_the_installed_command_lists_the_targets_and_pictures_are_drawn(folder):
    script = shutil.which("keepout", path=str(Path(sys.executable).parent))
    assert script is not None
    command = [script, "targets", "--json"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    rows = {row["name"]: row for row in json.loads(done.stdout)["targets"]}
    assert list(rows) == list(BUILTINS)
    assert rows["box"]["extents_m"] == pytest.approx(list(2.0 * HALF))
    assert rows["box"]["volume_m3"] == pytest.approx(float(np.prod(2.0 * HALF)))
    assert (rows["intelsat30"]["shipped_field"], rows["box"]["shipped_field"]) == (True, False)
    told = keepout_process(folder, "targets", "--pictures", "pictures", "--json", program=TWO_TARGETS)
    assert [row["picture"] for row in told["targets"]] == ["pictures/box.png", "pictures/sphere.png"]
    for name in ("box", "sphere"):
        check_picture(folder / "pictures" / f"{name}.png")


def test_the_module_runs_as_a_program():
    command = [sys.executable, "-m", "keepout.cli", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == f"keepout {keepout.__version__}\n"


def test_describe(folder):
    summary = keepout_process(folder, "describe", "turned.toml", "-o", "mesh", "--json")
    assert (summary["watertight"], summary["triangles"], summary["warnings"]) == (True, 12, [])
    assert summary["extents"] == pytest.approx(list(2.0 * HALF[[1, 0, 2]]))
    check_picture(folder / "mesh" / "box.png")


def test_scenario(folder):
    assert (
        keepout_process(folder, "scenario", "new", "--for", "box", "-o", "new.toml", "--json")["scenario"] == "new.toml"
    )
    assert keepout_process(folder, "scenario", "check", "drawn.toml", "--json")["flies"] is True
    assert keepout_process(folder, "scenario", "schema")["title"] == "Keepout scenario"


def test_a_fit_is_certified_in_the_same_command_and_no_search_beats_it(folder, fitted):
    model = FieldModel.load(folder / fitted["field"], target=Target.load("box"))
    assert {path.name for path in folder.glob("box*")} == {"box.keepout"}
    assert fitted["target_sha256"] == model.target_sha256
    assert fitted["profile"] == "quick"
    assert model.training["numbers"]["batch"] == 384
    assert fitted["ended"] == model.training["ended"] == "steps"
    [certificate] = model.certificates
    said = fitted["certificate"]
    assert (said["kind"], certificate.kind) == ("certified", "certified")
    assert (said["chaser_radius_m"], said["error_bound_m"]) == (RADIUS, certificate.error_bound)
    worst = float((values(model.field, contact_with_box(100_000, RADIUS)) - RADIUS).max())
    assert certificate.error_bound - 0.05 < worst <= certificate.error_bound


def test_a_fit_begins_with_another_field_and_ends_at_the_bound(folder, fitted):
    command = ("fit", "turned.toml", "-o", "second.keepout", *CHOSEN, "--from", "box.keepout", "--until-bound", 10.0)
    said = keepout_process(folder, *command, "--at-most", 600, "--json", program=ROUGH)
    turned = Target.load("box", rotation=QUARTER_TURN)
    training = FieldModel.load(folder / "second.keepout", target=turned).training
    assert training["chaser_radius"] == 0.4
    assert said["ended"] == training["ended"] == "bound"
    assert said["sampled_maximum_m"] <= 10.0
    numbers = [training["numbers"][name] for name in ("steps", "tuning_steps", "polish_steps", "polish_round")]
    assert numbers == [0, 250, 100, 100]


def test_certify_adds_another_certificate(folder, fitted):
    shutil.copy(folder / "box.keepout", folder / "two.keepout")
    said = keepout_process(folder, "certify", "two.keepout", "--chaser-radius", "0.0", "--json")
    first, second = FieldModel.load(folder / "two.keepout").certificates
    assert {first.chaser_radius, second.chaser_radius} == {RADIUS, 0.0}
    assert said["error_bound_m"] in (first.error_bound, second.error_bound)
    assert said["error_bound_m"] >= said["sampled_maximum_m"]


def test_a_refused_certificate_leaves_the_field_as_it_was(folder, fitted):
    before = (folder / "box.keepout").read_bytes()
    for wrong in (("--mesh", "sphere"), ("--chaser-radius", "50")):
        answer = keepout_command("certify", "box.keepout", *wrong)
        assert answer.code == 1
        assert answer.err.count("\n") == 1
        assert (folder / "box.keepout").read_bytes() == before


FEWER_POINTS = """
from keepout.flights import surface
surface._SURFACE_CELLS = 2e4
surface.surface_distance.__kwdefaults__["count"] = 5_000
from keepout.cli import main
main()
"""
"""As many as give the shape of an answer; tests/core/measures says how good a measure is."""


def test_measure(folder, fitted):
    summary = keepout_process(folder, "measure", "box.keepout", "--json", program=FEWER_POINTS)
    [proof] = summary["certificates"]
    assert proof["error_bound"] == fitted["certificate"]["error_bound_m"]
    assert summary["sealed_volume_m3"] == pytest.approx(24.0, rel=0.02)


def test_a_flight_reaches_its_goal_and_says_so_everywhere(folder, flown):
    assert written(folder / "flight") == flown
    assert (flown["reached"], flown["contact"], flown["contact_verdict"]) == (True, False, "no")
    assert flown["start_certified"]
    table = pq.read_table(folder / "flight" / "boxed.parquet")
    column = {name: table.column(name).to_numpy() for name in table.schema.names}
    position, velocity, force = (
        np.column_stack([column[f"{name}_{axis}"] for axis in "xyz"]) for name in ("position", "velocity", "force")
    )
    np.testing.assert_array_equal(column["time"], np.arange(SECONDS + 1.0))
    np.testing.assert_array_equal(position[0], START)
    error = np.linalg.norm(position - np.array(GOAL), axis=1)
    assert flown["final_error_m"] == pytest.approx(error[-1], abs=1e-12)
    assert flown["time_to_reach_s"] == column["time"][np.flatnonzero(error >= 0.1)[-1] + 1]
    assert flown["delta_v_mps"] == pytest.approx(np.linalg.norm(force[:-1], axis=1).sum() / 20.0)
    assert flown["largest_speed_mps"] == pytest.approx(np.linalg.norm(velocity, axis=1).max())
    assert np.abs(force).max() <= 0.1
    assert flown["saturated_fraction"] == column["saturated"][:-1].mean()
    assert flown["statuses"]["guard"]["clear"] == np.sum(column["guard_status"][:-1] & 3 == 0)
    assert flown["guard_interventions"] == np.sum(column["guard_status"][:-1] & 3 != 0)
    least = box_distance(position).min() - RADIUS
    assert least - 0.01 < flown["minimum_clearance_m"] <= least


def test_the_flight_file_says_what_was_flown_and_can_be_judged_again(folder, flown):
    envelope = json.loads(pq.read_schema(folder / "flight" / "boxed.parquet").metadata[b"keepout_flight"])
    header = json.loads(envelope["header"])
    scenario = Scenario.load(folder / "mission.toml")
    assert Scenario.parse(json.loads(header["scenario"])) == scenario
    assert (header["target_sha256"], header["seed"]) == (Target.load("box").sha256, scenario.seed)
    assert header["versions"]["keepout"] == keepout.__version__
    record = FlightRecord.load(folder / flown["flight"])
    again = judged(record, scenario)
    assert (str(again.contact), again.minimum_clearance) == ("no", flown["minimum_clearance_m"])
    # Moved into the box between two samples, the same file is not called safe.
    record.position[100] = [0.0, 1.0, 0.0]
    assert str(judged(record, scenario).contact) != "no"


def test_the_page_of_the_flight(folder, flown):
    """It holds the table of the summary, the pictures beside it, and the recorded path; it fetches nothing."""
    out = folder / "flight"
    pictures = {"paths", "clearance", "error", "boxed"}
    files = {"boxed.parquet", "index.html", "replay.html", "summary.json", "mission.json"}
    files |= {f"{name}.png" for name in pictures}
    assert {path.name for path in out.iterdir()} == files
    page = Page.read(out / "index.html")
    assert set(page.outside) == {"replay.html"}
    assert page.unclosed == []
    assert page.table[1:] == [["boxed", *(shown(flown[key]) for key in FLIGHT_COLUMNS)]]
    assert set(page.images) == pictures
    for name, content in page.images.items():
        assert content == (out / f"{name}.png").read_bytes()
        check_picture(out / f"{name}.png")
    drawn = ReplayPage.read(out / "replay.html").positions("boxed")
    np.testing.assert_allclose(drawn, FlightRecord.load(flown["flight"]).position, rtol=1e-6, atol=1e-6)


def test_a_folder_of_another_mission_is_refused_before_anything_is_flown(folder, flown):
    before = sorted((folder / "flight").iterdir())
    for command in (("fly", "drawn.toml"), ("rare", "drawn.toml"), ("campaign", "mission.toml")):
        refused = keepout_command(*command, "-o", "flight")
        assert refused.code == 1
        assert f"flight: holds what `keepout fly` wrote of boxed ({folder / 'mission.toml'})" in refused.err
        assert "--force" in refused.err
    assert sorted((folder / "flight").iterdir()) == before


TEN_LINES = """
import sys
from dataclasses import replace
import keepout, numpy
from keepout.core.fields.model import FieldModel
from keepout.core.learning import training
learned = replace(FieldModel.load("box.keepout"), certificates=())
training.fit = lambda target, **how: learned
exec(sys.argv[1])
assert flight.outcome.reached
flown = {"guarded": flight.record.guarded_force[0], "least": flight.audit.minimum_clearance}
numpy.savez("ten.npz", clearance=flight.clearance, force=force, position=flight.record.position, **flown)
"""


@pytest.mark.slow  # names and results of Python are in test_public_names
def test_the_ten_lines_of_readme(folder, flown):
    """As they stand, but for the fit, which is that of the command, and for the time that they take."""
    box = Target.load("box")
    trimesh.Trimesh(box.vertices, box.faces, process=False).export(folder / "satellite.glb")
    [code] = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert code.count("duration=1200.0") == 1
    told = told_by_process(folder, code.replace("duration=1200.0", f"duration={SECONDS}.0"), program=TEN_LINES)
    assert "proved free, certified from the start" in told
    found = np.load("ten.npz")
    exact = box_distance(found["position"]) - RADIUS
    np.testing.assert_allclose(found["clearance"], exact, atol=1e-9)
    assert 0.0 < found["least"] <= exact.min()
    np.testing.assert_allclose(found["force"], found["guarded"], rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(FlightRecord.load("flight.parquet").position, found["position"])


def test_replay(folder, flown):
    told = told_by_process(
        folder, "replay", flown["flight"], "-o", "again.html", "--title", "Once more", program=COARSE
    )
    assert "open again.html" in told
    assert "<title>Once more</title>" in (folder / "again.html").read_text(encoding="utf-8")


def test_export_and_audit(folder, flown):
    for craft in ("chaser", "target"):
        command = ("export", flown["flight"], "--to", "oem", "--of", craft, "-o", f"{craft}.oem", "--json")
        assert keepout_process(folder, *command)["file"] == f"{craft}.oem"
    files = ("--chaser", "chaser.oem", "--target-orbit", "target.oem", "--chaser-radius", RADIUS)
    said = keepout_process(folder, "audit", "--target", "box", *files, "--acceleration-bound", "0.02", "--json")
    assert said["contact"] is False


def test_a_campaigns_summary_is_that_of_its_rows_and_these_are_its_flights(folder, campaign):
    out = folder / "many"
    assert written(out) == campaign
    table = pq.read_table(folder / campaign["flights"])
    rows = {name: table.column(name).to_numpy(zero_copy_only=False) for name in table.schema.names}
    assert table.num_rows == campaign["runs"] == RUNS
    assert campaign["reached"] == rows["reached"].sum()
    assert campaign["contacts"] == (rows["contact"] != "no").sum() == 0
    assert campaign["minimum_clearance_m"] == rows["minimum_clearance"].min()
    assert campaign["median_delta_v_mps"] == np.median(rows["delta_v"])
    check_picture(out / "campaign.png")
    assert len(campaign["kept"]) == RUNS
    shown = keepout.Campaign.open(out)._repr_html_()
    assert "of 3 flights 0 are not proved free of a contact" in shown
    assert "srcdoc=" in shown
    for row in table.to_pylist():
        record = FlightRecord.load(out / "kept" / f"run-{row['run']:010d}.parquet")
        least = box_distance(record.position).min() - RADIUS
        assert least - 0.01 < row["minimum_clearance"] <= least
        own = Scenario.parse(json.loads(record.header["scenario"]))
        assert row["minimum_clearance"] == judged(record, own).minimum_clearance
        assert row["final_error"] == pytest.approx(np.linalg.norm(record.position[-1] - [0.0, -5.0, 2.0]), abs=1e-12)


@pytest.mark.usefixtures("coarse_surfaces")
def test_campaign_report_compare_and_replay(folder, campaign):
    """Those of them that are no command of their own in this process, whose libraries are there."""
    page = folder / "many" / "index.html"
    page.unlink()
    told = keepout_command("campaign", "report", "many")
    assert (told.code, "Traceback" in told.err) == (0, False)
    assert "no contact" in told.out
    assert "open many/index.html" in told.out
    assert page.exists()
    assert keepout_command("campaign", "compare", "many", "many", "-o", "compared", "--json").json["paired"]
    assert (folder / "compared" / "index.html").exists()
    page.unlink()
    assert keepout_process(folder, "report", "many", "--json", program=COARSE)["page"] == "many/index.html"
    assert page.exists()
    assert keepout_command("report", "many", "--pdf", "-o", "many.pdf", "--json").json == {"report": "many.pdf"}
    assert (folder / "many.pdf").read_bytes().startswith(b"%PDF")
    said = keepout_process(folder, "campaign", "replay", "many", "--run", 1, "--no-figures", "--json")
    assert (said["equal"], said["differences"]) == (True, {})


@pytest.mark.slow  # judging by requirements is in flights/test_requirements
@pytest.mark.usefixtures("coarse_surfaces")
def test_a_campaign_that_is_there_is_judged_by_what_is_required_now(folder, campaign):
    """No flight is flown again for it; a command that finds too few runs that meet it ends with exit code 3."""
    command = ("campaign", "drawn.toml", "-o", "many", "--keep", "none", "--set", "require.contact=proved", "--set")
    told = keepout_command(*command, "require.share=0.3")  # of 3 of 3 the lower end is 0.025^(1/3), 0.2924
    assert (told.code, told.out.count("FAIL")) == (3, 1)
    assert "open many/index.html" in told.out
    assert "require.contact: proved free of contact: not met, 3 of 3 runs" in told.err
    assert written(folder / "many")["requirements"][0]["met"] is False
    assert "FAIL" in (folder / "many" / "index.html").read_text(encoding="utf-8")
    assert keepout_command("campaign", "report", "many").code == 3


def test_rare(folder):
    command = ("rare", "drawn.toml", "--below", 3, "--runs", 2, "--flights", 64, "-o", "rare", "--json")
    assert keepout_process(folder, *command, program=COARSE)["grade"] == "measured"


@pytest.fixture(scope="module")
def kept_map(folder):
    """A map that one true view has grown, kept for the exploration to go on from."""
    scenario = Scenario.parse(tomllib.loads(EXPLORE) | {"map": {"radius": 6.0, "spacing": 0.2}})
    sensor, box, place = equipment.depth_camera(scenario), Target.load("box"), np.array([0.0, -8.0, 2.0])
    known, rays = equipment.map_of(scenario, sensor), FirstHit(box.vertices, box.faces)
    axes = axes_towards(-place, np.array([0.0, 0.0, 1.0]))
    assert known.see(take(sensor, rays, place, axes, np.random.default_rng(0), ErrorDraw("random"))).opened > 0
    map_file.save(known, folder / "kept.keepmap")
    return known


def test_explore_goes_on_from_the_map_and_frees_no_cube_that_meets_the_box(folder, kept_map):
    summary = keepout_process(folder, "explore", "explore.toml", "-o", "explored", "--json", program=COARSE)
    assert written(folder / "explored") == summary
    files = {"map.keepmap", "unknown.parquet", "index.html", "replay.html", "seen.png", "map.png"}
    assert {path.name for path in (folder / "explored").iterdir()} >= files
    check_flown(folder / "explored" / "unknown.parquet", summary)
    later = map_file.load(folder / "explored" / "map.keepmap", name="unknown", spacing=0.2)
    assert later.views == kept_map.views + summary["views"] - sum(summary["refused_views"].values())
    assert (later.free >= kept_map.free).all()
    # The nearest place of each free cube to the box is not inside it.
    centres = later.origin + (np.argwhere(later.free) + 0.5) * later.spacing
    assert np.maximum(np.abs(centres) - HALF, 0.0).max(axis=1).min() >= 0.5 * later.spacing - 1e-9


def test_explore_refuses_the_map_of_something_else_and_leaves_it_as_it_was(folder, kept_map):
    before = (folder / "kept.keepmap").read_bytes()
    for stands, other in (("spacing = 0.2", "spacing = 0.1"), ('"unknown"', '"other"'), ("= 6.0", "= 6.5")):
        assert stands in EXPLORE
        (folder / "other.toml").write_text(EXPLORE.replace(stands, other))
        refused = keepout_command("explore", "other.toml", "-o", "other")
        assert refused.code == 1
        assert refused.err.count("\n") == 1
        assert "kept.keepmap" in refused.err
        assert (folder / "kept.keepmap").read_bytes() == before


def test_inspect_and_its_files_alone_give_the_same_coverage(folder):
    summary = keepout_process(folder, "inspect", "inspect.toml", "-o", "inspected", "--no-figures", "--json")
    assert written(folder / "inspected") == summary
    check_flown(folder / "inspected" / "look.parquet", summary)
    assert (folder / "inspected" / "unseen.json").exists()
    [beam] = summary["zones"]
    away = FlightRecord.load(folder / "inspected" / "look.parquet").position - (0.0, 0.0, 12.0)
    assert (beam["name"], beam["entered"], summary["zones_entered"]) == ('zone "beam"', "no", "no")
    least = np.linalg.norm(away, axis=1).min() - 2.0 - RADIUS
    assert least - 5e-3 <= beam["minimum_clearance_m"] <= least + 1e-9
    again = coverage_of_files(folder / "inspected" / "look.parquet", folder / "inspected" / "frames.parquet")
    assert again.same
    assert again.coverage == pytest.approx(summary["coverage"], abs=1e-12)


def check_flown(path: Path, summary: dict) -> None:
    """Clearance and Δv are those of the file's positions and forces around the true box."""
    record = FlightRecord.load(path)
    least = box_distance(record.position).min() - RADIUS
    assert least - 5e-3 <= summary["minimum_clearance_m"] <= least + 1e-9
    pushed = np.linalg.norm(record.force[:-1], axis=1).sum() * (record.time[1] - record.time[0]) / 20.0
    assert summary["delta_v_mps"] == pytest.approx(pushed, rel=1e-6)
    assert summary["contact"] is False


ONE_ROUGH_TARGET = """
from keepout.apps.reproduction import shapes
shapes.TARGETS = {"intelsat30": shapes.TARGETS["intelsat30"]}
shapes.QUICK_COARSENING *= 4
from keepout.cli import main
main()
"""
"""One target, in larger leaves; tests/flights/test_surface_and_volume.py says how good a volume is."""


def test_reproduce(folder):
    assert keepout_process(folder, "reproduce", "volumes", "--quick", "-o", "paper", "--json", program=ONE_ROUGH_TARGET)
    assert (folder / "paper" / "index.html").exists()
