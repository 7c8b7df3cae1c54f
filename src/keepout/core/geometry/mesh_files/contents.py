"""What a reader hands on, and the checks that all readers share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from keepout.core.errors import MeshError

MOST_TRIANGLES, MOST_CORNERS, MOST_PLACED = 20_000_000, 60_000_000, 100_000
"""Of what a file makes out of few bytes by placing one thing many times: triangles, vertices or corners of triangles,
and placements. More is refused before anything is built."""
ROUNDING = 1e-6
"""Share of a mesh's size by which the rounding of its coordinates may change it."""
_UNIT = 2.0**-52
UNENDED = "the last line has no line end, as in a file that was cut short: its last number may be incomplete"


@dataclass(frozen=True, eq=False)
class MeshContents:
    """Triangles, or points: of a file in its units and axes, or a surface made of them, in metres.

    Attributes:
        vertices: (v, 3).
        faces: (f, 3) vertex indices; none where a file holds points only, (i, i, i) for each ball of a surface.
        actions: what the reading left out or did, one line each.
        unit: the length unit that a file declares, in the file's own word.
        broken: of the skin of a map: what makes it one that nothing is promised of.
        ball_radius: of the surface of a point cloud, metres, positive.

    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    actions: tuple[str, ...] = ()
    unit: str | None = None
    broken: tuple[str, ...] = ()
    ball_radius: float = 0.0


@dataclass(frozen=True, eq=False)
class Place:
    """Where a node, an instance or a component puts what it holds, in file axes.

    Attributes:
        matrix: from its own axes.
        magnitude: product of the absolute values of the matrices that `matrix` is the product of: how large a number
            was met, also where large ones cancel.

    """

    matrix: Float[np.ndarray, "4 4"]
    magnitude: Float[np.ndarray, "4 4"]

    def then(self, own: Float[np.ndarray, "4 4"]) -> "Place":
        """Give the place of a child by the child's own matrix."""
        return Place(self.matrix @ own, self.magnitude @ np.abs(own))


FILE_AXES = Place(np.eye(4), np.eye(4))


class Resolution:
    """Whether placed parts are still there: what rounding takes of each beside its size."""

    def __init__(self) -> None:
        self._parts: list[tuple[str, float, float, float]] = []

    def note(self, name: str, box: tuple[np.ndarray, np.ndarray], place: Place) -> None:
        """Note a part, named for a refusal, with its `box` in its own axes."""
        lower, upper = box
        size = float((np.abs(place.matrix[:3, :3]) @ (upper - lower)).max())
        met = float((place.magnitude[:3] @ [*np.maximum(np.abs(lower), np.abs(upper)), 1.0]).max())
        if np.isfinite(met):  # what is not finite is refused where a triangle uses it
            self._parts.append((name, size, met, float(np.abs(place.matrix[:3, 3]).max())))

    def require(self) -> None:
        """Refuse a file of which a part is lost to rounding; a part that is a point to the whole file may be.

        Raises:
            MeshError: naming what placed the part, and how far.

        """
        largest = max((size for _, size, _, _ in self._parts), default=0.0)
        for name, size, met, moved in self._parts:
            if size > 0.0 and 4.0 * _UNIT * met > max(ROUNDING * size, 2.0**-40 * largest):
                raise MeshError(
                    f"{name} is {size:.4g} in size and its transforms move it by numbers up to {met:.4g}, in the end "
                    f"by {moved:.4g}: rounding would change it by more than a millionth of its size"
                )


