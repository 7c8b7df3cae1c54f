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


def flight(name: str, figure: float, steps: int = 1500) -> dict:
    figures = ("minimum_clearance_m", "final_error_m", "delta_v_mps", "saturated_fraction")
    return {
        "name": name,
        "reached": True,
        "contact": False,
        **{key: figure * (1.0 + 0.1 * k) for k, key in enumerate(figures)},
        "guard_interventions": steps,
        "assumptions_broken": [],
    }


def figures_of(one: dict) -> list:
    return [value for key, value in one.items() if key != "assumptions_broken"]


def test_what_a_flight_goes_beyond_is_said_under_the_table():
    said = ["disturbance: flown up to 0.028 N > disturbance.bound 0.0143 N", "faults.delay 2 != guard.delay 1"]
    beyond = flight("stormy", 0.5) | {"assumptions_broken": said}
    text = drawn(terminal.flights_table([flight("calm", 0.5), beyond]))
    check(text, *(word for word in "; ".join(said).split()), "nothing", "promised:")
    assert words(drawn(terminal.flights_table([flight("calm", 0.5)]))).isdisjoint({"promised:", "nothing"})


@example([("a", 0.0), *(("a" * 21, figure) for figure in (-7851.0, 0.0, 0.0))])
@given(
    st.lists(st.tuples(st.text("abcdefgh -", min_size=1, max_size=30), st.floats(-1e9, 1e9)), min_size=1, max_size=4)
)
def test_no_flights_figure_is_ever_cut(given_flights):
    flights = [flight(name, figure) for name, figure in given_flights]
    text = drawn(terminal.flights_table(flights))
    assert "…" not in text
    assert {terminal.shown(value) for one in flights for value in figures_of(one)[1:]} <= words(text)
