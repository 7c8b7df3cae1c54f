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
    """Read the section `Attributes` of a docstring: what each entry means, in one line without its full stop.

    Entries that mean the same of two things stand in one line: `lower, upper: Corners of a box.`
    """
    meanings: dict[str, str] = {}
    key = ""
    for line in inspect.cleandoc(doc).partition("\nAttributes:\n")[2].split("\n"):
        if line.startswith(" " * 8):
            meanings[key] += f" {line.strip()}"
        elif line.startswith(" " * 4):
            key, _, meanings[key] = line.strip().partition(": ")
    return {key: meaning.removesuffix(".") for keys, meaning in meanings.items() for key in keys.split(", ")}


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
    """The spacecraft that is flown around.

    Attributes:
        source: A built-in target (`keepout targets`) or a mesh, point cloud or .keepmap, by path from the scenario.
        units: Of the file: m, cm, mm, in or ft; unset: metres, or as it says.
        scale: Metres per unit, instead of `units`.
        drop_stray: Leave out parts far from the rest.
        thickness: Diameter of the ball at each point of a cloud, m; needed there.
        rotation: From file axes to body axes, by rows.
        origin: Of the body frame in file axes, m.
        centre_of_mass: Its place, body axes, m: it orbits, and the target turns about it.
        parameters: Of a built-in target, such as its wings' angle.

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
    """The field that the law flies by.

    Attributes:
        source: "shipped", learned, of a built-in target; "grid", exact distances, made when needed; or a .keepout file.

    """

    source: str = "shipped"


class ChaserEntry(Entry):
    """The chaser: a ball of `radius`.

    Attributes:
        mass: As law and guard know it, kg.
        radius: Of the ball that holds all of it, m.
        force_limit: Along each body axis, N.
        speed_limit: Relative to the target, m/s.

    """

    mass: Positive = 20.0
    radius: NonNegative = 0.5
    force_limit: Positive = 0.1
    speed_limit: Positive = 0.1


class SafetyEntry(Entry):
    """Room that is kept to the target.

    Attributes:
        margin: The operator's own, beside what is proved, m.

    """

    margin: NonNegative = 0.1


class GuardEntry(Entry):
    """The guard, and what its theorem may assume.

    Attributes:
        enabled: The guard flies along.
        position_error, velocity_error: Largest error of the estimate, m, m/s.
        mass_error: Largest relative error of `chaser.mass`.
        gain_error: Largest relative error of thrusters' force.
        keeps_margin: The theorem keeps `safety.margin` too.
        delay: Control periods from a command to its effect; the law predicts over them.

    """

    enabled: bool = True
    position_error: NonNegative = 0.0
    velocity_error: NonNegative = 0.0
    mass_error: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    gain_error: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    keeps_margin: bool = False
    delay: Annotated[int, Field(ge=0, le=8)] = 0


class FaultsEntry(Entry):
    """Errors and failures; law and guard know only what `guard` says of them.

    Attributes:
        law: In the law's place: full thrust "into the body"; "through" to the goal at twice the speed limit; "random"
            forces; "bang-bang", full thrust in a random corner for 15 periods; "not a number" in every 15th command;
            "none".
        position_bias, velocity_bias: Constant error of the estimate, direction random, m, m/s.
        position_noise, velocity_noise: Largest error of the estimate, new each period, m, m/s.
        position_noise_std, velocity_noise_std: Standard deviation of unbounded Gaussian errors of each axis, m, m/s.
        noise_correlation_time: Gaussian errors fall to 1/e in it, s; 0: new each period.
        delay: True delay of commands, control periods.
        dropped: Probability that a command is lost and the last goes on.
        gain_error: Largest relative error of an axis' force, drawn once a flight.
        stuck: Ideal thruster that sticks, by its push: +x, -x, +y, -y, +z or -z.
        stuck_force: Force of a stuck ideal thruster, N: 0 is off, chaser.force_limit on.
        stuck_from: When a thruster sticks, s.
        abort_at: When the chaser gets away as `approach.abort` says, s; unset: never.
        thruster: Thruster of a layout that sticks, counted from 0.
        thruster_stuck: It sticks on or off.

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
    """Only for `control.profile = "paper"`: what the paper does not print.

    Attributes:
        slowing_length: k_p of the desired velocity v_max tanh(r_e/k_p), by component, m.
        sharpness: ε of the smooth safety filter.
        position_weight: H₀ is this times the identity.
        gradient_error: e_∇h; above 0 the barrier row becomes a cone.

    """

    slowing_length: Positive = 1.5
    sharpness: Positive = 1.0
    position_weight: Positive = 1.0
    gradient_error: NonNegative = 0.0


