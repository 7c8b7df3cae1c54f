"""A spline field packed for a flight computer: no halos, details in one or two bytes, blocks found by a tree.

A block of `GridField` stores 11³ numbers, of which its neighbours store all but 8³ as well. Here each block stores its
8³ alone, as how much they differ from what they inherit of the coarser spline, in whole numbers of a unit of its own.
What is lost is at most half a unit; `packed` gives the field of the numbers that are left, so that Python flies the
very one that the C code has, and by how much its values may differ. The C code undoes it in the same order of sums
(`sources/keepout_spline.c`).
"""

import dataclasses
import itertools
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from keepout.core.errors import ExchangeError
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.grid import BLOCK, STORED, GridField

NONE = 0xFFFF
"""Instead of a number of a block or brick: there is none."""
_OWN = slice(1, 1 + BLOCK)
"""Of the 11 nodes along a block's edge those that are its own."""


class Level(NamedTuple):
    """One level's blocks, for the C code.

    Attributes:
        children: of each block of the next coarser level, eight numbers of this level's.
        scale: of each block, m a unit.
        detail: of each block, whole units.

    """

    children: Int[np.ndarray, "above 8"]
    scale: Float32[np.ndarray, "blocks"]
    detail: Int[np.ndarray, "blocks 512"]


class SplineTables(NamedTuple):
    """A spline for the C code.

    Attributes:
        shape: blocks of the coarsest level along each axis.
        brick: number of each brick of the coarsest level's nodes, or `NONE`.
        base: of each brick, m.
        scale: of each brick, m a unit.
        values: of each brick, whole units.
        levels: the finer levels, finest first.
        origin: lower corner of the grid, m.
        spacing: of the finest level, m.
        continuation: beyond the domain.

    """

    shape: tuple[int, ...]
    brick: Int[np.ndarray, "nx ny nz"]
    base: Float32[np.ndarray, "bricks"]
    scale: Float32[np.ndarray, "bricks"]
    values: Int[np.ndarray, "bricks 512"]
    levels: tuple[Level, ...]
    origin: Float[np.ndarray, "3"]
    spacing: float
    continuation: RadialContinuation

    @property
    def parts(self) -> list[bytes]:
        """The image's parts, in the order in which `keepout_open` takes them."""
        parts = [self.brick.astype("<u2"), self.base.astype("<f4"), self.scale.astype("<f4"), self.values.astype("<i2")]
        for number, level in reversed(list(enumerate(self.levels))):
            detail = level.detail.astype("<i2" if number else "i1")
            parts += [level.children.astype("<u2"), level.scale.astype("<f4"), detail]
        return [part.tobytes() for part in parts]


def packed(field: GridField) -> tuple[SplineTables, GridField, float]:
    """Pack a field: its tables, the field that they hold, and the largest difference of a value, m.

    The B-spline's weights are not negative and their sum is 1, so that no value differs by more than a coefficient.

    Raises:
        ExchangeError: a tree of more blocks, or of others, than the format has room for.

    """
    tables = [np.asarray(table) for table in field.tables]
    before = np.asarray(field.coefficients).reshape(-1, STORED, STORED, STORED)
    after = before.copy()
    _require_tree(tables)
    top = tables[-1]
    needed = _asked(field, top.shape)
    coarsest, error = _coarsest(before, top, needed)
    brick, base, scale, values, whole = coarsest
    for place in np.ndindex(*top.shape):
        corner = tuple(slice(BLOCK * i, BLOCK * i + STORED) for i in place)
        after[top[place]] = whole[corner]
    levels: list[Level] = []
    for number in range(len(tables) - 2, -1, -1):
        level, most = _level(before, after, tables[number], tables[number + 1], 127 if number == 0 else 32767)
        levels.insert(0, level)
        error = max(error, most)
    made = SplineTables(
        shape=top.shape,
        brick=brick,
        base=base,
        scale=scale,
        values=values,
        levels=tuple(levels),
        origin=np.asarray(field.origin),
        spacing=float(field.spacing),
        continuation=field.continuation,
    )
    held = dataclasses.replace(field, coefficients=jax.device_put(after.reshape(-1)))
    return made, held, error


