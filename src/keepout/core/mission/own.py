"""A mission with parts of your own: disturbance, thrusters, field. Law and guard: `Mission.with_law`, `with_guard`."""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from keepout.core.compiled.tried import described
from keepout.core.errors import FieldError, ScenarioError
from keepout.core.fields.own import FunctionField
from keepout.core.mission import environment
from keepout.core.mission.build import Mission
from keepout.core.mission.law import broken_as, law_on
from keepout.core.mission.tried import require_disturbance, require_thruster_model
from keepout.core.motion.arrays import as_float64
from keepout.core.motion.chaser import ThrusterModel
from keepout.core.motion.disturbance import Disturbance
from keepout.core.progress import Progress, silent

_ROUNDING = 1.0 + 1e-9
_TRIED = 2001
"""Moments of a flight at which a disturbance is held against its bound."""


def with_disturbance(mission: Mission, disturbance: Disturbance) -> Mission:
    """Give the same mission with another disturbance; law and guard assume what they assumed, the audit is told of it.

    Where its bound is above what they assume, that is an assumption broken, and nothing is promised.

    Raises:
        ScenarioError: it does not answer as a disturbance, or its force is found above the bound that it states.

    """
    require_disturbance(disturbance)
    bound, times = disturbance.bound, np.linspace(0.0, mission.scenario.duration, _TRIED)
    found = float(np.linalg.norm(np.asarray(_forces(disturbance, as_float64(times))), axis=1).max())
    if not found <= bound * _ROUNDING:
        raise ScenarioError(f"disturbance: it states a bound of {bound:.6g} N, and its force is found at {found:.6g} N")
    assumed = environment.disturbance_bound(mission.scenario)
    broken = mission.assumptions_broken
    if bound > assumed * _ROUNDING:
        broken = (*broken, f"disturbance: flown up to {bound:.6g} N > disturbance.bound {assumed:.6g} N")
    certified = mission.start_certified
    return replace(
        mission,
        setup=replace(mission.setup, disturbance=disturbance),
        own_push=bound,
        start_certified=None if certified is None else certified and not broken,
        assumptions_broken=broken,
    )


@eqx.filter_jit
def _forces(disturbance: Disturbance, times: Float[Array, " n"]) -> Float[Array, "n 3"]:
    return jax.vmap(disturbance.force)(times)


def with_thrusters(mission: Mission, thrusters: ThrusterModel) -> Mission:
    """Give the same mission with other thrusters; law and guard assume the scenario's.

    The guard's theorem asks for thrusters that give what is commanded within `guard.gain_error`. Whether these do is
    not known, so nothing is certified of the start.

    Raises:
        ScenarioError: tried on an example, they do not answer as thrusters.

    """
    require_thruster_model(thrusters)
    said = "thrusters: others than the scenario's (what they give of a command is not known)"
    return replace(
        mission,
        setup=replace(mission.setup, thrusters=thrusters),
        start_certified=None if mission.start_certified is None else False,
        assumptions_broken=(*mission.assumptions_broken, said),
    )


def with_field(mission: Mission, field: FunctionField, *, leaf: float = 0.1, progress: Progress = silent) -> Mission:
    """Give the same mission with the scenario's law built on another field; the guard keeps its own.

    The law's error bound is `certificate.stated_error_bound`: proved if the field's Lipschitz bound is true.

    Args:
        mission: as `prepare` built it.
        field: of `stated_field` or `sampled_field`.
        leaf: side of the cubes that the bound is proved with, m.
        progress: called while the guidance is made.

    Raises:
        KeepoutError: the law cannot be built on it; the message names the entry.

    """
    if not isinstance(field, FunctionField):
        raise FieldError(f"field: {described(field)}; it must be one of keepout.stated_field or keepout.sampled_field")
    scenario = mission.scenario
    bound = stated_error_bound(field, mission.target, scenario.chaser.radius, leaf=leaf)
    law = law_on(scenario, field, bound, progress=progress)
    return replace(mission, setup=replace(mission.setup, controller=broken_as(scenario, law, field), field=field))
