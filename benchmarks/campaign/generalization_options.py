"""Options of ``python -m izoo.benchmarks.generalization``, and what its scales stand for."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from izoo.algos.learners.registry import DRIVER_NAMES, cap_share, choices
from izoo.conf.recipes import recipe_words
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError, check_range, check_types, unknown_choice
from izoo.files import expanded
from izoo.zoo import catalog

T = TypeVar("T", bound="GeneralizationConfig")
RECIPE_PREFIX = "recipe:"
SWEPT = ("eta", "alpha", "beta", "comfort", "realism", "safety")
"""Weights of the reward that a trade-off sweeps over (:class:`izoo.envs.config.RewardConfig`)."""
RESIDUAL_SUFFIX, UNTRAINED_SUFFIX, FLOOR_INFIX = "_residual", "_untrained", "glide_floor"
NOT_OF_AN_ENTRY = ("contexts", "evaluation", "validation")
"""Groups of options that a recipe's entry leaves out: the benchmark sets them."""
BASELINES = ("human", "uncommanded")
"""Entries that all others are compared with."""
REFERENCES = ("constant_2.0", "cap_0.6")
"""Entries that stand beside whatever is trained, as does every algorithm before its first update: so that nobody takes
vehicle parameters, slow driving or an initialisation for what was learned."""
SET_BY = {
    **{"algo": "algos", "action": "algos", "seed": "seeds", "total_frames": "frames or episodes"},
    **{"contexts": "protocol, train and form", "num_workers": "train_workers", "run_dir": "out", "resume": "out"},
    **{"simulator": "simulator or train_simulator", "num_envs": "num_envs"},
    "env.horizon_s": "horizon_s or train_horizon_s",
}
"""Options of ``izoo.train`` that the benchmark sets itself, and by which of its own."""


@dataclass(frozen=True)
class Scale:
    """What a scale sets where an option is null.

    Attributes:
        seeds: training seeds per algorithm.
        episodes: training episodes per run.
        horizon_s: length of an episode.
        eval_seeds: paired episodes per test context.
        test_limit: test contexts; ``None``: all.
        train_contexts: training contexts that are played too.
        train_workers: environments that a run trains on.
        num_workers: processes that evaluate; 0: this one, which spares short evaluations the start of others.
    """

    seeds: int
    episodes: int
    horizon_s: float
    eval_seeds: int
    test_limit: int | None
    train_contexts: int
    train_workers: int
    num_workers: int


SCALES = {
    "smoke": Scale(2, 11, 200.0, eval_seeds=3, test_limit=4, train_contexts=2, train_workers=1, num_workers=0),
    "small": Scale(4, 100, 1000.0, eval_seeds=3, test_limit=32, train_contexts=32, train_workers=2, num_workers=2),
    "paper": Scale(4, 5000, 1000.0, eval_seeds=3, test_limit=None, train_contexts=32, train_workers=10, num_workers=10),
}
"""``smoke``: minutes on two cores, shows that everything works and nothing else. ``small``: hours. ``paper``: the
published scale (5,000 episodes, 4 seeds, every test context)."""


@dataclass(frozen=True)
class Entry:
    """What is compared: a trained algorithm, or a policy that needs no training.

    Attributes:
        name: in tables and folders.
        kind: ``trained``, ``untrained`` (as training begins) or ``scripted``.
        algo: preset of the algorithm (a choice of ``algo=``), or ``None``.
        action: ``direct``, ``advise`` or ``residual``, or ``None``.
        policy: the scripted driver's name, ``zoo:NAME``, ``FILE.pt`` or ``module:function``, or ``None``.
        floor_mps: of glide, the speed below which it never advises to drive; ``None``: its default.
        options: more options of ``izoo.train`` for this entry alone.
    """

    name: str
    kind: Literal["trained", "untrained", "scripted"]
    algo: str | None = None
    action: str | None = None
    policy: str | None = None
    floor_mps: float | None = None
    options: tuple[str, ...] = ()

    @property
    def seeded(self) -> bool:
        """Whether every training seed is a policy of its own."""
        return self.kind != "scripted"


