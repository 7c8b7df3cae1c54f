"""The paper's law written the usual way: PyTorch for the field, CVXPY with Clarabel for the program, else NumPy.

It needs the extra `bench`. Every step builds nothing anew: the network and the program are made once, the program with
parameters.
"""

import importlib
import importlib.util
import itertools
from typing import Any

import numpy as np
from jaxtyping import Float

from keepout.core.control.controller import Controller
from keepout.core.control.guidance import ComponentwiseGuidance
from keepout.core.control.observer import ContinuousObserver
from keepout.core.control.velocity import ConstantCirculation
from keepout.core.errors import ControlError
from keepout.core.fields.neural import NeuralField

Vector = Float[np.ndarray, "3"]

PACKAGES = ("cvxpy", "torch")


def missing_extra() -> str | None:
    """Say how to get what is missing of the extra `bench`; None where nothing is."""
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if not missing:
        return None
    return f"not run: {', '.join(missing)} not installed; pip install 'keepout-gnc[bench]'"


class TorchField:
    """A learned field's value and gradient by PyTorch's autograd on one thread, within the ball that it was learned on.

    Args:
        field: gives weights and units.
        idle: hidden layers and their width of a further network of random weights, which is evaluated for its cost
            only and changes nothing.

    """

    def __init__(self, field: NeuralField, *, idle: tuple[int, int] | None = None) -> None:
        self._torch: Any = importlib.import_module("torch")
        self._torch.set_num_threads(1)
        self._centre = np.asarray(field.continuation.centre)
        self._reach = float(field.continuation.target_radius)
        self._scale = float(field.scale)
        weights = [np.asarray(weight, np.float32) for weight in field.layers.weights]
        biases = [np.asarray(bias, np.float32) for bias in field.layers.biases]
        self._net = self._network(weights, biases, field.beta)
        self._idle = None
        if idle is not None:
            layers, width = idle
            draw = np.random.default_rng(0)
            sizes = [3, *[width] * layers, 1]
            random = [
                (draw.normal(size=(after, before)) / np.sqrt(before)).astype(np.float32)
                for before, after in itertools.pairwise(sizes)
            ]
            self._idle = self._network(random, [np.zeros(size, np.float32) for size in sizes[1:]], field.beta)

    def _network(self, weights: list[np.ndarray], biases: list[np.ndarray], beta: float) -> Any:
        torch, layers = self._torch, []
        for weight, bias in zip(weights, biases):
            layer = torch.nn.Linear(weight.shape[1], weight.shape[0])
            with torch.no_grad():
                layer.weight.copy_(torch.tensor(weight))
                layer.bias.copy_(torch.tensor(bias))
            layers += [layer, torch.nn.Softplus(beta)]
        return torch.nn.Sequential(*layers[:-1])

    def value_and_gradient(self, position: Vector) -> tuple[float, Vector]:
        """Return the distance, m, and its gradient.

        Raises:
            ControlError: the position lies outside the ball that the network was learned on.

        """
        away = position - self._centre
        if np.linalg.norm(away) > self._reach:
            raise ControlError(
                f"usual way: {position.tolist()} m lies more than {self._reach:.3g} m from the target's centre, where "
                "the network was not learned"
            )
        if self._idle is not None:
            self._differentiated(self._idle, away / self._scale)
        value, gradient = self._differentiated(self._net, away / self._scale)
        return value * self._scale, gradient

    def _differentiated(self, network: Any, at: Vector) -> tuple[float, Vector]:
        point = self._torch.tensor(at, dtype=self._torch.float32, requires_grad=True)
        value = network(point)[0]
        (gradient,) = self._torch.autograd.grad(value, point)
        return float(value.detach()), gradient.numpy().astype(float)


