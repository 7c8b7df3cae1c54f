"""The independent verdict on a flight: whether the chaser touched the target at any instant, by the exact mesh.

It asks the exact distance to the mesh; the recorded states, forces and four bounds (`FlightBounds`) tell where the
chaser can have been between samples (`tube`). It imports neither fields nor control, guard or flight loop. Two things
it shares with them: the exact distance (`geometry.distance`), which the fields are made from, and the bounds on
rotation and differential gravity (`mission.surroundings`), which the guard assumes too. A mistake in either would
mislead both sides alike, so both are tested against code that shares nothing with them.

Why no contact is a proof. The chaser is a sphere of radius R about a continuous path r(t). If d(r(t)) > R throughout,
d being the unsigned distance to the triangles, the sphere meets no triangle at any instant. The path then stays in the
component of {d > R} it began in; that this is the exterior, not a closed cavity of the mesh, is proved apart, by a
chain of free balls from a recorded position to beyond the mesh's bounding box. A record whose consecutive
samples no motion within the bounds can join has no path to bound, and its contact is "undecided", never "no".

The chain (`proved_outside`): the ball of radius d(p) − R about p is free. So points, each in the ball of the one
before, that leave the bounding box by more than R settle it. No orientation, sign or watertightness is needed.
"""

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from keepout.core.audit.tube import Contact, Distance, FlightBounds, Tube, components, lengths, nearest
from keepout.core.audit.zones import Entered, Region, entered
from keepout.core.errors import FlightError, require_finite

_DIRECTIONS = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)


def proved_outside(
    point: Float[np.ndarray, "3"],
    distance: Distance,
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    *,
    radius: float,
    expansions: int = 2000,
    away: float | None = None,
) -> bool:
    """Whether a free way for a sphere of `radius` metres leads from `point` out of the box [lower, upper] (metres).

    `away` is the point's distance, where that is known. Best-first search over ball chains, balls nearer the box's
    faces first. False means "not proved", never "inside".
    """
    least = 0.02

    def depth(at: np.ndarray) -> np.ndarray:
        """How far points are from being outside the box grown by the radius; negative outside."""
        return np.min(np.minimum(at - lower, upper - at), axis=-1) + radius

    free = (float(distance(point[None])[0]) if away is None else away) - radius
    if free <= 0.0:
        return False
    if depth(point[None])[0] < 0.0:
        return True
    queue: list[tuple[float, int, np.ndarray, float]] = [(0.0, 0, point, free)]
    seen: set[tuple[int, ...]] = set()
    count = 0
    while queue and count < expansions:
        _, _, at, free = heapq.heappop(queue)
        count += 1
        nexts = at + 0.9 * free * _DIRECTIONS
        # A ball that already reaches beyond the box settles it.
        depths = depth(nexts)
        if np.any(depths < 0.0):
            return True
        found = distance(nexts) - radius
        for i in np.flatnonzero(found > least):
            cell = tuple(np.floor(nexts[i] / max(0.25 * float(found[i]), least)).astype(int))
            if cell not in seen:
                seen.add(cell)
                heapq.heappush(queue, (float(depths[i] - found[i]), count * 32 + int(i), nexts[i], float(found[i])))
    return False


_REPLACED = 0b11
"""Bits of a recorded guard status that are not all 0 where the guard replaced the command (docs/files.md)."""

_ROUNDING = 1e-9
"""Metres taken off every clearance bound: far more than float64 loses at the size of a space station."""


@runtime_checkable
class ExactMesh(Protocol):
    """What the audit asks of a target's geometry."""

    @property
    def vertices(self) -> Float[np.ndarray, "vertices 3"]:
        """Corners of the triangles, body frame, metres."""
        ...

    @property
    def distance(self) -> Any:
        """An exact unsigned distance with a `distance(points)` method."""
        ...


Box = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
"""Lower and upper corner, m."""


def box_of(target: ExactMesh) -> Box:
    """Give the bounding box of a mesh."""
    vertices = np.asarray(target.vertices)
    return vertices.min(axis=0), vertices.max(axis=0)


