"""Parts of a user's own that are not what they should be: refused when they are given, in one line that says what."""

import functools
import json
from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import keepout
from keepout.core.errors import ControlError, FieldError, KeepoutError, ScenarioError
from keepout.core.motion.chaser import Firing
from keepout.flights.pages import terminal
from keepout.flights.pages.folder import write_flight

GOAL = (0.0, -10.0, -4.0)
MISSION = """
duration = 20.0
[control]
guidance = "straight"
[guard]
enabled = false
"""


@pytest.fixture(autouse=True)
def _as_users_have_it(monkeypatch):
    """Without the tests' own check of every argument, which would be first to refuse."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("own") / "mission.toml"
    path.write_text(MISSION)
    return path


@pytest.fixture(scope="module")
def mission(path):
    return keepout.prepare(str(path))


def refused(kind: type[KeepoutError], give: Any, *given: Any, **chosen: Any) -> str:
    with pytest.raises(kind) as refusal:
        give(*given, **chosen)
    text = str(refusal.value)
    assert "\n" not in text
    assert len(text) < 400
    return text


@pytest.mark.long
def test_a_mission_is_prepared_from_a_path_or_tables(mission, path):
    assert mission.scenario == keepout.Scenario.load(path) == keepout.Scenario.of(mission.scenario.model_dump())
    for nothing in (3, None, {"duration": -20.0}, "absent.toml"):
        assert refused(ScenarioError, keepout.prepare, nothing)


class Law(keepout.Law):
    """Right in everything but what it is told to do instead."""

    wrong: dict[str, Any]

    def or_wrong(self, name: str, right: Any) -> Any:
        answer = self.wrong.get(name, right)
        return answer() if callable(answer) else answer

    @property
    def goal(self):
        return self.or_wrong("goal", jnp.zeros(3))

    def initial_state(self, state):
        return self.or_wrong("initial_state", jnp.zeros(()))

    def step(self, state, estimate):
        force = self.or_wrong("force", 0.0 * estimate.position)
        return self.or_wrong("step", (state + 1.0, keepout.Command.of_force(force)))

    def with_applied_force(self, state, force):
        return self.or_wrong("with_applied_force", state)


def fails() -> None:
    raise RuntimeError("two\nlines")


class Guard(keepout.SafetyLayer):
    answer: Any

    def initial_state(self, estimate):
        return ()

    def filter(self, guard_state, estimate, force, disturbance_estimate, errors=None, contradicted=None):
        return self.answer


class Push(keepout.Disturbance):
    answer: Any
    most: Any = 1.0

    def force(self, time):
        return self.answer() if callable(self.answer) else self.answer

    @property
    def bound(self):
        return self.most


class Nozzles(keepout.ThrusterModel):
    wrong: dict[str, Any]

    def apply(self, command):
        return self.wrong.get("apply", command)

    def saturated(self, command):
        return self.wrong.get("saturated", jnp.any(command > 1.0))

    def fire(self, state, command):
        return self.wrong.get("fire", (state, Firing(self.apply(command))))


class Leads(keepout.Guidance):
    goal: jax.Array
    answer: Any

    def desired_velocity(self, position):
        return self.answer


NAN = jnp.full(3, jnp.nan)
GIVEN = {
    "law": (ControlError, lambda mission, wrong: mission.with_law(Law(wrong))),
    "policy": (ControlError, lambda mission, policy: mission.with_law(keepout.PolicyLaw(GOAL, policy, on_host=True))),
    "own law": (ControlError, lambda mission, law: mission.with_law(law)),
    "guard": (ControlError, lambda mission, answer: mission.with_guard(Guard(answer))),
    "own guard": (ControlError, lambda mission, guard: mission.with_guard(guard)),
    "push": (ScenarioError, lambda mission, answer: mission.with_disturbance(Push(answer))),
    "bound": (ScenarioError, lambda mission, most: mission.with_disturbance(Push(jnp.zeros(3), most))),
    "own push": (ScenarioError, keepout.Mission.with_disturbance),
    "nozzles": (ScenarioError, lambda mission, wrong: mission.with_thrusters(Nozzles(wrong))),
    "own thrusters": (ScenarioError, keepout.Mission.with_thrusters),
    "leads": (ControlError, lambda mission, answer: with_guidance(mission, Leads(jnp.array(GOAL), answer))),
    "own guidance": (ControlError, lambda mission, guidance: with_guidance(mission, guidance)),
    "own field": (FieldError, keepout.Mission.with_field),
}
"""How a user gives each part, and the refusal that it is to be."""


def with_guidance(mission, guidance):
    return keepout.prepare(mission.scenario, guidance=guidance)


@pytest.mark.parametrize(
    ("part", "wrong", "said"),
    [
        ("law", {"goal": jnp.zeros(2)}, "law: Law.goal:  … float64[2] … (3,)"),
        ("law", {"step": lambda: jnp.zeros(3)}, "Law.step … float64[3] … memory and a keepout.Command"),
        ("law", {"step": fails}, "Law.step … RuntimeError: two … a keepout.Command"),
        ("law", {"force": lambda: jnp.zeros(2)}, "Law.step … (3,)"),
        ("law", {"force": lambda: NAN}, "Law.step … nan … finite"),
        ("law", {"step": lambda: (NAN, keepout.Command.of_force(NAN))}, "Law.step … float64[3] … memory … float64[]"),
        ("law", {"with_applied_force": lambda: {}}, "Law.with_applied_force … memory … float64[]"),
        ("policy", lambda *_: "north", "PolicyLaw.step"),
        ("own law", keepout.PolicyLaw(GOAL, lambda *_: np.zeros(2), on_host=False), "PolicyLaw.step … (3,)"),
        ("own law", lambda away, velocity, time: -away, "law:  … PolicyLaw"),
        ("guard", jnp.zeros(3), "guard: Guard.filter … a status"),
        ("guard", ((), jnp.zeros(3), "clear"), "whole number"),
        ("guard", (jnp.zeros(3), jnp.zeros(3), jnp.zeros((), int)), "memory"),
        ("own guard", "none", "guard:  … SafetyLayer"),
        ("push", fails, "disturbance: Push.force … RuntimeError: two … (3,)"),
        ("push", NAN, "Push.force … nan … (3,)"),
        *(("bound", most, "Push.bound … finite number") for most in ("1", True, jnp.ones(3), -1.0, np.inf)),
        ("own push", lambda time: time, "keepout.Disturbance"),
        ("nozzles", {"apply": jnp.full(3, jnp.inf)}, "inf"),
        ("nozzles", {"fire": jnp.zeros(3)}, "Firing"),
        ("nozzles", {"fire": (jnp.zeros(3), Firing(jnp.zeros(3)))}, "memory"),
        ("nozzles", {"saturated": jnp.zeros(3, bool)}, "Nozzles.saturated"),
        ("own thrusters", None, "thrusters:  … ThrusterModel"),
        ("leads", NAN, "Leads.desired_velocity … (3,)"),
        ("own guidance", lambda position: position, "keepout.Guidance"),
        ("own field", lambda point: jnp.linalg.norm(point) - 1.0, "stated_field"),
    ],
)
def test_a_part_that_is_none_is_refused_in_one_line(mission, part, wrong, said):
    kind, give = GIVEN[part]
    text = refused(kind, give, mission, wrong)
    for words in said.split(" … "):
        assert words in text


@pytest.mark.long
def test_a_law_that_is_right_is_taken(mission):
    assert mission.with_law(Law({})).setup.controller == Law({})
    assert mission.with_law(mission.setup.controller).setup == mission.setup
    assert mission.with_guard(None).setup.guard is None


class LosesItself(keepout.Law):
    """Commands what is no number from the sixth step on."""

    @property
    def goal(self):
        return jnp.array(GOAL)

    def initial_state(self, state):
        return 0

    def step(self, state, estimate):
        return state + 1, keepout.Command.of_force(jnp.where(state > 4, jnp.nan, 0.0) * jnp.ones(3))


@pytest.mark.slow  # pages and verdicts of such rows are in flights/pages/test_scene and core/audit
def test_a_flight_that_ends_in_no_numbers_is_told_and_kept(mission, tmp_path, coarse_surfaces):
    flight = mission.with_law(LosesItself()).fly()
    summary = json.loads(json.dumps(flight.summary(), allow_nan=False))
    told = summary["contact_verdict"], summary["minimum_clearance_m"], summary["final_error_m"]
    assert told == ("undecided", None, None)
    assert flight.verdict.why == "the sample at 5 s holds a number that is not finite"
    apart = mission.target.distance.distance(flight.record.position[:5]) - mission.scenario.chaser.radius
    np.testing.assert_allclose(flight.clearance[:5], apart)
    assert np.isnan(flight.clearance[-1])
    page = write_flight(tmp_path, "lost", flight, title="", introduction="")
    assert "where it ended is no number" in terminal.verdict(page)
    assert (tmp_path / "index.html").exists()


BOX = {"lower": [-1.0, -1.0, -1.0], "upper": [1.0, 1.0, 1.0]}


@pytest.mark.parametrize("make", [functools.partial(keepout.stated_field, lipschitz=1.0), keepout.sampled_field])
def test_a_field(make):
    for function, said in (
        (lambda point: point, "float64[3]"),
        (lambda point: (point[0], 1.0), "(float64[], float)"),
        (lambda point: jnp.sum(point.astype(int)), "int64[]"),
        (lambda point: float(point[0]), "ConcretizationTypeError"),
        (3.0, "float"),
    ):
        text = refused(FieldError, make, function, **BOX)
        assert text.startswith("field: ")
        assert said in text
        assert "one number" in text


def test_numbers_of_a_field():
    for wrong in ("1", None, True):
        assert "Lipschitz" in refused(FieldError, keepout.stated_field, jnp.linalg.norm, wrong, **BOX)
    for wrong in ([0.0, 0.0], "low", [0.0, 0.0, np.nan], [2.0, 0.0, 0.0]):
        assert "lower" in refused(FieldError, keepout.stated_field, jnp.linalg.norm, 1.0, **(BOX | {"lower": wrong}))
