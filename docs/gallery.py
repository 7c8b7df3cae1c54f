"""Write the gallery: a page for each example with its text, its command, and what came out.

python docs/gallery.py              # run every example, which takes an hour or two, and write all pages
python docs/gallery.py case1 faults # run these, and write all pages
python docs/gallery.py --pages      # run nothing: write all pages, with the outputs that they have
python docs/gallery.py --check      # compare the pages with the examples' present text

What came out is kept in docs/gallery: printed lines in the page, pictures beside it as small PNG files.
"""

import argparse
import ast
import base64
import contextlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]
EXAMPLES = REPOSITORY / "examples"
GALLERY = REPOSITORY / "docs" / "gallery"
WIDTH, MOST = 900, 60_000
"""Of a picture: pixels, bytes."""
MACHINE = re.compile(r"│ (seconds|processors|computed in s) |  \"median_step_us\"")
"""Begins a printed line that tells of the machine, which no page has."""
SHOWN = 60
"""Printed lines of a page; of more, those in the middle are left out."""
FLOWN = "import runpy, sys; flown = runpy.run_path(sys.argv[1], run_name='__main__'); flown['flight'].plot(sys.argv[2])"
"""Runs an example as it is, and draws the flight that it leaves."""


@dataclass(frozen=True)
class Example:
    """One page.

    Attributes:
        title: of the page.
        files: of examples/, in the order in which they are shown; the first one says what all of it shows.
        command: that runs it; empty for a notebook, which is run cell by cell.
        pictures: that it writes, below the folder where it was run, or "plot" for that of the flight that it flies.
        seen: what to look at in them.

    """

    title: str
    files: tuple[str, ...]
    command: str = ""
    pictures: tuple[str, ...] = ()
    seen: str = ""


def _file(name: str, title: str, verb: str, *pictures: str, seen: str = "") -> Example:
    command = f"keepout {verb} examples/{name}.toml -o out/{name}"
    return Example(title, (f"{name}.toml",), command, tuple(f"out/{name}/{one}" for one in pictures), seen)


def _own(name: str, title: str, *pictures: str, seen: str = "") -> Example:
    return Example(title, (f"{name}.py",), f"python examples/{name}.py", pictures, seen)


_PATH = "The path from two sides, then clearance, speed, force and the distance to the goal over time."
GALLERY_PAGES = {
    "first_flight": Example("Notebook: a first flight", ("first_flight.ipynb",)),
    "law_against_the_papers": Example(
        "Notebook: a law of your own against the paper's", ("law_against_the_papers.ipynb",)
    ),
    "case1": _file(
        "case1", "The paper's Case 1", "fly", "paths.png", "clearance.png", seen="The path, and the clearance."
    ),
    "faults": _file(
        "faults",
        "A hostile flight",
        "fly",
        "paths.png",
        "clearance.png",
        seen="The law steers into the body; the guard holds.",
    ),
    "approach": _file(
        "approach",
        "An approach in legs",
        "fly",
        "paths.png",
        "approach.png",
        seen="The path, then velocity and speed allowed, force, disturbance.",
    ),
    "campaign": _file(
        "campaign", "Five hundred flights", "campaign", "report/distributions.png", "report/influences.png"
    ),
    "explore": _file("explore", "A target that is not as expected", "explore", "seen.png", "map.png"),
    "inspect": _file("inspect", "See all of a satellite", "inspect", "contact-sheet.png", "coverage.png"),
    "inspect-in-light": _file("inspect-in-light", "See all that the sun lights", "inspect", "contact-sheet.png"),
    "own_law": _own("own_law", "A law of your own", "plot", seen=_PATH),
    "own_policy": _own("own_policy", "Policies under the guard", "plot", seen=f"The network's flight. {_PATH}"),
    "own_guidance": _own("own_guidance", "A guidance of your own", "plot", seen=_PATH),
    "own_field": _own("own_field", "A field of your own", "plot", seen=_PATH),
    "own_disturbance": _own("own_disturbance", "A disturbance of your own", "plot", seen=_PATH),
    "own_thrusters": _own("own_thrusters", "Thrusters of your own", "plot", seen=_PATH),
    "tune_gain": _own("tune_gain", "A gain tuned by the flight's derivative"),
    "paper_step": _own("paper_step", "The paper's control step in NumPy"),
    "compare_laws": _own("compare_laws", "Laws on the same pairs"),
    "learn_a_policy": Example(
        "Learn a policy behind the guard",
        ("learn_a_policy.py",),
        "python examples/learn_a_policy.py",
        ("out/learn_a_policy.png",),
        "The mean return and the share of contacts over the generations, with the guard and without it.",
    ),
    "basilisk": Example(
        "Flight software in Basilisk",
        ("basilisk/fly.py", "basilisk/basilisk_world.py", "basilisk/mission.toml"),
        "make basilisk",
    ),
}


