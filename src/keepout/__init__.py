"""Keepout: learn a spacecraft's shape, prove how wrong it can be, and fly around it without touching it."""

import importlib
from typing import TYPE_CHECKING, Any

import jax

# Dynamics, cone program and observer need float64; switching it on here makes forgetting it impossible.
jax.config.update("jax_enable_x64", True)

from keepout.errors import KeepoutError  # noqa: E402  (x64 must be on before anything builds an array)

if TYPE_CHECKING:
    from keepout.control.guidance.guidance import Guidance
    from keepout.control.guidance.plan import GuidancePlan
    from keepout.control.law import Command, Law
    from keepout.fields.field import Field
    from keepout.fields.model import FieldModel
    from keepout.fields.shipped import load_shipped
    from keepout.flight.on_board import OnBoard
    from keepout.flight.record import FlightRecord
    from keepout.geometry.target import Target
    from keepout.guard.safety_layer import SafetyLayer
    from keepout.learning.training import fit
    from keepout.mission.build import Mission, prepare
    from keepout.mission.campaign import Campaign, run_campaign
    from keepout.mission.flight import Flight, fly
    from keepout.mission.scenario import Scenario
    from keepout.motion.chaser import Chaser
    from keepout.motion.disturbance import Disturbance
    from keepout.proof.certificate import certify

__version__ = "0.1.0"

# Loaded on first use, so that the command line answers at once.
_HOMES = {
    "Field": "keepout.fields.field",
    "Disturbance": "keepout.motion.disturbance",
    "SafetyLayer": "keepout.guard.safety_layer",
    "GuidancePlan": "keepout.control.guidance.plan",
    "Guidance": "keepout.control.guidance.guidance",
    "Law": "keepout.control.law",
    "Command": "keepout.control.law",
    "Chaser": "keepout.motion.chaser",
    "Campaign": "keepout.mission.campaign",
    "run_campaign": "keepout.mission.campaign",
    "certify": "keepout.proof.certificate",
    "FieldModel": "keepout.fields.model",
    "load_shipped": "keepout.fields.shipped",
    "fit": "keepout.learning.training",
    "OnBoard": "keepout.flight.on_board",
    "FlightRecord": "keepout.flight.record",
    "Target": "keepout.geometry.target",
    "Flight": "keepout.mission.flight",
    "Mission": "keepout.mission.build",
    "fly": "keepout.mission.flight",
    "prepare": "keepout.mission.build",
    "Scenario": "keepout.mission.scenario",
}

__all__ = [
    "Campaign",
    "Chaser",
    "Command",
    "Disturbance",
    "Field",
    "FieldModel",
    "Flight",
    "FlightRecord",
    "Guidance",
    "GuidancePlan",
    "KeepoutError",
    "Law",
    "Mission",
    "OnBoard",
    "SafetyLayer",
    "Scenario",
    "Target",
    "__version__",
    "certify",
    "fit",
    "fly",
    "load_shipped",
    "prepare",
    "run_campaign",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'keepout' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
