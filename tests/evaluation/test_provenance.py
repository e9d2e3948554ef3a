"""The digest of the package's own files: a changed simulator never meets old numbers."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from izoo.evaluation import provenance


@pytest.fixture
def digest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], str]:
    """What computes the digest of a package ``made_up`` in ``tmp_path`` anew."""
    (tmp_path / "made_up" / "inner" / "__pycache__").mkdir(parents=True)
    for name in ("__init__.py", "inner/__init__.py", "inner/rules.py", "inner/table.json", "inner/__pycache__/x.nbi"):
        (tmp_path / "made_up" / name).write_text("1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "made_up", raising=False)
    monkeypatch.setattr(provenance, "SIMULATED_BY", {"made_up": None})
    return provenance.code_digest.__wrapped__


@pytest.mark.parametrize("name", ["inner/rules.py", "inner/table.json"])
def test_files_in_folders_inside_a_room_count(digest: Callable[[], str], tmp_path: Path, name: str) -> None:
    before = digest()
    (tmp_path / "made_up" / name).write_text("2\n")
    assert digest() != before


def test_what_compilers_leave_does_not_count(digest: Callable[[], str], tmp_path: Path) -> None:
    before = digest()
    (tmp_path / "made_up" / "inner" / "__pycache__" / "x.nbi").write_text("2\n")
    assert digest() == before


def test_the_files_that_it_names_exist() -> None:
    """A renamed file must not drop out of the digest unnoticed."""
    for package, names in provenance.SIMULATED_BY.items():
        folder = Path(__import__(package, fromlist=["x"]).__path__[0])
        assert all((folder / name).is_file() for name in names or ()), package
