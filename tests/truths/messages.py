"""A flight of a toy law along a scenario's own orbit and turning, as a record, for what exports and reads flights."""

import jax
import numpy as np

from keepout.core.flight import loop
from keepout.core.flight.record import FlightRecord
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from truths.flights import KEY, Spring, make_setup

GEOSTATIONARY = {"name": "toy", "target": {"source": "box"}}
TUMBLING = {
    "name": "toy-tumbling",
    "epoch": "2027-03-04T05:06:07.5Z",
    "orbit": {"semi_major_axis": 6.8e6, "eccentricity": 0.001, "inclination": 0.9, "right_ascension": 0.4, "j2": True},
    "attitude": {
        "kind": "tumbling",
        "angular_velocity": [0.001, 0.002, -0.003],
        "inertia": [[3, 0, 0], [0, 2, 0], [0, 0, 1.5]],
    },
    "target": {"source": "box", "centre_of_mass": [0.1, -0.2, 0.3]},
}


LONGEST = 120


def toy_flight(tree, *, start=(0.0, 6.0, 4.0), goal=(3.0, -6.0, 4.0), steps=LONGEST):
    """Give scenario and record of a flight past the target."""
    scenario = Scenario.parse(
        tree | {"duration": float(steps), "start": {"position": start}, "goal": {"position": goal}}
    )
    motion = Surroundings(scenario).motion
    law = Spring(motion, np.asarray(goal))
    setup = make_setup(
        motion=motion, controller=law, goal=np.asarray(goal), disturbance=Surroundings(scenario).disturbance
    )
    initial = motion.initial_state(np.asarray(start), np.zeros(3))
    assert steps <= LONGEST
    # As many rows for all of them, so that flights of the same kind share a program.
    log = jax.tree.map(lambda column: column[: steps + 1], loop.fly(setup, initial, LONGEST, KEY))
    return scenario, FlightRecord.of_log(log, scenario=scenario.model_dump_json(), target_sha256="")