@dataclass(frozen=True)
class Audit:
    """What is known about one flight (metres, seconds, newtons, metres per second; body frame).

    `minimum_clearance` is a lower bound on the least distance from the chaser's surface to the mesh, at any instant;
    `measured_clearance` the least one found, at `minimum_time` and `minimum_position`. `largest_force` and
    `largest_speed` are those of the samples; `force_excess` and `speed_excess` the largest amounts by which a limit
    was passed at a sample (≤ 0: kept). `inconsistent_steps` are the steps whose ends no motion within the bounds joins.
    `remarks` says, a line each, why a verdict is not a plain "no". `zones` says of each zone and corridor whether it
    was kept.
    """

    contact: Contact
    minimum_clearance: float
    measured_clearance: float
    minimum_time: float
    minimum_position: tuple[float, float, float]
    inconsistent_steps: tuple[int, ...]
    start_outside: bool
    largest_force: float
    force_excess: float
    force_violations: int
    largest_speed: float
    speed_excess: float
    speed_violations: int
    guard_interventions: int
    steps: int
    remarks: tuple[str, ...]
    zones: tuple[Entered, ...] = ()

    @property
    def zones_entered(self) -> Contact:
        """Whether any zone was entered or any corridor left: the gravest of what is known of each."""
        found = {zone.entered for zone in self.zones}
        return next((said for said in (Contact.YES, Contact.UNDECIDED) if said in found), Contact.NO)

    @property
    def consistent(self) -> bool:
        """Whether some motion within the bounds passes through all the recorded states."""
        return not self.inconsistent_steps


AUDITED = ("time", "position", "velocity", "force", "guard_status")
"""Of a log, those that the audit looks at."""


class Limits(NamedTuple):
    """What the chaser is, and must keep.

    Attributes:
        chaser_radius: of the ball that holds the chaser, m.
        force: per axis, N.
        speed: on the norm, m/s.

    """

    chaser_radius: float
    force: float
    speed: float


def audit(
    record: Any,
    target: ExactMesh,
    *,
    chaser_radius: float,
    bounds: FlightBounds,
    force_limit: float,
    speed_limit: float,
    regions: Sequence[Region] = (),
    tolerance: float = 1e-3,
    consistency: float = 1e-6,
) -> Audit:
    """Judge one flight against the exact mesh.

    Args:
        record: holds NumPy arrays `time (N,)` s, `position (N, 3)` m, `velocity (N, 3)` m/s and `force (N, 3)` N: the
            true states in the body frame and the force truly applied from sample k to k + 1; `guard_status (N,)`, if it
            is there, counts as an intervention wherever its two lowest bits are not 0.
        target: the mesh.
        chaser_radius: of the ball that holds the chaser, m.
        bounds: on what the record does not hold.
        force_limit: per axis, N.
        speed_limit: on the norm, m/s.
        regions: that must not be entered.
        tolerance: how close to the truth the clearance bound is driven, m.
        consistency: what the flight's own integrator may err by in a step, m.

    Raises:
        FlightError: the record cannot be read as a flight.

    """
    guard = getattr(record, "guard_status", None)
    log = {name: np.asarray(getattr(record, name), float)[None] for name in AUDITED[:4]}
    log |= {} if guard is None else {"guard_status": np.asarray(guard)[None]}
    limits = Limits(chaser_radius, force_limit, speed_limit)
    return audit_campaign(log, target, limits, bounds, regions=regions, tolerance=tolerance, consistency=consistency)[0]


