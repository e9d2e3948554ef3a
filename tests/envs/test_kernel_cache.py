"""Compiled kernels are forgotten when what they were compiled from changes, and only then."""

from __future__ import annotations

from pathlib import Path

import pytest

from izoo.envs import kernel_cache


def test_compiled_kernels_go_when_a_source_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "kernels.py"
    source.write_text("x = 1")
    cache = tmp_path / "__pycache__"
    cache.mkdir()
    compiled, foreign = cache / "kernels.place-1.py311.nbi", cache / "other.f-1.py311.nbi"
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(kernel_cache, "__file__", str(tmp_path / "kernel_cache.py"))
    monkeypatch.setattr(kernel_cache, "kernel_sources", lambda: [source])
    kernel_cache.forget_stale_kernels()
    compiled.touch()
    foreign.touch()
    kernel_cache.forget_stale_kernels()
    assert compiled.exists()
    source.write_text("x = 2")
    kernel_cache.forget_stale_kernels()
    assert not compiled.exists()
    assert foreign.exists()


def test_every_source_exists() -> None:
    assert all(path.is_file() for path in kernel_cache.kernel_sources())
