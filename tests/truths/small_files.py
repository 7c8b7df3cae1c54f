"""Mesh files written by hand, and what is asked of every refusal of one."""

import io
import signal
import zipfile
from contextlib import contextmanager

import numpy as np
import pytest

from keepout.core.errors import MeshError
from keepout.core.geometry.target import Target

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
METRES = 'unit="meter"'
CORNERS = "".join(f'<vertex x="{x}" y="{y}" z="0"/>' for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
FACES = '<triangle v1="0" v2="1" v3="2"/><triangle v1="0" v2="2" v3="3"/>'
MESH = f"<mesh><vertices>{CORNERS}</vertices><triangles>{FACES}</triangles></mesh>"
BODY = f'<object id="1">{MESH}</object>'
"""A square of two triangles."""
ITEM = '<item objectid="1"/>'
SQUARE = np.array([(0.0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
REFUSED_IN = 4.0
"""Seconds on the processor, all threads together; one on an idle machine."""


def three_mf(resources=BODY, build=ITEM, attributes=METRES, parts=(), head="", encoding="utf-8"):
    """Give the bytes of a 3MF archive with one model and what else is asked for."""
    model = f'<model xmlns="{CORE}" {attributes}><resources>{resources}</resources><build>{build}</build></model>'
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", (head + model).encode(encoding))
        for name, content in parts:
            archive.writestr(name, content)
    return data.getvalue()


def written(path, content):
    """Write text or bytes; give the path."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@contextmanager
def within(seconds):
    """Fail, rather than go on, past a time on the processor: memory would end first."""

    def late(*_):
        pytest.fail(f"not done in {seconds} s")  # no Exception, which a reader would take for a damaged file

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def refused(path, *words, **arguments):
    """The file is refused soon, in one line that names it and says these words."""
    with within(REFUSED_IN), pytest.raises(MeshError) as refusal:
        Target.load(path, **arguments)
    told = str(refusal.value)
    assert "\n" not in told
    assert "TypeCheckError" not in told
    for word in (path.name, *words):
        assert word in told, told


def soup(triangles):
    """Triangles as a sorted set of sorted corners: the surface, whatever the order."""
    return sorted(tuple(sorted(map(tuple, t))) for t in (np.asarray(triangles).round(6) + 0.0).tolist())
