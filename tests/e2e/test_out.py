"""OUT in the places where people have it: around the photos, or moved."""

import shutil

import pytest

pytestmark = pytest.mark.slow


def test_out_around_the_photos_and_a_copy_of_it(tiny_photos, tmp_path, run, matched_pairs):
    """hm-sfm match project/images project, as COLMAP's projects are laid out; then cp -r project/* moved/."""
    project, moved = tmp_path / "project", tmp_path / "moved"
    shutil.copytree(tiny_photos, project / "images")
    finished = run("match", project / "images", project, "--quiet")
    assert (finished.code, finished.err) == (0, "") and len(matched_pairs) == 15
    moved.mkdir()
    for entry in project.glob("[!.]*"):
        (shutil.copytree if entry.is_dir() else shutil.copy)(entry, moved / entry.name)
    for out in (project, moved):
        finished = run("match", out / "images", out, "--quiet")
        assert (finished.code, finished.err) == (0, "")
        assert finished.out == f"15 pairs of 6 images matched: {out / 'matches.h5'}\n"
    assert len(matched_pairs) == 15  # nothing again
