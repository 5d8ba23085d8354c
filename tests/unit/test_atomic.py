import pytest

from hm_sfm.errors import InputError
from hm_sfm.io.atomic import make_folder, replace_file


def test_a_file_appears_when_the_block_ends(tmp_path):
    path = tmp_path / "a.txt"
    with replace_file(path) as temporary:
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_block_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error), replace_file(path) as temporary:
        temporary.write_text("half of the n")
        raise error
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


def test_what_a_killed_writer_left_is_overwritten(tmp_path):
    (tmp_path / "a.txt.tmp").write_text("half of the n")
    with replace_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


def test_a_folder_appears_when_the_block_ends_and_not_when_it_fails(tmp_path):
    target = tmp_path / "new" / "folder"
    with pytest.raises(KeyboardInterrupt), make_folder(target) as temporary:
        (temporary / "a.txt").write_text("half")
        raise KeyboardInterrupt
    assert list(target.parent.iterdir()) == []
    target.mkdir()
    with make_folder(target) as temporary:
        (temporary / "a.txt").write_text("whole")
        assert list(target.iterdir()) == []
    assert [path.name for path in target.iterdir()] == ["a.txt"]
    with pytest.raises(InputError, match="folder is there already and not empty"), make_folder(target):
        pass
    assert [path.name for path in target.parent.iterdir()] == ["folder"]
