"""Scenarios: one typed tree, one TOML file.

Every entry is in SI units. A value outside its range, an unknown key or a missing one is refused with the entry's name,
the value, and what would be valid; nothing is guessed.
"""

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from keepout.errors import ScenarioError


def _finite(vector: tuple[float, ...]) -> tuple[float, ...]:
    if not all(abs(x) < float("inf") for x in vector):
        raise ValueError("must be three finite numbers")
    return vector


Vector = Annotated[tuple[float, float, float], AfterValidator(_finite)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-6.3, le=6.3)]


class Entry(BaseModel):
    """A table of a scenario: immutable, and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


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
    """The learned field that the control law flies by."""

    source: str = Field(default="shipped", description='"shipped" for a built-in target, or a .keepout file')


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

    enabled: bool = True
    position_error: NonNegative = Field(default=0.0, description="largest error of the position estimate, m")
    velocity_error: NonNegative = Field(default=0.0, description="largest error of the velocity estimate, m/s")
    mass_error: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(default=0.0, description="largest relative error")
    gain_error: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(default=0.0, description="of the thrusters, relative")
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

    @model_validator(mode="after")
    def _stuck_is_named(self) -> "FaultsEntry":
        if self.stuck is None and (self.stuck_force or self.stuck_from):
            raise ValueError('stuck_force and stuck_from need stuck = "+x", "-x", "+y", "-y", "+z" or "-z"')
        return self


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

    @model_validator(mode="after")
    def _spacing_of_a_grid(self) -> "ControlEntry":
        guidance = self.guidance or ("geodesic" if self.profile == "default" else "straight")
        if self.spacing is not None and guidance != "geodesic":
            raise ValueError(f'spacing {self.spacing} m is for guidance = "geodesic", and guidance is "{guidance}"')
        return self


class OrbitEntry(Entry):
    """The target's orbit about the Earth."""

    semi_major_axis: Annotated[float, Field(gt=6.4e6, lt=1e9)] = Field(default=42_164_000.0, description="m")
    eccentricity: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
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


class AttitudeEntry(Entry):
    """How the target turns."""

    kind: Literal["vvlh", "inertial", "tumbling"] = Field(
        default="vvlh", description="fixed to VVLH, fixed to the stars, free"
    )
    angular_velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="tumbling: inertial, in body axes, rad/s")
    inertia: tuple[Vector, Vector, Vector] = Field(
        default=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), description="tumbling: tensor in body axes, kg m2"
    )

    @model_validator(mode="after")
    def _only_tumbling_turns(self) -> "AttitudeEntry":
        if self.kind != "tumbling" and any(self.angular_velocity):
            raise ValueError(f'an angular_velocity needs kind = "tumbling", not "{self.kind}"')
        return self


class DisturbanceEntry(Entry):
    """The force that nobody commanded, in body axes."""

    kind: Literal["none", "paper", "constant", "bang-bang", "resonant", "random"] = "paper"
    force: Vector | None = Field(default=None, description="constant: N")
    amplitude: Positive | None = Field(default=None, description="bang-bang, resonant, random: largest norm, N")
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


class StateEntry(Entry):
    """The chaser's state relative to the target, in body axes."""

    position: Vector = Field(default=(0.0, 10.0, 6.0), description="m")
    velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="m/s")


class GoalEntry(Entry):
    """Where to go."""

    position: Vector = Field(default=(0.0, -10.0, -4.0), description="m")
    tolerance: Positive = Field(default=0.1, description="reached when it stays within this, m")


class CampaignEntry(Entry):
    """Many flights from random starts at rest."""

    runs: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    lower: Vector = Field(default=(-15.0, -5.0, -4.0), description="lower corner of the box of starts, m")
    upper: Vector = Field(default=(15.0, 5.0, -4.0), description="upper corner of the box of starts, m")

    @model_validator(mode="after")
    def _ordered(self) -> "CampaignEntry":
        if any(low > high for low, high in zip(self.lower, self.upper)):
            raise ValueError(f"lower {list(self.lower)} must not exceed upper {list(self.upper)}")
        return self


