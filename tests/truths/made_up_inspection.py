"""An inspection that nobody flew: a camera carried round a box on a circle; what it sees is known in closed form.

The box is convex, so that nothing hides or shades anything else: a place on a side is before the camera, or lit, by
the angle to that side's normal alone.
"""

import math

import numpy as np

from keepout.apps.inspection.inspection import Frame, Inspection
from keepout.apps.inspection.plan import InspectionPlan, PlannedView
from keepout.apps.inspection.seeing.patches import Patches
from keepout.apps.inspection.seeing.seeable import Hidden, Seeable, Verdict
from keepout.apps.inspection.seeing.visible import SeeingRules
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario
from truths.made_up_exploration import HALF, circle, made_up_flight, made_up_record

PERIOD = 20.0
RULES = SeeingRules(field_of_view=math.radians(50.0), pixels=512)
SUN = np.array([-0.2, -0.9, 0.4]) / np.linalg.norm([-0.2, -0.9, 0.4])
DARK = (5, 6)
"""Frames in the Earth's shadow, where the sun matters."""


def box_patches(across=4, half=HALF):
    """Each side of the box in `across`² equal rectangles; the sides in the order -x, -y, -z, x, y, z."""
    corners, normals = [], []
    edges = np.linspace(-1.0, 1.0, across + 1)
    for sign in (-1.0, 1.0):
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            order = ((0, 0), (1, 0), (1, 1), (0, 1)) if sign > 0 else ((0, 0), (0, 1), (1, 1), (1, 0))
            for i in range(across):
                for j in range(across):
                    square = np.zeros((4, 3))
                    square[:, axis] = sign * half[axis]
                    square[:, u] = [edges[i + a] * half[u] for a, _ in order]
                    square[:, v] = [edges[j + b] * half[v] for _, b in order]
                    corners.append(square)
                    normals.append(sign * np.eye(3)[axis])
    corners, normals = np.array(corners), np.array(normals)
    sides = np.linalg.norm(np.diff(corners[:, :3], axis=1), axis=2)
    count = len(corners)
    return Patches(
        corners=corners,
        counts=np.full(count, 4),
        normals=normals,
        areas=sides.prod(axis=1),
        centres=corners.mean(axis=1),
        faces=np.zeros(count, int),
        counted=np.arange(2 * count) % 2 == 0,
        size=float(sides.max()),
    )


def seen_of_box(patches, rules, position, boresight, sun=None):
    """Units of a convex box that a camera outside it sees wholly: by each corner alone."""
    away = position - patches.corners
    far = np.linalg.norm(away, axis=2)
    cosine = np.einsum("nki,ni->nk", away, patches.normals) / far
    along = -(away @ boresight) / far
    good = (cosine >= math.cos(rules.greatest_incidence)) & (along >= math.cos(rules.half_angle))
    good &= (far > rules.least_range) & (far < rules.greatest_range)
    wholly = good.all(axis=1)
    if sun is not None:
        wholly &= patches.normals @ sun >= math.cos(rules.greatest_sun_incidence)
    return 2 * np.flatnonzero(wholly)


def made_up(*, views=8, light=False, across=4, name="made-up", outcome="all seen", **scenario):
    """Give the inspection; -z is told hidden, half of it enclosed and half too narrow, and a row of +z undecided."""
    whole = PERIOD * views
    entries = {"target": {"source": "box"}, "duration": whole} | scenario
    told = Scenario().replace(name=name, **entries)
    target, patches = Target.load("box"), box_patches(across)
    frames = []
    for number in range(views):
        position = circle(PERIOD * number, whole) + np.array([0.0, 0.0, 2.0])
        boresight = -position / np.linalg.norm(position)
        sun = SUN if light and number not in DARK else None
        units = seen_of_box(patches, RULES, position, boresight, sun)
        frames.append(Frame(PERIOD * number, position, boresight, sun, units[:0] if light and sun is None else units))
    seen = np.zeros(patches.units, bool)
    for frame in frames:
        seen[frame.units] = True
    side = np.repeat(np.arange(len(patches.areas)) // across**2, 2)
    row = np.repeat(np.arange(len(patches.areas)) % across, 2)
    verdict = np.full(patches.units, Verdict.SEEABLE, np.int8)
    why = np.full(patches.units, Hidden.NOT, np.int8)
    verdict[~patches.counted] = Verdict.UNDECIDED
    verdict[(side == 2) & patches.counted] = Verdict.HIDDEN
    why[(side == 2) & (row < across // 2)] = Hidden.ENCLOSED
    why[(side == 2) & (row >= across // 2)] = Hidden.NARROW
    verdict[(side == 5) & (row == 0)] = Verdict.UNDECIDED
    witness = np.where((verdict == Verdict.SEEABLE)[:, None], np.array([5.0, 5.0, 5.0]), np.nan)
    possible = patches.counted & (verdict != Verdict.HIDDEN)
    if light:
        possible &= patches.unit_normals() @ SUN >= math.cos(RULES.greatest_sun_incidence)
    lit = possible & (verdict == Verdict.SEEABLE)
    view = PlannedView(frames[0].position, frames[0].boresight, frames[0].units)
    record = made_up_record(told, target, whole)
    record.columns["position"] += np.array([0.0, 0.0, 2.0])
    return Inspection(
        flight=made_up_flight(told, target, record),
        outcome=outcome,
        why="every patch that the plan covers was in a frame",
        seconds=1.0,
        patches=patches,
        rules=RULES,
        seeable=Seeable(patches, verdict, why, witness),
        possible=possible,
        plan=InspectionPlan((view,) * views, lit.copy(), 20.0, whole, 100, views - 1, views + 1),
        plans=1,
        frames=tuple(frames),
        seen=seen,
    )
