"""A learned field as an ONNX model: points in float64 to values and gradients in float64, the network in its own type.

The nodes follow `fields.neural`, `fields.mlp` and `fields.continuation` step by step: into the domain, forward sweep,
reverse sweep, continuation. Every runtime rounds in its own way, so the difference from the package is measured where
the file is written, and the measured difference stands in the file beside the certificate; it proves nothing.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from keepout.core.errors import ExchangeError
from keepout.core.fields.evaluate import values_and_gradients
from keepout.core.fields.mlp import Layers
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.fields.neural import NeuralField
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import write_whole
from keepout.flights.exchange.onnx_graph import Graph

POINTS = 120_000
"""At which the file is measured; a third each within the domain, on the bend beyond it, and far outside."""
_FARTHEST = 4.0
"""Points lie within so many outer radii of the field's centre."""
_PIECE = 4096


def export_onnx(
    model: FieldModel,
    path: Path,
    *,
    certificate: Certificate | None,
    seed: int = 0,
    points: int = POINTS,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write a field as an ONNX model, measured against the package, and give what was measured.

    Args:
        model: a neural field.
        path: the file.
        certificate: the one that the file shall tell, with the measured difference added.
        seed: of the points at which the difference is measured.
        points: how many.
        progress: called as they are done.

    Raises:
        ExchangeError: the field is none of a network, `onnxruntime` is missing, or the file cannot be written.

    """
    field = model.field
    if not isinstance(field, NeuralField):
        raise ExchangeError(f"a {type(field).__name__} has no ONNX form; a neural field has")
    graph = field_graph(field)
    content = graph.SerializeToString()
    progress(0.1, "measuring")
    where = sample_points(field, points, seed)
    measured = measure(content, field, where, progress=progress)
    rounding = own_rounding(field, where)
    told = {
        "format": "keepout-field-onnx 1",
        "units": "points and value in metres, gradient dimensionless; the target's body frame",
        "target_name": model.target_name,
        "target_sha256": model.target_sha256,
        "field_sha256": model.sha256,
        "measured_value_difference_m": measured.value,
        "measured_gradient_difference": measured.gradient,
        "package_rounding_m": rounding.value,
        "package_rounding_of_gradient": rounding.gradient,
        "measured_points": points,
        "measured_seed": seed,
        "measured_runtime": _runtime_version(),
    }
    if certificate is not None:
        told |= {
            "certificate_kind": certificate.kind,
            "chaser_radius_m": certificate.chaser_radius,
            "error_bound_m": certificate.error_bound,
            "error_bound_with_measured_difference_m": certificate.error_bound + measured.value,
            "gradient_bound": certificate.gradient_bound,
            "gradient_kind": certificate.gradient_kind,
            "gradient_bound_with_measured_difference": certificate.gradient_bound + measured.gradient,
        }
    for key, value in told.items():
        entry = graph.metadata_props.add()
        entry.key, entry.value = f"keepout.{key}", value if isinstance(value, str) else repr(value)
    write_whole(path, graph.SerializeToString(), refusal=ExchangeError)
    return {**told, "nodes": len(graph.graph.node)}


def field_graph(field: NeuralField) -> Any:
    """Give a field's ONNX model: input `points` (n, 3) in metres, outputs `value` (n,) and `gradient` (n, 3)."""
    g = Graph()
    rings = _Rings(g, field)
    inside = g.apply("Where", rings.outside, rings.carried, "points")
    dtype = np.dtype(field.layers.weights[0].dtype)
    centred = g.apply("Sub", inside, g.constant(np.asarray(field.continuation.centre)[None]))
    x = g.cast(g.apply("Div", centred, g.constant(float(field.scale))), dtype)
    value, gradient = (g.cast(name, np.dtype(np.float64)) for name in _sweeps(g, field, x, dtype))
    scaled = g.apply("Mul", value, g.constant(float(field.scale)))
    g.named(g.apply("Squeeze", rings.value(scaled), g.constant([1], np.int64)), "value")
    g.named(rings.gradient(gradient), "gradient")
    said = "Signed distance (m) and its gradient at points (m) in the target's body frame; positive outside."
    return g.model({"points": ["n", 3]}, {"value": ["n"], "gradient": ["n", 3]}, said)


def _sweeps(g: Graph, field: NeuralField, x: str, dtype: np.dtype) -> tuple[str, str]:
    """Append the network's forward and reverse sweep (`fields.mlp.sweeps`); give its value (n, 1) and gradient."""
    weights = [np.asarray(W) for W in field.layers.weights]
    biases = [np.asarray(b) for b in field.layers.biases]
    one, beta = g.constant(1.0, dtype), g.constant(field.beta, dtype)
    a, slopes = x, []
    for W, b in zip(weights[:-1], biases[:-1]):
        z = g.apply("Add", g.apply("MatMul", a, g.constant(W.T, dtype)), g.constant(b, dtype))
        t = g.apply("Mul", z, beta)
        e = g.apply("Exp", g.apply("Neg", g.apply("Abs", t)))
        both = g.apply("Add", one, e)
        risen = g.apply("Max", t, g.constant(0.0, dtype))
        a = g.apply("Div", g.apply("Add", risen, g.apply("Log", both)), beta)
        reciprocal = g.apply("Div", one, both)
        rising = g.apply("Greater", t, g.constant(0.0, dtype))
        slopes.append(g.apply("Where", rising, reciprocal, g.apply("Mul", e, reciprocal)))
    last = g.apply("MatMul", a, g.constant(weights[-1].T, dtype))
    value = g.apply("Add", last, g.constant(biases[-1], dtype))
    a_bar = g.constant(weights[-1], dtype)
    for W, slope in zip(weights[-2::-1], reversed(slopes)):
        a_bar = g.apply("MatMul", g.apply("Mul", a_bar, slope), g.constant(W, dtype))
    return value, a_bar


class _Rings:
    """The nodes of `fields.continuation`: which points lie outside, where they are asked, and what is added there."""

    def __init__(self, g: Graph, field: NeuralField) -> None:
        self.g, ring = g, field.continuation
        numbers = (ring.target_radius, ring.domain_radius, ring.outer_radius, ring.allowance)
        self.target_radius, self.domain_radius, self.outer_radius, self.allowance = (float(n) for n in numbers)
        centre = g.constant(np.asarray(ring.centre)[None])
        self._from_centre = g.apply("Sub", "points", centre)
        self.outside, self._away, self._r = self._beyond(self.domain_radius)
        width = self.outer_radius - self.domain_radius
        t = self._share(self._r, self.domain_radius, width)
        t2 = g.apply("Mul", t, t)
        t3 = g.apply("Mul", t2, t)
        bent = self._sum(t, self._times(t3, -1.0), self._times(g.apply("Mul", t2, t2), 0.5))
        self._psi = self._plus(self._times(bent, width), self.domain_radius)
        self._psi1 = self._plus(self._sum(self._times(t2, -3.0), self._times(t3, 2.0)), 1.0)
        ratio = g.apply("Div", self._psi, self._r)
        self._ratio = ratio
        self._lowered, self._lowered_slope = self._lowering()
        self.carried = g.apply("Add", g.apply("Mul", self._away, ratio), centre)

    def value(self, value: str) -> str:
        """Continue values (n, 1)."""
        g = self.g
        added = g.apply("Sub", self._rise(self._r), self._rise(self._psi))
        beyond = g.apply("Where", self.outside, added, g.constant(0.0))
        return g.apply("Sub", g.apply("Add", value, beyond), self._lowered)

    def gradient(self, gradient: str) -> str:
        """Continue gradients (n, 3)."""
        g = self.g
        u = g.apply("Div", self._away, self._r)
        radial = g.dot(gradient, u)
        falling = g.apply("Mul", self._rise_slope(self._psi), self._psi1)
        added = g.apply("Sub", self._rise_slope(self._r), falling)
        across = g.apply("Mul", self._ratio, g.apply("Sub", gradient, g.apply("Mul", radial, u)))
        along = g.apply("Mul", g.apply("Add", g.apply("Mul", self._psi1, radial), added), u)
        continued = g.apply("Where", self.outside, g.apply("Add", across, along), gradient)
        return g.apply("Sub", continued, self._lowered_slope)

    def _lowering(self) -> tuple[str, str]:
        """Append the allowance times a smoothstep from the target's radius to the domain's, and its gradient."""
        g = self.g
        _, away, r = self._beyond(self.target_radius)
        width = self.domain_radius - self.target_radius
        t = self._share(r, self.target_radius, width)
        t2 = g.apply("Mul", t, t)
        bracket = self._plus(self._sum(self._times(t, -15.0), self._times(t2, 6.0)), 10.0)
        value = self._times(g.apply("Mul", g.apply("Mul", t2, t), bracket), self.allowance)
        bell = g.apply("Mul", t, self._plus(self._times(t, -1.0), 1.0))
        first = self._times(g.apply("Mul", bell, bell), self.allowance * 30.0 / width)
        return value, g.apply("Mul", first, g.apply("Div", away, r))

    def _beyond(self, radius: float) -> tuple[str, str, str]:
        """Whether a point lies beyond a radius; its place from the centre, or a stand-in if not; and that one's r."""
        g = self.g
        beyond = g.apply("Greater", g.dot(self._from_centre, self._from_centre), g.constant(radius**2))
        away = g.apply("Where", beyond, self._from_centre, g.constant([[radius, 0.0, 0.0]]))
        return beyond, away, g.apply("Sqrt", g.dot(away, away))

    def _share(self, r: str, start: float, width: float) -> str:
        g = self.g
        share = g.apply("Div", g.apply("Sub", r, g.constant(start)), g.constant(width))
        return g.apply("Min", g.apply("Max", share, g.constant(0.0)), g.constant(1.0))

    def _rise(self, s: str) -> str:
        """F(s) = √(s² − ρ²) − ρ arccos(ρ/s).

        Runtimes have the arc cosine in float32 only; one Newton step on cos θ = ρ/s makes it one of float64.
        """
        g = self.g
        rho = g.constant(self.target_radius)
        ratio = g.apply("Div", rho, s)
        rough = g.cast(g.apply("Acos", g.cast(ratio, np.dtype(np.float32))), np.dtype(np.float64))
        missing = g.apply("Sub", g.apply("Cos", rough), ratio)
        angle = g.apply("Add", rough, g.apply("Div", missing, g.apply("Sin", rough)))
        root = g.apply("Sqrt", g.apply("Sub", g.apply("Mul", s, s), g.constant(self.target_radius**2)))
        return g.apply("Sub", root, g.apply("Mul", rho, angle))

    def _rise_slope(self, s: str) -> str:
        """F'(s) = √(1 − (ρ/s)²)."""
        g = self.g
        ratio = g.apply("Div", g.constant(self.target_radius), s)
        return g.apply("Sqrt", g.apply("Sub", g.constant(1.0), g.apply("Mul", ratio, ratio)))

    def _times(self, value: str, factor: float) -> str:
        return self.g.apply("Mul", value, self.g.constant(factor))

    def _plus(self, value: str, number: float) -> str:
        return self.g.apply("Add", value, self.g.constant(number))

    def _sum(self, first: str, *rest: str) -> str:
        for value in rest:
            first = self.g.apply("Add", first, value)
        return first


@dataclass(frozen=True)
class Difference:
    """Largest difference between two evaluations of a field: of the value, m, and of the gradient, as a vector."""

    value: float
    gradient: float


def sample_points(field: NeuralField, count: int, seed: int) -> Float[np.ndarray, "n 3"]:
    """Give points in any direction: a third within the domain, a third on the bend beyond it, a third far outside."""
    generator = np.random.default_rng(seed)
    ring = field.continuation
    domain, outer = float(ring.domain_radius), float(ring.outer_radius)
    inside = domain * generator.uniform(size=count - 2 * (count // 3)) ** (1.0 / 3.0)
    bend = generator.uniform(domain, outer, count // 3)
    beyond = generator.uniform(outer, _FARTHEST * outer, count // 3)
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(ring.centre) + direction * np.concatenate([inside, bend, beyond])[:, None]


def measure(
    content: bytes, field: NeuralField, points: Float[np.ndarray, "n 3"], *, progress: Progress = silent
) -> Difference:
    """Evaluate an ONNX model in onnxruntime and the field in the package, and give how far they are apart.

    Raises:
        ExchangeError: `onnxruntime` is missing.

    """
    try:
        import onnxruntime
    except ImportError:
        raise ExchangeError("--to onnx: measures the file with onnxruntime; pip install 'keepout[export]'") from None
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    value, gradient = values_and_gradients(field, points)
    worst = np.zeros(2)
    for start in range(0, len(points), _PIECE):
        piece = slice(start, start + _PIECE)
        here, slope = session.run(["value", "gradient"], {"points": points[piece]})
        apart = (np.abs(here - value[piece]), np.linalg.norm(slope - gradient[piece], axis=1))
        # A number that is none must not be lost in a maximum.
        worst = np.maximum(worst, [np.max(part) if np.isfinite(part).all() else np.inf for part in apart])
        progress(0.1 + 0.9 * start / len(points), "measuring")
    if not np.isfinite(worst).all():
        raise ExchangeError("--to onnx: onnxruntime gives a number that is not finite where the field's is")
    return Difference(float(worst[0]), float(worst[1]))


def own_rounding(field: NeuralField, points: Float[np.ndarray, "n 3"]) -> Difference:
    """Give how far the package's evaluation in the network's type is from one of the same weights in float64."""
    wide = [tuple(jax.device_put(np.asarray(part, np.float64)) for part in parts) for parts in field.layers]
    exact = eqx.tree_at(lambda f: f.layers, field, Layers(*wide))
    value, gradient = values_and_gradients(field, points)
    true_value, true_gradient = values_and_gradients(exact, points)
    steepest = np.linalg.norm(gradient - true_gradient, axis=1)
    return Difference(float(np.abs(value - true_value).max()), float(steepest.max()))


def _runtime_version() -> str:
    import onnxruntime

    return f"onnxruntime {onnxruntime.__version__}, CPUExecutionProvider"
