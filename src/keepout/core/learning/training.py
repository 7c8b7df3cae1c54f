"""Learning a field: gradient descent in three phases, the later two fed with the worst over-statements found."""

import dataclasses
import functools
import json
import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax.contrib
import safetensors.numpy
from jaxtyping import Array, Float, Float32, Int

from keepout.core.compiled.in_batches import in_chunks
from keepout.core.compiled.kept_programs import keep_programs
from keepout.core.compiled.xla import WIDE
from keepout.core.errors import FieldError
from keepout.core.fields import neural
from keepout.core.fields.continuation import Domain
from keepout.core.fields.field import in_pieces
from keepout.core.fields.model import FieldModel
from keepout.core.fields.neural import NeuralField
from keepout.core.geometry.distance import Points
from keepout.core.geometry.level_set import random_directions
from keepout.core.geometry.offset_solid import OffsetSolid
from keepout.core.geometry.target import Target
from keepout.core.kept import digest
from keepout.core.learning import losses
from keepout.core.learning.samples import Hunt, Samples, label, normalised, training_points, where_wrong
from keepout.core.learning.schedule import Ending, Pace, block_lengths, learning_rates, phase_of, settling, shortened
from keepout.core.progress import Progress, part_of, silent
from keepout.core.whole_file import write_whole

ROWS = 2048
"""Points that the network in mid-training is asked at together, float32."""
WATCHED = 4096
"""Labelled points on which the training curve follows the field's mean error."""
HARD_SHARES, HARD_WEIGHT = (0.0, 0.3, 0.5), 2.0
"""Share of a step's points, by phase, that are counter-examples, and their weight. Of them the distance is learned."""
CURVE = ("value_term", "gradient_term", "mean_error_m")
"""Columns of a training curve."""


class _State(NamedTuple):
    """All that a fit needs to go on: the same after a reload, to the bit.

    `worst` is the largest f̃ - R found where a chaser touches, metres; `curve` has after each block the loss's two
    terms, and the mean of f̃ - d over `WATCHED` samples, metres.
    """

    layers: neural.Layers
    optimizer: optax.OptState
    hard: losses.Batch
    block: Int[Array, ""]
    worst: Float32[Array, ""]
    curve: Float32[Array, "blocks 3"]


