"""How much is there to gain? A planner that knows the future looks for advice by trial, on branches of the twin.

``python -m izoo.benchmarks.planner contexts=...`` plays every context with human drivers, uncommanded CVs, glide and
the planner, on the twin. The planner is no policy that could drive: before it advises a CV, it plays what would follow
from each advice, with the very vehicles that will come. What it finds is a lower bound of what could be gained, since
it changes the advice of one CV at a time.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo.commands.option_command import GOES_ON, OptionCommand
from izoo.conf.mapping import to_mapping
from izoo.errors import IzooError
from izoo.files import read_text, write_json

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from izoo.benchmarks.planner_options import PlannerConfig
    from izoo.benchmarks.whole_episodes import Play, Sums
    from izoo.envs import EnvConfig, TwinEnv

MAY_CHANGE = ("out", "threads", "adoptions", "seeds")
"""Options that may differ when a file of rows is gone on with."""
AT_ONCE = 16
"""Intersections that are played side by side."""
LEAST_GAIN = 1e-3
"""Advice is changed for no less, in units of what human driving burns in a step: rounding is no reason."""


def run(config: PlannerConfig, given: frozenset[str] = frozenset()) -> list[dict[str, Any]]:
    """Play all contexts that the file ``out`` does not hold yet, print the table, and return all rows.

    Raises:
        IzooError: ``out`` is not a file of this command, or was made with other options.
    """
    print("Loading torch; the twin compiles where it has not yet.", flush=True)
    from rich.console import Console

    from izoo.benchmarks.whole_episodes import WHOLE_DEMAND, played, scripted
    from izoo.console import Progress
    from izoo.evaluation.baselines import baseline_context
    from izoo.evaluation.selection import EVALUATION_STREAM, EpisodeSeeds, choose_contexts

    rows = kept(config)
    contexts = choose_contexts(config.contexts.build(), config.num_contexts, config.seed)
    seeds = EpisodeSeeds(EVALUATION_STREAM + config.seed, config.seeds)
    env, done = settings(config), {(row["context_hash"], row["seed"]) for row in rows}
    parts: list[list[Play]] = []
    for adoption in config.adoptions:
        plays = [(context.replace(adoption=adoption), seed) for context in contexts for seed in seeds.of(context)]
        todo = [(context, seed) for context, seed in plays if (context.content_hash, seed) not in done]
        parts += [todo[first : first + AT_ONCE] for first in range(0, len(todo), AT_ONCE)]
    if done:
        print(f"{config.out} holds {len(rows)} episodes; it goes on.", flush=True)
    with Progress(len(parts) * env.decisions, unit="decisions", file=sys.stderr) as bar:
        for number, part in enumerate(parts):

            def seen(decisions: int, before: int = number * env.decisions) -> None:
                bar.update(before + decisions)

            human = [(baseline_context(context), seed) for context, seed in part]
            found = {
                "human": played(human, env, config.threads, scripted("human", env)),
                "uncommanded": played(part, env, config.threads, scripted("uncommanded", env)),
                "glide": played(part, env, config.threads, scripted("glide", env)),
                "planner": played(part, env, config.threads, lambda world: Planner(world, config, seen).act),
            }
            for k, (context, seed) in enumerate(part):
                row = {"context_hash": context.content_hash, "context": context.name, "seed": seed}
                row["intersection"] = context.intersection.name
                lanes = int(found["human"]["lanes"][k])
                rows.append({**row, "adoption": context.adoption, "lanes": lanes, **_sums(found, k)})
            keep(config, rows)
    Console().print(table(rows))
    print(f"Percentages are saved over uncommanded CVs; brackets: 95 % intervals. {WHOLE_DEMAND}")
    return rows


def kept(config: PlannerConfig) -> list[dict[str, Any]]:
    """Return the rows that the file ``out`` holds; none where there is no such file."""
    if config.out is None or not Path(config.out).exists():
        return []
    from izoo.evaluation.folder import differences

    try:
        content = json.loads(read_text(Path(config.out)))
        made_with, rows, made_by = dict(content["options"]), list(content["rows"]), dict(content.get("versions", {}))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise IzooError(f"{config.out} is no file of izoo.benchmarks.planner; choose another with out=FILE.") from None
    for name, value in _options(config).items():
        if made_with.get(name) != value:
            raise IzooError(
                f"{config.out} was made with {name}={made_with.get(name)}, and now it is {value}; give the same, or "
                "choose another file with out=FILE."
            )
    differing = differences(made_by, _versions())
    if differing:
        raise IzooError(f"{config.out} was made by other versions ({differing}); choose another file with out=FILE.")
    return rows


def keep(config: PlannerConfig, rows: Sequence[dict[str, Any]]) -> None:
    """Write the rows, and what they come to, where they are wanted."""
    if config.out is not None:
        content = {"options": _options(config), "versions": _versions(), "rows": rows, "summary": summary(rows)}
        write_json(Path(config.out), content)


def _options(config: PlannerConfig) -> dict[str, Any]:
    """Return the options that rows of one file share."""
    return {name: value for name, value in to_mapping(config).items() if name not in MAY_CHANGE}


def _versions() -> dict[str, str]:
    """Return the versions that rows of one file share."""
    from izoo.benchmarks.claim import with_drivers
    from izoo.evaluation.provenance import versions

    return with_drivers(versions())


def settings(config: PlannerConfig) -> EnvConfig:
    """Return the environment: decisions as long as between two trials, paid as a team."""
    from izoo.envs import RewardConfig

    reward, emit = RewardConfig.fuel_team(), ("team_reward",)
    return dataclasses.replace(config.env, hold_s=config.every_s, reward=reward, emit=emit)


class Planner:
    """Advises CVs by trial: one CV per intersection at a time, whoever has waited longest for it.

    Advice holds until the next trial about the same CV, or until it has crossed the stop line.

    Args:
        world: the environments, at the beginning of their episodes; the branches are made of them.
        config: options.
        note: is told after how many decisions it is.
    """

    def __init__(self, world: TwinEnv, config: PlannerConfig, note: Callable[[int], None] = lambda _: None) -> None:
        import torch

        from izoo.algos.advice import SpeedCap
        from izoo.envs.mdp.frame import observation_names

        self.world, self.config, self.note = world, config, note
        self.cap = SpeedCap(world.config, config.brake_mps2)
        self.approaching = observation_names(world.config).index("location_approaching")
        self.candidates = torch.tensor([0.0, 0.0, *config.caps])  # as it is, nothing, or one of the caps
        self.branches = world.branch(len(self.candidates))
        shape = (world.num_envs, world.config.num_agents)
        self.advice, self.asked = torch.zeros(shape), torch.full(shape, -1.0)
        self.decisions = 0

    def act(self, state: TensorDictBase) -> TensorDictBase:
        """Look for better advice for one CV of each environment, and write everyone's commands."""
        import torch

        self._forget(self.advice, state)
        mask = state.get(("agents", "mask"))
        self.asked[~mask] = -1.0
        here = mask & (state.get(("agents", "observation"))[..., self.approaching] > 0.5)
        waiting = torch.where(here, self.decisions - self.asked, torch.full_like(self.asked, -1.0))
        longest, slot = waiting.max(-1)
        if bool((longest >= 0).any()):
            rows = torch.arange(len(slot))
            tried = self.candidates.repeat(len(slot), 1)
            tried[:, 0] = self.advice[rows, slot]
            worth = self._tried(slot, tried)
            best = worth.argmax(-1)
            better = (longest >= 0) & (worth[rows, best] > worth[:, 0] + LEAST_GAIN)
            self.advice[rows[better], slot[better]] = tried[rows, best][better]
            self.asked[rows, slot] = float(self.decisions)
        self.decisions += 1
        self.note(self.decisions)
        return self._command(state, self.advice)

    def _tried(self, slot: Any, tried: Any) -> Any:
        """Return the team's rewards of what follows from advising ``tried [N, K]`` in the slots ``[N]``, ``[N, K]``."""
        import torch

        count = tried.shape[1]
        self.world.branch_into(self.branches)
        advice = self.advice.repeat_interleave(count, 0)
        advice[torch.arange(len(advice)), slot.repeat_interleave(count)] = tried.reshape(-1)
        now, worth = self.branches.present(), torch.zeros(len(advice))
        for _ in range(max(round(self.config.look_ahead_s / self.config.every_s), 1)):
            self._forget(advice, now)
            following = self.branches.step_lean(self._command(now, advice))
            worth += following.get("team_reward").squeeze(-1)
            if following.get("done").any():
                break
            now = following.exclude(("agents", "reward"))
        return worth.view(-1, count)

    def _forget(self, advice: Any, state: TensorDictBase) -> None:
        """Advise nobody who has crossed the stop line, and no empty slot."""
        here = state.get(("agents", "mask")) & (state.get(("agents", "observation"))[..., self.approaching] > 0.5)
        advice[~here] = 0.0

    def _command(self, state: TensorDictBase, advice: Any) -> TensorDictBase:
        seen = self.cap.look(state.get(("agents", "observation")), state.get(("agents", "mask")))
        accel, defer = self.cap.command(seen, advice)
        state.set(("agents", "action"), accel.unsqueeze(-1))
        return state.set(("agents", "defer"), defer)


