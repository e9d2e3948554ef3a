"""What can be evaluated: scripted drivers, TorchRL modules, and callables, each with a name and a fingerprint."""

from __future__ import annotations

import copy
import functools
import importlib
import inspect
from dataclasses import dataclass
from typing import Any

import cloudpickle
from torch import nn

from izoo import zoo
from izoo.algos.scripted import DRIVERS, UncommandedDriver, make_driver
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError, unknown_choice
from izoo.evaluation.fingerprint import fingerprint
from izoo.evaluation.playing import Policy

HUMAN, UNCOMMANDED = "human", "uncommanded"
POLICY_FREE = (HUMAN, UNCOMMANDED)
"""Drivers that command nothing: their episodes can be cached."""


@dataclass(frozen=True)
class Candidate:
    """A policy to evaluate.

    Attributes:
        name: its name in tables.
        policy: TensorDict in, TensorDict with ``("agents", "action")`` out.
        fingerprint: differs where the policy does: class, weights, or source.
    """

    name: str
    policy: Policy
    fingerprint: str

    def pack(self) -> bytes:
        """Serialise for a worker process; modules travel on the CPU, and are to evaluate, not to train.

        Raises:
            IzooError: it holds something that cannot be sent.
        """
        policy = copy.deepcopy(self.policy).to("cpu").eval() if isinstance(self.policy, nn.Module) else self.policy
        try:
            return cloudpickle.dumps(policy)
        except Exception as error:
            raise IzooError(f"policy {self.name!r} cannot be sent to worker processes: {error}") from error


def as_candidate(policy: str | Policy, config: EnvConfig, name: str | None = None) -> Candidate:
    """Return the candidate that ``policy`` means: a driver's name, ``zoo:NAME``, the path of a file ``NAME.pt`` that
    ``python -m izoo.zoo export`` wrote, ``module:function``, or the policy itself.

    Raises:
        IzooError: no such driver, policy or function.
    """
    if isinstance(policy, str):
        shipped = zoo.named(policy)
        if shipped:
            trained = zoo.load(shipped)
            trained.check_observed(config)
            return as_candidate(trained.policy, config, name or trained.name)
        zoo.check_exported(policy)
        if ":" in policy:
            return as_candidate(import_policy(policy), config, name or policy.rpartition(":")[2])
        if policy not in DRIVERS:
            raise unknown_choice("policy", policy, [*DRIVERS, "zoo:NAME", "FILE.pt", "module:function"])
        return as_candidate(make_driver(policy, config), config, name or policy)
    if not callable(policy):
        raise IzooError(f"a {type(policy).__name__} is no policy; give a driver's name, a module or a callable.")
    name = name or "policy"
    if name in POLICY_FREE and not isinstance(policy, UncommandedDriver):
        raise IzooError(f"{name!r} is the name of a baseline; give the policy another name.")
    return Candidate(name, policy, fingerprint(policy))


def import_policy(reference: str) -> Policy:
    """Import ``module:function``; a class is called without arguments."""
    module_name, _, attribute = reference.partition(":")
    if not module_name or module_name.startswith(".") or not all(map(str.isidentifier, attribute.split("."))):
        raise IzooError(
            f"{reference!r} is no policy: it is written module:function, such as mine:drive for the function drive of "
            "mine.py, whose folder is on PYTHONPATH."
        )
    try:
        found: Any = functools.reduce(getattr, attribute.split("."), importlib.import_module(module_name))
    except (ImportError, AttributeError) as error:
        raise IzooError(f"cannot import the policy {reference!r}: {error}. It is written module:function.") from error
    policy: Any = found() if inspect.isclass(found) else found
    if not callable(policy):
        raise IzooError(f"the policy {reference!r} is a {type(policy).__name__}; name a function, a module or a class.")
    return policy
