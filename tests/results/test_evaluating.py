"""``python -m izoo.evaluate`` at toy size, and what it refuses."""

import shutil
from pathlib import Path

import pytest
import yaml

from izoo import train
from izoo.conf.context_choices import PcgContexts
from izoo.contexts.source import ContextList
from izoo.evaluate import main
from izoo.results.rollout import DRAIN_S
from izoo.results.selection import choose_contexts
from izoo.results.store import read_manifest, read_table
from tests.conftest import Refused

TOY = ["contexts=pcg_easy", "env.horizon_s=90", "env.num_agents=16", "num_workers=0"]


def test_command_writes_its_results_and_goes_on_with_more_seeds(
    here: Path, cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["policy=tests.results.odd_policies:gentle", f"cache={cache}", "num_contexts=1", *TOY]
    assert main([*words, "seeds=1"]) == 0
    (folder,) = (here / "evaluations").iterdir()
    assert len(read_table(folder)) == 3
    assert main([*words, "seeds=2", "-v"]) == 0
    assert len(read_table(folder)) == 6
    manifest = read_manifest(folder)
    assert manifest.task == "pcg" and manifest.env["drain_s"] == DRAIN_S
    assert manifest.policies["gentle"][0].source == "tests.results.odd_policies:gentle"
    out = " ".join(capsys.readouterr().out.split())
    assert "1 context, 2 seeds each, episodes of 90 s of which the first 25 s are not measured" in out
    assert "Episodes of gentle that are there already, and not played again: 1" in out
    assert out.endswith("on 1 unsaturated intersection, too few for an interval (6)."), "the verdict comes last"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["policy=glied"], "Did you mean 'glide'"),
        (["polciy=glide"], "Did you mean 'policy'"),
        (["policy=glide", "seeds=0"], "seeds is 0"),
        (["policy=glide", "algo=ppo"], "'algo'"),
        (["policy=glide", "env.neighbours=[follower]"], "leader_present"),
        (["policy=glide", "env.drain_s=0"], "evaluated episodes are played out"),
        (["policy=cap_2"], "is not a speed cap"),
        (["policy=glide", "simulator=twin", "env.gui=true", "num_contexts=1"], "the twin has no window; use sim"),
    ],
)
def test_bad_options_are_one_sentence(words: list[str], message: str, here: Path, refused: Refused) -> None:
    refused(main, [*words, *TOY], message)
    assert list(here.iterdir()) == []


def test_contexts_that_changed_go_into_a_folder_of_their_own(
    here: Path, cache: Path, published: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where a town is built again: the options are the same, its contexts are not."""
    town = shutil.copytree(published / "106", here / "town" / "9")
    words = ["policy=glide", "contexts=dataset", "contexts.path=town", "contexts.approaches=all", f"cache={cache}"]
    words += ["env.horizon_s=40", "env.num_agents=16", "num_workers=0", "seeds=1", "num_contexts=1"]
    for inflow in ("1000\n", "2000\n"):
        (town / "inflows.txt").write_text(inflow * len((town / "inflows.txt").read_text().splitlines()))
        assert main(words) == 0
        assert main([*words, "out=together"]) == 0
    assert [len(read_table(path)) % 3 for path in (here / "evaluations").iterdir()] == [0, 0]
    said = capsys.readouterr().out
    assert said.count(f"1 other context of earlier evaluations in {here / 'together'}: ") == 1


@pytest.mark.parametrize("sweep", [False, True])
def test_options_of_a_runs_own_contexts_are_changed(
    sweep: bool, here: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    """One by one, whatever these contexts are; the others stay as they were in training."""
    trained = ["contexts=pcg", "contexts.lane_count={1:0.25,2:0.75}", "contexts.green_s=20..30"]
    trained += ["contexts.adoption=0.2"]
    short = ["env.horizon_s=30", "env.warmup_s=5", "algo.frames_per_batch=50", "total_frames=50"]
    short += ["evaluation.contexts=0", "num_workers=1", "collector=single", "run_dir=run"]
    assert train.main([*trained, *short]) == 0
    words = ["run=run", "contexts.adoption=0..1", "contexts.exclude=[{lane_count:2}]"]
    if sweep:
        assert main(["run=run", "contexts.adoption=0.5", "seeds=1,2", "num_contexts=1", "-m", "--cfg"]) == 0
        assert capsys.readouterr().out.count("name: pcg") == 2
        refused(main, ["run=run,elsewhere", "contexts.adoption=0.5", "num_contexts=1", "-m"])
        return
    capsys.readouterr()
    assert main([*words, "--cfg"]) == 0
    shown = yaml.safe_load(capsys.readouterr().out.partition("\n")[2])["contexts"]
    assert shown["name"] == "pcg" and shown["green_s"] == "20..30" and shown["adoption"] == "0..1"
    assert {float(lanes) for lanes in shown["lane_count"]} == {1.0, 2.0} and shown["exclude"] == [{"lane_count": 2}]
    refused(main, ["run=run", "contexts.split=test"], "contexts.split")
    assert main(["run=run", "contexts.adoption=0.5", "num_contexts=1", "seeds=1", "num_workers=0", *short[:2]]) == 0
    assert ": pcg, 1 context" in capsys.readouterr().out


def test_what_the_system_says_of_a_path_is_one_sentence(refused: Refused) -> None:
    error = refused(main, ["policy=glide", "contexts=dataset", f"contexts.path={'x' * 300}"])
    assert "File name too long" in error or "does not exist" in error  # the latter from Python 3.14 on


def test_contexts_are_drawn_without_end_or_taken_from_a_list(contexts) -> None:
    source = PcgContexts(inflow_vph_per_lane="100..900").build()
    drawn = choose_contexts(source, None, 0)
    assert len({context.content_hash for context in drawn}) == len(drawn) == 16
    assert choose_contexts(source, 3, 0) == choose_contexts(source, 3, 0) != choose_contexts(source, 3, 1)
    assert choose_contexts(ContextList(contexts), None, 0) == contexts
    assert choose_contexts(ContextList(contexts), 1, 0)[0] in contexts
