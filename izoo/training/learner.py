"""The learner: an algorithm on its device, and the policy that collects on the CPU, where the simulators are."""

from __future__ import annotations

import copy
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from izoo.algos.learners.base import MASK, OBSERVATION, POTENTIAL, Algorithm, Keys, innermost, reads
from izoo.algos.learners.decisions import Decisions, shaped
from izoo.conf.train_options import TrainConfig
from izoo.envs.config import STEP
from izoo.gpu import check_gpu

COLLECTS_ON = torch.device("cpu")
_SPARSE: dict[tuple[str, ...], tuple[str, ...]] = {OBSERVATION: MASK, ("next", *OBSERVATION): ("next", *MASK)}
"""What is 0 but where an agent is, and what says where."""


def learner_device(name: str) -> torch.device:
    """Return the device that the option ``device`` names: ``cpu``, ``cuda``, or ``auto``, a GPU where there is one.

    Raises:
        IzooError: ``cuda``, and there is no GPU that PyTorch can use.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda":
        check_gpu("device", "cpu")
    return torch.device(name)


def to_learner(batch: TensorDictBase, device: torch.device) -> TensorDictBase:
    """Return a batch on the learner's device; of observations, which are 0 in empty slots, those of agents travel."""
    if device == COLLECTS_ON:
        return batch
    sparse = {key: mask for key, mask in _SPARSE.items() if {key, mask} <= set(batch.keys(True, True))}
    found = batch.exclude(*sparse).to(device)
    for key, mask in sparse.items():
        dense = batch.get(key)
        rows = dense[batch.get(mask)].to(device)
        found.set(key, rows.new_zeros(dense.shape).index_put_((found.get(mask),), rows))
    return found


class Learner:
    """An algorithm and the policy that collects. They share weights on the CPU; elsewhere the policy gets a copy after
    each update.

    Args:
        algorithm: on the device.
        config: options of the run.
        device: where networks, losses and replay live.

    Attributes:
        decisions: makes decisions of steps, where agents do not decide in every step.
    """

    def __init__(self, algorithm: Algorithm, config: TrainConfig, device: torch.device) -> None:
        self.algorithm, self.device = algorithm, device
        self.gamma: float = getattr(config.algo, "gamma", 1.0)
        whole = getattr(innermost(algorithm), "looks_around", False)
        self.decisions = None if config.env.decide == STEP else Decisions(whole)
        shared = device == COLLECTS_ON
        self.policy: TensorDictModuleBase = (
            algorithm.policy if shared else copy.deepcopy(algorithm.policy).to(COLLECTS_ON)
        )

    def update(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn from a batch ``[N, T]`` that was collected on the CPU; see :class:`izoo.algos.learners.base.Algorithm`.

        The algorithm sees decisions, and shaped rewards where the batch holds potentials. The figures of every
        algorithm hold ``decisions``: how many it learned from.
        """
        if self.decisions is not None:
            batch = self.decisions(batch)
        # Each entry of :class:`Decisions` is one; elsewhere every agent in a step takes one.
        stats = {"decisions": float(len(batch) if self.decisions is not None else batch.get(MASK).sum())}
        if batch.get(POTENTIAL, None) is not None:
            batch = shaped(batch, self.gamma)
        if batch.numel() > 0:
            stats |= self.algorithm.update(to_learner(batch, self.device), progress)
        self.share()
        return stats

    @property
    def reads(self) -> Keys | None:
        """The keys of a batch that the algorithm learns from; ``None``: any of them."""
        return reads(self.algorithm)

    def advantage(self) -> Tensor:
        """Return the advantages ``[N, T, A]`` that the last update estimated, before they were normalised."""
        return innermost(self.algorithm).advantage.to(COLLECTS_ON)

    def state_dict(self) -> dict[str, Any]:
        """Return the algorithm's state and the states of the random generators that learning draws from."""
        acts, kept = innermost(self.policy), innermost(self.algorithm.policy)
        if acts is not kept and hasattr(acts, "noise"):  # exploration goes on in the copy
            kept.noise = acts.noise
        state = {"algorithm": self.algorithm.state_dict(), "torch_rng": torch.get_rng_state()}
        if self.decisions is not None:
            state["decisions"] = self.decisions.state_dict()
        if self.device.type == "cuda":
            state["cuda_rng"] = torch.cuda.get_rng_state(self.device)
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, on whichever device that was."""
        self.algorithm.load_state_dict(state["algorithm"])
        if self.decisions is not None:
            self.decisions.load_state_dict(state["decisions"])
        self.share()
        acts, kept = innermost(self.policy), innermost(self.algorithm.policy)
        if acts is not kept and hasattr(acts, "noise"):
            acts.noise = kept.noise.to(COLLECTS_ON, copy=True)
        torch.set_rng_state(state["torch_rng"])
        if self.device.type == "cuda" and "cuda_rng" in state:
            torch.cuda.set_rng_state(state["cuda_rng"], self.device)

    def share(self) -> None:
        """Hand the algorithm's weights to the policy that collects."""
        if self.policy is not self.algorithm.policy:
            self.policy.load_state_dict(self.algorithm.policy.state_dict())
