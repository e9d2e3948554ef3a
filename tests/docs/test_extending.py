"""The page on extending izoo: what a reward term, an observation column and a figure take, and what follows.

They are written into a copy of the package with the very code that the page shows; nothing else in the copy changes.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest
import torch

from izoo.docs import pages
from izoo.envs import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import EGO_FEATURES
from izoo.envs.mdp.reward import REWARD_COLUMNS, REWARD_VECTOR, SHARED
from tests.docs.blocks import DOCS, ROOT, blocks_of

OBSERVED = observation_names(EnvConfig())
INSTALLED_INSIDE = ("envs", "algos", "benchmarks")

FACTS = """
import json
import torch
import izoo
from izoo.docs import pages
from izoo.envs import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.reward import REWARD_VECTOR
from izoo.envs.specs import observation_spec

config = EnvConfig(emit=("reward_vector",))
agents = observation_spec(config, torch.Size())["agents"]
print(json.dumps({
    "package": izoo.__file__,
    "reward_vector": REWARD_VECTOR,
    "paid_width": agents["reward_vector"].shape[-1],
    "observation_names": observation_names(config),
    "observed_width": agents["observation"].shape[-1],
    "reward_table": pages.reward_table(),
    "observation_table": pages.observation_table(),
}))
"""
ROLLOUT = """
import sys
import torch
from izoo.contexts.procedural import procedural_context
from izoo.envs import EcoDrivingEnv, EnvConfig, RewardConfig

reward = RewardConfig(eta=0.25, speed=0.0, alpha=0.0, beta=0.0, power=1.0, scale=2.0)
config = EnvConfig(horizon_s=100.0, reward=reward, emit=("vehicles", "reward_vector"))
env = EcoDrivingEnv(procedural_context(adoption=0.5, inflow_vph_per_lane=500.0, approach="all"), config=config, seed=3)
torch.save(env.rollout(90).to_dict(), sys.argv[1])
env.close()
"""

FIGURE = """
import contextlib
import io
import sys
from pathlib import Path
from izoo.contexts.procedural import procedural_context
from izoo.envs import EnvConfig
from izoo.metrics.summary import summarise
from izoo.report import leaderboard, page, tables
from izoo.results.rollout import evaluate_policy

out = Path(sys.argv[1])
contexts = [procedural_context(adoption=0.5, inflow_vph_per_lane=flow, approach="all") for flow in (400.0, 500.0)]
config = EnvConfig(horizon_s=100.0, drain_s=50.0)
options = {"workers": 0, "out": out, "cache": out / "cache", "progress": False}
with contextlib.redirect_stdout(io.StringIO()):
    table = evaluate_policy("constant_2.0", contexts, [1], config, **options)
assert (table["hard_braking_s"] > 0).any()
summary = summarise(table)
tables.print_summary(summary, verbose=True)
(out / "tables.md").write_text(tables.markdown(summary))
page.write_report(out, replay=False)
(path,) = leaderboard.write_entries(out)
(group,) = leaderboard.merge([leaderboard.read_entry(path)])["groups"]
assert "hard_braking_s" in group["summary"]["entries"]["constant_2.0"]["levels"]["all"]
"""


def shown(beginning: str) -> str:
    """The block of the page in which a line begins so."""
    (code,) = {
        block.code for block in blocks_of(DOCS / "extending.md") if re.search(f"^{beginning}", block.code, re.MULTILINE)
    }
    return code


def write_before(path: Path, anchor: str, code: str, after: str = "") -> None:
    """Write code above a place in a file: the first one beyond ``after``."""
    text = path.read_text()
    place = text.index(anchor, text.index(after))
    path.write_text(text[:place] + code + text[place:])


def run(package: Path, *words: str) -> str:
    """What Python prints, with the copy of the package in the place of the installed one."""
    # Compiled code of the copy is of no further use: it is compiled quickly instead of well.
    settings = os.environ | {"PYTHONPATH": str(package.parent), "OMP_NUM_THREADS": "1", "NUMBA_OPT": "0"}
    command = [sys.executable, *words]
    result = subprocess.run(command, cwd=package.parent, env=settings, capture_output=True, text=True, timeout=550)
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of izoo with the term and the column of the page."""
    copy = tmp_path_factory.mktemp("extended") / "izoo"
    leave_out = shutil.ignore_patterns("__pycache__", "*.png")
    shutil.copytree(ROOT / "izoo", copy, ignore=leave_out)
    for name in INSTALLED_INSIDE:
        shutil.copytree(ROOT / name, copy / name, ignore=leave_out)
    reward, observation = copy / "envs" / "mdp" / "reward.py", copy / "envs" / "mdp" / "observation.py"
    write_before(reward, "@dataclass(frozen=True)\nclass RewardConfig(", shown("def _power") + "\n\n")
    write_before(
        reward, "\n    def __post_init__", textwrap.indent(shown("power: float"), "    "), "class RewardConfig("
    )
    write_before(observation, "EGO_COLUMNS = (", shown("def _accel") + "\n\n")
    write_before(observation, ")\nNEIGHBOUR_COLUMNS", f"    {shown(r'Column')[:-1]},\n", "EGO_COLUMNS = (")
    tally = copy / "envs" / "mdp" / "metric_sums.py"
    named = shown('"hard_braking_s"').strip().replace('"  #', '",  #')
    write_before(tally, '    "due",', f"    {named}\n")
    write_before(copy / "metrics" / "figures.py", "    )\n}\n", f"        {shown('Figure')[:-1]},\n", "FIGURES: dict")
    line = "            sums.region_time_s += step_s\n"
    write_before(tally, line, textwrap.indent(shown(r"sums\.hard_braking_s"), 12 * " "))
    return copy


