"""Seeing a target that nobody has a model of: which view comes next, and when there is none worth taking."""

from keepout.apps.unknown.next_view import Ended, NextView, Pace, choose
from keepout.apps.unknown.reachable import Reachable, reachable
from keepout.apps.unknown.tried import Tried

__all__ = ["Ended", "NextView", "Pace", "Reachable", "Tried", "choose", "reachable"]
