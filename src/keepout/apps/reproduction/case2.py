"""The paper's Case 2 (section VI.C.2): the same flight with and without the disturbance observer."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from keepout.apps.reproduction.figures import draw_comparisons, goal_error
from keepout.apps.reproduction.fitted import paper_network, target_of
from keepout.apps.reproduction.flown import kept_flight
from keepout.apps.reproduction.work import Part, Table, Work, side_by_side
from keepout.core.mission.flight import Flight
from keepout.core.mission.scenario import Scenario
from keepout.core.progress import part_of

PAPER = (
    "With the disturbance observer the position error converges to zero and h is always positive; figures of position "
    "error, h, V₁ and control input with and without it. No number tells the two apart."
)

WITHOUT, PRINTED, CONSTANT, HARMONIC = "no observer", "printed observer", "constant observer", "harmonic observer"
OBSERVERS = {WITHOUT: "off", PRINTED: "printed", CONSTANT: "constant", HARMONIC: "harmonic"}

FAST = "printed constants, 20 Hz, 10 N"
SLOW = "printed constants, 1 Hz, 0.1 N"
NETWORK = "printed constants and network, 1 Hz, 0.1 N"
PUSH = "extra: printed, 20 Hz, 10 N, constant push"
DEFAULT = "default law with guard, 1 Hz, 0.1 N"

_NAMES = {FAST: "fast", SLOW: "slow", NETWORK: "network", PUSH: "push", DEFAULT: "default"}

SETTLED = 0.2
"""Last part of a flight over which it is taken for settled."""


def case2_scenarios(seed: int, *, quick: bool, network: bool = False) -> dict[tuple[str, str], Scenario]:
    """Give one scenario for each comparison and observer; within a comparison all else is equal.

    A quick run leaves out the printed constants at 1 Hz and 0.1 N, and the constant observer. With `network` there is
    one more comparison, to be flown by a field of the paper's network.
    """
    paper = {"control": {"profile": "paper"}, "guard": {"enabled": False}}
    fast = {"control": {"profile": "paper", "period": 0.05}, "chaser": {"force_limit": 10.0}, "guard": paper["guard"]}
    push = {**fast, "disturbance": {"kind": "constant", "force": (5.0, 5.0, 5.0)}}
    flown: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
        FAST: (fast, (WITHOUT, PRINTED)),
        **({} if quick else {SLOW: (paper, (WITHOUT, PRINTED))}),
        **({NETWORK: (paper, (WITHOUT, PRINTED))} if network else {}),
        PUSH: (push, (WITHOUT, PRINTED) if quick else (WITHOUT, PRINTED, CONSTANT)),
        DEFAULT: ({}, (WITHOUT, HARMONIC) if quick else (WITHOUT, CONSTANT, HARMONIC)),
    }
    base = Scenario().replace(seed=seed, duration=500.0 if quick else 900.0)
    made = {}
    for comparison, (changes, observers) in flown.items():
        for observer in observers:
            control = {**changes.get("control", {}), "observer": OBSERVERS[observer]}
            name = f"{_NAMES[comparison]}-{OBSERVERS[observer]}"
            made[comparison, observer] = base.replace(name=name, **{**changes, "control": control})
    return made


def case2(work: Work) -> Part:
    """Fly Case 2's comparisons."""
    target = target_of("intelsat30")
    network = paper_network(work, target)
    scenarios = case2_scenarios(work.seed, quick=work.quick, network=network is not None)

    jobs = {
        scenario.name: functools.partial(
            kept_flight, work, scenario, target, model=network if comparison == NETWORK else None
        )
        for (comparison, _), scenario in scenarios.items()
    }
    flown = side_by_side(jobs, part_of(work.progress, 0.1, 0.95))
    flights = {key: flown[scenario.name] for key, scenario in scenarios.items()}
    rows = [row(*key, flight) for key, flight in flights.items()]
    return Part(
        name="case2",
        title="Case 2: disturbance observer",
        paper=PAPER,
        ours=found(rows, quick=work.quick),
        rows=rows,
        tables=[
            Table(
                "observers",
                f"With and without observer; settled: the last {100 * SETTLED:g} % of the flight; clearance by the "
                "audit on the exact mesh",
                rows,
            )
        ],
        drawings=_drawings(work, flights),
    )


