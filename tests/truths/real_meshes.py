"""Real spacecraft meshes, which are not part of the repository: where each is from, and its sha256.

`KEEPOUT_MESHES` names the folder that holds them; without it, `../shared/meshes` beside the repository is looked at.
A file that is there must have the hash below. Tests that want real meshes run on those that are there, which may be
none: they add to the messy meshes of `truths.messy_meshes`, which are always there.

"""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(os.environ.get("KEEPOUT_MESHES") or Path(__file__).resolve().parents[3] / "shared" / "meshes")
NASA_42 = "the models of NASA's simulator 42 (https://github.com/ericstoneking/42, NASA Open Source Agreement)"
NASA_3D = "NASA 3D Resources (https://github.com/nasa/NASA-3D-Resources, not copyrighted)"


@dataclass(frozen=True)
class RealMesh:
    """One file by name."""

    name: str
    sha256: str
    source: str
    scale: float = 1.0
    """Metres a file unit."""

    @property
    def path(self) -> Path:
        return FOLDER / self.name

    @property
    def is_whole(self) -> bool:
        """Whether the file has the hash that is known of it."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest() == self.sha256


REAL_MESHES = (
    RealMesh(
        "aura_arbitrary_units.glb",
        "64bd72c1d2b9718ea2abedcca74cce630fa6d962a3f72f0c434008d81f432c3e",
        f"Aura, from {NASA_3D}; 1 unit is 0.342 m",
        0.342,
    ),
    RealMesh(
        "hubble.glb", "02bf1dc79caa65da7fd14e78feaea020efefdeb9da6a9ff34482483659894adf", f"Hubble, from {NASA_42}"
    ),
    RealMesh(
        "iss.glb",
        "9b14f46caa8fd0eadd195a1ff6434b1f867835f958241e2ef04fe85c33714aba",
        f"International Space Station, from {NASA_42}",
    ),
    RealMesh(
        "itokawa.obj",
        "8787c981156775acd56b461994b694319321a9b6c16e031f3c718244198aacde",
        f"asteroid Itokawa, from {NASA_42}; watertight, taken at 20 m a unit",
        20.0,
    ),
    RealMesh(
        "ssl1300.glb",
        "b6f3d8584e4d9ae541ecf80a1ca678b000a905df9ec538089e3e466d6c7a72b3",
        f"SSL-1300 communications satellite, from {NASA_3D}",
    ),
    RealMesh(
        "tdrs.glb",
        "a1954d36393e3dff8f8cabdca2f9d4da4d1b463685158d7d3679718dda907201",
        f"TDRS relay satellite, from {NASA_3D}",
    ),
)


def present() -> list[RealMesh]:
    """Real meshes that are there, whole or not."""
    return [mesh for mesh in REAL_MESHES if mesh.path.is_file()]
