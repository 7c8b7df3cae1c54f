"""The certificate: how far a field can over-state the distance where a chaser touches, proved.

A continuous path from outside to contact crosses {d = R}, R the chaser's radius and d the exact distance to the
triangles. So one inequality on one surface, f̃ ≤ R + e_h on {d = R}, makes {f̃ > R + e_h} free of contact. The surface
is covered with triangles (R = 0) or boxes (R > 0), f̃ is bounded over each, and those that matter are split
(docs/certificate.md). Where a proof takes too long, a search says what it found, and proves nothing; of a field of your
own the bound follows from the Lipschitz bound that is stated.
"""

import dataclasses
import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.errors import FieldError
from keepout.core.fields.field import values, values_and_gradients
from keepout.core.fields.grid import GridField
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.fields.neural import NeuralField
from keepout.core.fields.own import FunctionField
from keepout.core.geometry import level_set
from keepout.core.geometry.distance import ExactDistance
from keepout.core.geometry.octree import straddling_cells
from keepout.core.geometry.target import Target
from keepout.core.progress import Progress, part_of, silent
from keepout.core.proof import bounds
from keepout.core.proof.grid import certify_grid
from keepout.core.proof.slope import GAP, prove_lipschitz

PIECE = 32_768
"""Elements bounded between two reports of progress."""
RELATIVE_GAP, SMALLEST_GAP = 0.05, 0.003
"""Splitting stops when the bound is within this of the largest value found: 5 %, or 3 mm."""
MOST_ELEMENTS = 3_000_000
"""Splitting also stops after this many elements; the bound is then the largest of what is left: looser, and still
proved."""
ERROR_GAP, POINT_LIKE = 2e-5, 0.005
"""Share of the domain's radius by which the float32 error may carry the bound further above the largest value found,
where an element is longer than so many metres: the error does not vanish at a point."""
GRADIENT_ALLOWANCE = 0.2
"""Added to the largest gradient found, as a share of it, where no bound is proved."""
FIRST_LEAF, LARGEST_LEAF = 0.02, 0.4
"""Side of the cubes that first cover {d = R}: this share of the domain's radius, at most so many metres."""
OTHER_MACHINE = 1e-12
"""Metres, or slope: what float64 sums in another order change; every bound has more than that added for it."""
LOOKED_AT = 1024
"""Elements with the largest bounds, of each size, where a larger value is looked for."""