@dataclass(frozen=True)
class GeneralizationConfig:
    """Options of the generalization benchmark.

    Attributes:
        protocol: ``in_distribution``: train and test in one city; ``productivity``: train in one city, test zero-shot
            in another; ``systematicity``: train on wide procedural ranges, test inside a box they exclude.
        scale: ``smoke`` (minutes), ``small`` (hours) or ``paper`` (the published scale); sets what is null below.
        algos: what is compared: presets of ``algo`` (``ppo``, ``ddpg``, ``mappo``, ``gcrl``, ``ppo_paper``, ...), with
            ``_residual`` appended for ``action=residual``; scripted drivers (``glide``, ``uncommanded``, ...;
            ``glide_floor3`` is glide that never slows below 3 m/s); ``recipe:NAME``, a recipe of ``izoo.train`` with
            its own length and environment, on the contexts of the protocol; ``zoo:NAME``, a policy that ships, and
            ``FILE.pt``, one that ``python -m izoo.zoo export`` wrote, as they are and in their environments; or
            ``module:function``. Human driving and ``uncommanded`` are always played; beside trained entries also
            ``constant_2.0``, ``cap_0.6`` and every algorithm as it begins (``ppo_untrained``).
        train: where to train: one of the ten built-in cities, or a folder of the published dataset; null:
            ``salt_lake_city``. Not for systematicity.
        test: where to test, for productivity; null: ``atlanta``.
        form: ``split``: train, validation and test share out the intersections 80/10/10; ``paper``: train and test on
            all.
        weather: ``published`` or ``county``; null: published where the city has it.
        test_set: of systematicity: ``grid``, the 128 published contexts, or ``sample``, 128 drawn ones.
        seeds: training seeds per algorithm, 0 to ``seeds - 1``; null: the scale's.
        untrained_seeds: of how many of these the algorithm before its first update is tested as well; null: all.
        episodes: training episodes per run; null: the scale's.
        frames: decisions per run, instead of ``episodes``.
        horizon_s: length of an episode, in training and in evaluation; null: the scale's.
        train_horizon_s: length of a training episode, where it differs from ``horizon_s``: shorter ones show more
            contexts in the same number of frames.
        train_warmup_s: warm-up of a training episode, where it differs from the evaluation's: short episodes would
            otherwise show little but roads that are still filling.
        eval_seeds: paired episodes per test context; null: the scale's.
        test_limit: most test contexts, drawn reproducibly; null: the scale's; 0: all.
        train_contexts: contexts of the training, drawn reproducibly, that every entry plays too; how much more it saves
            there is the generalisation gap. 0: none; null: the scale's, and none where nothing is trained, or
            where it is tested on what it was trained on (``form=paper``).
        human_vehicles: also test every entry on CVs whose vehicle parameters are those of human-driven ones, where all
            that differs from human driving is due to commands; takes as long again.
        select: which weights of a run are tested: ``last``, or ``best`` on the validation split, which is measured
            beside training and takes time; the last where a run was too short to be validated.
        simulator: what plays the episodes of tests and validations, and of training: ``sumo``, which is what counts, or
            ``twin``, its compiled copy.
        train_simulator: what plays training episodes, where it differs from ``simulator``: ``twin`` trains faster. A
            recipe trains where it says itself.
        train_options: more options of ``izoo.train`` for every trained entry, such as
            ``["algo.gamma=0.98","env.reward.eta=0.5"]``.
        train_workers: environments that a run trains on in SUMO, each in a process of its own; 1 trains in this
            process; null: the scale's.
        num_envs: environments that a run trains on in the twin, all in this process; null: as ``izoo.train`` has it. A
            recipe brings its own number.
        num_workers: processes that evaluate, each with one simulator; 0: this one; null: the scale's.
        runs_at_once: training runs that learn at the same time, each in a process of its own, on its share of the
            cores.
        trained_in: another results folder, whose finished training runs are taken over instead of trained again: those
            of a benchmark of the same versions and training options, such as ``in_distribution`` before
            ``productivity``.
        out: the results folder; an interrupted benchmark goes on there. null: a folder named after protocol and scale
            in ``results`` of the current folder.
        cache: folder of the cached episodes of human and uncommanded driving; null: the user's cache folder.
        verbose: print all figures of every entry, and the differences between entries.
    """

    protocol: Literal["in_distribution", "productivity", "systematicity"] = "in_distribution"
    scale: Literal["smoke", "small", "paper"] = "smoke"
    algos: tuple[str, ...] = ("ppo", "ddpg", "mappo", "gcrl", "glide", "uncommanded")
    train: str | None = None
    test: str | None = None
    form: Literal["split", "paper"] = "split"
    weather: Literal["published", "county"] | None = None
    test_set: Literal["grid", "sample"] = "grid"
    seeds: int | None = None
    untrained_seeds: int | None = None
    episodes: int | None = None
    frames: int | None = None
    horizon_s: float | None = None
    train_horizon_s: float | None = None
    train_warmup_s: float | None = None
    eval_seeds: int | None = None
    test_limit: int | None = None
    train_contexts: int | None = None
    human_vehicles: bool = False
    select: Literal["last", "best"] = "last"
    simulator: Literal["sumo", "twin"] = "sumo"
    train_simulator: Literal["sumo", "twin"] | None = None
    train_options: tuple[str, ...] = ()
    train_workers: int | None = None
    num_envs: int | None = None
    num_workers: int | None = None
    runs_at_once: int = 1
    trained_in: str | None = None
    out: str | None = None
    cache: str | None = None
    verbose: bool = False

    def __post_init__(self) -> None:
        check_types("", self)
        ranges: dict[str, tuple[float, float]] = {
            "seeds": (1, 1000),
            "untrained_seeds": (1, 1000),
            "episodes": (1, 10**8),
            "frames": (1, 10**12),
            "horizon_s": (30, 86400),
            "train_horizon_s": (30, 86400),
            "train_warmup_s": (0, 86400),
            "eval_seeds": (1, 10**6),
            "test_limit": (0, 10**7),
            "train_contexts": (0, 10**7),
            "train_workers": (1, 1024),
            "num_envs": (1, 65536),
            "num_workers": (0, 1024),
            "runs_at_once": (1, 1024),
        }
        for name, (low, high) in ranges.items():
            if getattr(self, name) is not None:
                check_range(name, getattr(self, name), low, high)
        if self.frames is not None and self.episodes is not None:
            raise IzooError("episodes and frames are both given; give one of them.")
        self._check_places()
        self._check_train_options()
        if self.num_envs is not None and self.trains_in == "sumo":
            raise IzooError(
                f"num_envs is {self.num_envs}, but runs train in SUMO, where every environment is a process: set "
                "train_workers, or train_simulator=twin."
            )
        object.__setattr__(self, "algos", tuple(map(catalog.absolute, self.algos)))
        names = [parse_entry(name).name for name in self.algos]
        if not names or len(names) > len(set(names)):
            raise IzooError(
                f"algos is {list(self.algos)}; give one or more names, each once (of module:function, function counts)."
            )
        for name in ("train", "test", "trained_in", "out", "cache"):
            value = getattr(self, name)
            if value is not None and (name not in ("train", "test") or is_folder(value)):
                object.__setattr__(self, name, str(expanded(value).absolute()))

    def _check_train_options(self) -> None:
        for word in self.train_options:
            name = word.lstrip("+~").partition("=")[0].partition("@")[0]
            found = name if name in SET_BY else "contexts" if name.startswith("contexts.") else None
            if found is not None:
                raise IzooError(f"train_options holds {word!r}, which the benchmark sets itself: by {SET_BY[found]}.")

    def _check_places(self) -> None:
        if self.protocol == "systematicity":
            if self.train or self.test or self.weather or self.form != "split":
                words = "leave train, test, weather and form out"
                raise IzooError(f"protocol=systematicity has procedural contexts of its own; {words}.")
        elif self.test_set != "grid":
            raise IzooError(f"test_set={self.test_set} is of protocol=systematicity; leave it out.")
        if self.protocol == "in_distribution" and self.test is not None:
            raise IzooError("protocol=in_distribution tests where it trains; leave test out or take productivity.")

    def resolved(self: T) -> T:
        """Return the options with the scale's values for what is null; ``test_limit`` 0 stands for all."""
        scale = SCALES[self.scale]
        changes: dict[str, Any] = {
            field.name: getattr(scale, field.name)
            for field in dataclasses.fields(scale)
            if field.name != "episodes" and getattr(self, field.name) is None
        }
        if self.frames is None and self.episodes is None:
            changes["episodes"] = scale.episodes
        changes["test_limit"] = changes.get("test_limit", self.test_limit) or 0
        if self.protocol != "systematicity":
            changes["train"] = self.train or "salt_lake_city"
        if self.protocol == "productivity":
            changes["test"] = self.test or "atlanta"
        return dataclasses.replace(self, **changes)

    @property
    def trains_in(self) -> Literal["sumo", "twin"]:
        """What plays training episodes, but for entries that bring their own simulator."""
        return self.train_simulator or self.simulator

    def seeds_of(self, entry: Entry) -> range:
        """Return the training seeds of an entry, one for what needs none; of resolved options."""
        if not entry.seeded:
            return range(1)
        seeds = self.seeds or 0
        least = entry.kind == "untrained" and self.untrained_seeds is not None
        return range(min(seeds, self.untrained_seeds or 0) if least else seeds)

    def train_episode(self) -> EnvConfig:
        """Return an environment with the length and warm-up of a training episode; of resolved options."""
        env = EnvConfig(horizon_s=self.train_horizon_s or self.horizon_s or 0.0)
        return env if self.train_warmup_s is None else dataclasses.replace(env, warmup_s=self.train_warmup_s)

    def entries(self) -> list[Entry]:
        """Return the baselines, what :attr:`algos` names and what stands beside it, trained policies last."""
        named = [parse_entry(name) for name in self.algos]
        untrained = [f"{name}{UNTRAINED_SUFFIX}" for name in self.algos if parse_entry(name).kind == "trained"]
        beside = map(parse_entry, [*REFERENCES, *untrained] if untrained else [])
        found = {name: Entry(name, "scripted", policy=name) for name in BASELINES}
        found |= {entry.name: entry for entry in [*named, *beside] if entry.name not in found}
        return sorted(found.values(), key=lambda entry: entry.kind == "trained")


