"""From the options of the generalization benchmark to contexts, seeds, and the options of its training runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np

from izoo import zoo
from izoo.benchmarks.campaign.generalization_options import Entry, GeneralizationConfig, is_folder
from izoo.cli.compose import compose_config
from izoo.conf.built_in import CityContexts, Split
from izoo.conf.context_choices import ContextsConfig, PcgContexts
from izoo.conf.folders import DatasetContexts
from izoo.conf.train_options import TrainConfig
from izoo.contexts import protocols
from izoo.contexts.cities.rebuilt import city_name
from izoo.contexts.cities.weather import WEATHER_PUBLISHED
from izoo.contexts.context import Context
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError
from izoo.results.rollout import evaluated
from izoo.results.selection import EpisodeSeeds
from izoo.zoo import catalog

EVALUATION_SEED = 241015221
"""Published constant: base of the episode seeds and of the drawn test contexts; no training seed reaches it."""

LENGTH = ("env.horizon_s=", "env.warmup_s=")


@dataclass(frozen=True)
class Plan:
    """What a benchmark trains on and tests on.

    Attributes:
        task: what is tested, in words: ``train -> test``, and in what it departs from the protocol.
        train: contexts of the training runs, as options of ``izoo.train``.
        train_text, test_text: what is trained and tested on, in words.
        test: the test contexts.
        seen: training contexts that are played too.
        seeds: episode seeds of the evaluation.
    """

    task: str
    train: ContextsConfig
    train_text: str
    test: list[Context]
    seen: list[Context]
    test_text: str
    seeds: EpisodeSeeds


def make_plan(config: GeneralizationConfig) -> Plan:
    """Return the plan of resolved options.

    Raises:
        IzooError: a city, folder or set of contexts cannot be used.
    """
    seeds = evaluation_seeds(config.eval_seeds or 0)
    if config.protocol == "systematicity":
        train: ContextsConfig = PcgContexts(preset="systematicity_train")
        contexts: Sequence[Context] = protocols.systematicity(config.test_set).test
        task = f"systematicity ({config.test_set})"
        texts = ["procedural contexts outside the test box", f"the test box, {config.test_set}"]
    else:
        places = (config.train or "", config.test or config.train or "")
        roles: tuple[Split, Split] = ("train", "test") if config.form == "split" else ("all", "all")
        chosen = [place_contexts(place, role, config) for place, role in zip(places, roles, strict=True)]
        train, contexts = chosen[0], cast(Sequence[Context], chosen[1].build())
        names = [place_name(place) for place in places]
        task = " -> ".join(names) + (", all intersections" if config.form == "paper" else "")
        if any(config.weather not in (None, default_weather(place)) for place in places):
            task += f", {config.weather} weather"
        texts = [f"{name}, {role} intersections" for name, role in zip(names, roles, strict=True)]
    limited = limit_contexts(contexts, config.test_limit or 0)
    if len(limited) < len(contexts):
        texts[1] += f", {len(limited)} drawn of {len(contexts)} contexts"
    if config.horizon_s != EnvConfig().horizon_s:
        task += f", {config.horizon_s:g} s"
    return Plan(task, train, texts[0], limited, seen_contexts(train, config), texts[1], seeds)


def seen_contexts(train: ContextsConfig, config: GeneralizationConfig) -> list[Context]:
    """Return the training contexts that are played too, of a larger number among them those of every smaller one."""
    count = config.train_contexts or 0
    if count == 0 or config.form == "paper" or all(entry.kind != "trained" for entry in config.entries()):
        return []
    source = train.build()
    if hasattr(source, "__len__"):
        return limit_contexts(cast(Sequence[Context], source), count)
    generator = np.random.default_rng(EVALUATION_SEED)
    return [source.sample(generator) for _ in range(count)]


def place_name(place: str) -> str:
    """Return the name of a city, or that of a folder with a slash, so that no folder passes for a city."""
    return f"{Path(place).name}/" if is_folder(place) else city_name(place)


def evaluation_seeds(count: int) -> EpisodeSeeds:
    """Return the episode seeds of the evaluation: published, so that everyone's episodes pair up."""
    return EpisodeSeeds(EVALUATION_SEED, count)


