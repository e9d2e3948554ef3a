"""Compiled kernels are forgotten when what they were compiled from changes, and only then."""

from __future__ import annotations

from pathlib import Path

import pytest

from izoo.envs import stale


def test_compiled_kernels_go_when_a_source_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "kernels.py"
    source.write_text("x = 1")
    cache = tmp_path / "__pycache__"
    cache.mkdir()
    compiled, foreign = cache / "kernels.place-1.py311.nbi", cache / "other.f-1.py311.nbi"
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(stale, "__file__", str(tmp_path / "stale.py"))
    monkeypatch.setattr(stale, "kernel_sources", lambda: [source])
    stale.forget_stale_kernels()
    compiled.touch()
    foreign.touch()
    stale.forget_stale_kernels()
    assert compiled.exists()
    source.write_text("x = 2")
    stale.forget_stale_kernels()
    assert not compiled.exists()
    assert foreign.exists()


def test_every_source_exists() -> None:
    assert all(path.is_file() for path in stale.kernel_sources())