class UsualWay:
    """The law of `profiles.paper` in NumPy, with the numbers of a law built there.

    The change of the safe velocity is its difference over the last period, where the law here has its derivative.

    Args:
        law: gives every constant; it must be of the paper's profile, on a target fixed to a circular orbit.
        field: distance and gradient.
        period: s.
        orbital_rate: of the target, rad/s.

    """

    def __init__(self, law: Controller, field: TorchField, *, period: float, orbital_rate: float) -> None:
        guidance, circulation = law.velocity.guidance, law.velocity.circulation
        if (
            not isinstance(guidance, ComponentwiseGuidance)
            or not isinstance(circulation, ConstantCirculation)
            or not isinstance(law.observer, ContinuousObserver)
            or law.velocity.box is None
        ):
            raise ControlError("usual way: only the paper's profile, with its own guidance, circulation and observer")
        self._field, self._period, self._rate = field, period, orbital_rate
        self._goal, self._speed = np.asarray(guidance.goal), float(guidance.speed)
        self._length = float(guidance.slowing_length)
        self._offset, self._alpha = float(law.velocity.offset), float(law.velocity.class_k.rate)
        self._omega = np.asarray(circulation.omega)
        self._level, self._slope = float(circulation.level), float(circulation.slope)
        self._tracking = {
            name: np.asarray(value) for name, value in vars(law.tracking).items() if name != "acceleration_limit"
        }
        self._observer = {name: np.asarray(value) for name, value in vars(law.observer).items()}
        self._mass, self._limit = float(law.mass), np.asarray(law.force_limit)
        error = law.velocity.gradient_error
        self._pose(float(law.velocity.box), float(circulation.weight), 0.0 if error is None else float(error))
        self._estimate: Float[np.ndarray, " q"] | None = None
        self._before: tuple[Vector, Vector, Vector, Vector] | None = None
        self.unsolved = 0

    def _pose(self, box: float, weight: float, error: float) -> None:
        cvxpy: Any = importlib.import_module("cvxpy")
        self._clarabel = cvxpy.CLARABEL
        self._velocity, relaxation = cvxpy.Variable(3), cvxpy.Variable()
        self._desired, self._normal, self._tangent = (cvxpy.Parameter(3) for _ in range(3))
        self._barrier_rate, self._turn = cvxpy.Parameter(), cvxpy.Parameter()
        barrier = self._normal @ self._velocity + self._barrier_rate
        constraints = [
            barrier >= (error * cvxpy.norm(self._velocity) if error else 0.0),
            self._tangent @ self._velocity - self._turn >= relaxation,
            self._velocity <= box,
            self._velocity >= -box,
        ]
        cost = 0.5 * cvxpy.sum_squares(self._desired - self._velocity) + weight * cvxpy.square(relaxation)
        self._program = cvxpy.Problem(cvxpy.Minimize(cost), constraints)

    def safe_velocity(self, position: Vector) -> tuple[float, Vector, Vector]:
        """Return h (m), ∇f̃ and the safe velocity (m/s); where the solver finds none, zero, counted in `unsolved`."""
        value, normal = self._field.value_and_gradient(position)
        barrier = value - self._offset
        self._desired.value = -self._speed * np.tanh((position - self._goal) / self._length)
        self._normal.value = normal
        self._tangent.value = self._omega @ normal
        self._barrier_rate.value = self._alpha * barrier
        self._turn.value = self._level - self._slope * barrier
        self._program.solve(solver=self._clarabel)
        if self._velocity.value is None:
            self.unsolved += 1
            return barrier, normal, np.zeros(3)
        return barrier, normal, np.asarray(self._velocity.value)

    def drift(self, position: Vector, velocity: Vector) -> Vector:
        """Return the acceleration without force, m/s²: Clohessy and Wiltshire's, in the paper's axes."""
        n = self._rate
        return np.array(
            [
                2.0 * n * velocity[2],
                -n * n * position[1],
                3.0 * n * n * position[2] - 2.0 * n * velocity[0],
            ]
        )

    def step(self, time: float, position: Vector, velocity: Vector) -> Vector:
        """Return the force to hold over the coming period, N."""
        position, velocity = np.asarray(position, float), np.asarray(velocity, float)
        drift = self.drift(position, velocity)
        disturbance = self._observe(velocity, drift)
        barrier, normal, safe = self.safe_velocity(position)
        change = np.zeros(3) if self._before is None else (safe - self._before[3]) / self._period
        force = self._tracked(barrier, normal, safe, change, position, velocity, drift) - disturbance
        force = np.clip(force, -self._limit, self._limit)
        self._before = velocity, drift, force, safe
        return force

    def _observe(self, velocity: Vector, drift: Vector) -> Vector:
        o = self._observer
        gain = o["gain"]
        if self._before is None or self._estimate is None:
            self._estimate = -gain @ velocity
        else:
            before, drift_before, force, _ = self._before
            error = o["generator"] - gain @ o["output"] / self._mass
            constant = error @ gain @ before - gain @ (0.5 * (drift_before + drift) + force / self._mass)
            self._estimate = (
                o["transition"] @ self._estimate
                + o["held"] @ constant
                + o["ramp"] @ (error @ gain @ (velocity - before))
            )
        return o["output"] @ (self._estimate + gain @ velocity)

    def _tracked(
        self,
        barrier: float,
        normal: Vector,
        safe: Vector,
        change: Vector,
        position: Vector,
        velocity: Vector,
        drift: Vector,
    ) -> Vector:
        """Return u, N: the tracking layer with the smooth safety filter (paper, section V-B)."""
        t = self._tracking
        error = velocity - safe
        feedback = -t["lyapunov_ratio"] * (t["position_weight"] @ (position - self._goal)) - 0.5 * t["gain"] * error
        reference = self._mass * (change - drift + feedback)
        gradient = -error / (self._mass * t["barrier_ratio"])
        b = float(gradient @ gradient)
        if b <= 1e-24:
            return reference
        a = (
            -error @ feedback / t["barrier_ratio"]
            + normal @ velocity
            - t["gradient_error"] * np.linalg.norm(velocity)
            + t["barrier_rate"] * (barrier - error @ error / (2.0 * t["barrier_ratio"]))
            - b / (2.0 * t["estimation_weight"] * (2.0 * t["estimation_rate"] - t["barrier_rate"]))
        )
        return reference + np.logaddexp(0.0, -t["sharpness"] * a / b) / t["sharpness"] * gradient
