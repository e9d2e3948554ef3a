import pickle

import numpy as np
import pytest

from izoo.contexts import catalogue
from izoo.contexts.__main__ import main
from izoo.contexts.catalogue import ADOPTIONS, SIZE, Scenario, Scenarios, describe, find_id
from izoo.contexts.cities.weather import weather
from izoo.errors import IzooError

GOLDEN = {
    0: Scenario("atlanta", 0, "winter", 0.1, "peak", "combustion"),
    1: Scenario("atlanta", 0, "winter", 0.1, "peak", "electric"),
    2: Scenario("atlanta", 0, "winter", 0.1, "off-peak", "combustion"),
    4: Scenario("atlanta", 0, "winter", 0.2, "peak", "combustion"),
    20: Scenario("atlanta", 0, "spring", 0.1, "peak", "combustion"),
    80: Scenario("atlanta", 1, "winter", 0.1, "peak", "combustion"),
    621 * 80: Scenario("boston", 0, "winter", 0.1, "peak", "combustion"),
    654321: Scenario("los_angeles", 1193, "winter", 0.1, "peak", "electric"),
    SIZE - 1: Scenario("seattle", 994, "fall", 1.0, "off-peak", "electric"),
}


def test_size_is_the_published_one():
    assert SIZE == 1_306_720
    assert len(Scenarios()) == SIZE == 2 * sum(len(Scenarios(adoption=adoption, hour="peak")) for adoption in ADOPTIONS)


@pytest.mark.parametrize(("context_id", "scenario"), GOLDEN.items())
def test_golden_ids(context_id, scenario):
    assert describe(context_id) == scenario


def test_ids_are_a_bijection():
    every = Scenarios()
    for context_id in np.random.default_rng(0).integers(SIZE, size=3000):
        scenario = describe(int(context_id))
        assert find_id(*scenario) == context_id
        assert every.locate(int(context_id)) == (scenario, None)


def test_get_builds_the_scenario():
    for context_id in np.random.default_rng(1).integers(SIZE, size=20):
        scenario, context = describe(int(context_id)), catalogue.get(int(context_id))
        assert context.context_id == context_id
        assert context.name == f"{scenario.city}/{scenario.intersection}"
        assert (context.season, context.adoption) == (scenario.season, scenario.adoption)
        assert (context.hour, context.engine) == (scenario.hour, scenario.engine)
        assert (context.temperature_c, context.humidity_pct) == weather(scenario.city, scenario.season)
        assert context.demand_approaches == context.intersection.approach_names
    assert catalogue.get(654321).content_hash == catalogue.get(654321).content_hash


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"city": "paris"}, "unknown city"),
        ({"intersection": 621}, "0 to 620"),
        ({"season": "autumn"}, "unknown season"),
        ({"adoption": 0.33}, "0.1, 0.2, 0.5, 0.75, 1.0"),
        ({"hour": "noon"}, "unknown hour"),
        ({"engine": "hybrid"}, "unknown engine"),
    ],
)
def test_unknown_scenarios_are_refused(changes, message):
    with pytest.raises(IzooError, match=message):
        find_id(**{**GOLDEN[0]._asdict(), **changes})


def test_ids_out_of_range_and_filters_that_leave_nothing_are_refused():
    for context_id in (-1, SIZE, 1.5, "3", True):
        with pytest.raises(IzooError, match="1306719"):
            describe(context_id)
    with pytest.raises(IzooError, match="no scenario is selected"):
        Scenarios(season=[])
    with pytest.raises(IzooError, match=r"\[0, 1\]"):
        Scenarios(adoption=1.2)


def test_filters_match_a_plain_search():
    filters = {"season": "summer", "hour": "off-peak", "engine": "electric"}
    chosen = Scenarios(city=["seattle", "atlanta"], adoption=[1.0, 0.2], **filters)
    assert len(chosen) == (621 + 995) * 2
    ids = [find_id(*chosen.locate(index)[0]) for index in range(len(chosen))]
    assert ids == sorted(set(ids))
    every = ((number, describe(number)._asdict()) for number in range(621 * 80))
    wanted = [number for number, of in every if filters.items() <= of.items() and of["adoption"] in (0.2, 1.0)]
    assert ids[: len(wanted)] == wanted
    assert chosen[3].context_id == ids[3]
    assert chosen[-1].context_id == ids[-1]
    with pytest.raises(IndexError):
        chosen[len(chosen)]


def test_one_approach_expansion():
    settings = {"city": "salt_lake_city", "season": "summer", "hour": "peak", "engine": "combustion", "adoption": 1 / 3}
    one = Scenarios(**settings, approaches="one")
    assert len(one) == 1048
    names = [context.name for context in one]
    assert len(set(names)) == 1048
    assert names[:2] == ["salt_lake_city/0/A", "salt_lake_city/0/B"]
    assert one[0].context_id is None
    assert one[0].demand_approaches == ("A",)
    assert len(Scenarios(**settings)) == 282
    assert Scenarios(**settings)[0].context_id is None
    # Of several levels every pair is enumerated once.
    chosen = Scenarios(city="salt_lake_city", season="summer", hour="peak", approaches="one")
    seen = {chosen.locate(index) for index in range(len(chosen))}
    assert len(seen) == len(chosen) == 1048 * 5 * 2


def test_published_weather():
    chosen = Scenarios(city="atlanta", season="summer", weather="published")
    assert (chosen[0].temperature_c, chosen[0].humidity_pct, chosen[0].season) == (22.8, 83.0, None)
    assert chosen[0].context_id is None
    with pytest.raises(IzooError, match="published weather"):
        Scenarios(city="boston", season="summer", weather="published")
    assert len({context.content_hash for context in chosen[:40]}) == 40
    for season in (None, "fall", ["summer", "fall"]):
        with pytest.raises(IzooError, match="season='summer' or weather='county'"):
            Scenarios(city="atlanta", season=season, weather="published")


def test_sampling_and_pickling():
    chosen = Scenarios(city="boston", split="test", approaches="one")
    copy = pickle.loads(pickle.dumps(chosen))
    one, two = chosen.sample(np.random.default_rng(5)), copy.sample(np.random.default_rng(5))
    assert one == two
    assert one.intersection.city == "boston"


def test_commands(capsys):
    assert main(["show", "654321"]) == 0
    assert "los_angeles/1193  (id 654321" in capsys.readouterr().out
    assert main(["count", "--city", "seattle", "--season", "fall"]) == 0
    assert capsys.readouterr().out.strip() == str(995 * 20)
    assert main(["list", "--city", "salt-lake-city", "--approaches", "one", "--limit", "2"]) == 0
    out, err = capsys.readouterr()
    assert [line.split()[1] for line in out.splitlines()] == ["salt_lake_city/0/A", "salt_lake_city/0/B"]
    assert "more" in err
    assert main(["cities"]) == 0
    assert "1306720" in capsys.readouterr().out
    assert main(["compare", "--city", "salt-lake-city"]) == 0
    assert "salt_lake_city" in capsys.readouterr().out
