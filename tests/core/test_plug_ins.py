import subprocess
import sys

from keepout.core import plug_ins


def test_all_that_rooms_add_is_there():
    for group in plug_ins.GROUPS:
        for name in plug_ins.names(group):
            assert plug_ins.load(group, name) is not None, (group, name)


def test_to_know_the_names_loads_no_room():
    code = (
        "import sys; from keepout.core.geometry.mesh_files import READERS; assert '.keepmap' in READERS;"
        "assert not [name for name in sys.modules if name.startswith(('keepout.apps', 'keepout.flights'))]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
