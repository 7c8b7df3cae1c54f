"""Training profiles, the numbers of a fit by name; and what a fit minimises: Keepout's loss, and the paper's twice.

A loss that depends on a network's value f and gradient ∇f has its reverse derivative written out. With s_l = σ'(z_l),
z̄_l = ∂f/∂z_l and ẋ = ∂loss/∂(∇f), the loss's derivative with respect to the weights is that of (∂loss/∂f) f + ẋ·∇f
with ẋ held, and ẋ·∇f is the derivative of f along ẋ: one sweep of tangents forward, and one back. JAX's own reverse of
the reverse does as many products of matrices, and goes over the activations more often.
"""

import dataclasses
import math
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float32, Int

from keepout.core.errors import FieldError
from keepout.core.fields import neural
from keepout.core.fields.continuation import Vectors
from keepout.core.fields.neural import Kept, Layers, sweeps, times

Number = float | Float32[Array, ""]
LARGE_TARGET = 20.0
"""Metres. A target whose bounding ball is larger gets the profile's numbers for large targets, where it has any."""
BEYOND_CONTACT = 0.7
"""Metres that the near field reaches beyond where a chaser touches."""
ROUND = 50
"""Steps in one compiled loop, and between searches for counter-examples in the last phase."""
SHARES = 8
"""Parts of a step's points, of which some are learned with their gradient and the others without."""


@dataclasses.dataclass(frozen=True)
class TrainingProfile:
    """The numbers of a fit.

    Attributes:
        loss: "keepout": pinball on the distance, weighted towards the surface, and exact gradients where one surface
            decides.
            "paper_pinball": the paper's loss with L_P read as κ max(e, 0) + max(-e, 0), e = f̃ - d. "paper_printed":
            L_P = (κ-1) max(e, 0) as printed, whose minimum is f̃ → -∞.
        width, depth: hidden layers.
        start: of the weights: "he" (He et al. 2015); "surface", the same, but that the first layer's neurons bend at
            points of the surface and their weights are of many sizes; or "geometric" (Atzmon, Lipman 2020): about the
            distance to half the unit ball, as the method has it that the paper builds on.
        first_scale: of the first layer's weights, over He's: the larger, the finer is what a network begins with.
        beta: sharpness of the softplus, in normalised units.
        samples: labelled points.
        batch: points a step.
        steps: of the main phase.
        tuning_steps: of the counter-example phase.
        polish_steps: of the phase that follows, at a small rate: it takes narrow spikes away, on which the error bound
            stands.
        polish_round: steps after each of which that phase searches for new counter-examples.
        worst: over-statements of each kind that a round of hunting keeps; a tenth may be peaks that count five times.
        webs: worst under-statements of the near field that a round of the counter-example phase keeps. Without them
            webs grow in the corners between panels; with as many as of the over-statements the surface suffers.
        near: metres; errors count in proportion to near/(|g| + near), g the signed distance, so that the surface
            matters most and the far field is not lost (keepout loss).
        spread: metres; distances from the surface between which samples are drawn evenly in the logarithm; at most 0.6
            of the target's radius.
        room_share: share of the samples that are spread over the room next to the surface (`samples.room_points`);
            the rest has few in gaps that are wide, and small beside the target.
        optimizer: "adam" (Kingma, Ba 2015), or "muon" (Jordan et al. 2024): momentum made orthogonal for the hidden
            matrices, Adam for the rest.
        learning_rate: of Adam, at the start.
        adam_b2: Adam's decay of the second moment.
        muon_rate: of the hidden matrices under Muon, at the start.
        halving: steps after which the learning rate halves; 0: cosine decay over the phase.
        over_weight: weight of over-statement against under-statement, 0.5 to 1, in the near field (keepout loss).
        far_over_weight: the same beyond the near field, where over-statement costs no safety.
        near_field: metres from the surface up to which over-statement is held and hunted; `for_chaser` extends it.
        squared_below: metres, above 0, until the last phase and in it; a distance error below it counts by its square,
            so that what is nearly right does not tug at what is wrong, all others by their amount (keepout loss). A
            satellite would lose more of its bound by it than its mean error gains.
        gradient_weight: of the gradient term (keepout), or η of the eikonal term (paper).
        kappa: κ of the paper's loss.
        large: the numbers for a target larger than `LARGE_TARGET`; None: the same.

    """

    loss: Literal["keepout", "paper_pinball", "paper_printed"] = "keepout"
    width: int = 96
    depth: int = 4
    start: Literal["he", "surface", "geometric"] = "he"
    first_scale: float = 1.84
    beta: float = 100.0
    samples: int = 300_000
    batch: int = 1536
    steps: int = 2_500
    tuning_steps: int = 1_250
    polish_steps: int = 300
    polish_round: int = ROUND
    worst: int = 1_500
    webs: int = 500
    near: float = 0.2
    spread: tuple[float, float] = (0.005, 100.0)
    room_share: float = 0.45
    optimizer: Literal["adam", "muon"] = "muon"
    learning_rate: float = 5e-3
    adam_b2: float = 0.99
    muon_rate: float = 0.01
    halving: int = 0
    over_weight: float = 0.8
    far_over_weight: float = 0.8
    near_field: float = 1.2
    squared_below: tuple[float, float] = (1e-6, 1e-6)
    gradient_weight: float = 0.15
    kappa: float = 2.0
    large: "TrainingProfile | None" = None

    def for_size(self, radius: float) -> "TrainingProfile":
        """Return the numbers for a target whose bounding ball has this radius, metres."""
        return self if self.large is None or radius <= LARGE_TARGET else self.large

    def with_batch(self, batch: int) -> "TrainingProfile":
        """Return the numbers with so many points a step.

        Raises:
            FieldError: not between 1 and the number of samples.

        """
        if not 1 <= batch <= self.samples:
            raise FieldError(f"batch {batch}: it must be between 1 and the profile's {self.samples} samples")
        return dataclasses.replace(self, batch=batch, large=self.large and self.large.with_batch(batch))

    def for_chaser(self, radius: float) -> "TrainingProfile":
        """Return the numbers for a chaser of this radius, metres: the near field reaches beyond where it touches."""
        return dataclasses.replace(self, near_field=max(self.near_field, radius + BEYOND_CONTACT))


