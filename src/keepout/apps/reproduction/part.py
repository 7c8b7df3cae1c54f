"""What a part of a reproduction hands over: tables, figures and words, each beside what the paper states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from keepout.core.mission.flight import Flight
from keepout.flights.pages.page import Table

__all__ = ["Drawing", "Part", "Table"]


@dataclass(frozen=True)
class Drawing:
    """A figure of a reproduction: `<name>.png` and `<name>.svg` in the part's folder.

    Attributes:
        name: of its files, without ending.
        caption: what it shows, plain text.

    """

    name: str
    caption: str


@dataclass(frozen=True)
class Part:
    """One part of the paper's Section VI, repeated.

    Attributes:
        name: as on the command line.
        title: heading on the page.
        paper: what the paper states of it, plain text.
        ours: what was found, plain text, a paragraph each.
        rows: one row a flight, field or campaign; see `named_rows`.
        tables: each becomes a CSV file and a table of the page.
        drawings: each is a PNG and an SVG file that stand in the part's folder.
        flights: to be replayed on the page, all around one target.

    """

    name: str
    title: str
    paper: str
    ours: Sequence[str]
    rows: Sequence[dict[str, Any]]
    tables: Sequence[Table] = ()
    drawings: Sequence[Drawing] = ()
    flights: Mapping[str, Flight] = field(default_factory=dict)

    @property
    def named_rows(self) -> list[dict[str, Any]]:
        """Its rows as `--json` and `summary.json` list them among those of other parts: each with its name first."""
        return [{"experiment": self.name, **row} for row in self.rows]
