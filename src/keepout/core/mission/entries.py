"""The tables of a scenario, each an immutable set of entries with ranges; `scenario.py` puts them together.

Every entry is in SI units. What depends on two entries of one table is checked in that table.
"""

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


class Entry(BaseModel):
    """A table of a scenario: immutable, without unknown keys, and with values of the kind that each entry asks for.

    `true` and `"5"` are no numbers, and 1 is no flag; a whole number is a number, and a list is a vector.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> Any:
        """Make every number, flag and text of the table strict; `strict` of the model would refuse lists as well."""
        return _strict(handler(source))


class TargetEntry(Entry):
    """What is flown around."""

    source: str = Field(
        default="intelsat30", description="a built-in target's name, or a mesh file (relative to the scenario)"
    )
    units: Literal["m", "cm", "mm", "in", "ft"] | None = Field(default=None, description="length unit of the mesh file")
    scale: Positive | None = Field(default=None, description="metres per unit of the mesh file, instead of `units`")
    drop_stray: bool = Field(default=False, description="leave out parts far from the rest")
    thickness: Positive | None = Field(default=None, description="of a point cloud: each point is a ball this wide, m")
    rotation: tuple[Vector, Vector, Vector] | None = Field(default=None, description="from file axes to body axes")
    origin: Vector | None = Field(default=None, description="of the body frame, in file axes, m")
    centre_of_mass: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="of the target, about which it turns and which orbits, in the body frame, m",
    )
    parameters: dict[str, float] = Field(default_factory=dict, description="of a built-in: wing angle, wing span, …")

    @model_validator(mode="after")
    def _one_scale(self) -> "TargetEntry":
        if self.units is not None and self.scale is not None:
            raise ValueError("give either units or scale, not both")
        return self


class FieldEntry(Entry):
    """The field that the control law flies by."""

    source: str = Field(
        default="shipped",
        description='"shipped" for a built-in target; "grid", made of exact distances when it is needed, for any; or a '
        ".keepout file",
    )


class ChaserEntry(Entry):
    """The chaser: a ball of `radius` with one thruster pair an axis."""

    mass: Positive = Field(default=20.0, description="kg")
    radius: NonNegative = Field(default=0.5, description="of the ball that holds the chaser, m")
    force_limit: Positive = Field(default=0.1, description="per body axis, N")
    speed_limit: Positive = Field(default=0.1, description="m/s")


class SafetyEntry(Entry):
    """What is kept between chaser and target beyond what is proved."""

    margin: NonNegative = Field(default=0.1, description="the operator's own, m")


class GuardEntry(Entry):
    """The hard layer that accepts or replaces every commanded force, and what its theorem may assume."""

    enabled: bool = Field(default=True, description="whether it flies along")
    position_error: NonNegative = Field(default=0.0, description="largest error of the position estimate, m")
    velocity_error: NonNegative = Field(default=0.0, description="largest error of the velocity estimate, m/s")
    mass_error: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(default=0.0, description="largest relative error")
    gain_error: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(default=0.0, description="of the thrusters, relative")
    keeps_margin: bool = Field(
        default=False, description="whether its theorem too keeps `safety.margin`, and not only from contact"
    )
    delay: Annotated[int, Field(ge=0, le=8)] = Field(
        default=0, description="from command to effect, control periods; the control law predicts its state over it too"
    )


class FaultsEntry(Entry):
    """What goes wrong in flight, drawn from the scenario's seed; law and guard know only what `guard` says of it."""

    law: Literal["none", "into the body", "through", "random", "bang-bang", "not a number"] = Field(
        default="none",
        description="what replaces the law's force: full thrust into the body, straight through to the goal at twice "
        "the speed limit, random forces, full thrust in a random corner for 15 periods each, NaN in every 15th command",
    )
    position_bias: NonNegative = Field(default=0.0, description="constant error of the estimate, random direction, m")
    velocity_bias: NonNegative = Field(default=0.0, description="the same of its velocity, m/s")
    position_noise: NonNegative = Field(default=0.0, description="largest error drawn anew each period, m")
    velocity_noise: NonNegative = Field(default=0.0, description="the same of its velocity, m/s")
    position_noise_std: NonNegative = Field(
        default=0.0, description="standard deviation of a Gaussian error of each axis, which has no bound, m"
    )
    velocity_noise_std: NonNegative = Field(default=0.0, description="the same of its velocity, m/s")
    noise_correlation_time: NonNegative = Field(
        default=0.0, description="over which the Gaussian errors fall to a third (1/e); 0: new ones each period, s"
    )
    delay: Annotated[int, Field(ge=0, le=100)] = Field(
        default=0, description="true delay from command to effect, control periods"
    )
    dropped: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(
        default=0.0, description="probability that a command is lost; the last one then goes on"
    )
    gain_error: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(
        default=0.0, description="each axis gives 1 ± this of its command, drawn once a flight"
    )
    stuck: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = Field(
        default=None, description="the thruster that is stuck, by the direction it pushes in"
    )
    stuck_force: NonNegative = Field(
        default=0.0, description="what it then gives: 0 stuck off, force_limit stuck on, N"
    )
    stuck_from: NonNegative = Field(default=0.0, description="when it sticks, s")
    thruster: Annotated[int, Field(ge=0)] | None = Field(
        default=None, description="of a layout, the thruster that is stuck, counted from 0"
    )
    thruster_stuck: Literal["on", "off"] = Field(default="off", description="how")

    @model_validator(mode="after")
    def _stuck_is_named(self) -> "FaultsEntry":
        if self.stuck is None and (self.stuck_force or (self.stuck_from and self.thruster is None)):
            raise ValueError('stuck_force and stuck_from need stuck = "+x", "-x", "+y", "-y", "+z" or "-z"')
        if self.thruster is None and self.thruster_stuck != "off":
            raise ValueError("thruster_stuck needs thruster, its number")
        return self

    @model_validator(mode="after")
    def _correlated_noise_is_there(self) -> "FaultsEntry":
        if self.noise_correlation_time and not (self.position_noise_std or self.velocity_noise_std):
            raise ValueError("noise_correlation_time needs position_noise_std or velocity_noise_std")
        return self


