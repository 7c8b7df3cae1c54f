"""Whole inspections: what is seen as flown, how near the target, at what cost; beside other tours, lit, dispersed.

    python benchmarks/inspection.py [PART ...] [--targets NAME ...] [--flights 200] [--out FILE] [--json]

Stand-off 1.5 m, range 10 m (ISS 20 m), cone 60 degrees, turn 1 degree a second, patches of 0.25 m (ISS 1 m), 99.5 % of
the area that can be seen (and lit) wanted; chaser and disturbance are the scenario's defaults, guard on. The start is
8 m off the target's box. A mesh without a shipped field is flown by a grid of exact distances, and so is the ISS, whose
shipped field is above the distance where the stand-off is kept.

Parts:
  targets    one flight by the plan, without light
  baselines  the same by the nearest views (their tour is the first plan), and by the tour "circumnavigation"
  light      the same in a low orbit, with the sun fixed in the body frame, and as it moves, with the Earth's shadow
  dispersed  flights from dispersed starts, with errors of the estimate up to their bounds (by default --flights of
             them around the first two targets); all of a target share what can be seen, and the first plan

A row has the figures of `keepout inspect`. `seeable_seconds` and `plan_seconds` are what came before the flight; in
`seconds` they are left out. `coverage_loss` of a dispersed flight is against the row of `targets`. Rows are kept in
the file as they come, and none is made twice with the same settings; several runs may share it.
"""

import dataclasses
import functools
import sys
import time
from pathlib import Path

import numpy as np
from kept_rows import Rows, command, tell
from nearest_views import nearest_views

from keepout.apps.inspection.inspect import inspect
from keepout.apps.inspection.inspection import shares
from keepout.apps.inspection.light import Light, ever_lit
from keepout.apps.inspection.planning import plan
from keepout.apps.inspection.problem import Problem, Wanted, boresight_of, rules_of
from keepout.core.errors import KeepoutError
from keepout.core.fields import shipped_names
from keepout.core.geometry.target import Target
from keepout.core.mission.scenario import Scenario

OUT = Path(__file__).with_name("results") / "inspection.json"
PARTS = ("targets", "baselines", "light", "dispersed")
TARGETS = ("intelsat30", "tiangong", "iss", "../shared/meshes/ssl1300.glb", "../shared/meshes/hubble.glb")
RECIPE = 2
"""Raised where the flights change: rows of an older one are flown again."""
PLACE = ("part", "target", "tour", "light", "seed")
SETTINGS = ("recipe", "stand_off_m", "range_m", "patch_m", "wanted", "limit_s")
SHOWN = (*PLACE, "outcome", "coverage_seeable", "coverage_upper_bound", "views", "way_m", "plan_seconds", "contact")
SHOWN += ("minimum_clearance_m", "delta_v_mps", "duration_s", "coverage_loss")
STAND_OFF, WANTED, AWAY = 1.5, 0.995, 8.0
FAR, LARGE, LONG = {"iss": 20.0}, {"iss": 1.0}, {"iss": 60_000.0}
"""Range, m, edge of the patches, m, and longest flight, s, where they are not 10 m, 0.25 m and 20,000 s."""
LONG_IN_SUN = {"tiangong": 90_000.0, "iss": 120_000.0}
"""The same in the light of a sun that moves: a third of an orbit is shadow, and a side is lit for part of the rest."""
BY_GRID = ("iss",)
"""Flown by a grid of exact distances, though there is a shipped field."""
LOW_ORBIT = 6_878_000.0
"""Semi-major axis, m."""
LIGHTS = {
    "none": {},
    "fixed": {"light": {"kind": "fixed", "direction": (1.0, -1.0, 1.0)}, "orbit": {"semi_major_axis": LOW_ORBIT}},
    "sun": {"light": {"kind": "sun"}, "orbit": {"semi_major_axis": LOW_ORBIT}},
}
POSITION_ERROR, VELOCITY_ERROR = 0.01, 3e-4
"""Largest errors of the estimate, m and m/s: the guard's bounds, and what is drawn anew each period."""
BESIDE, MOVING = 2.0, 0.01
"""Dispersion of the start on each axis, ± m and ± m/s."""


