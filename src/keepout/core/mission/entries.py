"""The tables of a scenario, each an immutable set of entries with ranges; `scenario.py` puts them together.

Every entry is in SI units. What depends on two entries of one table is checked in that table. What an entry means is
said in its table's docstring, of which the first line says what the table is for.
"""

import inspect
from collections.abc import Iterable, Iterator
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    model_validator,
)
from pydantic.fields import FieldInfo

from keepout.core.mission.epoch import checked_epoch


def _finite(vector: tuple[float, ...]) -> tuple[float, ...]:
    if not all(abs(x) < float("inf") for x in vector):
        raise ValueError("must be three finite numbers")
    return vector


Vector = Annotated[tuple[float, float, float], AfterValidator(_finite)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-6.3, le=6.3)]
Epoch = Annotated[str, BeforeValidator(checked_epoch)]


def _strict(part: Any) -> Any:
    if isinstance(part, list):
        return [_strict(inner) for inner in part]
    if not isinstance(part, dict):
        return part
    made = {key: _strict(inner) for key, inner in part.items()}
    return made | {"strict": True} if part.get("type") in ("float", "int", "bool", "str") else made


def _meanings(doc: str) -> dict[str, str]:
    """Read the section `Attributes` of a docstring: what each entry means, in one line without its full stop."""
    meanings: dict[str, str] = {}
    key = ""
    for line in inspect.cleandoc(doc).partition("\nAttributes:\n")[2].split("\n"):
        if line.startswith(" " * 8):
            meanings[key] += f" {line.strip()}"
        elif line.startswith(" " * 4):
            key, _, meanings[key] = line.strip().partition(": ")
    return {key: meaning.removesuffix(".") for key, meaning in meanings.items()}


class _Documented(type(BaseModel)):
    """Gives each entry of a table its meaning from the table's docstring, where references and schema look for it."""

    def __new__(mcs, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **options: Any):
        doc = namespace.get("__doc__") or ""
        namespace["__doc__"] = doc.partition("\n\n    Attributes:\n")[0]
        for key, meaning in _meanings(doc).items():
            given = namespace.get(key, ...)
            made = isinstance(given, FieldInfo)
            default: dict[str, Any] = {"default_factory": given.default_factory} if made else {"default": given}
            namespace[key] = Field(description=meaning, **default)
        return super().__new__(mcs, name, bases, namespace, **options)

    def __dir__(cls) -> list[str]:
        """Leave out what pydantic brings: whoever types a dot looks for entries."""
        return _own(super().__dir__())


def _own(names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith("__") or not hasattr(BaseModel, name)]


