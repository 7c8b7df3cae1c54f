"""What can be seen at all: lower and upper bound on the area, and why the rest is not.

    python benchmarks/seeable.py [--meshes DIRECTORY] [--squares N] [--json]

One thread. Stand-off 1.5 m, range 10 m (ISS 20 m), incidence 60 degrees, patches 0.25 m (ISS 1 m). `seconds` is
processor time of `seeable` as a whole, the room included, without the compilation of its loops.
`places_that_contradict` must be 0: random places of the room, from 1.5 to 6 m from the mesh, that see a unit which is
called hidden.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from kept_rows import command, tell

from keepout.apps.inspection.seeing.patches import cut
from keepout.apps.inspection.seeing.room import Room
from keepout.apps.inspection.seeing.seeable import SQUARES, Hidden, Verdict, seeable
from keepout.apps.inspection.seeing.sightlines import Sightlines
from keepout.apps.inspection.seeing.visible import SeeingRules, visible
from keepout.core.geometry.target import Target

SHIPPED = ("intelsat30", "tiangong", "iss")
FILES = ("ssl1300", "hubble")
STAND_OFF = 1.5


def judged(source: str, squares: int, places: int) -> dict[str, Any]:
    """Judge one mesh."""
    target = Target.load(source, units="m") if Path(source).stem == "ssl1300" else Target.load(source)
    large = source == "iss"
    patches = cut(target, 1.0 if large else 0.25)
    rules = SeeingRules(greatest_range=20.0 if large else 10.0)
    sight = Sightlines(target.vertices, target.faces, patches)
    began = time.process_time()
    room = Room(target.distance, STAND_OFF)
    found = seeable(sight, rules, room, squares=squares)
    took = time.process_time() - began
    hidden = found.verdict == Verdict.HIDDEN
    return {
        "mesh": Path(source).stem,
        "units_counted": int(patches.counted.sum()),
        "lower": found.lower,
        "upper": found.upper,
        "gap": found.upper - found.lower,
        "enclosed": patches.coverage(found.why == Hidden.ENCLOSED),
        "narrow": patches.coverage(found.why == Hidden.NARROW),
        "squares": found.squares,
        "units_undecided": int((found.verdict == Verdict.UNDECIDED)[patches.counted].sum()),
        "seconds": took,
        "places_looked_from": places,
        "places_that_contradict": sum(
            bool(len(visible(sight, rules, place, among=hidden).units)) for place in _places(target, places)
        ),
    }


def _places(target: Target, count: int) -> np.ndarray:
    room, generator = Room(target.distance, STAND_OFF), np.random.default_rng(0)
    used = target.vertices[target.faces]
    low, high = used.min(axis=(0, 1)) - 6.0, used.max(axis=(0, 1)) + 6.0
    chosen = np.empty((0, 3))
    while len(chosen) < count:
        some = generator.uniform(low, high, size=(4 * count, 3))
        some = some[target.distance.distance(some) < 6.0]
        chosen = np.concatenate([chosen, some[room.allowed(some)]])
    return chosen[:count]


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--meshes", type=Path, help="folder with ssl1300.glb and hubble.glb")
    parser.add_argument("--squares", type=int, default=SQUARES, help="of directions; what is left then is undecided")
    parser.add_argument("--places", type=int, default=1000, help="that are looked from against the verdicts")
    parser.add_argument("--only", nargs="*", help="names of the meshes wanted")
    given = parser.parse_args()
    sources = list(SHIPPED)
    if given.meshes is not None:
        sources += [str(given.meshes / f"{name}.glb") for name in FILES]
    if given.only:
        sources = [source for source in sources if Path(source).stem in given.only]
    judged("box", None, 0)  # compiles the loops
    tell([judged(source, given.squares, given.places) for source in sources], given)


if __name__ == "__main__":
    main()
