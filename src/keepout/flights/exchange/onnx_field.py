"""A learned field as an ONNX model: points in float64 to values and gradients in float64, the network in its own type.

The nodes follow `fields.neural` and `fields.continuation` step by step: into the domain, forward sweep,
reverse sweep, continuation. Every runtime rounds in its own way, so the difference from the package is measured where
the file is written, and the measured difference stands in the file beside the certificate; it proves nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import onnx
from jaxtyping import Float
from onnx import TensorProto, helper, numpy_helper

from keepout.core.errors import ExchangeError
from keepout.core.fields.field import values_and_gradients
from keepout.core.fields.model import Certificate, FieldModel
from keepout.core.fields.neural import Layers, NeuralField
from keepout.core.progress import Progress, silent
from keepout.core.whole_file import write_whole

OPSET = 18
IR_VERSION = 9
"""Of ONNX 1.14 (2023): what reads that or later reads these files."""

_TYPES = {np.dtype(np.float32): TensorProto.FLOAT, np.dtype(np.float64): TensorProto.DOUBLE}
POINTS = 120_000
"""At which the file is measured; a third each within the domain, on the bend beyond it, and far outside."""
_FARTHEST = 4.0
"""Points lie within so many outer radii of the field's centre."""
_PIECE = 4096


class Graph:
    """Nodes and constants of an ONNX graph in the order in which they were asked for."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: dict[tuple[str, bytes, tuple[int, ...]], Any] = {}

    def constant(self, value: Any, dtype: Any) -> str:
        """Give the name of a constant; equal ones are kept once."""
        array = np.ascontiguousarray(value, dtype)
        key = (array.dtype.str, array.tobytes(), array.shape)
        if key not in self._constants:
            self._constants[key] = numpy_helper.from_array(array, f"constant_{len(self._constants)}")
        return self._constants[key].name

    def node(self, operator: str, inputs: list[str], **attributes: Any) -> str:
        """Append an operator with one output and give the output's name."""
        name = f"{operator}_{len(self._nodes)}"
        self._nodes.append(helper.make_node(operator, inputs, [name], name=name, **attributes))
        return name

    def named(self, value: str, name: str) -> None:
        """Give a value a second name, as an output has one."""
        self._nodes.append(helper.make_node("Identity", [value], [name], name=name))

    def model(self, inputs: dict[str, list[Any]], outputs: dict[str, list[Any]], said: str) -> Any:
        """Give the model with float64 inputs and outputs of these shapes.

        Raises:
            onnx.checker.ValidationError: the graph is no graph.

        """
        described = [
            [helper.make_tensor_value_info(name, TensorProto.DOUBLE, shape) for name, shape in values.items()]
            for values in (inputs, outputs)
        ]
        graph = helper.make_graph(self._nodes, "keepout_field", *described, initializer=list(self._constants.values()))
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="keepout"
        )
        model.doc_string = said
        onnx.checker.check_model(model, full_check=True)
        return model


def _appending(operator: str, *, swapped: bool = False) -> Callable[[Any, Any], Any]:
    """Give a method of `Value` that appends an operator with two inputs."""

    def method(self: Any, other: Any) -> Any:
        return self.constant(other).apply(operator, self) if swapped else self.apply(operator, other)

    return method


class Value:
    """A value of a graph: arithmetic with it appends nodes; numbers and arrays are constants of its type."""

    def __init__(self, graph: Graph, name: str, dtype: np.dtype) -> None:
        self.graph, self.name, self.dtype = graph, name, dtype

    def constant(self, value: Any) -> "Value":
        """Give a constant of its type."""
        return Value(self.graph, self.graph.constant(value, self.dtype), self.dtype)

    def apply(self, operator: str, *others: Any, **attributes: Any) -> "Value":
        """Append an operator with this and others as its inputs; a name stands for itself."""
        # The type of a condition is that of what it was made from, and so of what it chooses between.
        names = [one if isinstance(one, str) else self._of(one).name for one in (self, *others)]
        return Value(self.graph, self.graph.node(operator, names, **attributes), self.dtype)

    def cast(self, dtype: Any) -> "Value":
        """Change the float type."""
        dtype = np.dtype(dtype)
        return Value(self.graph, self.graph.node("Cast", [self.name], to=_TYPES[dtype]), dtype)

    def dot(self, other: "Value") -> "Value":
        """Sum the products along the second axis, which stays with length 1."""
        return (self * other).apply("ReduceSum", self.graph.constant([1], np.int64), keepdims=1)

    def _of(self, value: Any) -> "Value":
        return value if isinstance(value, Value) else self.constant(value)

    __add__, __radd__ = _appending("Add"), _appending("Add", swapped=True)
    __sub__, __rsub__ = _appending("Sub"), _appending("Sub", swapped=True)
    __mul__, __rmul__ = _appending("Mul"), _appending("Mul", swapped=True)
    __truediv__, __rtruediv__ = _appending("Div"), _appending("Div", swapped=True)
    __matmul__, __gt__ = _appending("MatMul"), _appending("Greater")

    def __neg__(self) -> "Value":
        return self.apply("Neg")

    def __abs__(self) -> "Value":
        return self.apply("Abs")


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
    import onnxruntime  # is there, as `measure` does not refuse

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
        "measured_runtime": f"onnxruntime {onnxruntime.__version__}, CPUExecutionProvider",
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
    value, gradient = _continued(Value(g, "points", np.dtype(np.float64)), field)
    g.named(value.apply("Squeeze", g.constant([1], np.int64)).name, "value")
    g.named(gradient.name, "gradient")
    said = "Signed distance (m) and its gradient at points (m) in the target's body frame; positive outside."
    return g.model({"points": ["n", 3]}, {"value": ["n"], "gradient": ["n", 3]}, said)


