"""The exterior broken on purpose: points in closed cavities are then called free, and the checks must notice."""

import numpy as np
import pytest
from truths.solids import check_a_narrow_hole_is_sealed, check_nested_shells_are_solid

from keepout.geometry import exterior, offset_solid


def flood_through_walls(monkeypatch):
    """The flood passes through cells that hold surfaces, so that every free cell is reached."""
    flood = exterior.flood

    def without(*arguments):
        cells, free, _ = flood(*arguments)
        return cells, free, free

    monkeypatch.setattr(offset_solid, "flood", without)


def forget_the_closing_radius(monkeypatch):
    """The flood is that of a point, which passes every hole."""
    flood = exterior.flood

    def without(distance, origin, side, depth, radius, progress):
        return flood(distance, origin, side, depth + 3, 0.0, progress)

    monkeypatch.setattr(offset_solid, "flood", without)


def believe_every_walk(monkeypatch):
    """A walk that comes to no end is taken to have come out."""
    monkeypatch.setattr(exterior, "_walk", lambda *arguments: np.full(len(arguments[-1]), exterior._OPEN, np.int8))


def hide_nothing(monkeypatch):
    """Cells that the flood does not reach are not hidden."""
    hidden_cells = exterior.hidden_cells

    def without(*arguments):
        cells, hidden = hidden_cells(*arguments)
        return cells, np.zeros_like(hidden)

    monkeypatch.setattr(offset_solid, "hidden_cells", without)


@pytest.mark.long
@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (flood_through_walls, check_nested_shells_are_solid),
        (flood_through_walls, lambda: check_a_narrow_hole_is_sealed(0.1)),
        (forget_the_closing_radius, lambda: check_a_narrow_hole_is_sealed(0.22)),
        (believe_every_walk, check_nested_shells_are_solid),
        (hide_nothing, check_nested_shells_are_solid),
    ],
)
def test_a_break_is_noticed(broken, check, monkeypatch):
    check()
    broken(monkeypatch)
    with pytest.raises(AssertionError):
        check()
