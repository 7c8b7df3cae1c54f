"""One row a run: the columns of a campaign's table, the same in every part of it, and the figures of a whole one."""

import io
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from keepout.core.audit.audit import Audit, Contact
from keepout.core.errors import FlightError
from keepout.core.flight.loop import FlightOutcome
from keepout.core.guard.safety_layer import GuardFlag, flag_names
from keepout.core.mission.flight import LAYERS
from keepout.core.mission.scenario import Scenario
from keepout.flights.campaign.dispersion import Design, Run, columns

_PARQUET = {"compression": "zstd", "write_page_checksum": True, "write_statistics": False}
FLOWN, REFUSED = "flown", "refused"
_STEPS = {f"{layer}_steps.{status.name.lower()}": (layer, status) for layer, kind in LAYERS.items() for status in kind}
_KINDS = {
    "contact": pa.string(),
    "reached": pa.bool_(),
    **dict.fromkeys(
        (
            *("minimum_clearance", "measured_clearance", "minimum_clearance_time", "minimum_barrier"),
            *("final_error", "time_to_reach", "delta_v", "propellant", "saturated_fraction"),
            *("largest_speed", "largest_force"),
        ),
        pa.float64(),
    ),
    **dict.fromkeys(("speed_violations", "force_violations", "inconsistent_steps"), pa.int32()),
    "finite": pa.bool_(),
    "guard_interventions": pa.int32(),
    "guard_flags": pa.string(),
    "start_certified": pa.bool_(),
    **dict.fromkeys(("assumptions_broken", "violated_conditions", "remarks"), pa.string()),
    **dict.fromkeys(_STEPS, pa.int32()),
}
"""Names and types of the columns that a flown run has values for."""
_NUMBER = re.compile(r"[-+]?\b\d+(\.\d+)?([eE][-+]?\d+)?\b")
"""A number in a reason, and no digits in a name."""
_OF_ZONES = {"zones_entered": pa.string(), "zone_clearance": pa.float64()}
_OF_LEGS = {"holds_kept": pa.bool_()}
"""Those of runs with zones or corridors, and with legs."""


def approach_columns(scenario: Scenario) -> dict[str, pa.DataType]:
    """Give the names and types of the columns that the runs of a scenario with zones, corridors or legs have beside."""
    return (_OF_ZONES if scenario.zone or scenario.corridor else {}) | (_OF_LEGS if scenario.leg else {})


_RENAMED = {"minimum_clearance_found": "measured_clearance"}
"""What columns of earlier files are called now."""
SUMMARISED = (
    *("run", "status", "reason", "start_drawn_again", "reached", "contact", "minimum_clearance", "minimum_barrier"),
    *("delta_v", "time_to_reach", "final_error", "saturated_fraction", "guard_interventions", "guard_flags"),
    *("start_certified", "assumptions_broken", *_STEPS),
)
"""Columns that `summary` looks at."""


def table_of(
    design: Design,
    scenario: Scenario,
    runs: Sequence[Run],
    flown: Mapping[int, tuple[FlightOutcome, Audit, bool | None, bool | None]],
) -> pa.Table:
    """Lay runs out as a table; what a refused run has no value for is null.

    Args:
        design: of the campaign.
        scenario: likewise.
        runs: as drawn.
        flown: of each flown run, by number: its outcome, its audit, whether the guard's theorem holds from its start,
            and whether it kept its holds.

    """
    made: dict[str, pa.Array] = {
        "run": pa.array([run.number for run in runs], pa.int64()),
        "status": pa.array([REFUSED if run.mission is None else FLOWN for run in runs], pa.string()),
        "reason": pa.array([run.refusal for run in runs], pa.string()),
        "start_drawn_again": pa.array([run.drawn_again for run in runs], pa.int32()),
    }
    for key in ("position", "velocity"):
        for axis, letter in enumerate("xyz"):
            name = f"start_{letter}" if key == "position" else f"start_v{letter}"
            made[name] = pa.array([float(getattr(run, key)[axis]) for run in runs], pa.float64())
    for dispersion in design.dispersions:
        for name, values in columns(dispersion, [run.values[dispersion.name] for run in runs]).items():
            made[name] = pa.array(values, pa.string() if values.dtype == object else pa.float64())
    figures = {run.number: _figures(run, *flown[run.number]) for run in runs if run.number in flown}
    for name, kind in (_KINDS | approach_columns(scenario)).items():
        made[name] = pa.array([figures[n.number][name] if n.number in figures else None for n in runs], kind)
    return pa.table(made)