def place_contexts(place: str, split: Split, config: GeneralizationConfig) -> CityContexts | DatasetContexts:
    """Return the contexts of a built-in city or a dataset folder, one approach at a time."""
    if is_folder(place):
        if not Path(place).is_dir():
            raise IzooError(f"{place} is no folder; give a city or a folder of the published dataset.")
        return DatasetContexts(path=place, split=split, weather=config.weather or default_weather(place))
    weather = config.weather or default_weather(place)
    return CityContexts(city=city_name(place), split=split, weather=weather, **dict(protocols.COMMON))


def default_weather(place: str) -> Literal["published", "county"]:
    """Return the weather of a city or folder where the options do not say: published where there is one."""
    return "published" if is_folder(place) or city_name(place) in WEATHER_PUBLISHED else "county"


def limit_contexts(contexts: Sequence[Context], limit: int) -> list[Context]:
    """Return at most ``limit`` contexts (0: all) in their order; a larger limit contains every smaller one."""
    if limit == 0 or limit >= len(contexts):
        return [contexts[k] for k in range(len(contexts))]
    chosen = np.random.default_rng(EVALUATION_SEED).permutation(len(contexts))[:limit]
    return [contexts[int(k)] for k in np.sort(chosen)]


def train_config(config: GeneralizationConfig, plan: Plan, entry: Entry, seed: int) -> TrainConfig:
    """Return the options of one training run.

    Raises:
        IzooError: ``train_options`` holds something that this algorithm does not have.
    """
    workers = config.train_workers or 1
    in_sumo = f"collector={'single' if workers == 1 else 'parallel'}"
    in_twin = f"num_envs={'null' if config.num_envs is None else config.num_envs}"
    on_twin = "simulator=twin" in (f"simulator={config.trains_in}", *entry.options)
    validation = ["validation.every_batches=0"]
    if config.select == "best":
        validation = ["validation.contexts=16", f"validation.simulator={config.simulator}"]
    words = [
        f"algo={entry.algo}",
        f"action={entry.action}",
        f"seed={seed}",
        f"num_workers={workers}",
        f"simulator={config.trains_in}",
        in_twin if on_twin else in_sumo,
        *([] if config.frames is None else [f"total_frames={config.frames}"]),
        f"env.horizon_s={config.train_episode().horizon_s}",
        f"env.warmup_s={config.train_episode().warmup_s}",
        "evaluation.contexts=0",
        *validation,
        *config.train_options,
        *entry.options,
    ]
    composed = compose_config(TrainConfig, words)
    if config.frames is None and not any(option.startswith("total_frames=") for option in entry.options):
        # Frames are decisions, of which an episode has fewer where they last longer.
        composed = dataclasses.replace(composed, total_frames=(config.episodes or 1) * composed.env.decisions)
    return dataclasses.replace(composed, contexts=plan.train)


def evaluation_env(config: GeneralizationConfig, entry: Entry | None = None) -> EnvConfig:
    """Return the environment of an entry's evaluation: that of the benchmark's training runs, and what is its own.

    Episodes have the evaluation's length, whatever that of training, and are played out. A policy that ships, or was
    exported from its run, brings its own environment.
    """
    shipped = catalog.named(entry.policy or "") if entry is not None else None
    if shipped:
        env = dataclasses.replace(zoo.full_episodes(zoo.load(shipped).env), horizon_s=config.horizon_s or 0.0)
    else:
        words = [word.lstrip("+") for word in (*config.train_options, *(entry.options if entry is not None else ()))]
        said = [word for word in words if word.startswith("env.") and not word.startswith(LENGTH)]
        env = compose_config(TrainConfig, [f"env.horizon_s={config.horizon_s}", *said]).env
    return evaluated(dataclasses.replace(env, emit=()))
