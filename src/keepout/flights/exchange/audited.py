"""The audit of a flight that is known by files only: two orbits and an attitude as one motion, and its verdict.

Nothing is interpolated: how wrong an interpolated state can be, no file tells. Epochs that one file lacks are left
out and counted, and the audit's bound then spans the longer step.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from keepout.core.audit.audit import Contact
from keepout.core.audit.tube import lengths
from keepout.core.errors import ExchangeError
from keepout.core.geometry.target import Target
from keepout.core.mission.epoch import format_instant, leap_second_between
from keepout.core.motion.rotation import vvlh_axes
from keepout.core.progress import Progress, silent
from keepout.flights.exchange.ephemeris import Attitude, Ephemeris, Orbit, read_aem, read_oem
from keepout.flights.exchange.passage import Passage, SampleBounds, Samples, angles, audit_passage

INERTIAL = ("EME2000", "J2000", "GCRF", "ICRF")
"""Frames in which a difference of positions is one in axes that do not turn. J2000 is another name of EME2000."""

BODY = re.compile(r"SC[_ ]BODY([_ ]\w+)?")
"""Names of a spacecraft's own frame in an AEM; those of its instruments and actuators lie otherwise in it."""

FixedIn = Literal["vvlh", "inertial"]
_CENTRE_OF_MASS = re.compile(r"cent(?:re|er) of (?:mass|gravity)", re.IGNORECASE)
_NUMBERS = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")


