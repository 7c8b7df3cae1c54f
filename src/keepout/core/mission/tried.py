"""Parts of a user's own, each tried at a mission's start before anything is flown: what they must answer, in words."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from keepout.core.compiled.tried import THREE_NUMBERS, computed, described, require_numbers, require_same, tried
from keepout.core.control.controller import Controller
from keepout.core.control.law import Command, Law
from keepout.core.errors import ControlError, ScenarioError
from keepout.core.guard.safety_layer import SafetyLayer
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.chaser import Firing, ThrusterModel
from keepout.core.motion.disturbance import Disturbance
from keepout.core.motion.relative import MotionState

_COMMAND = "its memory and a keepout.Command whose force is three finite numbers, N, an array (3,) of floats"
_FILTERED = "its memory, a force (3,) of floats, N, and a status, one whole number"
_FIRED = "its memory and a Firing whose force is three finite numbers, N, an array (3,) of floats"
_NUMBERS_OF_COMMAND = {
    **dict.fromkeys(("desired_velocity", "safe_velocity", "disturbance_estimate"), (3,)),
    **dict.fromkeys(("barrier", "backstepping_barrier", "lyapunov"), ()),
}


def require_law(law: Any, start: MotionState) -> None:
    """Refuse what is no control law, or answers otherwise than `control.law.Law` says.

    It is traced at the start; one that is not the package's own is also computed there, and its force must be finite.

    Raises:
        ControlError: naming the method, what it gives and what it must give.

    """
    if not isinstance(law, Law):
        raise ControlError(
            f"law: {described(law)}; it must be a keepout.Law; of a callable, keepout.PolicyLaw(goal, callable) is one"
        )
    name = f"law: {type(law).__name__}"
    asked: dict[str, Any] = {"part": f"{name}.goal", "wanted": f"{THREE_NUMBERS}, m", "refusal": ControlError}
    require_numbers(tried(lambda: law.goal, **asked), (3,), **asked)
    asked |= {"part": f"{name}.initial_state", "wanted": "a memory, a pytree of arrays"}
    memory = tried(law.initial_state, start, **asked)
    asked |= {"part": f"{name}.step", "wanted": _COMMAND}
    after, command = _pair(tried(law.step, memory, start, **asked), Command, asked)
    require_same(after, memory, part=f"{name}.step", refusal=ControlError)
    require_numbers(command.force, (3,), **asked)
    for key, shape in _NUMBERS_OF_COMMAND.items():
        wanted = f"{key} as an array {shape} of floats"
        require_numbers(getattr(command, key), shape, part=f"{name}.step", wanted=wanted, refusal=ControlError)
    of_status: dict[str, Any] = asked | {"wanted": "a status, one whole number"}
    require_numbers(command.status, (), kind=np.integer, **of_status)
    told: dict[str, Any] = {"part": f"{name}.with_applied_force", "wanted": "its memory", "refusal": ControlError}
    require_same(
        tried(law.with_applied_force, after, command.force, **told), memory, part=told["part"], refusal=ControlError
    )
    if not isinstance(law, Controller):
        force = computed(lambda law, start: law.step(law.initial_state(start), start)[1].force, law, start, **asked)
        require_numbers(force, (3,), **asked)


def require_guard(guard: Any, start: MotionState) -> None:
    """Refuse what is no safety layer, or answers otherwise than `guard.safety_layer.SafetyLayer` says.

    Raises:
        ControlError: naming the method, what it gives and what it must give.

    """
    if guard is None:
        return
    if not isinstance(guard, SafetyLayer):
        raise ControlError(f"guard: {described(guard)}; it must be a keepout.SafetyLayer, or None")
    name = f"guard: {type(guard).__name__}"
    asked: dict[str, Any] = {"part": f"{name}.initial_state", "wanted": "a memory", "refusal": ControlError}
    memory = tried(guard.initial_state, start, **asked)
    asked |= {"part": f"{name}.filter", "wanted": _FILTERED}
    # With sensors it is told the errors of what it is told, and whether that contradicts itself.
    known = jnp.zeros(2), jnp.zeros((), bool)
    answer = tried(guard.filter, memory, start, jnp.zeros(3), jnp.zeros(3), *known, **asked)
    if not (isinstance(answer, tuple) and len(answer) == 3):
        raise ControlError(f"{name}.filter: gives {described(answer)}; it must give {_FILTERED}")
    require_same(answer[0], memory, part=f"{name}.filter", refusal=ControlError)
    require_numbers(answer[1], (3,), **asked)
    require_numbers(answer[2], (), kind=np.integer, **asked)


def require_disturbance(disturbance: Any) -> None:
    """Refuse what is no disturbance, or answers otherwise than `motion.disturbance.Disturbance` says.

    Raises:
        ScenarioError: naming the method, what it gives and what it must give.

    """
    if not isinstance(disturbance, Disturbance):
        raise ScenarioError(f"disturbance: {described(disturbance)}; it must be a keepout.Disturbance")
    name = f"disturbance: {type(disturbance).__name__}"
    asked: dict[str, Any] = {"part": f"{name}.force", "wanted": f"{THREE_NUMBERS}, N", "refusal": ScenarioError}
    now = as_float64(0.0)
    require_numbers(tried(disturbance.force, now, **asked), (3,), **asked)
    require_numbers(computed(lambda part, time: part.force(time), disturbance, now, **asked), (3,), **asked)
    for key in ("bound", "longest_stretch"):
        number = getattr(disturbance, key)
        right = not isinstance(number, bool) and isinstance(number, int | float | np.number)
        if not (right and number >= 0.0 and (key != "bound" or math.isfinite(number))):
            shown = described(number) if not right else f"{number}"
            raise ScenarioError(f"{name}.{key}: gives {shown}; it must be a finite number of at least 0")
    asked |= {"part": f"{name}.switches", "wanted": "times, an array (switches,) of floats, s"}
    switches = tried(disturbance.switches, now, now, **asked)
    require_numbers(switches, np.shape(switches)[:1] if np.shape(switches) else (0,), **asked)
    asked |= {"part": f"{name}.between_switches", "wanted": "a keepout.Disturbance"}
    between = tried(disturbance.between_switches, now, **asked)
    if not isinstance(between, Disturbance):
        raise ScenarioError(f"{name}.between_switches: gives {described(between)}; it must give a keepout.Disturbance")


def require_thruster_model(thrusters: Any) -> None:
    """Refuse what are no thrusters, or answer otherwise than `motion.chaser.ThrusterModel` says.

    Raises:
        ScenarioError: naming the method, what it gives and what it must give.

    """
    if not isinstance(thrusters, ThrusterModel):
        raise ScenarioError(f"thrusters: {described(thrusters)}; they must be a keepout.ThrusterModel")
    name, key, command = f"thrusters: {type(thrusters).__name__}", jax.random.key(0), jnp.zeros(3)
    asked: dict[str, Any] = {"part": f"{name}.initial_state", "wanted": "a memory", "refusal": ScenarioError}
    memory = tried(thrusters.initial_state, key, **asked)
    asked |= {"part": f"{name}.fire", "wanted": _FIRED}
    after, firing = _pair(tried(thrusters.fire, memory, command, **asked), Firing, asked)
    require_same(after, memory, part=f"{name}.fire", refusal=ScenarioError)
    require_numbers(firing.force, (3,), **asked)
    force = computed(lambda part, key: part.fire(part.initial_state(key), command)[1].force, thrusters, key, **asked)
    require_numbers(force, (3,), **asked)
    asked |= {"part": f"{name}.saturated", "wanted": "one truth value, an array () of bool"}
    require_numbers(tried(thrusters.saturated, command, **asked), (), kind=np.bool_, **asked)


def _pair(answer: Any, second: type, asked: dict[str, Any]) -> tuple[Any, Any]:
    if not (isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[1], second)):
        raise asked["refusal"](f"{asked['part']}: gives {described(answer)}; it must give {asked['wanted']}")
    return answer
