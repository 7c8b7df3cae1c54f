"""What a user meets at the edges: what cannot be flown is refused by name, the rest is flown and flagged."""

import json
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from keepout import cli
from keepout.audit.audit import Contact
from keepout.errors import KeepoutError
from keepout.fields.model import FieldModel
from keepout.geometry.target import Target
from keepout.guard.field import cache_folder, guard_field
from keepout.mission.build import prepare
from keepout.mission.flight import fly
from keepout.mission.scenario import Scenario
from keepout.report.terminal import broken_assumptions

pytestmark = pytest.mark.long


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("KEEPOUT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def target():
    return Target.load("box")


@pytest.fixture(scope="module")
def field_path(target, tmp_path_factory):
    path = tmp_path_factory.mktemp("field") / "box.keepout"
    guard_field(target, 0.5).save(path)
    return path


@pytest.fixture(scope="module")
def base(field_path):
    """Around the 4 × 3 × 2 m box, straight from one side to above it."""
    return Scenario.parse(
        {
            "duration": 150.0,
            "target": {"source": "box"},
            "field": {"source": str(field_path)},
            "control": {"guidance": "straight"},
            "start": {"position": [4.0, 0.0, 2.0]},
            "goal": {"position": [0.0, 0.0, 3.0]},
        }
    )


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        pytest.param({"start": {"position": (2.4, 0.0, 0.0)}}, ("start.position", "0.400 m", "touches"), id="contact"),
        pytest.param(
            {"start": {"position": (0.0, 0.0, 0.4)}}, ("start: [0.0, 0.0, 0.4] m", "inside"), id="start inside"
        ),
        pytest.param(
            {"goal": {"position": (0.0, 0.0, 1.3)}}, ("goal.position", "0.300 m", "touches"), id="goal touches"
        ),
        pytest.param(
            {"goal": {"position": (0.0, 0.0, 1.62)}}, ("goal", "m inside the keep-out zone"), id="goal too near"
        ),
        pytest.param({"chaser": {"radius": 0.4}}, ("chaser radius 0.4 m", "certified for: 0.5 m"), id="radius"),
        pytest.param({"chaser": {"force_limit": 0.01}}, ("disturbance", "not below chaser.force_limit"), id="weak"),
        pytest.param(
            {"target": {"source": "box", "parameters": {"length": 4.1}}},
            ("made for box", "not for box"),
            id="wrong field",
        ),
    ],
)
def test_what_cannot_be_flown_is_refused(base, entries, said):
    with pytest.raises(KeepoutError) as refusal:
        prepare(base.replace(**entries))
    text = str(refusal.value)
    assert "\n" not in text
    for part in said:
        assert part in text


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("[chaser]\nmass = -20.0", "chaser.mass"),
        ("duration = 0.0", "duration"),
        ("[start]\nposition = [nan, 0.0, 0.0]", "start.position"),
        ("[start]\nvelocity = [0.0, inf, 0.0]", "start.velocity"),
        ("[faults]\nlaw = 'sideways'", "faults.law"),
        ("[start]\nposition = [2.4, 0.0, 0.0]", "start.position"),
    ],
)
def test_the_command_line_refuses_in_one_line(field_path, tmp_path, monkeypatch, capsys, lines, said):
    path = tmp_path / "flight.toml"
    path.write_text(f"{lines}\n[target]\nsource = 'box'\n[field]\nsource = '{field_path}'\n")
    monkeypatch.setattr(sys, "argv", ["keepout", "fly", str(path), "-o", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    output = capsys.readouterr()
    assert stop.value.code not in (0, None)
    assert said in output.err
    assert output.err.strip().count("\n") == 0
    assert output.out == ""


def test_a_start_inside_the_margin_is_led_out_and_flagged(base, target):
    start = (2.52, 0.0, 0.0)
    assert 0.5 < target.distance.distance(np.array([start]))[0] < 0.5 + 0.1
    flight = fly(base.replace(start={"position": start}, duration=120.0))
    summary = flight.summary()
    assert summary["start_certified"] is False
    assert summary["statuses"]["guard"]["escaping"] > 0
    assert summary["guard_flags"]["field"] > 0
    assert flight.audit.contact is Contact.NO
    status = flight.record.guard_status
    assert status[0] & 3 == 3
    assert not np.any(status[-40:] & 3 == 3), "the escape ends in a certified state"
    # The shortest way out: along the face's normal, never nearer than at the start but for the braking of drift.
    assert flight.clearance.min() > flight.clearance[0] - 0.02
    with pytest.raises(KeepoutError, match="inside the keep-out zone"):
        prepare(base.replace(start={"position": start}, guard={"enabled": False}))


def test_a_start_is_certified_only_from_every_estimate(base):
    scenario = base.replace(guard={"position_error": 0.02})
    mission = prepare(scenario)
    assert mission.start_certified is True
    guard = mission.setup.guard

    @eqx.filter_jit
    @jax.vmap
    def certified(x):
        place = jnp.zeros(3).at[0].set(x)
        return guard.certified(eqx.tree_at(lambda state: state.position, mission.initial, place))

    places = np.arange(2.52, 4.0, 0.005)
    free = np.array(certified(jnp.asarray(places)))
    assert free[-1]
    assert not free[0]
    # The nearest place that is certified as it is: an estimate 20 mm nearer is not.
    nearest = float(places[np.argmax(free)])
    doubtful = prepare(scenario.replace(start={"position": (nearest, 0.0, 0.0)}))
    assert doubtful.initial.position[0] == nearest
    assert np.array(certified(jnp.asarray(np.full(len(places), nearest)))).all()
    assert not np.array(certified(jnp.asarray(np.full(len(places), nearest - 0.02)))).any()
    assert doubtful.start_certified is False
    assert doubtful.assumptions_broken == ()


def test_an_assumption_that_is_broken_is_named_and_nothing_is_promised(base):
    summary = fly(base.replace(disturbance={"bound": 0.01}, duration=5.0)).summary()
    assert summary["start_certified"] is False
    assert summary["assumptions_broken"] == ["disturbance: flown up to 0.0141421 N > disturbance.bound 0.01 N"]
    assert summary["guard"]["disturbance_force_N"] == 0.01
    assert 0.0 < summary["guard"]["position_radius_rho_m"] < 0.1
    lines = broken_assumptions([{"name": "here", **summary}])
    assert lines == [f"here: beyond the guard's assumptions, nothing is promised: {summary['assumptions_broken'][0]}"]
    assert json.loads(json.dumps(summary))["guard"] == summary["guard"]


@pytest.mark.parametrize("delay", [6, pytest.param(8, marks=pytest.mark.slow)])
def test_long_delays_fly(base, delay):
    push = {"kind": "constant", "force": (0.002, 0.0, 0.0)}
    flight = fly(base.replace(faults={"delay": delay}, guard={"delay": delay}, disturbance=push, duration=200.0))
    summary = flight.summary()
    assert (summary["reached"], summary["start_certified"], summary["guard_flags"]) == (True, True, {})
    assert flight.audit.contact is Contact.NO


@pytest.mark.slow
def test_faults_of_a_scenario_are_flown_and_shown(base):
    faults = {"law": "into the body", "delay": 1, "gain_error": 0.02, "position_noise": 0.01, "velocity_noise": 3e-4}
    guard = {"delay": 1, "gain_error": 0.02, "position_error": 0.01, "velocity_error": 3e-4}
    flight = fly(base.replace(faults=faults, guard=guard))
    summary = flight.summary()
    assert flight.audit.contact is Contact.NO
    assert summary["faults"] == faults
    assert summary["guard_flags"] == {}
    assert summary["statuses"]["guard"]["clear"] < 150
    record = flight.record
    off = np.linalg.norm(record.estimated_position - record.position, axis=1)
    assert 0.005 < off.max() <= 0.01
    ratio = record.force[1:] / np.where(record.guarded_force[:-1] == 0.0, np.nan, record.guarded_force[:-1])
    assert np.nanmax(np.abs(ratio - 1.0)) <= 0.02 + 1e-9, "each command takes effect a period late, within its gain"
    assert json.loads(json.dumps(summary))["faults"]["delay"] == 1


@pytest.mark.slow
def test_undeclared_faults_raise_flags(base):
    assert "state_jump" in fly(base.replace(faults={"law": "random", "delay": 2})).summary()["guard_flags"]
    assert "command" in fly(base.replace(faults={"law": "not a number"})).summary()["guard_flags"]
    stuck = fly(base.replace(faults={"stuck": "-z", "stuck_force": 0.1, "stuck_from": 20.0}))
    assert "state_jump" in stuck.summary()["guard_flags"]
    twice = {"kind": "constant", "force": (0.02, 0.0, 0.0), "bound": 0.01}
    assert "state_jump" in fly(base.replace(disturbance=twice)).summary()["guard_flags"]


@pytest.mark.slow
def test_leaving_the_region_is_flagged_and_mended(base):
    flight = fly(base.replace(start={"position": (30.0, 0.0, 0.0), "velocity": (0.5, 0.0, 0.0)}, duration=400.0))
    summary = flight.summary()
    assert summary["start_certified"] is False
    assert summary["guard_flags"]["region"] > 0
    assert flight.audit.contact is Contact.NO
    assert not flight.record.guard_status[-1] & 32, "and it comes back"


def test_the_guards_field_is_kept_and_a_damaged_one_built_anew(target):
    first = guard_field(target, 0.5)
    (path,) = cache_folder().glob("guard-*.keepout")
    written = path.stat().st_mtime_ns
    again = guard_field(target, 0.5)
    assert again.sha256 == first.sha256
    assert again.certificate(0.5) == first.certificate(0.5)
    assert path.stat().st_mtime_ns == written
    path.write_bytes(path.read_bytes()[:-100])
    said = []
    assert guard_field(target, 0.5, progress=lambda _, text: said.append(text)).sha256 == first.sha256
    assert "damaged" in said[0]
    assert FieldModel.load(path).sha256 == first.sha256
