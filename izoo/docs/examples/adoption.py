"""How much do controlled vehicles save, few of them or all? Several policies against the share of CVs, in one figure.

``python -m izoo.docs.examples.adoption DATASET OUT [POLICY ...]`` evaluates, in SUMO, on the test split of a folder of
the published dataset. ``NAME=FILE.pt,FILE.pt`` in place of a policy means several training seeds of one learner. It may
be stopped at any time; the same command goes on.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from izoo import zoo
from izoo.conf.folders import DatasetContexts
from izoo.console import exit_code, survives_lost_output
from izoo.contexts.context import Context
from izoo.envs import EnvConfig
from izoo.errors import IzooError
from izoo.files import write_json
from izoo.results import evaluate_policy, summarise
from izoo.results.policies import as_policy
from izoo.results.selection import EVALUATION_STREAM, EpisodeSeeds, choose_contexts

ADOPTIONS = (0.1, 1 / 3, 1.0)
VEHICLES = {"paper": "CVs with the paper's parameters", "human": "CVs with the parameters of human-driven vehicles"}


@dataclass(frozen=True)
class Entry:
    """A line of the figure: its name, and a policy or the training seeds of one."""

    name: str
    policies: tuple[str, ...]

    @classmethod
    def named(cls, text: str) -> Entry:
        """Return the entry that ``POLICY`` or ``NAME=POLICY,POLICY`` means.

        Raises:
            IzooError: a policy means nothing, or the name cannot be that of a folder.
        """
        name, several, policies = text.partition("=")
        own = Path(text).stem if text.endswith(".pt") else text.rpartition(":")[2]
        entry = cls(name, tuple(policies.split(","))) if several else cls(own, (text,))
        if not re.fullmatch(r"\w[\w.+-]*", entry.name):
            raise IzooError(f"{entry.name!r} in {text!r} is no name; write letters and digits: ppo=FILE.pt,FILE.pt.")
        for policy in entry.policies:
            as_policy(policy, own_env(policy))
        return entry


def own_env(policy: str, horizon_s: float = 1000.0) -> EnvConfig:
    """Return what a policy observes, and how long its decisions last: as it was trained, or 2 s."""
    shipped = zoo.named(policy)
    env = zoo.load(shipped).env if shipped else EnvConfig(hold_s=2.0)
    return dataclasses.replace(env, horizon_s=horizon_s)


def measure(
    contexts: Sequence[Context],
    entries: Sequence[Entry],
    out: Path,
    seeds: int = 3,
    horizon_s: float = 1000.0,
    num_workers: int = 0,
) -> list[dict[str, Any]]:
    """Evaluate entries at every adoption with both kinds of vehicles; return a row per combination.

    Args:
        contexts: whatever their adoption is.
        entries: what is compared.
        out: folder of the evaluations.
        seeds: paired episodes per context.
        horizon_s: how long they last.
        num_workers: processes that play.
    """
    rows = []
    for vehicle in VEHICLES:
        for adoption in ADOPTIONS:
            here = [context.replace(adoption=adoption, cv_vehicle=vehicle) for context in contexts]
            for entry in entries:
                print(f"{entry.name}, {100 * adoption:.0f} % {VEHICLES[vehicle]}", flush=True)
                for train_seed, policy in enumerate(entry.policies):
                    table = evaluate_policy(
                        policy,
                        here,
                        EpisodeSeeds(EVALUATION_STREAM, seeds),
                        own_env(policy, horizon_s),
                        workers=num_workers,
                        out=out / f"{vehicle}-{adoption:.2f}",
                        name=entry.name,
                        train_seed=train_seed,
                    )
            summary = summarise(table[table["context_hash"].isin([context.content_hash for context in here])])
            for entry in entries:
                found = summary["entries"][entry.name]
                saved = {name: blocks["all"]["figures"]["co2_saved"] for name, blocks in found["against"].items()}
                seen = {"train_seeds": found["train_seeds"], "contexts": summary["n"]["contexts"], "saved": saved}
                rows.append({"policy": entry.name, "adoption": adoption, "vehicle": vehicle, **seen})
    return rows


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the CO2 saved over human driving against adoption, a panel per kind of vehicle."""
    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(VEHICLES), figsize=(9.5, 3.8), sharey=True, layout="constrained")
    for panel, (vehicle, title) in zip(axes, VEHICLES.items(), strict=True):
        names = list(dict.fromkeys(row["policy"] for row in rows))
        for number, name in enumerate(names):
            mine = [row for row in rows if row["policy"] == name and row["vehicle"] == vehicle]
            x = np.arange(len(mine)) + min(0.12, 0.4 / len(names)) * (number - (len(names) - 1) / 2)
            y = [row["saved"]["human"]["value"] for row in mine]
            panel.plot(x, y, "o-", label=name.replace("_", " "), markersize=4)
            for place, row in zip(x, mine, strict=True):
                if row["saved"]["human"]["low"] is not None:
                    ends = [row["saved"]["human"]["low"], row["saved"]["human"]["high"]]
                    panel.plot([place, place], ends, color=panel.lines[-1].get_color(), linewidth=1)
            panel.set_xticks(range(len(mine)), [f"{100 * row['adoption']:.0f} %" for row in mine])
        panel.axhline(0.0, color="grey", linewidth=0.8)
        panel.set(title=title, xlabel="share of CVs")
    axes[0].set_ylabel("CO2 saved over human driving (%)")
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(dataset: str, out: str, policies: Sequence[str], limit: int = 10, num_workers: int = 0) -> None:
    """Evaluate on ``limit`` approaches drawn from the test split, and write ``adoption.json`` and ``adoption.png``."""
    folder = Path(out)
    entries = [Entry.named(policy) for policy in policies]  # a name that means nothing is refused before playing
    names = [entry.name for entry in entries]
    if len(set(names)) < len(names):
        raise IzooError(f"the entries {', '.join(names)} share a name; give each another, as in NAME=POLICY.")
    contexts = choose_contexts(DatasetContexts(path=dataset, split="test").build(), limit, 0)
    rows = measure(contexts, entries, folder, num_workers=num_workers)
    write_json(folder / "adoption.json", {"rows": rows})
    draw(rows, folder / "adoption.png")
    print(f"{folder / 'adoption.png'}")


def command(words: Sequence[str]) -> int:
    """Run the example as a command and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m izoo.docs.examples.adoption", description=__doc__)
    parser.add_argument("dataset", help="folder of the published dataset")
    parser.add_argument("out", help="folder of the results")
    parser.add_argument(
        "policies", nargs="*", metavar="POLICY", help="as policy= of izoo.evaluate, or NAME=FILE.pt,FILE.pt,..."
    )
    parser.add_argument("--limit", type=int, default=10, help="approaches drawn from the test split")
    parser.add_argument("--workers", type=int, default=0, help="processes that play")
    given = parser.parse_args(words)

    @survives_lost_output()
    def work() -> int:
        main(given.dataset, given.out, given.policies or ("uncommanded", "glide"), given.limit, given.workers)
        return 0

    return exit_code("adoption", work, "the same command goes on where it stopped")


if __name__ == "__main__":
    sys.exit(command(sys.argv[1:]))
