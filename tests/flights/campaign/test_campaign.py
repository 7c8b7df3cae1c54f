"""Campaigns flown into folders: chunks, kills, refusals and replays, by a law that compiles quickly."""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from truths.small_campaigns import BATCH, MISSION

from keepout.apps.reproduction.in_memory import plan_campaign
from keepout.core.errors import FlightError, ScenarioError
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.scenario import Scenario
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.flying import fly_chunk, replay
from keepout.flights.campaign.plan import Plan
from keepout.flights.campaign.run import fly_campaign, keep_flights, keep_of
from keepout.flights.campaign.table import of_bytes, summary

pytestmark = [pytest.mark.long, pytest.mark.as_used]

GOAL = [0.0, -10.0, -4.0]


@pytest.fixture(scope="module")
def scenario():
    return Scenario.parse(MISSION)


@pytest.fixture(scope="module")
def plan(scenario):
    return Plan.of(scenario, batch=BATCH)


@pytest.fixture(scope="module")
def flown(plan, tmp_path_factory):
    dataset = Dataset.begin(tmp_path_factory.mktemp("flown"), plan)
    told = []
    with dataset.lock():
        fly_campaign(plan, dataset, told=told.append)
    return dataset, told


def test_every_run_has_a_row_and_a_refused_one_its_reason(plan, flown, scenario):
    table = flown[0].table()
    assert table["run"].to_pylist() == list(range(22))
    rows = table.to_pylist()
    refused = [row for row in rows if row["status"] == "refused"]
    assert {row["run"] for row in refused} == {row["run"] for row in rows if row["chaser.force_limit"] == 0.001}
    assert refused
    assert all("no law can hold the chaser" in row["reason"] and row["contact"] is None for row in refused)
    assert all(row["reason"] == "" and row["contact"] is not None for row in rows if row["status"] == "flown")
    figures = summary(flown[0].table(), scenario)
    assert (figures["runs"], figures["refused"], figures["flown"]) == (22, len(refused), 22 - len(refused))
    assert figures["refusals"][0] == {"run": refused[0]["run"], "reason": refused[0]["reason"]}
    assert figures["starts_drawn_again"] == sum(row["start_drawn_again"] for row in rows) > 0
    starts = np.array([[row[f"start_{axis}"] for axis in "xyz"] for row in rows])
    assert plan.workshop.mission(scenario).target.distance.distance(starts).min() > 0.8


def test_a_chunk_is_a_function_of_plan_and_number_whoever_flies_it(plan, flown):
    sent = pickle.loads(pickle.dumps(plan))
    for number in (plan.chunks - 1, 0):
        result = fly_chunk(sent, number, workers=1)
        assert result == fly_chunk(plan, number, workers=3)
        assert of_bytes(result.table).equals(flown[0].part(number))


def test_a_run_is_the_same_in_chunks_of_another_size(scenario, flown):
    whole = Plan.of(scenario.replace(campaign={"runs": 9}), batch=BATCH)
    object.__setattr__(whole, "chunk", 8)
    rows = of_bytes(fly_chunk(whole, 0).table).replace_schema_metadata(None)
    assert rows.equals(flown[0].table().slice(0, 8))


@pytest.mark.slow  # campaigns in memory are in apps/reproduction/test_in_memory
def test_a_campaign_in_memory_has_the_rows_of_one_in_a_folder(scenario, flown):
    made = plan_campaign(scenario).fly(batch=BATCH)
    assert made.table.equals(flown[0].table())
    columns, rows = made.columns(), [row for row in made.table.to_pylist() if row["status"] == "flown"]
    for name in ("run", "chaser.mass", "start_x", "delta_v", "minimum_clearance", "contact"):
        assert list(columns[name]) == [row[name] for row in rows]
    place, run = next((i, run) for i, run in enumerate(made.flights) if run.number > 8)
    np.testing.assert_allclose(made.series.values["position_error"][place, 0], np.linalg.norm(run.position - GOAL))
    assert made.summary()["flown"] == len(rows) == len(made.audits) < 22


@pytest.mark.slow  # of one chunk: the test below
def test_the_worst_flights_are_kept_and_no_others(plan, flown):
    dataset, _ = flown
    kept = keep_flights(plan, dataset, keep_of("worst:3"))
    rows = [row for row in dataset.table().to_pylist() if row["status"] == "flown"]
    assert kept == [row["run"] for row in sorted(rows, key=lambda row: row["minimum_clearance"])[:3]]
    assert {path.name for path in (dataset.folder / "kept").iterdir()} == {dataset.kept(run).name for run in kept}
    header = FlightRecord.load(dataset.kept(kept[0])).header
    assert (header["campaign"], header["run"]) == (plan.sha256, kept[0])
    assert keep_of("all") is None
    assert keep_of("none") == 0
    with pytest.raises(ScenarioError, match="worst:N"):
        keep_of("worst:0")


def test_of_one_chunk_the_worst_flights_are_kept_as_they_land_with_the_bits_of_a_replay(scenario, tmp_path):
    plan = replace(Plan.of(scenario.replace(campaign={"runs": 8}), batch=BATCH), keep=2)
    dataset = Dataset.begin(tmp_path, plan)
    fly_campaign(plan, dataset)
    rows = [row for row in dataset.table().to_pylist() if row["status"] == "flown"]
    worst = [row["run"] for row in sorted(rows, key=lambda row: row["minimum_clearance"])[:2]]
    kept = {run: dataset.kept_record(run) for run in worst}
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {dataset.kept(run).name for run in kept}
    for flown in replay(plan, sorted(kept)):
        assert flown.apart == 0.0
        for name, column in kept[flown.run.number].columns.items():
            np.testing.assert_array_equal(column, flown.flight.record.columns[name])
    assert not replace(plan, scenario=scenario.replace(campaign={"runs": 8}, duration=1e6)).in_full


