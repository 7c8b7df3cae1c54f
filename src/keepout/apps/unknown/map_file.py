"""Map files, `.keepmap`: settings, which cubes are free (a bit each), returns, views taken, and what was broken then.

A file reads back bit for bit or is refused. Distances are not kept: they follow from the cubes. A map that was read
goes on seeing and becomes the same map as one that was never written.
"""

import dataclasses
import json
import math
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from keepout.apps.unknown.known_free import LATTICE, KnownFreeMap, Seen
from keepout.apps.unknown.view import SensorBounds
from keepout.core.errors import MapError
from keepout.core.kept import digest
from keepout.core.whole_file import write_whole

FORMAT = "keepout-map"
VERSION = 2
UNTOLD = "its file is of version 1, which keeps no word of what was broken when it was made"
"""Said of a map from such a file: what is not known to have been kept counts as broken."""
SUFFIX = ".keepmap"
_SETTINGS = ("name", "centre", "radius", "spacing", "cap", "bounds", "speed_limit")
_TENSORS = {"free": "U8", "returns": "I64", "times": "F64", "positions": "F64", "axes": "F64"}
"""Arrays of a file and their number types, as safetensors names them."""


def settings(known: KnownFreeMap) -> dict[str, Any]:
    """Give all that a map was begun with, as JSON holds it: name, ball, spacing, cap, sensor bounds, speed limit."""
    told = {name: getattr(known, name) for name in _SETTINGS}
    told |= {"centre": known.centre.tolist(), "bounds": dataclasses.asdict(known.bounds)}
    return told | {"speed_limit": known.speed_limit if math.isfinite(known.speed_limit) else None}


def fingerprint(known: KnownFreeMap) -> str:
    """Give the SHA-256, in hex, of a map's settings: maps of one fingerprint free the same cubes of the same views."""
    return digest(json.dumps(settings(known), sort_keys=True))