class PaperEntry(Entry):
    """What the paper's law needs and the paper does not print; only for `profile = "paper"`."""

    slowing_length: Positive = Field(
        default=1.5, description="k_p of the desired velocity v_max tanh(r_e/k_p), by component, m"
    )
    sharpness: Positive = Field(default=1.0, description="ε of the smooth safety filter")
    position_weight: Positive = Field(default=1.0, description="H₀ of the Lyapunov function is this times the identity")
    gradient_error: NonNegative = Field(default=0.0, description="e_∇h; above 0 the barrier row becomes a cone")


class ControlEntry(Entry):
    """The control law."""

    profile: Literal["default", "paper"] = Field(
        default="default", description="the recommended law, or the paper's constants"
    )
    period: Positive = Field(default=1.0, description="between control steps, s")
    guidance: Literal["geodesic", "straight"] | None = Field(default=None, description="unset: the profile's own")
    spacing: Positive | None = Field(
        default=None, description="of the geodesic grid, m; unset: from the room and the zone's width"
    )
    circulation: Literal["none", "printed", "skew", "switching"] | None = Field(
        default=None, description="unset: the profile's"
    )
    observer: Literal["harmonic", "constant", "printed", "off"] | None = Field(
        default=None, description="unset: the profile's own"
    )
    paper: PaperEntry = PaperEntry()

    @model_validator(mode="after")
    def _paper_of_its_profile(self) -> "ControlEntry":
        if self.profile != "paper" and self.paper != PaperEntry():
            named = ", ".join(f"paper.{key}" for key in self.paper.model_dump(exclude_defaults=True))
            raise ValueError(f'{named}: only for profile = "paper", and profile is "{self.profile}"')
        return self

    @model_validator(mode="after")
    def _spacing_of_a_grid(self) -> "ControlEntry":
        guidance = self.guidance or ("geodesic" if self.profile == "default" else "straight")
        if self.spacing is not None and guidance != "geodesic":
            raise ValueError(f'spacing {self.spacing} m is for guidance = "geodesic", and guidance is "{guidance}"')
        return self


class OrbitEntry(Entry):
    """The target's orbit about the Earth."""

    semi_major_axis: Annotated[float, Field(gt=6.4e6, lt=1e9)] = Field(default=42_164_000.0, description="m")
    eccentricity: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(default=0.0, description="0: a circle")
    true_anomaly: Angle = Field(default=0.0, description="at the start, rad")
    inclination: Angle = Field(default=0.0, description="rad; this and the next two count only with j2 or drag")
    right_ascension: Angle = Field(default=0.0, description="of the ascending node, rad")
    argument_of_perigee: Angle = Field(default=0.0, description="rad")
    j2: bool = Field(default=False, description="whether the Earth's oblateness bends both orbits")

    @model_validator(mode="after")
    def _above_ground(self) -> "OrbitEntry":
        perigee = self.semi_major_axis * (1.0 - self.eccentricity)
        if perigee < 6.4e6:
            raise ValueError(f"the perigee radius is {perigee:.4g} m, inside the Earth; it must be at least 6.4e6 m")
        return self


