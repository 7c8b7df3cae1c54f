"""One row a run: the columns of a campaign's table, the same in every part of it."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from keepout.core.audit.audit import Audit
from keepout.core.errors import FlightError
from keepout.core.flight.outcome import FlightOutcome
from keepout.core.guard.status import flag_names
from keepout.core.mission.statuses import LAYERS
from keepout.flights.campaign.dispersion import Design, columns
from keepout.flights.campaign.drawing import Run

_PARQUET = {"compression": "zstd", "write_page_checksum": True, "write_statistics": False}
FLOWN, REFUSED = "flown", "refused"


def table_of(
    design: Design,
    runs: Sequence[Run],
    flown: dict[int, tuple[FlightOutcome, Audit, bool | None]],
) -> pa.Table:
    """Lay runs out as a table; what a refused run has no value for is null.

    Args:
        design: of the campaign.
        runs: as drawn.
        flown: of each flown run, by number: its outcome, its audit, and whether the guard's theorem holds from its
            start.

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
    for name, kind in _kinds().items():
        made[name] = pa.array([figures[n.number][name] if n.number in figures else None for n in runs], kind)
    return pa.table(made)


def _kinds() -> dict[str, pa.DataType]:
    """Names and types of the columns that a flown run has values for."""
    counted = {f"{layer}_steps.{status.name.lower()}": pa.int32() for layer, kind in LAYERS.items() for status in kind}
    return {
        "contact": pa.string(),
        "reached": pa.bool_(),
        "minimum_clearance": pa.float64(),
        "minimum_clearance_found": pa.float64(),
        "minimum_clearance_time": pa.float64(),
        "minimum_barrier": pa.float64(),
        "final_error": pa.float64(),
        "time_to_reach": pa.float64(),
        "delta_v": pa.float64(),
        "propellant": pa.float64(),
        "saturated_fraction": pa.float64(),
        "largest_speed": pa.float64(),
        "largest_force": pa.float64(),
        "speed_violations": pa.int32(),
        "force_violations": pa.int32(),
        "inconsistent_steps": pa.int32(),
        "finite": pa.bool_(),
        "guard_interventions": pa.int32(),
        "guard_flags": pa.string(),
        "start_certified": pa.bool_(),
        "assumptions_broken": pa.string(),
        "violated_conditions": pa.string(),
        "remarks": pa.string(),
        **counted,
    }


def _figures(run: Run, outcome: FlightOutcome, audit: Audit, certified: bool | None) -> dict[str, Any]:
    mission = run.mission
    assert mission is not None
    figures: dict[str, Any] = {
        "contact": str(audit.contact),
        "reached": bool(outcome.reached),
        "minimum_clearance": audit.minimum_clearance,
        "minimum_clearance_found": audit.minimum_clearance_found,
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
    }
    for layer, kind in LAYERS.items():
        counts = np.asarray(getattr(outcome, f"{layer}_status_counts"))
        figures |= {f"{layer}_steps.{status.name.lower()}": int(counts[status]) for status in kind}
    return figures


def to_bytes(table: pa.Table, marks: dict[str, str]) -> bytes:
    """Give the content of a Parquet file with marks in its metadata; the same table gives the same bytes."""
    stream = io.BytesIO()
    text = [column.name for column in table.schema if pa.types.is_string(column.type)]
    pq.write_table(table.replace_schema_metadata(marks), stream, use_dictionary=text, **_PARQUET)  # pyright: ignore
    return stream.getvalue()


def of_bytes(content: bytes, columns: list[str] | None = None) -> pa.Table:
    """Read what `to_bytes` gave, or some columns of it.

    Raises:
        FlightError: damaged, or not such a file.

    """
    try:
        return pq.read_table(pa.BufferReader(content), columns=columns, page_checksum_verification=True)
    except Exception as error:  # damaged bytes surface as almost anything a reading library can raise
        raise FlightError(f"damaged, truncated or foreign ({' '.join(str(error).split())[:120]})") from error
