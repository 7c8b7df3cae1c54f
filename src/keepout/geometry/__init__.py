"""Geometry: meshes in, exact distances and offset solids out."""

from keepout.geometry.distance import BallCloudDistance, Distance, ExactDistance
from keepout.geometry.leak import LeakCheck, leak_check
from keepout.geometry.mesh_report import MeshReport
from keepout.geometry.octree import straddling_cells
from keepout.geometry.offset_solid import OffsetSolid
from keepout.geometry.survey import MeshSurvey, survey
from keepout.geometry.target import Target

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
