"""Import of folders and archives, with hostile ones among them."""

import csv
import json
import stat
import zipfile
from pathlib import Path

import pytest

from izoo.errors import IzooError
from izoo.networks.dataset.importing import import_dataset
from izoo.networks.dataset.intersections import load_dataset
from tests.networks.test_dataset import NET, write

GOOD = {"net.net.xml": NET, "inflows.txt": "1\n1\n1\n"}


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Two usable intersections and three broken folders."""
    folder = tmp_path / "salt-lake-city"
    write(folder / "10", inflows="0\n0\n0\n")
    write(folder / "9", inflows="1000\n0\n0\n")
    write(folder / "11", NET[:-30], "1\n1\n1\n")
    write(folder / "12", inflows="1\n")
    (folder / "13").mkdir()
    (folder / "summary.csv").write_text("a,b\n")
    return folder


def pack(path: Path, members: dict[str, str | bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


def tree(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def test_copies_the_usable_folders_and_says_why_others_are_not(tmp_path: Path, source: Path) -> None:
    target, seen = tmp_path / "target", []
    report = import_dataset(source, target, progress=lambda done, total: seen.append((done, total)))
    assert [spec.name for spec in report.usable] == ["salt_lake_city/9", "salt_lake_city/10"]
    assert set(report.unusable) == {f"salt-lake-city/{name}" for name in ("11", "12", "13")}
    assert "not well-formed" in report.unusable["salt-lake-city/11"]
    assert "1 lines for the 3 legs" in report.unusable["salt-lake-city/12"]
    assert "no net.net.xml" in report.unusable["salt-lake-city/13"]
    assert ".partial" not in str(report) and seen == [(k, 5) for k in range(1, 6)]
    assert tree(target) == {
        "index.csv",
        "manifest.json",
        "salt-lake-city",
        *(f"salt-lake-city/{k}{name}" for k in (9, 10) for name in ("", "/net.net.xml", "/inflows.txt")),
    }
    with (target / "index.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["city"], row["approaches"], row["with_demand"]) for row in rows] == [
        ("salt_lake_city", "A", "A"),
        ("salt_lake_city", "A", ""),
    ]
    assert json.loads((target / "manifest.json").read_text())["intersections"] == 2
    (context,) = load_dataset(target)
    assert context.name == "salt_lake_city/9/A" and context.intersection.city == "salt_lake_city"


def test_zip_and_folder_give_the_same_import(tmp_path: Path, source: Path) -> None:
    names = [path for path in source.rglob("*") if path.is_file()]
    members = {path.relative_to(tmp_path).as_posix(): path.read_bytes() for path in names}
    archive = pack(tmp_path / "download.zip", {**members, "salt-lake-city/13/": b"", "__MACOSX/9/net.net.xml": b"x"})
    zipped, plain = import_dataset(archive, tmp_path / "one"), import_dataset(source, tmp_path / "two")
    assert zipped.unusable == plain.unusable
    assert [spec.name for spec in zipped.usable] == [spec.name for spec in plain.usable]
    assert tree(tmp_path / "one") == tree(tmp_path / "two")
    windows = pack(tmp_path / "windows.zip", {name.replace("/", "\\"): content for name, content in members.items()})
    import_dataset(windows, tmp_path / "three")
    assert tree(tmp_path / "three") == tree(tmp_path / "two")


def test_a_single_intersection_and_an_archive_without_a_top_folder(tmp_path: Path, source: Path) -> None:
    import_dataset(source / "9", tmp_path / "one")
    assert (tmp_path / "one" / "salt-lake-city" / "9" / "net.net.xml").is_file()
    flat = pack(tmp_path / "atlanta.zip", {"5/net.net.xml": NET, "5/inflows.txt": "1\n1\n1\n"})
    assert import_dataset(flat, tmp_path / "two").usable[0].city == "atlanta"


def test_hostile_archives_do_nothing_outside_the_target(tmp_path: Path) -> None:
    """Names that lead elsewhere, links, and files that would fill the memory or hold entities."""
    entity = '<!DOCTYPE net [<!ENTITY a "' + "a" * 99 + '">]>' + NET.replace('speed="13.41"', 'speed="&a;"')
    members: dict[str, str | bytes] = {f"t/1/{name}": content for name, content in GOOD.items()}
    for folder in ("../evil", "t/../../evil", "/evil", "C:/evil", "..\\evil", "\\evil"):
        members |= {f"{folder}.txt": "evil"} | {f"{folder}/{name}": content for name, content in GOOD.items()}
    members |= {"t/2/net.net.xml": b" " * (17 * 1024**2), "t/2/inflows.txt": "1", "t/notes": bytes(80 * 1024**2)}
    members |= {"t/3/net.net.xml": entity, "t/3/inflows.txt": "1\n1\n1\n", "t/4/inflows.txt": "1\n1\n1\n"}
    archive = pack(tmp_path / "x.zip", members)
    link = zipfile.ZipInfo("t/4/net.net.xml")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(archive, "a") as file:
        file.writestr(link, "/etc/passwd")
    report = import_dataset(archive, tmp_path / "target")
    assert {path.name for path in tmp_path.iterdir()} == {"x.zip", "target"}
    assert all(path.resolve().is_relative_to(tmp_path / "target") for path in (tmp_path / "target").rglob("*"))
    assert "larger than 16 MiB" in report.unusable["t/2"] and "EntitiesForbidden" in report.unusable["t/3"]
    assert "not well-formed XML" in report.unusable["t/4"]
    (tmp_path / "held").symlink_to(tmp_path / "target")
    with pytest.raises(IzooError, match="is not a folder"):
        import_dataset(archive, tmp_path / "held")


def test_damaged_archives_are_named(tmp_path: Path, source: Path) -> None:
    (tmp_path / "x.zip").write_bytes(b"not a zip")
    with pytest.raises(IzooError, match="neither a folder nor a readable zip"):
        import_dataset(tmp_path / "x.zip", tmp_path / "target")
    with pytest.raises(IzooError, match="does not exist"):
        import_dataset(tmp_path / "y.zip", tmp_path / "target")
    with pytest.raises(IzooError, match="holds no intersection folders"):
        import_dataset(pack(tmp_path / "z.zip", {"readme": "hello"}), tmp_path / "target")
    path = pack(tmp_path / "w.zip", {"t/1/net.net.xml": NET, "t/1/inflows.txt": "1\n1\n1\n"})
    data = bytearray(path.read_bytes())
    data[100:140] = bytes(40)
    path.write_bytes(data)
    with pytest.raises(IzooError, match="none of the 1 folders"):
        import_dataset(path, tmp_path / "target")
    assert not (tmp_path / "target").exists()


@pytest.mark.parametrize("manifest", [None, '{"name": "app"}', '{"datasets": ["thesis"]}', "no JSON"])
def test_other_files_in_the_target_are_safe(manifest: str | None, tmp_path: Path, source: Path) -> None:
    target = tmp_path / "target"
    (target / "thesis").mkdir(parents=True)
    (target / "thesis" / "thesis.tex").write_text("years of work")
    if manifest is not None:
        (target / "manifest.json").write_text(manifest)
    before = tree(target)
    with pytest.raises(IzooError, match=r"holds other files \((manifest\.json, )?thesis\)"):
        import_dataset(source, target)
    assert tree(target) == before
    with pytest.raises(IzooError, match="within each other"):
        import_dataset(source, source / "target")


def test_names_of_a_foreign_archive_cannot_command_a_terminal(tmp_path: Path) -> None:
    odd = "\x1b[31mred\u202e"
    members = {f"t/{name}/{file}": text for name in ("1", odd) for file, text in GOOD.items()}
    said = str(import_dataset(pack(tmp_path / "x.zip", members), tmp_path / "target"))
    assert "\\x1b[31mred\\u202e" in said and "\x1b" not in said and "\u202e" not in said


def test_an_earlier_import_is_replaced_whole(tmp_path: Path, source: Path) -> None:
    target = tmp_path / "target"
    import_dataset(source, target)
    other = pack(tmp_path / "atlanta.zip", {"5/net.net.xml": NET, "5/inflows.txt": "1\n1\n1\n"})
    import_dataset(other, target)
    assert [row["dataset"] for row in csv.DictReader((target / "index.csv").open())] == ["atlanta"]
    assert not (target / "salt-lake-city").exists()