def _figures(
    run: Run, outcome: FlightOutcome, audit: Audit, certified: bool | None, held: bool | None
) -> dict[str, Any]:
    """Give what a flown run has values for, by the names of `_KINDS` and of those of zones and legs."""
    mission = run.flown
    return {
        "contact": str(audit.contact),
        "reached": bool(outcome.reached),
        "minimum_clearance": audit.minimum_clearance,
        "measured_clearance": audit.measured_clearance,
        "minimum_clearance_time": audit.minimum_time,
        "minimum_barrier": float(outcome.minimum_barrier),
        "final_error": float(outcome.final_error),
        "time_to_reach": float(outcome.time_to_reach),
        "delta_v": float(outcome.delta_v),
        "propellant": None if outcome.propellant is None else float(outcome.propellant),
        "saturated_fraction": float(outcome.saturated_fraction),
        "largest_speed": audit.largest_speed,
        "largest_force": audit.largest_force,
        "speed_violations": audit.speed_violations,
        "force_violations": audit.force_violations,
        "inconsistent_steps": len(audit.inconsistent_steps),
        "finite": bool(outcome.finite),
        "guard_interventions": int(outcome.guard_interventions),
        "guard_flags": " ".join(flag_names(int(outcome.guard_flags))),
        "start_certified": certified,
        "assumptions_broken": "; ".join(mission.assumptions_broken),
        "violated_conditions": "; ".join(str(c) for c in mission.setup.controller.conditions if not c.satisfied),
        "remarks": "; ".join(audit.remarks),
        "zones_entered": str(audit.zones_entered),
        "zone_clearance": min((zone.minimum_clearance for zone in audit.zones), default=None),
        "holds_kept": held,
        **{name: int(getattr(outcome, f"{layer}_status_counts")[status]) for name, (layer, status) in _STEPS.items()},
    }


def without_numbers(reason: str) -> str:
    """Give a reason with # for each number, so that runs refused for the same reason have the same text."""
    return _NUMBER.sub("#", reason)


def to_bytes(table: pa.Table, marks: dict[str, str]) -> bytes:
    """Give the content of a Parquet file with marks in its metadata; the same table gives the same bytes."""
    stream = io.BytesIO()
    text = [column.name for column in table.schema if pa.types.is_string(column.type)]
    pq.write_table(table.replace_schema_metadata(marks), stream, use_dictionary=text, **_PARQUET)  # pyright: ignore
    return stream.getvalue()


def named_now(there: Sequence[str]) -> list[str]:
    """Give the names that columns of a file have today."""
    return [_RENAMED.get(name, name) for name in there]


def read(source: Sequence[Path] | pa.Buffer, columns: Sequence[str] | None = None, **options: Any) -> pa.Table:
    """Read Parquet files of one schema, or some columns of them, under the names that columns have today.

    Args:
        source: at least one path, or the content of one file.
        columns: their names today; all, if None.
        options: of `pyarrow.parquet.read_table`.

    Raises:
        OSError: a file that cannot be read.
        pyarrow.ArrowException: a file that is damaged, or has no such column.

    """
    is_content = isinstance(source, pa.Buffer)
    there = pq.read_schema(pa.BufferReader(source) if is_content else source[0]).names
    before = dict(zip(named_now(there), there))
    stored = None if columns is None else [before.get(name, name) for name in columns]
    found = pq.read_table(
        pa.BufferReader(source) if is_content else list(source),
        columns=stored,
        page_checksum_verification=True,
        **options,
    )
    named = found.rename_columns(named_now(found.column_names))
    return named.replace_schema_metadata(found.schema.metadata)


