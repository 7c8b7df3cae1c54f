"""A folder of results written from flights known in closed form: page, figures and flight files."""

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pytest
from truths.replay_page import ReplayPage
from truths.results import Page, check_picture

from keepout.audit.audit import audit
from keepout.flight.outcome import FlightOutcome
from keepout.flight.record import FlightRecord
from keepout.geometry.target import Target
from keepout.mission import environment
from keepout.mission.campaign import Campaign
from keepout.mission.flight import Flight
from keepout.mission.scenario import Scenario
from keepout.report import folder, terminal
from keepout.report.campaign_view import draw_campaign

STEPS = 200
SPEED = 0.05


@pytest.fixture(scope="module")
def target():
    return Target.load("box")


def passing(target: Target, height: float, name: str) -> Flight:
    """A straight pass over the box at a height, m, at constant speed: its clearance is height - 1 - 0.5."""
    scenario = Scenario().replace(name=name, target={"source": "box"}, goal={"position": (5.0, 0.0, height)})
    time = np.arange(STEPS + 1.0)
    rows = STEPS + 1
    record = FlightRecord(
        header={},
        time=time,
        position=np.column_stack([-5.0 + SPEED * time, np.zeros(rows), np.full(rows, height)]),
        velocity=np.tile([SPEED, 0.0, 0.0], (rows, 1)),
        attitude=np.tile([1.0, 0.0, 0.0, 0.0], (rows, 1)),
        **{
            name: np.zeros((rows, 3))
            for name in (
                *("angular_velocity", "estimated_position", "estimated_velocity", "commanded_force", "guarded_force"),
                *("force", "disturbance", "disturbance_estimate", "desired_velocity", "safe_velocity"),
            )
        },
        barrier=np.full(rows, height - 1.6),
        **{name: np.zeros(rows) for name in ("backstepping_barrier", "lyapunov", "field_value")},
        control_status=np.zeros(rows, np.int32),
        guard_status=np.zeros(rows, np.int32),
        saturated=np.zeros(rows, bool),
    )
    verdict = audit(
        record,
        target,
        chaser_radius=0.5,
        bounds=environment.flight_bounds(scenario),
        force_limit=0.1,
        speed_limit=0.1,
    )
    outcome = FlightOutcome(
        minimum_barrier=jnp.asarray(height - 1.6),
        final_error=jnp.asarray(0.125),
        reached=jnp.asarray(height > 2.0),
        time_to_reach=jnp.asarray(150.0),
        delta_v=jnp.asarray(0.75),
        saturated_fraction=jnp.asarray(0.25),
        guard_interventions=jnp.asarray(17),
        control_status_counts=jnp.zeros(16, int).at[0].set(STEPS),
        guard_status_counts=jnp.zeros(16, int).at[0].set(STEPS),
        guard_flags=jnp.asarray(0),
        finite=jnp.asarray(True),
    )
    clearance = target.distance.distance(record.position) - 0.5
    return Flight(scenario, target, record, outcome, verdict, clearance)


@pytest.fixture(scope="module")
def written(target, tmp_path_factory):
    out = tmp_path_factory.mktemp("results") / "made" / "by the writer"
    flights = {"high & <safe>": passing(target, 3.0, "high"), "low": passing(target, 1.2, "low")}
    summaries = folder.write_flights(out, flights, title="Two <passes>", introduction="One & the other.")
    return out, flights, summaries


def test_the_flight_files_hold_the_flights(written):
    out, flights, summaries = written
    for summary, flight in zip(summaries, flights.values()):
        again = FlightRecord.load(summary["flight"])
        np.testing.assert_array_equal(again.position, flight.record.position)
        assert summary["flight"] == str(out / f"{flight.scenario.name}.parquet")
    high, low = summaries
    assert (high["contact_verdict"], low["contact_verdict"]) == ("no", "yes")
    assert high["minimum_clearance_m"] == pytest.approx(1.5, abs=2e-3)
    assert high["minimum_clearance_m"] <= 1.5


def test_the_page_stands_alone_and_says_what_the_summaries_say(written):
    out, _, summaries = written
    page = Page.read(out / "index.html")
    assert page.outside == ["replay.html", "replay.html"]  # shown, and linked to
    assert page.unclosed == []
    assert page.headings[0] == "Two <passes>"
    headings, *rows = page.table
    assert headings == ["flight", *terminal.FLIGHT_COLUMNS.values()]
    assert rows == [[one["name"], *(terminal.shown(one[key]) for key in terminal.FLIGHT_COLUMNS)] for one in summaries]
    assert "class=bad" in (out / "index.html").read_text(encoding="utf-8")
    assert set(page.images) == {"paths", "clearance", "error", "high", "low"}
    for name, content in page.images.items():
        assert content == (out / f"{name}.png").read_bytes()


def test_the_replay_follows_the_recorded_paths(written, target):
    out, flights, _ = written
    page = ReplayPage.read(out / "replay.html")
    assert list(page.flights()) == list(flights)
    for name, flight in flights.items():
        np.testing.assert_allclose(page.positions(name), flight.record.position, atol=1e-6)
    faces = page.array(page.told["target"]["faces"])
    np.testing.assert_allclose(
        page.array(page.told["target"]["vertices"])[faces], target.vertices[target.faces], atol=1e-4
    )
    assert page.told["surfaces"] == []  # flights that do not know their mission have no envelope


@pytest.mark.parametrize("name", ["paths", "clearance", "error", "high", "low"])
def test_the_figures_show_something(written, name):
    check_picture(written[0] / f"{name}.png")


def test_without_figures_only_flight_files_are_written(target, tmp_path):
    folder.write_flights(tmp_path, {"high": passing(target, 3.0, "high")}, title="", introduction="", figures=False)
    assert [path.name for path in tmp_path.iterdir()] == ["high.parquet"]


def test_a_campaigns_figure_and_numbers(target, tmp_path):
    flights = [passing(target, height, "many") for height in (3.0, 1.2, 4.0)]
    stacked = jax.tree.map(lambda *one: jnp.stack(one), *(flight.outcome for flight in flights))
    starts = np.stack([flight.record.position[0] for flight in flights])
    audits = tuple(flight.audit for flight in flights)
    flown = Campaign(flights[0].scenario, target, starts, stacked, audits, 1.0)
    draw_campaign(tmp_path / "campaign.png", pa.table(flown.columns()))
    check_picture(tmp_path / "campaign.png")
    summary = flown.summary()
    assert (summary["runs"], summary["reached"], summary["contacts"], summary["undecided"]) == (3, 2, 1, 0)
    assert summary["minimum_clearance_m"] == min(audit.minimum_clearance for audit in audits)
    assert summary["statuses"] == {"control": {"nominal": 3 * STEPS}, "guard": {"clear": 3 * STEPS}}
