"""Two orbits and an attitude from files as one relative motion, at the epochs that all of them have.

Nothing is interpolated: how wrong an interpolated state can be, no file tells. Epochs that one file lacks are left
out and counted, and the audit's bound then spans the longer step.
"""

from dataclasses import dataclass
from functools import reduce
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from keepout.errors import ExchangeError
from keepout.exchange.attitude_message import Attitude
from keepout.exchange.orbit_message import Orbit
from keepout.mission.epoch import format_instant, leap_second_between
from keepout.motion.frames import vvlh_axes

INERTIAL = ("EME2000", "J2000", "GCRF", "ICRF")
"""Frames in which a difference of positions is one in axes that do not turn. J2000 is another name of EME2000."""

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

    """

    epochs: Int[np.ndarray, "n"]
    relative: Float[np.ndarray, "n 3"]
    relative_velocity: Float[np.ndarray, "n 3"]
    turn: Float[np.ndarray, "n 3 3"]
    frame: str
    time_system: str
    left_out: int

    @property
    def time(self) -> Float[np.ndarray, "n"]:
        """Seconds since the first epoch."""
        return (self.epochs - self.epochs[0]) / 1e9


def encounter(chaser: Orbit, target: Orbit, attitude: Attitude | FixedIn) -> Encounter:
    """Put two orbits and the target's attitude together.

    Args:
        chaser: its orbit.
        target: the orbit of the target's centre of mass.
        attitude: from a file, or the axes with which the target's body axes coincide throughout.

    Raises:
        ExchangeError: centres, frames or time systems differ or are not usable, or fewer than two epochs are common.

    """
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
    if isinstance(attitude, Attitude):
        turn = _turn(attitude, chaser)[np.searchsorted(attitude.epochs, common)]
    elif attitude == "vvlh":
        turn = np.asarray(jax.jit(jax.vmap(vvlh_axes))(position, velocity))
    else:
        turn = np.broadcast_to(np.eye(3), (len(common), 3, 3))
    all_epochs = reduce(np.union1d, [epochs for _, epochs in files])
    return Encounter(
        common,
        chaser.position[of_chaser] - position,
        chaser.velocity[of_chaser] - velocity,
        turn,
        chaser.frame,
        system,
        len(all_epochs) - len(common),
    )


def _frame(name: str) -> str:
    return "EME2000" if name == "J2000" else name


def _turn(attitude: Attitude, chaser: Orbit) -> Float[np.ndarray, "n 3 3"]:
    """Give the rotations body ← inertial of an attitude between the orbits' frame and a body's."""
    names = (_frame(attitude.frame_a), _frame(attitude.frame_b))
    wanted = _frame(chaser.frame)
    if (names[0] == wanted) == (names[1] == wanted) or set(names) <= set(INERTIAL):
        raise ExchangeError(
            f"{attitude.path}: REF_FRAME_A is {attitude.frame_a} and REF_FRAME_B {attitude.frame_b}; one of them must "
            f"be {wanted}, as in {chaser.path}, and the other the body's"
        )
    a_from_b = Rotation.from_quat(attitude.quaternion).as_matrix()
    return np.swapaxes(a_from_b, 1, 2) if names[0] == wanted else a_from_b
