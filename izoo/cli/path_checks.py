"""Paths on the command line that cannot be used are refused here, before anything slow is imported."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from izoo.algos.learners.registry import DRIVER_NAMES
from izoo.conf.quoting import written
from izoo.errors import IzooError, unknown_choice
from izoo.files import check_folder, expanded, read_text
from izoo.training import checkpoint
from izoo.zoo import catalog

if TYPE_CHECKING:
    from izoo.conf.evaluate_options import EvaluateConfig
    from izoo.conf.report_options import ReportConfig
    from izoo.conf.train_options import CollectConfig, TrainConfig

MANIFESTS = ("manifest.json", "evaluation.json")
"""As :data:`izoo.results.store.MANIFEST_FILE`, which is slow to import; the second one is of an earlier version."""
RESULTS = "give one that izoo.evaluate, izoo.train or a benchmark has written"


def check_train(config: TrainConfig) -> None:
    """Refuse a folder to resume that is not a run, or contexts in a folder that is not there."""
    if config.resume is not None:
        _check_run(Path(config.resume))
    else:
        _check_contexts(config.contexts)


def check_evaluate(config: EvaluateConfig) -> None:
    """Refuse a run without the checkpoint, a file that is no policy, a module that is not installed, contexts in a
    missing folder, or an occupied folder for the results.
    """
    if config.out is not None:
        _check_results(Path(config.out))
    if config.run is None and config.checkpoint != "last":
        raise IzooError(
            f"checkpoint={config.checkpoint} chooses among those of a run's folder, but run is not given; give "
            "run=RUN_DIR, or leave checkpoint out."
        )
    if config.run is not None:
        checkpoint.find(Path(config.run), config.checkpoint)
    elif config.policy is not None and not catalog.named(config.policy):
        catalog.check_exported(config.policy)
        if ":" in config.policy:
            _check_module(config.policy)
    _check_contexts(config.contexts)


def contexts_of_run(words: Sequence[str]) -> list[str]:
    """Return the contexts of the run that shall be evaluated as words, where some of their options are written anew.

    A run that cannot be read is refused later.
    """
    said = {name: value for name, _, value in (word.partition("=") for word in words)}
    if "run" not in said or "contexts" in said or not any(name.startswith("contexts.") for name in said):
        return []
    try:
        folder = checkpoint.run_of(checkpoint.find(expanded(said["run"].strip("'\"")), said.get("checkpoint", "last")))
        contexts = dict(yaml.safe_load(read_text(folder / "config.yaml"))["contexts"])
        name = contexts.pop("name")
    except (IzooError, OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        return []
    options = {f"contexts.{key}": value for key, value in contexts.items() if value is not None}
    return [f"contexts={name}", *(f"{key}={written(value)}" for key, value in options.items() if key not in said)]


def check_collect(config: CollectConfig) -> None:
    """Refuse a missing ``out``, a policy that nobody knows, or contexts in a missing folder."""
    if config.out is None:
        raise IzooError("out is missing; name a new folder for the data: out=DIR.")
    # Human driving is a matter of the contexts (contexts.adoption=0), not of a policy.
    drivers = [name for name in DRIVER_NAMES if name != "human"]
    known = catalog.named(config.policy) or config.policy in drivers or ":" in config.policy
    if not known and not expanded(config.policy).exists():
        error = unknown_choice("policy", config.policy, [*drivers, "zoo:NAME", "FILE.pt", "module:function"])
        raise IzooError(f"{error} Or name the folder of a training run; there is none at that path.")
    _check_contexts(config.contexts)


def check_report(config: ReportConfig) -> None:
    """Refuse results that are not a folder."""
    check_folder(expanded(str(config.results)), RESULTS)


def _check_contexts(contexts: Any) -> None:
    """Let contexts that lie in a folder check it; others have nothing to check."""
    check = getattr(contexts, "check", None)
    if check is not None:
        check()


def _check_run(folder: Path) -> None:
    if not folder.exists():
        raise IzooError(f"{folder} does not exist; give the folder of a training run.")


def _check_results(folder: Path) -> None:
    """Refuse a folder that holds other things than an evaluation, beside which its files would be hard to tell."""
    if folder.is_dir() and any(folder.iterdir()) and not any((folder / name).is_file() for name in MANIFESTS):
        raise IzooError(
            f"out={folder} holds other things than an evaluation; choose a new folder, or one that izoo.evaluate wrote."
        )


def _check_module(policy: str) -> None:
    """Refuse a policy of a package that is not there; what lies inside it is imported later."""
    package = policy.partition(":")[0].partition(".")[0]
    if package.isidentifier() and importlib.util.find_spec(package) is None:
        raise IzooError(
            f"policy={policy}: there is no module {package!r} here; install it, or add its folder to PYTHONPATH."
        )
