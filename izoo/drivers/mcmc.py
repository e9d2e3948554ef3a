"""Markov chains: NumPyro's NUTS in pieces, so that progress shows, Ctrl-C works, and chains share the cores."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from numpyro.infer import NUTS, util

from izoo.cores import usable_cores
from izoo.drivers import model
from izoo.drivers.laplace_fit import LaplaceFit
from izoo.drivers.trajectories import Following
from izoo.errors import check_range

PIECE = 20
"""Iterations between two reports of progress."""
MAX_TREE_DEPTH = 8
FIRST_STEP = 0.3
TARGET_ACCEPT = 0.9
"""Of proposals: the kinks of the IDM want shorter steps than NUTS's usual 0.8."""


@dataclass(frozen=True)
class SamplerConfig:
    """How long to sample.

    Attributes:
        warmup: iterations per chain in which the step size adapts; thrown away.
        draws: iterations per chain that count.
        chains: independent chains.
        seed: of the chains.
    """

    warmup: int = 200
    draws: int = 400
    chains: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        check_range("--warmup", self.warmup, 20, 10**6)
        check_range("--draws", self.draws, 20, 10**6)
        check_range("--chains", self.chains, 2, 64)
        check_range("--seed", self.seed, 0, 2**31 - 1)


@dataclass(frozen=True)
class Draws:
    """The posterior of one class of ``D`` drivers, in ``C`` chains of ``S`` draws.

    Attributes:
        values: ``log_mean``, ``log_sd`` ``[C, S, 5]``, ``correlation`` ``[C, S, 5, 5]``, ``noise_mean``, ``noise_sd``
            ``[C, S]`` of the population; ``x`` ``[C, S, D, 5]`` and ``log_noise`` ``[C, S, D]`` of the drivers.
        diverging: ``[C, S]`` bool.
    """

    values: dict[str, np.ndarray]
    diverging: np.ndarray

    @property
    def log_cov(self) -> np.ndarray:
        """``[C, S, 5, 5]`` covariance of the population."""
        sd = self.values["log_sd"]
        return sd[..., :, None] * self.values["correlation"] * sd[..., None, :]


def sample(data: Following, first_fit: LaplaceFit, config: SamplerConfig, report: Callable[[float], None]) -> Draws:
    """Draw from the posterior; chains of one seed are the same on any number of cores.

    Args:
        data: one class of drivers.
        first_fit: their first fit.
        config: how long.
        report: is told, now and then, which share of the work is done.
    """
    potential = functools.partial(util.potential_energy, model.model, (data, first_fit), {})
    # The first fit knows the scales of all coordinates better than a warm-up can learn them, so only the step adapts.
    kernel = NUTS(
        potential_fn=potential,
        adapt_mass_matrix=False,
        inverse_mass_matrix=ravel_pytree(model.scales(first_fit))[0],
        step_size=FIRST_STEP,
        target_accept_prob=TARGET_ACCEPT,
        max_tree_depth=MAX_TREE_DEPTH,
    )

    @jax.jit
    def begin(key: Any) -> Any:
        place = jax.random.fold_in(key, 1)
        values, unravel = ravel_pytree(model.start(first_fit))
        scale = jnp.sqrt(ravel_pytree(model.scales(first_fit))[0])
        start = unravel(values + scale * jax.random.normal(place, values.shape))
        return kernel.init(key, config.warmup, start, (), {})

    @jax.jit
    def advance(state: Any) -> Any:
        def one(state: Any, _: None) -> Any:
            state = kernel.sample(state, (), {})
            return state, (state.z, state.diverging)

        return jax.lax.scan(one, state, None, length=PIECE)

    constrain = jax.jit(jax.vmap(functools.partial(_constrained, data, first_fit)))
    warmup, kept = -(-config.warmup // PIECE), -(-config.draws // PIECE)
    keys = jax.random.split(jax.random.PRNGKey(config.seed), config.chains)
    with ThreadPoolExecutor(min(config.chains, usable_cores())) as threads:
        states = [begin(key) for key in keys]
        pieces: list[list[Any]] = [[] for _ in keys]
        for piece in range(warmup + kept):
            results = list(threads.map(lambda state: jax.block_until_ready(advance(state)), states))
            states = [state for state, _ in results]
            for chain, (_, (place, diverging)) in zip(pieces, results, strict=True):
                if piece >= warmup:
                    chain.append(({name: np.asarray(value) for name, value in constrain(place).items()}, diverging))
            report((piece + 1) / (warmup + kept))
    return _gather(pieces, config.draws)


def _constrained(data: Following, first_fit: LaplaceFit, place: dict[str, Any]) -> dict[str, Any]:
    values = util.constrain_fn(model.model, (data, first_fit), {}, place, return_deterministic=True)
    factor = values["corr_factor"]
    chosen = {name: values[name] for name in ("log_mean", "log_sd", "noise_mean", "noise_sd", "x", "log_noise")}
    return {**chosen, "correlation": factor @ factor.T}


def _gather(pieces: list[list[Any]], draws: int) -> Draws:
    """Join the pieces of every chain, and stack the chains."""

    def stack(parts: Callable[[Any], Any]) -> np.ndarray:
        return np.stack([np.concatenate([np.asarray(parts(piece)) for piece in chain])[:draws] for chain in pieces])

    names = pieces[0][0][0].keys()
    values = {name: stack(lambda piece, name=name: piece[0][name]) for name in names}  # type: ignore[misc]
    return Draws(values, stack(lambda piece: piece[1]))