class Inspected:
    """One target, with what can be seen of it and the plans made: its rows share them."""

    def __init__(self, source, *, stand_off=STAND_OFF, patch=None, reach=None, **entries):
        self.target = Target.load(source)
        self.name = self.target.name
        start = 0.5 * (self.target.vertices.min(axis=0) + self.target.vertices.max(axis=0))
        start[1] = self.target.vertices[:, 1].max() + AWAY
        tree = {
            "name": f"inspect-{self.name}",
            "duration": LONG.get(self.name, 20_000.0),
            "target": {"source": source},
            "field": {"source": "shipped" if self.name in shipped_names() and self.name not in BY_GRID else "grid"},
            "start": {"position": start.tolist()},
            "camera": {"greatest_range": reach or FAR.get(self.name, 10.0)},
            "inspect": {"stand_off": stand_off, "patch_size": patch or LARGE.get(self.name, 0.25), "coverage": WANTED},
        }
        self.scenario = Scenario.parse(tree | entries)
        self.problem, self.seeable_seconds, self.plans = None, 0.0, {}

    def lit(self, light):
        """Give the entries of a light."""
        longer = light == "sun" and self.name in LONG_IN_SUN
        return LIGHTS[light] | ({"duration": LONG_IN_SUN[self.name]} if longer else {})

    def flown(self, part, tour="plan", light="none", seed=0):
        """Give the scenario of a row."""
        scenario = self.scenario.replace(seed=seed, inspect=tour_of(tour), **self.lit(light))
        if part != "dispersed":
            return scenario
        generator = np.random.default_rng((seed, 21))
        start = np.asarray(scenario.start.position) + generator.uniform(-BESIDE, BESIDE, 3)
        errors = {"position_error": POSITION_ERROR, "velocity_error": VELOCITY_ERROR}
        return scenario.replace(
            start={"position": start.tolist(), "velocity": generator.uniform(-MOVING, MOVING, 3).tolist()},
            disturbance={"phase": float(generator.uniform(0.0, 2.0 * np.pi))},
            guard=errors,
            faults={"position_noise": POSITION_ERROR, "velocity_noise": VELOCITY_ERROR},
        )

    def prepared(self, scenario, tour, light, say):
        """Give problem, first plan (None for a tour without one) and the seconds that the plan took."""
        if self.problem is None:
            began = time.perf_counter()
            self.problem = Problem.of(self.scenario, self.target)
            self.seeable_seconds = time.perf_counter() - began
            say(f"{self.name}: what can be seen took {self.seeable_seconds:.0f} s")
        if (tour, light) not in self.plans:
            planned = self.scenario.replace(inspect=tour_of(tour), **self.lit(light))
            problem = dataclasses.replace(self.problem, scenario=planned, rules=rules_of(planned), light=Light(planned))
            first, began = None, time.perf_counter()
            if tour != "circumnavigation":
                first = first_plan(problem, nearest=tour == "nearest")
            self.plans[tour, light] = problem, first, time.perf_counter() - began
            say(f"{self.name}, {tour}, {light}: the plan took {self.plans[tour, light][2]:.0f} s")
        return self.plans[tour, light]

    def row(self, part, tour="plan", light="none", seed=0, say=lambda words: None):
        """Fly one inspection and give its figures; a refusal is a row too."""
        scenario = self.flown(part, tour, light, seed)
        try:
            problem, first, plan_seconds = self.prepared(scenario, tour, light, say)
            inspection = inspect(scenario, target=self.target, problem=problem, first=first)
        except KeepoutError as refusal:
            return {"outcome": "refused", "why": str(refusal)}
        return {
            **inspection.summary(),
            "shares": shares(inspection),
            "units": int(problem.patches.counted.sum()),
            "seeable_seconds": self.seeable_seconds,
            "plan_seconds": plan_seconds,
        }

    def plan_of(self, part, tour, light, seed):
        """Give the entries that say which row it is, and with what settings."""
        inspected, camera = self.scenario.inspect, self.scenario.camera
        place = (part, self.name, tour, light, seed)
        made = (RECIPE, inspected.stand_off, camera.greatest_range, inspected.patch_size, inspected.coverage)
        longest = self.scenario.replace(**self.lit(light)).duration
        return dict(zip((*PLACE, *SETTINGS), (*place, *made, longest), strict=True))


