"""The audit of a flight that is known by files only: the command `keepout audit` from its arguments to its summary."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from keepout.core.audit.audit import Contact
from keepout.core.audit.passage import audit_passage, measured_turning_acceleration
from keepout.core.errors import ExchangeError
from keepout.core.geometry.target import Target
from keepout.core.mission.epoch import format_instant
from keepout.core.progress import Progress, silent
from keepout.flights.exchange.attitude_message import Attitude, read_aem
from keepout.flights.exchange.encounter import FixedIn, encounter
from keepout.flights.exchange.orbit_message import Orbit, read_oem

_CENTRE_OF_MASS = re.compile(r"cent(?:re|er) of (?:mass|gravity)", re.IGNORECASE)
_NUMBERS = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")


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
    centre_of_mass: tuple[float, float, float] | None = None,
    chaser_object: str | None = None,
    target_object: str | None = None,
    attitude_object: str | None = None,
    attitude_frame: str | None = None,
    sample_error: float = 1e-6,
    attitude_error: float = 0.0,
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
        centre_of_mass: of the target, in the body frame, m; the frame's origin if absent, which a remark says.
        chaser_object: OBJECT_NAME or OBJECT_ID of the chaser, which its file must have; chooses among several.
        target_object: the same of the target.
        attitude_object: what the AEM calls the target, if not as the target's OEM does.
        attitude_frame: what the AEM calls the body's frame, if not SC_BODY or SC_BODY_1.
        sample_error: how far a relative position may be from the truth, m, where the digits do not let it be further.
        attitude_error: the angle by which an attitude may be wrong, rad, where the digits do not let it be more.
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
    for option, value in (("--attitude-object", attitude_object), ("--attitude-frame", attitude_frame)):
        if value is not None and target_attitude is None:
            raise ExchangeError(f"{option} {value}: only with --target-attitude")
    for name, value, unit in (("sample_error", sample_error, "m"), ("attitude_error", attitude_error, "rad")):
        if not (math.isfinite(value) and value >= 0.0):
            raise ExchangeError(f"{name} is {value} {unit}; it must be finite and at least 0")
    progress(0.0, "reading")
    of_chaser = read_oem(chaser, wanted=chaser_object, sample_error=sample_error)
    of_target = read_oem(target_orbit, wanted=target_object, sample_error=sample_error)
    whom = of_target.subject if attitude_object is None else attitude_object
    attitude = axes if target_attitude is None else read_aem(target_attitude, wanted=whom)
    motion = encounter(of_chaser, of_target, attitude, body_frame=attitude_frame)  # pyright: ignore[reportArgumentType]
    sampled, turned = max(sample_error, motion.position_error), max(attitude_error, motion.attitude_error)
    measured = turning_acceleration_bound is None
    if measured and attitude != "inertial" and len(motion.epochs) < 3:
        raise ExchangeError(
            "--turning-acceleration-bound: not given, and 2 epochs do not show how the target's turning changes; a "
            "number in rad/s² is valid"
        )
    turning = (
        measured_turning_acceleration(motion.time, motion.turn, turned) if measured else turning_acceleration_bound
    )
    centre = (0.0, 0.0, 0.0) if centre_of_mass is None else centre_of_mass
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
        centre_of_mass=centre,
        tolerance=tolerance,
        sample_error=sampled,
        velocity_error=motion.velocity_error,
        attitude_error=turned,
    )
    files = [of_chaser, of_target, *([attitude] if isinstance(attitude, Attitude) else [])]
    unambiguous = math.pi / verdict.longest_step
    depends = _not_told(
        files,
        centre_of_mass=centre_of_mass,
        unchecked=[
            f"{file.path} is taken to be of the {role}, and is of {file.subject}: {option} was not given"
            for role, option, wanted, file in (
                ("chaser", "--chaser-object", chaser_object, of_chaser),
                ("target", "--target-object", target_object, of_target),
            )
            if wanted is None
        ],
        fixed_in=axes if target_attitude is None and fixed_in is None else None,
        unambiguous=unambiguous if target_attitude is not None else None,
        measured=measured,
    )
    if motion.position_error > max(sample_error, tolerance):
        depends.append(f"positions have few digits: {motion.position_error:.4g} m is assumed as the sample error")
    swung = turned * float(np.linalg.norm(motion.relative, axis=1).max())
    if motion.attitude_error > attitude_error and swung > tolerance:
        depends.append(f"the target's axes have few digits: {turned:.4g} rad is assumed as the attitude error")
    overrides = []
    if isinstance(attitude, Attitude):
        if not attitude.subject.is_same(of_target.subject):
            overrides.append(f"--attitude-object {attitude_object}: {attitude.path} is of {attitude.subject}")
        if attitude_frame is not None:
            overrides.append(f"--attitude-frame {attitude_frame}: taken as the frame in which the mesh lies")
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
        "centre": of_chaser.centre,
        "chaser_object": of_chaser.subject.name,
        "chaser_object_id": of_chaser.subject.identifier,
        "target_object": of_target.subject.name,
        "target_object_id": of_target.subject.identifier,
        "overrides": overrides,
        "epochs": len(motion.epochs),
        "epochs_left_out": motion.left_out,
        "rows_outside_useable_times": sum(file.unuseable for file in files),
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
            "unambiguous_turning_rate_radps": unambiguous,
            "sample_error_m": sampled,
            "sample_error_of_digits_m": motion.position_error,
            "velocity_error_of_digits_mps": motion.velocity_error,
            "attitude_error_rad": turned,
            "attitude_error_of_digits_rad": motion.attitude_error,
            "centre_of_mass_m": list(centre),
            "tolerance_m": tolerance,
        },
        "remarks": [*verdict.remarks, *depends],
    }


def _not_told(
    files: Sequence[Orbit | Attitude],
    *,
    centre_of_mass: tuple[float, float, float] | None,
    unchecked: list[str],
    fixed_in: str | None,
    unambiguous: float | None,
    measured: bool,
) -> list[str]:
    """Say a line each on what the answer depends on and neither options nor files told."""
    said = list(unchecked)
    if centre_of_mass is None:
        said.append("the centre of mass was not given: taken at the origin of the body frame")
    comments = {comment: file.path for file in reversed(files) for comment in file.comments}
    for comment, path in comments.items():
        found = _CENTRE_OF_MASS.search(comment)
        if found and not _says(comment[found.end() :], centre_of_mass or (0.0, 0.0, 0.0)):
            said.append(f"{path} says, unlike --centre-of-mass: {comment}")
    if fixed_in is not None:
        said.append(f"how the target is turned was not given: its axes are taken to be those of {fixed_in}")
    if unambiguous is not None:
        said.append(
            "whole turns between two epochs cannot be seen: the target is taken to turn at less than "
            f"{unambiguous:.4g} rad/s, half a turn in the longest step"
        )
        if measured:
            said.append("the bound of the turning acceleration was not given: measured from the attitudes, not proved")
    for file in files:
        if file.unuseable:
            said.append(f"{file.path}: {file.unuseable} rows outside its useable times are not judged")
    return said


def _says(text: str, centre: tuple[float, float, float]) -> bool:
    """Whether the first three numbers of a comment are those of a centre of mass."""
    numbers = [float(number) for number in _NUMBERS.findall(text)[:3]]
    return len(numbers) == 3 and all(math.isclose(one, other, abs_tol=1e-9) for one, other in zip(numbers, centre))
