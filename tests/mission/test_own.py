"""Parts of a user's own that are not what they should be: refused when they are given, in one line that says what."""

from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import keepout
from keepout.errors import ControlError, FieldError, KeepoutError, ScenarioError
from keepout.motion import MotionState
from keepout.motion.actuator import Firing

pytestmark = pytest.mark.long

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


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"goal": jnp.zeros(2)}, ("Law.goal", "float64[2]", "(3,)")),
        ({"goal": fails}, ("Law.goal", "RuntimeError: two", "(3,)")),
        ({"step": lambda: jnp.zeros(3)}, ("Law.step", "float64[3]", "memory and a keepout.Command")),
        ({"step": lambda: (jnp.zeros(()), jnp.zeros(3))}, ("Law.step", "float64[3]", "a keepout.Command")),
        ({"step": fails}, ("Law.step", "RuntimeError: two", "a keepout.Command")),
        ({"force": lambda: jnp.zeros(2)}, ("Law.step", "(3,)")),
        ({"force": lambda: jnp.zeros(3, int)}, ("Law.step", "(3,)")),
        ({"force": lambda: "north"}, ("Law.step", "(3,)")),
        ({"force": lambda: jnp.full(3, jnp.nan)}, ("Law.step", "nan", "finite")),
        ({"initial_state": lambda: jnp.zeros(2), "step": None}, ("Law.step", "NoneType", "keepout.Command")),
        (
            {"step": lambda: (jnp.zeros(2), keepout.Command.of_force(jnp.zeros(3)))},
            ("Law.step", "memory", "float64[2]", "float64[]"),
        ),
        ({"with_applied_force": lambda: {}}, ("Law.with_applied_force", "memory", "float64[]")),
    ],
)
def test_a_law(mission, wrong, said):
    text = refused(ControlError, mission.with_law, Law(wrong))
    assert text.startswith("law: ")
    for part in said:
        assert part in text


def test_a_law_that_is_right_is_taken_and_one_that_is_no_law_is_named(mission):
    assert mission.with_law(Law({})).setup.controller == Law({})
    assert mission.with_law(mission.setup.controller).setup == mission.setup
    assert mission.with_guard(None).setup.guard is None
    assert "PolicyLaw" in refused(ControlError, mission.with_law, lambda away, velocity, time: -away)


@pytest.mark.parametrize("on_host", [True, False])
@pytest.mark.parametrize("policy", [lambda *_: np.zeros(2), lambda *_: "north", lambda *_: None, lambda one: one])
def test_a_policy(mission, policy, on_host):
    text = refused(ControlError, mission.with_law, keepout.PolicyLaw(GOAL, policy, on_host=on_host))
    assert "PolicyLaw.step" in text
    assert "Error: " in text or "(3,)" in text


class Guard(keepout.SafetyLayer):
    answer: Any

    def initial_state(self, estimate):
        return ()

    def filter(self, guard_state, estimate, force, disturbance_estimate, errors=None, contradicted=None):
        return self.answer


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (jnp.zeros(3), "a status"),
        (((), jnp.zeros(2), jnp.zeros((), int)), "float64[2]"),
        (((), jnp.zeros(3), jnp.zeros(())), "whole number"),
        (((), jnp.zeros(3), "clear"), "whole number"),
        ((jnp.zeros(3), jnp.zeros(3), jnp.zeros((), int)), "memory"),
    ],
)
def test_a_guard(mission, answer, said):
    text = refused(ControlError, mission.with_guard, Guard(answer))
    assert text.startswith("guard: Guard.filter")
    assert said in text
    assert "SafetyLayer" in refused(ControlError, mission.with_guard, "none")


class Push(keepout.Disturbance):
    answer: Any
    most: Any = 1.0

    def force(self, time):
        return self.answer() if callable(self.answer) else self.answer

    @property
    def bound(self):
        return self.most


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (jnp.zeros(2), "float64[2]"),
        ([0.0, 0.0, 0.0], "list"),
        (0.01, "float"),
        (fails, "RuntimeError: two"),
        (jnp.full(3, jnp.nan), "nan"),
    ],
)
def test_a_disturbance(mission, answer, said):
    text = refused(ScenarioError, keepout.with_disturbance, mission, Push(answer))
    assert text.startswith("disturbance: Push.force")
    assert said in text
    assert "(3,)" in text