def audit_campaign(
    log: Mapping[str, np.ndarray],
    target: ExactMesh,
    limits: Limits,
    bounds: FlightBounds,
    *,
    regions: Sequence[Region] = (),
    tolerance: float = 1e-3,
    consistency: float = 1e-6,
) -> list[Audit]:
    """Judge flights that share their sample times.

    Args:
        log: the arrays of `audit`'s record by name, each with a leading axis of flights; more of them do not matter.
        target: the mesh.
        limits: of the chaser.
        bounds: on what the log does not hold.
        regions: that must not be entered.
        tolerance: how close to the truth the clearance bound is driven, m.
        consistency: what the flights' own integrator may err by in a step, m.

    Raises:
        FlightError: the log cannot be read as flights.

    """
    time, states, guard_status = log["time"][0], [log[name] for name in AUDITED[1:4]], log.get("guard_status")
    chaser_radius = limits.chaser_radius
    _check(time, dict(zip(AUDITED[1:4], states, strict=True)), chaser_radius, tolerance, consistency)
    finite = np.all([np.isfinite(array.reshape(len(array), -1)).all(axis=1) for array in states], axis=0)
    # Zeros for the flights that are not finite; the arrays themselves where all are.
    shown = [array if finite.all() else np.where(finite[:, None, None], array, 0.0) for array in states]
    tube = Tube.of(time, *shown, bounds=bounds)
    distance = target.distance.distance
    bound = nearest(tube, distance, tolerance=tolerance)
    excess = tube.inconsistency()
    zones = [entered(tube, region, tolerance=tolerance) for region in regions]
    first_away = distance(tube.position[:, 0])
    box = box_of(target)
    audits = []
    for i in range(len(finite)):
        if not finite[i]:
            audits.append(_unreadable(time, *(array[i] for array in states)))
            continue
        clearance = float(bound.lower[i]) - chaser_radius - _ROUNDING
        found = float(bound.upper[i]) - chaser_radius
        broken = np.flatnonzero(excess[i] > consistency)
        # One recorded position proved outside is enough: the path joins all of them.
        samples = np.linspace(0, len(time) - 1, 5).astype(int) if clearance > 0.0 else [0]
        outside = outside_from(tube.position[i, samples], distance, box, chaser_radius, float(first_away[i]))
        contact, remarks = verdict(clearance, found, outside, _remarks_on_steps(broken, excess[i], time))
        if tube.beyond[i].any():
            contact, remarks = _beyond(contact, remarks, time[int(np.argmax(tube.beyond[i]))], bounds)
        x, y, z = bound.position[i].tolist()
        _, velocity, force = (array[i] for array in states)
        pushes = np.max([np.abs(part) for part in components(force[:-1])], axis=0)
        audits.append(
            Audit(
                contact=contact,
                minimum_clearance=clearance,
                measured_clearance=found,
                minimum_time=float(bound.time[i]),
                minimum_position=(x, y, z),
                inconsistent_steps=tuple(broken.tolist()),
                start_outside=outside,
                **_against("force", pushes, limits.force),
                **_against("speed", lengths(velocity), limits.speed),
                guard_interventions=0 if guard_status is None else int(np.count_nonzero(guard_status[i] & _REPLACED)),
                steps=len(time) - 1,
                remarks=remarks,
                zones=tuple(_decided(found[i], remarks) for found in zones),
            )
        )
    return audits


def _decided(found: Entered, remarks: tuple[str, ...]) -> Entered:
    """Leave undecided what rests on a path that may not have been flown, or was not bounded."""
    return replace(found, entered=Contact.UNDECIDED) if found.entered is Contact.NO and remarks else found


def _against(name: str, sizes: Float[np.ndarray, "samples"], limit: float) -> dict[str, Any]:
    """Give an audit's entries on how forces (N) or speeds (m/s) keep a limit."""
    largest, violations = float(sizes.max()), int(np.sum(sizes > limit * (1.0 + 1e-9)))
    return {f"largest_{name}": largest, f"{name}_excess": largest - limit, f"{name}_violations": violations}


def outside_from(
    points: Float[np.ndarray, "points 3"], distance: Distance, box: Box, radius: float, away: float | None = None
) -> bool:
    """Whether one of some points (m) is `proved_outside` of a mesh for a sphere of `radius` m.

    `away` is the first point's distance (m), where that is known.
    """
    found = (
        proved_outside(point, distance, *box, radius=radius, away=None if k else away) for k, point in enumerate(points)
    )
    return any(found)


