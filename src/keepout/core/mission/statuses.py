"""What law and guard have to say, by name: the one legend of statuses and flags for flights, campaigns and files."""

from collections.abc import Mapping
from enum import IntEnum

import numpy as np
from jaxtyping import Int

from keepout.core.control.law import ControlStatus
from keepout.core.flight.outcome import FlightOutcome
from keepout.core.guard.status import GuardFlag, GuardStatus, flag_names

LAYERS: Mapping[str, type[IntEnum]] = {"control": ControlStatus, "guard": GuardStatus}
"""The enumeration of each layer's statuses."""


def legend() -> dict[str, dict[int, str]]:
    """Name every number that a flight file's columns `control_status` and `guard_status` are made of."""
    names = {f"{layer}_status": {int(s): s.name.lower() for s in kind} for layer, kind in LAYERS.items()}
    names["guard_status"] |= {int(flag): name for flag in GuardFlag for name in flag_names(flag)}
    return names


def status_counts(outcome: FlightOutcome) -> dict[str, dict[str, int]]:
    """Count the steps of one flight, or of all flights of a batch, by layer and status; those never met are left out.

    Args:
        outcome: of one flight, or with leading axes of many.

    """
    counted = {}
    for layer, kind in LAYERS.items():
        count = np.asarray(getattr(outcome, f"{layer}_status_counts"))
        count = count.reshape(-1, count.shape[-1]).sum(axis=0)
        counted[layer] = {status.name.lower(): int(count[status]) for status in kind if count[status]}
    return counted


def flag_counts(statuses: Int[np.ndarray, "n"]) -> dict[str, int]:
    """Count among guard statuses, of steps or of whole flights, those with each flag; flags never met are left out."""
    counts = {name: int(np.count_nonzero(statuses & flag)) for flag in GuardFlag for name in flag_names(flag)}
    return {name: count for name, count in counts.items() if count}
