"""The way a user goes, by the command line: from the list of targets to a campaign, with a look into every result.

One fit serves all of it, so that one worker runs all of it. The truths are the box's own closed forms and what the
files say when read without the code that wrote them.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from truths.boxes import HALF, box_distance, contact_with_box
from truths.command_line import keepout_command
from truths.learned import kept as kept_field
from truths.learned import taken
from truths.replay_page import ReplayPage
from truths.results import Page, check_picture

import keepout
from keepout.audit.audit import Audit, audit, audit_campaign
from keepout.fields.evaluate import values
from keepout.fields.model import FieldModel
from keepout.flight.record import FlightRecord
from keepout.geometry.builtin import BUILTINS
from keepout.geometry.target import Target
from keepout.learning import checkpoint, training
from keepout.mission import audited, environment
from keepout.mission import flight as flights
from keepout.mission.flight import fly
from keepout.mission.scenario import Scenario
from keepout.proof import certificate as proving
from keepout.report.terminal import FLIGHT_COLUMNS, shown

pytestmark = [pytest.mark.xdist_group("journey"), pytest.mark.long]

RADIUS = 0.5
START, GOAL, SECONDS = (0.0, 10.0, 6.0), (0.0, -10.0, -4.0), 500
"""Those of tests/test_readme.py, which takes the program of the flight."""
MISSION = f"""
name = "boxed"
duration = {SECONDS}.0
target.source = "box"
field.source = "box.keepout"
start.position = {list(START)}
goal.position = {list(GOAL)}
campaign.lower = [-4.0, 3.0, -2.0]
campaign.upper = [4.0, 5.0, 2.0]
"""
RUNS = 5


def judged(record: Any, scenario: Scenario) -> Audit:
    """Audit one flight around the box by the numbers of its scenario."""
    return audit(
        record,
        Target.load("box"),
        chaser_radius=RADIUS,
        bounds=environment.flight_bounds(scenario),
        force_limit=scenario.chaser.force_limit,
        speed_limit=scenario.chaser.speed_limit,
    )


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A user's working folder, with an empty cache of its own."""
    folder = tmp_path_factory.mktemp("journey")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KEEPOUT_CACHE", str(folder / "cache"))
        patch.setenv("COLUMNS", "80")
        patch.chdir(folder)
        (folder / "mission.toml").write_text(MISSION, encoding="utf-8")
        yield folder


@pytest.fixture(scope="module")
def fitted(place):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "fit", kept_field(training.fit))
        return keepout_command("fit", "box", "-o", "box.keepout", "--profile", "quick", "--json").json


@pytest.fixture(scope="module")
def certified(place, fitted):
    uncertified = (place / "box.keepout").read_bytes()
    refused = keepout_command("fly", "mission.toml", "-o", "refused")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proving, "certify", kept_field(proving.certify))
        summary = keepout_command("certify", "box.keepout", "--chaser-radius", RADIUS, "--json").json
    return summary, uncertified, refused


@pytest.fixture(scope="module")
def kept():
    """The flights that `fly` has flown, for tests of what comes after it."""
    return []


@pytest.fixture(scope="module")
def flown(place, certified, kept):
    def fly_and_keep(*arguments, **options):
        kept.append(fly(*arguments, **options))
        return kept[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "fly", fly_and_keep)
        return keepout_command("fly", "mission.toml", "-o", "flight", "--json").json


@pytest.fixture(scope="module")
def landed():
    """Times, positions, velocities and forces that `campaign` audited."""
    return []


