"""A depth sensor that sees a mesh: what it says, how wrong it can be, and how it is turned."""

from keepout.sensing.depth.camera import DepthCamera
from keepout.sensing.depth.depth import take
from keepout.sensing.depth.errors import ErrorDraw
from keepout.sensing.depth.pointing import Boresight, axes_towards
from keepout.sensing.depth.sure_return import sure_return_violations

__all__ = ["Boresight", "DepthCamera", "ErrorDraw", "axes_towards", "sure_return_violations", "take"]