class ControlEntry(Entry):
    """The control law.

    Attributes:
        profile: default, or paper, the paper's law with its constants.
        period: Time between control steps, s.
        guidance: geodesic, along the shortest free way, or straight; unset: geodesic (paper: straight).
        spacing: Of the geodesic grid, m; unset: by the room and the zone's width.
        circulation: none, printed, skew, or switching; unset: none (paper: printed).
        observer: Of the disturbance: harmonic, constant, printed, or off; unset: harmonic (paper: printed).

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
        semi_major_axis: In m; perigee radius at least 6.4e6.
        eccentricity: 0 is a circle.
        true_anomaly: At the start, rad.
        inclination, right_ascension, argument_of_perigee: In ECI, rad (right ascension of the node); matter with j2,
            drag, sun, inertial zones, exports.
        j2: Oblateness bends both orbits.

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
    """Drag of both craft; the exponential atmosphere turns with the Earth.

    Attributes:
        density: Of the air at `altitude`, kg/m3.
        altitude: Above the equatorial radius, m.
        scale_height: Over which the density falls to 1/e, m.
        target_area_to_mass, chaser_area_to_mass: Drag coefficient × area / mass, m2/kg.

    """

    density: NonNegative = 0.0
    altitude: NonNegative = 400_000.0
    scale_height: Annotated[float, Field(ge=1e3, le=1e6)] = 60_000.0
    target_area_to_mass: NonNegative = 0.02
    chaser_area_to_mass: NonNegative = 0.02


class SunEntry(Entry):
    """Sunlight: where it comes from, and how it pushes both craft.

    Attributes:
        direction: From Earth to sun, ECI, any length; unset: as at `epoch`.
        target_area_to_mass, chaser_area_to_mass: Radiation pressure coefficient × area / mass, m2/kg.

    """

    direction: Vector | None = None
    target_area_to_mass: NonNegative = 0.0
    chaser_area_to_mass: NonNegative = 0.0

    def _contradictions(self) -> Iterator[str]:
        if self.direction is not None and not any(self.direction):
            yield "direction [0, 0, 0] points nowhere; give a vector from the Earth to the sun"


class AttitudeEntry(Entry):
    """How the target turns; all but `kind` is for tumbling.

    Attributes:
        kind: Fixed to vvlh or inertial axes, or tumbling freely; only then the others count.
        angular_velocity: Inertial, at the start, body axes, rad/s.
        inertia: Of the target, body axes, kg m2.
        gravity_gradient: The Earth's gravity turns the target.

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
    """The force that nobody commanded, body axes.

    Attributes:
        kind: none; paper, 0.01 [sin 0.02 t, cos 0.02 t, sin 0.01 t] N; constant; bang-bang, changing sign every 50 s;
            resonant, at every control step; random, smooth noise.
        force: Vector that constant needs, N.
        amplitude: Largest norm, N; bang-bang, resonant and random need it.
        phase: Added to every sinusoid's, or lead of the square wave, 2π a period, rad.
        bound: Largest that law and guard assume, N; unset: the true one.

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
    """The chaser at the start, relative to the target, body axes.

    Attributes:
        position, velocity: Of the chaser's centre, relative to the target, m, m/s.

    """

    position: Vector = (0.0, 10.0, 6.0)
    velocity: Vector = (0.0, 0.0, 0.0)


class GoalEntry(Entry):
    """The place to go to.

    Attributes:
        position: The place, body axes, m; legs give it where there are any.
        tolerance: The chaser reaches it by staying this near, m.

    """

    position: Vector = (0.0, -10.0, -4.0)
    tolerance: Positive = 0.1


class ThrusterEntry(Entry):
    """One thruster of a layout of your own.

    Attributes:
        position: From the chaser's centre of mass, m.
        direction: Of the force on the chaser, any length.
        force: While it is on, N; unset: `thrusters.force`.

    """

    position: Vector
    direction: Vector
    force: Positive | None = None

    def _contradictions(self) -> Iterator[str]:
        if not any(self.direction):
            yield "direction [0, 0, 0]; it must point somewhere"


class ThrustersEntry(Entry):
    """The chaser's thrusters.

    Attributes:
        layout: ideal: any force up to chaser.force_limit an axis, at once; six, 12, 24: one, two or four on/off
            thrusters a direction; own: those of `own`.
        held_in: Axes in which ideal thrusters hold a force: target or inertial.
        own: The thrusters of a layout of your own.
        force: Of each thruster, N; unset: chaser.force_limit divided by the thrusters a direction.
        least_on_time: Shortest pulse, s; less than half of it is not fired.
        modulation: pulse-width, or delta-sigma, whose pulses make up for earlier errors.
        specific_impulse: In s; cold nitrogen has 70, hydrazine 220.
        rise_delay: Pulses begin and end this late, s.
        misalignment: Largest angle of a force to its axis, drawn once a flight, rad.
        scale_error: Largest relative error of a force, drawn once a flight.
        detection_time: From a thruster's sticking until others make up for it, s.
        survive_failure: The guard covers a thruster stuck off or on; the others must give chaser.force_limit.

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
    """What sensors, law and guard know of the motion.

    Attributes:
        suite: far (GNSS), near (laser range and bearing), close (pose by lidar or camera), or none: the true state with
            errors of `faults`.
        estimate: Kalman "filter" of motion and disturbance; last samples and the law's "observer"; or "raw" samples.
        position_noise, velocity_noise: Largest error of a sample of suite close, m, m/s; unset: 0.05, 0.002.
        dropout: Probability that a sample is lost; unset: the suite's.
        most_missed: Most samples lost in a row; unset: the suite's.
        initial_position_error, initial_velocity_error: Largest error at first, m, m/s; unset: the suite's without
            losses.

    """

    suite: Literal["none", "far", "near", "close"] = "none"
    estimate: Literal["filter", "observer", "raw"] = "filter"
    position_noise: NonNegative | None = None
    velocity_noise: NonNegative | None = None
    dropout: Annotated[float, Field(ge=0.0, lt=1.0)] | None = None
    most_missed: Annotated[int, Field(ge=0, le=20)] | None = None
    initial_position_error: NonNegative | None = None
    initial_velocity_error: NonNegative | None = None
