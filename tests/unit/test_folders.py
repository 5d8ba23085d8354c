"""Which files of a folder are photos of the collection."""

import errno
import os

import pytest

from hm_sfm.errors import InputError
from hm_sfm.io.markers import MADE_MARKER, RUN_MARKER
from hm_sfm.photos.folders import find_files


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_linked_folders_are_searched_once_and_circles_end(tmp_path, caplog):
    photos, elsewhere = tmp_path / "photos", tmp_path / "elsewhere"
    touch(photos, "a.jpg", "z/b.jpg", ".hidden/c.jpg", ".d.jpg")
    touch(elsewhere, "e.jpg", "deep/f.jpg", "deep/.g.jpg")
    (photos / "c_link").symlink_to(photos / "z")  # b.jpg keeps the name of its own folder
    (photos / "linked").symlink_to(elsewhere)
    (photos / "linked_again").symlink_to(elsewhere)
    (elsewhere / "deep" / "circle").symlink_to(elsewhere)
    (photos / "z" / "self").symlink_to(photos)
    (photos / "z" / "loop").symlink_to("loop")
    (photos / "file.jpg").symlink_to(elsewhere / "e.jpg")
    names = find_files(photos)
    assert names == ["a.jpg", "file.jpg", "linked/deep/f.jpg", "linked/e.jpg", "z/b.jpg", "z/loop"]
    assert caplog.messages == []
    (photos / "z" / "up").symlink_to(tmp_path)
    assert find_files(photos) == names
    assert caplog.messages == [f"left out: the folder {photos / 'z' / 'up'} is a link to a folder around the photos"]
    (tmp_path / "link").symlink_to(photos)
    assert find_files(tmp_path / "link") == names


@pytest.mark.parametrize("marker", [RUN_MARKER, MADE_MARKER])
def test_what_hm_sfm_made_is_left_out(tmp_path, caplog, marker):
    touch(tmp_path, "a.jpg", f"out/{marker}", "out/images/a.jpg", f"sub/out/{marker}", "sub/out/b.jpg", "sub/c.jpg")
    (tmp_path / "linked").symlink_to(tmp_path / "out")
    assert find_files(tmp_path) == ["a.jpg", "sub/c.jpg"]
    assert caplog.messages == [f"left out: the folder {tmp_path / 'out'} was made by hm_sfm, and 1 more"]
    assert find_files(tmp_path / "out") == ["images/a.jpg"]  # asked for by its name


def test_what_storage_devices_made_is_left_out(tmp_path, caplog):
    touch(tmp_path, "a.jpg", "@eaDir/a.jpg/SYNOPHOTO_THUMB_XL.jpg", "x/@eaDir/b.jpg", "#recycle/c.jpg", "x/d.jpg")
    assert find_files(tmp_path) == ["a.jpg", "x/d.jpg"]
    assert caplog.messages == [f"left out: the folder {tmp_path / '#recycle'} was made by a storage device, and 2 more"]


def test_folders_that_cannot_be_searched_are_named(tmp_path, caplog, monkeypatch):
    def refuse_closed(path):  # root, whom tests may run as, may search every folder
        if path.name == "closed":
            raise PermissionError(errno.EACCES, "Permission denied")
        return scan(path)

    scan = os.scandir
    monkeypatch.setattr(os, "scandir", refuse_closed)
    touch(tmp_path, "a.jpg", "closed/b.jpg")
    assert find_files(tmp_path) == ["a.jpg"]
    assert caplog.messages == [f"left out: the folder {tmp_path / 'closed'} cannot be searched: Permission denied"]


def test_no_folder(tmp_path):
    touch(tmp_path, "a.jpg")
    for name, reason in {"b": "does not exist", "a.jpg": "is not a folder"}.items():
        with pytest.raises(InputError, match=f"{name} {reason}"):
            find_files(tmp_path / name)
