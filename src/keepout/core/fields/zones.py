"""Zones: room that stays free of the chaser whatever the mesh says, as signed distances; and a field with zones in it.

A zone's distance is exact, or says less; either way it is 1-Lipschitz. A zone that turns against the body frame, or
stands for a while only, counts from now until it ends, wherever it will be: so a field with zones says, as time goes
on, nowhere less than before, and what was found free stays free. docs/guard.md, section 9, has the proof.
"""

import abc
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from keepout.core.fields.field import Field, Hessians, Points, Values, of_places, within_numbers
from keepout.core.motion.arrays import Scalar, Vector, as_float64, norm


class Shape(eqx.Module):
    """A closed body in its own axes, whose signed distance is at most the true one and 1-Lipschitz; lengths in m."""

    @abc.abstractmethod
    def distance(self, point: Vector) -> Scalar:
        """Give a lower bound of the signed distance, m, positive outside, of a point (3,) m."""


class Sphere(Shape):
    """All within `radius` of `centre`."""

    centre: Vector = eqx.field(converter=as_float64)
    radius: Scalar = eqx.field(converter=as_float64)

    def distance(self, point: Vector) -> Scalar:
        """Exact."""
        return norm(point - self.centre) - self.radius


class Ellipsoid(Shape):
    """All with ‖(p − centre)/semi_axes‖ ≤ 1.

    Its distance is the larger of two lower bounds: k = ‖(p − centre)/a‖ changes by at most 1/min a a metre and is 1 on
    the surface, and the ball of radius max a holds the body.
    """

    centre: Vector = eqx.field(converter=as_float64)
    semi_axes: Vector = eqx.field(converter=as_float64)

    def distance(self, point: Vector) -> Scalar:
        """Give the larger of (k − 1) min a and ‖p − centre‖ − max a."""
        away, a = point - self.centre, self.semi_axes
        return jnp.maximum((norm(away / a) - 1.0) * jnp.min(a), norm(away) - jnp.max(a))


class Box(Shape):
    """All between two corners."""

    lower: Vector = eqx.field(converter=as_float64)
    upper: Vector = eqx.field(converter=as_float64)

    def distance(self, point: Vector) -> Scalar:
        """Exact."""
        return _of_box(jnp.abs(point - 0.5 * (self.lower + self.upper)) - 0.5 * (self.upper - self.lower))


class Cylinder(Shape):
    """All within `radius` of the stretch of `length` from `centre` along the unit vector `axis`."""

    centre: Vector = eqx.field(converter=as_float64)
    axis: Vector = eqx.field(converter=as_float64)
    radius: Scalar = eqx.field(converter=as_float64)
    length: Scalar = eqx.field(converter=as_float64)

    def distance(self, point: Vector) -> Scalar:
        """Exact: that of a rectangle in the half-plane of (distance from the axis, along it)."""
        across, along = _polar(point - self.centre, self.axis)
        half = 0.5 * self.length
        return _of_box(jnp.stack([across - self.radius, jnp.abs(along - half) - half]))


class Cone(Shape):
    """All within `half_angle` (rad) of the unit vector `axis`, seen from `centre`, and within `length` of it."""

    centre: Vector = eqx.field(converter=as_float64)
    axis: Vector = eqx.field(converter=as_float64)
    half_angle: Scalar = eqx.field(converter=as_float64)
    length: Scalar = eqx.field(converter=as_float64)

    def distance(self, point: Vector) -> Scalar:
        """Exact: that of a sector in the half-plane of (distance from the axis, along it)."""
        return self.of_polar(*_polar(point - self.centre, self.axis))

    def of_polar(self, across: Scalar, along: Scalar) -> Scalar:
        """Give the distance from how far a point is from the axis and along it, m, seen from the apex."""
        sine, cosine = jnp.sin(self.half_angle), jnp.cos(self.half_angle)
        beyond, out = across * cosine - along * sine, norm(jnp.stack([across, along])) - self.length
        up = jnp.clip(across * sine + along * cosine, 0.0, self.length)
        side = norm(jnp.stack([across - up * sine, along - up * cosine]))
        return jnp.where(beyond > 0.0, side, jnp.maximum(beyond, out))


