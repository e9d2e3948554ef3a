"""The cache of nets: where it lies, and what is removed from it."""

import pytest

from izoo.contexts.procedural import procedural_intersection
from izoo.errors import IzooError
from izoo.networks.net import net_cache as cache
from izoo.networks.net.build import build_net


def test_nothing_is_written_outside_the_cache(tmp_path, monkeypatch):
    home, here = tmp_path / "home", tmp_path / "here"
    home.mkdir()
    here.mkdir()
    for name in ("HOME", "XDG_CACHE_HOME", "TMPDIR"):
        monkeypatch.setenv(name, str(home))
    monkeypatch.chdir(here)
    build_net(procedural_intersection(), tmp_path / "cache")
    assert list(home.iterdir()) == list(here.iterdir()) == []
    assert [path.suffixes for path in (tmp_path / "cache" / "nets").iterdir()] == [[".net", ".xml"]]


def test_a_folder_that_cannot_be_made_is_explained(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(IzooError, match=r"cannot write to the cache folder .* IZOO_CACHE_DIR"):
        cache.cache_folder(tmp_path / "file")