def fit(
    target: Target,
    *,
    profile: str | losses.TrainingProfile = "default",
    chaser_radius: float = 0.5,
    seed: int = 0,
    checkpoint: Path | None = None,
    solid: OffsetSolid | None = None,
    first: FieldModel | None = None,
    until_bound: float | None = None,
    at_most: float | None = None,
    progress: Progress = silent,
) -> FieldModel:
    """Learn a neural field of a target.

    What a fit reaches in a time that is `at_most` given depends on the machine: it alone is no function of seed,
    target and profile.

    Args:
        target: what to learn.
        profile: "default", "fine" (two to four times the work), "quick" (rough), "paper" or "paper_printed"; or a
            `TrainingProfile`.
        chaser_radius: metres; where a chaser of this radius touches, over-statement is hunted as it is on the surface.
        seed: the same seed, target and profile on the same machine give the same field.
        checkpoint: a file kept up to date while training and deleted at the end; if it exists, the fit goes on from it.
        solid: the target's offset solid, if already built.
        first: the field of a mesh that differs little; the fit begins with it, learns most where it is wrong, and takes
            the fewer steps, the less it is wrong.
        until_bound: m; once no over-statement above it is found, the rest of the steps is left out but for the last,
            which polish. The bound itself is `certify`'s to prove, and a few millimetres more.
        at_most: s, after which the fit ends, to a block: blocks that there is no time for are left out, evenly.
            With a bound that is not found by then it goes on polishing as long as there is time.
        progress: fraction done, and the loss terms, the worst over-statement so far, what it is expected to come to,
            and the time left.

    Raises:
        FieldError: an unknown profile, a radius that is negative or too large, a checkpoint of another fit, a loss
            that is not finite, a first field of another kind or size, or no time to learn in.

    """
    keep_programs()
    start, ending = time.perf_counter(), Ending(until_bound, at_most)
    distance = target.distance
    domain = Domain.around(distance)
    numbers = losses.find_profile(profile).for_size(domain.target_radius).for_chaser(chaser_radius)
    begun = None if first is None else layers_of(first, domain, numbers)
    numbers = numbers if begun else ending.of_profile(numbers)
    largest = domain.domain_radius - domain.target_radius
    if not 0.0 <= chaser_radius <= largest:
        raise FieldError(f"chaser radius {chaser_radius:g} m: for {target.name} it must be 0 to {largest:.3g} m")
    if solid is None:
        solid = OffsetSolid.build(distance, progress=lambda part, text: progress(0.08 * part, f"offset solid: {text}"))
    sealed = time.perf_counter()
    generator = np.random.default_rng(seed)
    progress(0.08, "labelling samples")
    count = numbers.samples // (3 if begun else 1)
    points = training_points(distance, domain, count, generator, numbers)
    samples = learned = label(solid, points, whole_depth=numbers.loss != "keepout")
    weight = numbers.near / (np.abs(samples.distance) + numbers.near)
    if begun:
        excess = Learned(begun, numbers.beta, domain).value(points) - samples.distance
        error = weight / numbers.near * np.where(samples.hidden, np.maximum(excess, 0.0), np.abs(excess))
        drawn = where_wrong(error, numbers.samples, generator)
        learned, weight, numbers = samples.picked(drawn), weight[drawn], shortened(numbers, error.mean())
    hunt = None
    if numbers.tuning_steps or numbers.polish_steps:
        hunt = Hunt.prepare(solid, domain, chaser_radius, numbers, samples)
    data = normalised(learned, domain, weight)
    seconds = {"solid": sealed - start, "labels": time.perf_counter() - sealed, "hunts": 0.0, "steps": 0.0}
    pace = Pace(numbers, ending, start)
    if pace.time_left <= 0.0:
        prepared = time.perf_counter() - start
        raise FieldError(f"at_most: {at_most:g} s; to prepare took {prepared:.0f} s, and nothing is left to learn in")
    course = _Course(numbers, domain, hunt, losses.Parted.by(numbers, data), _watched(samples), seed, seconds, pace)

    entries = [target.sha256, solid.offset, solid.closing_radius, dataclasses.asdict(numbers), chaser_radius, seed]
    entries.append(first and first.sha256)
    kept = None if checkpoint is None else _Checkpoint(checkpoint, digest(json.dumps(entries)))
    initial = _initial(numbers, data, hunt.kept if hunt else 0, seed)
    initial = initial._replace(layers=begun or initial.layers)
    state = course.taken(initial, kept, target.name, part_of(progress, 0.1, 0.99))
    field = _finished(Learned(state.layers, numbers.beta, domain), solid, generator)
    name = profile if isinstance(profile, str) else "custom"
    training = course.record(state, name, chaser_radius, solid.closing_radius)
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    progress(1.0, "done")
    return FieldModel(field, target.name, target.sha256, solid.offset, training)