class Mesh(Shape):
    """All within one of some convex bodies; a body's points are on the inner side of all its planes.

    The signed distance of a half-space is at most that of a body in it, so the largest of a body's planes is a lower
    bound, 0 on its surface and 1-Lipschitz as each of them; and so is the least of all bodies outside of them.

    Attributes:
        normals: outward unit normals of each body's planes.
        offsets: of these planes, m.

    """

    normals: Float[Array, "bodies planes 3"] = eqx.field(converter=as_float64)
    offsets: Float[Array, "bodies planes"] = eqx.field(converter=as_float64)

    def distance(self, point: Vector) -> Scalar:
        """Give the least, over the bodies, of how far a point is beyond its planes."""
        return jnp.min(jnp.max(jnp.sum(self.normals * point, axis=-1) - self.offsets, axis=-1))


class Beside(Shape):
    """All within `length` of `port` but what is in an endless cone or tube along the unit vector `axis`.

    The larger of the signed distances of two bodies is a lower bound of that of what they share.
    """

    port: Vector = eqx.field(converter=as_float64)
    axis: Vector = eqx.field(converter=as_float64)
    length: Scalar = eqx.field(converter=as_float64)

    @abc.abstractmethod
    def room(self, point: Vector) -> Scalar:
        """Give how deep a point (3,) m is in the endless cone or tube, m, exactly; negative outside."""

    def distance(self, point: Vector) -> Scalar:
        """Give the larger of the distances to the ball, and out of the cone or tube."""
        return jnp.maximum(norm(point - self.port) - self.length, self.room(point))

    def depth(self, point: Vector, clear_from: Scalar) -> Scalar:
        """Give how deep a point is between the walls, within `length`, `clear_from` (m) or more along the axis.

        It is positive inside only, the least of three depths, and 1-Lipschitz as each of them.
        """
        away = point - self.port
        along = jnp.sum(away * self.axis)
        return jnp.minimum(jnp.minimum(self.room(point), self.length - norm(away)), along - clear_from)


class BesideCone(Beside):
    """Beside all that is within `half_angle` (rad) of the axis, seen from `apex`."""

    apex: Vector = eqx.field(converter=as_float64)
    half_angle: Scalar = eqx.field(converter=as_float64)

    def room(self, point: Vector) -> Scalar:
        """Give the distance to the cone's side, or to its apex behind it."""
        away = point - self.apex
        across, along = _polar(away, self.axis)
        sine, cosine = jnp.sin(self.half_angle), jnp.cos(self.half_angle)
        behind = across * sine + along * cosine <= 0.0  # where the apex is what is nearest of the cone
        return -jnp.where(behind, norm(away), across * cosine - along * sine)


class BesideTube(Beside):
    """Beside all that is within `radius` of the line along the axis through the port."""

    radius: Scalar = eqx.field(converter=as_float64)

    def room(self, point: Vector) -> Scalar:
        """Give the distance to the tube's side."""
        return self.radius - _polar(point - self.port, self.axis)[0]


def _polar(away: Vector, axis: Vector) -> tuple[Scalar, Scalar]:
    """Give the distance from an axis (a unit vector), and the way along it."""
    along = jnp.sum(away * axis)
    return norm(away - along * axis), along


def _of_box(beyond: Float[Array, "n"]) -> Scalar:
    """Give the signed distance of a box, from how far the point is beyond its faces along each axis."""
    return norm(jnp.maximum(beyond, 0.0)) + jnp.minimum(jnp.max(beyond), 0.0)