@dataclass(frozen=True, kw_only=True)
class Given:
    """The files of a flight, and what they are judged by.

    Attributes:
        chaser: OEM of the chaser's centre.
        target_orbit: OEM of the target's centre of mass.
        chaser_radius: of the ball that holds the chaser, m.
        acceleration_bound: of the chaser relative to the target in inertial axes, whatever its cause, m/s².
        target_attitude: AEM of the target.
        target_fixed_in: without one: the axes that the target's body axes are; "vvlh" if absent.
        turning_acceleration_bound: of the target, rad/s²; measured from the attitudes if absent.
        centre_of_mass: of the target, in the body frame, m; the frame's origin if absent, which a remark says.
        chaser_object: OBJECT_NAME or OBJECT_ID of the chaser, which its file must have; chooses among several.
        target_object: the same of the target.
        attitude_object: what the AEM calls the target, if not as the target's OEM does.
        attitude_frame: what the AEM calls the body's frame, if not SC_BODY or SC_BODY_1.
        sample_error: how far a relative position may be from the truth, m, where the digits do not let it be further.
        attitude_error: the angle by which an attitude may be wrong, rad, where the digits do not let it be more.
        tolerance: how close to the truth the bound is driven, m.

    """

    chaser: Path
    target_orbit: Path
    chaser_radius: float
    acceleration_bound: float
    target_attitude: Path | None = None
    target_fixed_in: str | None = None
    turning_acceleration_bound: float | None = None
    centre_of_mass: tuple[float, float, float] | None = None
    chaser_object: str | None = None
    target_object: str | None = None
    attitude_object: str | None = None
    attitude_frame: str | None = None
    sample_error: float = 1e-6
    attitude_error: float = 0.0
    tolerance: float = 1e-3

    @property
    def centre(self) -> tuple[float, float, float]:
        """The target's centre of mass as it is taken, m."""
        return self.centre_of_mass or (0.0, 0.0, 0.0)

    @property
    def axes(self) -> str:
        """The axes that the target's body axes are, where no file says."""
        return "vvlh" if self.target_fixed_in is None else self.target_fixed_in

    def check(self) -> None:
        """Refuse what does not go together.

        Raises:
            ExchangeError: the message names the option.

        """
        if self.target_attitude is not None and self.target_fixed_in is not None:
            raise ExchangeError(
                f"--target-fixed-in {self.target_fixed_in}: not with --target-attitude, which says how the target turns"
            )
        if self.axes not in get_args(FixedIn):
            raise ExchangeError(f"--target-fixed-in {self.axes}: valid: {', '.join(get_args(FixedIn))}")
        for option, value in (("object", self.attitude_object), ("frame", self.attitude_frame)):
            if value is not None and self.target_attitude is None:
                raise ExchangeError(f"--attitude-{option} {value}: only with --target-attitude")
        for name, unit in (("sample_error", "m"), ("attitude_error", "rad")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ExchangeError(f"{name} is {value} {unit}; it must be finite and at least 0")


def audit_files(target: Target, given: Given, *, progress: Progress = silent) -> dict[str, Any]:
    """Judge a flight told by OEM and AEM files against a mesh; the answer is plain JSON values.

    Args:
        target: the mesh, in the target's body frame.
        given: the files, and what they are judged by.
        progress: called as the work goes on.

    Raises:
        KeepoutError: a file or a number cannot be used; the message names it.

    """
    given.check()
    progress(0.0, "reading")
    chaser = read_oem(given.chaser, wanted=given.chaser_object, sample_error=given.sample_error)
    orbit = read_oem(given.target_orbit, wanted=given.target_object, sample_error=given.sample_error)
    whom = orbit.subject if given.attitude_object is None else given.attitude_object
    attitude = None if given.target_attitude is None else read_aem(given.target_attitude, wanted=whom)
    motion = encounter(chaser, orbit, attitude, fixed_in=given.axes, body_frame=given.attitude_frame)
    sampled, turned = max(given.sample_error, motion.position_error), max(given.attitude_error, motion.attitude_error)
    turning = given.turning_acceleration_bound
    if turning is None:
        if (attitude is not None or given.axes != "inertial") and len(motion.epochs) < 3:
            raise ExchangeError(
                "--turning-acceleration-bound: not given, and 2 epochs do not show how the target's turning changes; a "
                "number in rad/s² is valid"
            )
        turning = measured_turning_acceleration(motion.samples.time, motion.samples.turn, turned)
    progress(0.3, "audit")
    verdict = audit_passage(
        motion.samples,
        target,
        chaser_radius=given.chaser_radius,
        bounds=SampleBounds(given.acceleration_bound, turning, sampled, motion.velocity_error, turned),
        centre_of_mass=given.centre,
        tolerance=given.tolerance,
    )
    overrides = []
    if attitude is not None and not attitude.subject.is_same(orbit.subject):
        overrides.append(f"--attitude-object {given.attitude_object}: {attitude.path} is of {attitude.subject}")
    if given.attitude_frame is not None:
        overrides.append(f"--attitude-frame {given.attitude_frame}: taken as the frame in which the mesh lies")
    files = [file for file in (chaser, orbit, attitude) if file is not None]
    progress(1.0, "")
    return {
        **_verdict(verdict, motion),
        "time_system": chaser.time_system,
        "frame": chaser.frame,
        "centre": chaser.centre,
        "chaser_object": chaser.subject.name,
        "chaser_object_id": chaser.subject.identifier,
        "target_object": orbit.subject.name,
        "target_object_id": orbit.subject.identifier,
        "overrides": overrides,
        "epochs": len(motion.epochs),
        "epochs_left_out": motion.left_out,
        "rows_outside_useable_times": sum(file.unuseable for file in files),
        "target": target.name,
        "target_sha256": target.sha256,
        "assumptions": _assumptions(given, motion, verdict, sampled, turned, turning),
        "remarks": [*verdict.remarks, *_not_told(given, files, verdict), *_few_digits(given, motion)],
    }


def _assumptions(
    given: Given, motion: "Encounter", verdict: Passage, sampled: float, turned: float, turning: float
) -> dict[str, Any]:
    return {
        "chaser_radius_m": given.chaser_radius,
        "acceleration_bound_mps2": given.acceleration_bound,
        "least_acceleration_of_samples_mps2": verdict.least_acceleration,
        "target_attitude": given.axes if given.target_attitude is None else "file",
        "turning_acceleration_bound_radps2": turning,
        "turning_acceleration_kind": "measured" if given.turning_acceleration_bound is None else "stated",
        "turning_rate_bound_radps": verdict.turning_rate,
        "largest_turn_between_epochs_deg": math.degrees(verdict.largest_turn),
        "longest_step_s": verdict.longest_step,
        "path_uncertainty_m": verdict.uncertainty,
        "unambiguous_turning_rate_radps": math.pi / verdict.longest_step,
        "sample_error_m": sampled,
        "sample_error_of_digits_m": motion.position_error,
        "velocity_error_of_digits_mps": motion.velocity_error,
        "attitude_error_rad": turned,
        "attitude_error_of_digits_rad": motion.attitude_error,
        "centre_of_mass_m": list(given.centre),
        "tolerance_m": given.tolerance,
    }


def _verdict(verdict: Passage, motion: "Encounter") -> dict[str, Any]:
    first, last = int(motion.epochs[0]), int(motion.epochs[-1])
    return {
        "contact": verdict.contact is not Contact.NO,
        "contact_verdict": str(verdict.contact),
        "minimum_clearance_m": verdict.minimum_clearance,
        "measured_clearance_m": verdict.measured_clearance,
        "minimum_time_s": verdict.minimum_time,
        "minimum_epoch": format_instant(first + round(verdict.minimum_time * 1e9)),
        "minimum_position_m": list(verdict.minimum_position),
        "start_epoch": format_instant(first),
        "stop_epoch": format_instant(last),
    }


def _not_told(given: Given, files: Sequence[Ephemeris], verdict: Passage) -> list[str]:
    """Say a line each on what the answer depends on and neither options nor files told."""
    said = [
        f"{file.path} is taken to be of the {role}, and is of {file.subject}: --{role}-object was not given"
        for role, wanted, file in zip(("chaser", "target"), (given.chaser_object, given.target_object), files)
        if wanted is None
    ]
    if given.centre_of_mass is None:
        said.append("the centre of mass was not given: taken at the origin of the body frame")
    comments = {comment: file.path for file in reversed(files) for comment in file.comments}
    for comment, path in comments.items():
        found = _CENTRE_OF_MASS.search(comment)
        if found and not _says(comment[found.end() :], given.centre):
            said.append(f"{path} says, unlike --centre-of-mass: {comment}")
    if given.target_attitude is None and given.target_fixed_in is None:
        said.append(f"how the target is turned was not given: its axes are taken to be those of {given.axes}")
    if given.target_attitude is not None:
        said.append(
            "whole turns between two epochs cannot be seen: the target is taken to turn at less than "
            f"{math.pi / verdict.longest_step:.4g} rad/s, half a turn in the longest step"
        )
        if given.turning_acceleration_bound is None:
            said.append("the bound of the turning acceleration was not given: measured from the attitudes, not proved")
    return said + [
        f"{file.path}: {file.unuseable} rows outside its useable times are not judged"
        for file in files
        if file.unuseable
    ]


def _few_digits(given: Given, motion: "Encounter") -> list[str]:
    """Say where the digits of the files, and no option, decide how wrong they may be."""
    said, turned = [], motion.attitude_error
    if motion.position_error > max(given.sample_error, given.tolerance):
        said.append(f"positions have few digits: {motion.position_error:.4g} m is assumed as the sample error")
    swung = turned * float(np.linalg.norm(motion.samples.relative, axis=1).max())
    if turned > given.attitude_error and swung > given.tolerance:
        said.append(f"the target's axes have few digits: {turned:.4g} rad is assumed as the attitude error")
    return said


def _says(text: str, centre: tuple[float, float, float]) -> bool:
    """Whether the first three numbers of a comment are those of a centre of mass."""
    numbers = [float(number) for number in _NUMBERS.findall(text)[:3]]
    return len(numbers) == 3 and all(math.isclose(one, other, abs_tol=1e-9) for one, other in zip(numbers, centre))


@dataclass(frozen=True, eq=False)
class Encounter:
    """A chaser's motion relative to a target, at common epochs.

    Attributes:
        epochs: rising, ns.
        samples: at them, times from the first one.
        left_out: epochs of any of the files that another lacks.
        position_error: how far the digits of the files let a relative position be from the truth, m.
        velocity_error: the same of a relative velocity, m/s.
        attitude_error: the angle by which they let the body be turned from the truth, rad.

    """

    epochs: Int[np.ndarray, "n"]
    samples: Samples
    left_out: int
    position_error: float
    velocity_error: float
    attitude_error: float


def encounter(
    chaser: Orbit, target: Orbit, attitude: Attitude | None, *, fixed_in: str, body_frame: str | None
) -> Encounter:
    """Put two orbits and the target's attitude together.

    Args:
        chaser: its orbit.
        target: the orbit of the target's centre of mass.
        attitude: of the target, from a file.
        fixed_in: without one, the axes with which the target's body axes coincide throughout, a `FixedIn`.
        body_frame: what the file of the attitude calls the body's frame, if not SC_BODY or SC_BODY_1.

    Raises:
        ExchangeError: both orbits are of one object, centres, frames or time systems differ or are not usable, or fewer
            than two epochs are common.

    """
    _require_alike(chaser, target, attitude)
    files = [file for file in (chaser, target, attitude) if file is not None]
    common = reduce(np.intersect1d, [file.epochs for file in files])
    if len(common) < 2:
        spans = "; ".join(
            f"{file.path}: {format_instant(int(file.epochs[0]))} to {format_instant(int(file.epochs[-1]))}"
            for file in files
        )
        raise ExchangeError(f"{len(common)} epochs are common to all files ({spans}); at least 2 must be")
    day = leap_second_between(int(common[0]), int(common[-1])) if chaser.time_system == "UTC" else None
    if day is not None:
        raise ExchangeError(f"{chaser.path}: holds the leap second before {day}; without one, or in TAI, it is valid")
    of_chaser, of_target = np.searchsorted(chaser.epochs, common), np.searchsorted(target.epochs, common)
    position, velocity = target.position[of_target], target.velocity[of_target]
    astray, drifting = (_at(error, of_target) for error in (target.position_error, target.velocity_error))
    if attitude is not None:
        of_body = np.searchsorted(attitude.epochs, common)
        turn = _turn(attitude, chaser, body_frame)[of_body]
        turned = _at(attitude.error, of_body)
    elif fixed_in == "vvlh":
        turn = np.asarray(jax.jit(jax.vmap(vvlh_axes))(position, velocity))
        turned = _turned(position, velocity, astray, drifting)
    else:
        turn = np.broadcast_to(np.eye(3), (len(common), 3, 3))
        turned = np.zeros(len(common))
    relative, speed = chaser.position[of_chaser] - position, chaser.velocity[of_chaser] - velocity
    return Encounter(
        common,
        Samples((common - common[0]) / 1e9, relative, speed, turn),
        len(reduce(np.union1d, [file.epochs for file in files])) - len(common),
        float(np.max(_at(chaser.position_error, of_chaser) + astray)),
        float(np.max(_at(chaser.velocity_error, of_chaser) + drifting)),
        float(np.max(turned)),
    )


def _require_alike(chaser: Orbit, target: Orbit, attitude: Attitude | None) -> None:
    """Refuse files that do not tell one encounter of two objects in axes that do not turn."""
    if chaser.subject.is_same(target.subject):
        raise ExchangeError(
            f"{target.path}: is of {target.subject}, as {chaser.path} is; chaser and target must be two objects"
        )
    same: list[tuple[Ephemeris, str, str, str]] = [
        (target, "CENTER_NAME", chaser.centre, target.centre),
        (target, "REF_FRAME", _frame(chaser.frame), _frame(target.frame)),
        (target, "TIME_SYSTEM", chaser.time_system, target.time_system),
    ]
    if attitude is not None:
        same.append((attitude, "TIME_SYSTEM", chaser.time_system, attitude.time_system))
    for file, keyword, one, other in same:
        if one != other:
            raise ExchangeError(f"{file.path}: {keyword} is {other}; it must be {one}, as in {chaser.path}")
    if chaser.frame not in INERTIAL:
        raise ExchangeError(f"{chaser.path}: REF_FRAME is {chaser.frame}; valid: {', '.join(INERTIAL)}")
    if attitude is None:
        return
    whose = target.subject
    if attitude.centre and attitude.centre not in (chaser.centre, whose.name.upper(), whose.identifier.upper()):
        raise ExchangeError(
            f"{attitude.path}: CENTER_NAME is {attitude.centre}; it must be {chaser.centre}, as in {chaser.path}, or "
            "the target"
        )


def _at(error: Float[np.ndarray, "n"] | None, places: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    return np.zeros(len(places)) if error is None else error[places]


def _turned(
    position: Float[np.ndarray, "n 3"],
    velocity: Float[np.ndarray, "n 3"],
    astray: Float[np.ndarray, "n"],
    drifting: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n"]:
    """Give the angle (rad) by which errors of position (m) and velocity (m/s) can turn the axes of VVLH.

    One axis lies along the position, one along the orbit's normal: twice the angle by which the first can be wrong, and
    once that of the second, hold the turn.
    """
    away, fast = np.linalg.norm(position, axis=1), np.linalg.norm(velocity, axis=1)
    normal = np.linalg.norm(np.cross(position, velocity), axis=1)
    kicked = astray * fast + away * drifting + astray * drifting
    sines = [part / np.maximum(whole, 1e-300) for part, whole in ((astray, away), (kicked, normal))]
    first, second = (np.where(sine < 1.0, np.arcsin(np.minimum(sine, 1.0)), np.pi) for sine in sines)
    return np.minimum(2.0 * first + second, np.pi)


def _frame(name: str) -> str:
    return "EME2000" if name == "J2000" else name


def _turn(attitude: Attitude, chaser: Orbit, body_frame: str | None) -> Float[np.ndarray, "n 3 3"]:
    """Give the rotations body ← inertial of an attitude between the orbits' frame and the body's."""
    names = (_frame(attitude.frame_a), _frame(attitude.frame_b))
    wanted = _frame(chaser.frame)
    if wanted not in names or names[0] == names[1]:
        raise ExchangeError(
            f"{attitude.path}: REF_FRAME_A is {attitude.frame_a} and REF_FRAME_B {attitude.frame_b}; one of them must "
            f"be {wanted}, as in {chaser.path}, and the other the body's"
        )
    forwards = names[0] == wanted
    body = names[1] if forwards else names[0]
    if not (BODY.fullmatch(body) if body_frame is None else body == body_frame.upper()):
        raise ExchangeError(
            f"{attitude.path}: REF_FRAME_{'B' if forwards else 'A'} is {body}; it must be the frame in which the mesh "
            f"lies, the body's: {body_frame or 'SC_BODY, SC_BODY_1'}"
        )
    a_from_b = Rotation.from_quat(attitude.quaternion).as_matrix()
    return np.swapaxes(a_from_b, 1, 2) if forwards else a_from_b


def measured_turning_acceleration(
    time: Float[np.ndarray, "samples"], turn: Float[np.ndarray, "samples 3 3"], attitude_error: float = 0.0
) -> float:
    """Give twice the largest change of the mean angular velocity from step to step, over their middles' distance.

    What the attitudes' error (rad) can hide of such a change is added. A measurement: what happens between the epochs
    is not in them.
    """
    if len(time) < 3:
        return 0.0
    step = np.diff(time)
    between = np.einsum("nij,nkj->nik", turn[1:], turn[:-1])
    skew = 0.5 * (between - np.swapaxes(between, 1, 2))
    axis = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    angle = angles(turn)
    # sin φ times the axis becomes φ times the axis.
    mean = axis * (angle / np.maximum(np.sin(angle), 1e-300))[:, None] / step[:, None]
    apart = 0.5 * (step[1:] + step[:-1])
    hidden = 2.0 * attitude_error * (1.0 / step[1:] + 1.0 / step[:-1])
    return float(np.max((2.0 * lengths(np.diff(mean, axis=0)) + hidden) / apart))