class DragEntry(Entry):
    """Drag of both spacecraft in an exponential atmosphere that turns with the Earth."""

    density: NonNegative = Field(default=0.0, description="of the air at `altitude`, kg/m3; 0: no drag")
    altitude: NonNegative = Field(default=400_000.0, description="above the equatorial radius, m")
    scale_height: Annotated[float, Field(ge=1e3, le=1e6)] = Field(
        default=60_000.0, description="over which the density falls to a third (1/e), m"
    )
    target_area_to_mass: NonNegative = Field(default=0.02, description="drag coefficient × area / mass, m2/kg")
    chaser_area_to_mass: NonNegative = Field(default=0.02, description="drag coefficient × area / mass, m2/kg")


class SunEntry(Entry):
    """Sunlight: where it comes from, and how it pushes both spacecraft."""

    direction: Vector | None = Field(
        default=None, description="from the Earth to the sun, ECI, any length; unset: where it is at `epoch`"
    )
    target_area_to_mass: NonNegative = Field(
        default=0.0, description="radiation pressure coefficient × area / mass, m2/kg; 0: no push"
    )
    chaser_area_to_mass: NonNegative = Field(
        default=0.0, description="radiation pressure coefficient × area / mass, m2/kg; 0: no push"
    )

    @model_validator(mode="after")
    def _points_somewhere(self) -> "SunEntry":
        if self.direction is not None and not any(self.direction):
            raise ValueError("direction [0, 0, 0] points nowhere; give a vector from the Earth to the sun")
        return self


class AttitudeEntry(Entry):
    """How the target turns."""

    kind: Literal["vvlh", "inertial", "tumbling"] = Field(
        default="vvlh", description="fixed to VVLH, fixed to the stars, free"
    )
    angular_velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="tumbling: inertial, in body axes, rad/s")
    inertia: tuple[Vector, Vector, Vector] = Field(
        default=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), description="tumbling: tensor in body axes, kg m2"
    )
    gravity_gradient: bool = Field(default=False, description="tumbling: whether the Earth's gravity turns it")

    @model_validator(mode="after")
    def _only_tumbling_turns(self) -> "AttitudeEntry":
        if self.kind != "tumbling" and any(self.angular_velocity):
            raise ValueError(f'an angular_velocity needs kind = "tumbling", not "{self.kind}"')
        if self.kind != "tumbling" and self.gravity_gradient:
            raise ValueError(f'gravity_gradient needs kind = "tumbling", not "{self.kind}"')
        return self


class DisturbanceEntry(Entry):
    """The force that nobody commanded, in body axes."""

    kind: Literal["none", "paper", "constant", "bang-bang", "resonant", "random"] = Field(
        default="paper",
        description="paper: 0.01 [sin 0.02 t, cos 0.02 t, sin 0.01 t] N; bang-bang: changes sign every 50 s; resonant: "
        "with every control step; random: smooth noise from the seed",
    )
    force: Vector | None = Field(default=None, description="constant: N")
    amplitude: Positive | None = Field(default=None, description="bang-bang, resonant, random: largest norm, N")
    phase: Angle = Field(
        default=0.0,
        description="paper, random: added to that of every sinusoid; bang-bang, resonant: a full turn is a period; "
        "none and constant have none, rad",
    )
    bound: Positive | None = Field(
        default=None, description="what the control law may assume, N; unset: the true bound"
    )

    @model_validator(mode="after")
    def _complete(self) -> "DisturbanceEntry":
        if self.kind == "constant" and self.force is None:
            raise ValueError('kind = "constant" needs force = [x, y, z] in N')
        if self.kind in ("bang-bang", "resonant", "random") and self.amplitude is None:
            raise ValueError(f'kind = "{self.kind}" needs amplitude in N')
        return self

    @model_validator(mode="after")
    def _phase_of_what_repeats(self) -> "DisturbanceEntry":
        if self.phase and self.kind in ("none", "constant"):
            raise ValueError(
                f'phase {self.phase} rad is for kind = "paper", "bang-bang", "resonant" or "random"; '
                f'"{self.kind}" has none'
            )
        return self


class StateEntry(Entry):
    """The chaser's state relative to the target, in body axes."""

    position: Vector = Field(default=(0.0, 10.0, 6.0), description="m")
    velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="m/s")


