"""The subcommands of ``python -m izoo.contexts`` that reach into other rooms."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from izoo.cli import smoke_test
from izoo.cli.contexts import CONTEXTS
from izoo.contexts.cities import rebuilt as cities
from izoo.networks.dataset.intersections import load_dataset
from izoo.networks.osm.store import save_cmdp

main = CONTEXTS.main
PNG = b"\x89PNG"


@pytest.fixture
def few(published: Path, tmp_path: Path) -> Path:
    """A folder with three of the measured intersections."""
    for folder in sorted(path for path in published.iterdir() if path.is_dir())[:3]:
        shutil.copytree(folder, tmp_path / "few" / folder.name)
    return tmp_path / "few"


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """A folder like those built from OpenStreetMap, with two intersections."""
    changes = {"source": "osm", "city": None, "signal_plan": None}
    specs = {str(k): dataclasses.replace(cities.get("boston")[k], **changes) for k in (3, 4)}
    streets = {"A": "Elm Street"}
    said = {key: {"streets": streets, "lonlat": [-122.0 + 0.001 * int(key), 47.0]} for key in specs}
    save_cmdp(tmp_path / "town", specs, said, {})
    return tmp_path / "town"


def test_import_reports_and_says_what_comes_next(few, here, capsys):
    (few / "broken").mkdir()
    (few / "broken" / "inflows.txt").write_text("1\n")
    assert main(["import", str(few)]) == 0
    out = capsys.readouterr().out
    assert "imported 3 intersections" in out
    assert "unusable: few/broken: it has no net.net.xml" in out
    assert "contexts=dataset contexts.path=datasets/few" in out
    assert len({context.intersection.name for context in load_dataset("datasets/few")}) == 3


@pytest.mark.parametrize("what", ["17", "atlanta/17", "San-Francisco"])
def test_draw_by_id_and_by_city(what, tmp_path, capsys):
    png = tmp_path / "new" / "picture.png"
    assert main(["draw", what, str(png)]) == 0
    assert png.read_bytes().startswith(PNG)
    assert str(png) in capsys.readouterr().out


def test_draw_by_path(few, town, tmp_path):
    one = next(few.iterdir())
    for number, path in enumerate((few, one, town, town / "3.json")):
        png = tmp_path / f"{number}.png"
        assert main(["draw", str(path), str(png)]) == 0
        assert png.read_bytes().startswith(PNG)


def test_a_folder_comes_before_an_id_of_the_catalogue(few, tmp_path, monkeypatch):
    monkeypatch.chdir(few)
    one = next(path.name for path in few.iterdir() if path.name.isdigit())
    drawn = [tmp_path / name for name in ("folder.png", "same.png", "id.png")]
    assert main(["draw", one, str(drawn[0])]) == main(["draw", f"./{one}", str(drawn[1])]) == 0
    monkeypatch.chdir(tmp_path)
    assert main(["draw", one, str(drawn[2])]) == 0
    folder, same, scenario = (path.read_bytes() for path in drawn)
    assert folder == same != scenario
    assert main(["draw", "--", "--5", str(tmp_path / "x.png")]) == 2


def test_bad_input_is_one_sentence_and_leaves_nothing(few, town, tmp_path, refused):
    nodes = "".join(f'<node id="{k}" lat="1.00{k}" lon="1.0"/>' for k in (1, 2, 3))
    way = '<way id="9"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="highway" v="primary"/></way>'
    (tmp_path / "no_signals.osm").write_text(f'<osm version="0.6">{nodes}{way}</osm>')
    (tmp_path / "text.osm").write_text("no extract")
    target, png = str(tmp_path / "out"), str(tmp_path / "out.png")
    before = sorted(tmp_path.rglob("*"))
    for argv, message in (
        (["build", "--osm", str(tmp_path / "no_signals.osm"), target], "no usable intersection with traffic signals"),
        (["build", "--osm", str(tmp_path / "text.osm"), target], "text.osm"),
        (["build", "--osm", "/nowhere.osm", target], "/nowhere.osm"),
        (["import", "/nowhere", target], "/nowhere does not exist"),
        (["import", str(town), target], "holds no intersection folders"),
        (["import", str(few), str(few / "inside")], "within each other"),
        (["draw", "1306720", png], "0 to 1306719"),
        (["draw", "atlanta/621", png], "0 to 620"),
        (["draw", "paris", png], "san_francisco"),
        (["draw", "atlanta", str(tmp_path / "out.pdf")], "must end in .png"),
        (["draw", "atlanta", "/dev/null/out.png"], "/dev/null"),
        (["try", str(town), "--city", "atlanta"], "--city"),
        (["try", "--count", "0"], "--count is 0"),
        (["try", "--horizon-s", "10"], "horizon"),
        (["try", "--city", "paris"], "unknown city"),
        (["count", "--city", "paris"], "unknown city"),
        (["show", "9999999"], "0 to 1306719"),
        (["list", "--limit", "-1"], "--limit"),
    ):
        assert refused(main, argv, message).startswith("izoo contexts: ")
        assert sorted(tmp_path.rglob("*")) == before, argv


def test_try_cities_plays_in_all_of_them(capsys):
    assert main(["try", "--count", "3", "--horizon-s", "60"]) == 0
    assert "3 intersections, 6 episodes, 0 failures" in capsys.readouterr().out


def test_try_plays_towns_and_names_what_fails(town, monkeypatch, capsys):
    assert main(["try", str(town), "--horizon-s", "60"]) == 0
    assert "2 intersections, 4 episodes, 0 failures" in capsys.readouterr().out

    def refuse(*_arguments: object) -> None:
        raise ValueError("no way")

    monkeypatch.setattr(smoke_test, "run_episode", refuse)
    assert main(["try", str(town)]) == 2
    out, err = capsys.readouterr()
    assert "failed: " in out and "ValueError: no way" in out
    assert "4 failures in 2 intersections and 4 episodes." in err
