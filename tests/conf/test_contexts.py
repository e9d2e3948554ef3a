"""``contexts=...``: every choice builds what it says, and refuses what it cannot use."""

import numpy as np
import pytest

from izoo.cli.option_command import compose_config
from izoo.conf.built_in import CatalogueContexts, CityContexts
from izoo.conf.choices import groups
from izoo.conf.context_choices import MixedContexts, PcgContexts
from izoo.conf.folders import DatasetContexts, OsmContexts
from izoo.conf.train_options import TrainConfig
from izoo.contexts import catalogue
from izoo.contexts.cities.rebuilt import SIZES
from izoo.contexts.procedural import SYSTEMATICITY_TEST_SAMPLE
from izoo.contexts.source import ContextList
from izoo.errors import IzooError
from izoo.options import from_mapping, to_mapping
from izoo.training.validation_rollout import held_out

CHOICES = {
    "pcg": PcgContexts(),
    "pcg_easy": PcgContexts(preset="easy"),
    "systematicity_test": PcgContexts(preset="systematicity_grid"),
    "city": CityContexts(),
    "catalogue": CatalogueContexts(),
    "dataset": DatasetContexts(),
    "osm": OsmContexts(),
    "mixed": MixedContexts(),
}


def chosen(*words: str):
    """What ``python -m izoo.train WORDS`` takes as its contexts."""
    return compose_config(TrainConfig, list(words)).contexts


def test_every_choice_is_its_dataclass():
    assert set(CHOICES) == set(groups()["contexts"])
    for name, config in CHOICES.items():
        assert chosen(f"contexts={name}") == config


@pytest.mark.parametrize(
    "config",
    [
        CityContexts(city=["atlanta", "boston"], season=None, adoption=[0.1, 0.5]),
        CatalogueContexts(ids=(3, "100..199")),
        PcgContexts(lane_count={1: 0.25, 2: 0.75}, exclude=[{"green_s": "20..24"}]),
        OsmContexts(path="/town", split="test"),
        MixedContexts(sources=[CityContexts(city="boston"), PcgContexts(lane_count=2)]),
    ],
)
def test_options_survive_being_saved(config):
    saved = from_mapping(TrainConfig, to_mapping(TrainConfig(contexts=config))).contexts
    assert to_mapping(saved) == to_mapping(config)
    if isinstance(config, PcgContexts):
        one, two = (each.build().sample(np.random.default_rng(3)) for each in (config, saved))
        assert one == two


def test_a_city_is_named_on_one_line():
    words = ["contexts=city", "contexts.city=salt_lake_city", "contexts.season=summer", "contexts.hour=peak"]
    source = chosen(*words, "contexts.adoption=0.33", "contexts.split=train", "contexts.approaches=all").build()
    assert len(source) == SIZES["salt_lake_city"] - 56
    context = source[0]
    assert (context.season, context.hour, context.adoption, context.approach) == ("summer", "peak", 0.33, None)
    test = chosen("contexts=city", "contexts.city=atlanta", "contexts.split=test", "contexts.weather=published").build()
    assert test[0].intersection.city == "atlanta"
    assert (test[0].temperature_c, test[0].humidity_pct) == (22.8, 83.0)
    assert test[0].approach == "A"


def test_cities_take_lists_and_null():
    words = ["contexts=city", "contexts.city=[boston,atlanta]", "contexts.season=null", "contexts.approaches=all"]
    assert len(chosen(*words).build()) == 4 * (SIZES["boston"] + SIZES["atlanta"])
    assert CityContexts(cv_vehicle="human").build()[5].cv_vehicle == "human"


def test_catalogue_ids_and_ranges():
    source = chosen("contexts=catalogue", "contexts.ids=[7,100..103,7]").build()
    assert [context.context_id for context in source] == [7, 100, 101, 102, 103, 7]
    assert source[-1] == catalogue.get(7)
    assert source[1:3] == [catalogue.get(100), catalogue.get(101)]
    everything = CatalogueContexts(ids=(f"0..{catalogue.SIZE - 1}",)).build()
    assert len(everything) == catalogue.SIZE
    assert everything.sample(np.random.default_rng(0)).context_id is not None
    assert CatalogueContexts(ids=(7,), cv_vehicle="human").build()[0].context_id is None