def of_bytes(content: bytes, columns: list[str] | None = None) -> pa.Table:
    """Read what `to_bytes` gave, or some columns of it.

    Raises:
        FlightError: damaged, or not such a file.

    """
    try:
        return read(pa.py_buffer(content), columns)
    except Exception as error:  # damaged bytes surface as almost anything a reading library can raise
        raise FlightError(f"damaged, truncated or foreign ({' '.join(str(error).split())[:120]})") from error


def summary(whole: pa.Table, scenario: Scenario) -> dict[str, Any]:
    """Give the figures of a complete campaign for JSON; a contact is whatever the audit does not exclude.

    Args:
        whole: its table, of which `SUMMARISED` is read.
        scenario: of all runs.

    """
    was_flown = pc.equal(whole["status"], FLOWN)  # pyright: ignore[reportAttributeAccessIssue]
    flown, refused = whole.filter(was_flown), whole.filter(pc.invert(was_flown))  # pyright: ignore[reportAttributeAccessIssue]
    names = [name for name in SUMMARISED if not pa.types.is_string(whole[name].type)]
    of = {name: np.asarray(flown[name].cast(pa.float64()).to_numpy(zero_copy_only=False), float) for name in names}
    contact, certified = flown["contact"].to_numpy(zero_copy_only=False), of["start_certified"]
    statuses: dict[str, dict[str, int]] = {layer: {} for layer in LAYERS}
    for name, (layer, status) in _STEPS.items():
        if total := int(np.sum(of[name])):
            statuses[layer][status.name.lower()] = total
    flags = {entry["values"]: entry["counts"] for entry in flown["guard_flags"].value_counts().to_pylist()}
    flagged = {
        name: sum(count for words, count in flags.items() if name in (words or "").split())
        for flag in GuardFlag
        for name in flag_names(flag)
    }
    approach: dict[str, Any] = {}
    if "zones_entered" in whole.column_names:
        entered = flown["zones_entered"].to_numpy(zero_copy_only=False)
        approach["zones_entered"] = int(np.sum(entered == str(Contact.YES)))
        approach["zones_undecided"] = int(np.sum(entered == str(Contact.UNDECIDED)))
        approach["zone_clearance_m"] = finite(np.min, np.asarray(flown["zone_clearance"].to_numpy(), float))
    if "holds_kept" in whole.column_names:
        approach["holds_kept"] = int(np.sum(flown["holds_kept"].to_numpy(zero_copy_only=False).astype(bool)))
    return approach | {
        "runs": len(whole),
        "flown": len(flown),
        "refused": len(refused),
        # The first ones; the table has all.
        "refusals": [{"run": row["run"], "reason": row["reason"]} for row in refused.slice(0, 10).to_pylist()],
        "reached": int(np.sum(of["reached"])),
        "contacts": int(np.sum(contact != str(Contact.NO))),
        "undecided": int(np.sum(contact == str(Contact.UNDECIDED))),
        "minimum_clearance_m": finite(np.min, of["minimum_clearance"]),
        "minimum_barrier_m": finite(np.min, of["minimum_barrier"]),
        "below_barrier": int(np.sum(of["minimum_barrier"] < 0.0)),
        "starts_drawn_again": int(np.sum(whole["start_drawn_again"].to_numpy())),
        "median_delta_v_mps": finite(np.median, of["delta_v"]),
        "saturated_fraction": float(np.mean(of["saturated_fraction"])) if len(flown) else None,
        "guard_interventions": int(np.sum(of["guard_interventions"])),
        "statuses": statuses,
        "starts_certified": None if np.isnan(certified).all() else int(np.nansum(certified)),
        "assumptions_broken": sorted(text for text in flown["assumptions_broken"].unique().to_pylist()[:10] if text),
        "flagged": {name: count for name, count in flagged.items() if count},
        "faults": scenario.faults.model_dump(exclude_defaults=True),
        "worst_runs": of["run"][np.lexsort((of["run"], of["minimum_clearance"]))[:10]].astype(int).tolist(),
        "seed": scenario.seed,
    }


def finite(figure: Callable[[np.ndarray], Any], values: np.ndarray) -> float | None:
    """Give a figure of numbers, or None where there are none or it is not finite."""
    found = float(figure(values)) if values.size else np.nan
    return found if np.isfinite(found) else None
