"""A depth sensor that sees a mesh: what it says, how wrong it can be, and how it is turned."""

from keepout.apps.unknown.depth.camera import DepthCamera
from keepout.apps.unknown.depth.depth import take
from keepout.apps.unknown.depth.errors import ErrorDraw
from keepout.apps.unknown.depth.pointing import Boresight, axes_towards
from keepout.apps.unknown.depth.sure_return import sure_return_violations

__all__ = ["Boresight", "DepthCamera", "ErrorDraw", "axes_towards", "sure_return_violations", "take"]
