"""Options of a run that do not go together, or that are not there, are refused before anything is written."""

from pathlib import Path

import pytest

from izoo import train
from tests.conftest import Refused

TWIN = ["simulator=twin", "num_envs=16"]
ONCE = [*TWIN, "env.decide=vehicle", "env.action=speed", "action=speed"]
STEP = "learns from decisions in every step"
TEAM = ["algo=mappo", "algo.credit=team", "env.reward=fuel_team"]
SEARCH = ["algo=cmaes", "env.reward=fuel_team"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["env.lane_change=true"], "env.lane_change=true asks the policy for lane changes"),
        (["env.drain_s=600"], "leave it at 0"),
        (["algo.control_variate=vehicle"], "choose simulator=twin"),
        (["algo.common_noise=1"], "simulator is sumo and env.decide step"),
        ([*TWIN, "algo.common_noise=1"], "choose simulator=twin and env.decide=vehicle"),
        ([*TEAM, "algo.control_variate=team"], "choose simulator=twin"),
        (["env.decide=vehicle", "action=advise"], f"action=advise {STEP}"),
        (["env.action=speed", "action=advise"], "choose action=speed"),
        ([*ONCE, *TEAM], f"algo.credit=team {STEP}"),
        ([*ONCE, "levels.draw=prioritised"], f"levels.draw=prioritised {STEP}"),
        ([*TWIN, "env.decide=vehicle", *SEARCH], f"algo=cmaes {STEP}"),
        (SEARCH, "a multiple of 16 for num_envs"),
        (["simulator=twin", "num_envs=17", *SEARCH], "a multiple of 16 for num_envs"),
        ([*TWIN, "algo=cmaes", "env.reward=fuel"], "a multiple of 16 for num_envs"),
        (["levels.draw=prioritised"], "saves its place with the simulator"),
        ([*TWIN, "levels.draw=prioritised", "algo=td3"], "algo=td3 has none"),
        (["levels.draw=hardest"], "uniform, prioritised"),
        (["levels.share=1.5"], "levels.share is 1.5"),
        (["levels.temperature=0"], "levels.temperature is 0"),
        (["num_envs=256"], "set num_workers, or choose simulator=twin"),
        (["simulator=twin", "collector=multisync"], "collector=multisync is a way to step environments"),
        (["simulator=twin", "twin.threads=0"], "twin.threads is 0"),
        (["simulator=twin", "num_envs=0"], "num_envs is 0"),
        (["simulator=twin", "env.gui=true"], "the twin has no window"),
        (["simulator=cityflow"], "sumo, twin"),
        (["algo.warm_start=glide"], "choose action=advise"),
        (["algo.warm_start=glide", "action=residual"], "choose action=advise"),
        (["algo.warm_start=random", "action=advise"], "none, glide"),
        (["algo.warm_start=glide", "action=advise", "algo.warm_start_frames=0"], "warm_start_frames is 0"),
        (["algo=ddpg", "algo.warm_start=glide"], "unknown option"),
        (["algo.hidden=[1000000,1000000]"], "weights, more than"),
        (["start=nowhere"], "does not exist; give the folder of a training run"),
    ],
)
def test_what_cannot_work_is_refused(words: list[str], message: str, tmp_path: Path, refused: Refused) -> None:
    refused(train.main, [*words, "contexts=pcg_easy", f"run_dir={tmp_path / 'run'}"], message)
    assert not (tmp_path / "run").exists()
