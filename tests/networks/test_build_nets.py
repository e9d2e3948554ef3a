"""Many nets in one call of netconvert: each the same as if it had been built alone."""

import dataclasses
from pathlib import Path

import pytest

from izoo.contexts.cities import rebuilt
from izoo.contexts.procedural import procedural_intersection
from izoo.contexts.spec import IntersectionSpec
from izoo.cores import usable_cores
from izoo.errors import IzooError
from izoo.networks.net import build
from izoo.networks.net.build import build_net, build_nets
from izoo.networks.net.plain import PlainNet
from tests.networks.worlds import CROSS, intersection

POCKETS = {"left_pockets": 1, "pocket_length_m": 50.0}
PROCEDURAL = [procedural_intersection(lanes, phases, green_s=24.0) for lanes in (1, 2, 3, 4) for phases in (1, 2)]
ODD = [
    intersection((0.0, 90.0, 180.0), 3, 2, grade=0.04, **POCKETS),
    intersection((0.0, 60.0, 120.0, 180.0, 240.0, 300.0), 2, grade=-0.1, right_on_red=True),
    intersection((10.0, 60.0, 170.0, 215.0, 290.0), 3),
]
IMPOSSIBLE = dataclasses.replace(procedural_intersection(4, 2, lane_length_m=30.0), name="test/short")
REFUSED = dataclasses.replace(intersection(CROSS, 2), name="test/refused")


def one_way(bearings: tuple[float, ...]) -> IntersectionSpec:
    """The first leg has no approach, so that no ghost lies there, and the box around the nodes ends at a zero."""
    whole = intersection(bearings, 2)
    return dataclasses.replace(whole, legs=(dataclasses.replace(whole.legs[0], approach=None), *whole.legs[1:]))


def city(name: str) -> list[IntersectionSpec]:
    """Some intersections of a city, with grades; most have four legs, some three."""
    specs = rebuilt.get(name)
    return [specs[index] for index in range(0, len(specs), len(specs) // 10)]


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a cache."""
    return {path.name: path.read_bytes() for path in (folder / "nets").iterdir()}


@pytest.mark.parametrize("towns", [(), pytest.param(("salt_lake_city", "atlanta"), marks=pytest.mark.slow)])
def test_nets_are_the_same_as_alone(towns: tuple[str, ...], tmp_path: Path, calls: list[str]) -> None:
    zeros = [one_way(bearings) for bearings in ((0.0, 90.0, 270.0), (180.0, 270.0), (90.0, 0.0), (270.0, 180.0))]
    specs = [*PROCEDURAL[::3], *ODD, *zeros, *(spec for name in towns for spec in city(name))]
    assert any(leg.approach.grade for spec in specs for leg in spec.legs if leg.approach)
    together = build_nets(specs, tmp_path / "together")
    assert len(calls) <= usable_cores()
    alone = [build_net(spec, tmp_path / "alone") for spec in specs]
    assert [path.name for path in together] == [path.name for path in alone]
    assert contents(tmp_path / "together") == contents(tmp_path / "alone")


def test_paths_come_in_the_order_of_the_specs_and_nothing_is_built_twice(tmp_path: Path, calls: list[str]) -> None:
    finished = tmp_path / "own.net.xml"
    finished.write_text("<net/>")
    own = dataclasses.replace(intersection(), source="dataset", net_path=str(finished))
    renamed = dataclasses.replace(PROCEDURAL[0], name="test/another")
    paths = build_nets([PROCEDURAL[1], own, PROCEDURAL[0], PROCEDURAL[1], renamed], tmp_path)
    assert len(set(paths)) == 3
    assert paths[1] == finished
    assert paths[0] == paths[3] == build_net(PROCEDURAL[1], tmp_path)
    assert paths[2] == paths[4] == build_net(PROCEDURAL[0], tmp_path)
    assert build_nets([own], tmp_path / "never") == [finished] == [build_net(own, tmp_path / "never")]
    assert build_nets([], tmp_path / "never") == []
    assert not (tmp_path / "never").exists()
    paths[0].write_bytes(paths[0].read_bytes()[:-100])
    before = paths[2].stat().st_mtime_ns
    build_nets(PROCEDURAL[:2], tmp_path)
    finished.unlink()
    with pytest.raises(IzooError, match="does not exist"):
        build_net(own, tmp_path)
    assert len(calls) == 2 and paths[2].stat().st_mtime_ns == before and paths[0].read_bytes().endswith(b"</net>\n")


@pytest.mark.parametrize("refused", [False, True])
def test_an_impossible_one_stops_no_other(refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain_net = build.plain_net

    def broken(spec: IntersectionSpec, plan: object) -> PlainNet:
        plain = plain_net(spec, plan)
        if spec is not REFUSED:
            return plain
        return dataclasses.replace(plain, edges=plain.edges.replace('from="TL" to="A"', 'from="TL" to="nowhere"'))

    monkeypatch.setattr(build, "plain_net", broken)
    bad, reason = (REFUSED, "nowhere") if refused else (IMPOSSIBLE, "leg A is too short")
    with pytest.raises(IzooError, match=f"intersection {bad.name}") as raised:
        build_nets([*PROCEDURAL[:5], bad, *PROCEDURAL[5:]], tmp_path / "together")
    assert reason in str(raised.value)
    build_nets(PROCEDURAL, tmp_path / "good")
    assert contents(tmp_path / "together") == contents(tmp_path / "good")
    with pytest.raises(IzooError) as alone:
        build_net(bad, tmp_path / "good")
    assert str(alone.value) == str(raised.value)
