"""Flights of a scenario, flown in batches and judged on the exact mesh by the scenario's own numbers as they land."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from keepout.core.audit.audit import Audit, ExactMesh, audit_campaign
from keepout.core.audit.tube import FlightBounds
from keepout.core.flight.batches import Landed, fly_batches
from keepout.core.flight.outcome import FlightOutcome
from keepout.core.flight.setup import FlightSetup
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings
from keepout.core.motion.relative import MotionState

AUDITED = ("time", "position", "velocity", "force", "guard_status")
"""Columns of a log that the audit looks at."""


def fly_audited(
    scenario: Scenario,
    target: ExactMesh,
    setup: FlightSetup,
    initial: MotionState,
    *,
    columns: Sequence[str] = (),
    landed: Landed | None = None,
    tolerance: float = 1e-3,
    **batches: Any,
) -> tuple[FlightOutcome, tuple[Audit, ...]]:
    """Fly a setup from many initial states, and audit each flight.

    Args:
        scenario: how long the flights are, and what they are judged by: chaser, and all that bounds their motion.
        target: the mesh.
        setup: of every flight; what differs between flights is named by `vary`.
        initial: states with a leading axis of flights.
        columns: of the log, for `landed` beside `AUDITED`.
        landed: gets each batch's columns once it is judged.
        tolerance: how close to the truth the clearance bounds are driven, m.
        **batches: further arguments of `fly_batches`, such as `vary`, `seed` or `batch`.

    Returns:
        The outcomes with a leading axis of flights, and the verdicts in the same order.

    """
    bounds, audits = Surroundings(scenario).flight_bounds, []

    def land(first: int, log: dict[str, np.ndarray]) -> None:
        audits.extend(judge(scenario, target, log, bounds=bounds, tolerance=tolerance))
        if landed is not None:
            landed(first, log)

    wanted = tuple(dict.fromkeys((*AUDITED, *columns)))
    outcome = fly_batches(setup, initial, scenario.steps, columns=wanted, landed=land, **batches)
    return outcome, tuple(audits)


def judge(
    scenario: Scenario,
    target: ExactMesh,
    log: Mapping[str, np.ndarray],
    *,
    bounds: FlightBounds | None = None,
    tolerance: float = 1e-3,
) -> list[Audit]:
    """Audit flights that were flown together, by the columns `AUDITED` of their log, each (flights, steps + 1, ...).

    Args:
        scenario: gives the chaser's radius and limits.
        target: the mesh.
        log: more columns do not matter.
        bounds: on what the log does not hold; by default the scenario's.
        tolerance: how close to the truth the clearance bounds are driven, m.

    """
    chaser = scenario.chaser
    return audit_campaign(
        log["time"][0],
        log["position"],
        log["velocity"],
        log["force"],
        target,
        guard_status=log["guard_status"],
        chaser_radius=chaser.radius,
        bounds=Surroundings(scenario).flight_bounds if bounds is None else bounds,
        force_limit=chaser.force_limit,
        speed_limit=chaser.speed_limit,
        tolerance=tolerance,
    )
