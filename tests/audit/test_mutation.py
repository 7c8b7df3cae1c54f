"""The audit broken on purpose: what must be said of flights known in closed form is then no longer said.

Each check is the one that an ordinary test makes.
"""

import numpy as np
import pytest
from truths.audited import (
    check_a_cavity_is_not_called_safe,
    check_a_dip_between_samples_is_found,
    check_a_push_not_recorded_leaves_room,
    check_an_edited_position_is_caught,
)

from keepout.audit import audit
from keepout.audit.tube import Tube


def look_at_samples_only(monkeypatch):
    """Between two samples the chaser is taken to be at the nearer one: the tube is nothing."""

    def piece(self, flight, index, start, end):
        sample = index + np.where(0.5 * (start + end) <= 0.5, 0, 1)
        nothing = np.zeros(len(index))
        return self.position[flight, sample], nothing, nothing

    monkeypatch.setattr(Tube, "piece", piece)


def take_the_middle_for_the_whole(monkeypatch):
    """A piece of path is taken for its middle: its radius is nothing."""
    whole = Tube.piece

    def piece(self, *arguments):
        point, error, _ = whole(self, *arguments)
        return point, error, error

    monkeypatch.setattr(Tube, "piece", piece)


def forget_what_is_not_recorded(monkeypatch):
    """Disturbance and drift are taken for nothing."""
    whole = Tube.piece

    def piece(self, flight, index, start, end):
        point, error, radius = whole(self, flight, index, start, end)
        return point, np.zeros_like(error), radius - error

    monkeypatch.setattr(Tube, "piece", piece)


def believe_every_step(monkeypatch):
    """Samples are never asked whether a motion joins them."""
    monkeypatch.setattr(Tube, "inconsistency", lambda self: np.full(self.residual.shape, -1.0))


def believe_every_start(monkeypatch):
    """A flight is taken to be outside wherever it is."""
    monkeypatch.setattr(audit, "proved_outside", lambda *_, **__: True)


@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (look_at_samples_only, check_a_dip_between_samples_is_found),
        (take_the_middle_for_the_whole, check_a_dip_between_samples_is_found),
        (forget_what_is_not_recorded, check_a_push_not_recorded_leaves_room),
        (believe_every_step, check_an_edited_position_is_caught),
        (believe_every_start, check_a_cavity_is_not_called_safe),
    ],
)
def test_a_break_is_noticed(broken, check, monkeypatch):
    check()
    broken(monkeypatch)
    with pytest.raises(AssertionError):
        check()
