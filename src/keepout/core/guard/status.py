"""What the guard says of a step: what it did, and what it saw."""

from enum import IntEnum, IntFlag


class GuardStatus(IntEnum):
    """What the guard did in a step: the status's two lowest bits."""

    CLEAR = 0
    """The command was passed on (cut to the thrusters' limits, if it was beyond them)."""
    BRAKING = 1
    """The command was replaced; the plan's braking motion was followed."""
    HOLDING = 2
    """The command was replaced; the chaser is held at the plan's point of rest."""
    ESCAPING = 3
    """No certified plan: the shortest way out was taken. Nothing is promised until the status changes."""


class GuardFlag(IntFlag):
    """What the guard saw in a step: bits added to the status. Any flag but COMMAND means an assumption did not hold."""

    STATE_JUMP = 4
    """The estimate moved further than force, disturbance bound and estimate errors allow, in a step or in several."""
    DISTURBANCE = 8
    """The disturbance estimate is above one and a half times what the assumptions let an observer see."""
    FIELD = 16
    """The field is not finite here, or not above the threshold."""
    REGION = 32
    """The chaser is beyond the range or speed limit within which the drift is bounded."""
    COMMAND = 64
    """The command held a number that is not finite; it was replaced."""
    OFF_PLAN = 128
    """The chaser has left the tube around its certified plan."""
    ESTIMATE = 256
    """The estimate held a number that is not finite; the plan was followed blind."""
    WIDE = 512
    """The estimate's error bound is wider than declared; no command was passed on, the plan was followed."""
    CONTRADICTED = 1024
    """What the guard is told contradicts itself (samples that no state explains, a map that a view proves wrong)."""
    EXPIRED = 2048
    """The time is past the one until which the assumptions' numbers were worked out."""


def flag_names(flags: int) -> tuple[str, ...]:
    """Name the `GuardFlag` bits of a status, or of several joined by `|`."""
    return tuple(flag.name.lower() for flag in GuardFlag if flag & flags and flag.name is not None)
