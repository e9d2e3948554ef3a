import numpy as np
import pytest

from izoo.contexts import procedural
from izoo.contexts.distributions import Box
from izoo.contexts.procedural import EASY, ProceduralSource, procedural_context, procedural_intersection


def _shape_and_ranges(context):
    approach = context.intersection.leg("A").approach
    plan = context.intersection.signal_plan
    greens = [phase.duration_s for phase in plan.phases if phase.states[0][2] == "G"]
    phases = 2 if len(plan.phases) == 8 else 1
    return {
        "shape": (approach.lane_count, phases),
        "inflow": context.flow_vph_per_lane("A"),
        "green": greens[0],
        "red": greens[2] if phases == 2 else greens[1],
        "length": approach.length_m,
        "speed": approach.speed_limit_mps,
        "offset": context.intersection.ghosts.offset_s,
    }


def _in_test_box(context):
    values = _shape_and_ranges(context)
    return (
        values["shape"] in ((2, 2), (3, 1))
        and 400 <= values["inflow"] <= 500
        and 26 <= values["green"] <= 29
        and 26 <= values["red"] <= 29
        and 325 <= values["length"] <= 500
        and 17 <= values["speed"] <= 18
        and 2 <= values["offset"] <= 3
    )


@pytest.mark.parametrize(("phase_count", "extra"), [(1, 6.0), (2, 24.0)])
def test_cycle_and_ghosts_follow_the_spec(phase_count, extra):
    spec = procedural_intersection(lane_count=3, phase_count=phase_count, green_s=25.0, red_s=31.0, offset_s=2.0)
    assert spec.signal_plan.cycle_s == 25.0 + 31.0 + extra
    ghosts = spec.ghosts
    assert (ghosts.repeats_main, ghosts.offset_s, ghosts.yellow_s) == (True, 2.0, 3.0)
    assert (ghosts.outer_gates, spec.right_on_red) == (False, False)
    assert (ghosts.straight_source_length_m, ghosts.turning_source_length_m) == (246.0, None)


def test_lefts_come_only_with_two_phases_and_from_the_leftmost_lane():
    assert procedural_intersection(2, 1).leg("A").approach.lanes == ("s", "s")
    assert procedural_intersection(2, 2).leg("B").approach.lanes == ("s", "sl")
    assert procedural_intersection(1, 2).leg("C").approach.lanes == ("sl",)
    plan = procedural_intersection(1, 2).signal_plan
    assert plan.phases[2].states == (("A", "B", "G"), ("C", "D", "G"))
    assert plan.phases[6].states == (("B", "C", "G"), ("D", "A", "G"))
    assert [phase.duration_s for phase in plan.phases] == [26, 3, 6, 3, 26, 3, 6, 3]


def test_inflow_is_the_peak_inflow():
    context = procedural_context(inflow_vph_per_lane=400.0)
    assert context.flow_vph_per_lane("A") == pytest.approx(400.0)
    assert context.demand_approaches == ("A",)
    assert procedural_context(approach="all").demand_approaches == ("A", "B", "C", "D")


def test_easy_is_one_fixed_context():
    one, two = EASY.sample(np.random.default_rng(0)), EASY.sample(np.random.default_rng(1))
    assert one.content_hash == two.content_hash
    assert one.flow_vph_per_lane("A") == pytest.approx(250.0)
    assert len(EASY.contexts()) == 1
    assert (one.temperature_c, one.humidity_pct, one.adoption) == (20.0, 46.0, 1 / 3)


def test_systematicity_test_grid_is_the_published_one():
    assert len(procedural.SYSTEMATICITY_TEST) == 128
    assert len({context.content_hash for context in procedural.SYSTEMATICITY_TEST}) == 128
    assert all(_in_test_box(context) for context in procedural.SYSTEMATICITY_TEST)
    generator = np.random.default_rng(0)
    assert all(_in_test_box(procedural.SYSTEMATICITY_TEST_SAMPLE.sample(generator)) for _ in range(200))


def test_systematicity_train_never_enters_the_test_box():
    one, two = (procedural.SYSTEMATICITY_TRAIN.sample(np.random.default_rng(7)) for _ in range(2))
    assert one == two
    generator = np.random.default_rng(0)
    shapes = set()
    for _ in range(1500):
        context = procedural.SYSTEMATICITY_TRAIN.sample(generator)
        assert not _in_test_box(context)
        values = _shape_and_ranges(context)
        shapes.add(values["shape"])
        assert 100 <= values["inflow"] <= 600.000001
        assert 100 <= values["length"] <= 775
    assert shapes == {(1, 1), (1, 2), (2, 1), (2, 2), (3, 1), (3, 2)}


def test_finite_sources_enumerate_in_a_stable_order():
    source = ProceduralSource({"lane_count": [1, 2], "adoption": [0.1, 0.2, 0.5]}, [Box({"adoption": 0.2})])
    contexts = source.contexts()
    seen = [(context.intersection.leg("A").approach.lane_count, context.adoption) for context in contexts]
    assert seen == [(1, 0.1), (1, 0.5), (2, 0.1), (2, 0.5)]
    assert [context.adoption for context in contexts[1:3]] == [0.5, 0.1]


def test_roads_of_another_grade_are_another_intersection():
    names = {procedural_intersection(grade=grade).name for grade in (0.0, 0.05, -0.05)}
    assert len(names) == 3 and procedural_intersection().name in names
