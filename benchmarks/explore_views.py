"""How many views open the way to goals near an unknown target: the choice of views alone, without flight dynamics.

Usage: python benchmarks/explore_views.py [--targets NAME ...] [--views N] [--sure-empty METRES ...] [--goals N]
           [--towards N] [--fly-around] [--keep METRES] [--seed N] [--json FILE]

The camera jumps to each place that `keepout.apps.unknown` chooses in known-free room, takes an image of the exact mesh
with random errors, and the map grows. Goals are drawn evenly over the surface, 1 m from it along its normal and from
all other parts, outside closed bodies. A goal is connected if a way that keeps the chaser's radius leads to it.

All round: one exploration without a goal, and the share of all goals connected after some views. Towards (--towards):
one exploration a goal from the outside, and the share that is reachable after some views. Seconds are of the processor,
the largest of any choice but the first.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from keepout.apps.led.camera import axes_towards
from keepout.apps.led.first_hit import FirstHit
from keepout.apps.unknown.cells import Tried
from keepout.apps.unknown.depth_sensor import DepthCamera, take
from keepout.apps.unknown.known_free import KnownFreeMap, ViewStatus
from keepout.apps.unknown.next_view import UP, Ended, NextView, Seeker, choose, sphere
from keepout.apps.unknown.view import SensorBounds
from keepout.apps.unknown.ways import reachable
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.target import Target

RADIUS, HEIGHT, DECLARED = 0.5, 1.0, 0.5
"""Of the chaser, of goals over the surface, and of the declared ball beyond the target, m."""
COUNTED = (10, 20, 40, 60, 80)


def solid(name: str) -> trimesh.Trimesh:
    """Give a simple body: a ball, a box open at one end and 4.6 m deep, or two plates 2.7 m apart."""
    if name == "ball":
        return trimesh.creation.icosphere(4, 2.0)
    if name == "plates":
        parts = [((4.0, 4.0, 0.3), (0.0, 0.0, side * 1.5)) for side in (-1.0, 1.0)]
    elif name == "pocket":
        walls = [((0.4, 4.0, 5.0), (side * 1.8, 0.0, 0.0)) for side in (-1.0, 1.0)]
        walls += [((3.2, 0.4, 5.0), (0.0, side * 1.8, 0.0)) for side in (-1.0, 1.0)]
        parts = [*walls, ((3.2, 3.2, 0.4), (0.0, 0.0, -2.3))]
    else:
        target = Target.load(name)
        return trimesh.Trimesh(target.vertices, target.faces, process=False)
    boxes = []
    for size, centre in parts:
        box = trimesh.creation.box(size)
        box.apply_translation(centre)
        boxes.append(box)
    return trimesh.util.concatenate(boxes)


def goals_near(mesh: trimesh.Trimesh, count: int, seed: int, *, height: float = HEIGHT) -> np.ndarray:
    """Draw places `height` metres from the surface, evenly over it; (count, 3) m."""
    exact = ExactDistance(np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces))
    generator = np.random.default_rng(seed)
    found: list[np.ndarray] = []
    while len(found) < count:
        points, faces = trimesh.sample.sample_surface(mesh, 256, seed=int(generator.integers(2**31)))
        places = points + height * mesh.face_normals[faces]
        found.extend(places[np.abs(exact.distance(places) - height) < 1e-3])
    return np.array(found[:count])


@dataclass
class Jumping:
    """An exploration in which the camera is at once where it wants to be."""

    mesh: trimesh.Trimesh
    name: str
    camera: DepthCamera
    keep: float
    seed: int

    def __post_init__(self) -> None:
        self.generator = np.random.default_rng(self.seed)
        vertices, faces = np.asarray(self.mesh.vertices, dtype=float), np.asarray(self.mesh.faces)
        self.first_hit = FirstHit(vertices, faces)
        self.radius = float(np.linalg.norm(vertices, axis=1).max()) + DECLARED
        self.known = KnownFreeMap.begin(np.zeros(3), self.radius, bounds=self.camera.bounds, name=self.name)
        self.tried = Tried.nothing(self.known)
        outward = self.generator.normal(size=3)
        outward /= np.linalg.norm(outward)
        self.position, self.direction = (self.radius + 1.0) * outward, -outward
        self.seconds = 0.0
        self.choices = 0

    def look(self) -> int:
        """Take a view; give how many cubes it opened."""
        axes = axes_towards(self.direction, UP)
        view = take(self.camera, self.first_hit, self.position, axes, self.generator)
        report = self.known.see(view)
        if report.status in (ViewStatus.SEEN, ViewStatus.EMPTY):
            self.tried.note(self.known, view.camera, view)
        return report.opened

    def step(self, goal: np.ndarray | None) -> NextView | Ended:
        """Choose the next view and jump there."""
        before = time.process_time()
        seeker = Seeker(self.position, self.camera.camera, self.keep, self.direction)
        answer = choose(self.known, seeker, goal, self.tried, seed=self.choices)
        if self.choices:
            self.seconds = max(self.seconds, time.process_time() - before)
        self.choices += 1
        if isinstance(answer, NextView) and not answer.is_goal:
            self.position, self.direction = answer.position, answer.direction
        return answer

    def connected(self, goals: np.ndarray) -> float:
        """Share of the goals that a known way leads to."""
        reach = reachable(self.known, self.position, self.keep)
        return float(np.mean([reach.leads_to(self.known, goal) for goal in goals]))

    def free_share(self) -> float:
        """Share of the declared ball's volume that is known free."""
        closed = np.count_nonzero(~self.known.free) * self.known.spacing**3
        return max(0.0, 1.0 - closed / (4.0 / 3.0 * math.pi * self.radius**3))


