"""Rows of a benchmark: asked for on a command line, kept in a file as they are made, printed as a table or as JSON."""

import argparse
import fcntl
import json
import sys
import time

from keepout.core.whole_file import write_whole


class Rows:
    """Rows flown so far, in one file that is written whole after each; several runs may share it.

    Args:
        path: of the file; None keeps them in memory alone.
        place: entries that say which row it is: a new one takes the place of the old one.
        settings: further entries that must agree for a row not to be flown again.

    """

    def __init__(self, path, place, settings):
        self.path, self.place, self.settings, self._rows = path, place, settings, []
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)

    @property
    def kept(self):
        """All rows, in the file now where there is one."""
        if self.path is not None and self.path.exists():
            self._rows = json.loads(self.path.read_text())
        return self._rows

    def find(self, plan):
        """Give the row of a plan, if it has been flown with the same settings."""
        names = (*self.place, *self.settings)
        return next((row for row in self.kept if all(row.get(name) == plan.get(name) for name in names)), None)

    def keep(self, row):
        """Keep a row, in place of the one flown with other settings, and write the file."""
        if self.path is None:
            self._rows = self._with(row)
            return
        with open(self.path.with_suffix(".lock"), "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # released as the file is closed
            write_whole(self.path, "[\n" + ",\n".join(json.dumps(one) for one in self._with(row)) + "\n]\n")

    def made(self, plan, make):
        """Give the row of a plan: that found, or what `make` gives beside the plan, which is kept, and told of."""
        row = self.find(plan)
        if row is None:
            row = plan | make()
            self.keep(row)
            sys.stderr.write(json.dumps({name: of for name, of in row.items() if not isinstance(of, list)}) + "\n")
        return row

    def _with(self, row):
        return [*(old for old in self.kept if any(old.get(name) != row.get(name) for name in self.place)), row]


def command(says):
    """Begin a command line that prints rows: a parser that says what the benchmark's docstring says, with --json."""
    parser = argparse.ArgumentParser(description=says, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print a list of rows as JSON")
    return parser


def tell(rows, given, columns=None):
    """Print rows as the command line `given` asks: as JSON, or as a table of columns, by default of all."""
    if given.json:
        sys.stdout.write(json.dumps(rows, indent=1) + "\n")
    else:
        show(rows, columns or rows[0])


def keep(rows, path):
    """Write rows into a file as a list; nothing where no file is asked for."""
    if path is not None:
        write_whole(path, "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")


def on_one_line(fraction, message):
    """Print progress on one line of standard error."""
    print(f"\r{100 * fraction:3.0f} % {message:<100.100}", end="", file=sys.stderr, flush=True)


def timed(work, *given, clock=time.perf_counter):
    """Give the answer of a call, and its seconds."""
    begun = clock()
    answer = work(*given)
    return answer, clock() - begun


def with_meshes(names, folder):
    """Give the names of targets, and the GLB and OBJ files of a folder where there is one."""
    files = () if folder is None else (path for path in folder.iterdir() if path.suffix in (".glb", ".obj"))
    return [*names, *sorted(map(str, files))]


def show(rows, columns):
    """Print rows as a table (Markdown)."""
    sys.stdout.write("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns) + "\n")
    for row in rows:
        shown = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in (row.get(name, "") for name in columns)]
        sys.stdout.write("| " + " | ".join(shown) + " |\n")
