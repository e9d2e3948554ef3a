"""Why a path could not be used, in words that are true."""

from __future__ import annotations

from pathlib import Path

import pytest

from izoo.errors import os_reason


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
    assert os_reason(caught.value) == reason.format(tmp_path)