@dataclasses.dataclass(frozen=True)
class _Course:
    """What the blocks of a fit have in common, the seconds of its parts so far, and what comes next."""

    numbers: losses.TrainingProfile
    domain: Domain
    hunt: Hunt | None
    examples: losses.Parted
    watched: Samples
    seed: int
    seconds: dict[str, float]
    pace: Pace

    def taken(self, state: _State, checkpoint: "_Checkpoint | None", name: str, progress: Progress) -> _State:
        """Take all blocks from a state, or from a checkpoint, which is kept up to date; `name` is the target's.

        Raises:
            FieldError: a loss that is not finite, or a checkpoint that is damaged or of another fit.

        """
        if checkpoint is not None and checkpoint.path.exists():
            state = checkpoint.load(state)
        numbers, pace, place = self.numbers, self.pace, int(state.block)
        before = place - 1
        while place < pace.blocks:
            begun = time.perf_counter()
            state = self.hunted(state, place)
            found_at = time.perf_counter()
            pace.found(float(state.worst), place)
            if place == 0 or phase_of(numbers, place) != phase_of(numbers, before):
                state = state._replace(optimizer=_optimizer(numbers).init(state.layers))
            state = self.trained(state, place)
            value_term, slope_term, _ = (float(number) for number in state.curve[place])
            if not math.isfinite(value_term):
                reached = sum(block_lengths(numbers)[: place + 1])
                raise FieldError(f"training of {name}: the loss is not finite at step {reached}")
            self.seconds["hunts"] += found_at - begun
            self.seconds["steps"] += time.perf_counter() - found_at
            pace.took(place, found_at - begun, time.perf_counter() - found_at)
            if place == pace.blocks - 1 and pace.ending.until_bound is not None:
                pace.found(float(self.hunted(state, place + 1).worst), place)
            before, place = place, pace.onward(place)
            state = state._replace(block=jnp.asarray(place, state.block.dtype))
            if checkpoint is not None:
                checkpoint.save(state)
            told = f"distance {value_term:.4f}, gradient {slope_term:.4f}{pace.told(before, place)}"
            progress(pace.share(before), told)
        return state

    def hunted(self, state: _State, block: int) -> _State:
        """Renew, but for the first phase, the counter-examples: what the network is most wrong at now."""
        numbers, domain = self.numbers, self.domain
        if self.hunt is None or phase_of(numbers, block) == 0:
            return state
        known = np.asarray(state.hard.x, np.float64) * domain.learned_radius + domain.centre
        learner, generator = Learned(state.layers, numbers.beta, domain), np.random.default_rng((self.seed, block))
        fresh, worst = self.hunt.worst(learner, known, generator, settling=settling(numbers, block))
        hard = jax.tree.map(lambda new, old: jnp.concatenate([new, old])[: len(old)], fresh, state.hard)
        return state._replace(hard=hard, worst=jnp.asarray(worst, jnp.float32))

    def trained(self, state: _State, block: int) -> _State:
        """Take the steps of one block."""
        numbers, domain = self.numbers, self.domain
        whole_key, rates = jax.random.fold_in(jax.random.key(self.seed), block), learning_rates(numbers, block)
        batch, phase = min(numbers.batch, int(self.examples.known)), phase_of(numbers, block)
        hard = round(HARD_SHARES[phase] * batch)
        # Of all points none is drawn, and each is as it is.
        drawn = hard or batch < int(self.examples.known)
        sloped = self.examples.rows(batch - hard) if drawn else int(self.examples.sloped)
        scale, bend = map(jnp.float32, (domain.learned_radius, numbers.squared_below[phase // 2]))
        terms, layers, optimizer = [], state.layers, state.optimizer
        for n in range(0, len(rates), losses.ROUND):
            state = state._replace(layers=layers, optimizer=optimizer)
            key, now = jax.random.fold_in(whole_key, n), rates[n : n + losses.ROUND]
            layers, optimizer, *means = _train_round(numbers, hard, sloped, state, self.examples, scale, bend, key, now)
            terms.append(means)
        value_term, slope_term = (jnp.stack(means).mean() for means in zip(*terms))
        learned = Learned(layers, numbers.beta, domain)
        offset = learned.value(self.watched.points.astype(np.float64)) - self.watched.distance
        reached = jnp.stack([value_term, slope_term, jnp.asarray(offset.mean(), jnp.float32)])
        return state._replace(layers=layers, optimizer=optimizer, curve=state.curve.at[block].set(reached))

    def record(self, state: _State, profile: str, chaser_radius: float, closing_radius: float) -> dict[str, Any]:
        """Give plain values for JSON: how a field was learned, and the loss's terms after each block that was taken."""
        curve = np.asarray(state.curve, np.float64)
        taken = np.isfinite(curve[:, 0])
        return {
            "profile": profile,
            "numbers": dataclasses.asdict(self.numbers),
            "chaser_radius": chaser_radius,
            "seed": self.seed,
            "sloped_share": int(self.examples.sloped) / int(self.examples.known),
            "seconds": time.perf_counter() - self.pace.begun,
            "seconds_of": self.seconds,
            "ended": self.pace.ended,
            "closing_radius": closing_radius,
            "curve": {
                "steps": np.cumsum(np.array(block_lengths(self.numbers))[taken]).tolist(),
                **{name: column[taken].tolist() for name, column in zip(CURVE, curve.T)},
            },
            "jax": jax.__version__,
            "device": jax.devices()[0].platform,
        }


def _initial(profile: losses.TrainingProfile, data: losses.Batch, hard_count: int, seed: int) -> _State:
    """He-scaled weights (He et al. 2015); first-layer kinks spread over the unit ball; the output starts positive.

    Or the kinks go through some of the tenth of the points that is nearest to the surface, each a third to three times
    as sharp. Or the network starts as the distance to half the unit ball (Atzmon, Lipman 2020, section 4).
    """
    width, depth = profile.width, profile.depth
    sizes = [3] + [width] * depth + [1]
    keys = jax.random.split(jax.random.key(seed), depth + 2)
    weights = [
        jax.random.normal(key, (n_out, n_in), jnp.float32) * jnp.float32(math.sqrt(2.0 / n_in))
        for key, n_in, n_out in zip(keys, sizes[:-1], sizes[1:])
    ]
    biases = [jnp.zeros(n, jnp.float32) for n in sizes[1:]]
    if profile.start == "geometric":
        weights[0] = weights[0] * jnp.float32(math.sqrt(3.0 / width))
        weights[-1] = jnp.full((1, width), math.sqrt(math.pi / width), jnp.float32)
        biases[-1] = jnp.full(1, -0.5, jnp.float32)
    else:
        weights[0] = weights[0] * jnp.float32(profile.first_scale)
        weights[-1] = weights[-1] * jnp.float32(0.5)
        biases[0] = jax.random.uniform(keys[-1], (width,), jnp.float32, -0.5, 0.5)
        if profile.start == "surface":
            sharpness, places = jax.random.split(keys[-1])
            weights[0] = weights[0] * jnp.exp(jax.random.uniform(sharpness, (width, 1), jnp.float32, -1.0, 1.0))
            nearest = np.argsort(np.where(data.hidden, np.inf, np.abs(data.distance)))[: max(len(data.x) // 10, width)]
            biases[0] = -jnp.sum(weights[0] * data.x[jax.random.choice(places, nearest, (width,))], axis=1)
    layers = neural.Layers(tuple(weights), tuple(biases))
    hard = jax.tree.map(lambda a: jnp.resize(a, (hard_count, *a.shape[1:])), data)
    optimizer = _optimizer(profile).init(layers)
    curve = jnp.full((len(block_lengths(profile)), len(CURVE)), jnp.nan, jnp.float32)
    return _State(layers, optimizer, hard, jnp.asarray(0, jnp.int32), jnp.asarray(jnp.inf, jnp.float32), curve)


def layers_of(model: FieldModel, domain: Domain, numbers: losses.TrainingProfile) -> neural.Layers:
    """Give another field's network in the normalised coordinates of a domain: the same function of a place in metres.

    Raises:
        FieldError: the field is no network, or not one of these numbers.

    """
    field = model.field
    if not isinstance(field, NeuralField):
        raise FieldError(f"first: the field of {model.target_name} is no network; a fit goes on from a learned field")
    weights, biases = (list(map(np.asarray, part)) for part in field.layers)
    found = len(weights) - 1, len(weights[0]), field.beta
    asked = numbers.depth, numbers.width, numbers.beta
    if found != asked:
        said = ["{} layers of {}, sharpness {:g}".format(*shape) for shape in (found, asked)]
        raise FieldError(f"first: the field of {model.target_name} has {said[0]}; the profile asks for {said[1]}")
    scale = float(field.scale)
    moved = (domain.centre - np.asarray(field.continuation.centre)) / scale
    biases[0] = biases[0] + weights[0] @ moved
    weights[0] = weights[0] * (domain.learned_radius / scale)
    weights[-1], biases[-1] = (part * (scale / domain.learned_radius) for part in (weights[-1], biases[-1]))
    return neural.Layers(*(tuple(jnp.asarray(part, jnp.float32) for part in parts) for parts in (weights, biases)))


def _watched(samples: Samples) -> Samples:
    """Give the samples on which the training curve follows the field: evenly picked, of those with a label."""
    labelled = np.flatnonzero(~samples.hidden)
    picked = labelled[np.linspace(0, len(labelled) - 1, min(WATCHED, len(labelled))).astype(int)]
    return samples.picked(picked)


def _optimizer(profile: losses.TrainingProfile) -> optax.GradientTransformation:
    """Make the profile's optimiser, at its learning rates; `learning_rates` says by how much of them a step moves."""
    if profile.optimizer == "adam":
        return optax.adam(profile.learning_rate, b2=profile.adam_b2)
    return optax.contrib.muon(
        profile.muon_rate,
        adam_learning_rate=profile.learning_rate,
        adam_b2=profile.adam_b2,
        muon_weight_dimension_numbers=_hidden_matrices,  # pyright: ignore[reportArgumentType]
    )


def _hidden_matrices(layers: Any) -> Any:
    """Muon is for matrices between hidden layers; the first and the last are coordinates and one output."""
    hidden: Any = (optax.contrib.MuonDimensionNumbers(),) * (len(layers.weights) - 2)
    return layers._replace(weights=(None, *hidden, None), biases=(None,) * len(layers.biases))


@functools.partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=WIDE)
def _train_round(
    profile: losses.TrainingProfile,
    hard: int,
    sloped: int,
    state: _State,
    data: losses.Parted,
    scale: Float32[Array, ""],
    bend: Float32[Array, ""],
    key: Array,
    rates: Float32[Array, "steps"],
):
    """Take a step for each of the rates, in one compiled loop.

    A step's points are `sloped` points with a gradient, others without, and `hard` counter-examples. Those of the
    former two kinds count as if they were drawn in the shares in which there are some. Errors below `bend`, metres,
    count by their square (`losses.keepout_terms`).
    """
    optimizer = _optimizer(profile)
    batch = min(profile.batch, len(data.points.x))
    easy = batch - hard
    kind = jnp.arange(easy) < sloped
    start, end = jnp.where(kind, 0, data.sloped), jnp.where(kind, data.sloped, data.known)
    weight = easy / data.known * (end - start) / jnp.where(kind, sloped, easy - sloped)
    weight = jnp.concatenate([weight, jnp.full(hard, HARD_WEIGHT)]).astype(jnp.float32)

    def loss(layers: neural.Layers, rows: losses.Batch):
        value_term, slope_term = losses.terms(layers, profile, scale, rows, sloped, bend)
        value_mean, slope_mean = jnp.mean(weight * value_term), jnp.sum(weight[:sloped] * slope_term) / batch
        return value_mean + slope_mean, (value_mean, slope_mean)

    def step(carry, now):
        (layers, optimizer_state), (step_key, rate) = carry, now
        rows = data.points
        if hard or batch < len(data.points.x):
            keys = jax.random.split(step_key)
            drawn = jax.random.randint(keys[0], (easy,), start, end)
            again = jax.random.randint(keys[1], (hard,), 0, max(len(state.hard.x), 1))
            rows = losses.Batch(*(jnp.concatenate([a[drawn], b[again]]) for a, b in zip(data.points, state.hard)))
        (_, means), gradient = jax.value_and_grad(loss, has_aux=True)(layers, rows)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state, layers)
        updates = jax.tree.map(lambda update: rate * update, updates)
        return (optax.apply_updates(layers, updates), optimizer_state), means

    each = jax.random.split(key, len(rates)), rates
    (layers, optimizer_state), (value_term, slope_term) = jax.lax.scan(step, (state.layers, state.optimizer), each)
    return layers, optimizer_state, value_term.mean(), slope_term.mean()


def _finished(learned: "Learned", solid: OffsetSolid, generator: np.random.Generator) -> NeuralField:
    """Give the field its continuation, lowered by what it over-states on the shell it continues from."""
    domain = learned.domain
    direction = random_directions(generator, 40_000)
    radius = generator.uniform(domain.domain_radius, domain.learned_radius, size=(len(direction), 1))
    shell = domain.centre + radius * direction
    excess = learned.value(shell) - solid.signed_distance(shell)
    # A quarter above the largest of 40,000 samples of a smooth far field; `certify` does not rest on it.
    continuation = domain.continuation(1.25 * max(float(excess.max()), 0.0) + 0.01)
    return NeuralField(learned.layers, jnp.asarray(domain.learned_radius, jnp.float64), continuation, learned.beta)


@dataclasses.dataclass(frozen=True)
class Learned:
    """A network in normalised coordinates, asked in metres, without continuation.

    Attributes:
        layers: its weights.
        beta: sharpness of the softplus.
        domain: of the field.

    """

    layers: neural.Layers
    beta: float
    domain: Domain

    def value(self, points: Points) -> Float[np.ndarray, "n"]:
        """Return f̃ in metres at (n, 3) points in metres."""
        y = in_pieces(lambda x: _value(self.layers, self.beta, x), self._normalised(points))
        return y.astype(np.float64) * self.domain.learned_radius

    def gradient(self, points: Points) -> Float[np.ndarray, "n 3"]:
        """Return ∇f̃, (n, 3), at points in metres."""
        return in_pieces(lambda x: _gradient(self.layers, self.beta, x), self._normalised(points)).astype(np.float64)

    def _normalised(self, points: Points) -> Float32[np.ndarray, "n 3"]:
        return ((points - self.domain.centre) / self.domain.learned_radius).astype(np.float32)


@functools.partial(jax.jit, static_argnums=(1,), compiler_options=WIDE)
def _value(layers: neural.Layers, beta: float, x: Float32[Array, "n 3"]) -> Float32[Array, "n"]:
    return in_chunks(lambda rows: neural.value(layers, beta, rows), x, ROWS)


@functools.partial(jax.jit, static_argnums=(1,), compiler_options=WIDE)
def _gradient(layers: neural.Layers, beta: float, x: Float32[Array, "n 3"]) -> Float32[Array, "n 3"]:
    return in_chunks(lambda rows: neural.value_and_gradient(layers, beta, rows)[1], x, ROWS)


@dataclasses.dataclass(frozen=True)
class _Checkpoint:
    """The file of a fit under way, and a digest of the fit's settings, without which it does not go on."""

    path: Path
    fingerprint: str

    def save(self, state: _State) -> None:
        leaves = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        write_whole(self.path, safetensors.numpy.save(leaves, {"fingerprint": self.fingerprint}), refusal=FieldError)

    def load(self, like: _State) -> _State:
        """Read a state of the shape of another one."""
        try:
            with safetensors.safe_open(self.path, framework="numpy") as file:
                if (file.metadata() or {}).get("fingerprint") != self.fingerprint:
                    raise FieldError(
                        f"{self.path}: a checkpoint of another fit (target, profile or seed); delete it to start anew"
                    )
                leaves, structure = jax.tree.flatten(like)
                restored = [jnp.asarray(file.get_tensor(f"{i:04d}")) for i in range(len(leaves))]
        except (OSError, safetensors.SafetensorError) as error:
            raise FieldError(f"{self.path}: a damaged checkpoint ({error}); delete it to start anew") from None
        return jax.tree.unflatten(structure, restored)
