"""The audit of a flight that is known by files only: the command `keepout audit` from its arguments to its summary."""

import math
from pathlib import Path
from typing import Any, get_args

from keepout.audit.audit import Contact
from keepout.audit.passage import audit_passage, measured_turning_acceleration
from keepout.errors import ExchangeError
from keepout.exchange.attitude_message import read_aem
from keepout.exchange.encounter import FixedIn, encounter
from keepout.exchange.orbit_message import read_oem
from keepout.geometry.target import Target
from keepout.mission.epoch import format_instant
from keepout.progress import Progress, silent


def audit_files(
    target: Target,
    *,
    chaser: Path,
    target_orbit: Path,
    chaser_radius: float,
    acceleration_bound: float,
    target_attitude: Path | None = None,
    fixed_in: str | None = None,
    turning_acceleration_bound: float | None = None,
    centre_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sample_error: float = 1e-6,
    tolerance: float = 1e-3,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Judge a flight told by OEM and AEM files against a mesh; the answer is plain JSON values.

    Args:
        target: the mesh, in the target's body frame.
        chaser: OEM of the chaser's centre.
        target_orbit: OEM of the target's centre of mass.
        chaser_radius: of the ball that holds the chaser, m.
        acceleration_bound: of the chaser relative to the target in inertial axes, whatever its cause, m/s².
        target_attitude: AEM of the target.
        fixed_in: without one: the axes that the target's body axes are; "vvlh" if absent.
        turning_acceleration_bound: of the target, rad/s²; measured from the attitudes if absent.
        centre_of_mass: of the target, in the body frame, m.
        sample_error: how far a sample may be from the truth, m.
        tolerance: how close to the truth the bound is driven, m.
        progress: called as the work goes on.

    Raises:
        KeepoutError: a file or a number cannot be used; the message names it.

    """
    if target_attitude is not None and fixed_in is not None:
        raise ExchangeError(
            f"--target-fixed-in {fixed_in}: not with --target-attitude, which says how the target turns"
        )
    axes = "vvlh" if fixed_in is None else fixed_in
    if axes not in get_args(FixedIn):
        raise ExchangeError(f"--target-fixed-in {axes}: valid: {', '.join(get_args(FixedIn))}")
    progress(0.0, "reading")
    attitude = axes if target_attitude is None else read_aem(target_attitude)
    motion = encounter(read_oem(chaser), read_oem(target_orbit), attitude)  # pyright: ignore[reportArgumentType]
    measured = turning_acceleration_bound is None
    turning = measured_turning_acceleration(motion.time, motion.turn) if measured else turning_acceleration_bound
    progress(0.3, "audit")
    verdict = audit_passage(
        motion.time,
        motion.relative,
        motion.relative_velocity,
        motion.turn,
        target,
        chaser_radius=chaser_radius,
        acceleration_bound=acceleration_bound,
        turning_acceleration_bound=turning,
        centre_of_mass=centre_of_mass,
        tolerance=tolerance,
        sample_error=sample_error,
    )
    progress(1.0, "")
    return {
        "contact": verdict.contact is not Contact.NO,
        "contact_verdict": str(verdict.contact),
        "minimum_clearance_m": verdict.minimum_clearance,
        "minimum_clearance_bound_m": verdict.minimum_clearance_bound,
        "minimum_time_s": verdict.minimum_time,
        "minimum_epoch": format_instant(int(motion.epochs[0]) + round(verdict.minimum_time * 1e9)),
        "minimum_position_m": list(verdict.minimum_position),
        "start_epoch": format_instant(int(motion.epochs[0])),
        "stop_epoch": format_instant(int(motion.epochs[-1])),
        "time_system": motion.time_system,
        "frame": motion.frame,
        "epochs": len(motion.epochs),
        "epochs_left_out": motion.left_out,
        "target": target.name,
        "target_sha256": target.sha256,
        "assumptions": {
            "chaser_radius_m": chaser_radius,
            "acceleration_bound_mps2": acceleration_bound,
            "least_acceleration_of_samples_mps2": verdict.least_acceleration,
            "target_attitude": "file" if target_attitude is not None else axes,
            "turning_acceleration_bound_radps2": turning,
            "turning_acceleration_kind": "measured" if measured else "stated",
            "turning_rate_bound_radps": verdict.turning_rate,
            "largest_turn_between_epochs_deg": math.degrees(verdict.largest_turn),
            "longest_step_s": verdict.longest_step,
            "path_uncertainty_m": verdict.uncertainty,
            "sample_error_m": sample_error,
            "centre_of_mass_m": list(centre_of_mass),
            "tolerance_m": tolerance,
        },
        "remarks": list(verdict.remarks),
    }
