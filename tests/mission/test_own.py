"""Parts of a user's own that are not what they should be: refused when they are given, in one line that says what."""

from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import keepout
from keepout.errors import ControlError, FieldError, KeepoutError, ScenarioError
from keepout.motion.actuator import Firing

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


def test_a_mission_is_prepared_from_a_path(mission, path):
    assert mission.scenario == keepout.Scenario.load(path)
    assert "absent.toml: cannot be read" in refused(ScenarioError, keepout.prepare, "absent.toml")
    for nothing in (3, None, {"duration": 20.0}):
        said = refused(ScenarioError, keepout.prepare, nothing)
        assert said == f"scenario: {type(nothing).__name__}; it must be a Scenario or the path of its TOML file"


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


HERE, NAN = jnp.zeros(()), jnp.full(3, jnp.nan)
GIVEN = {
    "law": (ControlError, lambda mission, wrong: mission.with_law(Law(wrong))),
    "policy": (ControlError, lambda mission, policy: mission.with_law(keepout.PolicyLaw(GOAL, policy, on_host=True))),
    "own law": (ControlError, lambda mission, law: mission.with_law(law)),
    "guard": (ControlError, lambda mission, answer: mission.with_guard(Guard(answer))),
    "own guard": (ControlError, lambda mission, guard: mission.with_guard(guard)),
    "push": (ScenarioError, lambda mission, answer: keepout.with_disturbance(mission, Push(answer))),
    "bound": (ScenarioError, lambda mission, most: keepout.with_disturbance(mission, Push(jnp.zeros(3), most))),
    "own push": (ScenarioError, keepout.with_disturbance),
    "nozzles": (ScenarioError, lambda mission, wrong: keepout.with_thrusters(mission, Nozzles(wrong))),
    "own thrusters": (ScenarioError, keepout.with_thrusters),
    "leads": (ControlError, lambda mission, answer: with_guidance(mission, Leads(jnp.array(GOAL), answer))),
    "own guidance": (ControlError, lambda mission, guidance: with_guidance(mission, guidance)),
    "own field": (FieldError, keepout.with_field),
}
"""How a user gives each part, and the refusal that it is to be."""


def with_guidance(mission, guidance):
    return keepout.prepare(mission.scenario, guidance=guidance)


@pytest.mark.parametrize(
    ("part", "wrong", "said"),
    [
        ("law", {"goal": jnp.zeros(2)}, "law: Law.goal:  … float64[2] … (3,)"),
        ("law", {"goal": fails}, "Law.goal … RuntimeError: two … (3,)"),
        ("law", {"step": lambda: jnp.zeros(3)}, "Law.step … float64[3] … memory and a keepout.Command"),
        ("law", {"step": fails}, "Law.step … RuntimeError: two … a keepout.Command"),
        ("law", {"force": lambda: jnp.zeros(2)}, "Law.step … (3,)"),
        ("law", {"force": lambda: jnp.zeros(3, int)}, "Law.step … (3,)"),
        ("law", {"force": lambda: NAN}, "Law.step … nan … finite"),
        ("law", {"initial_state": lambda: jnp.zeros(2), "step": None}, "Law.step … NoneType … keepout.Command"),
        (
            "law",
            {"step": lambda: (jnp.zeros(2), keepout.Command.of_force(jnp.zeros(3)))},
            "Law.step … float64[2] … memory … float64[]",
        ),
        ("law", {"with_applied_force": lambda: {}}, "Law.with_applied_force … memory … float64[]"),
        ("policy", lambda *_: np.zeros(2), "PolicyLaw.step … (3,)"),
        ("policy", lambda *_: "north", "PolicyLaw.step"),
        ("policy", lambda one: one, "PolicyLaw.step … Error: "),
        ("own law", keepout.PolicyLaw(GOAL, lambda *_: np.zeros(2), on_host=False), "PolicyLaw.step … (3,)"),
        ("own law", lambda away, velocity, time: -away, "law:  … PolicyLaw"),
        ("guard", jnp.zeros(3), "guard: Guard.filter … a status"),
        ("guard", ((), jnp.zeros(2), jnp.zeros((), int)), "guard: Guard.filter … float64[2]"),
        ("guard", ((), jnp.zeros(3), "clear"), "whole number"),
        ("guard", (jnp.zeros(3), jnp.zeros(3), jnp.zeros((), int)), "memory"),
        ("own guard", "none", "guard:  … SafetyLayer"),
        ("push", jnp.zeros(2), "disturbance: Push.force … float64[2] … (3,)"),
        ("push", fails, "Push.force … RuntimeError: two … (3,)"),
        ("push", NAN, "Push.force … nan … (3,)"),
        *(("bound", most, "disturbance: Push.bound … finite number of at least 0") for most in ("1", True)),
        *(("bound", most, "Push.bound … finite number") for most in (jnp.ones(3), -1.0, np.inf)),
        ("own push", lambda time: time, "keepout.Disturbance"),
        ("nozzles", {"apply": jnp.zeros(2)}, "thrusters: Nozzles.fire"),
        ("nozzles", {"apply": jnp.full(3, jnp.inf)}, "inf"),
        ("nozzles", {"fire": jnp.zeros(3)}, "Firing"),
        ("nozzles", {"fire": (jnp.zeros(3), Firing(jnp.zeros(3)))}, "memory"),
        ("nozzles", {"saturated": jnp.zeros(3, bool)}, "Nozzles.saturated"),
        ("own thrusters", None, "thrusters:  … ThrusterModel"),
        ("leads", jnp.zeros(2), "guidance: Leads.desired_velocity … (3,)"),
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


def test_a_law_that_is_right_is_taken(mission):
    assert mission.with_law(Law({})).setup.controller == Law({})
    assert mission.with_law(mission.setup.controller).setup == mission.setup
    assert mission.with_guard(None).setup.guard is None


BOX = {"lower": [-1.0, -1.0, -1.0], "upper": [1.0, 1.0, 1.0]}


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda point: point, "float64[3]"),
        (lambda point: (point[0], 1.0), "(float64[], float)"),
        (lambda point: jnp.sum(point.astype(int)), "int64[]"),
        (lambda point: float(point[0]), "ConcretizationTypeError"),
        (3.0, "float"),
    ],
)
def test_a_field(function, said):
    for make in (lambda: keepout.stated_field(function, 1.0, **BOX), lambda: keepout.sampled_field(function, **BOX)):
        text = refused(FieldError, make)
        assert text.startswith("field: ")
        assert said in text
        assert "one number" in text


def test_numbers_of_a_field():
    def distance(point):
        return jnp.linalg.norm(point) - 1.0

    for wrong in ("1", None, True):
        assert "Lipschitz" in refused(FieldError, keepout.stated_field, distance, wrong, **BOX)
    for wrong in ([0.0, 0.0], "low", [0.0, 0.0, np.nan], [2.0, 0.0, 0.0]):
        assert "lower" in refused(FieldError, keepout.stated_field, distance, 1.0, **(BOX | {"lower": wrong}))