_MORE = TrainingProfile(samples=600_000, batch=2048)
_STATION = dataclasses.replace(
    _MORE,
    width=160,
    depth=5,
    start="surface",
    batch=1536,
    steps=4_000,
    tuning_steps=2_750,
    webs=300,
    near=0.4,
    spread=(0.03, 10.0),
    room_share=0.25,
    over_weight=0.65,
    far_over_weight=0.5,
    squared_below=(0.1, 1e-6),
)
_FINE_STATION = dataclasses.replace(_STATION, steps=13_000, tuning_steps=9_000, polish_steps=2_000, worst=3_000)
_PAPER = TrainingProfile(
    loss="paper_pinball",
    width=512,
    depth=10,
    samples=50_000,
    batch=50_000,
    steps=10_000,
    tuning_steps=0,
    polish_steps=0,
    optimizer="adam",
    learning_rate=5e-3,
    adam_b2=0.999,
    halving=2000,
    gradient_weight=0.1,
    first_scale=math.sqrt(1.5),
    room_share=0.0,
)

PROFILES: dict[str, TrainingProfile] = {
    "default": TrainingProfile(large=_STATION),
    "fine": dataclasses.replace(_MORE, steps=8_000, tuning_steps=4_000, large=_FINE_STATION),
    "quick": TrainingProfile(width=48, depth=3, samples=60_000, steps=1000, tuning_steps=250),
    "paper": _PAPER,
    "paper_printed": dataclasses.replace(_PAPER, loss="paper_printed"),
}


def find_profile(profile: str | TrainingProfile) -> TrainingProfile:
    """Return a profile by name; a `TrainingProfile` is returned as it is.

    Raises:
        FieldError: no profile of that name.

    """
    if isinstance(profile, TrainingProfile):
        return profile
    if profile not in PROFILES:
        raise FieldError(f"profile {profile!r}: there is none of that name; choose from {', '.join(PROFILES)}")
    return PROFILES[profile]


class Batch(NamedTuple):
    """Labelled points in normalised coordinates; see `Samples` for the labels.

    `weight` says how much the distance error of the point counts (Keepout's loss).
    """

    x: Float32[Array, "n 3"]
    distance: Float32[Array, "n"]
    gradient: Float32[Array, "n 3"]
    smooth: Bool[Array, "n"]
    hidden: Bool[Array, "n"]
    weight: Float32[Array, "n"]


class Parted(NamedTuple):
    """Labelled points, first those of which value and gradient are learned, then those of the value only, at half work.

    What follows the `known` points fills up: whichever mesh they are of, their arrays have one shape, and a step is
    one program.
    """

    points: Batch
    sloped: Int[Array, ""]
    known: Int[Array, ""]

    @classmethod
    def by(cls, profile: TrainingProfile, data: Batch) -> "Parted":
        """Part points as the profile's loss takes them: the paper's asks every point for a gradient."""
        sloped = np.asarray(data.smooth) | (profile.loss != "keepout")
        count = len(sloped)
        spare = max(profile.samples - count, 0) if profile.batch < count else 0
        order = np.concatenate([np.flatnonzero(sloped), np.flatnonzero(~sloped), np.zeros(spare, np.int64)])
        points = Batch(*(jnp.asarray(np.asarray(column)[order]) for column in data))
        return cls(points, jnp.asarray(sloped.sum()), jnp.asarray(count))

    def rows(self, easy: int) -> int:
        """Say how many of a step's points have a gradient: their share of all, to a step of `SHARES` of the points.

        The share itself is a weight; so few numbers are so few programs for all meshes.
        """
        sloped, count = int(self.sloped), int(self.known)
        if sloped in (0, count):
            return easy if sloped else 0
        step = math.ceil(easy / SHARES)
        return int(np.clip(step * round(easy * sloped / count / step), step, easy - step))