def test_procedural_settings():
    words = ["contexts=pcg", "contexts.inflow_vph_per_lane=[100,600]", "contexts.green_s=20..40"]
    words += ["contexts.lane_count={1:0.25,2:0.75}", "contexts.phase_count=1"]
    source = chosen(*words, "contexts.exclude=[{green_s:22..40,lane_count:2}]").build()
    lanes = []
    for seed in range(300):
        context = source.sample(np.random.default_rng(seed))
        approach = context.intersection.leg("A").approach
        green_s = context.intersection.signal_plan.phases[0].duration_s
        lanes.append(approach.lane_count)
        assert context.flow_vph_per_lane("A") == pytest.approx(100.0) or context.flow_vph_per_lane("A") == 600.0
        assert 20.0 <= green_s <= 40.0
        assert approach.lane_count == 1 or green_s < 22.0
    assert set(lanes) == {1, 2}


def test_a_side_of_a_box_may_be_several_values_or_of_a_feature_that_is_not_drawn() -> None:
    for exclude, left in (({"lane_count": [2, 3]}, {1}), ({"lane_count": [2, 3], "green_s": "20..30"}, {1})):
        source = PcgContexts(preset="easy", lane_count=[1, 2, 3], exclude=[exclude]).build()
        drawn = [source.sample(np.random.default_rng(k)).intersection.leg("A").approach for k in range(20)]
        assert {approach.lane_count for approach in drawn} == left


def test_an_empty_list_lifts_the_exclusion():
    inside = {"lane_count": 2, "phase_count": 2, "inflow_vph_per_lane": 450, "green_s": 27, "red_s": 27}
    inside |= {"lane_length_m": 400, "speed_limit_mps": 17.5, "offset_s": 2.5}
    with pytest.raises(IzooError, match="leaves nothing"):
        PcgContexts(**inside).build()
    assert PcgContexts(**inside, exclude=[]).build().sample(np.random.default_rng(0)).adoption == pytest.approx(1 / 3)


def test_the_systematicity_test_set():
    grid = chosen("contexts=systematicity_test").build()
    assert isinstance(grid, ContextList)
    assert [context.content_hash for context in grid] == [
        context.content_hash for context in SYSTEMATICITY_TEST_SAMPLE.interval_ends()
    ]


def test_dataset_splits_share_out_the_intersections(published):
    path = str(published)
    names = {}
    for split in ("train", "validation", "test", "all"):
        source = DatasetContexts(path=path, split=split).build()
        names[split] = {context.intersection.name for context in source}
    assert (len(names["train"]), len(names["validation"]), len(names["test"])) == (48, 6, 6)
    assert names["train"] | names["validation"] | names["test"] == names["all"]
    several = list(DatasetContexts(path=path, split="test", adoption=[0.1, 1.0]).build())
    assert {context.intersection.name for context in several} == names["test"]
    assert [context.adoption for context in several] == [0.1] * (len(several) // 2) + [1.0] * (len(several) // 2)
    assert len({context.content_hash for context in several}) == len(several)
    with pytest.raises(IzooError, match="named after one of the ten"):
        DatasetContexts(path=path, weather="county", season="winter").build()
    with pytest.raises(IzooError, match="too few for a test set"):
        DatasetContexts(path=f"{path}/106", split="test").build()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["contexts=city", "contexts.city=atlantis"], "atlanta"),
        (["contexts=city", "contexts.season=monsoon"], "winter"),
        (["contexts=city", "contexts.adoption=1.5"], r"\[0, 1\]"),
        (["contexts=city", "contexts.adoption=[0.5,1.5]"], r"\[0, 1\]"),
        (["contexts=city", "contexts.weather=published", "contexts.season=fall"], "summer"),
        (["contexts=city", "contexts.weather=published", "contexts.city=boston"], "salt_lake_city, atlanta"),
        (["contexts=city", "contexts.city=[]"], "a filter is empty"),
        (["contexts=catalogue"], "contexts.ids is empty"),
        (["contexts=catalogue", "contexts.ids=[1306720]"], "0 to 1306719"),
        (["contexts=catalogue", "contexts.ids=[-1]"], "0 to 1306719"),
        (["contexts=catalogue", "contexts.ids=[9..3]"], "low end first"),
        (["contexts=catalogue", "contexts.ids=[x]"], "'x'"),
        (["contexts=dataset"], "contexts.path=DIR"),
        (["contexts=dataset", "contexts.path=/nowhere"], "/nowhere does not exist"),
        (["contexts=dataset", "contexts.season=fall"], "contexts.weather=county"),
        (["contexts=dataset", "contexts.adoption=[]"], "contexts.adoption is an empty list"),
        (["contexts=osm"], "contexts.path=DIR"),
        (["contexts=osm", "contexts.path=/nowhere"], "izoo.contexts build --osm"),
        (["contexts=pcg", "contexts.green_s=40..20"], "contexts.green_s: .*upside down"),
        (["contexts=pcg", "contexts.green_s=a..b"], "low..high"),
        (["contexts=pcg", "contexts.lane_count={1:0.5,2:0.4}"], "contexts.lane_count: .*sum to 0.9"),
        (["contexts=pcg", "contexts.lane_count={1:x}"], "probability"),
        (["contexts=pcg", "contexts.lane_count=[]"], "empty"),
        (["contexts=pcg", "contexts.lane_count=7"], "lane_count"),
        (["contexts=pcg", "contexts.exclude=[{}]"], "exclude everything"),
        (["contexts=pcg", "contexts.exclude=[{green_s:30..20}]"], "low end must come first"),
        (["contexts=pcg", "contexts.exclude=[{lanes:2}]"], "lane_count"),
        (["contexts=pcg", "contexts.exclude=[{engine:electrc}]"], "electrc"),
        (["contexts=pcg_easy", "contexts.green_s=20..30", "contexts.exclude=[{green_s:25}]"], "means nothing, since"),
        (["contexts=pcg_easy", "contexts.green_s=20..30", "contexts.exclude=[{green_s:[20,30]}]"], "means nothing"),
        (["contexts=pcg", "contexts.exclude=[{engine:0..1}]"], "give a value or a list of values"),
        (["contexts=pcg", "contexts.exclude=[{green_s:26-29}]"], "green_s is '26-29'"),
        (["contexts=pcg", "contexts.exclude=[{lane_count:{1:0.5,2:0.5}}]"], "give a value or a list of values"),
        (["contexts=pcg", "contexts.exclude=[{green_s:0..300}]"], "leaves nothing"),
        (["contexts=systematicity_test", "contexts.lane_count=1"], "together"),
    ],
)
def test_bad_input_names_the_value_and_what_is_legal(words, message):
    with pytest.raises(IzooError, match=message):
        chosen(*words).build()


