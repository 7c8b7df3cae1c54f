"""Python as one guesses it: programs of a few lines, one way to read a mission, docstrings that name what is asked."""

import dataclasses
import inspect
import re

import numpy as np
import pytest

import keepout
from keepout.core.errors import KeepoutError
from keepout.core.guard.field import guard_field

MISSION = """
name = "small"
duration = 20.0
[target]
source = "box"
[field]
source = "grid"
[control]
guidance = "straight"
[guard]
enabled = false
"""


class Coasting(keepout.Law):
    """A law that never fires."""

    goal = np.array([0.0, -10.0, -4.0])

    def initial_state(self, start):
        """Remember nothing."""
        return ()

    def step(self, memory, estimate):
        """Command no force."""
        return memory, keepout.Command.of_force(np.zeros(3))


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    path = tmp_path_factory.mktemp("mission") / "mission.toml"
    path.write_text(MISSION, encoding="utf-8")
    return path


@pytest.mark.long
def test_a_mesh_a_field_a_law_and_a_verdict_and_what_a_flight_can_do(mission, tmp_path):
    target = keepout.Target.load("box")
    prepared = keepout.prepare(mission, target=target, model=guard_field(target, 0.5))
    flight = keepout.fly(prepared.with_law(Coasting()))
    assert not flight.record.force.any()
    verdict, summary, table = flight.verdict, flight.summary(), flight.table()
    assert (verdict.contact, verdict.certified) == ("proved free", None)
    assert f"{summary['minimum_clearance_m']:.4g} m" in verdict.why
    assert summary["minimum_clearance_m"] <= flight.clearance.min() <= summary["measured_clearance_m"] + 1e-3
    assert table.num_rows == flight.record.steps + 1
    np.testing.assert_array_equal(table["position_y"].to_numpy(), flight.record.position[:, 1])
    kept = keepout.FlightRecord.load(flight.save(tmp_path / "flight.parquet"))
    assert kept.columns.keys() == flight.record.columns.keys()
    assert flight.plot(tmp_path / "flight.png").axes
    bare = dataclasses.replace(flight, mission=None)  # without the surfaces of field and guard, which take long to cut
    shown = bare._repr_html_()
    assert "proved free" in shown
    assert "<img" in shown
    assert "srcdoc=" in shown
    with pytest.raises(KeepoutError, match=r"mission\.txt: a replay is a page; its name ends in \.html"):
        flight.replay(tmp_path / "mission.txt")

    handed = flight.export("oem", tmp_path / "handed")
    assert sorted(path.name for path in handed) == ["chaser.oem", "target.oem"]
    told = keepout.audit(*handed, target=target, chaser_radius=0.5, acceleration_bound=0.01)
    assert told["contact_verdict"] == "no"
    assert told["minimum_clearance_m"] <= told["measured_clearance_m"]
    assert told["measured_clearance_m"] == pytest.approx(summary["measured_clearance_m"], abs=2e-3)


@pytest.mark.parametrize(
    "verb", ["fly", "prepare", "check", "campaign", "explore", "inspect", "rare", "fit", "describe", "measure"]
)
def test_every_verb_reads_a_mission_in_the_same_way(verb, tmp_path):
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[chaser]\nmass = -1.0\n", encoding="utf-8")
    told = []
    for given in (wrong, str(wrong), {"chaser": {"mass": -1.0}}):
        with pytest.raises(KeepoutError) as refusal:
            getattr(keepout, verb)(given)
        told.append(str(refusal.value).partition("chaser.")[2])
    assert set(told) == {"mass: -1.0 must be greater than 0"}


def test_a_dot_after_a_scenario_offers_its_entries_and_nothing_of_pydantic():
    made, scenario = (
        {name for name in dir(of) if not name.startswith("_")} for of in (keepout.Scenario, keepout.Scenario())
    )
    assert scenario == made | set(keepout.Scenario.model_fields)
    assert made == {"load", "of", "parse", "replace", "resolved", "steps"}


def test_old_names_warn_and_are_what_they_were():
    for name in keepout._OLD:
        with pytest.warns(DeprecationWarning, match=f"keepout.{name} goes"):
            assert callable(getattr(keepout, name))
        assert name not in keepout.__all__
    assert keepout._OLD["with_field"][0].endswith("Mission.with_field")


def public_functions():
    """Give every public function, and every public method of a public class, of the package's own, by its name."""
    for name in keepout.__all__:
        thing = getattr(keepout, name)
        if inspect.isfunction(thing):
            yield f"keepout.{name}", thing
        elif inspect.isclass(thing):
            for key, of in vars(thing).items():
                of = of.__func__ if isinstance(of, classmethod | staticmethod) else of
                if inspect.isfunction(of) and not key.startswith("_"):
                    yield f"keepout.{name}.{key}", of


def told(words, section):
    """Give what a docstring says of each name in a section."""
    lines = inspect.cleandoc(words).partition(f"{section}:\n")[2].partition("\n\n")[0]
    entries = re.split(r"^    (\**\w+): ", lines, flags=re.MULTILINE)[1:]
    return {name.lstrip("*"): words for name, words in zip(entries[::2], entries[1::2], strict=True)}


UNIT = re.compile(
    r"(?<![\w.])(m|s|kg|N|rad|m[/²³]s?²?|rad/s|1/s²?|metres|ratio|relative|fraction|share|quaternion|axes|‖∇f̃‖)(?![\w(])"
)
FRAME = re.compile(r"\b(body|VVLH|inertial|orbital)\b")
IN_A_FRAME = re.compile(r"(?<!least_)(position|velocity|force|attitude)$")


def unsaid(name, annotation, words, whole):
    """Say which of unit and frame the words on a quantity leave out; `whole` is the docstring that they stand in."""
    quantity = re.search(r"\bfloat\b|Float\[", str(annotation)) and not re.search("Callable|dict", str(annotation))
    if quantity and not name.endswith("seconds") and not UNIT.search(words):
        yield "unit"
    if quantity and IN_A_FRAME.search(name) and not FRAME.search(whole):
        yield "frame"


def test_a_public_name_says_what_each_argument_is_and_when_it_refuses():
    silent = []
    for name, function in public_functions():
        code, words = inspect.unwrap(function), function.__doc__ or ""
        said = told(words, "Args")
        for key, of in inspect.signature(code).parameters.items():
            if key not in ("self", "cls"):
                lacking = unsaid(key, of.annotation, said[key], words) if key in said else ["all"]
                silent += [f"{name}, {key}: {what}" for what in lacking]
        if re.search(r"\braise \w+Error", inspect.getsource(code)) and "Raises:" not in words:
            silent.append(f"{name}: Raises")
    assert not silent, "\n".join(silent)


def test_a_public_class_says_in_what_unit_and_frame_each_number_is():
    silent = []
    for name in keepout.__all__:
        of = getattr(keepout, name)
        if inspect.isclass(of) and dataclasses.is_dataclass(of):
            whole = "\n\n".join(inspect.cleandoc(base.__doc__ or "") for base in of.__mro__)
            said = {key: text for base in of.__mro__ for key, text in told(base.__doc__ or "", "Attributes").items()}
            for field in dataclasses.fields(of):
                lacking = unsaid(field.name, field.type, said.get(field.name, whole), whole)
                silent += [f"{name}.{field.name}: {what}" for what in lacking]
    assert not silent, "\n".join(silent)
