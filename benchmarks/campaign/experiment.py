"""Experiments: what a campaign trains and plays, as data. ``experiments/*.yaml`` hold those that ship."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import yaml

from izoo.conf.evaluate_options import check_policy
from izoo.envs import SIMULATORS
from izoo.errors import IzooError, check_choice, unknown_choice
from izoo.files import expanded, read_text
from izoo.options import CheckedOptions, from_mapping
from izoo.report.plots import UNTRAINED
from izoo.zoo import catalog

SHIPPED = resources.files("izoo.benchmarks.campaign") / "experiments"
FASTEST = next(name for name, simulator in SIMULATORS.items() if simulator.batched)
"""What plays the tests where a part does not say so."""
Kind = Literal["trained", "untrained", "scripted", "planner"]


@dataclass(frozen=True)
class Entry(CheckedOptions):
    """What is compared: an algorithm that is trained, or a policy that is there.

    Attributes:
        like: the entry whose options of training come before its own; of the same option the last counts.
        train: options of ``izoo.train``; the task says all others. An entry that has some is trained.
        start: the entry whose run of the same training seed each run begins with (``start=`` of ``izoo.train``).
        policy: without training: a driver's name, ``zoo:NAME``, ``FILE.pt`` or ``module:function``.
        glide: of ``policy: glide``, settings that differ (:class:`izoo.algos.drivers.glide.GlideConfig`).
        planner: the planner's settings (:class:`izoo.benchmarks.planner.PlannerConfig`), which drives on the twin.
        select: which weights of a run are tested: the ``last``, or the ``best`` on the validation split.
        contexts: no more test contexts than these; ``None``: those of the part.
        seeds: training seeds; ``None``: those of the part.
    """

    like: str | None = None
    train: tuple[str, ...] = ()
    start: str | None = None
    policy: str | None = None
    glide: Any = field(default_factory=dict)
    planner: Any = None
    select: Literal["last", "best"] = "last"
    contexts: int | None = None
    seeds: int | None = None


@dataclass(frozen=True)
class Part(CheckedOptions):
    """A task, and the entries that are compared on it.

    Attributes:
        task: its name (:mod:`izoo.tasks`).
        entries: their names, in the order of training; ``NAME_untrained`` is one as its training begins.
        grid: factors of further entries, one for every combination, such as ``{eta: {a: [...], b: [...]}}``: options
            of ``izoo.train`` by the factor's name and the value's, of which the entry's name consists.
        train: options of ``izoo.train`` for everything that is trained.
        reference: the entry that all others are compared with; ``None``: all are compared pairwise.
        seeds: training seeds.
        contexts: no more test contexts than these; ``None``: those of the task.
        training_contexts: contexts of the training that every entry plays too, for the generalisation gap; 0: none.
            Of two simulators the twin plays them.
        simulators: what plays the tests.
        sumo_seeds: how many of the training seeds SUMO plays; ``None``: all.
        trained_in: the part whose runs are tested here; nothing is trained then.
        adoption, cv_vehicle: conditions of the tests that differ from the task's.
        tradeoff: draw CO2 against delay, and say which entries are on the Pareto front.
    """

    task: str
    entries: tuple[str, ...] = ()
    grid: Any = field(default_factory=dict)
    train: tuple[str, ...] = ()
    reference: str | None = None
    seeds: int = 4
    contexts: int | None = None
    training_contexts: int = 0
    simulators: tuple[str, ...] = (FASTEST,)
    sumo_seeds: int | None = None
    trained_in: str | None = None
    adoption: float | None = None
    cv_vehicle: str | None = None
    tradeoff: bool = False

    ranges = (("seeds", 1, 1000),)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.simulators:
            check_choice("simulators", name, SIMULATORS)


@dataclass(frozen=True)
class Experiment:
    """What a campaign does: parts, in order, and entries by name."""

    entries: Mapping[str, Entry]
    parts: Mapping[str, Part]

    def entries_of(self, name: str) -> dict[str, tuple[Kind, Entry]]:
        """Return the entries of a part, with what they are.

        Raises:
            IzooError: the part names an entry that there is not.
        """
        part, found, known = self.parts[name], {}, self.known(name)
        for entry in dict.fromkeys([*part.entries, *_combined(part)]):
            base = entry.removesuffix(UNTRAINED)
            if base not in known:
                raise unknown_choice(f"parts.{name}.entries", entry, known)
            kind: Kind = "planner" if known[base].planner is not None else "scripted"
            if known[base].policy is None and kind == "scripted":
                kind = "untrained" if base != entry else "trained"
            found[entry] = (kind, known[base])
        return found

    def known(self, name: str) -> dict[str, Entry]:
        """Return the entries that a part may name: those of the experiment, and of its own grid."""
        trainer = self.parts[name].trained_in or name
        if trainer not in self.parts:
            raise unknown_choice(f"parts.{name}.trained_in", trainer, self.parts)
        return {**self.entries, **_combined(self.parts[trainer])}


def _combined(part: Part) -> dict[str, Entry]:
    """Return the entries of a part's grid."""
    found = {}
    for values in itertools.product(*part.grid.values()) if part.grid else ():
        words = [word for factor, value in zip(part.grid, values, strict=True) for word in part.grid[factor][value]]
        found["-".join(map(str, values))] = Entry(train=tuple(words))
    return found


def shipped() -> list[str]:
    """Return the names of the experiments that ship."""
    return sorted(path.name.removesuffix(".yaml") for path in SHIPPED.iterdir() if path.name.endswith(".yaml"))


def read_experiment(name: str) -> Experiment:
    """Return an experiment that ships, or that of a file.

    Raises:
        IzooError: there is none, or it holds something that an experiment does not have.
    """
    path = SHIPPED / f"{name}.yaml" if name in shipped() else expanded(name)
    if name not in shipped() and not Path(str(path)).is_file():
        raise IzooError(f"{unknown_choice('experiment', name, shipped())} Or name a YAML file.")
    try:
        values = yaml.safe_load(read_text(Path(str(path))))
        parts = {key: from_mapping(Part, value, f"parts.{key}") for key, value in values["parts"].items()}
        entries = {
            key: from_mapping(Entry, value or {}, f"entries.{key}") for key, value in values.get("entries", {}).items()
        }
    except IzooError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise IzooError(f"experiment {path} cannot be read: {error!r}.") from error
    for key, entry in entries.items():
        if entry.policy is not None:
            check_policy(f"entries.{key}.policy", entry.policy)
            entries[key] = dataclasses.replace(entry, policy=catalog.absolute(entry.policy))
        if entry.like is not None:
            if entry.like not in entries:
                raise unknown_choice(f"entries.{key}.like", entry.like, entries)
            entries[key] = dataclasses.replace(entry, train=(*entries[entry.like].train, *entry.train))
    experiment = Experiment(entries, parts)
    for part in parts:
        experiment.entries_of(part)
    return experiment
