"""The map of known-free room that depth views make: what has not been seen free is an obstacle."""

from keepout.apps.unknown.mapping.known_free import KnownFreeMap, ViewReport, ViewStatus
from keepout.apps.unknown.mapping.view import Pinhole, SensorBounds, View

__all__ = ["KnownFreeMap", "Pinhole", "SensorBounds", "View", "ViewReport", "ViewStatus"]
