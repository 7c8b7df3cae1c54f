"""What the page says of Case 1, in words made from its numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

PAPER = (
    "Without the circulation inequality the chaser is trapped in a local minimum; with it, it arrives, and the "
    "position error converges to zero. In both flights the barrier h stays positive; without circulation it falls to "
    "zero. Safe velocity and velocity keep within ±v_max. Start (0, 10, 6) m, goal (0, -10, -4) m, 1 Hz, 0.1 N, "
    "0.1 m/s. The slowing length k_p is not printed."
)


def findings(rows: Sequence[Mapping[str, Any]], counts: Sequence[Mapping[str, Any]], *, has_network: bool) -> list[str]:
    """Say what was found, a paragraph each.

    Args:
        rows: of the flights, as in `summary.json`.
        counts: of the map.
        has_network: whether the paper's own network was flown too.

    """
    said = [
        "tanh acts on each component apart, so k_p decides what the paper's law does here. With k_p much smaller than "
        "the way, v_c saturates in every component: the chaser leaves along the diagonal of the axes and slips past "
        "the bus. With large k_p it follows the straight line to the goal, into the corner of dish and bus.",
    ]
    said += [_sentence(row) for row in rows]
    lowest = min((row for row in rows if row["slowing_length_m"] is not None), key=lambda row: row["minimum_barrier_m"])
    said.append(
        f"h is not positive throughout: its least is {lowest['minimum_barrier_m']:.3g} m ({lowest['name']})."
        if lowest["minimum_barrier_m"] < 0.0
        else "h is never negative in these flights."
    )
    if not has_network:
        said.append("All these flights are by Keepout's own learned field: none of the paper's network was given.")
    by_length: dict[Any, list[str]] = {}
    for count in counts:
        words = f"{count['circulation']} {count['trapped']}, {count['clean']}, {count['touched']}"
        by_length.setdefault(count["k_p m"], []).append(words)
    for length, words in by_length.items():
        at = "By the default law without its guard" if length is None else f"At k_p = {length:g} m"
        of = f"of {counts[0]['pairs']} random pairs were trapped, arrived without a touch, touched"
        said.append(f"{at}, {of}: {'; '.join(words)}.")
    return said


def _sentence(row: Mapping[str, Any]) -> str:
    if row["trapped"]:
        end = f"comes to rest {row['final_error_m']:.3g} m from the goal"
    elif row["first_within_s"] is not None:
        end = f"is within the goal's tolerance after {row['first_within_s']:.0f} s"
    else:
        end = f"is still under way at the end, {row['final_error_m']:.3g} m from the goal"
    touch = {"no": "without contact", "yes": "and touches the target"}.get(row["contact_verdict"], "contact undecided")
    gap = row["minimum_clearance_m"]
    return f"{row['name'][0].upper()}{row['name'][1:]}: {end}, {touch} (least gap {gap:.3g} m)."