def _sweeps(x: Value, field: NeuralField) -> tuple[Any, Any]:
    """Append the network's forward and reverse sweep (`fields.neural.sweeps`); give its value (n, 1) and gradient."""
    weights = [np.asarray(W) for W in field.layers.weights]
    biases = [np.asarray(b) for b in field.layers.biases]
    a, slopes = x, []
    for W, b in zip(weights[:-1], biases[:-1]):
        t = (a @ W.T + b) * field.beta
        e = (-abs(t)).apply("Exp")
        both = 1.0 + e
        a = (t.apply("Max", 0.0) + both.apply("Log")) / field.beta
        reciprocal = 1.0 / both
        slopes.append((t > 0.0).apply("Where", reciprocal, e * reciprocal))
    value = a @ weights[-1].T + biases[-1]
    a_bar = x.constant(weights[-1])
    for W, slope in zip(weights[-2::-1], reversed(slopes)):
        a_bar = (a_bar * slope) @ W
    return value, a_bar


def _continued(points: Value, field: NeuralField) -> tuple[Any, Any]:
    """Append the network within its domain and its continuation beyond (`fields.continuation`): value and gradient."""
    ring, scale = field.continuation, float(field.scale)
    numbers = (ring.target_radius, ring.domain_radius, ring.outer_radius, ring.allowance)
    target_radius, domain_radius, outer_radius, allowance = (float(n) for n in numbers)
    centre = np.asarray(ring.centre)[None]
    from_centre = points - centre

    def beyond(radius: float) -> tuple[Any, ...]:
        """Whether a point lies beyond a radius; its place from the centre, or a stand-in if not; and that one's r."""
        outside = from_centre.dot(from_centre) > radius**2
        away = outside.apply("Where", from_centre, from_centre.constant([[radius, 0.0, 0.0]]))
        return outside, away, away.dot(away).apply("Sqrt")

    def share(r: Value, start: float, width: float) -> Value:
        return ((r - start) / width).apply("Max", 0.0).apply("Min", 1.0)

    def rise(s: Value) -> Value:
        """F(s) = √(s² − ρ²) − ρ arccos(ρ/s).

        Runtimes have the arc cosine in float32 only; one Newton step on cos θ = ρ/s makes it one of float64.
        """
        ratio = target_radius / s
        rough = ratio.cast(np.float32).apply("Acos").cast(np.float64)
        angle = rough + (rough.apply("Cos") - ratio) / rough.apply("Sin")
        return (s * s - target_radius**2).apply("Sqrt") - target_radius * angle

    def rise_slope(s: Value) -> Value:
        """F'(s) = √(1 − (ρ/s)²)."""
        ratio = target_radius / s
        return (1.0 - ratio * ratio).apply("Sqrt")

    outside, away, r = beyond(domain_radius)
    width = outer_radius - domain_radius
    t = share(r, domain_radius, width)
    t2 = t * t
    t3 = t2 * t
    psi = (t + t3 * -1.0 + (t2 * t2) * 0.5) * width + domain_radius
    psi1 = t2 * -3.0 + t3 * 2.0 + 1.0
    ratio = psi / r
    # The allowance times a smoothstep from the target's radius to the domain's, and its gradient.
    _, near, distance = beyond(target_radius)
    breadth = domain_radius - target_radius
    s = share(distance, target_radius, breadth)
    s2 = s * s
    lowered = (s2 * s) * (s * -15.0 + s2 * 6.0 + 10.0) * allowance
    bell = s * (s * -1.0 + 1.0)
    lowered_slope = (bell * bell) * (allowance * 30.0 / breadth) * (near / distance)

    inside = outside.apply("Where", away * ratio + centre, points)
    sweeps = _sweeps(((inside - centre) / scale).cast(field.layers.weights[0].dtype), field)
    value, gradient = (of.cast(np.float64) for of in sweeps)
    added = outside.apply("Where", rise(r) - rise(psi), 0.0)
    u = away / r
    radial = gradient.dot(u)
    across = ratio * (gradient - radial * u)
    along = (psi1 * radial + (rise_slope(r) - rise_slope(psi) * psi1)) * u
    continued = outside.apply("Where", across + along, gradient)
    return value * scale + added - lowered, continued - lowered_slope


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
        raise ExchangeError("--to onnx: needs onnxruntime; pip install 'keepout-gnc[export]'") from None
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
