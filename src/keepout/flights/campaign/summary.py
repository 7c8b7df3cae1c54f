"""A campaign's figures as plain numbers, read off its folder."""

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from keepout.core.audit.audit import Contact
from keepout.core.guard.status import GuardFlag, flag_names
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.statuses import LAYERS
from keepout.flights.campaign.bands import QUANTITIES
from keepout.flights.campaign.dataset import Dataset
from keepout.flights.campaign.table import FLOWN

SHARES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Quantiles that the bands are read off at."""

_READ = (
    *("run", "status", "reason", "start_drawn_again", "reached", "contact", "minimum_clearance", "minimum_barrier"),
    *("delta_v", "time_to_reach", "final_error", "saturated_fraction", "guard_interventions", "guard_flags"),
    *("start_certified", "assumptions_broken"),
)


def summary(dataset: Dataset, scenario: Scenario) -> dict[str, Any]:
    """Give the figures of a complete campaign for JSON; a contact is whatever the audit does not exclude."""
    counted = [f"{layer}_steps.{status.name.lower()}" for layer, kind in LAYERS.items() for status in kind]
    whole = dataset.table([*_READ, *counted])
    flown = whole.filter(pc.equal(whole["status"], FLOWN))  # pyright: ignore[reportAttributeAccessIssue]
    refused = whole.filter(pc.not_equal(whole["status"], FLOWN))  # pyright: ignore[reportAttributeAccessIssue]
    contact = flown["contact"].to_numpy(zero_copy_only=False)
    certified = _numbers(flown, "start_certified")
    clearance = _numbers(flown, "minimum_clearance")
    worst = np.lexsort((_numbers(flown, "run"), clearance))[:10]
    return {
        "runs": len(whole),
        "flown": len(flown),
        "refused": len(refused),
        "refusals": _common(refused),
        "reached": int(np.sum(_numbers(flown, "reached"))),
        "contacts": int(np.sum(contact != str(Contact.NO))),
        "undecided": int(np.sum(contact == str(Contact.UNDECIDED))),
        "minimum_clearance_m": _least(clearance),
        "minimum_barrier_m": _least(_numbers(flown, "minimum_barrier")),
        "below_barrier": int(np.sum(_numbers(flown, "minimum_barrier") < 0.0)),
        "starts_drawn_again": int(np.sum(_numbers(whole, "start_drawn_again"))),
        "median_delta_v_mps": _median(_numbers(flown, "delta_v")),
        "saturated_fraction": float(np.mean(_numbers(flown, "saturated_fraction"))) if len(flown) else None,
        "guard_interventions": int(np.sum(_numbers(flown, "guard_interventions"))),
        "statuses": {
            layer: {
                status.name.lower(): total
                for status in kind
                if (total := int(np.sum(_numbers(flown, f"{layer}_steps.{status.name.lower()}"))))
            }
            for layer, kind in LAYERS.items()
        },
        "starts_certified": None if np.isnan(certified).all() else int(np.nansum(certified)),
        "assumptions_broken": _broken(flown),
        "flagged": _flagged(flown),
        "faults": scenario.faults.model_dump(exclude_defaults=True),
        "worst_runs": [int(run) for run in _numbers(flown, "run")[worst]],
        "seed": scenario.seed,
    }


def band_figures(dataset: Dataset) -> dict[str, Any]:
    """Give the quantiles over time of every quantity for JSON; see `Bands.quantiles` for what they are within."""
    bands = dataset.bands()
    return {
        "time_s": bands.time.tolist(),
        "shares": list(SHARES),
        **{
            name: [[float(x) if np.isfinite(x) else None for x in row] for row in bands.quantiles(name, SHARES)]
            for name in QUANTITIES
        },
    }


def _numbers(of: pa.Table, name: str) -> np.ndarray:
    return np.asarray(of[name].cast(pa.float64()).to_numpy(zero_copy_only=False), float)


def _least(values: np.ndarray) -> float | None:
    return float(np.min(values)) if values.size and np.isfinite(np.min(values)) else None


def _median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if values.size and np.isfinite(np.median(values)) else None


def _common(refused: pa.Table) -> list[dict[str, Any]]:
    """Give the first refused runs with their reasons; the table has all."""
    return [{"run": row["run"], "reason": row["reason"]} for row in refused.slice(0, 10).to_pylist()]


def _broken(flown: pa.Table) -> list[str]:
    return sorted(text for text in flown["assumptions_broken"].unique().to_pylist()[:10] if text)


def _flagged(flown: pa.Table) -> dict[str, int]:
    counts = {entry["values"]: entry["counts"] for entry in flown["guard_flags"].value_counts().to_pylist()}
    names = [name for flag in GuardFlag for name in flag_names(flag)]
    found = {name: sum(count for words, count in counts.items() if name in (words or "").split()) for name in names}
    return {name: count for name, count in found.items() if count}
