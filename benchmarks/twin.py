"""How far the twin is from SUMO, on any contexts.

``python -m izoo.benchmarks.twin contexts=dataset contexts.path=NETS`` plays the same episodes on both: one and two
vehicles alone, to 1e-6; for some policies every vehicle in every step, up to where the two part, and what drivers did
(changes of lane, vehicles that passed on each signal, how queues left); for all policies CO2, delay and vehicles that
crossed per approach; and what each policy saves over human driving. SUMO plays everything once more with one vehicle
of every approach a step late (``late=1``): how far it is from itself then stands beside how far the twin is. The folder
``out`` is a results folder (:mod:`izoo.results.store`) with rows of both simulators, and gets ``fidelity.json``,
``approaches.csv``, ``fidelity.png``, ``few.csv`` and ``steps.csv``; rows with late vehicles are in ``late-1`` and so
on. The same command goes on where it was stopped.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from izoo.cli.option_command import GOES_ON, OptionCommand
from izoo.conf.built_in import CityContexts
from izoo.conf.context_choices import ContextsConfig
from izoo.conf.evaluate_options import EPISODE_RANGES, check_policy
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError, check_choice, check_range
from izoo.files import make_absolute
from izoo.metrics.pairing import HUMAN
from izoo.options import CheckedOptions
from izoo.zoo import catalog

if TYPE_CHECKING:
    import pandas as pd

    from izoo.contexts.context import Context
    from izoo.results.policies import NamedPolicy
    from izoo.results.selection import EpisodeSeeds


@dataclass(frozen=True)
class FidelityConfig(CheckedOptions):
    """Options of the comparison of the twin with SUMO.

    Attributes:
        contexts: which contexts to play; every one is played at every adoption and with every demand below.
        env: the environment.
        num_contexts: how many contexts to draw; null: all of a finite set, and 16 of one without end.
        adoptions: shares of CVs; human driving is played beside them in any case.
        demand: ``given`` as the contexts say, ``all`` with vehicles from all approaches.
        policies: drivers, ``zoo:NAME``, ``FILE.pt``, or ``module:function``; all are played in the environment of the
            policy from the zoo, if there is one.
        exact: of which of them to compare every vehicle in every step, in the first episode of each context.
        seeds: episodes per context.
        late: how often SUMO plays everything again, with another vehicle of every approach a step late. How far it is
            from itself then is what differences are judged against.
        seed: base of the episode seeds and of the drawn contexts.
        num_workers: worker processes that play SUMO.
        out: folder of the results; a comparison that was interrupted goes on there.
        cache: folder of the cached episodes of human and uncommanded driving; null: the user's cache folder.
        verbose: print every table, not only how far apart policies are.
    """

    contexts: ContextsConfig = field(default_factory=CityContexts)
    env: EnvConfig = field(default_factory=EnvConfig)
    num_contexts: int | None = None
    adoptions: tuple[float, ...] = (1 / 3, 1.0)
    demand: tuple[Literal["given", "all"], ...] = ("given", "all")
    policies: tuple[str, ...] = ("uncommanded", "glide", "random")
    exact: tuple[str, ...] = ("uncommanded", "glide")
    seeds: int = 3
    late: int = 1
    seed: int = 0
    num_workers: int = 2
    out: str = "twin-fidelity"
    cache: str | None = None
    verbose: bool = False
    ranges = (*EPISODE_RANGES, ("late", 0, 1000))

    def __post_init__(self) -> None:
        super().__post_init__()
        for adoption in self.adoptions:
            check_range("adoptions", adoption, 0.0, 1.0)
        if self.late and self.env.late_vehicle:
            raise IzooError("late=0 or env.late_vehicle=0: the comparison sets env.late_vehicle itself.")
        for demand in self.demand:
            check_choice("demand", demand, ("given", "all"))
        for name in ("policies", "exact"):
            for policy in getattr(self, name):
                if policy == HUMAN:
                    raise IzooError(f"{name} holds 'human', which is played in any case; leave it out.")
                check_policy(name, policy)
            object.__setattr__(self, name, tuple(map(catalog.absolute, getattr(self, name))))
        if not (self.adoptions and self.demand and self.policies):
            raise IzooError("adoptions, demand and policies each need one entry or more.")
        make_absolute(self, "out", "cache")


def run(config: FidelityConfig) -> Path:
    """Compare, or go on comparing; print the tables, and return the folder of the results."""
    import pandas as pd

    from izoo.benchmarks.fidelity import single_vehicle, trajectory_diff, twin_fidelity
    from izoo.console import counted
    from izoo.envs.twin.backend import check_settings
    from izoo.envs.twin.net.supported import check_contexts
    from izoo.files import write_json, write_text
    from izoo.results.policies import BASELINES, as_policy
    from izoo.results.rollout import evaluated
    from izoo.results.rows_file import RowsFile
    from izoo.results.selection import EVALUATION_STREAM, EpisodeSeeds, choose_contexts, describe

    config = dataclasses.replace(config, env=evaluated(config.env))
    check_settings(config.env)
    out = Path(config.out)
    base = choose_contexts(config.contexts.build(), config.num_contexts, config.seed)
    contexts = variants(base, config)
    check_contexts(base)
    # Made before anything is played, so that one that is not there stops the command at once.
    exact_of = [as_policy(name, config.env) for name in config.exact]
    policies = [as_policy(name, config.env) for name in dict.fromkeys([*BASELINES, *config.policies])]
    seeds = EpisodeSeeds(EVALUATION_STREAM + config.seed, config.seeds)
    print(f"SUMO and the twin: {describe(contexts, seeds, config.env)}. Results: {out}", flush=True)
    both = play_all(config, policies, contexts, seeds)
    late = [play_all(config, policies, contexts, seeds, number) for number in range(1, config.late + 1)]
    sumo, played = (both[both["simulator"] == name] for name in ("sumo", "twin"))
    few_file, steps_file = (
        RowsFile(out / name, (*of.TEXT, *of.NUMBERS), of.TEXT, ("seed",)).read()
        for name, of in (("few.csv", single_vehicle), ("steps.csv", trajectory_diff))
    )
    few = single_vehicle.compare_few(base, seeds, config.env.step_s, few_file)
    exact = pd.DataFrame(trajectory_diff.compare_steps(contexts, seeds, config.env, exact_of, steps_file))
    own = twin_fidelity.own_spread(sumo, late)
    compared = twin_fidelity.with_spread(twin_fidelity.approaches(sumo, played), own)
    gained = twin_fidelity.gains(sumo, played, late)
    found = {
        "few": twin_fidelity.few(few),
        "exact": twin_fidelity.exactness(exact),
        "driving": twin_fidelity.driving(exact),
        "groups": twin_fidelity.by_group(compared),
        "own": own if own.empty else twin_fidelity.by_group(own),
        "gains": gained,
    }
    write_text(out / "approaches.csv", compared.to_csv(index=False))
    about = {"contexts": len(contexts), "seeds": len(seeds), "late": config.late}
    rows = {name: json.loads(table.to_json(orient="records")) for name, table in found.items()}
    write_json(out / "fidelity.json", {**about, **rows, "same_order": twin_fidelity.same_order(gained)})
    shown_of = f"{counted(len(contexts), 'context')}, {counted(len(seeds), 'seed')}"
    twin_fidelity.plot(compared, out / "fidelity.png", f"The twin beside SUMO: {shown_of}")
    for table in [*(twin_fidelity.tables(found) if config.verbose else ()), twin_fidelity.headline(compared, gained)]:
        table.show()
    print(f"Results: {out}\n{twin_fidelity.verdict(compared, gained)}", flush=True)
    return out


def play_all(
    config: FidelityConfig,
    policies: Sequence[NamedPolicy],
    contexts: Sequence[Context],
    seeds: EpisodeSeeds,
    late: int = 0,
) -> pd.DataFrame:
    """Play every policy on SUMO and the twin, or on SUMO with a ``late`` vehicle; return the rows of these episodes.

    A folder also holds what was played with other options.
    """
    import pandas as pd

    from izoo.results.rollout import Play, play_missing
    from izoo.results.schema import EPISODE
    from izoo.results.store import Store

    env = dataclasses.replace(config.env, late_vehicle=late or config.env.late_vehicle)
    store = Store(Path(config.out, f"late-{late}" if late else ""), task="twin and SUMO", config=env)
    episodes = [(context, seed) for context in contexts for seed in seeds.of(context)]
    options: dict[str, Any] = {"task": "twin and SUMO", "workers": config.num_workers, "cache": config.cache}
    wanted = []
    with store.open():
        store.keep_contexts(contexts)
        for simulator, policy in itertools.product(("sumo",) if late else ("sumo", "twin"), policies):
            print(f"{simulator}{f' with late vehicle {late}' if late else ''}: {policy.name}", flush=True)
            key = policy.name, 0
            store.admit({key: policy.record})
            plays = [Play(*key, *episode) for episode in episodes]
            play_missing(store, plays, {key: policy.policy}, env, simulator, **options)
            wanted += [(policy.name, 0, simulator, context.content_hash, seed) for context, seed in episodes]
    table = store.table
    return table[pd.MultiIndex.from_frame(table[list(EPISODE)]).isin(wanted)]


def variants(base: Sequence[Context], config: FidelityConfig) -> list[Context]:
    """Return the contexts with every demand and at every adoption that is asked for, without repetition."""
    found = [
        context.replace(adoption=adoption, approach=None if demand == "all" else context.approach)
        for demand in config.demand
        for context in base
        for adoption in config.adoptions
    ]
    return list({context.content_hash: context for context in found}.values())


COMMAND = OptionCommand(
    name="benchmarks.twin",
    summary="Compare the twin with SUMO on any contexts: every vehicle and step, CO2 per approach, gains of policies.",
    examples=(
        "izoo.benchmarks.twin contexts=pcg num_contexts=8",
        "izoo.benchmarks.twin contexts=dataset contexts.path=NETS adoptions=[0.33,1] policies=[uncommanded,glide]",
        "izoo.benchmarks.twin contexts=city contexts.city=atlanta num_contexts=20 demand=[all] out=atlanta",
    ),
    config="izoo.benchmarks.twin:FidelityConfig",
    work="izoo.benchmarks.twin:run",
    defaults="izoo.cli.defaults:of_policies",
    stopped=GOES_ON,
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
