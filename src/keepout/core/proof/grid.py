"""The proved bounds of a grid field, from its coefficients, without search: of its error and of its slope.

**Spline.** A block beside a coarser one stores the coarser spline's coefficients there, rounded to float32, so that the
field as stored jumps at a block's face by what was rounded. Leave out the rounding: take f*, on the coarsest level the
spline of the stored coefficients, and on each finer level

    f*_ℓ = f*_{ℓ+1} + Σ_i e_i B_i,     e_i what the stored coefficient adds to the coarser spline's own,

over the nodes i whose B-spline lies in the blocks stored on that level. Every B_i is C², so f* is. In a block, f* is
the spline of coefficients c*, and the weights of a spline are at least 0 and sum to 1; so |f̃ - f*| ≤ max |c - c*|
everywhere.

**Slope**, over all of space: of spline, lowering and continuation.

In a cell the gradient g of the spline is a polynomial of degree 3 along each axis. In Bernstein form its 64 control
vectors G_k have weights that are at least 0 and sum to 1, so g lies in their convex hull, and any convex function of g
is largest at one of them. Cells whose bound is not yet near the largest slope found are cut in eight, which brings the
hull closer to the polynomial with the square of the side.

With ρ_T, ρ_0, ρ_1, ψ, F of `RadialContinuation`, q the point asked, r its distance from the centre, u = q/r:

- up to ρ_0 the gradient is g - v, v = λ(r) u the lowering's. v changes by at most max(|λ'|, λ/r) a metre;
- beyond it the tangential part is (ψ/r) g_t, and the radial one ψ' (g_r - F'(ψ)) + F'(r); each of ψ/r, ψ', F' is
  monotone in r. Beyond ρ_1, where ψ' = 0, the slope's square is linear in 1/r², so largest at ρ_1 or 1 at the far end.
"""

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from keepout.core.errors import FieldError
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.field import values
from keepout.core.fields.grid import BLOCK, NODES, STORED, GridField, inherited_coefficients, own_nodes
from keepout.core.fields.model import FieldModel
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.level_set import level_points
from keepout.core.geometry.octree import CORNERS, straddling_cells
from keepout.core.geometry.target import Target

_WINDOW = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
ROUNDING = 1e-9
"""Metres. Float64 evaluation of 64 products of coefficients below 1e4 m is far more exact than this."""
GAP = 0.01
"""Cells are cut until each bound is at most this share above the largest slope found."""
LEAST = 1.05
"""No sharper bound than this is looked for: the slope of a distance is 1 almost everywhere."""
MOST_CELLS = 2_000_000
"""Cutting also stops after so many parts; the largest bound left is then looser, and still one."""
_PIECE = 16_384
_RADII = 4097
"""Radii from ρ_0 to ρ_1 between which ψ, ψ' and F' are taken at their extremes."""
_OUTWARD = 1e-9

_TO_BERNSTEIN = np.array([[1, 4, 1, 0], [0, 4, 2, 0], [0, 2, 4, 0], [0, 1, 4, 1]]) / 6.0
_SLOPE = np.array([[-3, 0, 3, 0], [-1, -4, 5, 0], [0, -5, 4, 1], [0, -3, 0, 3]]) / 6.0
"""From four coefficients to the Bernstein form of the spline, and of its derivative raised to degree 3."""
_MIDDLE, _MIDDLE_SLOPE = np.array([[1, 23, 23, 1]]) / 48.0, np.array([[-1, -5, 5, 1]]) / 8.0
"""From four coefficients to value and derivative in the middle of the cell."""
_HALVES = np.array([[4, 4, 0, 0], [1, 6, 1, 0], [0, 4, 4, 0], [0, 1, 6, 1], [0, 0, 4, 4]]) / 8.0
"""From four coefficients to the five of half the spacing: the first four are the lower half's, the last the upper's."""


def _along(axis: int, one: np.ndarray, others: np.ndarray) -> Float[np.ndarray, "k 64"]:
    x, y, z = (one if axis == k else others for k in range(3))
    return np.kron(x, np.kron(y, z))


_CONTROL = np.concatenate([_along(axis, _SLOPE, _TO_BERNSTEIN) for axis in range(3)])
_GRADIENT = np.concatenate([_along(axis, _MIDDLE_SLOPE, _MIDDLE) for axis in range(3)])
_CHILDREN = np.concatenate(
    [np.kron(x, np.kron(y, z)) for x, y, z in ([_HALVES[k : k + 4] for k in (c > 0).astype(int)] for c in CORNERS)]
)


