"""How far the twin is from SUMO, on any contexts.

``python -m izoo.benchmarks.twin contexts=dataset contexts.path=NETS`` plays the same episodes on both, rung by rung:
one and two vehicles alone, to 1e-6; for some policies every vehicle in every step, up to where the two part, and what
drivers did (changes of lane, who passed on which signal, how queues left); for all policies CO2, vehicles that crossed,
travel and stopped times per approach; and what each policy gains over human driving. SUMO plays everything once more
with one vehicle of every approach a step late (``late=1``): how far it is from itself then stands beside how far the
twin is. The folder ``out`` gets ``ladder.json``, ``approaches.csv``, ``own.csv``, ``few.csv``, ``exact.csv``,
``ladder.png`` and the evaluations; the same command goes on where it was stopped.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from izoo.commands.option_command import GOES_ON, OptionCommand

if TYPE_CHECKING:
    import pandas as pd

    from izoo.benchmarks.ladder_options import LadderConfig
    from izoo.contexts.context import Context
    from izoo.envs.config import EnvConfig
    from izoo.evaluation.policies import Candidate
    from izoo.evaluation.selection import EpisodeSeeds

STEPS_KEY = ("policy", "fingerprint", "context_hash", "seed")
STEPS_COLUMNS = {
    **{"policy": "str", "fingerprint": "str", "context": "str", "context_hash": "str", "seed": "int64"},
    **{"adoption": "float", "demand": "str", "lanes": "int64", "steps": "int64", "parted": "Int64", "where": "str"},
    **{"ks_speed": "float", "ks_accel": "float"},
}


def run(config: LadderConfig, given: frozenset[str] = frozenset()) -> Path:
    """Compare, or go on comparing; print the tables, and return the folder of the results."""
    import pandas as pd
    from rich.console import Console

    from izoo.benchmarks import ladder
    from izoo.benchmarks.few_vehicles import compare_few
    from izoo.console import counted
    from izoo.envs.twin.playable import check_contexts
    from izoo.envs.twin.twin_backend import check_settings
    from izoo.evaluation.policies import HUMAN, UNCOMMANDED, as_candidate
    from izoo.evaluation.runner import evaluate_policy
    from izoo.evaluation.selection import EVALUATION_STREAM, EpisodeSeeds, choose_contexts, describe
    from izoo.files import write_json, write_text

    config = dataclasses.replace(config, env=env_of(config, given))
    check_settings(config.env)
    out = Path(config.out)
    base = choose_contexts(config.contexts.build(), config.num_contexts, config.seed)
    contexts = variants(base, config)
    check_contexts(base)
    # Made before anything is played, so that one that is not there stops the command at once.
    exact_of = [as_candidate(name, config.env) for name in config.exact]
    seeds = EpisodeSeeds(EVALUATION_STREAM + config.seed, config.seeds)
    print(f"SUMO and the twin: {describe(contexts, seeds, config.env)}. Results: {out}", flush=True)
    # A folder also holds what was played with other options; only what is played now is compared.
    names = {HUMAN, UNCOMMANDED, *(as_candidate(policy, config.env).name for policy in config.policies)}
    episodes = pd.MultiIndex.from_tuples([(each.content_hash, seed) for each in contexts for seed in seeds.of(each)])

    def evaluated(simulator: str, late_vehicle: int) -> pd.DataFrame:
        folder = f"{simulator}-late-{late_vehicle}" if late_vehicle else simulator
        for policy in config.policies:
            print(f"{folder}: {policy}", flush=True)
            table = evaluate_policy(
                policy,
                contexts,
                seeds,
                dataclasses.replace(config.env, late_vehicle=late_vehicle or config.env.late_vehicle),
                num_workers=config.num_workers,
                out_dir=out / folder,
                cache=config.cache,
                simulator=simulator,
            )
        played_now = pd.MultiIndex.from_frame(table[["context_hash", "seed"]]).isin(episodes)
        return table[played_now & table["policy"].isin(names)]

    sumo, played = evaluated("sumo", 0), evaluated("twin", 0)
    late = [evaluated("sumo", number) for number in range(1, config.late + 1)]
    few = compare_few(base, seeds, config.env.step_s, out / "few.csv")
    exact = compare_steps(contexts, seeds, config, exact_of, out / "exact.csv")
    own = ladder.own_spread(sumo, late)
    compared = ladder.with_spread(ladder.approaches(sumo, played), own)
    rungs, gained = ladder.rungs(compared), ladder.gains(sumo, played, late)
    own_rungs = pd.DataFrame() if own.empty else ladder.rungs(own, "late")
    write_text(out / "approaches.csv", compared.to_csv(index=False))
    if len(own):
        write_text(out / "own.csv", own.to_csv(index=False))
    write_json(
        out / "ladder.json",
        {
            "contexts": len(contexts),
            "seeds": len(seeds),
            "late": config.late,
            "few": _records(ladder.few(few)),
            "exact": _records(ladder.exactness(exact)),
            "conduct": _records(ladder.conduct(exact)),
            "approaches": _records(rungs),
            "own": _records(own_rungs),
            "gains": _records(gained),
            "same_order": ladder.same_order(gained),
        },
    )
    shown_of = f"{counted(len(contexts), 'context')}, {counted(len(seeds), 'seed')}"
    ladder.plot(compared, out / "ladder.png", f"The twin beside SUMO: {shown_of}")
    found = ladder.Ladder(ladder.few(few), ladder.exactness(exact), ladder.conduct(exact), rungs, own_rungs, gained)
    for shown in ladder.tables(found):
        Console().print(shown)
    print(f"Results: {out}", flush=True)
    return out


def env_of(config: LadderConfig, given: frozenset[str]) -> EnvConfig:
    """Return the environment that everybody is played in.

    It is that of a policy that ships with izoo, if there is one among them, but for what ``given`` names.
    """
    from izoo import zoo
    from izoo.conf.mapping import with_given

    env = config.env
    for name in filter(None, map(zoo.named, config.policies)):
        env = with_given(zoo.load(name).env, config.env, given, "env")
    return env


def _records(table: pd.DataFrame) -> Any:
    """Return a table's rows for JSON, where NaN is null."""
    return json.loads(table.to_json(orient="records"))