def keepout_terms(
    layers: Layers, profile: TrainingProfile, scale: Number, batch: Batch, sloped: int, bend: Number
) -> tuple[Float32[Array, "n"], Float32[Array, "{sloped}"]]:
    """For each point: the weighted pinball of the distance error; for the first ones, the squared gradient error.

    Where the point is hidden, only over-statement counts. An error e below b = `bend`, metres, counts as e²/(2b), and
    one above as e - b/2 (Huber 1964).
    """
    y, gradient = value_and_gradient(layers, profile.beta, batch.x[:sloped])
    y = jnp.concatenate([y, neural.value(layers, profile.beta, batch.x[sloped:])])
    e = y * jnp.float32(scale) - batch.distance
    size = optax.losses.huber_loss(e, delta=bend) / bend
    tau = jnp.where(batch.distance < profile.near_field, profile.over_weight, profile.far_over_weight)
    value_term = batch.weight * jnp.where(e > 0.0, tau, jnp.where(batch.hidden, 0.0, 1.0 - tau)) * size
    first = Batch(*(column[:sloped] for column in batch))
    difference = jnp.sum((gradient - first.gradient) ** 2, axis=-1)
    slope_term = jnp.float32(profile.gradient_weight) * first.smooth * difference / (1 + jnp.abs(first.distance))
    return value_term, slope_term


def paper_terms(
    layers: Layers, profile: TrainingProfile, scale: Number, batch: Batch
) -> tuple[Float32[Array, "n"], Float32[Array, "n"]]:
    """For each point: L_P and η L_E, after Zhou et al. Section IV, in normalised units.

    L_E = (‖∇f̃‖ - 1)². The printed L_P = (κ-1) max(e, 0) leaves f̃ → -∞ free; the pinball reading is
    ((κ-1)/2) e + ((κ+1)/2)|e| = κ max(e, 0) + max(-e, 0).
    """
    y, gradient = value_and_gradient(layers, profile.beta, batch.x)
    e = y - batch.distance / jnp.float32(scale)
    if profile.loss == "paper_printed":
        value_term = (profile.kappa - 1) * jnp.maximum(e, 0.0)
    else:
        value_term = profile.kappa * jnp.maximum(e, 0.0) + jnp.maximum(-e, 0.0)
    norm = jnp.sqrt(jnp.sum(gradient * gradient, axis=-1) + jnp.float32(1e-12))
    return value_term, jnp.float32(profile.gradient_weight) * (norm - 1) ** 2


def terms(
    layers: Layers, profile: TrainingProfile, scale: Number, batch: Batch, sloped: int, bend: Number = 1e-6
) -> tuple[Float32[Array, "n"], Float32[Array, "{sloped}"]]:
    """Return the two terms of the profile's loss: at each point, and at the first ones, which have a gradient term."""
    if profile.loss == "keepout":
        return keepout_terms(layers, profile, scale, batch, sloped, bend)
    return paper_terms(layers, profile, scale, batch)


value_and_gradient = jax.custom_vjp(neural.value_and_gradient, nondiff_argnums=(1,))
"""`neural.value_and_gradient`, whose own derivative is with respect to the layers, not to x."""


def _forward(layers: Layers, beta: float, x: Vectors) -> tuple[tuple[Array, Array], tuple[Layers, Kept]]:
    answer, kept = sweeps(layers, beta, x)
    return answer, (layers, kept)


def _reverse(beta: float, forward: tuple[Layers, Kept], seeds: tuple[Array, Array]) -> tuple[Layers, None]:
    layers, (activations, slopes, z_bars) = forward
    seed, along = seeds
    tangents, moved = [along], []
    for W, slope in zip(layers.weights[:-1], slopes):
        moved.append(times(tangents[-1], W.T))
        tangents.append(slope * moved[-1])
    weights = [(times(seed[None], activations[-1]) + jnp.sum(tangents[-1], axis=0))]
    biases = [jnp.sum(seed)[None]]
    a_bar = seed[:, None] * layers.weights[-1]
    for depth in range(len(slopes) - 1, -1, -1):
        slope, z_bar = slopes[depth], z_bars[depth]
        # σ'' = β s (1 - s).
        whole = a_bar * slope + beta * (1.0 - slope) * z_bar * moved[depth]
        weights.append(times(whole.T, activations[depth]) + times(z_bar.T, tangents[depth]))
        biases.append(jnp.sum(whole, axis=0))
        a_bar = times(whole, layers.weights[depth])
    return Layers(tuple(reversed(weights)), tuple(reversed(biases))), None


value_and_gradient.defvjp(_forward, _reverse)
