"""Files that are whole or not there."""

import pytest

from sb3_ddiffpg.utils.disk import written_whole


def test_a_file_is_the_one_before_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "model.zip"
    for content in (b"first", b"second"):
        before = path.read_bytes() if path.exists() else None
        with written_whole(path) as unfinished:
            assert unfinished.suffix == ".zip" and unfinished.parent == tmp_path
            unfinished.write_bytes(content)
            assert (path.read_bytes() if path.exists() else None) == before
        assert path.read_bytes() == content and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
@pytest.mark.parametrize("begun", [False, True])
def test_an_error_leaves_what_was_there(tmp_path, error, begun):
    path = tmp_path / "model.zip"
    path.write_bytes(b"before")
    with pytest.raises(error), written_whole(path) as unfinished:
        if begun:
            unfinished.write_bytes(b"half")
        raise error
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]


def test_what_was_never_written_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError), written_whole(tmp_path / "model.zip"):
        pass