@pytest.fixture(scope="module")
def facts(package: Path) -> dict[str, Any]:
    """What specs, names and tables of the copy say."""
    found = json.loads(run(package, "-c", FACTS))
    assert Path(found["package"]) == package / "__init__.py"
    return found


def test_no_other_file_changes(package: Path) -> None:
    changed = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if path.read_bytes() != original(path.relative_to(package)).read_bytes()
    }
    figure = {"metrics/figures.py", "envs/mdp/metric_sums.py"}
    assert changed == {"envs/mdp/reward.py", "envs/mdp/observation.py", *figure}


def original(place: Path) -> Path:
    return ROOT / place if place.parts[0] in INSTALLED_INSIDE else ROOT / "izoo" / place


def test_the_reward_vector_has_the_term(facts: dict[str, Any]) -> None:
    columns = (*REWARD_COLUMNS, "power")
    shared = [declared.name for declared in SHARED.values()]
    assert facts["reward_vector"] == [*columns, *(f"fleet_{name}" for name in columns), *shared]
    assert facts["paid_width"] == len(REWARD_VECTOR) + 2


def test_observations_have_the_column(facts: dict[str, Any]) -> None:
    own = len(EGO_FEATURES)
    assert facts["observation_names"] == [*OBSERVED[:own], "accel", *OBSERVED[own:]]
    assert facts["observed_width"] == len(OBSERVED) + 1


def test_the_layout_page_has_both(facts: dict[str, Any]) -> None:
    """One row more in each table, and no other is lost."""
    term = "| `power` | m^2/s^3 | `env.reward.power` | 0 | own, and `fleet_power` |"
    assert set(facts["reward_table"].splitlines()) - set(pages.reward_table().splitlines()) == {term}
    column = f"| {len(EGO_FEATURES)} | `accel` | m/s^2 | 2.6 | as driven in the last step |"
    table = facts["observation_table"].splitlines()
    assert column in table and len(table) == len(pages.observation_table().splitlines()) + 1


@pytest.mark.slow
def test_help_has_the_option(package: Path) -> None:
    told = run(package, "-m", "izoo.train", "--help")
    assert re.search(r"env\.reward\.power=0\n +weight of the power that a vehicle draws, per kg\.\n", told)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_rollout_pays_the_term_and_observes_the_column(package: Path, facts: dict[str, Any], tmp_path: Path) -> None:
    run(package, "-c", ROLLOUT, str(tmp_path / "steps.pt"))
    steps = torch.load(tmp_path / "steps.pt")
    before, after, agents = steps["vehicles"], steps["next"]["vehicles"], steps["next"]["agents"]
    acts, vector = steps["agents"]["mask"], agents["reward_vector"]
    stays = acts & agents["mask"]
    assert stays.sum() > 200

    sees = steps["agents"]["observation"][..., facts["observation_names"].index("accel")]
    accel_mps2 = before["accel_mps2"].gather(1, steps["agents"]["vehicle"])
    torch.testing.assert_close(2.6 * sees[acts], accel_mps2[acts], rtol=1e-5, atol=1e-6)
    assert accel_mps2[acts].std() > 0.1 and not sees[~acts].any()

    power = torch.where(after["present"], -(after["speed_mps"] * after["accel_mps2"]).clamp_min(0.0), 0.0)
    own, paid = power.gather(1, agents["vehicle"]), vector[..., facts["reward_vector"].index("power")]
    mean = power.sum(1, keepdim=True) / after["present"].sum(1, keepdim=True).clamp_min(1)
    fleet = vector[..., facts["reward_vector"].index("fleet_power")]
    torch.testing.assert_close(paid[stays], own[stays], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(fleet, torch.where(acts, mean, 0.0), rtol=1e-4, atol=1e-4)
    reward = agents["reward"].squeeze(-1)
    torch.testing.assert_close(reward[acts], ((0.25 * fleet + 0.75 * paid) / 2.0)[acts], rtol=1e-4, atol=1e-4)
    assert own[stays].std() > 0.1 and not reward[~acts].any()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_figure_is_shown_wherever_figures_are(package: Path, tmp_path: Path) -> None:
    console = run(package, "-c", FIGURE, str(tmp_path))
    label = "hard braking per vehicle"
    assert label in " ".join(console.split()), "on the console"
    assert f"| {label} |" in (tmp_path / "tables.md").read_text(), "in Markdown"
    assert label in (tmp_path / "report.html").read_text(), "on the page"
    (path,) = (tmp_path / "leaderboard").glob("*.json")
    assert "hard_braking_s" in json.loads(path.read_text())["rows"], "in leaderboard files"
