"""Keepout: learn a spacecraft's shape, prove how wrong it can be, and fly around it without touching it."""

from typing import Any

import lazy_loader

from keepout.core.compiled.xla import require_double_precision

# Dynamics, cone program and observer need float64; switching it on here makes forgetting it impossible.
require_double_precision()

__version__ = "0.2.0"

# Loaded on first use, so that the command line answers at once; `__init__.pyi` says what is there.
_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

_OLD = {
    "Check": ("verbs.check:Check", "keepout.verbs.check.Check"),
    "FunctionField": ("core.fields.own:FunctionField", "keepout.core.fields.own.FunctionField"),
    "GuidancePlan": ("core.control.guidance:GuidancePlan", "keepout.core.control.guidance.GuidancePlan"),
    "fly_mission": ("core.mission.build:Mission.fly", "mission.fly()"),
    "run_campaign": ("apps.reproduction.in_memory:run_campaign", "keepout.campaign(…)"),
    "with_disturbance": ("core.mission.build:Mission.with_disturbance", "mission.with_disturbance(…)"),
    "with_field": ("core.mission.build:Mission.with_field", "mission.with_field(…)"),
    "with_thrusters": ("core.mission.build:Mission.with_thrusters", "mission.with_thrusters(…)"),
}
"""Names that go with the next version: where each is, and what is said instead."""


def __getattr__(name: str) -> Any:
    if name not in _OLD:
        return _public(name)
    import warnings
    from pkgutil import resolve_name

    place, instead = _OLD[name]
    warnings.warn(f"keepout.{name} goes with the next version; write {instead}", DeprecationWarning, stacklevel=2)
    return resolve_name(f"keepout.{place}")