def tour_of(name):
    """Give the scenario's entry for a tour; that to the nearest views is a first plan like any other."""
    return {"tour": "plan" if name == "nearest" else name}


def first_plan(problem, *, nearest=False):
    """Make the plan that an inspection begins with."""
    scenario = problem.scenario
    lit = ever_lit(problem.camera, problem.seeable.possible, scenario.duration)
    wanted = Wanted(problem.patches, lit, scenario.inspect.coverage)
    if nearest:
        return nearest_views(problem, wanted.left, wanted.share_of_left)
    return plan(
        problem,
        position=np.asarray(scenario.start.position),
        time=0.0,
        wanted=wanted.left,
        share=wanted.share_of_left,
        boresight=boresight_of(scenario, problem.target).direction,
    )


def asked(part, flights, seed):
    """Give tour, light and seed of each row of a part."""
    return {
        "targets": [("plan", "none", 0)],
        "baselines": [("nearest", "none", 0), ("circumnavigation", "none", 0)],
        "light": [("plan", "fixed", 0), ("plan", "sun", 0)],
        "dispersed": [("plan", "none", one) for one in range(seed, seed + flights)],
    }[part]


def loss(row, rows):
    """Give what a dispersed flight saw less than the calm one around the same target, or None."""
    like = {"part": "targets", "target": row["target"]}
    calm = next((one for one in rows if like.items() <= one.items()), None)
    if row["part"] != "dispersed" or calm is None or not {"coverage_seeable"} <= row.keys() & calm.keys():
        return None
    return calm["coverage_seeable"] - row["coverage_seeable"]


def say(text):
    """Tell how it goes on."""
    print(text, file=sys.stderr, flush=True)


def fly(inspected, parts, rows, *, flights, seed):
    """Fly the rows around one target that are not kept yet; give all that were asked for."""
    shown = []
    for part in parts:
        for tour, light, number in asked(part, flights, seed):
            wanted = inspected.plan_of(part, tour, light, number)
            shown.append(rows.made(wanted, functools.partial(inspected.row, part, tour, light, number, say)))
    return [row | {"coverage_loss": loss(row, rows.kept)} for row in shown]


def main():
    """Fly what is asked for and print it."""
    parser = command(__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=f"of {', '.join(PARTS)}")
    parser.add_argument("--targets", nargs="+", help="built-ins or mesh files")
    parser.add_argument("--flights", type=int, default=200, help="dispersed ones around each target")
    parser.add_argument("--seed", type=int, default=0, help="of the first of them")
    parser.add_argument("--out", type=Path, default=OUT, help="rows kept")
    arguments = parser.parse_args()
    for part in arguments.parts:
        if part not in PARTS:
            parser.error(f"no part {part!r}; it must be one of {', '.join(PARTS)}")
    rows, shown = Rows(arguments.out, PLACE, SETTINGS), []
    for source in arguments.targets or TARGETS:
        every = arguments.targets or source in TARGETS[:2]
        parts = [part for part in arguments.parts if every or part != "dispersed"]
        shown += fly(Inspected(source), parts, rows, flights=arguments.flights, seed=arguments.seed)
    tell(shown, arguments, SHOWN)


if __name__ == "__main__":
    main()
