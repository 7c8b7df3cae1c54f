"""CCSDS navigation messages as metadata and rows, in both of their forms: keywords and values (KVN), and XML.

What is common to orbit ephemeris messages (OEM, CCSDS 502.0-B-3) and attitude ephemeris messages (AEM, 504.0-B-2): a
header, and segments of metadata and rows. The meaning of metadata and rows is `ephemeris`'s. A row is an epoch and
numbers, all of them still text. A file of keywords and values holds one message; an XML file holds one, or an `ndm`
(505.0-B) of several, of which all of the wanted kind are read.
"""

import datetime
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

from keepout.core.errors import ExchangeError
from keepout.core.whole_file import write_whole

Kind = Literal["OEM", "AEM"]
Row = tuple[str, ...]

_KEYWORD = re.compile(r"([A-Z][A-Z0-9_]*)\s*=\s*(.*)")
_STATES: dict[Kind, tuple[str, dict[str, str]]] = {
    "OEM": ("stateVector", {"X": "km", "Y": "km", "Z": "km", "X_DOT": "km/s", "Y_DOT": "km/s", "Z_DOT": "km/s"}),
    "AEM": ("attitudeState", dict.fromkeys(("Q1", "Q2", "Q3", "QC"), "")),
}
"""Of a row in XML: its element, and the names of its numbers with their units."""
_LONGEST_LINE = 254
"""Letters of a line, by both standards."""
_KVN_LINE = re.compile(r"\r\n|\r|\n")
_PRINTABLE = re.compile(r"[ -~]+")


@dataclass(frozen=True)
class Segment:
    """The version of the standard, metadata by keyword, and rows of text: an epoch first."""

    version: str
    metadata: dict[str, str]
    rows: tuple[Row, ...]

    def required(self, path: Path, keyword: str) -> str:
        """Give a keyword's value.

        Raises:
            ExchangeError: it is not there.

        """
        if not self.metadata.get(keyword):
            raise ExchangeError(f"{path}: {keyword} is missing; a segment's metadata must have it")
        return self.metadata[keyword]

    def one_of(self, path: Path, keyword: str, valid: Iterable[str]) -> str:
        """Give a keyword's value in capitals.

        Raises:
            ExchangeError: it is not there, or none of the valid ones.

        """
        value = self.required(path, keyword).upper()
        if value not in valid:
            raise ExchangeError(f"{path}: {keyword} is {value}; valid: {', '.join(valid)}")
        return value


def write_message(path: Path, kind: Kind, segment: Segment, *, comments: Sequence[str], xml: bool) -> None:
    """Write a message of one segment, whole or not at all.

    Args:
        path: the file.
        kind: of message.
        segment: its metadata in the standard's order.
        comments: of the header, for people; one that is longer than a line goes on in the next, and letters that are
            not ASCII are written as Python's escapes.
        xml: as XML instead of keywords and values.

    Raises:
        ExchangeError: a value of the metadata is no line of the standard, or the file cannot be written.

    """
    for key, value in segment.metadata.items():
        if not _PRINTABLE.fullmatch(value) or len(f"{key} = {value}") > _LONGEST_LINE or value != value.strip():
            raise ExchangeError(
                f"{path}: {key} would be {value[:60]!r}, {len(value)} characters; valid: printable ASCII, in a line of "
                f"at most {_LONGEST_LINE}"
            )
    ascii_only = (comment.encode("ascii", "backslashreplace").decode() for comment in comments)
    lines = [line for comment in ascii_only for line in textwrap.wrap(comment, _LONGEST_LINE - len("COMMENT "))]
    created = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%S")
    header = [*(("COMMENT", line) for line in lines), ("CREATION_DATE", created), ("ORIGINATOR", "KEEPOUT")]
    write_whole(path, (_xml if xml else _kvn)(kind, segment, header), refusal=ExchangeError)


