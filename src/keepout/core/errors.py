"""Errors that a user can act on: what was given, why it is refused, and what would be valid."""

import math


class KeepoutError(ValueError):
    """A refusal with a one-line reason that names the field or file, the value, and what would be valid."""


class UsageError(KeepoutError):
    """A value of a command's option or argument that is none of those that it takes, whatever files there are."""


class MeshError(KeepoutError):
    """A mesh or point cloud that cannot give a distance."""


class FieldError(KeepoutError):
    """A field file that is damaged, foreign, or certified for something else."""


class ScenarioError(KeepoutError):
    """A scenario entry outside its valid range, or a combination that cannot be flown."""


class ControlError(KeepoutError):
    """A control design that violates a condition it needs."""


class KeepOutZoneError(ControlError):
    """A start or goal inside the law's keep-out zone; `place` says which of them."""

    def __init__(self, message: str, place: str) -> None:
        super().__init__(message)
        self.place = place


class FlightError(KeepoutError):
    """A flight file that is damaged or foreign."""


class ExchangeError(KeepoutError):
    """A file for or from other programs that cannot be written or used."""


class ClusterError(KeepoutError):
    """A cluster that cannot be reached, a worker that would fly otherwise than the others, or a chunk that failed."""


class InspectionError(KeepoutError):
    """A camera that can never see, a patch that cannot be cut, or limits of an inspection that contradict."""


class MapError(KeepoutError):
    """A known-free map that cannot be made, a map file that is damaged or of something else, or a view out of shape."""


def require_finite(value: float, said: str, refusal: type[KeepoutError], *, positive: bool = False) -> None:
    """Refuse a number that is not finite or below 0, or, if it is to be `positive`, 0.

    Args:
        value: the number.
        said: how the message begins: where, what, the value and its unit, as "guard: mass is -1 kg".
        refusal: the error to raise.
        positive: whether 0 is refused too.

    Raises:
        KeepoutError: of the kind `refusal`.

    """
    if not (math.isfinite(value) and (value > 0.0 if positive else value >= 0.0)):
        raise refusal(f"{said}; it must be finite and {'greater than' if positive else 'at least'} 0")
