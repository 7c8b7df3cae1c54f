"""Random velocity programs and independent solvers for them."""

import clarabel
import numpy as np
import scs
from scipy import sparse

LIMIT = 0.1


def random_programs(rng: np.random.Generator, count: int) -> dict[str, np.ndarray]:
    """Programs in a broad mix: outside and inside the obstacle, far and near, with degenerate normals among them."""
    normal = rng.normal(size=(count, 3))
    normal *= rng.uniform(0.5, 1.5, (count, 1)) / np.linalg.norm(normal, axis=1, keepdims=True)
    normal[rng.random(count) < 0.02] = 0.0
    aligned = rng.random(count) < 0.05
    normal[aligned] = np.eye(3)[rng.integers(0, 3, aligned.sum())]
    size = np.linalg.norm(normal, axis=1)
    error = np.where(rng.random(count) < 0.3, 0.0, rng.uniform(0.0, 0.9, count) * size)
    close = rng.random(count) < 0.15
    error[close] = size[close] * rng.choice([0.97, 0.99, 1.0, 1.01, 1.3], close.sum())
    rate = rng.choice([1.0, 0.1, 0.01], count) * rng.uniform(-0.1, 0.3, count)
    rate[rng.random(count) < 0.03] = 0.0
    desired = rng.normal(size=(count, 3)) * rng.choice([0.02, 0.1, 0.4], (count, 1))
    inward = rng.random(count) < 0.1
    desired[inward] = -0.1 * normal[inward]
    tangent = np.cross(normal, rng.normal(size=(count, 3)))
    return {
        "desired": desired,
        "normal": normal,
        "barrier_rate": rate,
        "gradient_error": error,
        "tangent": tangent,
        "circulation_rate": rng.uniform(-0.3, 0.12, count),
        "weight": rng.choice([0.2, 1.0, 5.0], count),
        "speed": LIMIT * rng.uniform(0.3, 1.5, count),
    }


def reference(one: dict[str, np.ndarray], *, circulation: bool, box: bool, speed: bool) -> np.ndarray | None:
    """Solve one program with SCS at 1e-10, in units of the limit; None if SCS does not call it solved."""
    objective, constraint, offset, cones = _standard_form(one, circulation=circulation, box=box, speed=speed)
    data = {"P": objective[0], "A": constraint, "b": offset, "c": objective[1]}
    solver = scs.SCS(
        data, cones, eps_abs=1e-10, eps_rel=1e-10, verbose=False, max_iters=200_000, acceleration_lookback=20
    )
    answer = solver.solve()
    return answer["x"][:3] * LIMIT if answer["info"]["status"] == "solved" else None


def largest_rate(one: dict[str, np.ndarray], *, box: bool, speed: bool) -> float:
    """Maximise n·v − e‖v‖ with Clarabel (m/s)."""
    rows, offset, cones = [], [], []
    if box:
        rows += [np.hstack([np.eye(3), np.zeros((3, 1))]), np.hstack([-np.eye(3), np.zeros((3, 1))])]
        offset.append(np.ones(6))
        cones.append(clarabel.NonnegativeConeT(6))
    rows.append(-np.eye(4)[[3, 0, 1, 2]])
    offset.append(np.zeros(4))
    cones.append(clarabel.SecondOrderConeT(4))
    if speed:
        rows.append(np.vstack([np.zeros((1, 4)), -np.eye(3, 4)]))
        offset.append(np.array([one["speed"] / LIMIT, 0.0, 0.0, 0.0]))
        cones.append(clarabel.SecondOrderConeT(4))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cost = np.append(-one["normal"], one["gradient_error"])
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix((4, 4)), cost, sparse.csc_matrix(np.vstack(rows)), np.concatenate(offset), cones, settings
    )
    return -float(solver.solve().obj_val) * LIMIT


def _standard_form(one, *, circulation, box, speed):
    """minimise ½xᵀPx + cᵀx subject to Ax + s = b, s in half-lines, then second-order cones; x = (v, w)/limit."""
    n = 4 if circulation else 3
    diagonal = np.array([1.0, 1.0, 1.0] + [2.0 * one["weight"]] * circulation)
    cost = np.append(-one["desired"] / LIMIT, [0.0] * circulation)
    linear, linear_offset = [], []
    if circulation:
        linear.append(np.append(-one["tangent"], -1.0))
        linear_offset.append(-one["circulation_rate"] / LIMIT)
    if box:
        for sign in (1.0, -1.0):
            for axis in range(3):
                row = np.zeros(n)
                row[axis] = sign
                linear.append(row)
                linear_offset.append(1.0)
    cone = np.zeros((4, n))
    cone[0, :3] = -one["normal"]
    cone[1:, :3] = -one["gradient_error"] * np.eye(3)
    cone_offset = np.array([one["barrier_rate"] / LIMIT, 0.0, 0.0, 0.0])
    blocks, offsets, sizes = [cone], [cone_offset], [4]
    if speed:
        cap = np.zeros((4, n))
        cap[1:, :3] = -np.eye(3)
        blocks.append(cap)
        offsets.append(np.array([one["speed"] / LIMIT, 0.0, 0.0, 0.0]))
        sizes.append(4)
    rows = (np.array(linear).reshape(-1, n), *blocks)
    matrix = sparse.csc_matrix(np.vstack(rows))
    offset = np.concatenate([np.array(linear_offset), *offsets])
    return (sparse.diags(diagonal, format="csc"), cost), matrix, offset, {"l": len(linear), "q": sizes}
