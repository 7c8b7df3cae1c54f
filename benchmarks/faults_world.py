"""Where `faults.py` flies: a target with the guard's field, the law and its field, the starts, and the disturbances."""

import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from keepout.core.control.geodesic import Geodesic
from keepout.core.fields import load_shipped, shipped_names
from keepout.core.fields.field import values, values_and_gradients
from keepout.core.flight import faults as broken
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.guard.field import guard_field
from keepout.core.mission.build import build_guard
from keepout.core.mission.law import broken_as, build_law, room_for_guard
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.disturbance import CombinedDisturbance, SinusoidalDisturbance, SquareWaveDisturbance

MESHES = Path(__file__).resolve().parents[2] / "shared" / "meshes"
RADIUS, MARGIN, MASS, FORCE, SPEED = 0.5, 0.1, 20.0, 0.1, 0.1
BOUND = 0.0143
"""Disturbance bound assumed by the guard, N: just above the paper's disturbance, 0.01 √2 N."""
REACH = 25.0
"""Starts are drawn within this of the goal along each axis, m, so that a flight of 600 s can get there."""
CLOSE = 0.1
"""Metres below the law's margin down to which close starts are drawn."""


def disturbances(kind, flights, generator):
    """Stack one disturbance a flight, in a direction of its own; all kinds have one structure of arrays."""
    direction = generator.normal(size=(flights, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    amplitude, frequency, phase = np.zeros((3, flights, 1, 3))
    square, period = np.zeros((flights, 3)), 100.0
    if kind == "paper":
        amplitude[:], frequency[:], phase[:] = 0.01, [0.02, 0.02, 0.01], [0.0, np.pi / 2, 0.0]
    elif kind in ("constant", "twice the bound"):
        amplitude[:, 0], phase[:] = (0.999 if kind == "constant" else 2.0) * BOUND * direction, np.pi / 2
    else:
        square, period = 0.999 * BOUND * direction, 2.0 if kind == "resonant" else 2.0 * np.pi / 0.05
    template = CombinedDisturbance(
        (SinusoidalDisturbance(amplitude[0], frequency[0], phase[0]), SquareWaveDisturbance(square[0], period))
    )
    stacked = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (flights, *leaf.shape)), template)
    return eqx.tree_at(
        lambda d: (d.parts[0].amplitude, d.parts[0].frequency, d.parts[0].phase, d.parts[1].amplitude),
        stacked,
        tuple(map(jnp.asarray, (amplitude, frequency, phase, square))),
    )


@functools.cache
def look_up(name):
    """Give the target of a name or mesh file, its shipped field or None, and the digest of what the law flies by."""
    path = MESHES / name if (MESHES / name).is_file() else Path(name)
    target = Target.load(path if path.suffix else name)
    if path.stem not in shipped_names():
        return target, None, target.sha256
    model = load_shipped(path.stem, target=target)
    return target, model, model.sha256


class World:
    """A target with all that its rows share: the guard's field, the law and its field, the box of starts."""

    def __init__(self, name, *, keeps_margin=False):
        self.name, self.keeps_margin = Path(name).stem, keeps_margin
        self.target, shipped, self.digest = look_up(name)
        self.solid = OffsetSolid.build(self.target.distance, closing_radius=0.25)
        lower, upper = self.target.vertices.min(axis=0), self.target.vertices.max(axis=0)
        self.grid = guard_field(self.target, RADIUS)
        centre = 0.5 * (lower + upper)
        self.goal = np.array([centre[0], lower[1] - 4.0, centre[2] - 2.0])
        self.lower, self.upper = np.maximum(lower - 4.0, self.goal - REACH), np.minimum(upper + 4.0, self.goal + REACH)
        self.model, self.law_field = (shipped, "shipped") if shipped else (self.grid, "grid")
        room = (np.minimum(self.lower, self.goal) - 3.0, np.maximum(self.upper, self.goal) + 3.0)
        scenario = self.scenario("", 600)
        kept = room_for_guard(Surroundings(scenario, self.target))
        chosen = {"guidance": Geodesic(bounds=room), "from_start": False} | kept
        self.law = build_law(scenario, self.model, **chosen)

    def scenario(self, told, duration):
        """Give the scenario behind a group of rows, with the strongest disturbance that any of them flies."""
        entry = {"position_error": 0.01, "velocity_error": 3e-4, "gain_error": 0.02} if told else {}
        entry |= {"delay": 1} if told == "late" else {}
        entry |= {"keeps_margin": self.keeps_margin}
        return Scenario().replace(
            goal={"position": tuple(self.goal)},
            start={"position": tuple(self.upper)},
            disturbance={"kind": "constant", "force": (2.0 * BOUND, 0.0, 0.0), "bound": BOUND},
            chaser={"radius": RADIUS, "mass": MASS, "force_limit": FORCE, "speed_limit": SPEED},
            safety={"margin": MARGIN},
            guard=entry,
            duration=float(duration),
        )

    def setup(self, told, duration):
        """Give the setup of a group of rows: what differs within it are arrays (`varied`), so it compiles once."""
        scenario = self.scenario(told, duration)
        law = broken_as(scenario, self.law, self.model.field)
        stuck = broken.StuckThruster(1, 1, 0.0, start=jnp.inf)
        parts = (broken.WrongEstimate(), broken.DroppedCommands(0.0), broken.ThrusterGain(0.0), stuck)
        late = (broken.DelayedCommands(1),) if told == "late" else ()
        return Surroundings(scenario).setup(
            broken.BrokenLaw(law, self.grid.field, "none", FORCE, MASS, SPEED),
            disturbance=jax.tree.map(lambda leaf: leaf[0], disturbances("paper", 1, np.random.default_rng(0))),
            guard=build_guard(Surroundings(scenario, self.target)),
            faults=broken.CombinedFaults((*parts, *late)),
        )

    def starts(self, guard, generator, count, *, close):
        """Draw starts outside the target; `close` ones are inside the law's own margin, but outside the guard's."""
        offset, kept = float(self.law.velocity.offset), []
        for _ in range(200):
            points = generator.uniform(self.lower, self.upper, (8192, 3))
            if close:
                points = self._onto_law_level(points, offset - CLOSE * generator.random(len(points)))
            points = points[values(self.grid.field, points) > guard.least_value + (0.02 if close else 0.5)]
            points = points[self.solid.is_exterior(points)]
            law_value = values(self.model.field, points)
            kept.append(points[(law_value < offset) if close else (law_value > offset + 0.1)])
            if sum(map(len, kept)) >= count:
                break
        found = np.concatenate(kept)
        if len(found) == 0:
            raise SystemExit(f"{self.name}: no room for starts around {self.goal.tolist()}")
        return np.resize(found, (count, 3))

    def _onto_law_level(self, points, level):
        """Move points to where the law's field has the values `level`: what is drawn at large is hardly ever there."""
        for _ in range(4):
            value, gradient = values_and_gradients(self.model.field, points)
            squared = np.maximum((gradient**2).sum(axis=1), 0.1)
            points = points + ((level - value) / squared)[:, None] * gradient
        return points[((points > self.lower) & (points < self.upper)).all(axis=1)]
