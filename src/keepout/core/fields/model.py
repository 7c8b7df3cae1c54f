"""A field with its papers: what it was made from, how, and what was proved of it; and the file that holds them."""

import dataclasses
import itertools
import json
import sys
import time
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import safetensors.numpy

from keepout.core.errors import FieldError
from keepout.core.fields.continuation import RadialContinuation
from keepout.core.fields.field import Field
from keepout.core.fields.grid import STORED, GridField
from keepout.core.fields.neural import Layers, NeuralField
from keepout.core.geometry.target import Target
from keepout.core.kept import digest
from keepout.core.motion.arrays import as_float64
from keepout.core.plug_ins import load
from keepout.core.whole_file import write_whole

FORMAT = "keepout-field"
VERSION = 1
STORED_TYPES = ("F32", "F64", "I32")
"""Number types of a file's tensors, as safetensors names them."""
NETWORK_TYPES = ("float32", "float64")
"""Float types of a network: the certificate knows the rounding of these alone."""
_RADIUS_TOLERANCE = 1e-9
_MOST = sys.float_info.max


CertificateKind = Literal["certified", "sampled"]


@dataclasses.dataclass(frozen=True)
class Certificate:
    """An upper bound of f̃ where the chaser touches, for one target, one field and one chaser radius.

    Attributes:
        kind: "certified" when `error_bound` is proved (docs/certificate.md); "sampled" when it is a largest sampled
            value plus a stated allowance, which proves nothing.
        chaser_radius: R, metres.
        error_bound: e_h(R), metres: f̃ ≤ R + e_h wherever the exact distance to the triangles is R. May be negative.
        allowance: metres added to the sampled maximum; zero for a certified bound.
        sampled_maximum: the largest f̃ - R found by search on that surface, metres: how much of the bound is slack.
        gradient_bound: a bound of ‖∇f̃‖ wherever d ≥ R (the Lipschitz number of the guard).
        gradient_kind: "certified" when that is proved; "sampled" when it is the largest found plus a stated allowance.
        evaluation_error: metres. Neural: the part of the bound that covers evaluation in the network's float type, on
            that surface. Grid: f̃ as evaluated is within this of a function with that gradient bound, everywhere.
        seconds: wall-clock time it took.
        target_sha256: digest of the triangles.
        field_sha256: digest of the field.
        gradient_found: the largest ‖∇f̃‖ found by search; None in files from before it was recorded.

    """

    kind: CertificateKind
    chaser_radius: float
    error_bound: float
    allowance: float
    sampled_maximum: float
    gradient_bound: float
    gradient_kind: CertificateKind
    evaluation_error: float
    seconds: float
    target_sha256: str
    field_sha256: str
    gradient_found: float | None = None

    def __post_init__(self) -> None:
        """Refuse what bounds nothing, or contradicts itself."""
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if entry.name.endswith("kind"):
                if value not in ("certified", "sampled"):
                    raise FieldError(f"certificate: {entry.name} is {value!r}; it must be 'certified' or 'sampled'")
            elif entry.name.endswith("sha256"):
                if not isinstance(value, str):
                    raise FieldError(f"certificate: {entry.name} is {value!r}; it must be text")
            elif value is None and entry.name == "gradient_found":
                continue
            elif isinstance(value, bool) or not isinstance(value, int | float) or not -_MOST < value < _MOST:
                raise FieldError(f"certificate: {entry.name} is {str(value)[:40]}; it must be a finite number")
        for name in ("chaser_radius", "allowance", "gradient_bound", "evaluation_error", "seconds"):
            if getattr(self, name) < 0.0:
                raise FieldError(f"certificate: {name} is {getattr(self, name)}; it must be at least 0")
        if self.kind == "certified" and self.allowance != 0.0:
            raise FieldError(f"certificate: allowance is {self.allowance} m and kind 'certified'; it must be 0 there")
        for bound, found in (("error_bound", "sampled_maximum"), ("gradient_bound", "gradient_found")):
            most, least = getattr(self, bound), getattr(self, found)
            if least is not None and most < least:
                said = f"{bound} is {most} and {found} {least}"
                raise FieldError(f"certificate: {said}; a bound is at least what was found")

    def _repr_html_(self) -> str:
        return load("notebook", "certificate")(self)


