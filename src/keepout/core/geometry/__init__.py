"""Geometry: meshes in, exact distances and offset solids out."""

from keepout.core.geometry.distance import BallCloudDistance, Distance, ExactDistance
from keepout.core.geometry.leak import LeakCheck, leak_check
from keepout.core.geometry.mesh_report import MeshReport
from keepout.core.geometry.octree import straddling_cells
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.survey import MeshSurvey, survey
from keepout.core.geometry.target import Target

__all__ = [
    "BallCloudDistance",
    "Distance",
    "ExactDistance",
    "LeakCheck",
    "MeshReport",
    "MeshSurvey",
    "OffsetSolid",
    "Target",
    "leak_check",
    "straddling_cells",
    "survey",
]