@pytest.mark.parametrize("most", ["1", None, jnp.ones(3), -1.0, np.nan, np.inf, True])
def test_a_bound_of_a_disturbance(mission, most):
    text = refused(ScenarioError, keepout.with_disturbance, mission, Push(jnp.zeros(3), most))
    assert text.startswith("disturbance: Push.bound")
    assert "finite number of at least 0" in text
    assert "keepout.Disturbance" in refused(ScenarioError, keepout.with_disturbance, mission, lambda time: time)


class Nozzles(keepout.ThrusterModel):
    wrong: dict[str, Any]

    def apply(self, command):
        return self.wrong.get("apply", command)

    def saturated(self, command):
        return self.wrong.get("saturated", jnp.any(command > 1.0))

    def fire(self, state, command):
        return self.wrong.get("fire", (state, Firing(self.apply(command))))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"apply": jnp.zeros(2)}, "Nozzles.fire"),
        ({"apply": "no"}, "Nozzles.fire"),
        ({"apply": jnp.full(3, jnp.inf)}, "inf"),
        ({"fire": jnp.zeros(3)}, "Firing"),
        ({"fire": (jnp.zeros(3), Firing(jnp.zeros(3)))}, "memory"),
        ({"saturated": jnp.zeros(3, bool)}, "Nozzles.saturated"),
        ({"saturated": jnp.zeros(())}, "Nozzles.saturated"),
    ],
)
def test_thrusters(mission, wrong, said):
    text = refused(ScenarioError, keepout.with_thrusters, mission, Nozzles(wrong))
    assert text.startswith("thrusters: ")
    assert said in text
    assert "ThrusterModel" in refused(ScenarioError, keepout.with_thrusters, mission, None)


class Leads(keepout.Guidance):
    goal: jax.Array
    answer: Any

    def desired_velocity(self, position):
        return self.answer


class Plans(keepout.GuidancePlan):
    def guidance(self, field, offset, goal, **motion):
        return "straight on"


@pytest.mark.parametrize("answer", [jnp.zeros(2), "north", jnp.full(3, jnp.nan)])
def test_a_guidance(mission, answer):
    text = refused(ControlError, keepout.prepare, mission.scenario, guidance=Leads(jnp.array(GOAL), answer))
    assert text.startswith("guidance: Leads.desired_velocity")
    assert "(3,)" in text
    for nothing in (lambda position: position, Plans()):
        assert "keepout.Guidance" in refused(ControlError, keepout.prepare, mission.scenario, guidance=nothing)


BOX = {"lower": [-1.0, -1.0, -1.0], "upper": [1.0, 1.0, 1.0]}


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda point: point, "float64[3]"),
        (lambda point: "far", "str"),
        (lambda point: (point[0], 1.0), "(float64[], float)"),
        (lambda point, other: point[0], "TypeError"),
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


def test_numbers_of_a_field(mission):
    def distance(point):
        return jnp.linalg.norm(point) - 1.0

    for wrong in ("1", None, True):
        assert "Lipschitz" in refused(FieldError, keepout.stated_field, distance, wrong, **BOX)
    for wrong in ([0.0, 0.0], "low", [0.0, 0.0, np.nan], [2.0, 0.0, 0.0]):
        assert "lower" in refused(FieldError, keepout.stated_field, distance, 1.0, **(BOX | {"lower": wrong}))
    assert "stated_field" in refused(FieldError, keepout.with_field, mission, distance)


def test_what_is_tried_is_a_motion_of_the_mission(mission):
    """The example is the start itself, with the target's orbit and attitude: a law may read all of it."""
    seen = []

    class Curious(Law):
        def step(self, state, estimate: MotionState):
            seen.append(estimate.target_orbit is None)
            return super().step(state, estimate)

    mission.with_law(Curious({}))
    assert seen
    assert seen[0] == (mission.initial.target_orbit is None)