def _require_tree(tables: list[np.ndarray]) -> None:
    for finer, coarser in itertools.pairwise(tables):
        places = np.argwhere(finer >= 0)
        if np.any(coarser[tuple((places // 2).T)] < 0) or tuple(finer.shape) != tuple(2 * n for n in coarser.shape):
            raise ExchangeError("flight code: the guard's field has blocks that lie in no coarser one; they must")
    most = max(int((table >= 0).sum()) for table in tables)
    if most >= NONE or np.any(tables[-1] < 0):
        raise ExchangeError(f"flight code: a level of the guard's field has {most} blocks; at most {NONE - 1} fit")


def _asked(field: GridField, shape: tuple[int, ...]) -> Bool[np.ndarray, "nx ny nz"]:
    """Which nodes of the coarsest level (from -1 on) any value can ask for: those of cells that reach into the ball."""
    cont = field.continuation
    step = float(field.spacing) * 2 ** (len(field.tables) - 1)
    radius = 0.5 * float(cont.domain_radius + cont.outer_radius) + 1e-6
    squares = []
    for axis, count in enumerate(shape):
        low = float(field.origin[axis]) + step * np.arange(BLOCK * count) - float(cont.centre[axis])
        squares.append(np.maximum(np.maximum(low, -(low + step)), 0.0) ** 2)
    near = squares[0][:, None, None] + squares[1][:, None] + squares[2] <= radius**2
    nodes = np.zeros(tuple(BLOCK * count + 3 for count in shape), bool)
    for shift in np.ndindex(4, 4, 4):
        nodes[tuple(slice(s, s + n) for s, n in zip(shift, near.shape, strict=True))] |= near
    return nodes


def _coarsest(
    before: Float32[np.ndarray, "blocks 11 11 11"],
    table: Int[np.ndarray, "a b c"],
    needed: Bool[np.ndarray, "nx ny nz"],
) -> tuple[tuple[np.ndarray, ...], float]:
    """Give bricks of the coarsest level's nodes: numbers, bases, scales, values; its coefficients; the error, m."""
    nodes = np.zeros(needed.shape, np.float32)
    for place in np.ndindex(*table.shape):
        nodes[tuple(slice(BLOCK * i, BLOCK * i + STORED) for i in place)] = before[table[place]]
    room = [-(-n // BLOCK) for n in needed.shape]
    brick = np.full(room, NONE)
    held, bases, scales, values, count, error = nodes.copy(), [], [], [], 0, 0.0
    for place in np.ndindex(*room):
        corner = tuple(slice(BLOCK * i, min(BLOCK * (i + 1), n)) for i, n in zip(place, needed.shape, strict=True))
        asked = needed[corner]
        if not asked.any():
            continue
        brick[place] = count
        count += 1
        told = nodes[corner].astype(np.float64)
        low, high = told[asked].min(), told[asked].max()
        base, scale = np.float32(0.5 * (low + high)), np.float32((high - low) / 65530.0)
        units = np.zeros(told.shape)
        if scale > 0.0:
            units[asked] = np.clip(np.rint((told[asked] - np.float64(base)) / np.float64(scale)), -32768, 32767)
        now = (np.float64(base) + np.float64(scale) * units).astype(np.float32)
        error = max(error, float(np.abs(now.astype(np.float64) - told)[asked].max()))
        held[corner] = now
        whole = np.zeros((BLOCK, BLOCK, BLOCK), np.int64)
        whole[tuple(slice(0, n) for n in told.shape)] = units
        bases.append(base)
        scales.append(scale)
        values.append(whole.reshape(-1))
    return (brick, np.array(bases), np.array(scales), np.array(values), held), error


def _level(
    before: Float32[np.ndarray, "blocks 11 11 11"],
    after: Float32[np.ndarray, "blocks 11 11 11"],
    table: Int[np.ndarray, "a b c"],
    above: Int[np.ndarray, "d e f"],
    most: int,
) -> tuple[Level, float]:
    """Pack one level, whose coarser one is in `after` already; put it there too. The error is the largest, m."""
    places = np.argwhere(table >= 0)
    numbers = table[tuple(places.T)]
    inherited = inherited_in_order(after[above[tuple((places // 2).T)]], places)
    own = (slice(None), _OWN, _OWN, _OWN)
    wanted = before[numbers].astype(np.float64)[own] - inherited[own]
    scale = (np.abs(wanted).reshape(len(places), -1).max(axis=1) / most).astype(np.float32)
    unit = scale.astype(np.float64)[:, None, None, None]
    detail = np.clip(np.rint(np.divide(wanted, unit, out=np.zeros_like(wanted), where=unit > 0.0)), -most, most)
    now = inherited.copy()
    now[own] += unit * detail
    after[numbers] = now.astype(np.float32)
    _halos(after, table, places)
    local = np.full(table.shape, NONE)
    local[tuple(places.T)] = np.arange(len(places))
    children = np.full((int((above >= 0).sum()), 8), NONE)
    for row, place in enumerate(np.argwhere(above >= 0)):
        x, y, z = 2 * place
        children[row] = local[x : x + 2, y : y + 2, z : z + 2].reshape(-1)
    error = float(np.abs(after[numbers].astype(np.float64) - before[numbers]).max())
    return Level(children, scale, detail.reshape(len(places), -1).astype(np.int64)), error


def _halos(after: np.ndarray, table: Int[np.ndarray, "a b c"], places: Int[np.ndarray, "m 3"]) -> None:
    """Put each neighbour's own numbers into a block's nodes beyond its own."""
    reach = np.pad(table, 1, constant_values=-1)
    beside = {-1: (slice(0, 1), slice(8, 9)), 0: (slice(1, 9), slice(1, 9)), 1: (slice(9, 11), slice(1, 3))}
    own = after.copy()
    numbers = table[tuple(places.T)]
    for shift in np.ndindex(3, 3, 3):
        if shift == (1, 1, 1):
            continue
        other = reach[tuple((places + np.array(shift)).T)]
        there = other >= 0
        to, from_ = zip(*(beside[s - 1] for s in shift), strict=True)
        after[(numbers[there], *to)] = own[(other[there], *from_)]


def inherited_in_order(
    parents: Float32[np.ndarray, "m 11 11 11"], blocks: Int[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 11 11 11"]:
    """Give each block's coefficients as of its parent's spline, summed in the order of the C code: axis by axis."""
    rows = np.arange(len(blocks))
    half = parents.astype(np.float64)
    for axis in range(3):
        first = 4 * (blocks[:, axis] % 2)
        half = np.moveaxis(half, axis + 1, 1)
        finer = np.empty((len(blocks), STORED, *half.shape[2:]))
        for place, node in enumerate(range(-1, BLOCK + 2)):
            k = node // 2
            # Of the parent's nodes -1 on: a node of half the spacing stands on one, or between two.
            at = first + k + 1
            if node % 2 == 0:
                finer[:, place] = (0.125 * half[rows, at - 1] + 0.75 * half[rows, at]) + 0.125 * half[rows, at + 1]
            else:
                finer[:, place] = 0.5 * (half[rows, at] + half[rows, at + 1])
        half = np.moveaxis(finer, 1, axis + 1)
    return half