@dataclasses.dataclass(frozen=True)
class FieldModel:
    """A field, the target it was made for, its training record and its certificates.

    Attributes:
        field: `NeuralField` or `GridField`.
        target_name: for messages.
        target_sha256: digest of the target's triangles.
        offset: δ in metres: the field approximates the signed distance to the offset solid.
        training: plain JSON values: profile, seed, seconds, losses.
        certificates: at most one for each chaser radius.

    """

    field: Field
    target_name: str
    target_sha256: str
    offset: float
    training: dict[str, Any]
    certificates: tuple[Certificate, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a field of which nothing could be proved (`require_admissible`), and two certificates for a radius."""
        require_admissible(self.field)
        radii = sorted(certificate.chaser_radius for certificate in self.certificates)
        for radius, following in itertools.pairwise(radii):
            if following - radius <= _RADIUS_TOLERANCE:
                raise FieldError(f"certificates: two are for the chaser radius {radius:g} m; one is valid")

    @property
    def sha256(self) -> str:
        """Digest of the field's numbers and what they were made for, without certificates and training record."""
        tensors, description = _take_apart(self.field)
        return _digest(tensors, {"field": description, "target": self.target_sha256, "offset": self.offset})

    def certificate(self, chaser_radius: float) -> Certificate:
        """Return the certificate for a chaser radius.

        Args:
            chaser_radius: R, m.

        Raises:
            FieldError: there is none for that radius, or it belongs to another field or target.

        """
        for certificate in self.certificates:
            if abs(certificate.chaser_radius - chaser_radius) <= _RADIUS_TOLERANCE:
                return certificate
        have = ", ".join(f"{c.chaser_radius:g} m" for c in self.certificates) or "none"
        raise FieldError(
            f"chaser radius {chaser_radius:g} m: the field of {self.target_name} is certified for: {have}; "
            f"`keepout certify --chaser-radius {chaser_radius:g}` adds a certificate"
        )

    def with_certificate(self, certificate: Certificate) -> "FieldModel":
        """Return the same model with one more certificate, which replaces one for the same radius.

        Args:
            certificate: of this field and target.

        """
        others = [c for c in self.certificates if abs(c.chaser_radius - certificate.chaser_radius) > _RADIUS_TOLERANCE]
        ordered = sorted([*others, certificate], key=lambda c: c.chaser_radius)
        return dataclasses.replace(self, certificates=tuple(ordered))

    def certified(self, kind: CertificateKind, chaser_radius: float, start: float, **numbers: Any) -> "FieldModel":
        """Return the same model with one more certificate of its field and target.

        Args:
            kind: of the certificate.
            chaser_radius: metres.
            start: when the proof or the search began, s of `time.perf_counter`.
            numbers: the certificate's others.

        """
        return self.with_certificate(
            Certificate(
                kind=kind,
                chaser_radius=float(chaser_radius),
                seconds=time.perf_counter() - start,
                target_sha256=self.target_sha256,
                field_sha256=self.sha256,
                **numbers,
            )
        )

    def require_target(self, target: Target, *, where: str) -> None:
        """Refuse a target that is not the one that the field was made for.

        Args:
            target: that is meant.
            where: what the message begins with.

        Raises:
            FieldError: the triangles are others.

        """
        if target.sha256 != self.target_sha256:
            raise FieldError(
                f"{where}: the field was made for {self.target_name} ({self.target_sha256[:12]}), not for "
                f"{target.name} ({target.sha256[:12]}); other parameters, units or parts make another target, so fit "
                "and certify again"
            )

    def with_training(self, **entries: Any) -> "FieldModel":
        """Return the same model with more entries (plain JSON values) in its training record.

        Args:
            **entries: by name.

        """
        return dataclasses.replace(self, training={**self.training, **entries})

    def save(self, path: str | Path) -> None:
        """Write the `.keepout` file, whole or not at all.

        Args:
            path: of the file.

        Raises:
            FieldError: the file cannot be written.

        """
        path = Path(path)
        if not path.absolute().parent.is_dir():
            raise FieldError(f"{path}: cannot be written: the folder {path.parent} does not exist")
        tensors, description = _take_apart(self.field)
        header = {
            "version": VERSION,
            "field": description,
            "target": {"name": self.target_name, "sha256": self.target_sha256, "offset": self.offset},
            "field_sha256": self.sha256,
            "training": self.training,
            "certificates": [dataclasses.asdict(c) for c in self.certificates],
        }
        metadata = {"format": FORMAT, "header": json.dumps(header), "sha256": _digest(tensors, header)}
        try:
            content = safetensors.numpy.save(tensors, metadata)
        except safetensors.SafetensorError as error:
            raise FieldError(f"{path}: cannot be written ({error})") from None
        write_whole(path, content, refusal=FieldError)

    @classmethod
    def load(cls, path: str | Path, *, target: Target | None = None) -> "FieldModel":
        """Read a `.keepout` file, and check it against a target if one is given.

        Its certificates are believed: who made the file could write any number that does not contradict the others.
        `check_certificate` proves one again.

        Args:
            path: of the file.
            target: the mesh that it should have been made for.

        Raises:
            FieldError: missing, damaged, truncated, edited, not a field file, made for another target, or with numbers
                of which nothing can be proved (`require_admissible`).

        """
        path = Path(path)
        header, tensors = _read(path)
        try:
            model = cls(
                field=_put_together(tensors, header["field"]),
                target_name=str(header["target"]["name"]),
                target_sha256=str(header["target"]["sha256"]),
                offset=float(header["target"]["offset"]),
                training=dict(header["training"]),
                certificates=tuple(Certificate(**c) for c in header["certificates"]),
            )
        except FieldError as error:
            raise FieldError(f"{path}: {error}") from None
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise FieldError(f"{path}: the header lacks or misuses an entry ({error!r}); fit the field again") from None
        for certificate in model.certificates:
            if (certificate.field_sha256, certificate.target_sha256) != (model.sha256, model.target_sha256):
                raise FieldError(
                    f"{path}: its certificate for {certificate.chaser_radius:g} m belongs to another field or target; "
                    "certify again"
                )
        if target is not None:
            model.require_target(target, where=str(path))
        return model


def _digest(tensors: dict[str, np.ndarray], description: dict) -> str:
    named = ((f"{name} {tensors[name].dtype} {tensors[name].shape}", tensors[name]) for name in sorted(tensors))
    return digest(json.dumps(description, sort_keys=True), *itertools.chain.from_iterable(named))


def _read(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise FieldError(f"{path}: not a field file: no entry format = {FORMAT!r} in its header")
            header = json.loads(metadata["header"])
            names = list(file.keys())
            for name in names:
                stored = file.get_slice(name).get_dtype()
                if stored not in STORED_TYPES:
                    raise FieldError(f"{path}: {name} is {stored}; a field file holds {', '.join(STORED_TYPES)}")
            tensors = {name: file.get_tensor(name) for name in names}
    except FileNotFoundError:
        raise FieldError(f"{path}: no such file; a field is a .keepout file") from None
    except FieldError:
        raise
    except (OSError, safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise FieldError(f"{path}: damaged, truncated, or not a field file ({error})") from None
    version = header.get("version") if isinstance(header, dict) else None
    if version != VERSION:
        raise FieldError(f"{path}: field format version {version}; this release reads version {VERSION}")
    if _digest(tensors, header) != metadata.get("sha256"):
        raise FieldError(f"{path}: its contents do not match its checksum: edited or damaged")
    return header, tensors


def _take_apart(field: Field) -> tuple[dict[str, np.ndarray], dict]:
    if isinstance(field, NeuralField):
        layers = zip(field.layers.weights, field.layers.biases)
        tensors = {f"{kind}{i}": np.asarray(t) for i, pair in enumerate(layers) for kind, t in zip("Wb", pair)}
        description = {
            "kind": "neural",
            "beta": field.beta,
            "scale": float(field.scale),
            "hidden_layers": len(field.layers.weights) - 1,
        }
    elif isinstance(field, GridField):
        tensors = {f"table{i}": np.asarray(table) for i, table in enumerate(field.tables)}
        tensors["coefficients"] = np.asarray(field.coefficients)
        description = {
            "kind": "grid",
            "origin": np.asarray(field.origin).tolist(),
            "spacing": float(field.spacing),
            "levels": len(field.tables),
        }
    else:
        raise FieldError(f"a {type(field).__name__} has no file form; a neural or a grid field has")
    entries = dataclasses.fields(field.continuation)
    description["continuation"] = {f.name: np.asarray(getattr(field.continuation, f.name)).tolist() for f in entries}
    return tensors, description


def _put_together(tensors: dict[str, np.ndarray], description: dict) -> Field:
    numbers = {name: as_float64(value) for name, value in description["continuation"].items()}
    continuation = RadialContinuation(**numbers)
    if description["kind"] == "grid":
        tables = tuple(jax.device_put(tensors[f"table{i}"]) for i in range(int(description["levels"])))
        origin, spacing = (as_float64(description[name]) for name in ("origin", "spacing"))
        return GridField(jax.device_put(tensors["coefficients"]), tables, origin, spacing, continuation)
    if description["kind"] != "neural":
        raise ValueError(f"field kind {description['kind']!r}")
    count = int(description["hidden_layers"]) + 1
    layers = Layers(
        tuple(jax.device_put(tensors[f"W{i}"]) for i in range(count)),
        tuple(jax.device_put(tensors[f"b{i}"]) for i in range(count)),
    )
    width = 3
    for W, b in zip(layers.weights, layers.biases):
        if W.ndim != 2 or W.shape[1] != width or b.shape != (W.shape[0],):
            raise ValueError(f"layer shapes {W.shape}, {b.shape} do not follow on width {width}")
        width = W.shape[0]
    return NeuralField(layers, as_float64(description["scale"]), continuation, float(description["beta"]))


def require_admissible(field: Field) -> None:
    """Refuse a neural or grid field that cannot be what a certificate speaks of.

    Raises:
        FieldError: a network or a grid of another float type; a number that is not finite; radii out of order; a
            negative allowance; blocks that the coefficients do not have.

    """
    if isinstance(field, NeuralField):
        _require_continuation(field.continuation)
        _require_network(field)
    elif isinstance(field, GridField):
        _require_continuation(field.continuation)
        _require_grid(field)


def _require_continuation(continuation: RadialContinuation) -> None:
    for entry in dataclasses.fields(continuation):
        array = np.asarray(getattr(continuation, entry.name))
        # Squares of float16 radii overflow: then nothing is outside, and the field is asked where it was never made.
        if array.dtype != np.float64:
            raise FieldError(f"continuation.{entry.name} is {array.dtype.name}; it must be float64")
        _require_finite(f"continuation.{entry.name}", array)
    allowance = float(continuation.allowance)
    if not allowance >= 0.0:
        raise FieldError(f"continuation.allowance is {allowance:g} m; it must be at least 0: it may only lower values")
    names = ("target_radius", "domain_radius", "outer_radius")
    radii = [float(getattr(continuation, name)) for name in names]
    if not 0.0 < radii[0] < radii[1] < radii[2]:
        told = ", ".join(f"{name} {radius:g} m" for name, radius in zip(names, radii))
        raise FieldError(f"continuation: {told}; each must be above the one before, and the first above 0")


def _require_network(field: NeuralField) -> None:
    layers = field.layers
    arrays = {
        f"{kind}{i}": np.asarray(array)
        for kind, group in (("W", layers.weights), ("b", layers.biases))
        for i, array in enumerate(group)
    }
    for name, array in arrays.items():
        if array.dtype.name not in NETWORK_TYPES:
            raise FieldError(f"network: {name} is {array.dtype.name}; a network must be float32 or float64")
    if len({array.dtype for array in arrays.values()}) > 1:
        told = ", ".join(f"{name} {array.dtype.name}" for name, array in arrays.items())
        raise FieldError(f"network: {told}; all must be of one type, float32 or float64")
    for name, array in arrays.items():
        _require_finite(f"network: {name}", array)
    domain, scale = field.continuation, float(field.scale)
    for name, value in (("scale", scale), ("beta", field.beta)):
        if not (np.isfinite(value) and value > 0.0):
            raise FieldError(f"network: {name} is {value:g}; it must be finite and above 0")
    least, most = 1e-3 * float(domain.domain_radius), 1e3 * float(domain.outer_radius)
    if not least <= scale <= most:
        # The proof's first cubes are a share of the scale: a tiny one would never end, a huge one never begin.
        raise FieldError(f"network: scale is {scale:g} m; in its domain it must be {least:g} to {most:g} m")
    held = np.finfo(layers.weights[0].dtype)
    if not float(held.tiny) <= field.beta <= float(held.max):
        raise FieldError(f"network: beta is {field.beta:g}; a {held.dtype} holds {held.tiny:g} to {held.max:g} in full")


def _require_grid(field: GridField) -> None:
    coefficients = np.asarray(field.coefficients)
    if coefficients.dtype != np.float32 or len(coefficients) % STORED**3:
        raise FieldError(
            f"grid: coefficients are {len(coefficients)} of {coefficients.dtype.name}; "
            f"they must be float32, {STORED**3} a block"
        )
    _require_finite("grid: coefficients", coefficients)
    _require_finite("grid: origin", np.asarray(field.origin))
    spacing = float(field.spacing)
    if not (np.isfinite(spacing) and spacing > 0.0):
        raise FieldError(f"grid: spacing is {spacing:g} m; it must be finite and above 0")
    blocks = len(coefficients) // STORED**3
    tables = [np.asarray(table) for table in field.tables]
    for level, table in enumerate(tables):
        if not np.issubdtype(table.dtype, np.integer) or table.min() < -1 or table.max() >= blocks:
            raise FieldError(
                f"grid: table{level} holds {table.dtype.name} from {table.min()} to {table.max()}; "
                f"they must be integers from -1 to {blocks - 1}"
            )
    for level, (fine, coarse) in enumerate(itertools.pairwise(tables)):
        if fine.shape != tuple(2 * n for n in coarse.shape):
            raise FieldError(
                f"grid: table{level} has {fine.shape} blocks, table{level + 1} {coarse.shape}; each must be half the "
                "one before"
            )


def _require_finite(name: str, array: np.ndarray) -> None:
    bad = array[~np.isfinite(array)]
    if len(bad):
        raise FieldError(f"{name}: {len(bad)} of {array.size} numbers are not finite, the first {bad[0]}; all must be")