def all_round(run: Jumping, goals: np.ndarray, views: int) -> dict:
    """Explore without a goal; after an end the shares stay what they are."""
    shares, answer, taken = {}, None, 0
    for taken in range(1, views + 1):
        run.look()
        answer = run.step(None)
        if taken in COUNTED or taken == views:
            shares[taken] = run.connected(goals)
        if isinstance(answer, Ended):
            break
    share = run.connected(goals)
    for count in (*COUNTED, views):
        if taken <= count <= views:
            shares[count] = share
    outcome, why = (answer.outcome, answer.why) if isinstance(answer, Ended) else (None, "")
    return {
        "mode": "all round",
        "views": taken,
        "connected": {str(k): shares[k] for k in sorted(shares)},
        "free_share": run.free_share(),
        "choice_seconds": run.seconds,
        "outcome": outcome,
        "why": why,
    }


def fly_around(run: Jumping, goals: np.ndarray, views: int) -> dict:
    """Look at the middle from places spread evenly over a sphere outside the declared ball: what choosing is for."""
    shares = {}
    for taken, outward in enumerate(sphere(views), start=1):
        run.position, run.direction = (run.radius + 1.0) * outward, -outward
        run.look()
        if taken in COUNTED or taken == views:
            shares[str(taken)] = run.connected(goals)
    return {
        "mode": "fly around",
        "views": views,
        "connected": shares,
        "free_share": run.free_share(),
        "choice_seconds": 0.0,
        "outcome": None,
        "why": "",
    }


def towards(runs: Iterable[Jumping], goals: np.ndarray, views: int) -> dict:
    """Explore towards each goal from the start."""
    needed, ends, seconds = [], [], 0.0
    for run, goal in zip(runs, goals, strict=True):
        answer = None
        for _ in range(views):
            run.look()
            answer = run.step(goal)
            if isinstance(answer, Ended) or answer.is_goal:
                break
        reached = isinstance(answer, NextView) and answer.is_goal
        needed.append(run.choices if reached else math.inf)
        ends.append("reachable" if reached else answer.why if isinstance(answer, Ended) else "views are used up")
        seconds = max(seconds, run.seconds)
    counted = sorted({*(count for count in COUNTED if count <= views), views})
    return {
        "mode": "towards",
        "goals": len(goals),
        "connected": {str(count): float(np.mean(np.array(needed) <= count)) for count in counted},
        "median_views": float(np.median(needed)) if math.isfinite(np.median(needed)) else None,
        "choice_seconds": seconds,
        "not_reached": [end for end in ends if end != "reachable"],
    }


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", nargs="+", default=["ball", "plates", "pocket", "intelsat30"])
    parser.add_argument("--views", type=int, default=80)
    parser.add_argument("--sure-empty", nargs="+", type=float, default=[15.0, 0.0])
    parser.add_argument("--goals", type=int, default=200)
    parser.add_argument("--towards", type=int, default=0, help="goals explored towards, one exploration each")
    parser.add_argument("--fly-around", action="store_true", help="the same for views that nobody chooses")
    parser.add_argument("--keep", type=float, default=RADIUS, help="least distance of the chaser's centre, m")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    rows = []
    for name in given.targets:
        mesh = solid(name)
        for empty in given.sure_empty:
            camera = DepthCamera(bounds=SensorBounds(sure_empty_range=empty))
            jump = lambda seed, mesh=mesh, name=name, camera=camera: Jumping(mesh, name, camera, given.keep, seed)  # noqa: E731
            goals = goals_near(mesh, max(given.goals, given.towards), given.seed + 1)
            results = [all_round(jump(given.seed), goals[: given.goals], given.views)]
            if given.fly_around:
                results.append(fly_around(jump(given.seed), goals[: given.goals], given.views))
            if given.towards:
                runs = (jump(given.seed + i) for i in range(given.towards))
                results.append(towards(runs, goals[: given.towards], given.views))
            for result in results:
                row = {"target": name, "sure_empty_range_m": empty, "keep_m": given.keep, **result}
                rows.append(row)
                shares = "  ".join(f"{count}: {100 * share:5.1f} %" for count, share in row["connected"].items())
                print(
                    f"{name:12} s = {empty:4.1f} m  {row['mode']:10}  {shares}  {row['choice_seconds']:.2f} s a choice"
                )
                for text in row.get("not_reached", [row.get("why", "")]):
                    if text:
                        print(f"{'':14}{text}")
                sys.stdout.flush()
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