def test_a_torn_or_foreign_part_is_flown_again(plan, flown, tmp_path):
    dataset = Dataset.begin(tmp_path, plan)
    for number in range(plan.chunks):
        dataset.write(fly_chunk(plan, number))
    parts = sorted((tmp_path / "flights").iterdir())
    before = [part.read_bytes() for part in parts]
    parts[0].write_bytes(before[0][:-20])
    parts[1].write_bytes(before[2])
    sketch = next((tmp_path / "bands").glob("*-00003.npz"))
    sketch.write_bytes(sketch.read_bytes()[:-1])
    assert dataset.missing() == [0, 1, 3]
    with pytest.raises(FlightError, match=r"part-00000\.parquet: missing or damaged"):
        dataset.table()
    fly_campaign(plan, dataset)
    assert [part.read_bytes() for part in parts] == before
    assert dataset.bands().to_bytes() == flown[0].bands().to_bytes()


def test_a_resumed_campaign_counts_from_where_the_folder_stands(scenario, tmp_path):
    plan = Plan.of(scenario.replace(goal={"tolerance": 12.0}, campaign={"runs": 12}), batch=BATCH)
    dataset, told = Dataset.begin(tmp_path, plan), []
    for number in range(plan.chunks - 1):
        dataset.write(fly_chunk(plan, number))
    fly_campaign(plan, dataset, told=told.append)
    rows, (first, _) = dataset.table(["reached", "contact"]).to_pylist(), plan.chunk_runs(plan.chunks - 1)
    for standing, done in ((told[0], rows[:first]), (told[-1], rows)):
        assert standing.done == len(done)
        assert standing.reached == sum(row["reached"] is True for row in done) > 0
        assert standing.contacts == sum(row["contact"] not in (None, "no") for row in done)
    assert (told[0].flown, told[0].rate, told[0].seconds_left) == (0, 0.0, None)
    assert told[-1].flown <= 12 - first
    complete = []
    fly_campaign(plan, dataset, told=complete.append)
    assert [(one.done, one.reached, one.flown) for one in complete] == [(12, told[-1].reached, 0)]


def test_a_folder_of_another_campaign_or_that_another_process_flies_is_refused(scenario, flown):
    dataset = flown[0]
    other = Plan.of(scenario.replace(seed=1, chaser={"radius": 0.5}), batch=BATCH)
    with pytest.raises(ScenarioError, match="holds another campaign: seed is 0 there and 1 here; give another folder"):
        Dataset.begin(dataset.folder, other)
    program = (
        "import sys; from keepout.flights.campaign.dataset import Dataset\n"
        "with Dataset.open(sys.argv[1]).lock(): print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", program, str(dataset.folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with pytest.raises(ScenarioError, match=f"another process \\(process {process.pid}\\)"), dataset.lock():
            pass
        process.kill()
    with dataset.lock():  # a killed process holds nothing
        pass


def test_starts_in_the_target_are_refused_where_the_design_is_over_all_runs(scenario):
    campaign = {"sampling": "sobol", "runs": 32, "dispersions": {"start.position": {"sphere": [0.0, 8.0]}}}
    plan = Plan.of(scenario.replace(campaign=campaign), batch=8)
    runs = plan.draw(0, 32)
    refused = [run for run in runs if run.mission is None]
    assert 0 < len(refused) < 32
    assert all(run.refusal.startswith("start.position: ") and run.drawn_again == 0 for run in refused)


def test_a_campaign_of_which_nothing_can_be_flown_is_refused(scenario):
    with pytest.raises(ScenarioError, match=r"none of the first 16 runs can be flown; .*chaser\.mass: -1"):
        Plan.of(scenario.replace(campaign={"dispersions": {"chaser.mass": {"choice": [-1.0]}}}))


PROGRAM = """
import json, sys
from pathlib import Path
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.plan import Plan
from keepout.flights.campaign.run import fly_campaign
from keepout.core.mission.scenario import Scenario
plan = Plan.of(Scenario.parse(json.loads(sys.argv[2])), batch=4)
dataset = Dataset.begin(Path(sys.argv[1]), plan)
with dataset.lock():
    fly_campaign(plan, dataset)
"""


@pytest.mark.slow  # parts that are missing or torn are flown again above
def test_killed_and_started_again_it_ends_in_the_same_table(plan, flown, tmp_path):
    command = [sys.executable, "-c", PROGRAM, str(tmp_path), json.dumps(MISSION)]
    process = subprocess.Popen(command)
    until = time.monotonic() + 500.0
    while not list(tmp_path.glob("flights/*.parquet")) and time.monotonic() < until and process.poll() is None:
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert Dataset.open(tmp_path).missing(), "killed before the end"
    dataset, whole = Dataset.begin(tmp_path, plan), flown[0]
    before = {part: part.read_bytes() for part in (tmp_path / "flights").glob("*.parquet")}
    fly_campaign(plan, dataset)
    assert before, "what the killed process had flown is in the table, too"
    assert all(part.read_bytes() == content for part, content in before.items())
    assert dataset.missing() == []
    assert dataset.table().equals(whole.table())
    assert dataset.bands().to_bytes() == whole.bands().to_bytes()
    for part in (tmp_path / "flights").glob("*.parquet"):
        assert part.read_bytes() == (whole.folder / "flights" / part.name).read_bytes()
