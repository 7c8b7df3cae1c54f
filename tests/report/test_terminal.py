"""Tables on a terminal of 80 columns: every figure is there, and none is cut or broken."""

import io
import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rich.console import Console

from keepout.commands.mesh import describe_targets
from keepout.report import terminal

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


CASES = ("paper without circulation", "paper with circulation", "default law")


@pytest.mark.parametrize("names", [("box",), CASES[:2], CASES])
@pytest.mark.parametrize("figure", [0.0, 0.9204, LONGEST])
def test_flights(names, figure):
    flights = [flight(name, figure * (k + 1), steps=k + 7) for k, name in enumerate(names)]
    text = drawn(terminal.flights_table(flights))
    check(text, *terminal.FLIGHT_COLUMNS.values(), *(value for one in flights for value in figures_of(one)))


def test_what_a_flight_goes_beyond_is_said_under_the_table():
    said = ["disturbance: flown up to 0.028 N > disturbance.bound 0.0143 N", "faults.delay 2 != guard.delay 1"]
    beyond = flight("stormy", 0.5) | {"assumptions_broken": said}
    text = drawn(terminal.flights_table([flight("calm", 0.5), beyond]))
    check(text, *(word for word in "; ".join(said).split()), "nothing", "promised:")
    assert words(drawn(terminal.flights_table([flight("calm", 0.5)]))).isdisjoint({"promised:", "nothing"})


def test_a_campaigns_facts():
    summary = {
        "runs": 1_000_000,
        "minimum_clearance_m": LONGEST,
        "statuses": {
            "control": {"nominal": 12_345_678, "escaping": 345, "no_way_out": 12},
            "guard": {"clear": 12_000_000, "braking": 345_678, "escaping": 12},
        },
        "flagged": {"STATE_JUMP": 12, "FIELD": 1, "COMMAND": 123_456, "ESTIMATE": 7},
        "faults": {},
        "flights": "out/a-folder-with-a-long-name/of-a-campaign/around-a-station-with-a-name/mission-flights.parquet",
        "target_sha256": "37c698e952d3421040d75dfe141e87d11ef325f66eeb478966a605c1e7569d65",
    }
    path, digest = summary["flights"], summary["target_sha256"]
    text = drawn(terminal.facts_table("Campaign", summary))
    figures = {key: value for key, value in summary.items() if key not in ("flights", "target_sha256")}
    check(text, *figures.values(), *summary)
    # A path and a digest are longer than the terminal is wide: folded, and whole when put together again.
    joined = "".join(re.split(r"[\s│┌┐└┘─]+", text))
    assert path in joined
    assert digest in joined


def test_targets():
    rows = describe_targets()
    text = drawn(terminal.targets_table(rows))
    check(text, *(row["name"] for row in rows), *(str(row["triangles"]) for row in rows))
    for row in rows:
        assert f"{row['volume_m3']:.1f}" in words(text)
        assert "×".join(f"{extent:.1f}" for extent in row["extents_m"]) in words(text)
        for key, value in row["parameters"].items():
            assert f"{key}={value:g}" in words(text)


def measures(figure: float) -> dict:
    """What `measure` measures, with one figure everywhere: as many columns and entries as it really has."""
    off = ("from_m", "to_m", "mean_absolute", "root_mean_square", "absolute_999", "over_999", "eikonal")
    bend = ("level", "median", "percentile_99", "maximum")
    apart = ("level", "chamfer", "hausdorff", "learned_to_target", "learned_to_target_95")
    apart = (*apart, "learned_to_target_maximum", "target_to_learned", "target_to_learned_maximum")
    kept_out = ("chaser_radius", "level", "learned", "contact", "iou", "hull", "ellipsoid")
    proof = ("chaser_radius", "error_bound", "sampled_maximum", "gradient_bound", "gradient_found")
    return {
        "field": "box.keepout",
        "epsilon_m": figure,
        "near": dict.fromkeys(off, figure),
        "far": dict.fromkeys(off, 2.0 * figure),
        "curvature": [dict.fromkeys(bend, figure * (k + 1)) for k in range(3)],
        "surface": dict.fromkeys(apart, figure),
        "volumes": [dict.fromkeys(kept_out, figure * (k + 1)) for k in range(3)],
        "certificates": [
            {
                **dict.fromkeys(proof, figure * (k + 1)),
                "kind": "certified",
                "gradient_kind": "certified",
                "margin": {"mean": figure, "percentile_95": 3.0 * figure},
            }
            for k in range(3)
        ],
    }


@pytest.mark.parametrize("figure", [0.5, LONGEST])
def test_the_measures_of_a_field(figure):
    text = drawn(*terminal.measures_tables(measures(figure)))
    assert "…" not in text
    found = {word.rstrip(",") for word in words(text)}
    assert {terminal.shown(figure * k) for k in (1, 2, 3)} | {"certified", "Chamfer", "ellipsoid", "IoU"} <= found
    assert text.count(terminal.shown(figure)) >= 30


@example([("a", 0.0), *(("a" * 21, figure) for figure in (-7851.0, 0.0, 0.0))])
@given(
    st.lists(st.tuples(st.text("abcdefgh -", min_size=1, max_size=30), st.floats(-1e9, 1e9)), min_size=1, max_size=4)
)
def test_no_flights_figure_is_ever_cut(given_flights):
    flights = [flight(name, figure) for name, figure in given_flights]
    text = drawn(terminal.flights_table(flights))
    assert "…" not in text
    assert {terminal.shown(value) for one in flights for value in figures_of(one)[1:]} <= words(text)


def test_nothing_is_shown_as_none():
    assert terminal.shown({}) == "none"
    assert terminal.shown([]) == "none"