def is_folder(place: str) -> bool:
    """Whether a place is a folder of intersections rather than the name of a city."""
    return "/" in place or expanded(place).is_dir()


def parse_entry(name: str) -> Entry:
    """Return the entry that a name means.

    Raises:
        IzooError: neither an algorithm nor a driver.
    """
    if name.startswith(RECIPE_PREFIX):
        return _recipe_entry(name.removeprefix(RECIPE_PREFIX))
    shipped = catalog.named(name)
    if shipped is not None:
        return _policy_entry(Path(shipped).name.removesuffix(catalog.WEIGHTS), name)
    catalog.check_exported(name)
    if ":" in name:
        return _policy_entry(name.rpartition(":")[2], name)
    if (name in DRIVER_NAMES and name != "human") or cap_share(name) is not None:
        return Entry(name, "scripted", policy=name)
    if name.startswith(FLOOR_INFIX):
        return Entry(name, "scripted", policy="glide", floor_mps=_floor(name))
    if name.endswith(UNTRAINED_SUFFIX):
        return dataclasses.replace(parse_entry(name.removesuffix(UNTRAINED_SUFFIX)), name=name, kind="untrained")
    presets = choices()
    action = "residual" if name.endswith(RESIDUAL_SUFFIX) else "direct"
    preset = name.removesuffix(RESIDUAL_SUFFIX)
    if preset not in presets:
        drivers = [driver for driver in DRIVER_NAMES if driver != "human"]
        residual = [f"{preset}{RESIDUAL_SUFFIX}" for preset in presets]
        others = [
            "cap_SHARE",
            f"{FLOOR_INFIX}NUMBER",
            f"{catalog.PREFIX}NAME",
            f"FILE{catalog.WEIGHTS}",
            "module:function",
        ]
        raise unknown_choice("entry of algos", name, [*presets, *residual, *drivers, *others])
    return Entry(name, "trained", algo=preset, action=action)


