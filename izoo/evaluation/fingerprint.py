"""What tells one policy from another: a digest of its code, its settings and its weights, the same in every process."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import random
import re
import types
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

_LIBRARIES = ("torch", "torchrl", "tensordict", "numpy", "builtins")
_OF_EVERY_MODULE = frozenset(vars(nn.Module()))
"""Attributes that PyTorch keeps itself: weights are taken from the state, wherever they lie."""
_PLAIN = (bool, int, float, str, bytes, tuple, list, dict, set, frozenset, np.ndarray, types.NoneType)


def fingerprint(policy: Any) -> str:
    """Return a digest that differs where two policies do.

    It takes in: of a module its code, its plain settings (numbers, texts, dataclasses and collections of these) and its
    weights; of any other callable its code, and what it holds: closure, defaults, bound object, attributes. What cannot
    be looked into counts by its ``repr``. A callable whose attributes change by playing is another one afterwards.
    """
    digest = hashlib.sha256()
    _Walk(digest).take(policy)
    return digest.hexdigest()[:16]


class _Walk:
    """Writes values into a digest; one that holds itself counts by its depth.

    Args:
        digest: a hash.
    """

    def __init__(self, digest: Any) -> None:
        self.digest = digest
        self._above: list[int] = []

    def take(self, value: Any) -> None:
        """Write a value."""
        if isinstance(value, (bool, int, float, complex, str, bytes, type(None))):
            self.say(repr(value))
            return
        if id(value) in self._above:
            self.say(f"above {self._above.index(id(value))}")
            return
        self._above.append(id(value))
        self.say(type(value).__qualname__)
        if isinstance(value, (Tensor, np.ndarray, np.generic)):
            self._numbers(value)
        elif isinstance(value, nn.Module):
            self._module(value)
        else:
            for part in self._parts(value):
                self.take(part)
        self._above.pop()

    def say(self, text: str) -> None:
        """Write a text, and where it ends."""
        self.digest.update(text.encode() + b"\0")

    def _parts(self, value: Any) -> list[Any]:
        """Return what a value is made of."""
        if isinstance(value, Mapping):
            return [part for name in sorted(value, key=repr) for part in (name, value[name])]
        if isinstance(value, (set, frozenset)):
            return sorted(map(fingerprint, value))
        if isinstance(value, (list, tuple)):
            return list(value)
        if isinstance(value, functools.partial):
            return [value.func, value.args, value.keywords]
        if inspect.ismethod(value):
            return [value.__func__, value.__self__]
        if inspect.isfunction(value):
            cells = [cell.cell_contents for cell in value.__closure__ or () if _is_filled(cell)]
            return [_source(value), cells, value.__defaults__, value.__kwdefaults__]
        if isinstance(value, np.random.Generator):
            return [value.bit_generator.state]
        if isinstance(value, np.random.RandomState):
            return [value.get_state(legacy=False)]
        if isinstance(value, torch.Generator):
            return [value.get_state()]
        if isinstance(value, random.Random):
            return [value.getstate()]
        if isinstance(value, type) or inspect.isroutine(value):
            return [_source(value)]
        held = getattr(value, "__dict__", None)
        if held is None or type(value).__module__.partition(".")[0] in _LIBRARIES:
            return [_without_addresses(repr(value))]
        return [_source(type(value)), held]

    def _numbers(self, value: Any) -> None:
        self.say(f"{value.dtype} {tuple(value.shape)}")
        if isinstance(value, Tensor):  # as bytes, since NumPy has no bfloat16
            value = value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy()
        if value.dtype == object:
            self.take(value.tolist())
        else:
            self.digest.update(value.tobytes())

    def _module(self, policy: nn.Module) -> None:
        self.say(_without_addresses(repr(policy)))
        for name, module in policy.named_modules():
            self.say(name)
            if type(module).__module__.partition(".")[0] not in _LIBRARIES:
                self.say(_source(type(module)))
                for key, value in sorted(vars(module).items()):
                    plain = isinstance(value, _PLAIN) or dataclasses.is_dataclass(value)
                    if plain and key not in _OF_EVERY_MODULE:
                        self.say(key)
                        self.take(value)
            elif "module" in vars(module):  # of a TensorDictModule: a callable that is no module
                self.take(vars(module)["module"])
        for key, tensor in sorted(policy.state_dict().items()):
            if isinstance(tensor, Tensor):
                self.say(key)
                self._numbers(tensor)


def _is_filled(cell: Any) -> bool:
    try:
        cell.cell_contents  # noqa: B018 - it may be empty
    except ValueError:
        return False
    return True


def _source(target: Any) -> str:
    """Return name and source of a function or a class; what has no source counts by its name."""
    name = f"{getattr(target, '__module__', '')}:{getattr(target, '__qualname__', '')}"
    with contextlib.suppress(OSError, TypeError):
        return name + inspect.getsource(target)
    return name


def _without_addresses(text: str) -> str:
    return re.sub(r"0x[0-9a-fA-F]+", "", text)