def _kvn(kind: Kind, segment: Segment, header: Sequence[tuple[str, str]]) -> str:
    lines = [f"CCSDS_{kind}_VERS = {segment.version}"]
    lines += [f"{key} {value}" if key == "COMMENT" else f"{key} = {value}" for key, value in header]
    lines += ["", "META_START", *(f"{key} = {value}" for key, value in segment.metadata.items()), "META_STOP", ""]
    body = [" ".join(row) for row in segment.rows]
    lines += body if kind == "OEM" else ["DATA_START", *body, "DATA_STOP"]
    return "\n".join(lines) + "\n"


def _xml(kind: Kind, segment: Segment, header: Sequence[tuple[str, str]]) -> bytes:
    root = ElementTree.Element(kind.lower(), id=f"CCSDS_{kind}_VERS", version=segment.version)

    def add(parent, name: str, text: str | None = None, **attributes: str):
        child = ElementTree.SubElement(parent, name, attributes)
        child.text = text
        return child

    head = add(root, "header")
    inside = add(add(root, "body"), "segment")
    described, data = add(inside, "metadata"), add(inside, "data")
    for part, entries in ((head, header), (described, segment.metadata.items())):
        for key, value in entries:
            add(part, key, value)
    element, names = _STATES[kind]
    for epoch, *numbers in segment.rows:
        state = add(data, element) if kind == "OEM" else add(add(data, element), "quaternionEphemeris")
        add(state, "EPOCH", epoch)
        inside = state if kind == "OEM" else add(state, "quaternion")
        for (name, unit), number in zip(names.items(), numbers, strict=True):
            add(inside, name, number, **({"units": unit} if unit else {}))
    ElementTree.indent(root)
    return ElementTree.tostring(root, xml_declaration=True, encoding="UTF-8") + b"\n"