def row(comparison: str, observer: str, flight: Flight) -> dict[str, Any]:
    """Give one flight's figures."""
    record, summary, error = flight.record, flight.summary(), goal_error(flight)
    settled = record.time >= (1.0 - SETTLED) * record.time[-1]
    effort = np.linalg.norm(record.force, axis=1)
    return {
        "comparison": comparison,
        "observer": observer,
        "reached": summary["reached"],
        "settled_error_rms_mm": 1e3 * float(np.sqrt(np.mean(error[settled] ** 2))),
        "settled_error_largest_mm": 1e3 * float(error[settled].max()),
        "settled_v1_median_m2": float(np.median(record.lyapunov[settled])),
        "minimum_h_m": float(record.barrier.min()),
        "minimum_clearance_m": summary["minimum_clearance_m"],
        "contact": summary["contact_verdict"],
        "largest_force_n": float(effort[:-1].max()),
        "settled_force_rms_n": float(np.sqrt(np.mean(effort[:-1][settled[:-1]] ** 2))),
        "saturated_fraction": summary["saturated_fraction"],
    }


def found(rows: list[dict[str, Any]], *, quick: bool) -> list[str]:
    """Say in plain sentences what the rows show."""
    error = {(entry["comparison"], entry["observer"]): entry["settled_error_rms_mm"] for entry in rows}
    low = {(entry["comparison"], entry["observer"]): entry["minimum_h_m"] for entry in rows}
    said = ["The flight is Case 1's, with the circulation; the paper does not print k_p, and 1.5 m is flown."]
    if (NETWORK, PRINTED) not in error:
        said.append("No field of the paper's network was flown: all flights here are by the shipped field.")
    for comparison in (FAST, SLOW, NETWORK):
        if (comparison, PRINTED) not in error:
            continue
        said.append(
            f"{comparison}: the settled error is {error[comparison, PRINTED]:.3g} mm with the printed observer and "
            f"{error[comparison, WITHOUT]:.3g} mm without it; the least h is {low[comparison, PRINTED]:.3g} m with it "
            f"and {low[comparison, WITHOUT]:.3g} m without."
        )
    said.append(
        "The printed A = I, L = 50 I and m = 20 kg give an estimate of a constant push d that settles where "
        "0 = A d̂ + (L/m)(d - d̂), at 5/3 d. What is left has two thirds of the size of the push and the opposite "
        "sign: the observer takes a third of a slow disturbance's effect away, and pushes the other way."
    )
    kept = error[PUSH, PRINTED] / error[PUSH, WITHOUT]
    said.append(
        f"The extra run makes it plain: under a constant push of 5 N an axis (limit 10 N, 20 Hz) the settled error is "
        f"{error[PUSH, WITHOUT]:.3g} mm without observer and {error[PUSH, PRINTED]:.3g} mm with the printed one, "
        f"{100 * kept:.0f} % of it"
        + ("." if quick else f"; with A = 0, Keepout's constant observer, {error[PUSH, CONSTANT]:.3g} mm.")
    )
    others = "" if quick else f", {error[DEFAULT, CONSTANT]:.3g} mm with the constant one"
    said.append(
        f"The default law, 1 Hz and 0.1 N, the paper's disturbance: {error[DEFAULT, WITHOUT]:.3g} mm without observer"
        f"{others}, {error[DEFAULT, HARMONIC]:.3g} mm with the harmonic one, its own."
    )
    return said


def _drawings(work: Work, flights: dict[tuple[str, str], Flight]) -> dict[str, str]:
    """Draw four quantities, each with and without observer."""
    drawn: dict[str, tuple[str, Callable[[Flight], np.ndarray], dict[str, Any]]] = {
        "error": (
            "Distance to the goal with and without observer; dotted: the tolerance",
            goal_error,
            {"label": "‖r − goal‖, m", "logarithmic": True, "levels": (Scenario().goal.tolerance,)},
        ),
        "barrier": (
            "h with and without observer; dotted: h = 0",
            lambda flight: flight.record.barrier,
            {"label": "h, m", "levels": (0.0,)},
        ),
        "lyapunov": (
            "V₁ with and without observer",
            lambda flight: flight.record.lyapunov,
            {"label": "V₁, m²", "logarithmic": True},
        ),
        "force": (
            "Norm of the force applied with and without observer",
            lambda flight: np.linalg.norm(flight.record.force[:-1], axis=1),
            {"label": "‖F‖, N", "logarithmic": True},
        ),
    }
    for name, (_, values, how) in drawn.items():
        panels: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
        for (comparison, observer), flight in flights.items():
            shown = values(flight)
            panels.setdefault(comparison, {})[observer] = (flight.record.time[: len(shown)], shown)
        draw_comparisons(work.folder / f"{name}.png", panels, **how)
    return {name: caption for name, (caption, *_) in drawn.items()}