@pytest.fixture(scope="module")
def campaign(place, certified, landed):
    def audit_and_keep(*arguments, **options):
        landed.append(arguments[:4])
        return audit_campaign(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(audited, "audit_campaign", audit_and_keep)
        command = ("campaign", "mission.toml", "--runs", RUNS, "--seed", 3, "-o", "many", "--keep", "all", "--json")
        return keepout_command(*command).json


def test_the_installed_command_lists_the_targets():
    script = shutil.which("keepout", path=str(Path(sys.executable).parent))
    assert script is not None
    done = subprocess.run([script, "targets", "--json"], capture_output=True, text=True, check=True)
    rows = {row["name"]: row for row in json.loads(done.stdout)["targets"]}
    assert list(rows) == list(BUILTINS)
    assert rows["box"]["extents_m"] == pytest.approx(list(2.0 * HALF))
    assert rows["box"]["volume_m3"] == pytest.approx(float(np.prod(2.0 * HALF)))
    assert rows["intelsat30"]["shipped_field"]
    assert not rows["box"]["shipped_field"]


def test_pictures_of_the_targets(place):
    answer = keepout_command("targets", "--pictures", "pictures")
    assert answer.code == 0
    for name in BUILTINS:
        assert name in answer.out
        check_picture(place / "pictures" / f"{name}.png")


def test_the_mesh_is_reported_before_anything_is_learned(place):
    summary = keepout_command("describe", "box", "-o", "mesh", "--json").json
    assert summary["watertight"]
    assert summary["triangles"] == 12
    assert summary["warnings"] == []
    assert summary["extents"] == pytest.approx(list(2.0 * HALF))
    check_picture(place / "mesh" / "box.png")


def test_fit_writes_a_field_and_nothing_else(place, fitted):
    model = FieldModel.load(place / fitted["field"], target=Target.load("box"))
    assert fitted["target_sha256"] == model.target_sha256
    assert model.training["profile"] == fitted["profile"] == "quick"
    assert model.training["seed"] == fitted["seed"] == 0
    assert not [path.name for path in place.iterdir() if "checkpoint" in path.name or path.name.startswith(".")]
    on_surface = values(model.field, contact_with_box(100_000, 0.0))
    assert np.abs(on_surface + model.offset).max() < 0.1
    assert on_surface.max() == pytest.approx(fitted["sampled_maximum_m"], abs=5e-3)
    # Beside the box the field is the distance to it, less the offset.
    points = np.random.default_rng(2).uniform(-1.0, 1.0, (50_000, 3)) * (HALF + 1.0)
    exact = box_distance(points)
    points, exact = points[exact > 0.05], exact[exact > 0.05]
    errors = values(model.field, points) - (exact - model.offset)
    assert np.abs(errors).mean() < 0.03
    assert errors.max() < 0.1


def test_every_profile_is_named_in_the_help():
    from keepout.learning.profile import PROFILES

    text = " ".join(keepout_command("fit", "--help").out.split())
    for name in PROFILES:
        assert name in text


def test_certify_adds_a_certificate_that_no_search_beats(place, certified, fitted):
    summary, uncertified, _ = certified
    model = FieldModel.load(place / "box.keepout", target=Target.load("box"))
    [certificate] = model.certificates
    assert summary["kind"] == certificate.kind == "certified"
    assert summary["error_bound_m"] == certificate.error_bound
    assert summary["chaser_radius_m"] == certificate.chaser_radius == RADIUS
    assert summary["target_sha256"] == fitted["target_sha256"]
    contact = contact_with_box(400_000, RADIUS)
    np.testing.assert_allclose(box_distance(contact), RADIUS, atol=1e-12)
    worst = float((values(model.field, contact) - RADIUS).max())
    assert worst <= certificate.error_bound
    assert certificate.sampled_maximum <= certificate.error_bound
    assert worst == pytest.approx(certificate.error_bound, abs=0.02)
    assert (place / "box.keepout").read_bytes() != uncertified


def test_fit_certifies_in_the_same_command(place, certified, tmp_path):
    summary, uncertified, _ = certified
    learned = tmp_path / "learned.keepout"
    learned.write_bytes(uncertified)
    with pytest.MonkeyPatch.context() as patch:
        # Both take long, and were tried above.
        patch.setattr(training, "fit", lambda *_, **__: FieldModel.load(learned))
        patch.setattr(proving, "certify", taken(proving.certify))
        both = ("fit", "box", "-o", tmp_path / "both.keepout", "--chaser-radius", RADIUS, "--certify", "--json")
        said = keepout_command(*both).json["certificate"]
    [certificate] = FieldModel.load(tmp_path / "both.keepout", target=Target.load("box")).certificates
    assert said["error_bound_m"] == certificate.error_bound == summary["error_bound_m"]
    assert said["kind"] == "certified"


def test_a_field_without_a_certificate_is_not_flown(place, certified):
    _, _, refused = certified
    assert refused.code == 1
    assert "certified for: none" in refused.err
    assert refused.out == ""
    assert refused.err.splitlines()[-1].startswith("keepout: ")


def test_measure_measures_the_field_and_draws_it(place, certified):
    summary = keepout_command("measure", "box.keepout", "-o", "field", "--json").json
    [proof] = summary["certificates"]
    assert proof["error_bound"] == certified[0]["error_bound_m"]
    assert summary["sealed_volume_m3"] == pytest.approx(24.0, rel=0.02)
    [volume] = summary["volumes"]
    # Parallel body of a box: its volume, its faces, quarter cylinders along its edges, eighths of a ball.
    sides = 2.0 * HALF
    faces = 2.0 * (sides[0] * sides[1] + sides[1] * sides[2] + sides[0] * sides[2])
    parallel = sides.prod() + faces * RADIUS + np.pi * RADIUS**2 * sides.sum() + 4.0 / 3.0 * np.pi * RADIUS**3
    assert volume["contact"] == pytest.approx(parallel, rel=0.02)
    assert summary["pictures"] == ["field/slices.png", "field/surface.png"]
    for picture in summary["pictures"]:
        check_picture(place / picture)


def test_a_flight_reaches_its_goal_and_says_so_everywhere(place, flown):
    assert json.loads((place / "flight" / "summary.json").read_text(encoding="utf-8")) == flown
    assert flown["reached"]
    assert flown["contact"] is False
    assert flown["contact_verdict"] == "no"
    assert flown["start_certified"]
    table = pq.read_table(place / "flight" / "boxed.parquet")
    column = {name: table.column(name).to_numpy() for name in table.schema.names}
    time = column["time"]
    position, velocity, force = (
        np.column_stack([column[f"{name}_{axis}"] for axis in "xyz"]) for name in ("position", "velocity", "force")
    )
    np.testing.assert_array_equal(time, np.arange(SECONDS + 1.0))
    np.testing.assert_array_equal(position[0], START)
    error = np.linalg.norm(position - np.array(GOAL), axis=1)
    assert flown["final_error_m"] == pytest.approx(error[-1], abs=1e-12)
    late = np.flatnonzero(error >= 0.1)[-1] + 1
    assert flown["time_to_reach_s"] == time[late]
    assert flown["delta_v_mps"] == pytest.approx(np.linalg.norm(force[:-1], axis=1).sum() / 20.0)
    assert flown["largest_speed_mps"] == pytest.approx(np.linalg.norm(velocity, axis=1).max())
    assert np.abs(force).max() <= 0.1
    assert flown["saturated_fraction"] == column["saturated"][:-1].mean()
    assert flown["statuses"]["guard"]["clear"] == np.sum(column["guard_status"][:-1] & 3 == 0)
    assert flown["guard_interventions"] == np.sum(column["guard_status"][:-1] & 3 != 0)
    assert flown["minimum_clearance_m"] <= box_distance(position).min() - RADIUS
    assert flown["minimum_clearance_m"] == pytest.approx(box_distance(position).min() - RADIUS, abs=0.01)


def test_the_flight_file_says_what_was_flown_and_can_be_judged_again(place, flown):
    envelope = json.loads(pq.read_schema(place / "flight" / "boxed.parquet").metadata[b"keepout_flight"])
    header = json.loads(envelope["header"])
    scenario = Scenario.load(place / "mission.toml")
    assert Scenario.parse(json.loads(header["scenario"])) == scenario
    assert header["target_sha256"] == Target.load("box").sha256
    assert header["seed"] == scenario.seed
    assert header["versions"]["keepout"] == keepout.__version__
    assert header["statuses"]["guard_status"]["0"] == "clear"
    record = FlightRecord.load(place / flown["flight"])
    again = judged(record, scenario)
    assert str(again.contact) == flown["contact_verdict"]
    assert again.minimum_clearance == flown["minimum_clearance_m"]
    # Moved into the box between two samples, the same file is not called safe.
    record.position[100] = [0.0, 1.0, 0.0]
    assert str(judged(record, scenario).contact) != "no"


def check_page(folder: Path, summaries: list[dict], pictures: set[str]) -> None:
    """The page holds the table of the summaries, the pictures beside it, and the recorded paths; it fetches nothing."""
    page = Page.read(folder / "index.html")
    assert set(page.outside) == {"replay.html"}
    assert page.unclosed == []
    assert page.table[1:] == [[one["name"], *(shown(one[key]) for key in FLIGHT_COLUMNS)] for one in summaries]
    assert set(page.images) == pictures
    for name, content in page.images.items():
        assert content == (folder / f"{name}.png").read_bytes()
        check_picture(folder / f"{name}.png")
    replay = ReplayPage.read(folder / "replay.html")
    for one in summaries:
        recorded = FlightRecord.load(one["flight"]).position
        np.testing.assert_allclose(replay.positions(one["name"]), recorded, rtol=1e-6, atol=1e-6)


def test_the_page_of_the_flight(place, flown):
    check_page(place / "flight", [flown], {"paths", "clearance", "error", "boxed"})
    made = {path.name for path in (place / "flight").iterdir()}
    assert made == {
        "boxed.parquet",
        "boxed.png",
        "paths.png",
        "clearance.png",
        "error.png",
        "index.html",
        "replay.html",
        "summary.json",
    }


def test_a_campaigns_summary_is_that_of_its_rows(place, campaign):
    assert json.loads((place / "many" / "summary.json").read_text(encoding="utf-8")) == campaign
    table = pq.read_table(place / campaign["flights"])
    rows = {name: table.column(name).to_numpy(zero_copy_only=False) for name in table.schema.names}
    assert table.num_rows == campaign["runs"] == RUNS
    assert campaign["reached"] == rows["reached"].sum() == RUNS
    assert campaign["contacts"] == (rows["contact"] != "no").sum() == 0
    assert campaign["undecided"] == (rows["contact"] == "undecided").sum()
    assert campaign["minimum_clearance_m"] == rows["minimum_clearance"].min() > 0.1
    assert campaign["minimum_barrier_m"] == rows["minimum_barrier"].min()
    assert campaign["below_barrier"] == (rows["minimum_barrier"] < 0.0).sum()
    assert campaign["starts_drawn_again"] >= 0
    assert campaign["median_delta_v_mps"] == np.median(rows["delta_v"])
    assert campaign["guard_interventions"] == rows["guard_interventions"].sum()
    assert sum(campaign["statuses"]["guard"].values()) == RUNS * SECONDS
    assert np.isfinite(rows["time_to_reach"]).all()
    starts = np.column_stack([rows[f"start_{axis}"] for axis in "xyz"])
    assert (np.abs(starts - [0.0, 4.0, 0.0]) <= [4.0, 1.0, 2.0]).all()
    assert len(np.unique(starts, axis=0)) == RUNS
    assert (rows["minimum_clearance"] <= box_distance(starts) - RADIUS).all()
    scenario = Scenario.parse(json.loads(table.schema.metadata[b"scenario"]))
    assert (scenario.seed, scenario.campaign.runs, scenario.name) == (3, RUNS, "boxed")
    check_picture(place / "many" / "campaign.png")


def test_the_verdicts_of_a_campaign_are_those_of_its_flights_one_by_one(place, campaign, landed):
    rows = pq.read_table(place / campaign["flights"]).to_pylist()
    scenario = Scenario.load(place / "mission.toml")
    time, position, velocity, force = landed[0]  # those of the campaign; what follows is flown again to be kept
    assert len(campaign["kept"]) == RUNS
    for row in rows:
        record = FlightRecord.load(place / "many" / "kept" / f"run-{row['run']:010d}.parquet")
        np.testing.assert_array_equal(record.time, time)
        np.testing.assert_array_equal(record.position, position[row["run"]])
        np.testing.assert_array_equal(record.velocity, velocity[row["run"]])
        assert record.barrier.min() == row["minimum_barrier"]
    bands = json.loads((place / campaign["bands"]).read_text(encoding="utf-8"))
    at = np.rint(bands["time_s"]).astype(int)
    errors = np.linalg.norm(position - np.asarray(scenario.goal.position), axis=2)[:, at]
    for share, quantile in zip(bands["shares"], bands["position_error"], strict=True):
        ranked = np.sort(errors, axis=0)[max(int(np.ceil(share * RUNS)), 1) - 1]
        np.testing.assert_allclose(quantile, ranked, rtol=0.0101, atol=1e-6)
    assert position.shape == (RUNS, SECONDS + 1, 3)
    for row, *states in zip(rows, position, velocity, force):
        np.testing.assert_array_equal(states[0][0], [row[f"start_{axis}"] for axis in "xyz"])
        record = SimpleNamespace(time=time, **dict(zip(("position", "velocity", "force"), states)))
        verdict = judged(record, scenario)
        assert str(verdict.contact) == row["contact"]
        assert verdict.minimum_clearance == row["minimum_clearance"]
        assert row["minimum_clearance"] <= box_distance(states[0]).min() - RADIUS <= row["minimum_clearance"] + 0.01
        error = np.linalg.norm(states[0] - np.array(GOAL), axis=1)
        assert row["final_error"] == pytest.approx(error[-1], abs=1e-12)
        assert row["time_to_reach"] == np.flatnonzero(error >= 0.1)[-1] + 1


def test_a_stopped_fit_goes_on_where_it_was(place, fitted, monkeypatch):
    saved, keep = [], checkpoint.save

    def save_then_stop(path, *rest):
        keep(path, *rest)
        saved.append(path)
        if len(saved) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint, "save", save_then_stop)
    command = ("fit", "box", "-o", "again.keepout", "--profile", "quick", "--json")
    stopped = keepout_command(*command)
    assert (stopped.code, stopped.out) == (130, "")
    assert stopped.err.endswith("keepout: stopped\n")
    assert not (place / "again.keepout").exists()
    assert (place / "again.keepout.checkpoint").exists()
    assert keepout_command(*command).code == 0
    assert len(saved) == 8, "five blocks of 250 steps were left of eight"
    assert not (place / "again.keepout.checkpoint").exists()
    assert FieldModel.load(place / "again.keepout").sha256 == FieldModel.load(place / "box.keepout").sha256


@pytest.mark.parametrize(
    "blocked",
    ["summary.json", "boxed.parquet", "paths.png", pytest.param("replay.html", marks=pytest.mark.slow), "index.html"],
)
def test_a_place_that_cannot_be_written_is_named_in_one_line(place, flown, kept, blocked, monkeypatch):
    monkeypatch.setattr(flights, "fly", lambda *_, **__: kept[0])
    out = place / f"blocked-{blocked}"
    (out / blocked).mkdir(parents=True)
    answer = keepout_command("fly", "mission.toml", "-o", out, "--json")
    assert answer.code == 1
    assert answer.out == ""
    last = answer.err.splitlines()[-1]
    assert last.startswith("keepout: ")
    assert blocked in last
    assert "Traceback" not in answer.err
    assert not [path.name for path in out.iterdir() if path.name.startswith(".")]


def test_a_refused_certificate_leaves_the_field_as_it_was(place, certified):
    before = (place / "box.keepout").read_bytes()
    for wrong in (("--mesh", "sphere"), ("--chaser-radius", "50")):
        answer = keepout_command("certify", "box.keepout", *wrong)
        assert answer.code == 1
        assert answer.err.count("\n") == 1
        assert (place / "box.keepout").read_bytes() == before