class Zone(eqx.Module):
    """A shape that stands in the body frame for some time, turning or not.

    Attributes:
        shape: in the zone's axes.
        rotations: zone's axes ← body axes, of some moments while it stands.
        ends: until when each of them stands for the zone, s; as long it is within `turned` of it.
        turned: the largest angle, rad, between the zone and the rotation that stands for it.
        shift: added to the distance, m, so that the zone is entered where a field's own threshold is.
        by_word: whether it ends when somebody says "go".

    """

    shape: Shape
    rotations: Float[Array, "moments 3 3"] = eqx.field(converter=as_float64)
    ends: Float[Array, "moments"] = eqx.field(converter=as_float64)
    turned: Scalar = eqx.field(converter=as_float64)
    shift: Scalar = eqx.field(converter=as_float64)
    by_word: bool = eqx.field(static=True, default=False)

    def value(self, point: Vector, time: Scalar) -> Scalar:
        """Give how far a point (m) is from wherever the zone will be from a time (s) on, and `shift`; 1-Lipschitz.

        A zone turned by up to φ against one of its rotations is nearer by at most φ ‖p‖.
        """
        away = jax.vmap(lambda rotation: self.shape.distance(jnp.sum(rotation * point, axis=1)))(self.rotations)
        away = (away - self.turned * norm(point)) / (1.0 + self.turned)
        # A time that is no number ends nothing.
        return jnp.min(jnp.where(self.ends <= time, jnp.inf, away)) + self.shift


class SweptCone(eqx.Module):
    """A cone that turns at its apex about a fixed axis through it, from now until it ends, exactly.

    Of all cones on the way the nearest to a point is that whose axis makes the least angle with it, as a cone holds
    with a point all that are as far from the apex and nearer to its axis. So one cone is asked, whose axis is turned
    towards the point as far as the way goes.

    Attributes:
        cone: with its apex in the body frame's origin; its axis is that of no turn.
        about: unit vector, body axes.
        angles: of the turn at every `period` from the epoch on, rad, rising.
        period: s.
        end: until when it stands, s.
        shift: added to the distance, m, so that the zone is entered where a field's own threshold is.
        by_word: whether it ends when somebody says "go".

    """

    cone: Cone
    about: Vector = eqx.field(converter=as_float64)
    angles: Float[Array, "moments"] = eqx.field(converter=as_float64)
    period: Scalar = eqx.field(converter=as_float64)
    end: Scalar = eqx.field(converter=as_float64)
    shift: Scalar = eqx.field(converter=as_float64)
    by_word: bool = eqx.field(static=True, default=False)

    def value(self, point: Vector, time: Scalar) -> Scalar:
        """Give how far a point (m) is from wherever the cone will be from a time (s) on, and `shift`; 1-Lipschitz."""
        # The last moment not after the time: the cone is where it was then, or further on. One that is no number is 0.
        moment = jnp.nan_to_num(jnp.floor(time / self.period), nan=0.0)
        begun = self.angles[jnp.clip(moment, 0, len(self.angles) - 1).astype(jnp.int32)]
        a, n = self.cone.axis, self.about
        level, height = jnp.sum(a * n), jnp.sum(point * n)
        first, second = a - level * n, jnp.cross(n, a)  # the axis turned by θ: level n + first cos θ + second sin θ
        x, y = jnp.sum(point * first), jnp.sum(point * second)
        on_axis = x * x + y * y == 0.0
        ahead = jnp.arctan2(jnp.where(on_axis, 0.0, y), jnp.where(on_axis, 1.0, x)) - begun
        ahead = jnp.mod(ahead, 2.0 * jnp.pi)
        past = ahead - (self.angles[-1] - begun)
        off = jnp.where(past <= 0.0, 0.0, jnp.minimum(past, 2.0 * jnp.pi - ahead))
        along = level * height + norm(jnp.stack([x, y])) * jnp.cos(off)
        size = norm(point)
        away = self.cone.of_polar(jnp.sqrt(jnp.maximum(size * size - along * along, 1e-18)), along)
        return jnp.where(self.end <= time, jnp.inf, away) + self.shift


def at_word(zone: Zone | SweptCone, said: bool) -> Zone | SweptCone:
    """Give a zone that stands until "go" as it is before and after that is said, at whatever time."""
    if not zone.by_word:
        return zone
    if isinstance(zone, Zone):
        ends = jnp.full_like(zone.ends, -jnp.inf) if said else zone.ends.at[-1].set(jnp.inf)
        return dataclasses.replace(zone, ends=ends)
    return dataclasses.replace(zone, end=jnp.full_like(zone.end, -jnp.inf if said else jnp.inf))


