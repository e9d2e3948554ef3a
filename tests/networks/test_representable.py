"""What SUMO would play and izoo would see otherwise is refused, or left out where cars never go."""

import re
from pathlib import Path

import pytest

from izoo.contexts.procedural import procedural_context
from izoo.contexts.spec import Approach
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.errors import IzooError
from izoo.networks.dataset.importing import import_dataset
from izoo.networks.dataset.intersections import load_dataset, load_intersection
from izoo.networks.net.build import build_net
from izoo.networks.road import read_road
from tests.envs.worlds import defer
from tests.networks.test_clock import follow_sumo
from tests.networks.worlds import drive_everywhere

MAIN = r'(<tlLogic id="TL" )'
IN_MAIN = r'(<tlLogic id="TL" .*?)'
REFUSED = {
    "actuated": (f'{MAIN}type="static"', r'\1type="actuated"', "signal TL is of type actuated; .* fixed durations"),
    "delay based": (f'{MAIN}type="static"', r'\1type="delay_based"', "signal TL is of type delay_based"),
    "NEMA": (f'{MAIN}type="static"', r'\1type="NEMA"', "signal TL is of type NEMA"),
    "back to the first": (f"{IN_MAIN}<phase ", r'\1<phase next="0" ', "has a phase with next='0'; .*in their order"),
    "a choice": (f"{IN_MAIN}<phase ", r'\1<phase next="1 2" ', "has a phase with next='1 2'"),
    "blinking": (f'{IN_MAIN}state="G', r'\1state="o', "signal TL shows 'o'; choose among the letters G g Y y r u s"),
    "dark": (f'{IN_MAIN}state="G', r'\1state="O', "signal TL shows 'O'"),
    "left-hand": ("<net ", '<net lefthand="1" ', "the net is for traffic on the left .*mirror the net"),
    "free turn": (r'(<connection from="A2TL[^>]*?) tl="TL"', r"\1", "not controlled by signal TL; .* always green"),
}


def built(folder: Path, *changes: tuple[str, str], count: int = 1) -> Path:
    """Return a procedural net, changed."""
    text = build_net(procedural_context().intersection).read_text()
    for old, new in changes:
        text, found = re.subn(old, new, text, count=count, flags=re.DOTALL)
        assert found
    path = folder / "net.net.xml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_represented_is_refused_by_both_readers(tmp_path: Path, name: str) -> None:
    old, new, message = REFUSED[name]
    path = built(tmp_path, (old, new))
    (tmp_path / "inflows.txt").write_text("1000\n" * 4)
    for read in (read_road, lambda path: load_intersection(path.parent)):
        with pytest.raises(IzooError, match=rf"net\.net\.xml: .*{message}"):
            read(path)


def test_a_net_whose_signal_can_be_off_is_refused_at_the_import(faults: Path, tmp_path: Path) -> None:
    with pytest.raises(IzooError, match=r"signal TL has a program off; .*remove that program"):
        import_dataset(faults / "nets" / "two_programs_off", tmp_path / "town")


@pytest.mark.parametrize(
    "changes",
    [
        [(f"{IN_MAIN}<phase ", r'\1<phase next="1" ')],
        [],
        [(f'{IN_MAIN}state="y', r'\1state="Y'), (f'{IN_MAIN}state="r', r'\1state="u')],
        [(f'{MAIN}(.*?)offset="0"', r'\1\2offset="begin"')],
        [(f"{IN_MAIN}<phase ", r'\1<phase minDur="5" maxDur="50" ')],
    ],
    ids=["next in order", "as it is", "other letters", "offset begin", "durations of actuated signals"],
)
def test_what_sumo_shows_is_what_is_seen(tmp_path: Path, changes: list[tuple[str, str]]) -> None:
    assert follow_sumo(read_road(built(tmp_path, *changes)), tmp_path, 130.0) >= 0


def test_the_bare_net_is_read_as_ever(faults: Path, tmp_path: Path) -> None:
    for name in ("base", "offset_begin", "inflow_bom"):
        import_dataset(faults / "nets" / name, tmp_path / name)
        (context,) = load_dataset(tmp_path / name, approaches="all")
        spec = context.intersection
        assert [leg.approach.lanes for leg in spec.legs if leg.approach] == [("s", "s")] * 4
        assert [leg.approach.aadt_per_lane for leg in spec.legs if leg.approach] == [8000.0] * 4
        follow_sumo(read_road(build_net(spec)), tmp_path, 130.0)


@pytest.mark.parametrize(
    ("name", "lanes", "place"),
    [("disallow", (1, 2, 2, 2), 0), ("sidewalk", (2, 2, 2, 2), 1)],
    ids=["a bus lane on the left of A", "sidewalks on the right of all legs"],
)
def test_lanes_without_cars_are_left_out(
    faults: Path, tmp_path: Path, name: str, lanes: tuple[int, ...], place: int
) -> None:
    """Counts, turns, demand and departures are those of the lanes that cars may use."""
    import_dataset(faults / "nets" / name, tmp_path / "town")
    (context,) = load_dataset(tmp_path / "town", approaches="all")
    sides = [leg.approach for leg in context.intersection.legs]
    assert [side.lane_count for side in sides if isinstance(side, Approach)] == list(lanes)
    assert all(side.lanes == ("s",) * count for side, count in zip(sides, lanes, strict=True) if side)
    road = read_road(build_net(context.intersection))
    assert tuple(road.lane_count) == lanes == tuple(road.main_lane_count)
    assert road.source_lanes[0]["AB"] == (place, place + 1)
    first = road.lane_ids.index(f"A2TL_{place}")
    assert road.lane_index[first] == 0 and road.lane_right[first] == -1 and road.lane_siblings[first] == lanes[0]
    drive = drive_everywhere(Path(road.path), road, tmp_path)
    assert drive.arrived == drive.sent > 0 and not [line for line in drive.warnings if "Error" in line]
    env = EcoDrivingEnv(context, config=EnvConfig(horizon_s=120.0, warmup_s=20.0))
    try:
        tensordict = env.reset()
        for _ in range(200):
            tensordict = env.step(defer(tensordict))["next"]
        metrics = {name: float(tensordict["metrics", "approach", name].sum()) for name in ("dropped", "entered")}
    finally:
        env.close()
    assert metrics["dropped"] == 0 and metrics["entered"] > 20
    with pytest.raises(IzooError, match=r"Use simulator=sumo"):
        EcoDrivingEnv(context, config=EnvConfig(horizon_s=60.0), simulator="twin").reset()