def save(known: KnownFreeMap, path: str | Path) -> Path:
    """Write a map as a `.keepmap` file, whole or not at all.

    Raises:
        MapError: another ending, or a place that cannot be written to.

    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise MapError(f"{path}: a map file ends in {SUFFIX}")
    tensors = {
        "free": np.packbits(known.free.reshape(-1)),
        "returns": known.returned.keys,
        "times": np.array([seen.time for seen in known.seen], dtype=np.float64),
        "positions": np.array([seen.position for seen in known.seen], dtype=np.float64).reshape(-1, 3),
        "axes": np.array([seen.axes for seen in known.seen], dtype=np.float64).reshape(-1, 3, 3),
    }
    told = {"broken": list(known.broken), "contradicting": known.contradicting}
    header = json.dumps({"version": VERSION, "fingerprint": fingerprint(known), "settings": settings(known), **told})
    # One entry: safetensors keeps entries in no order, and the same map is to be the same file.
    envelope = json.dumps({"sha256": _digest(header, tensors), "header": header})
    write_whole(path, safetensors.numpy.save(tensors, {FORMAT: envelope}), refusal=MapError)
    return path


def load(path: str | Path, *, name: str | None = None, spacing: float | None = None) -> KnownFreeMap:
    """Read a `.keepmap` file.

    Args:
        path: of the file.
        name: of the target that it must be a map of; any if absent.
        spacing: edge of a cube that it must have, m; any if absent.

    Raises:
        MapError: missing, damaged, truncated, edited, not a map file, or a map of another name or spacing.

    """
    path = Path(path)
    header, tensors = _read(path)
    try:
        known = _put_together(header, tensors)
    except MapError as refusal:
        raise MapError(f"{path}: {refusal}") from None
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise MapError(f"{path}: an entry is missing or misused ({error!r}); make the map again") from None
    if name is not None and known.name != name:
        raise MapError(f"{path}: a map of {known.name!r}; a map of {name!r} is needed here")
    if spacing is not None and abs(known.spacing - spacing) > 1e-9 * spacing:
        raise MapError(f"{path}: a map with spacing = {known.spacing} m; {spacing} m is needed here")
    return known


def _digest(header: str, tensors: dict[str, np.ndarray]) -> str:
    named = ((f"{name} {tensors[name].dtype.str} {tensors[name].shape}", tensors[name]) for name in sorted(tensors))
    return digest(header, *chain.from_iterable(named))


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if FORMAT not in metadata:
                raise MapError(f"{path}: not a map file: no entry {FORMAT!r} in its header")
            stored = {name: file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118
            if stored != _TENSORS:
                raise MapError(f"{path}: holds {sorted(stored)}; a map file holds {sorted(_TENSORS)}")
            tensors = {name: file.get_tensor(name) for name in stored}
        envelope = json.loads(metadata[FORMAT])
        text, checksum = envelope["header"], envelope["sha256"]
        header = json.loads(text)
    except FileNotFoundError:
        raise MapError(f"{path}: no such file; a map is a {SUFFIX} file") from None
    except MapError:
        raise
    except (OSError, safetensors.SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        why = " ".join(str(error).split())[:160]
        raise MapError(f"{path}: damaged, truncated, or not a map file ({why})") from None
    version = header.get("version") if isinstance(header, dict) else None
    if version not in (1, VERSION):
        raise MapError(f"{path}: map format version {version}; this release reads versions 1 and {VERSION}")
    if _digest(text, tensors) != checksum:
        raise MapError(f"{path}: its contents do not match its checksum: edited or damaged")
    return header, tensors


def _put_together(header: dict[str, Any], tensors: dict[str, np.ndarray]) -> KnownFreeMap:
    given = {name: header["settings"][name] for name in _SETTINGS}
    given["bounds"] = SensorBounds(**given["bounds"])
    given["speed_limit"] = math.inf if given["speed_limit"] is None else given["speed_limit"]
    known = KnownFreeMap(**given)
    if fingerprint(known) != header["fingerprint"]:
        raise MapError("its settings do not match its fingerprint; make the map again")
    told = {"broken": [UNTOLD], "contradicting": 0} if header["version"] == 1 else header
    lines, count = told["broken"], told["contradicting"]
    if not (type(lines) is list and all(type(line) is str for line in lines) and type(count) is int and count >= 0):
        raise MapError("what was broken when it was made is no list of lines and a count")
    known.broken, known.contradicting = tuple(lines), count
    cubes = known.free.size
    if tensors["free"].shape != (-(-cubes // 8),):
        raise MapError(f"free holds {tensors['free'].size} bytes; {cubes} cubes need {-(-cubes // 8)}")
    free = np.unpackbits(tensors["free"], count=cubes).view(np.bool_).reshape(known.free.shape)
    if not free[known.free_outside_the_ball()].all():
        raise MapError("a cube outside the declared ball is not free; make the map again")
    known.fill(free)
    keys = tensors["returns"]
    if keys.ndim != 1 or (len(keys) and (keys[0] < 0 or keys[-1] >= (len(free) * LATTICE) ** 3)):
        raise MapError(f"returns of shape {keys.shape} do not lie in the map's box")
    if (np.diff(keys) <= 0).any():
        raise MapError("returns are not in rising order")
    known.returned.keys = keys
    views = len(tensors["times"])
    if tensors["positions"].shape != (views, 3) or tensors["axes"].shape != (views, 3, 3):
        raise MapError(
            f"{views} times of views, and {len(tensors['positions'])} positions, {len(tensors['axes'])} axes"
        )
    if not all(np.isfinite(tensors[name]).all() for name in ("times", "positions", "axes")):
        raise MapError("the pose or time of a view is not finite")
    known.seen = [
        Seen(float(time), position, axes)
        for time, position, axes in zip(tensors["times"], tensors["positions"], tensors["axes"], strict=True)
    ]
    return known
