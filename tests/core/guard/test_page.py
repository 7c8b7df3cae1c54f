"""The numbers that docs/guard.md prints are those of the product, to the last digit printed."""

import re
from pathlib import Path

import pytest

from keepout.core.geometry.target import Target
from keepout.core.guard.braking import design
from keepout.core.mission.scenario import Scenario
from keepout.core.mission.surroundings import Surroundings

PAGE = (Path(__file__).parents[3] / "docs" / "guard.md").read_text(encoding="utf-8")
TABLE = re.search(r"^\| ε_r, ε_v \| delay \| ρ \| σ \| a_b \| U \|\n\|[ |-]+\|\n((?:\|.*\|\n)+)", PAGE, re.MULTILINE)
ROWS = [line.strip("| ").split(" | ") for line in TABLE[1].splitlines()] if TABLE else []
UNITS = {"m": 1.0, "mm": 1e-3, "m/s": 1.0, "mm/s": 1e-3, "mm/s²": 1e-3, "N": 1.0, "kg": 1.0, "s": 1.0}


def number(text):
    """Value of a printed number with its unit, in SI units."""
    digits, unit = text.split()
    return float(digits) * UNITS[unit]


def printed(value, text):
    """A value as the text prints its own: in the same unit, to the same digit."""
    digits, unit = text.split()
    return f"{value / UNITS[unit]:.{len(digits.partition('.')[2])}f} {unit}"


def made(**guard):
    """What the guard assumes of the default scenario with these entries, and its braking law."""
    scenario = Scenario().replace(guard=guard)
    assumed = Surroundings(scenario, Target.load(scenario.target.source)).guard_assumptions
    return assumed, design(assumed)


def test_the_page_has_the_numbers():
    assert len(ROWS) >= 4


def test_the_default_scenarios_numbers_are_of_the_product():
    words = " ".join(PAGE.split())
    said = re.search(r"D = (\S+ \S+), a_b = (\S+ \S+), ρ = (\S+ \S+) and σ = (\S+ [^\s.]+)\.", words)
    assert said
    assumed, braking = made()
    values = (assumed.disturbance, braking.deceleration, braking.position_radius, braking.velocity_radius)
    assert [printed(value, text) for value, text in zip(values, said.groups(), strict=True)] == list(said.groups())


@pytest.mark.parametrize("row", ROWS, ids=lambda row: " ".join(row[:2]))
def test_the_table_is_of_the_product(row):
    errors, delay, *said = row
    position_error, velocity_error = (number(error) for error in errors.split(", "))
    assumed, braking = made(position_error=position_error, velocity_error=velocity_error, delay=int(delay))
    assert assumed.force_limit == number(re.search(r"With errors, force F_max = ([\d.]+ N)", PAGE)[1])
    values = (braking.position_radius, braking.velocity_radius, braking.deceleration, braking.reserve)
    assert [printed(value, text) for value, text in zip(values, said, strict=True)] == said