def certify(
    model: FieldModel,
    target: Target,
    *,
    chaser_radius: float | None = None,
    prove_slope: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> FieldModel:
    """Return the same model with a proved certificate for one chaser radius, in place of any it had for that radius.

    Args:
        model: its field must be a `NeuralField`.
        target: the mesh it was made for.
        chaser_radius: R, metres; that of the fit if absent, or 0.5.
        prove_slope: prove a bound of ‖∇f̃‖ too, which can take minutes; else it is the largest found plus 20 %, and
            says so.
        seed: of the search for the largest value; the bound is sound whatever it finds.
        progress: fraction done (a guess), elements left and the bound so far.

    Raises:
        FieldError: another target's model, a point cloud, a radius that is negative or too large for the field's
            domain.

    """
    keep_programs()
    start = time.perf_counter()
    chaser_radius = float(model.training.get("chaser_radius", 0.5)) if chaser_radius is None else chaser_radius
    field, distance = _in_reach(model, target, chaser_radius)
    found = largest_found(field, distance, chaser_radius, np.random.default_rng(seed))
    progress(0.1, f"largest value found {found - chaser_radius:+.4f} m")
    upper, evaluation, found = _bound_on_contact(field, distance, chaser_radius, found, progress)
    steepest = steepest_found(field, distance, chaser_radius, np.random.default_rng(seed + 1))
    # What another certificate of the model proved for a smaller radius holds for this one.
    smaller = (c for c in model.certificates if c.gradient_kind == "certified" and c.chaser_radius <= chaser_radius)
    proved = next((c.gradient_bound for c in smaller if c.gradient_bound >= steepest), None)
    if proved is None and prove_slope:
        part = part_of(progress, 0.7, 1.0)
        steepest, proved = prove_lipschitz(field, distance, found=steepest, clearance=chaser_radius, progress=part)
    progress(1.0, f"error bound {upper - chaser_radius:+.4f} m, largest found {found - chaser_radius:+.4f} m")
    return model.certified(
        "certified",
        chaser_radius,
        start,
        error_bound=float(upper - chaser_radius),
        allowance=0.0,
        sampled_maximum=float(found - chaser_radius),
        gradient_bound=(1.0 + GRADIENT_ALLOWANCE) * steepest if proved is None else proved,
        gradient_kind="sampled" if proved is None else "certified",
        evaluation_error=float(evaluation),
        gradient_found=steepest,
    )


class Check(NamedTuple):
    """What a proof of a certificate's numbers came to.

    Attributes:
        proved: whether all that the certificate calls certified was proved; of a sampled one nothing is.
        error_bound: e_h as proved now, metres; of a sampled certificate the largest f̃ - R found now.
        evaluation_error: as proved now, metres; None of a sampled certificate.
        gradient_bound: as proved now; None where the certificate does not call its own certified, or the bound proved
            would be too loose.

    """

    proved: bool
    error_bound: float
    evaluation_error: float | None
    gradient_bound: float | None


def check_certificate(
    model: FieldModel, target: Target, stated: Certificate, *, seed: int = 0, progress: Progress = silent
) -> Check:
    """Prove again what a certificate says, without believing any of its numbers.

    The field is bounded as in `certify` and `certify_grid`; a network's surface is split until the stated numbers are
    proved, a point is found that contradicts them, or the limit of elements is reached.

    Args:
        model: with its field.
        target: the mesh it was made for.
        stated: the certificate.
        seed: of the searches; what is proved is sound whatever they find.
        progress: as of `certify`.

    Raises:
        FieldError: as `certify` and `certify_grid`.

    """
    radius, slope_stated = stated.chaser_radius, stated.gradient_kind == "certified"
    if isinstance(model.field, GridField):
        bare = dataclasses.replace(model, certificates=())
        again = certify_grid(bare, target, chaser_radius=radius, seed=seed).certificate(radius)
        error, evaluation, slope = again.error_bound, again.evaluation_error, again.gradient_bound
    else:
        keep_programs()
        field, distance = _in_reach(model, target, radius)
        found = largest_found(field, distance, radius, np.random.default_rng(seed))
        if stated.kind == "sampled":
            return Check(False, found - radius, None, None)
        upper, evaluation, _ = _bound_on_contact(field, distance, radius, found, progress, stated)
        error, slope = upper - radius, None
        if slope_stated:
            # Cubes are then split until the stated bound holds, or a larger slope is found.
            enough = stated.gradient_bound / (1.0 + GAP) * (1.0 - 1e-12)
            part = part_of(progress, 0.7, 1.0)
            slope = prove_lipschitz(field, distance, found=enough, clearance=radius, progress=part).proved
    holds = error <= stated.error_bound + OTHER_MACHINE and evaluation <= stated.evaluation_error + OTHER_MACHINE
    if slope_stated:
        holds = holds and slope is not None and slope <= stated.gradient_bound + OTHER_MACHINE
    return Check(holds and stated.kind == "certified", error, evaluation, slope if slope_stated else None)


def _in_reach(model: FieldModel, target: Target, chaser_radius: float) -> tuple[NeuralField, ExactDistance]:
    """Give network and distance, and refuse a radius that reaches out of the learned domain."""
    field, distance = require_network_and_mesh(model, target, where="certify")
    centre = np.asarray(field.continuation.centre)
    reach = float(np.linalg.norm(np.maximum(np.abs(distance.lower - centre), np.abs(distance.upper - centre))))
    largest = float(field.continuation.domain_radius) - reach - _first_leaf(field) * np.sqrt(3.0)
    if not 0.0 <= chaser_radius <= largest:
        raise FieldError(f"chaser radius {chaser_radius:g} m: for this field it must be 0 to {largest:.3g} m")
    return field, distance


def require_network_and_mesh(model: FieldModel, target: Target, *, where: str) -> tuple[NeuralField, ExactDistance]:
    """Give the network and the distance to the triangles that a certificate is about; `where` begins a refusal.

    Raises:
        FieldError: another target's model, a field that is no network, or a point cloud.

    """
    field, distance = model.field, target.distance
    model.require_target(target, where=where)
    if not isinstance(field, NeuralField):
        raise FieldError(f"{where}: a {type(field).__name__} is no network; `certify_grid` certifies grid fields")
    if not isinstance(distance, ExactDistance):
        raise FieldError(f"{where}: {target.name} is a point cloud, which has no triangles; give a mesh")
    return field, distance


def largest_found(field: NeuralField, distance: ExactDistance, radius: float, generator: np.random.Generator) -> float:
    """Return the largest f̃ found on {d = radius}: samples, then random ascent around the best of them."""
    start = level_set.level_points(distance, radius, 60_000, generator)
    value = values(field, start)
    best = float(value.max())
    points = start[np.argsort(-value)[:400]]
    for step in (0.2, 0.1, 0.05, 0.03, 0.02, 0.01, 0.005, 0.002):
        moved = np.repeat(points, 10, axis=0)
        moved = level_set.onto_level(distance, moved + step * generator.normal(size=moved.shape), radius)
        candidates = np.concatenate([points, moved])
        value = values(field, candidates)
        points = candidates[np.argsort(-value)[:400]]
        best = max(best, float(value.max()))
    return best


def steepest_found(
    field: NeuralField, distance: ExactDistance, clearance: float, generator: np.random.Generator
) -> float:
    """Return the largest ‖∇f̃‖ found where d ≥ clearance: samples near and far, then random ascent."""
    centre, radius = np.asarray(field.continuation.centre), float(field.continuation.outer_radius)
    start = level_set.surface_points(distance, 60_000, generator, by_area=0.5)
    direction = level_set.random_directions(generator, len(start))
    near = start + (clearance + generator.exponential(0.2, size=(len(start), 1))) * direction
    far = centre + radius * generator.uniform(-1.2, 1.2, size=(20_000, 3))
    points = np.concatenate([near, far])
    best = 0.0
    for step in (0.0, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002):
        if step:
            moved = np.repeat(points, 10, axis=0)
            points = np.concatenate([points, moved + step * generator.normal(size=moved.shape)])
        points = points[distance.distance(points) >= clearance]
        slope = np.linalg.norm(values_and_gradients(field, points)[1], axis=1)
        best = max(best, float(slope.max()))
        points = points[np.argsort(-slope)[:400]]
    return best


def _bound_on_contact(
    field: NeuralField,
    distance: ExactDistance,
    radius: float,
    found: float,
    progress: Progress,
    stated: Certificate | None = None,
) -> tuple[float, float, float]:
    """Return an upper bound of f̃ in float32 on {d = radius}, the float32 error in it, and the largest f̃ found.

    Where a bound is stated, and as long as no point contradicts it, elements are split until it is proved.
    """
    contact = _Contact.of(field, distance, radius)
    frontier = _cover(distance, radius, _first_leaf(field))
    # σ' ≤ 1; Frobenius exceeds spectral.
    slack = float(np.prod([np.linalg.norm(W) for W in contact.network.weights])) * contact.slack
    settled, evaluation, seen = -np.inf, 0.0, 0
    while len(frontier):
        gap = max(RELATIVE_GAP * abs(found - radius), SMALLEST_GAP)
        upper, error = np.empty(len(frontier)), np.empty(len(frontier))
        for first in range(0, len(frontier), PIECE):
            piece = frontier[first : first + PIECE]
            part = slice(first, first + len(piece))
            upper[part], error[part] = contact.bounded(piece)
        seen += len(frontier)
        # The elements that matter know where to look for a larger value.
        worst = frontier[np.argsort(-upper)[:LOOKED_AT]]
        places = worst.mean(axis=1) if radius == 0.0 else level_set.onto_level(distance, worst[:, 2], radius)
        found = max(found, float(values(field, places).max(initial=-np.inf)))
        large = _edges(frontier, radius).max(axis=1) > POINT_LIKE
        if stated is None or found > radius + stated.error_bound:
            open_ = (upper - error > found + gap) | ((upper > found + gap + ERROR_GAP * contact.scale) & large)
        else:
            open_ = (upper > radius + stated.error_bound - slack) | ((error > stated.evaluation_error) & large)
        if seen + 2 * int(open_.sum()) > MOST_ELEMENTS:
            open_[:] = False
        settled = max(settled, float(upper[~open_].max(initial=-np.inf)))
        evaluation = max(evaluation, float(error[~open_].max(initial=0.0)))
        so_far = max(settled, float(upper.max())) - radius
        progress(
            0.1 + 0.6 * min(1.0, seen / 400_000), f"{int(open_.sum())} elements open, bound so far {so_far:+.4f} m"
        )
        frontier = _split(frontier[open_], distance, radius)
    return settled + slack, evaluation, found


@dataclasses.dataclass(frozen=True)
class _Contact:
    """{d = radius} and a network over it.

    Attributes:
        network: in float64.
        distance: exact.
        radius: metres.
        centre, scale: of the network's own coordinates, metres.
        slack: by which their rounding may move a point, metres.

    """

    network: bounds.Network
    distance: ExactDistance
    radius: float
    centre: Float[np.ndarray, "3"]
    scale: float
    slack: float

    @classmethod
    def of(cls, field: NeuralField, distance: ExactDistance, radius: float) -> "_Contact":
        network, centre = bounds.Network.of(field.layers, field.beta), np.asarray(field.continuation.centre)
        scale = float(field.scale)
        # The normalisation in float64 and its inverse: a few units in the last place of numbers of the domain's size.
        return cls(
            network, distance, radius, centre, scale, 64.0 * bounds.UNIT64 * (scale + float(np.abs(centre).max()))
        )

    def bounded(self, piece: Float[np.ndarray, "m k 3"]) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Return for each element an upper bound of f̃ in float32 where d = radius, and the float32 error in it, metres.

        Minus infinity where the element does not meet {d = radius}.
        """
        centre, scale = self.centre, self.scale
        if self.radius == 0.0:
            upper, _, _, error = bounds.upper_bounds(self.network, bounds.triangles((piece - centre) / scale))
        else:
            # A shift by the slack along each axis takes at most three of it along the edge that is not slanted.
            slanted = (piece[:, 2:] + np.vstack([-centre, 3.0 * self.slack * np.eye(3)])) / scale
            upper, slope, constant, error = bounds.upper_bounds(self.network, slanted.transpose(1, 0, 2))
            cut = level_set.largest_on_level(self.distance, self.radius, piece[:, 0], piece[:, 1] + self.slack, slope)
            upper = np.fmin(upper, ((piece[:, 0] - centre) / scale * slope).sum(axis=1) + constant + cut / scale)
        return scale * (upper + error), scale * error


def _first_leaf(field: NeuralField) -> float:
    return min(LARGEST_LEAF, FIRST_LEAF * float(field.scale))


def _cover(distance: ExactDistance, radius: float, leaf: float) -> Float[np.ndarray, "m k 3"]:
    """Triangles as (m, 3, 3) corners, or boxes as (m, 6, 3), see `_slanted`."""
    if radius == 0.0:
        return distance.vertices[distance.faces]
    centres, half = straddling_cells(distance, radius, leaf=leaf)
    return _slanted(centres, np.repeat(half[:, None], 3, axis=1), distance, radius)


def _edges(elements: Float[np.ndarray, "m k 3"], radius: float) -> Float[np.ndarray, "m 3"]:
    """Lengths of the edges, metres: a triangle's across from each corner, and a slanted box's."""
    if radius == 0.0:
        return np.linalg.norm(elements[:, [1, 2, 0]] - elements[:, [2, 0, 1]], axis=2)
    return 2.0 * np.linalg.norm(elements[:, 3:], axis=2)


def _split(elements: Float[np.ndarray, "m k 3"], distance: ExactDistance, radius: float) -> Float[np.ndarray, "p k 3"]:
    """Cut each element in two across its longest edge, and leave out boxes that cannot meet {d = radius}."""
    if len(elements) == 0:
        return elements
    rows, longest = np.arange(len(elements)), _edges(elements, radius).argmax(axis=1)
    if radius == 0.0:
        a, b, c = (elements[rows, (longest + k) % 3] for k in range(3))
        middle = 0.5 * (b + c)
        return np.concatenate([np.stack([a, b, middle], axis=1), np.stack([a, middle, c], axis=1)])
    step = np.where(np.arange(3) == longest[:, None], 0.5, 0.0) * elements[:, 1]
    centres, half = np.concatenate([elements[:, 0] - step, elements[:, 0] + step]), elements[:, 1] - step
    return _slanted(centres, np.tile(half, (2, 1)), distance, radius)


def _slanted(
    centres: Float[np.ndarray, "m 3"], half: Float[np.ndarray, "m 3"], distance: ExactDistance, radius: float
) -> Float[np.ndarray, "p 6 3"]:
    """Cut boxes down to what can meet {d = radius}: each box's centre and half widths, and a slanted box in it.

    With q the point of the target that is nearest to the centre c, at the distance r, and u the direction from q to c,
    u·(p - c) is at most what `largest_on_level` says. If no p of the box is more than t beside the line through q and
    c, |p - q| ≥ R says that |r + u·(p - c)| ≥ √(R² - t²), and p is on c's side of q unless the box reaches far. Between
    these two planes and two pairs of the box's faces is the slanted box: its centre, and the halves of its edges.
    """
    half = half * (1.0 + 1e-9) + 1e-9
    away = centres - distance.closest(centres)[1]
    r = np.linalg.norm(away, axis=1)
    u = np.where(r[:, None] > 0.0, away / np.maximum(r, 1e-300)[:, None], np.eye(3)[0])
    parts = half * np.abs(u)
    reach = parts.sum(axis=1)
    t_squared = (half**2).sum(axis=1) - (2.0 * parts.max(axis=1) - reach) ** 2
    beyond = np.sqrt(np.maximum(radius**2 - t_squared - 1e-9, 0.0))
    below = np.where(reach < r + beyond, np.maximum(beyond - r - 1e-9, -reach), -reach)
    above = np.minimum(level_set.largest_on_level(distance, radius, centres, half, u) + 1e-9, reach)
    centres, half, u, above, below = [of[above >= below] for of in (centres, half, u, above, below)]
    rows, k = np.arange(len(u)), np.abs(u).argmax(axis=1)
    steep, whole = u[rows, k], half[rows, k]
    thin = above - below < 2.0 * np.abs(steep) * whole
    thick, middle = np.where(thin, 0.5 * np.stack([above - below, above + below]) / steep, [whole, 0.0 * whole])
    slant = np.where(thin, -1.0 / steep, 0.0)[:, None] * half * u
    slant[rows, k] = np.abs(thick)
    edges, inner, wide = np.eye(3) * half[:, None], centres.copy(), np.abs(slant).sum(axis=1)
    edges[rows, :, k] = slant
    inner[rows, k] += middle
    low, high = np.maximum(middle - wide, -whole), np.minimum(middle + wide, whole)
    centres[rows, k] += 0.5 * (low + high)
    half[rows, k] = 0.5 * (high - low)
    return np.concatenate([np.stack([centres, half, inner], axis=1), edges], axis=1)


def sample_certificate(
    model: FieldModel,
    target: Target,
    *,
    chaser_radius: float = 0.0,
    allowance: float = 0.0,
    seed: int = 0,
    progress: Progress = silent,
) -> FieldModel:
    """Return the same model with a sampled certificate for one chaser radius, in place of any it had for that radius.

    It proves nothing: f̃ may exceed R + e_h where nobody looked. The search is the one that `certify` begins with:
    samples of {d = R}, denser along edges and at corners, then random ascent around the best. For networks whose
    bounds are too loose or take too long to prove, such as the source paper's 10 x 512.

    Args:
        model: its field must be a `NeuralField`.
        target: the mesh it was made for.
        chaser_radius: R, metres.
        allowance: metres added to the largest value found; 0 is what the source paper does.
        seed: of the search.
        progress: fraction done, and the largest value found.

    Raises:
        FieldError: another target's model, a field that is no network, a point cloud, a negative or infinite radius or
            allowance.

    """
    start = time.perf_counter()
    field, distance = require_network_and_mesh(model, target, where="sampled certificate")
    for name, value in (("chaser radius", chaser_radius), ("allowance", allowance)):
        if not 0.0 <= value < np.inf:
            raise FieldError(f"sampled certificate: {name} {value:g} m; it must be 0 or more, and finite")
    found = largest_found(field, distance, chaser_radius, np.random.default_rng(seed)) - chaser_radius
    progress(0.4, f"largest value found {found:+.4f} m")
    steepest = steepest_found(field, distance, chaser_radius, np.random.default_rng(seed + 1))
    progress(1.0, f"largest value found {found:+.4f} m: nothing is proved")
    return model.certified(
        "sampled",
        chaser_radius,
        start,
        error_bound=float(found + allowance),
        allowance=float(allowance),
        sampled_maximum=float(found),
        gradient_bound=(1.0 + GRADIENT_ALLOWANCE) * steepest,
        gradient_kind="sampled",
        evaluation_error=0.0,
        gradient_found=steepest,
    )


def stated_error_bound(field: FunctionField, target: Target, chaser_radius: float, *, leaf: float = 0.1) -> float:
    """Give e_h in metres with f̃ ≤ R + e_h wherever the exact distance to the target is R.

    {d = R} is covered by cubes; in a cube of centre c and half diagonal ρ the field is at most f̃(c) + L ρ. So the bound
    is proved where the field's Lipschitz bound L is true. It is loose by up to 2 L ρ; smaller cubes take longer.

    Args:
        field: with its Lipschitz bound, stated or sampled; the answer is of the same kind.
        target: the mesh.
        chaser_radius: R, m.
        leaf: side of the cubes, m.

    Raises:
        FieldError: a radius that is negative or not finite.

    """
    if not 0.0 <= chaser_radius < np.inf:
        raise FieldError(f"error bound: chaser radius {chaser_radius} m; it must be 0 or more, and finite")
    centres, half = straddling_cells(target.distance, chaser_radius, leaf=leaf)
    return float((values(field, centres) + field.lipschitz * np.sqrt(3.0) * half).max()) - chaser_radius
