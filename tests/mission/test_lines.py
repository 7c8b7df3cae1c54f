"""A refusal of a scenario file names the line on which its entry stands, and the nearest entry that there is."""

import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from keepout.errors import ScenarioError
from keepout.mission.lines import entry_lines, line_of
from keepout.mission.scenario import Scenario

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.toml"))


def refused(tmp_path: Path, text: str) -> str:
    path = tmp_path / "mission.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError) as refusal:
        Scenario.load(path)
    said = str(refusal.value)
    assert said.startswith(f"{path}: ")
    assert "\n" not in said
    return said.removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[chaser]\nmasss = 3\n", "line 2: chaser.masss: no such entry; did you mean mass?"),
        ("\n# a\nsafty = 1\n", "line 3: safty: no such entry; did you mean safety?"),
        ("[chaser]\n\nmargin = 0.1", "line 3: chaser.margin: no such entry; did you mean safety.margin?"),
        (
            "[guard]\nposition = [0.0, 1.0, 2.0]",
            "line 2: guard.position: no such entry; did you mean position_error or start.position or",
        ),
        ("[target]\nposition = [0.0, 1.0, 2.0]", "did you mean rotation or start.position or goal.position?"),
        ("[chaser]\nduration = 3.0", "did you mean duration?"),
        ("[start]\nposition = [\n  0.0, # m\n  nan,\n  1.0,\n]\n", "line 2: start.position: [0.0, nan, 1.0] must be"),
        ("[disturbance]\n# none\nkind = 'constant'\n", 'line 3: disturbance: kind = "constant" needs force'),
        ("[control]\nguidance = 'straight'\nspacing = 0.2", "line 3: control: spacing 0.2 m is for"),
        ("name = 'a'\n[control]\nperiod = 2000.0", "duration 1500.0 s is shorter than one control period"),
        ("name = 'a'\nduration = 0.5", "line 2: duration 0.5 s is shorter"),
        ("control.paper.k_p = 3", "line 1: control.paper.k_p: no such entry; valid: slowing_length"),
        (
            '[campaign.dispersions]\n"chaser.mass" = {uniform = [3, 1]}',
            "line 2: campaign.dispersions.chaser.mass: uniform",
        ),
        ("[[chaser]]\nmass = 3\n", "line 1: chaser: "),
        ("[chaser]\nmass = '''\nheavy\n'''\nradius = -1", "line 2: chaser.mass: "),
        (
            "[chaser]\nmass = '''\nheavy\n'''\nradius = -1",
            "line 5: chaser.radius: -1 must be greater than or equal to 0",
        ),
        ("[chaser]\nmass = \n", "not valid TOML: Invalid value (at line 2"),
        ("[chaser]\nmass = 1\nmass = 2\n", "not valid TOML: Cannot overwrite a value (at line 3"),
    ],
)
def test_the_line_is_named(tmp_path, text, said):
    assert said in refused(tmp_path, text)


def test_without_a_file_no_line_is_named():
    with pytest.raises(ScenarioError, match=r"^scenario: chaser\.masss"):
        Scenario.parse({"chaser": {"masss": 3}})


key = st.from_regex(r"[a-z]{1,4}", fullmatch=True)
number = st.integers(-9, 9).map(str)
plain = st.one_of(
    number,
    st.sampled_from(["true", '"a # b"', "'[x]'", "{q = 1, r = [2, 3]}", "[1, 2]"]),
    st.sampled_from(["[\n 1,\n # here\n 2\n]", "'''\n[t]\nz = 1\n'''", '"""a\\\n   b = 2"""']),
)
between = st.lists(st.sampled_from(["", "# note", "  # [table]", "\t"]), max_size=2)


@given(
    st.lists(
        st.tuples(key, st.lists(st.tuples(key, plain, between), max_size=4, unique_by=lambda e: e[0]), between),
        max_size=4,
        unique_by=lambda table: table[0],
    ),
    st.booleans(),
)
def test_every_entry_of_any_file_is_found_where_it_was_written(tables, windows):
    """The lines are counted here as the text is put together, with no reader of TOML."""
    lines: list[str] = []
    written = {}
    for name, entries, notes in tables:
        lines += notes
        lines.append(f"[{name}]")
        written[(name,)] = len(lines)
        for entry, value, inner in entries:
            lines += inner
            written[(name, entry)] = len(lines) + 1
            lines += f"{entry} = {value}".split("\n")
    text = "\n".join(lines)
    found = entry_lines(text.replace("\n", "\r\n") if windows and '"""' not in text else text)
    assert {path: line for path, line in found.items() if len(path) <= 2} == written


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_have_every_entry(path):
    text = path.read_text(encoding="utf-8")
    lines, found = text.split("\n"), entry_lines(text)

    def walk(tree, place=()):
        for name, value in tree.items():
            assert line_of(found, (*place, name)) == found[(*place, name)]
            assert re.search(rf'(^|[."\[{{ ])"?{re.escape(name)}\b', lines[found[(*place, name)] - 1].strip())
            if isinstance(value, dict):
                walk(value, (*place, name))

    walk(tomllib.loads(text))


@given(st.text(max_size=60))
def test_any_text_is_a_scenario_or_a_refusal_in_one_line(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("any") / "mission.toml"
    path.write_text(text, encoding="utf-8", errors="surrogatepass", newline="")
    said = ""
    try:
        Scenario.load(path)
    except ScenarioError as refusal:
        said = str(refusal)
    assert "\n" not in said