def read_message(path: Path, kind: Kind) -> tuple[tuple[Segment, ...], tuple[str, ...]]:
    """Read the segments of all messages of a kind in a file of either form, and its comments.

    Which form, its first character tells.

    An attitude quaternion of an XML message comes as the row Q1, Q2, Q3, QC, and its metadata say so.

    Raises:
        ExchangeError: the file is missing, damaged, or another kind of message.

    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ExchangeError(f"{path}: cannot be read: {error.strerror}") from None
    if content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        return _read_xml(path, kind, content)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ExchangeError(f"{path}: not a text file; an {kind} is text or XML") from None
    return _read_kvn(path, kind, text)


def _read_kvn(path: Path, kind: Kind, text: str) -> tuple[tuple[Segment, ...], tuple[str, ...]]:
    version, segments = "", []
    metadata: dict[str, str] = {}
    rows: list[Row] = []
    comments: list[str] = []
    place = "start"

    def refuse(number: int, line: str, valid: str) -> ExchangeError:
        return ExchangeError(f"{path}: line {number}: {line[:60]!r}; {valid}")

    for number, raw in enumerate(_KVN_LINE.split(text), 1):
        line = raw.strip()
        if not line:
            continue
        if line.split()[0] == "COMMENT":
            comments.append(line.removeprefix("COMMENT").strip())
            continue
        if not line.isascii():
            raise refuse(number, line, "only ASCII may stand there")
        keyword = _KEYWORD.fullmatch(line)
        if place == "start":
            if keyword is None or keyword[1] != f"CCSDS_{kind}_VERS":
                raise refuse(number, line, f"an {kind} begins with CCSDS_{kind}_VERS = …")
            version, place = keyword[2], "header"
        elif place == "covariance":
            place = "data" if line == "COVARIANCE_STOP" else place
        elif line == "META_START" and place in ("header", "data"):
            if place == "data":
                segments.append(Segment(version, metadata, tuple(rows)))
            metadata, rows, place = {}, [], "meta"
        elif line == "META_STOP" and place == "meta":
            place = "data"
        elif place in ("meta", "header"):
            if keyword is None:
                raise refuse(number, line, "a keyword = value must stand there")
            if place == "meta" and keyword[1] in metadata:
                raise refuse(number, line, f"{keyword[1]} must stand there once")
            if place == "meta":
                metadata[keyword[1]] = keyword[2]
        elif line == "COVARIANCE_START" and kind == "OEM":
            place = "covariance"
        elif line == "DATA_START" and place == "data" and kind == "AEM":
            place = "rows"
        elif line == "DATA_STOP" and place == "rows":
            place = "data"
        elif keyword is not None:
            raise refuse(number, line, "a row of an epoch and numbers must stand there")
        elif kind == "AEM" and place == "data":
            raise refuse(number, line, "rows stand between DATA_START and DATA_STOP")
        else:
            rows.append(tuple(line.split()))
    if place != "data":
        raise ExchangeError(f"{path}: ends in its {place}; it is cut off or no {kind}")
    segments.append(Segment(version, metadata, tuple(rows)))
    return tuple(segments), tuple(comments)


def _read_xml(path: Path, kind: Kind, content: bytes) -> tuple[tuple[Segment, ...], tuple[str, ...]]:
    if b"<!DOCTYPE" in content:
        raise ExchangeError(f"{path}: has a DOCTYPE, whose entities may stand for anything; an {kind} has none")
    try:
        root = ElementTree.fromstring(content.lstrip())
    except (ElementTree.ParseError, ValueError) as error:
        raise ExchangeError(f"{path}: damaged or not XML ({' '.join(str(error).split())[:120]})") from None
    if _name(root) not in (kind.lower(), "ndm"):
        raise ExchangeError(f"{path}: its element is {_name(root)!r}; an {kind} in XML is one {kind.lower()!r}")
    segments = []
    for message in (element for element in root.iter() if _name(element) == kind.lower()):
        for segment in (element for element in message.iter() if _name(element) == "segment"):
            segments.append(_segment(path, kind, message.get("version", ""), segment))
    if not segments:
        raise ExchangeError(f"{path}: has no segment of an {kind}; at least one must be there")
    comments = tuple((element.text or "").strip() for element in root.iter() if _name(element) == "COMMENT")
    return tuple(segments), comments


def _segment(path: Path, kind: Kind, version: str, segment) -> Segment:
    parts = {_name(part): part for part in segment}
    if not {"metadata", "data"} <= parts.keys():
        raise ExchangeError(f"{path}: a segment has no metadata or no data; it must have both")
    metadata: dict[str, str] = {}
    for entry in parts["metadata"]:
        if _name(entry) in metadata:
            raise ExchangeError(f"{path}: {_name(entry)} must stand once in a segment's metadata")
        if _name(entry) != "COMMENT":
            metadata[_name(entry)] = _text(path, entry)
    if kind == "AEM":
        metadata["QUATERNION_TYPE"] = "LAST"
    element, names = _STATES[kind]
    rows = tuple(_row(path, state, names) for state in parts["data"] if _name(state) == element)
    return Segment(version, metadata, rows)


def _row(path: Path, state, names: Mapping[str, str]) -> Row:
    """Give the epoch and the named numbers of a state, wherever inside it they stand."""
    row = []
    for name in ("EPOCH", *names):
        found = [element for element in state.iter() if _name(element) == name]
        if len(found) != 1:
            raise ExchangeError(
                f"{path}: a {_name(state)} has {'no' if not found else len(found)} {name}; it must have one each of "
                f"{', '.join(('EPOCH', *names))}"
            )
        unit = found[0].get("units", names.get(name, ""))
        if unit != names.get(name, ""):
            raise ExchangeError(f"{path}: {name} in {unit!r}; it must be in {names[name]!r}")
        row.append(_text(path, found[0]))
    return tuple(row)


def _text(path: Path, element) -> str:
    """Give an element's text, whole: an element inside would end it early."""
    if len(element):
        raise ExchangeError(f"{path}: {_name(element)} holds more than text; text alone is valid")
    return (element.text or "").strip()


def _name(element) -> str:
    """Give an element's name without its namespace."""
    return element.tag.rpartition("}")[2]