MIXED = "contexts.sources=[{name:city,city:atlanta,split:train},{name:pcg,preset:easy}]"


def test_a_mixture_draws_from_each_of_its_sources_alike():
    source = chosen("contexts=mixed", MIXED).build()
    drawn = [source.sample(np.random.default_rng([7, episode])).intersection.source for episode in range(200)]
    assert set(drawn) == {"city", "procedural"}
    assert 70 <= drawn.count("city") <= 130  # 100 +- 4 standard deviations of 7.1


def test_a_mixture_is_validated_on_the_validation_split_of_those_that_have_one():
    city, procedural = held_out(chosen("contexts=mixed", MIXED)).sources
    assert list(city) == list(CityContexts(city="atlanta", split="validation").build())
    assert procedural.sample(np.random.default_rng(0)).intersection.source == "procedural"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "0 entries; contexts=mixed needs two or more"),
        (("contexts.sources=[{name:city}]",), "1 entries; contexts=mixed needs two or more"),
        (("contexts.sources=[{name:city},{name:dataset}]",), "contexts=dataset needs a folder"),
        (("contexts.sources=[{name:city},{name:cty}]",), "contexts.sources[1].name"),
        (("contexts.sources=[{name:city},{name:mixed}]",), "contexts.sources[1].name"),
        (("contexts.sources=[{name:city},{name:pcg,lanes:2}]",), "contexts.sources[1].lanes"),
    ],
)
def test_a_mixture_that_cannot_be_made_is_refused(words, said):
    with pytest.raises(IzooError) as refused:
        chosen("contexts=mixed", *words).build()
    assert said in str(refused.value)


@pytest.mark.parametrize("fleet", [[], [0.7, 0.2, 0.1], [0.7, 0.2, 0.1, 0.1], [2.0, -1.0, 0.0, 0.0]])
@pytest.mark.parametrize("config", [OsmContexts, DatasetContexts])
def test_fleets_that_are_none(config: type, fleet: list[float]) -> None:
    with pytest.raises(IzooError, match=r"contexts\.fleet: the fleet is .*, from 0 to 1, with a sum of 1"):
        config(path="town", fleet=fleet)