class Entry(BaseModel, metaclass=_Documented):
    """A table of a scenario: immutable, without unknown keys, and with values of the kind that each entry asks for.

    `true` and `"5"` are no numbers, and 1 is no flag; a whole number is a number, and a list is a vector.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    def _contradictions(self) -> Iterator[str]:
        """Say what in the table does not go together; the first is its refusal."""
        return iter(())

    @model_validator(mode="after")
    def _goes_together(self) -> "Entry":
        for said in self._contradictions():
            raise ValueError(said)
        return self

    def __dir__(self) -> list[str]:
        """Leave out what pydantic brings."""
        return _own(super().__dir__())

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> Any:
        """Make every number, flag and text of the table strict; `strict` of the model would refuse lists as well."""
        return _strict(handler(source))


class TargetEntry(Entry):
    """What is flown around.

    Attributes:
        source: a built-in target's name, or a mesh file (relative to the scenario).
        units: length unit of the mesh file.
        scale: metres per unit of the mesh file, instead of `units`.
        drop_stray: leave out parts far from the rest.
        thickness: of a point cloud: each point is a ball this wide, m.
        rotation: from file axes to body axes.
        origin: of the body frame, in file axes, m.
        centre_of_mass: of the target, about which it turns and which orbits, in the body frame, m.
        parameters: of a built-in: wing angle, wing span, ….

    """

    source: str = "intelsat30"
    units: Literal["m", "cm", "mm", "in", "ft"] | None = None
    scale: Positive | None = None
    drop_stray: bool = False
    thickness: Positive | None = None
    rotation: tuple[Vector, Vector, Vector] | None = None
    origin: Vector | None = None
    centre_of_mass: Vector = (0.0, 0.0, 0.0)
    parameters: dict[str, float] = Field(default_factory=dict)

    def _contradictions(self) -> Iterator[str]:
        if self.units is not None and self.scale is not None:
            yield "give either units or scale, not both"


class FieldEntry(Entry):
    """The field that the control law flies by.

    Attributes:
        source: "shipped" for a built-in target; "grid", made of exact distances when it is needed, for any; or a
            .keepout file.

    """

    source: str = "shipped"


class ChaserEntry(Entry):
    """The chaser: a ball of `radius` with one thruster pair an axis.

    Attributes:
        mass: kg.
        radius: of the ball that holds the chaser, m.
        force_limit: per body axis, N.
        speed_limit: m/s.

    """

    mass: Positive = 20.0
    radius: NonNegative = 0.5
    force_limit: Positive = 0.1
    speed_limit: Positive = 0.1


class SafetyEntry(Entry):
    """What is kept between chaser and target beyond what is proved.

    Attributes:
        margin: the operator's own, m.

    """

    margin: NonNegative = 0.1


class GuardEntry(Entry):
    """The hard layer that accepts or replaces every commanded force, and what its theorem may assume.

    Attributes:
        enabled: whether it flies along.
        position_error: largest error of the position estimate, m.
        velocity_error: largest error of the velocity estimate, m/s.
        mass_error: largest relative error.
        gain_error: of the thrusters, relative.
        keeps_margin: whether its theorem too keeps `safety.margin`, and not only from contact.
        delay: from command to effect, control periods; the control law predicts its state over it too.

    """

    enabled: bool = True
    position_error: NonNegative = 0.0
    velocity_error: NonNegative = 0.0
    mass_error: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    gain_error: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    keeps_margin: bool = False
    delay: Annotated[int, Field(ge=0, le=8)] = 0


class FaultsEntry(Entry):
    """What goes wrong in flight, drawn from the scenario's seed; law and guard know only what `guard` says of it.

    Attributes:
        law: what replaces the law's force: full thrust into the body, straight through to the goal at twice the speed
            limit, random forces, full thrust in a random corner for 15 periods each, NaN in every 15th command.
        position_bias: constant error of the estimate, random direction, m.
        velocity_bias: the same of its velocity, m/s.
        position_noise: largest error drawn anew each period, m.
        velocity_noise: the same of its velocity, m/s.
        position_noise_std: standard deviation of a Gaussian error of each axis, which has no bound, m.
        velocity_noise_std: the same of its velocity, m/s.
        noise_correlation_time: over which the Gaussian errors fall to a third (1/e); 0: new ones each period, s.
        delay: true delay from command to effect, control periods.
        dropped: probability that a command is lost; the last one then goes on.
        gain_error: each axis gives 1 ± this of its command, drawn once a flight.
        stuck: the thruster that is stuck, by the direction it pushes in.
        stuck_force: what it then gives: 0 stuck off, force_limit stuck on, N.
        stuck_from: when it sticks, s.
        abort_at: when the mission is abandoned, as `approach.abort` says, s.
        thruster: of a layout, the thruster that is stuck, counted from 0.
        thruster_stuck: how.

    """

    law: Literal["none", "into the body", "through", "random", "bang-bang", "not a number"] = "none"
    position_bias: NonNegative = 0.0
    velocity_bias: NonNegative = 0.0
    position_noise: NonNegative = 0.0
    velocity_noise: NonNegative = 0.0
    position_noise_std: NonNegative = 0.0
    velocity_noise_std: NonNegative = 0.0
    noise_correlation_time: NonNegative = 0.0
    delay: Annotated[int, Field(ge=0, le=100)] = 0
    dropped: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    gain_error: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    stuck: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    stuck_force: NonNegative = 0.0
    stuck_from: NonNegative = 0.0
    abort_at: NonNegative | None = None
    thruster: Annotated[int, Field(ge=0)] | None = None
    thruster_stuck: Literal["on", "off"] = "off"

    def _contradictions(self) -> Iterator[str]:
        if self.stuck is None and (self.stuck_force or (self.stuck_from and self.thruster is None)):
            yield 'stuck_force and stuck_from need stuck = "+x", "-x", "+y", "-y", "+z" or "-z"'
        if self.thruster is None and self.thruster_stuck != "off":
            yield "thruster_stuck needs thruster, its number"
        if self.noise_correlation_time and not (self.position_noise_std or self.velocity_noise_std):
            yield "noise_correlation_time needs position_noise_std or velocity_noise_std"


class PaperEntry(Entry):
    """What the paper's law needs and the paper does not print; only for `profile = "paper"`.

    Attributes:
        slowing_length: k_p of the desired velocity v_max tanh(r_e/k_p), by component, m.
        sharpness: ε of the smooth safety filter.
        position_weight: H₀ of the Lyapunov function is this times the identity.
        gradient_error: e_∇h; above 0 the barrier row becomes a cone.

    """

    slowing_length: Positive = 1.5
    sharpness: Positive = 1.0
    position_weight: Positive = 1.0
    gradient_error: NonNegative = 0.0


class ControlEntry(Entry):
    """The control law.

    Attributes:
        profile: the recommended law, or the paper's constants.
        period: between control steps, s.
        guidance: unset: the profile's own.
        spacing: of the geodesic grid, m; unset: from the room and the zone's width.
        circulation: unset: the profile's.
        observer: unset: the profile's own.

    """

    profile: Literal["default", "paper"] = "default"
    period: Positive = 1.0
    guidance: Literal["geodesic", "straight"] | None = None
    spacing: Positive | None = None
    circulation: Literal["none", "printed", "skew", "switching"] | None = None
    observer: Literal["harmonic", "constant", "printed", "off"] | None = None
    paper: PaperEntry = PaperEntry()

    def _contradictions(self) -> Iterator[str]:
        if self.profile != "paper" and self.paper != PaperEntry():
            named = ", ".join(f"paper.{key}" for key in self.paper.model_dump(exclude_defaults=True))
            yield f'{named}: only for profile = "paper", and profile is "{self.profile}"'
        guidance = self.guidance or ("geodesic" if self.profile == "default" else "straight")
        if self.spacing is not None and guidance != "geodesic":
            yield f'spacing {self.spacing} m is for guidance = "geodesic", and guidance is "{guidance}"'


class OrbitEntry(Entry):
    """The target's orbit about the Earth.

    Attributes:
        semi_major_axis: m.
        eccentricity: 0: a circle.
        true_anomaly: at the start, rad.
        inclination: rad; this and the next two count only with j2 or drag.
        right_ascension: of the ascending node, rad.
        argument_of_perigee: rad.
        j2: whether the Earth's oblateness bends both orbits.

    """

    semi_major_axis: Annotated[float, Field(gt=6.4e6, lt=1e9)] = 42_164_000.0
    eccentricity: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    true_anomaly: Angle = 0.0
    inclination: Angle = 0.0
    right_ascension: Angle = 0.0
    argument_of_perigee: Angle = 0.0
    j2: bool = False

    def _contradictions(self) -> Iterator[str]:
        perigee = self.semi_major_axis * (1.0 - self.eccentricity)
        if perigee < 6.4e6:
            yield f"the perigee radius is {perigee:.4g} m, inside the Earth; it must be at least 6.4e6 m"


class DragEntry(Entry):
    """Drag of both spacecraft in an exponential atmosphere that turns with the Earth.

    Attributes:
        density: of the air at `altitude`, kg/m3; 0: no drag.
        altitude: above the equatorial radius, m.
        scale_height: over which the density falls to a third (1/e), m.
        target_area_to_mass: drag coefficient × area / mass, m2/kg.
        chaser_area_to_mass: drag coefficient × area / mass, m2/kg.

    """

    density: NonNegative = 0.0
    altitude: NonNegative = 400_000.0
    scale_height: Annotated[float, Field(ge=1e3, le=1e6)] = 60_000.0
    target_area_to_mass: NonNegative = 0.02
    chaser_area_to_mass: NonNegative = 0.02


class SunEntry(Entry):
    """Sunlight: where it comes from, and how it pushes both spacecraft.

    Attributes:
        direction: from the Earth to the sun, ECI, any length; unset: where it is at `epoch`.
        target_area_to_mass: radiation pressure coefficient × area / mass, m2/kg; 0: no push.
        chaser_area_to_mass: radiation pressure coefficient × area / mass, m2/kg; 0: no push.

    """

    direction: Vector | None = None
    target_area_to_mass: NonNegative = 0.0
    chaser_area_to_mass: NonNegative = 0.0

    def _contradictions(self) -> Iterator[str]:
        if self.direction is not None and not any(self.direction):
            yield "direction [0, 0, 0] points nowhere; give a vector from the Earth to the sun"


class AttitudeEntry(Entry):
    """How the target turns.

    Attributes:
        kind: fixed to VVLH, fixed to the stars, free.
        angular_velocity: tumbling: inertial, in body axes, rad/s.
        inertia: tumbling: tensor in body axes, kg m2.
        gravity_gradient: tumbling: whether the Earth's gravity turns it.

    """

    kind: Literal["vvlh", "inertial", "tumbling"] = "vvlh"
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    inertia: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    gravity_gradient: bool = False

    def _contradictions(self) -> Iterator[str]:
        if self.kind != "tumbling" and any(self.angular_velocity):
            yield f'an angular_velocity needs kind = "tumbling", not "{self.kind}"'
        if self.kind != "tumbling" and self.gravity_gradient:
            yield f'gravity_gradient needs kind = "tumbling", not "{self.kind}"'


class DisturbanceEntry(Entry):
    """The force that nobody commanded, in body axes.

    Attributes:
        kind: paper: 0.01 [sin 0.02 t, cos 0.02 t, sin 0.01 t] N; bang-bang: changes sign every 50 s; resonant: with
            every control step; random: smooth noise from the seed.
        force: constant: N.
        amplitude: bang-bang, resonant, random: largest norm, N.
        phase: paper, random: added to that of every sinusoid; bang-bang, resonant: a full turn is a period; none and
            constant have none, rad.
        bound: what the control law may assume, N; unset: the true bound.

    """

    kind: Literal["none", "paper", "constant", "bang-bang", "resonant", "random"] = "paper"
    force: Vector | None = None
    amplitude: Positive | None = None
    phase: Angle = 0.0
    bound: Positive | None = None

    def _contradictions(self) -> Iterator[str]:
        if self.kind == "constant" and self.force is None:
            yield 'kind = "constant" needs force = [x, y, z] in N'
        if self.kind in ("bang-bang", "resonant", "random") and self.amplitude is None:
            yield f'kind = "{self.kind}" needs amplitude in N'
        if self.phase and self.kind in ("none", "constant"):
            yield (
                f'phase {self.phase} rad is for kind = "paper", "bang-bang", "resonant" or "random"; '
                f'"{self.kind}" has none'
            )


class StateEntry(Entry):
    """The chaser's state relative to the target, in body axes.

    Attributes:
        position: m.
        velocity: m/s.

    """

    position: Vector = (0.0, 10.0, 6.0)
    velocity: Vector = (0.0, 0.0, 0.0)


class GoalEntry(Entry):
    """Where to go.

    Attributes:
        position: m.
        tolerance: reached when it stays within this, m.

    """

    position: Vector = (0.0, -10.0, -4.0)
    tolerance: Positive = 0.1


class ThrusterEntry(Entry):
    """One thruster of a layout of your own.

    Attributes:
        position: from the chaser's centre of mass, m.
        direction: of the force on the chaser.
        force: while it is on, N; unset: `thrusters.force`.

    """

    position: Vector
    direction: Vector
    force: Positive | None = None

    def _contradictions(self) -> Iterator[str]:
        if not any(self.direction):
            yield "direction [0, 0, 0]; it must point somewhere"


class ThrustersEntry(Entry):
    """What gives the chaser its force: any force at once, or thrusters that are on or off.

    Attributes:
        layout: ideal: any force up to chaser.force_limit an axis, at any instant; six, 12, 24: on/off thrusters, one,
            two or four for each direction; own: those of `own`.
        held_in: axes in which a force is held over a control period: those of the target, which turn with it, or
            inertial ones, as of a chaser that does not turn; only of ideal thrusters.
        own: thrusters of a layout of your own, each with position, direction and force.
        force: of each thruster, N; unset: chaser.force_limit divided by the thrusters of a direction.
        least_on_time: the shortest pulse, s; less than half of it is not fired.
        modulation: delta-sigma: what a pulse gives too much or too little is made up for later.
        specific_impulse: s; 70 is cold nitrogen's, 220 hydrazine's.
        rise_delay: by which each pulse begins and ends late, s.
        misalignment: largest angle of a thruster's force to its direction, drawn once a flight, rad.
        scale_error: largest relative error of a thruster's force, drawn once a flight.
        detection_time: from when a thruster sticks until the others are fired accordingly, s.
        survive_failure: whether the guard covers one thruster that sticks, off or on; chaser.force_limit must then be
            what the others can give.

    """

    layout: Literal["ideal", "six", "12", "24", "own"] = "ideal"
    held_in: Literal["target", "inertial"] = "target"
    own: tuple[ThrusterEntry, ...] = ()
    force: Positive | None = None
    least_on_time: NonNegative = 0.02
    modulation: Literal["pulse-width", "delta-sigma"] = "pulse-width"
    specific_impulse: Positive = 70.0
    rise_delay: NonNegative = 0.0
    misalignment: Annotated[float, Field(ge=0.0, le=0.2)] = 0.0
    scale_error: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    detection_time: NonNegative = 5.0
    survive_failure: bool = False

    def _contradictions(self) -> Iterator[str]:
        if (self.layout == "own") != bool(self.own):
            yield f'own: {len(self.own)} thrusters, and layout is "{self.layout}"; they belong to "own"'
        if self.held_in != "target" and self.layout != "ideal":
            yield (
                f'held_in: "{self.held_in}" is for layout = "ideal"; the thrusters of a layout are taken to be '
                "parallel to the target's axes"
            )
        lacking = [str(number) for number, thruster in enumerate(self.own) if thruster.force is None]
        if self.force is None and lacking:
            yield f"own: force of thrusters {', '.join(lacking)} not given; give it, or thrusters.force"


class NavigationEntry(Entry):
    """What is known of the motion: sensors, the law's estimate, and the guard's certain set.

    Attributes:
        suite: sensors (docs/navigation.md); none: the true state, with the errors of `faults` on it.
        estimate: what the law flies by; filter: a Kalman filter of motion and disturbance; observer: the last samples
            and the law's own observer; raw: the last samples alone.
        position_noise: close: largest error of a position, m; unset: 0.05.
        velocity_noise: close: largest error of a velocity, m/s; unset: 0.002.
        dropout: probability that a sample is lost; unset: the suite's own.
        most_missed: samples that can be lost in a row; unset: the suite's own.
        initial_position_error: largest error of the first estimate, m; unset: as where no sample is lost.
        initial_velocity_error: the same of its velocity, m/s; unset: likewise.

    """

    suite: Literal["none", "far", "near", "close"] = "none"
    estimate: Literal["filter", "observer", "raw"] = "filter"
    position_noise: NonNegative | None = None
    velocity_noise: NonNegative | None = None
    dropout: Annotated[float, Field(ge=0.0, lt=1.0)] | None = None
    most_missed: Annotated[int, Field(ge=0, le=20)] | None = None
    initial_position_error: NonNegative | None = None
    initial_velocity_error: NonNegative | None = None