def _sums(found: dict[str, Sums], k: int) -> dict[str, float]:
    return {
        f"{name}_{driver}": float(sums[name][k])
        for driver, sums in found.items()
        for name in ("demand_emission_g", "crossed", "waiting")
    }


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return, by adoption and lanes, what each driver saves over uncommanded CVs and how many more vehicles cross."""
    import numpy as np

    from izoo.benchmarks.whole_episodes import per_vehicle_g
    from izoo.metrics.statistics import estimate, mean

    def rate(row: dict[str, Any], driver: str) -> float:
        return float(per_vehicle_g(row[f"demand_emission_g_{driver}"], row[f"crossed_{driver}"]))

    rows = [row for row in rows if row["crossed_uncommanded"] > 0 and row["demand_emission_g_uncommanded"] > 0]
    lines = []
    for adoption in dict.fromkeys(row["adoption"] for row in rows):
        for kind, fits in (("one", lambda lanes: lanes == 1), ("several", lambda lanes: lanes > 1)):
            chosen = [row for row in rows if row["adoption"] == adoption and fits(row["lanes"])]
            if not chosen:
                continue
            places = [row["intersection"] for row in chosen]
            line: dict[str, Any] = {"adoption": adoption, "lanes": kind, "episodes": len(chosen)}
            for driver in ("glide", "planner"):
                saved = np.array([[1.0 - rate(row, driver) / rate(row, "uncommanded") for row in chosen]])
                more = np.array([[row[f"crossed_{driver}"] / row["crossed_uncommanded"] - 1.0 for row in chosen]])
                line[driver] = estimate(saved, mean, places).to_dict()
                line[f"{driver}_median"] = float(np.median(saved))
                line[f"{driver}_crossed"] = estimate(more, mean, places).to_dict()
            lines.append(line)
    return lines


def table(rows: Sequence[dict[str, Any]]) -> Any:
    """Return the summary as a table to read."""
    from rich.table import Table

    from izoo.evaluation.show import percent

    shown = Table(title="What there is to gain")
    for heading in ("adoption", "lanes", "episodes", "glide", "planner", "median", "vehicles through"):
        shown.add_column(heading, justify="right")
    for line in summary(rows):
        cells = [f"{line['adoption']:.2f}", line["lanes"], str(line["episodes"]), percent(line["glide"])]
        cells += [percent(line["planner"]), f"{100.0 * line['planner_median']:.1f} %", percent(line["planner_crossed"])]
        shown.add_row(*cells)
    return shown


COMMAND = OptionCommand(
    name="benchmarks.planner",
    summary="Search, with knowledge of the future, for advice that saves CO2: how much is there to gain?",
    examples=(
        "izoo.benchmarks.planner contexts=city contexts.split=validation num_contexts=8",
        "izoo.benchmarks.planner contexts=pcg contexts.lane_count=1 num_contexts=8 adoptions=[1.0] out=planner.json",
    ),
    config="izoo.benchmarks.planner_options:PlannerConfig",
    work="izoo.benchmarks.planner:run",
    check="izoo.benchmarks.result_file:check_out",
    stopped=f"with out=FILE {GOES_ON}",
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
