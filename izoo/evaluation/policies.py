"""What can be evaluated: scripted drivers, TorchRL modules, and callables, each with a name and a fingerprint."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import hashlib
import importlib
import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cloudpickle
from torch import nn

from izoo import zoo
from izoo.algos.scripted import DRIVERS, UncommandedDriver, make_driver
from izoo.envs.config import EnvConfig
from izoo.errors import IzooError, unknown_choice
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
        """Serialise for a worker process; modules travel on the CPU.

        Raises:
            IzooError: it holds something that cannot be sent.
        """
        policy = copy.deepcopy(self.policy).to("cpu") if isinstance(self.policy, nn.Module) else self.policy
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
    try:
        found: Any = functools.reduce(getattr, attribute.split("."), importlib.import_module(module_name))
    except (ImportError, AttributeError) as error:
        raise IzooError(f"cannot import the policy {reference!r}: {error}. It is written module:function.") from error
    policy: Any = found() if inspect.isclass(found) else found
    return policy


_LIBRARIES = ("torch", "torchrl", "tensordict")


def fingerprint(policy: Policy) -> str:
    """Return a digest that changes with a module's code, settings and weights, or a callable's source and state."""
    digest = hashlib.sha256()
    if isinstance(policy, nn.Module):
        digest.update(_without_addresses(repr(policy)))
        for name, module in policy.named_modules():
            if type(module).__module__.partition(".")[0] not in _LIBRARIES:
                digest.update(_without_addresses(f"{name} {_plain_attributes(module)}"))
                with contextlib.suppress(OSError, TypeError):
                    digest.update(inspect.getsource(type(module)).encode())
            elif inspect.isfunction(wrapped := vars(module).get("module")):  # of a TensorDictModule
                digest.update(f"{name} {fingerprint(wrapped)}".encode())
        for key, tensor in sorted(policy.state_dict().items()):
            if hasattr(tensor, "detach"):
                digest.update(key.encode())
                digest.update(tensor.detach().cpu().contiguous().flatten().double().numpy().tobytes())
        return digest.hexdigest()[:16]
    digest.update(_source(policy))
    if isinstance(policy, functools.partial):
        state: Any = [policy.func, policy.args, policy.keywords]
    elif inspect.isfunction(policy):
        cells = [cell.cell_contents for cell in policy.__closure__ or ()]
        state = [cells, policy.__defaults__, policy.__kwdefaults__]
    else:
        state = getattr(policy, "__dict__", None)
    digest.update(_stated(state).encode())
    return digest.hexdigest()[:16]


def _source(policy: Policy) -> bytes:
    """Return name and source of a callable, or of its type."""
    target: Any = policy if inspect.isroutine(policy) else type(policy)
    name = f"{target.__module__}:{target.__qualname__}".encode()
    try:
        return name + inspect.getsource(target).encode()
    except (OSError, TypeError):
        return name + _without_addresses(repr(policy))


def _stated(value: Any) -> str:
    """Return what a callable holds as text, the same in every process; functions are named by their source."""
    if isinstance(value, Mapping):
        return str(sorted((str(name), _stated(held)) for name, held in value.items()))
    if isinstance(value, (list, tuple)):
        return str([_stated(held) for held in value])
    if isinstance(value, (set, frozenset)):
        return str(sorted(map(_stated, value)))
    if isinstance(value, nn.Module):
        return fingerprint(value)
    text = _source(value) if inspect.isfunction(value) else _without_addresses(repr(value))
    return text.decode()


def _plain_attributes(module: nn.Module) -> list[tuple[str, Any]]:
    """Return the settings of a module: attributes that are numbers, texts, collections of them, or dataclasses."""
    values = {name: value for name, value in vars(module).items() if name != "training"}
    kinds = (bool, int, float, str, tuple, list, dict)
    return sorted((n, repr(v)) for n, v in values.items() if isinstance(v, kinds) or dataclasses.is_dataclass(v))


def _without_addresses(text: str) -> bytes:
    return re.sub(r"0x[0-9a-f]+", "", text).encode()