class Scenario(Entry):
    """One mission: target, chaser, law, environment, start and goal. The defaults are the source paper's Case 1."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")] = "case1"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    duration: Annotated[float, Field(gt=0.0, le=1e6, allow_inf_nan=False)] = Field(default=1500.0, description="s")
    target: TargetEntry = TargetEntry()
    field: FieldEntry = FieldEntry()
    chaser: ChaserEntry = ChaserEntry()
    safety: SafetyEntry = SafetyEntry()
    guard: GuardEntry = GuardEntry()
    control: ControlEntry = ControlEntry()
    orbit: OrbitEntry = OrbitEntry()
    drag: DragEntry = DragEntry()
    attitude: AttitudeEntry = AttitudeEntry()
    disturbance: DisturbanceEntry = DisturbanceEntry()
    faults: FaultsEntry = FaultsEntry()
    start: StateEntry = StateEntry()
    goal: GoalEntry = GoalEntry()
    campaign: CampaignEntry = CampaignEntry()

    @model_validator(mode="after")
    def _at_least_a_step(self) -> "Scenario":
        if self.duration < self.control.period:
            raise ValueError(f"duration {self.duration} s is shorter than one control period, {self.control.period} s")
        return self

    @model_validator(mode="after")
    def _thrusters_give_no_more(self) -> "Scenario":
        if self.faults.stuck_force > self.chaser.force_limit:
            raise ValueError(
                f"faults.stuck_force {self.faults.stuck_force} N is more than chaser.force_limit, "
                f"{self.chaser.force_limit} N; a stuck thruster gives from 0 to that"
            )
        return self

    @property
    def steps(self) -> int:
        """Whole control periods flown: the duration's, rounded to the nearest."""
        return round(self.duration / self.control.period)

    @classmethod
    def parse(cls, tree: dict[str, Any], *, where: str = "scenario") -> "Scenario":
        """Validate a nested dictionary.

        Raises:
            ScenarioError: an entry is unknown, missing or out of range; names all of them in one line.

        """
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            reasons = "; ".join(_reason(item, cls) for item in error.errors())
            # A key may hold a line break; a refusal is one line whatever was given.
            raise ScenarioError(" ".join(f"{where}: {reasons}".split())) from None

    @classmethod
    def load(cls, path: str | Path) -> "Scenario":
        """Read a TOML file; paths inside it are relative to it.

        Raises:
            ScenarioError: the file is missing, not TOML, or has an invalid entry.

        """
        path = Path(path)
        try:
            tree = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ScenarioError(f"{path}: cannot be read ({error.strerror}); give a scenario in TOML") from None
        except UnicodeDecodeError:
            raise ScenarioError(f"{path}: not a text file; give a scenario in TOML") from None
        except tomllib.TOMLDecodeError as error:
            raise ScenarioError(f"{path}: not valid TOML: {error}") from None
        return cls.parse(tree, where=str(path))._resolved(path.parent)

    def replace(self, **entries: Any) -> "Scenario":
        """Return a copy with whole tables or single entries replaced, as in `replace(seed=1, goal={"position": …})`.

        Raises:
            ScenarioError: a new value is invalid.

        """
        tree = self.model_dump()
        for key, value in entries.items():
            if isinstance(value, dict) and isinstance(tree.get(key), dict):
                tree[key] = tree[key] | value
            else:
                tree[key] = value
        return type(self).parse(tree)

    def _resolved(self, folder: Path) -> "Scenario":
        """Make file names absolute, so that a scenario means the same wherever it is run from."""
        changes: dict[str, dict[str, str]] = {}
        for key, source in (("target", self.target.source), ("field", self.field.source)):
            if Path(source).suffix and not Path(source).is_absolute():
                changes[key] = {"source": str((folder / source).resolve())}
        return self.replace(**changes) if changes else self


def _reason(item: Any, model: type[BaseModel]) -> str:
    """Turn one pydantic finding into the entry's name, the value and what would be valid."""
    name = ".".join(str(part) for part in item["loc"])
    value = item["input"]
    if item["type"] == "extra_forbidden":
        valid = _valid_keys(item["loc"][:-1], model)
        near = difflib.get_close_matches(str(item["loc"][-1]), valid, n=1)
        hint = f"did you mean {near[0]}?" if near else f"valid: {', '.join(valid)}"
        return f"{name}: no such entry; {hint}"
    message = item["msg"].removeprefix("Value error, ").removeprefix("Input ").replace("should be", "must be")
    shown = "" if isinstance(value, dict | BaseModel) else f"{value!r} "
    return f"{name}: {shown}{message}" if name else message


def _valid_keys(location: tuple[Any, ...], model: type[BaseModel]) -> list[str]:
    for part in location:
        annotation = model.model_fields[str(part)].annotation if str(part) in model.model_fields else None
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return []
        model = annotation
    return list(model.model_fields)


def reference() -> str:
    """Write the table of all entries as Markdown: name, default, what it means."""
    lines = ["# Scenario entries", "", "SI units. Every entry has a default; an empty file is valid.", ""]
    lines += [
        "Made by `python -m keepout.mission.scenario`.",
        "",
        "| entry | default | meaning |",
        "| --- | --- | --- |",
    ]
    for name, field in Scenario.model_fields.items():
        kind = field.annotation
        if not (isinstance(kind, type) and issubclass(kind, Entry)):
            lines.append(_row(name, field.default, field.description))
            continue
        lines.append(_row(f"**[{name}]**", None, (kind.__doc__ or "").splitlines()[0]))
        for key, entry in kind.model_fields.items():
            lines.append(_row(f"{name}.{key}", entry.get_default(call_default_factory=True), entry.description))
    return "\n".join(lines) + "\n"


def _row(name: str, default: Any, meaning: str | None) -> str:
    shown = "" if default is None else f"`{default}`"
    return f"| {name} | {shown} | {meaning or ''} |"


if __name__ == "__main__":
    print(reference(), end="")