def certify_grid(model: FieldModel, target: Target, *, chaser_radius: float = 0.0, seed: int = 0) -> FieldModel:
    """Prove an error bound and a gradient bound of a grid field.

    The weights w_i of the 64 coefficients at p sum to 1, have mean p and variance h²/3 an axis. Let n be the target's
    point nearest to p: d(x_i) ≤ ‖x_i - n‖, and Σ w_i ‖x_i - n‖ ≤ √(Σ w_i ‖x_i - n‖²) = √(‖p - n‖² + h²). So where
    c_i ≤ d(x_i) + ε on p's cell, f̃(p) ≤ √(d(p)² + h²) + ε; every cell that can meet {d = R} counts. For nodes that
    hold the signed distance, ε = -δ. Lowering only lowers f̃. The gradient bound is that of a function within
    `evaluation_error` of f̃, everywhere (`joined_spline`, `grid_slope`).

    Raises:
        FieldError: not a grid field, another target's, blocks that do not nest or leave out part of the
            domain, or a radius too large for it.

    """
    start = time.perf_counter()
    field, distance = model.field, target.distance
    if not isinstance(field, GridField) or not isinstance(distance, ExactDistance):
        raise FieldError("certify_grid: needs a grid field of a mesh; `certify` is for neural fields")
    model.require_target(target, where="certify_grid")
    room = float(field.continuation.domain_radius - field.continuation.target_radius)
    if not 0.0 <= chaser_radius < room:
        raise FieldError(f"chaser radius {chaser_radius:g} m: for this field it must be 0 to {room:.3g} m")
    _require_cover(field)
    bound = _largest_excess(field, distance, float(chaser_radius))
    spline = joined_spline(field)
    slope = grid_slope(field, spline)
    points = level_points(distance, chaser_radius, 100_000, np.random.default_rng(seed))
    sampled = float(values(field, points).max()) - chaser_radius
    return model.certified(
        "certified",
        chaser_radius,
        start,
        error_bound=bound + ROUNDING,
        allowance=0.0,
        sampled_maximum=sampled,
        gradient_bound=slope.proved,
        gradient_kind="certified",
        evaluation_error=spline.difference + ROUNDING,
        gradient_found=slope.found,
    )


def _require_cover(field: GridField) -> None:
    """Refuse a grid that does not hold the ball from which the continuation asks."""
    c = field.continuation
    reach = 0.5 * float(c.domain_radius + c.outer_radius)
    sides = BLOCK * float(field.spacing) * 2.0 ** (len(field.tables) - 1) * np.array(field.tables[-1].shape)
    low = np.asarray(field.origin) - (np.asarray(c.centre) - reach)
    if (low > 0.0).any() or (low + sides < 2.0 * reach).any():
        raise FieldError(
            f"grid field: its grid of {sides.tolist()} m from {np.asarray(field.origin).tolist()} does not hold the "
            f"ball of {reach:g} m in which it is asked"
        )


def _largest_excess(field: GridField, distance: ExactDistance, radius: float) -> float:
    """Largest √(R² + h²) - R + max (c_i - d(x_i)) over the cells that {d = R} can touch."""
    number, level, node = _touched(field, *straddling_cells(distance, radius, leaf=float(field.spacing)))
    coefficients = np.asarray(field.coefficients).reshape(-1, STORED, STORED, STORED)
    origin, worst = np.asarray(field.origin), -np.inf
    for one in np.unique(level):
        h = float(field.spacing) * 2.0 ** float(one)
        numbers, nodes = number[level == one], node[level == one]
        # Each node is shared by up to 64 cells, and its distance is asked once.
        lowest, extent = nodes.min(axis=0), np.ptp(nodes, axis=0) + 4
        window, corner = (
            np.asarray(np.ravel_multi_index(tuple(of.T), tuple(extent))) for of in (_WINDOW, nodes - lowest)
        )
        asked = corner
        for stride in (1, extent[2], extent[1] * extent[2]):
            asked = _distinct(np.concatenate([asked + stride * step for step in range(4)]))
        there = np.stack(np.unravel_index(asked, tuple(extent)), axis=-1) + lowest
        d = distance.distance(origin + h * (there - 1))
        for first in range(0, len(numbers), 4096):
            part = slice(first, first + 4096)
            at = (nodes[part] % BLOCK)[:, None, :] + _WINDOW
            c = coefficients[numbers[part, None], at[..., 0], at[..., 1], at[..., 2]].astype(np.float64)
            own = d[np.searchsorted(asked, corner[part, None] + window)]
            worst = max(worst, float((np.hypot(radius, h) - radius + (c - own).max(axis=1)).max()))
    return worst


