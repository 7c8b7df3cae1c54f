"""What a reader hands on, and the checks that all readers share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from keepout.errors import MeshError

UNENDED = "the last line has no line end, as in a file that was cut short: its last number may be incomplete"


@dataclass(frozen=True, eq=False)
class MeshContents:
    """A file's triangles, or its points where it has no triangles, in file units and file axes."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    """Empty where the file holds points only."""
    actions: tuple[str, ...] = ()
    """What was left out or interpreted, one line each."""
    unit: str | None = None
    """The length unit that the file declares, in the file's own word."""
    broken: tuple[str, ...] = ()
    """Of the skin of a map: what makes it one that nothing is promised of."""


def counted(number: int, noun: str) -> str:
    """Say how many: "1 face", "2 faces"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def left_out(number: int, noun: str) -> list[str]:
    """One action line if anything of this kind was left out, none otherwise; a comma may end the noun."""
    head, comma, tail = noun.partition(",")
    return [f"left out {counted(number, head)}{comma}{tail}"] if number else []


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
    actions = left_out(int((counts < 3).sum()), "polygon, of fewer than three corners")
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
