"""What can be evaluated: scripted drivers, TorchRL modules, and callables, each with a name and a record."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import inspect
from typing import Any, NamedTuple

import cloudpickle
import torch
from torch import Tensor, nn

from izoo import zoo
from izoo.algos.drivers.by_name import DRIVERS, make_driver
from izoo.algos.drivers.uncommanded import UncommandedDriver
from izoo.algos.learners.registry import cap_share
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError, unknown_choice
from izoo.imports import imported
from izoo.metrics.pairing import BASELINES
from izoo.results.playing import Policy
from izoo.results.store import PolicyRecord, own_settings
from izoo.zoo import catalog


class NamedPolicy(NamedTuple):
    """A policy, its name in tables, what a manifest says of it, and the training seed and environment it is of."""

    name: str
    policy: Policy
    record: PolicyRecord
    train_seed: int = 0
    trained: EnvConfig | None = None


def as_policy(policy: str | Policy, config: EnvConfig, name: str | None = None) -> NamedPolicy:
    """Return the policy that ``policy`` means, ready to act.

    Args:
        policy: a driver's name, ``zoo:NAME``, the path of a file ``NAME.pt`` that ``python -m izoo.zoo export`` wrote,
            ``module:function``, or the policy itself (:func:`izoo.training.run_folder.any_policy`: or a run).
        config: the environment in which it is to act.
        name: in tables; ``None``: its own.

    Raises:
        IzooError: there is no such policy, or it was trained on other observations or decisions.
    """
    own = own_settings(config)
    if not isinstance(policy, str):
        if not callable(policy):
            raise IzooError(f"a {type(policy).__name__} is not a policy; give a driver's name, a module or a callable.")
        name = name or "policy"
        if name in BASELINES and not isinstance(policy, UncommandedDriver):
            raise IzooError(f"{name!r} is the name of a baseline; give the policy another name.")
        weights = weights_hash(policy)
        return NamedPolicy(name, policy, PolicyRecord("trained" if weights else "scripted", weights, env=own))
    if policy in DRIVERS or cap_share(policy) is not None:
        record = PolicyRecord(source=policy, env=None if policy in BASELINES else own)
        return NamedPolicy(name or policy, make_driver(policy, config), record)
    if shipped := zoo.named(policy):
        trained = zoo.load(shipped)
        zoo.check_fits(f"the policy {trained.name}", trained.env, config)
        named = as_policy(trained.policy, config, name or trained.name)
        source = catalog.absolute(policy)
        record = dataclasses.replace(named.record, source=source, algo=trained.algo.name)
        return named._replace(record=record, trained=trained.env)
    if ":" not in policy:
        raise unknown_choice("policy", policy, [*DRIVERS, "cap_SHARE", "zoo:NAME", "FILE.pt", "module:function"])
    named = as_policy(import_policy(policy), config, name or policy.rpartition(":")[2])
    return named._replace(record=dataclasses.replace(named.record, source=policy))


def import_policy(reference: str) -> Policy:
    """Import ``module:function``; a class is called without arguments."""
    found: Any = imported("policy", reference)
    policy: Any = found() if inspect.isclass(found) else found
    if not callable(policy):
        raise IzooError(f"the policy {reference!r} is a {type(policy).__name__}; name a function, a module or a class.")
    return policy


def weights_hash(policy: Any) -> str | None:
    """Return the SHA-256 of a module's state: names, types, shapes and bytes; ``None`` where it has none."""
    tensors = policy.state_dict() if isinstance(policy, nn.Module) else {}
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        if isinstance(value, Tensor):
            digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
            # As bytes, since NumPy has no bfloat16.
            digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest() if tensors else None


def pack(name: str, policy: Policy) -> bytes:
    """Serialise a policy for workers; modules travel on the CPU, and are to evaluate, not to train.

    Raises:
        IzooError: it holds something that cannot be sent.
    """
    policy = copy.deepcopy(policy).to("cpu").eval() if isinstance(policy, nn.Module) else policy
    try:
        return cloudpickle.dumps(policy)
    except Exception as error:
        raise IzooError(f"policy {name!r} cannot be sent to worker processes: {error}") from error