def box(vertices: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lowest and highest coordinates; of no vertices the origin."""
    return (vertices.min(axis=0), vertices.max(axis=0)) if len(vertices) else (np.zeros(3), np.zeros(3))


def resolved(vertices: Float[np.ndarray, "n 3"], size: float) -> bool:
    """Whether float64 coordinates hold a mesh of this size to a millionth of it."""
    return bool(_UNIT * np.abs(vertices).max(initial=0.0) <= ROUNDING * size)


def require_countable(placements: int, triangles: int, corners: int) -> None:
    """Refuse a file that places more than can be built; the limits are this module's.

    Args:
        placements: of objects or meshes.
        triangles: in all placements together.
        corners: vertices, or corners of triangles where there are more, in all placements together.

    Raises:
        MeshError: with the number and the limit.

    """
    for number, most, noun in (
        (placements, MOST_PLACED, "placements"),
        (triangles, MOST_TRIANGLES, "triangles"),
        (corners, MOST_CORNERS, "vertices or corners"),
    ):
        if number > most:
            told = str(number) if number < 10**30 else f"10^{int(number.bit_length() * 0.30103)}"
            raise MeshError(f"it makes {told} {noun}; at most {most} are built")


def counted(number: int, noun: str) -> str:
    """Say how many: "1 face", "2 faces"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def left_out(numbers: Mapping[str, int]) -> list[str]:
    """One action line for each noun of which anything was left out; a comma may end the noun."""
    parts = ((number, noun.partition(",")) for noun, number in numbers.items() if number)
    return [f"left out {counted(number, head)}{comma}{tail}" for number, (head, comma, tail) in parts]


def with_plain_line_ends(text: str) -> str:
    """Turn every kind of line end into one newline character."""
    return text.replace("\r\n", "\n").replace("\r", "\n")


def text_lines(path: Path) -> tuple[list[str], list[str]]:
    """Read a text file.

    Returns:
        Its lines, whatever the line ends, and an action line if the last one has no end.

    """
    text = with_plain_line_ends(path.read_bytes().decode("utf-8-sig", errors="replace"))
    lines = text.split("\n")
    return lines, [] if text.endswith("\n") or not lines[-1].split() else [UNENDED]


def to_numbers(words: Sequence[str], place: str) -> Float[np.ndarray, "n"]:
    """Convert words to float64.

    Raises:
        MeshError: beginning with `place`, and naming the first word that is no plain number.

    """
    return np.array(_converted(words, float, place, "a number"), dtype=np.float64)


def to_indices(words: Sequence[str], place: str) -> list[int]:
    """Convert words to whole numbers.

    Raises:
        MeshError: beginning with `place`, and naming the first word that is no whole number.

    """
    return _converted(words, int, place, "a whole number")


_Number = TypeVar("_Number", int, float)


def _converted(words: Sequence[str], kind: Callable[[str], _Number], place: str, noun: str) -> list[_Number]:
    joined = "".join(words)
    # Python would also take 1_0 or other digits.
    if "_" in joined or not joined.isascii():
        wrong = next(word for word in words if "_" in word or not word.isascii())
        raise MeshError(f"{place}{wrong[:40]!r} is not {noun}")
    try:
        return [kind(word) for word in words]
    except ValueError as cause:
        raise MeshError(f"{place}{str(cause).rpartition(': ')[2][:40]} is not {noun}") from None


def index_refusal(what: str, index: int, vertices: int) -> MeshError:
    """Say that an index points at no vertex, with the valid range."""
    valid = f"0 to {vertices - 1}" if vertices else "none, as there are no vertices"
    return MeshError(f"{what} has the vertex index {index}; valid is {valid}")


def check_indices(indices: Int[np.ndarray, "..."], vertices: int, what: str) -> None:
    """Refuse an index that points at no vertex.

    Raises:
        MeshError: with the first such index and the valid range.

    """
    wrong = (indices < 0) | (indices >= vertices)
    if wrong.any():
        raise index_refusal(what, int(indices[wrong].reshape(-1)[0]), vertices)


def fans(
    counts: Int[np.ndarray, "polygons"], corners: Int[np.ndarray, "corners"], vertices: Float[np.ndarray, "v 3"]
) -> tuple[Int[np.ndarray, "f 3"], list[str]]:
    """Split polygons into fans of triangles round their first corners.

    Args:
        counts: corners of each polygon.
        corners: vertex indices of all polygons, one after the other.
        vertices: that the indices point at.

    Returns:
        The triangles in the polygons' order, and action lines: how many polygons were split, how many of those are
        concave or not flat, so that the fan is not the polygon alone (of a flat one it covers at least the polygon),
        and how many had fewer than three corners and were left out.

    """
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else np.zeros(0)
    starts = starts.astype(np.int64)
    pieces = np.maximum(counts - 2, 0)
    owner = np.repeat(np.arange(len(counts)), pieces)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    first = starts[owner]
    faces = np.stack([corners[first], corners[first + place + 1], corners[first + place + 2]], axis=1).astype(np.int64)
    actions = left_out({"polygon, of fewer than three corners": int((counts < 3).sum())})
    many = counts > 3
    if many.any():
        line = f"split {counted(int(many.sum()), 'polygon')} of more than three corners"
        actions.append(f"{line} into {int(pieces[many].sum())} triangles")
        bent = _bent(faces, owner, vertices, len(counts))
        if bent:
            actions.append(
                f"{counted(bent, 'split polygon')} concave or not flat: covered by a fan from the first corner"
            )
    return faces, actions


def _bent(
    faces: Int[np.ndarray, "f 3"], owner: Int[np.ndarray, "f"], vertices: Float[np.ndarray, "v 3"], polygons: int
) -> int:
    """Count polygons whose fan triangles do not all face along the polygon's normal, to a thousandth."""
    with np.errstate(invalid="ignore", over="ignore"):
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        normal = np.cross(b - a, c - a)
        whole = np.zeros((polygons, 3))
        np.add.at(whole, owner, normal)
        along = (normal * whole[owner]).sum(axis=1)
        lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(whole[owner], axis=1)
        return len(np.unique(owner[along < (1.0 - 1e-3) * lengths]))


def strip_triangles(strip: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "f 3"], int]:
    """Triangles (i, i + 1, i + 2), every other one turned round so that all face the same way.

    Returns:
        The triangles, without those that repeat a corner: such joints between strips are not drawn; and their number.

    """
    faces = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    faces[1::2] = faces[1::2, ::-1]
    return _without_joints(faces)


def fan_triangles(fan: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "f 3"], int]:
    """Triangles (0, i + 1, i + 2) of a fan, without those that repeat a corner; and their number."""
    return _without_joints(np.stack([np.repeat(fan[:1], max(len(fan) - 2, 0)), fan[1:-1], fan[2:]], axis=1))


def _without_joints(faces: Int[np.ndarray, "f 3"]) -> tuple[Int[np.ndarray, "kept 3"], int]:
    joint = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return np.ascontiguousarray(faces[~joint]), int(joint.sum())