def _remarks_on_steps(broken: np.ndarray, excess: np.ndarray, time: np.ndarray) -> list[str]:
    """Say which steps cannot have been flown, if any."""
    if not broken.size:
        return []
    k = int(broken[np.argmax(excess[broken])])
    return [
        f"{broken.size} steps cannot have been flown: the worst, from {time[k]:.6g} s to {time[k + 1]:.6g} s, is "
        f"{excess[k]:.3g} m beyond what its force and the bounds allow"
    ]


def verdict(clearance: float, found: float, outside: bool, remarks: list[str]) -> tuple[Contact, tuple[str, ...]]:
    """Judge by the clearance proved and the one found, m, and the exterior reached; add to what is remarked already."""
    if found <= 0.0:
        return Contact.YES, (*remarks, f"the chaser's surface reaches the mesh (clearance {found:.4g} m)")
    if clearance <= 0.0:
        near = f"the clearance lies between {clearance:.4g} m and {found:.4g} m: too close to decide"
        return Contact.UNDECIDED, (*remarks, near)
    if not outside:
        inside = "no free way from the flight to the outside was found: it may have flown inside the target"
        remarks = [*remarks, inside]
    return (Contact.UNDECIDED if remarks else Contact.NO), tuple(remarks)


def _beyond(
    contact: Contact, remarks: tuple[str, ...], since: float, bounds: FlightBounds
) -> tuple[Contact, tuple[str, ...]]:
    """Leave a flight undecided that was not seen to touch, but may have been where its drift is not bounded."""
    limits = ((bounds.range_limit, "m"), (bounds.speed_limit, "m/s"), (bounds.valid_until, "s"))
    said = " or ".join(f"{limit:.6g} {unit}" for limit, unit in limits if np.isfinite(limit))
    remark = f"from {since:.6g} s on it may be beyond {said}, where gravity is not bounded"
    return (Contact.UNDECIDED if contact is Contact.NO else contact), (*remarks, remark)


def _unreadable(time: Float[np.ndarray, "samples"], *states: Float[np.ndarray, "samples 3"]) -> Audit:
    """Audit a flight that holds a number which is not finite: undecided, with the first such sample named."""
    readable = np.all(np.isfinite(np.hstack(states)), axis=1)
    nan, unknown = float("nan"), np.full(1, np.nan)
    return Audit(
        contact=Contact.UNDECIDED,
        minimum_clearance=-np.inf,
        measured_clearance=np.inf,
        minimum_time=nan,
        minimum_position=(nan, nan, nan),
        inconsistent_steps=tuple(np.unique(np.maximum(np.flatnonzero(~readable) - 1, 0)).tolist()),
        start_outside=False,
        **_against("force", unknown, 0.0),
        **_against("speed", unknown, 0.0),
        guard_interventions=0,
        steps=len(time) - 1,
        remarks=(f"the sample at {time[np.argmin(readable)]:.6g} s holds a number that is not finite",),
    )


def _check(
    time: Float[np.ndarray, "samples"],
    states: dict[str, Float[np.ndarray, "flights samples 3"]],
    chaser_radius: float,
    tolerance: float,
    consistency: float,
) -> None:
    """Refuse arrays that are no flights, and numbers that nothing can be judged by."""
    if len(time) < 2:
        raise FlightError(f"audit: the flight has {len(time)} samples; it needs at least 2")
    if not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0.0):
        k = int(np.argmin(np.diff(time) > 0.0))
        raise FlightError(f"audit: time must rise from sample to sample; it goes {time[k]} s, {time[k + 1]} s")
    for name, array in states.items():
        if array.ndim != 3 or array.shape[1:] != (len(time), 3):
            raise FlightError(
                f"audit: {name} has shape {array.shape[1:]}; with {len(time)} times it must be ({len(time)}, 3)"
            )
    require_finite(chaser_radius, f"audit: chaser_radius is {chaser_radius} m", FlightError)
    for name, value in (("tolerance", tolerance), ("consistency", consistency)):
        require_finite(value, f"audit: {name} is {value} m", FlightError, positive=True)