def told(path: Path) -> str:
    """Give the first sentence of an example's docstring, first comment or first cell."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        first = ast.get_docstring(ast.parse(text)) or ""
    elif path.suffix == ".toml":
        comments = re.match(r"(#[^\n]*\n)+", text)
        first = re.sub(r"^# ?", "", comments[0], flags=re.MULTILINE) if comments else ""
    else:
        first = "".join(json.loads(text)["cells"][0]["source"]).split("\n", 1)[1].strip()
    paragraph = " ".join(first.split("\n\n")[0].split())
    return re.split(r"(?<=[.!?])\s+(?=[A-Z`])", paragraph)[0]


def fenced(language: str, text: str) -> str:
    """Give a block of a page."""
    return f"```{language}\n{text.rstrip()}\n```\n"


def page(name: str, printed: str, pictures: list[str]) -> str:
    """Give the text of a page."""
    example = GALLERY_PAGES[name]
    first = EXAMPLES / example.files[0]
    parts = [f"# {example.title}\n", f"{told(first)}\n"]
    if first.suffix == ".ipynb":
        link = f"The notebook is `examples/{example.files[0]}`. Below are its cells, and what came out of them.\n"
        return "\n".join([*parts, link, *cells(name, json.loads(first.read_text(encoding="utf-8")))])
    parts += ["## Run it\n", fenced("console", example.command)]
    if printed:
        parts += ["It prints:\n", fenced("text", printed)]
    if pictures and example.seen:
        parts.append(f"{example.seen}\n")
    parts += [f"![{example.title}]({picture})\n" for picture in pictures]
    for file in example.files:
        language = {".py": "python", ".toml": "toml"}[Path(file).suffix]
        parts += [f"## examples/{file}\n", fenced(language, (EXAMPLES / file).read_text(encoding="utf-8"))]
    return "\n".join(parts)


def cells(name: str, notebook: dict[str, Any]) -> list[str]:
    """Give the cells of a notebook as parts of a page, its first heading left out."""
    parts = []
    for number, cell in enumerate(notebook["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            if number:
                parts.append(source + "\n")
            continue
        parts.append(fenced("python", source))
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                parts.append(f"![What the cell draws]({name}-{number}.png)\n")
            else:
                parts.append(fenced("text", "".join(output.get("text", data.get("text/plain", "")))))
    return parts


def kept(name: str) -> tuple[str, list[str]]:
    """Give what is kept of the last run: the printed lines, from the page, and the pictures' names."""
    path = GALLERY / f"{name}.md"
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    block = re.search(r"^It prints:\n\n```text\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    return block[1] if block else "", sorted(one.name for one in GALLERY.glob(f"{name}-[0-9]*.png"))


def index() -> str:
    """Give the text of the gallery's first page."""
    rows = []
    for name, example in GALLERY_PAGES.items():
        pictures = kept(name)[1]
        thumbnail = f"![]({pictures[0]})<br>" if pictures else ""
        rows.append(f"| [{thumbnail}{example.title}]({name}.md) | {told(EXAMPLES / example.files[0])} |")
    head = (
        "# Gallery\n\nThis page is for somebody who looks for something to start from: each file of `examples/`, with\n"
        "the command that runs it and what came out.\n\n| example | what it shows |\n| --- | --- |\n"
    )
    return head + "\n".join(rows) + "\n"


def readme() -> str:
    """Give the text of examples/README.md."""
    lines = []
    for example in GALLERY_PAGES.values():
        first, run = example.files[0], f"`{example.command}`" if example.command else "any Jupyter"
        lines.append(f"| [{first}]({first}) | {told(EXAMPLES / first)} | {run} |")
    head = "# Examples\n\nThe gallery of the documentation shows what comes out of each.\n\n"
    return head + "| file | what it shows | run it by |\n| --- | --- | --- |\n" + "\n".join(lines) + "\n"


def written() -> dict[Path, str]:
    """Give every file that is written from the examples and what is kept of their runs."""
    pages = {GALLERY / f"{name}.md": page(name, *kept(name)) for name in GALLERY_PAGES}
    return pages | {GALLERY / "index.md": index(), EXAMPLES / "README.md": readme()}


def small(picture: bytes) -> bytes:
    """Give a picture with few colours, not wider than `WIDTH` and at most `MOST` bytes."""
    from PIL import Image

    image = Image.open(io.BytesIO(picture)).convert("RGB")
    width = min(WIDTH, image.width)
    while True:
        size = (width, round(image.height * width / image.width))
        out = io.BytesIO()
        image.resize(size, Image.Resampling.LANCZOS).quantize(128, kmeans=2).save(out, "PNG", optimize=True)
        if len(out.getvalue()) <= MOST:
            return out.getvalue()
        width = round(0.9 * width)


def keep(name: str, printed: str, pictures: list[bytes]) -> None:
    """Keep what came out of a run."""
    GALLERY.mkdir(exist_ok=True)
    for old in GALLERY.glob(f"{name}-[0-9]*.png"):
        old.unlink()
    names = [f"{name}-{number}.png" for number in range(len(pictures))]
    for one, picture in zip(names, pictures):
        (GALLERY / one).write_bytes(small(picture))
    lines = [line.rstrip() for line in printed.splitlines() if not MACHINE.match(line)]
    if len(lines) > SHOWN:
        lines = [*lines[: SHOWN // 2], "...", *lines[-SHOWN // 2 :]]
    (GALLERY / f"{name}.md").write_text(page(name, "\n".join(lines), names), encoding="utf-8")


def run(name: str) -> None:
    """Run an example in an empty folder, and keep what came out."""
    example = GALLERY_PAGES[name]
    if not example.command:
        return run_notebook(name)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "examples").symlink_to(EXAMPLES)
        words = shlex.split(example.command)
        if example.pictures == ("plot",):
            words = [sys.executable, "-c", FLOWN, words[1], "plot.png"]
        elif words[0] == "keepout":
            words = [sys.executable, "-m", "keepout.cli", *words[1:]]
        elif words[0] == "python":
            words = [sys.executable, *words[1:]]
        where = REPOSITORY if words[0] == "make" else folder
        variables = os.environ | {"COLUMNS": "100", "MPLBACKEND": "agg"}
        done = subprocess.run(words, cwd=where, env=variables, stdout=subprocess.PIPE, text=True)
        if done.returncode:
            raise SystemExit(f"{name}: exit code {done.returncode}")
        drawn = ("plot.png",) if example.pictures == ("plot",) else example.pictures
        keep(name, done.stdout, [(folder / one).read_bytes() for one in drawn])


def cell_run(source: str, names: dict[str, Any], say: Callable[[str], None]) -> Any:
    """Run a cell as notebooks do: what its last line is worth is its answer."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "cell", "exec"), names)
        value = eval(compile(ast.Expression(last.value), "cell", "eval"), names) if last is not None else None
    say(printed.getvalue())
    return value


def run_notebook(name: str) -> None:
    """Run a notebook's cells in this process, keep the outputs in it, and its pictures beside its page."""
    import matplotlib

    matplotlib.use("agg")
    path = EXAMPLES / GALLERY_PAGES[name].files[0]
    notebook, names = json.loads(path.read_text(encoding="utf-8")), {"__name__": "__main__"}
    GALLERY.mkdir(exist_ok=True)
    for old in GALLERY.glob(f"{name}-[0-9]*.png"):
        old.unlink()
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] != "code":
            continue
        said: list[str] = []
        value = cell_run("".join(cell["source"]), names, said.append)
        outputs: list[dict[str, Any]] = []
        if said[0]:
            outputs.append({"output_type": "stream", "name": "stdout", "text": said[0].splitlines(keepends=True)})
        data = {}
        if hasattr(value, "savefig"):
            drawn = io.BytesIO()
            value.savefig(drawn, format="png", dpi=100)
            picture = small(drawn.getvalue())
            (GALLERY / f"{name}-{number}.png").write_bytes(picture)
            data = {"image/png": base64.b64encode(picture).decode(), "text/plain": ["<Figure>"]}
        elif value is not None:
            data = {"text/plain": repr(value).splitlines(keepends=True)}
        if data:
            count = sum(one["cell_type"] == "code" for one in notebook["cells"][: number + 1])
            outputs.append({"output_type": "execute_result", "execution_count": count, "metadata": {}, "data": data})
        cell["outputs"] = outputs
        cell["execution_count"] = sum(one["cell_type"] == "code" for one in notebook["cells"][: number + 1])
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def main() -> None:
    """Run, write or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(GALLERY_PAGES)}")
    parser.add_argument("--check", action="store_true", help="compare only")
    parser.add_argument("--pages", action="store_true", help="run nothing")
    asked = parser.parse_args()
    unknown = set(asked.names) - set(GALLERY_PAGES)
    if unknown:
        parser.error(f"no page {', '.join(sorted(unknown))}")
    if not (asked.check or asked.pages):
        for name in asked.names or GALLERY_PAGES:
            print(name, flush=True)
            run(name)
    if asked.check:
        stale = [path for path, text in written().items() if not path.is_file() or path.read_text("utf-8") != text]
        if stale:
            names = ", ".join(path.relative_to(REPOSITORY).as_posix() for path in stale)
            raise SystemExit(f"{names}: not of this version; run python docs/gallery.py --pages")
        return
    for path, text in written().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