def _touched(
    field: GridField, centres: Float[np.ndarray, "n 3"], half: Float[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"], Int[np.ndarray, "m 3"]]:
    """Block number, level and lower node of every cell, of those that the field is made of, that a cube touches.

    Each cube is made a little wider, so that a cell that it only shares a face with counts.
    """
    reach = (half * (1.0 + 1e-9) + 1e-9)[:, None]
    lower, upper = ((centres + side * reach - np.asarray(field.origin)) / float(field.spacing) for side in (-1, 1))
    cells = []
    for level, table in enumerate(map(np.asarray, field.tables)):
        found = []
        last = BLOCK * np.array(table.shape) - 1
        low = np.clip(np.floor(lower / 2**level).astype(np.int64), 0, last)
        high = np.clip(np.floor(upper / 2**level).astype(np.int64), 0, last)
        widest = int((high - low).max(initial=0)) + 1
        for step in np.stack(np.meshgrid(*[np.arange(widest)] * 3, indexing="ij"), axis=-1).reshape(-1, 3):
            node = low + step
            node = node[(node <= high).all(axis=1)]
            used = table[tuple((node // BLOCK).T)] >= 0
            if level > 0:
                # Where a finer block lies, the field is that block's spline.
                used &= np.asarray(field.tables[level - 1])[tuple((2 * node // BLOCK).T)] < 0
            found.append(_distinct(np.asarray(np.ravel_multi_index(tuple(node[used].T), tuple(last + 1)))))
        node = np.stack(np.unravel_index(_distinct(np.concatenate(found)), tuple(last + 1)), axis=-1)
        cells.append((table[tuple((node // BLOCK).T)], np.full(len(node), level), node))
    number, level, node = (np.concatenate(column) for column in zip(*cells))
    return number, level, node


def _distinct(codes: Int[np.ndarray, "n"]) -> Int[np.ndarray, "m"]:
    """Sort whole numbers and leave each once: several times faster than NumPy's `unique`, which hashes them."""
    ordered = np.sort(codes)
    return ordered[np.concatenate([[True], ordered[1:] != ordered[:-1]])] if len(codes) else ordered


class JoinedSpline(NamedTuple):
    """f*, block by block.

    Attributes:
        coefficients: c*, metres.
        spacing: of each block's level, metres.
        block: each block's place in the grid of blocks of its level.
        used: by octant, whether no finer block lies there, so that the field is this block's spline.
        difference: max |c - c*|, metres.
        corner: lowest one of the grid, from the continuation's centre, metres.

    """

    coefficients: Float[np.ndarray, "blocks 11 11 11"]
    spacing: Float[np.ndarray, "blocks"]
    block: Int[np.ndarray, "blocks 3"]
    used: Bool[np.ndarray, "blocks 2 2 2"]
    difference: float
    corner: Float[np.ndarray, "3"]

    def middles(self, number: Int[np.ndarray, "m"], place: Int[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
        """Middles of the cells at some places of some blocks, from the continuation's centre, metres."""
        return self.corner + self.spacing[number, None] * (BLOCK * self.block[number] + place + 0.5)

    def cells(self, number: Int[np.ndarray, "m"], place: Int[np.ndarray, "m 3"]) -> "_Cells":
        """Give the same cells."""
        x, y, z = (place[:, axis, None] + np.arange(4) for axis in range(3))
        block = number[:, None, None, None]
        c = self.coefficients[block, x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]].reshape(-1, 64)
        return _Cells(c - c[:, :1], self.middles(number, place), self.spacing[number])


def joined_spline(field: GridField) -> JoinedSpline:
    """Return the C² spline f* of a grid field.

    Raises:
        FieldError: its coarsest level has holes, or a block lies outside the next coarser level's.

    """
    stored = np.asarray(field.coefficients, np.float64).reshape(-1, STORED, STORED, STORED)
    joined = stored.copy()
    spacing, block = np.zeros(len(stored)), np.zeros((len(stored), 3), np.int64)
    used = np.ones((len(stored), 2, 2, 2), bool)
    tables = [np.asarray(table) for table in field.tables]
    if (tables[-1] < 0).any():
        raise FieldError("grid field: its coarsest level has holes; every block of that level must be stored")
    for level in range(len(tables) - 1, -1, -1):
        table = tables[level]
        blocks = np.argwhere(table >= 0)
        numbers = table[tuple(blocks.T)]
        spacing[numbers], block[numbers] = float(field.spacing) * 2**level, blocks
        if level < len(tables) - 1:
            parents = tables[level + 1][tuple((blocks // 2).T)]
            if (parents < 0).any():
                raise FieldError(f"grid field: a block of level {level} lies outside the blocks of level {level + 1}")
            used[(parents, *(blocks % 2).T)] = False
            joined[numbers] = np.where(
                own_nodes(table, blocks), stored[numbers], inherited_coefficients(joined[parents], blocks)
            )
        joined[numbers] = _one_value_a_node(joined[numbers], blocks)
    corner = np.asarray(field.origin) - np.asarray(field.continuation.centre)
    return JoinedSpline(joined, spacing, block, used, float(np.abs(joined - stored).max()), corner)


def _one_value_a_node(
    coefficients: Float[np.ndarray, "m 11 11 11"], blocks: Int[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 11 11 11"]:
    """Give a node that several blocks share the value that the first of them has."""
    extent = BLOCK * (int(blocks.max(initial=0)) + 1) + STORED
    x, y, z = (BLOCK * blocks[:, axis, None] + NODES + 1 for axis in range(3))
    code = (x[:, :, None, None] * extent + y[:, None, :, None]) * extent + z[:, None, None, :]
    _, first, back = np.unique(code.reshape(-1), return_index=True, return_inverse=True)
    return coefficients.reshape(-1)[first][back].reshape(coefficients.shape)


class Slope(NamedTuple):
    """The largest ‖∇f‖ met on the way, and a proved bound of it."""

    found: float
    proved: float


class _Cells(NamedTuple):
    """Cells of the spline.

    Attributes:
        coefficients: less the first of each cell's, metres: a gradient does not know constants.
        middle: from the continuation's centre, metres.
        side: metres.

    """

    coefficients: Float[np.ndarray, "m 64"]
    middle: Float[np.ndarray, "m 3"]
    side: Float[np.ndarray, "m"]

    def at(self, chosen: Bool[np.ndarray, "m"] | slice) -> "_Cells":
        return _Cells(self.coefficients[chosen], self.middle[chosen], self.side[chosen])

    def cut(self) -> "_Cells":
        children = (self.coefficients @ _CHILDREN.T).reshape(-1, 64)
        middle = (self.middle[:, None, :] + 0.25 * self.side[:, None, None] * CORNERS).reshape(-1, 3)
        return _Cells(children, middle, np.repeat(0.5 * self.side, 8))


def grid_slope(field: GridField, spline: JoinedSpline) -> Slope:
    """Bound ‖∇f‖ over all of space, f the field with the C² spline f* in place of the stored blocks."""
    zones = _Zones.of(field.continuation)
    rough, number, place = _rough_bounds(spline, zones)
    # Far away the continuation's slope tends to 1.
    found = largest = 1.0
    parts, open_ = 0, []

    def settle(bound: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
        """Note the bounds that are near enough to the largest slope found; return which are not."""
        nonlocal largest
        kept = (bound > max((1.0 + GAP) * found, LEAST)) & (parts <= MOST_CELLS)
        largest = max(largest, float(bound[~kept].max(initial=0.0)))
        return kept

    def look(cells: _Cells) -> None:
        nonlocal found
        bound, middle = zones.slopes(cells)
        found = max(found, float(middle.max()))
        kept = settle(bound)
        if kept.any():
            open_.append((cells.at(kept), bound[kept]))

    order = np.argsort(-rough)
    for first in range(0, len(order), _PIECE):
        chosen = order[first : first + _PIECE]
        chosen = chosen[settle(rough[chosen])]
        if len(chosen):
            look(spline.cells(number[chosen], place[chosen]))
    while open_:
        # The steepest first, so that cells run out only where they are small.
        cells, bound = open_.pop(int(np.argmax([bound.max() for _, bound in open_])))
        cells = cells.at(settle(bound))
        for first in range(0, len(cells.side), _PIECE // 8):
            pieces = cells.at(slice(first, first + _PIECE // 8)).cut()
            parts += len(pieces.side)
            look(pieces)
    return Slope(found, largest * (1.0 + _OUTWARD) + _OUTWARD)


def _rough_bounds(
    spline: JoinedSpline, zones: "_Zones"
) -> tuple[Float[np.ndarray, "m"], Int[np.ndarray, "m"], Int[np.ndarray, "m 3"]]:
    """Bound the slope in each cell that is asked, by its largest coefficient differences; block and place of each.

    Infinite where lowering or continuation add to the spline's own.
    """
    rough, number, place = [], [], []
    steps = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for first in range(0, len(spline.spacing), 512):
        part = slice(first, first + 512)
        h = spline.spacing[part]
        bound = slopes_by_differences(spline.coefficients[part], h).reshape(len(h), -1)
        used = spline.used[part].repeat(BLOCK // 2, 1).repeat(BLOCK // 2, 2).repeat(BLOCK // 2, 3).reshape(len(h), -1)
        block, cell = np.nonzero(used)
        nearest, farthest = _radii(spline.middles(first + block, steps[cell]), h[block])
        asked = nearest <= zones.last
        block, cell, farthest = block[asked], cell[asked], farthest[asked]
        rough.append(np.where(farthest > zones.target, np.inf, bound[block, cell]))
        number.append(first + block)
        place.append(steps[cell])
    return np.concatenate(rough), np.concatenate(number), np.concatenate(place)


def slopes_by_differences(
    c: Float[np.ndarray, "m 11 11 11"], spacing: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "m 8 8 8"]:
    """Bound the spline's own slope in each cell: a derivative is a mean of the coefficient differences about the cell.

    Quick, looser, and without lowering and continuation. The coefficients are a `JoinedSpline`'s, m; so is the spacing.
    """
    total = np.zeros(1)
    for axis in (1, 2, 3):
        difference = np.abs(np.diff(c, axis=axis))
        for along in (1, 2, 3):
            size = 3 if along == axis else 4
            parts = [np.take(difference, np.arange(k, k + BLOCK), axis=along) for k in range(size)]
            difference = np.maximum.reduce(parts)
        total = total + (difference / spacing[:, None, None, None]) ** 2
    return np.sqrt(total)


def _radii(
    middle: Float[np.ndarray, "m 3"], side: Float[np.ndarray, "m"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Least and largest distance of each cell from the origin, made a little wider."""
    away, half = np.abs(middle), 0.5 * side[:, None]
    nearest = np.linalg.norm(np.maximum(away - half, 0.0), axis=1)
    return nearest * (1.0 - _OUTWARD) - _OUTWARD, np.linalg.norm(away + half, axis=1) * (1.0 + _OUTWARD) + _OUTWARD


class _Zones(NamedTuple):
    """Lowering and continuation by radius, for bounds over cells.

    Attributes:
        target, domain, outer, last: ρ_T, ρ_0, ρ_1 and (ρ_0 + ρ_1)/2, metres.
        allowance: metres.
        radii, psi, psi_slope, rise: r from ρ_0 to ρ_1, and ψ, ψ' and F' there.

    """

    target: float
    domain: float
    outer: float
    last: float
    allowance: float
    radii: Float[np.ndarray, "k"]
    psi: Float[np.ndarray, "k"]
    psi_slope: Float[np.ndarray, "k"]
    rise: Float[np.ndarray, "k"]

    @classmethod
    def of(cls, continuation: RadialContinuation) -> "_Zones":
        target, domain, outer = (
            float(getattr(continuation, name)) for name in ("target_radius", "domain_radius", "outer_radius")
        )
        width, t = outer - domain, np.linspace(0.0, 1.0, _RADII)
        radii = domain + width * t
        psi = domain + width * (t - t**3 + 0.5 * t**4)
        rise = np.sqrt(1.0 - (target / radii) ** 2)
        numbers = (target, domain, outer, 0.5 * (domain + outer), float(continuation.allowance))
        return cls(*numbers, radii, psi, 1.0 - t * t * (3.0 - 2.0 * t), rise)

    def slopes(self, cells: _Cells) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Bound ‖∇f‖ wherever a cell is asked from, and give ‖∇f‖ at one such place."""
        m = len(cells.side)
        control = (cells.coefficients @ _CONTROL.T).reshape(m, 3, 64) / cells.side[:, None, None]
        middle = (cells.coefficients @ _GRADIENT.T).reshape(m, 3, 1) / cells.side[:, None, None]
        nearest, farthest = _radii(cells.middle, cells.side)
        bound, found = np.zeros(m), np.zeros(m)
        spline = farthest <= self.target
        bound[spline] = np.linalg.norm(control[spline], axis=1).max(axis=1)
        found[spline] = np.linalg.norm(middle[spline, :, 0], axis=1)
        lowered = ~spline & (nearest <= self.domain)
        bound[lowered], found[lowered] = self._lowered(cells.at(lowered), control[lowered], middle[lowered])
        asked = (farthest >= self.domain) & (nearest <= self.last)
        beyond, there = self._beyond(cells.at(asked), control[asked], middle[asked])
        bound[asked], found[asked] = np.maximum(bound[asked], beyond), np.maximum(found[asked], there)
        return bound, found

    def _lowered(
        self, cells: _Cells, control: Float[np.ndarray, "m 3 64"], middle: Float[np.ndarray, "m 3 1"]
    ) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Bound ‖g - λ u‖: λ = λ(r) is the slope of a smoothstep, λ' at most 10/√3 e/(ρ_0 - ρ_T)²."""
        width = self.domain - self.target
        radius = np.linalg.norm(cells.middle, axis=1)
        t = np.clip((radius - self.target) / width, 0.0, 1.0)
        steepness = self.allowance * 30.0 * (t * (1.0 - t)) ** 2 / width
        lowering = (steepness / np.maximum(radius, 1e-9))[:, None] * cells.middle
        change = self.allowance / width * max(10.0 / 3.0**0.5 / width, 1.875 / self.target)
        bound = np.linalg.norm(control - lowering[:, :, None], axis=1).max(axis=1)
        found = np.linalg.norm(middle[:, :, 0] - lowering, axis=1)
        return bound + 0.5 * 3.0**0.5 * cells.side * change, np.where(radius <= self.domain, found, 0.0)

    def _beyond(
        self, cells: _Cells, control: Float[np.ndarray, "m 3 64"], middle: Float[np.ndarray, "m 3 1"]
    ) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Bound the continuation's slope where cells are asked from radii above ρ_0.

        For any direction u in the cell, g_r and g_t are those along and across the middle's direction u_0, but for
        |u - u_0| ‖g‖ each.
        """
        nearest, farthest = _radii(cells.middle, cells.side)
        low = np.searchsorted(self.psi, nearest, side="right") - 1
        low, high = np.maximum(low, 0), np.minimum(np.searchsorted(self.psi, farthest), _RADII - 1)
        radius = np.linalg.norm(cells.middle, axis=1)
        u = cells.middle / np.maximum(radius, 1e-9)[:, None]
        turn = 0.5 * 3.0**0.5 * cells.side / np.minimum(radius, np.maximum(nearest, self.domain))

        def parts(g: Float[np.ndarray, "m 3 k"]) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "m k"]]:
            radial = np.einsum("mck,mc->mk", g, u)
            return radial, np.linalg.norm(g - radial[:, None, :] * u[:, :, None], axis=1)

        radial, across = parts(control)
        scale = np.minimum(1.0, self.psi[high] / self.radii[low])[:, None]
        most, least = self.psi_slope[low][:, None], self.psi_slope[high][:, None]
        over, under = radial - self.rise_at(self.psi[low])[:, None], radial - self.rise_at(self.psi[high])[:, None]
        upper = np.where(over > 0.0, most, least) * over + self.rise[high][:, None]
        lower = np.where(under > 0.0, least, most) * under + self.rise[low][:, None]
        bound = np.hypot(scale * across, np.maximum(np.abs(upper), np.abs(lower))).max(axis=1)
        # Beyond ρ_1 the tangential part alone is asked, scaled by at most (ρ_0 + ρ_1)/(2 ρ_1).
        outside = np.maximum(1.0, np.hypot(self.last / self.outer * across.max(axis=1), self.rise[-1]))
        bound = np.where(farthest >= self.last, np.maximum(bound, outside), bound)
        bound += 2.0**0.5 * turn * np.linalg.norm(control, axis=1).max(axis=1)

        radial, across = (part[:, 0] for part in parts(middle))
        asked = np.clip(radius, self.domain, self.last)
        r = np.interp(asked, self.psi, self.radii)
        slope = np.interp(r, self.radii, self.psi_slope)
        here = np.hypot(
            asked / r * across, slope * (radial - self.rise_at(asked)) + np.sqrt(1 - (self.target / r) ** 2)
        )
        return bound, np.where((radius >= self.domain) & (radius <= self.last), here, 0.0)

    def rise_at(self, radius: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """F' at a radius."""
        return np.sqrt(1.0 - (self.target / radius) ** 2)
