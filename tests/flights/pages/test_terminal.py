"""Tables on a terminal of 80 columns: every figure is there, and none is cut or broken."""

import io
import re

from hypothesis import example, given
from hypothesis import strategies as st
from rich.console import Console

from keepout.flights.pages import terminal

WIDTH = 80
LONGEST = -1.234e-05
"""A figure as long as four digits of a float become."""


def drawn(*tables) -> str:
    console = Console(width=WIDTH, file=io.StringIO())
    for table in tables:
        console.print(table)
    return console.file.getvalue()


def words(text: str) -> set[str]:
    """Everything between spaces and the lines of a table."""
    return set(re.split(r"[\s│┃┌┐└┘├┤┏┓┗┛┡┩╇┳━─┬┴]+", text))


def check(text: str, *figures: object) -> None:
    assert "…" not in text
    assert max(len(line) for line in text.splitlines()) <= WIDTH
    missing = {part for figure in figures for part in terminal.shown(figure).split()} - words(text)
    assert not missing


def flight(name: str, figure: float, steps: int = 1500, **other: object) -> dict:
    figures = ("minimum_clearance_m", "final_error_m", "delta_v_mps", "saturated_fraction", "largest_speed_mps")
    return {
        "name": name,
        "reached": True,
        "contact_verdict": "no",
        "start_certified": True,
        **{key: figure * (1.0 + 0.1 * k) for k, key in enumerate(figures)},
        **{"time_to_reach_s": 600.0, "propellant_kg": None, "guard_interventions": steps, "navigation": None},
        "assumptions_broken": [],
    } | other


def test_what_a_flight_goes_beyond_is_said_under_the_table():
    said = ["disturbance: flown up to 0.028 N > disturbance.bound 0.0143 N", "faults.delay 2 != guard.delay 1"]
    text = drawn(terminal.flight_table(flight("stormy", 0.5, assumptions_broken=said)))
    check(text, *(word for word in "; ".join(said).split()), "nothing", "promised:")
    assert words(drawn(terminal.flight_table(flight("calm", 0.5)))).isdisjoint({"promised:", "nothing"})


@example("a" * 30, -7851.0)
@given(st.text("abcdefgh -", min_size=1, max_size=30), st.floats(-1e9, 1e9))
def test_no_flights_figure_is_ever_cut(name, figure):
    errors = {f"{of}_error_{kind}_{unit}": figure for kind in ("cap", "rms", "largest") for of, unit in _ERRORS}
    one = flight(name, figure, navigation={"suite": "near", "estimate": "filter", **errors})
    text = drawn(terminal.flight_table(one))
    assert "…" not in text
    assert {terminal.shown(one[key]) for key in terminal.FLIGHT_ROWS if one[key] is not None} <= words(text)
    assert text.count(" error, ") == len(errors)


_ERRORS = (("position", "m"), ("velocity", "mps"))


def test_the_verdict_never_says_more_than_is_proved():
    """A proved bound is rounded down; what is not proved is not called free."""
    proved = flight("calm", 0.2229, guard={"promised": 1})
    said = "Reached its goal after 600 s. No contact, proved: the clearance is at least 0.222 m at every instant. "
    assert terminal.verdict(proved).startswith(said + "The guard's theorem held")
    for said, changes in (
        ("Did not reach its goal: 0.245 m away at the end. ", {"reached": False}),
        (" Contact. ", {"contact_verdict": "yes"}),
        (" Contact not excluded. ", {"contact_verdict": "undecided"}),
        ("theorem does not hold", {"start_certified": False}),
        (" No guard flew", {"start_certified": None}),
        ("Stuck: no view is left. No contact, proved", {"outcome": "stuck", "why": "no view is left"}),
    ):
        assert said in terminal.verdict(proved | changes)
    rates = [{"name": name, "count": count, "of": 5} for name, count in (("reached", 4), ("contact or undecided", 1))]
    assert terminal.verdict({"rates": rates}) == "4 of 5 flights reached their goal; 1 are not proved free of contact."