def _policy_entry(called: str, policy: str) -> Entry:
    """Return the entry of somebody's policy, which must not be taken for one of the entries that stand beside it."""
    if called in (*BASELINES, *REFERENCES) or called.endswith(UNTRAINED_SUFFIX):
        raise IzooError(f"{policy} would be called {called!r}, as what the benchmark puts beside it is; rename it.")
    return Entry(called, "scripted", policy=policy)


def _recipe_entry(name: str) -> Entry:
    """Return the entry that trains as a recipe says, but for its contexts."""
    untrained = name.endswith(UNTRAINED_SUFFIX)
    words = recipe_words(name.removesuffix(UNTRAINED_SUFFIX))
    said = dict(word.split("=", 1) for word in words)
    own = (word for word in words if word.partition("=")[0].partition(".")[0] not in NOT_OF_AN_ENTRY)
    options = tuple(word for word in own if word.partition("=")[0] not in ("algo", "action"))
    kind: Literal["trained", "untrained"] = "untrained" if untrained else "trained"
    return Entry(name, kind, algo=said["algo"], action=said.get("action", "direct"), options=options)


def _floor(name: str) -> float:
    text = name.removeprefix(FLOOR_INFIX)
    try:
        floor_mps = float(text)
    except ValueError:
        raise IzooError(f"{name!r} is no entry; write glide with a floor of 3 m/s as {FLOOR_INFIX}3.") from None
    check_range(f"the floor of {name}", floor_mps, 0.1, 60.0, "m/s")
    return floor_mps