class GoalEntry(Entry):
    """Where to go."""

    position: Vector = Field(default=(0.0, -10.0, -4.0), description="m")
    tolerance: Positive = Field(default=0.1, description="reached when it stays within this, m")


class RareEntry(Entry):
    """What `keepout rare` draws beside the scenario's faults."""

    start_position_std: NonNegative = Field(
        default=0.0, description="standard deviation of each axis of the start about start.position, m"
    )
    start_velocity_std: NonNegative = Field(default=0.0, description="the same about start.velocity, m/s")


Amount = float | Vector
"""A number, or one for each component of a vector."""


class DispersionEntry(Entry):
    """How one entry varies from run to run of a campaign: one of `uniform`, `normal`, `choice` and `sphere`."""

    uniform: tuple[Amount, Amount] | None = Field(
        default=None, description="[least, largest]; of a vector: two corners of a box"
    )
    normal: tuple[Amount, Amount] | None = Field(
        default=None, description="[mean, standard deviation], cut off at `within`; of a vector: each component"
    )
    within: Annotated[float, Field(gt=0.0, le=8.0)] = Field(
        default=3.0, description="of normal: cut off at so many standard deviations"
    )
    choice: tuple[Any, ...] | None = Field(default=None, description="values to choose from")
    weights: tuple[NonNegative, ...] | None = Field(
        default=None, description="of choice: how often each, relative to the others; unset: all alike"
    )
    sphere: NonNegative | tuple[NonNegative, NonNegative] | None = Field(
        default=None, description="of a vector: any direction, with this length or one between [least, largest]"
    )
    centre: Vector = Field(default=(0.0, 0.0, 0.0), description="of sphere: what the vector is added to")

    @model_validator(mode="after")
    def _one_of_its_kinds(self) -> "DispersionEntry":
        kinds = ("uniform", "normal", "choice", "sphere")
        given = [kind for kind in kinds if getattr(self, kind) is not None]
        if len(given) != 1:
            raise ValueError(f"needs one of {', '.join(kinds)}, and has {' and '.join(given) or 'none'}")
        for key, of in (("within", "normal"), ("weights", "choice"), ("centre", "sphere")):
            if getattr(self, key) != type(self).model_fields[key].default and of != given[0]:
                raise ValueError(f"{key} is for {of}, and this is {given[0]}")
        return self

    @model_validator(mode="after")
    def _in_order(self) -> "DispersionEntry":
        for kind in ("uniform", "sphere"):
            ends = getattr(self, kind)
            if isinstance(ends, tuple):
                pairs = zip(*(end if isinstance(end, tuple) else (end,) for end in ends))
                if not all(-float("inf") < low <= high < float("inf") for low, high in pairs):
                    raise ValueError(f"{kind} {list(ends)}: finite, and the first must not exceed the second")
        if self.normal is not None:
            spread = self.normal[1] if isinstance(self.normal[1], tuple) else (self.normal[1],)
            if not all(0.0 <= part < float("inf") for part in spread):
                raise ValueError(f"normal: a standard deviation of {self.normal[1]}; it must be finite and at least 0")
        if self.choice is not None and not self.choice:
            raise ValueError("choice: no values to choose from")
        if self.weights is not None and (len(self.weights) != len(self.choice or ()) or not sum(self.weights) > 0.0):
            raise ValueError(f"weights: {list(self.weights)}; one for each value of choice, not all 0")
        return self


class CampaignEntry(Entry):
    """Many flights: from random starts at rest in a box, or with whatever `dispersions` names drawn anew for each."""

    runs: Annotated[int, Field(ge=1, le=1_000_000_000)] = Field(default=100, description="how many flights")
    lower: Vector = Field(
        default=(-15.0, -5.0, -4.0), description="lower corner of the box of starts, m; without dispersions"
    )
    upper: Vector = Field(
        default=(15.0, 5.0, -4.0), description="upper corner of the box of starts, m; without dispersions"
    )
    sampling: Literal["random", "latin-hypercube", "sobol"] = Field(
        default="random", description="how the dispersed numbers are drawn, over all of them together"
    )
    dispersions: dict[str, DispersionEntry] = Field(
        default_factory=dict,
        description='what varies, by dotted name: `"chaser.mass" = {uniform = [18, 22]}`; see docs/campaigns.md',
    )

    @model_validator(mode="after")
    def _ordered(self) -> "CampaignEntry":
        if any(low > high for low, high in zip(self.lower, self.upper)):
            raise ValueError(f"lower {list(self.lower)} must not exceed upper {list(self.upper)}")
        return self
