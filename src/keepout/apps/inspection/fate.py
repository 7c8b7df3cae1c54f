"""What became of each unit of a target's surface in an inspection: seen, or why not."""

import enum
from typing import Any

import numpy as np
from jaxtyping import Int, Int8

from keepout.apps.inspection.inspection import Inspection
from keepout.apps.inspection.seeing.seeable import Hidden, Verdict

_DIGITS = 4
"""Decimals of the lengths in a list for people: tenths of a millimetre."""


class Fate(enum.IntEnum):
    """What became of a unit."""

    SEEN = 0
    """Wholly, in a frame of the flight."""
    MISSED = 1
    """Not seen, though it can be, and is lit at some time of the mission."""
    SHADOWED = 2
    """Not seen, and never lit in the mission's time, though there is a place to see it from."""
    ENCLOSED_BY_RAYS = 3
    """Proved hidden. Measured: each of many rays from its middle meets the mesh."""
    NARROW_BY_RAYS = 4
    """Proved hidden. Measured: some of these rays gets out, so that incidence, range, stand-off or width forbid it."""
    UNDECIDED = 5
    """Not seen, and neither a place to see it from is known nor a proof that there is none."""
    NOT_COUNTED = 6
    """Nobody asks for it: the inner side of a closed part."""


WORDS = {
    Fate.SEEN: "seen",
    Fate.MISSED: "could be seen, was not",
    Fate.SHADOWED: "never lit",
    Fate.ENCLOSED_BY_RAYS: "hidden: enclosed, by rays",
    Fate.NARROW_BY_RAYS: "hidden: too narrow, by rays",
    Fate.UNDECIDED: "undecided",
    Fate.NOT_COUNTED: "not counted",
}
"""For people."""


def fates(inspection: Inspection) -> Int8[np.ndarray, " units"]:
    """Give what became of each unit, a `Fate`; what was seen counts as seen, whatever the verdict on it was."""
    seeable = inspection.seeable
    found = np.full(inspection.patches.units, Fate.UNDECIDED, np.int8)
    hidden = seeable.verdict == Verdict.HIDDEN
    found[hidden] = Fate.NARROW_BY_RAYS
    found[hidden & (seeable.why == Hidden.ENCLOSED)] = Fate.ENCLOSED_BY_RAYS
    found[seeable.verdict == Verdict.SEEABLE] = Fate.SHADOWED
    found[inspection.lit] = Fate.MISSED
    found[inspection.seen] = Fate.SEEN
    found[~inspection.patches.counted] = Fate.NOT_COUNTED
    return found


def first_frames(inspection: Inspection) -> Int[np.ndarray, " units"]:
    """Give the frame that first saw each unit; -1 where none did."""
    first = np.full(inspection.patches.units, -1)
    for number in reversed(range(len(inspection.frames))):
        first[inspection.frames[number].units] = number
    return first


def shares(inspection: Inspection) -> dict[str, float]:
    """Give shares of the area counted: what can be seen and lit, what was, and the rest by its reason.

    `seen` and the reasons `missed`, `shadowed`, `enclosed_by_rays`, `narrow_by_rays` and `undecided` add up to 1.
    `hidden` is what is proved to be, seen or not; that it is enclosed or too narrow is measured by rays.
    `seen_beyond_proof` is what was seen though it is proved hidden from the room allowed, as from nearer than the
    stand-off.
    """
    patches, fate = inspection.patches, fates(inspection)
    beyond = inspection.seen & (inspection.seeable.verdict == Verdict.HIDDEN)
    return {
        "seeable": inspection.seeable.lower,
        "seeable_and_lit": patches.coverage(inspection.lit),
        "hidden": patches.coverage(inspection.seeable.verdict == Verdict.HIDDEN),
        **{kind.name.lower(): patches.coverage(fate == kind) for kind in Fate if kind is not Fate.NOT_COUNTED},
        "seen_beyond_proof": patches.coverage(beyond),
    }


def unseen(inspection: Inspection) -> list[dict[str, Any]]:
    """List the units counted that were not seen, and why: by reason, and the largest first.

    Returns:
        Of each its `patch` and `side` (0: the one that the patch's normal points to), the `reason` (a `Fate` in small
        letters), the `area` in m², `centre` in m and outward `normal` in the body frame.

    """
    patches, fate, areas, normals = (
        inspection.patches,
        fates(inspection),
        inspection.patches.unit_areas(),
        inspection.patches.unit_normals(),
    )
    left = np.flatnonzero((fate != Fate.SEEN) & (fate != Fate.NOT_COUNTED))
    left = left[np.lexsort((left, -areas[left], fate[left]))]
    return [
        {
            "patch": int(unit // 2),
            "side": int(unit % 2),
            "reason": Fate(fate[unit]).name.lower(),
            "area": float(f"{areas[unit]:.6g}"),
            "centre": np.round(patches.centres[unit // 2], _DIGITS).tolist(),
            "normal": (np.round(normals[unit], _DIGITS) + 0.0).tolist(),
        }
        for unit in left
    ]