class ClearRoom(eqx.Module):
    """Room before a port of which it is proved that the chaser touches nothing there.

    Attributes:
        beside: the corridor whose inside it is.
        clear_from: how far from the port it begins, along the axis, m.
        shift: added to the depth, m: a field's own threshold.

    """

    beside: Beside
    clear_from: Scalar = eqx.field(converter=as_float64)
    shift: Scalar = eqx.field(converter=as_float64)

    def value(self, point: Vector) -> Scalar:
        """Give how deep a point (m) is in the room, and `shift`; 1-Lipschitz."""
        return self.beside.depth(point, self.clear_from) + self.shift


class ZonedField(Field):
    """The least of a field and of zones: what is above a threshold of it is so of the field, and outside the zones.

    Where room is proved clear the field itself counts as what that says, if it says more: above the threshold then is
    what is so of the field, or in clear room. The gradient jumps where two of them are equal, so that it is not twice
    differentiable there.

    Attributes:
        inner: the field.
        zones: with their shifts for that field.
        clear: rooms, with their shifts for that field.
        time: now, s; every zone counts that ends after it.

    """

    inner: Field
    zones: tuple[Zone | SweptCone, ...]
    clear: tuple[ClearRoom, ...] = ()
    time: Scalar = eqx.field(converter=as_float64, default=0.0)

    def at_time(self, time: Scalar) -> Field:
        """Give the field as it is from a time (s) on."""
        return dataclasses.replace(self, time=time)

    @property
    def target(self) -> "ZonedField":
        """The field without the zones; rooms that are proved clear count."""
        return dataclasses.replace(self, zones=())

    def zone_values(self, point: Vector) -> Float[Array, "zones"]:
        """Give each zone's signed distance from a point (m), m: ∞ of one that has ended; −∞ where the point is none."""
        near = within_numbers(point)
        return jnp.stack([of_places(point, zone.value(near, self.time)) for zone in self.zones])

    def _least(self, point: Vector) -> Scalar:
        """Of all zones, finite wherever the point is; −∞ where the point is none."""
        near = within_numbers(point)
        return of_places(point, jnp.min(jnp.stack([zone.value(near, self.time) for zone in self.zones])))

    def _most(self, point: Vector) -> Scalar:
        """Of all clear rooms; −∞ where the point is none."""
        near = within_numbers(point)
        return of_places(point, jnp.max(jnp.stack([room.value(near) for room in self.clear])))

    def _counting(self, points: Points, found: tuple[Array, ...], derivatives) -> tuple[Array, ...]:
        """Give what the field says, from what `inner` says at the points: its value, or with derivatives.

        `derivatives` makes the same of a function of one point.
        """
        for of, there, sign in ((self._most, self.clear, 1.0), (self._least, self.zones, -1.0)):
            if there:
                other = _each(derivatives(of), points)
                counts = sign * other[0] > sign * found[0]
                pairs = zip(other, found, strict=True)
                found = tuple(jnp.where(jnp.expand_dims(counts, range(counts.ndim, b.ndim)), a, b) for a, b in pairs)
        return found

    def value(self, points: Points) -> Values:
        """Give the least signed distance, m."""
        return self._counting(points, (self.inner.value(points),), lambda of: lambda point: (of(point),))[0]

    def value_and_gradient(self, points: Points) -> tuple[Values, Points]:
        """Give the least signed distance, m, and its gradient."""
        value, gradient = self._counting(points, self.inner.value_and_gradient(points), jax.value_and_grad)
        return value, gradient

    def value_gradient_hessian(self, points: Points) -> tuple[Values, Points, Hessians]:
        """Give the least signed distance, m, its gradient, and its Hessian, 1/m."""

        def twice(of):
            return lambda point: (*jax.value_and_grad(of)(point), jax.hessian(of)(point))

        value, gradient, hessian = self._counting(points, self.inner.value_gradient_hessian(points), twice)
        return value, gradient, hessian


def _each(function, points: Points):
    """Apply a function of one point to all of a batch."""
    flat = jax.vmap(function)(points.reshape(-1, 3))
    return jax.tree.map(lambda found: found.reshape(*points.shape[:-1], *found.shape[1:]), flat)