def variants(base: Sequence[Context], config: LadderConfig) -> list[Context]:
    """Return the contexts with every demand and at every adoption that is asked for, without repetition."""
    found = [
        context.replace(adoption=adoption, approach=None if demand == "all" else context.approach)
        for demand in config.demand
        for context in base
        for adoption in config.adoptions
    ]
    return list({context.content_hash: context for context in found}.values())


def compare_steps(
    contexts: Sequence[Context], seeds: EpisodeSeeds, config: LadderConfig, candidates: Sequence[Candidate], path: Path
) -> pd.DataFrame:
    """Play each context's first episode side by side, unless it is in the table at ``path``; return a row for each.

    Contexts in which nobody drives have none.

    Returns:
        ``policy``, ``fingerprint`` (of its code and weights), ``context``, ``context_hash``, ``seed``, ``adoption``,
        ``demand``, ``lanes``, ``steps``, ``parted`` (the first step that differs; empty where none does), ``where``
        (who differs there), ``ks_speed``, ``ks_accel``, and with ``_sumo`` and ``_twin`` what is counted of drivers
        (:data:`izoo.benchmarks.conduct.COUNTS`), where decisions last no longer than a step.
    """
    from izoo.benchmarks.kept_rows import KeptRows
    from izoo.benchmarks.ladder import COUNTED, ks_distance
    from izoo.benchmarks.side_by_side import SideBySide
    from izoo.console import Progress
    from izoo.networks.net.build import build_net
    from izoo.networks.road import read_road

    kept = KeptRows(path, STEPS_COLUMNS | dict.fromkeys(COUNTED, "float"), STEPS_KEY)
    plays = {
        (each.name, each.fingerprint, context.content_hash, seeds.of(context)[0]): (each, context)
        for context in contexts
        if context.demand_approaches
        for each in candidates
    }
    todo = [key for key in plays if key not in kept]
    if not todo:
        return kept.table(plays)
    both = SideBySide(config.env)
    try:
        with Progress(len(todo), unit="episodes", file=sys.stderr) as bar:
            for number, key in enumerate(todo, 1):
                (candidate, context), seed = plays[key], key[-1]
                played = both.play(candidate.policy, context, seed)
                sumo, twin = played.motions
                road = read_road(build_net(context.intersection))
                row: dict[str, Any] = {
                    "policy": candidate.name,
                    "fingerprint": candidate.fingerprint,
                    "context": context.name,
                    "context_hash": context.content_hash,
                    "seed": seed,
                    "adoption": context.adoption,
                    "demand": "all" if context.approach is None else "one",
                    "lanes": max(int(road.lane_count[road.approaches.index(leg)]) for leg in context.demand_approaches),
                    "steps": played.steps,
                    "parted": None if played.parting is None else played.parting.step,
                    "where": "" if played.parting is None else str(played.parting),
                    "ks_speed": ks_distance(sumo.speed, twin.speed),
                    "ks_accel": ks_distance(sumo.accel, twin.accel),
                    **dict.fromkeys(COUNTED),
                }
                for side, conduct in zip(("sumo", "twin"), played.conducts or (), strict=False):
                    row |= {f"{name}_{side}": count for name, count in conduct.counts().items()}
                kept.add(row)
                bar.update(number, context.name)
    finally:
        both.close()
    return kept.table(plays)


COMMAND = OptionCommand(
    name="benchmarks.twin",
    summary="Compare the twin with SUMO on any contexts: every vehicle and step, CO2 per approach, gains of policies.",
    examples=(
        "izoo.benchmarks.twin contexts=pcg num_contexts=8",
        "izoo.benchmarks.twin contexts=dataset contexts.path=NETS adoptions=[0.33,1] policies=[uncommanded,glide]",
        "izoo.benchmarks.twin contexts=city contexts.city=atlanta num_contexts=20 demand=[all] out=atlanta",
    ),
    config="izoo.benchmarks.ladder_options:LadderConfig",
    work="izoo.benchmarks.twin:run",
    stopped=GOES_ON,
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
