"""Two orbits and an attitude from files as one relative motion, at the epochs that all of them have.

Nothing is interpolated: how wrong an interpolated state can be, no file tells. Epochs that one file lacks are left
out and counted, and the audit's bound then spans the longer step.
"""

import re
from dataclasses import dataclass
from functools import reduce
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from keepout.core.errors import ExchangeError
from keepout.core.mission.epoch import format_instant, leap_second_between
from keepout.core.motion.rotation import vvlh_axes
from keepout.flights.exchange.attitude_message import Attitude
from keepout.flights.exchange.orbit_message import Orbit

INERTIAL = ("EME2000", "J2000", "GCRF", "ICRF")
"""Frames in which a difference of positions is one in axes that do not turn. J2000 is another name of EME2000."""

BODY = re.compile(r"SC[_ ]BODY([_ ]\w+)?")
"""Names of a spacecraft's own frame in an AEM; those of its instruments and actuators lie otherwise in it."""

FixedIn = Literal["vvlh", "inertial"]


@dataclass(frozen=True, eq=False)
class Encounter:
    """A chaser's motion relative to a target, at common epochs.

    Attributes:
        epochs: rising, ns.
        relative: chaser less target, inertial axes, m.
        relative_velocity: m/s.
        turn: rotations body ← inertial.
        frame: the inertial axes.
        time_system: of the epochs.
        left_out: epochs of any of the files that another lacks.
        position_error: how far the digits of the files let a relative position be from the truth, m.
        velocity_error: the same of a relative velocity, m/s.
        attitude_error: the angle by which they let the body be turned from the truth, rad.

    """

    epochs: Int[np.ndarray, "n"]
    relative: Float[np.ndarray, "n 3"]
    relative_velocity: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "n 3 3"]
    frame: str
    time_system: str
    left_out: int
    position_error: float
    velocity_error: float
    attitude_error: float

    @property
    def time(self) -> Float[np.ndarray, "n"]:
        """Seconds since the first epoch."""
        return (self.epochs - self.epochs[0]) / 1e9


def encounter(
    chaser: Orbit, target: Orbit, attitude: Attitude | FixedIn, *, body_frame: str | None = None
) -> Encounter:
    """Put two orbits and the target's attitude together.

    Args:
        chaser: its orbit.
        target: the orbit of the target's centre of mass.
        attitude: from a file, or the axes with which the target's body axes coincide throughout.
        body_frame: what the file of the attitude calls the body's frame, if not SC_BODY or SC_BODY_1.

    Raises:
        ExchangeError: both orbits are of one object, centres, frames or time systems differ or are not usable, or fewer
            than two epochs are common.

    """
    if chaser.subject.is_same(target.subject):
        raise ExchangeError(
            f"{target.path}: is of {target.subject}, as {chaser.path} is; chaser and target must be two objects"
        )
    for field, one, other in (
        ("CENTER_NAME", chaser.centre, target.centre),
        ("REF_FRAME", _frame(chaser.frame), _frame(target.frame)),
        ("TIME_SYSTEM", chaser.time_system, target.time_system),
    ):
        if one != other:
            raise ExchangeError(f"{target.path}: {field} is {other}; it must be {one}, as in {chaser.path}")
    if chaser.frame not in INERTIAL:
        raise ExchangeError(f"{chaser.path}: REF_FRAME is {chaser.frame}; valid: {', '.join(INERTIAL)}")
    files = [(chaser.path, chaser.epochs), (target.path, target.epochs)]
    if isinstance(attitude, Attitude):
        if attitude.time_system != chaser.time_system:
            raise ExchangeError(
                f"{attitude.path}: TIME_SYSTEM is {attitude.time_system}; it must be {chaser.time_system}, as in "
                f"{chaser.path}"
            )
        whose = target.subject
        if attitude.centre and attitude.centre not in (chaser.centre, whose.name.upper(), whose.identifier.upper()):
            raise ExchangeError(
                f"{attitude.path}: CENTER_NAME is {attitude.centre}; it must be {chaser.centre}, as in "
                f"{chaser.path}, or the target"
            )
        files.append((attitude.path, attitude.epochs))
    common = reduce(np.intersect1d, [epochs for _, epochs in files])
    if len(common) < 2:
        spans = "; ".join(
            f"{path}: {format_instant(int(epochs[0]))} to {format_instant(int(epochs[-1]))}" for path, epochs in files
        )
        raise ExchangeError(f"{len(common)} epochs are common to all files ({spans}); at least 2 must be")
    system = chaser.time_system
    day = leap_second_between(int(common[0]), int(common[-1])) if system == "UTC" else None
    if day is not None:
        raise ExchangeError(f"{chaser.path}: holds the leap second before {day}; without one, or in TAI, it is valid")
    of_chaser, of_target = np.searchsorted(chaser.epochs, common), np.searchsorted(target.epochs, common)
    position, velocity = target.position[of_target], target.velocity[of_target]
    astray, drifting = (_at(error, of_target) for error in (target.position_error, target.velocity_error))
    if isinstance(attitude, Attitude):
        of_body = np.searchsorted(attitude.epochs, common)
        turn = _turn(attitude, chaser, body_frame)[of_body]
        turned = _at(attitude.error, of_body)
    elif attitude == "vvlh":
        turn = np.asarray(jax.jit(jax.vmap(vvlh_axes))(position, velocity))
        turned = _turned(position, velocity, astray, drifting)
    else:
        turn = np.broadcast_to(np.eye(3), (len(common), 3, 3))
        turned = np.zeros(len(common))
    all_epochs = reduce(np.union1d, [epochs for _, epochs in files])
    return Encounter(
        common,
        chaser.position[of_chaser] - position,
        chaser.velocity[of_chaser] - velocity,
        turn,
        chaser.frame,
        system,
        len(all_epochs) - len(common),
        float(np.max(_at(chaser.position_error, of_chaser) + astray)),
        float(np.max(_at(chaser.velocity_error, of_chaser) + drifting)),
        float(np.max(turned)),
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
