"""Rows of a benchmark that takes hours: kept in a file as they are flown, and not flown again."""

import fcntl
import json
import sys

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

    def _with(self, row):
        return [*(old for old in self.kept if any(old.get(name) != row.get(name) for name in self.place)), row]


def show(rows, columns):
    """Print rows as a table (Markdown)."""
    sys.stdout.write("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns) + "\n")
    for row in rows:
        shown = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in (row.get(name, "") for name in columns)]
        sys.stdout.write("| " + " | ".join(shown) + " |\n")
