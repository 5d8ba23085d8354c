"""What somebody gets who installs hm_sfm. The demo of test_demo.py is run by this installation, too."""

import subprocess
import zipfile

import pytest
from installation import ROOT

pytestmark = pytest.mark.slow


def test_the_wheel_holds_all_of_the_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        licences = {name.rsplit("/", 1)[1] for name in archive.namelist() if ".dist-info/licenses/" in name}
    files = (path for path in (ROOT / "hm_sfm").rglob("*") if path.is_file() and path.suffix != ".pyc")
    assert names == {str(path.relative_to(ROOT)) for path in files}
    assert {"hm_sfm/py.typed", "hm_sfm/report/templates/report.html", "hm_sfm/network/weights/light.pt"} <= names
    assert licences == {"LICENSE", "NOTICE"}


def test_nothing_but_the_core_dependencies_is_installed(installed, tmp_path):
    extras = ["kornia", "matplotlib", "pillow_heif", "plyfile", "pytest", "ray", "pyright"]
    code = f"""
import importlib.util, hm_sfm
print(hm_sfm.__file__)
print([name for name in {extras} if importlib.util.find_spec(name)])
"""
    done = subprocess.run(
        [installed / "python", "-I", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    place, importable = done.stdout.splitlines()
    assert place.startswith(str(installed.parent / "lib")) and importable == "[]"
