"""Time and size of the geometry room on every built-in target and on meshes given by directory.

Usage: python benchmarks/geometry.py [--meshes DIRECTORY] [--slices DIRECTORY]

Prints one row a mesh: load, closest-point rate beside libigl's in the same run, offset solid at two closing radii
(seconds of wall clock and of processor), sealed volumes, and warnings. "peak" is the largest resident memory of a fresh
process through load, build and 100 000 signed distances, less what it was after the imports. Meshes without known units
are scaled as noted.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

import igl
import numpy as np
from kept_rows import with_meshes

from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.verbs.meshes import leak_warning

# Aura's file has no real unit (deployed length 17.37 m); Itokawa's is normalised, and is shown at 20 m.
SCALES = {"aura_arbitrary_units": 0.342, "itokawa": 20.0}


def peak_memory() -> float:
    """Largest resident memory of this process so far, MB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024.0
    return float("nan")


def measure(source: str, slices: Path | None) -> str:
    imported = peak_memory()
    start = time.perf_counter()
    target = Target.load(source, scale=SCALES.get(Path(source).stem))
    load = time.perf_counter() - start
    distance = target.distance
    points = np.random.default_rng(0).uniform(distance.lower - 3.0, distance.upper + 3.0, size=(100_000, 3))

    start, used = time.perf_counter(), time.process_time()
    solid = OffsetSolid.build(distance)
    build, processor = time.perf_counter() - start, time.process_time() - used
    solid.signed_distance(points[:100])
    start = time.perf_counter()
    signed = solid.signed_distance(points)
    signed_rate = len(points) / (time.perf_counter() - start)
    # Before libigl, the second solid and the figure are in memory.
    added = peak_memory() - imported

    start = time.perf_counter()
    d = distance.distance(points)
    rate = len(points) / (time.perf_counter() - start)
    start = time.perf_counter()
    squared, _, _ = igl.point_mesh_squared_distance(points[:20_000], target.vertices, target.faces)
    reference = 20_000 / (time.perf_counter() - start)
    difference = np.abs(np.sqrt(squared) - d[:20_000]).max()
    assert (signed <= d - solid.offset + 1e-12).all()
    if slices is not None:
        draw(target, solid, slices / f"{target.name}_mesh.png" if "/" in source else slices / f"{target.name}.png")
    start = time.perf_counter()
    tight = OffsetSolid.build(distance, closing_radius=solid.offset).sealed_volume
    tight_build = time.perf_counter() - start
    leak = leak_warning(tight, solid.sealed_volume)
    warnings = [*target.report.warnings, *([leak] if leak else []), *target.report.actions]
    x, y, z = target.report.extents
    figures = [
        Path(source).name,
        f"{target.report.triangles}",
        f"{x:.1f} x {y:.1f} x {z:.1f}",
        f"{load:.2f}",
        f"{rate:.1e}",
        f"{reference:.1e}",
        f"{difference:.0e}",
        f"{build:.1f}",
        f"{processor:.1f}",
        f"{added:.0f}",
        f"{signed_rate:.1e}",
        f"{solid.envelope:.3f}",
        f"{tight:.1f}",
        f"{solid.sealed_volume:.1f}",
        f"{tight_build:.1f}",
        "; ".join(warnings) or "none",
    ]
    return "| " + " | ".join(figures) + " |"


def draw(target: Target, solid: OffsetSolid, path: Path) -> None:
    """Slices of the signed distance through the middle of the target, with its zero level."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    lower, upper = solid.distance.lower - 1.0, solid.distance.upper + 1.0
    middle = 0.5 * (lower + upper)
    figure, panels = plt.subplots(1, 3, figsize=(24, 9))
    for panel, (u, v) in zip(panels, ((0, 1), (0, 2), (1, 2))):
        a, b = np.linspace(lower[u], upper[u], 600), np.linspace(lower[v], upper[v], 600)
        points = np.tile(middle, (600 * 600, 1))
        points[:, u], points[:, v] = (side.ravel() for side in np.meshgrid(a, b))
        signed = solid.signed_distance(points).reshape(600, 600)
        limit = max(0.5, float(-signed.min()))
        panel.contourf(a, b, np.clip(signed, -limit, limit), levels=40, cmap="RdBu")
        panel.contour(a, b, signed, levels=[0.0], colors="k", linewidths=0.8)
        panel.set(aspect="equal", xlabel=f"{'xyz'[u]} [m]", ylabel=f"{'xyz'[v]} [m]")
    figure.suptitle(f"{target.name}: signed distance to the offset solid")
    figure.savefig(path, dpi=60)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path)
    parser.add_argument("--slices", type=Path)
    parser.add_argument("--one", help="measure one source in this process")
    arguments = parser.parse_args()
    if arguments.one:
        print(measure(arguments.one, arguments.slices))
        return
    sources = with_meshes(["intelsat30", "iss", "tiangong", "box", "sphere", "pocket"], arguments.meshes)
    columns = [
        "mesh",
        "triangles",
        "extents, m",
        "load, s",
        "points/s",
        "libigl, points/s",
        "difference, m",
        "build, s",
        "build, cpu s",
        "peak, MB",
        "signed points/s",
        "envelope, m",
        "sealed at 0.03 m, m³",
        "sealed at 0.25 m, m³",
        "build at 0.03 m, s",
        "warnings and actions",
    ]
    print("| " + " | ".join(columns) + " |")
    print("|" + "---|" * len(columns))
    for source in sources:
        # A process each, so that the peak of memory is the mesh's own.
        command = [sys.executable, __file__, "--one", source]
        command += ["--slices", str(arguments.slices)] if arguments.slices else []
        print(subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip(), flush=True)


if __name__ == "__main__":
    main()
