"""Files that are whole or absent, folders that one process uses, and reasons in words that are true."""

import gzip
import subprocess
import sys
from pathlib import Path

import pytest

from izoo import files


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("file", "{0}/file is a file"),
        ("file/below", "a folder of its path is a file"),
        ("link", "{0}/link is a link that leads nowhere"),
        ("folder", "File exists"),
    ],
)
def test_a_path_that_cannot_be_made_says_what_stands_in_the_way(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OSError) as caught:
        (tmp_path / name).mkdir()
    assert files.os_reason(caught.value) == reason.format(tmp_path)


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    files.write_text(path, "old")
    with pytest.raises(UnicodeEncodeError):
        files.write_text(path, "\ud800")
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_a_folder_belongs_to_one_process_at_a_time(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    program = "from pathlib import Path; from izoo.files import claimed; "
    program += f"claimed(Path({str(folder)!r})).__enter__()"
    with files.claimed(folder):
        other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
        assert other.returncode != 0 and "another process works in" in other.stderr
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
    with files.claimed(folder):
        assert list(folder.iterdir()) == []


@pytest.mark.parametrize("existed", [False, True])
@pytest.mark.parametrize("filled", [False, True])
def test_a_folder_that_stays_empty_goes_again(tmp_path: Path, existed: bool, filled: bool) -> None:
    folder = tmp_path / "out"
    if existed:
        folder.mkdir()
    with pytest.raises(KeyError), files.claimed_empty(folder, "out"):
        if filled:
            (folder / "file").touch()
        raise KeyError
    assert folder.exists() == (existed or filled)


def test_free_names_are_counted(tmp_path: Path) -> None:
    (tmp_path / "run-2").touch()
    assert [files.free_folder(tmp_path / "run").name for _ in range(3)] == ["run", "run-3", "run-4"]
    (tmp_path / "runs").symlink_to("nowhere")
    with pytest.raises(FileExistsError):
        files.free_folder(tmp_path / "runs" / "run")


def test_a_key_is_made_once_and_for_its_user_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever of several processes makes it."""
    path = tmp_path / "izoo" / "key"
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    program = [sys.executable, "-c", "from izoo.user_key import own_key; print(own_key().hex())"]
    others = [subprocess.Popen(program, stdout=subprocess.PIPE, text=True) for _ in range(4)]
    keys = {other.communicate()[0].strip() for other in others}
    assert keys == {path.read_bytes().hex()} and path.stat().st_size == 32
    assert path.stat().st_mode & 0o077 == 0 and len(list(path.parent.iterdir())) == 1


def test_what_unpacks_to_more_than_its_bound_is_refused() -> None:
    assert files.unpacked(gzip.compress(bytes(10)), 10) == bytes(10)
    with pytest.raises(OSError, match="more than 10 bytes"):
        files.unpacked(gzip.compress(bytes(11)), 10)


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "new" / "target"
    with files.replacing_folder(target) as staging:
        (staging / "one").touch()
    with pytest.raises(KeyboardInterrupt), files.replacing_folder(target) as staging:
        (staging / "two").touch()
        raise KeyboardInterrupt
    assert [path.name for path in target.iterdir()] == ["one"]
    assert [path.name for path in target.parent.iterdir()] == ["target"]
