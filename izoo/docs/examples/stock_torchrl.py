"""Any of izoo's losses, trained by TorchRL's own collector, replay buffer and optimisers on many intersections."""

from __future__ import annotations

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import AdditiveGaussianModule, ProbabilisticActor, TanhModule, TanhNormal, ValueOperator
from torchrl.objectives import LossModule, SoftUpdate

from izoo.algos.losses import MaskedDDPGLoss, MaskedGraphPPOLoss, MaskedMAPPOLoss, MaskedPPOLoss, MaskedTD3Loss
from izoo.contexts.procedural import ProceduralSource
from izoo.envs import EnvConfig, TwinEnv

OBSERVATION, MASK, ACTION = ("agents", "observation"), ("agents", "mask"), ("agents", "action")
LOC, SCALE = ("agents", "loc"), ("agents", "scale")
LOW, HIGH = -4.5, 2.6
OFF_POLICY = ("ddpg", "td3")


class Alone(nn.Module):
    """What one vehicle sees, and its action where that is given."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        last = nn.Linear(64, outputs)
        self.layers = nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), last)
        for parameter in last.parameters():
            nn.init.zeros_(parameter)

    def forward(self, *seen: Tensor) -> Tensor:
        return self.layers(torch.cat(seen, -1))


class Together(nn.Module):
    """The same beside the mean over all vehicles that are there: ``[*B, A, F]`` and the mask ``[*B, A]``."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.alone = Alone(2 * inputs, outputs)

    def forward(self, seen: Tensor, mask: Tensor) -> Tensor:
        there = mask.unsqueeze(-1)
        total = torch.where(there, seen, 0.0).sum(-2, keepdim=True)
        mean = total / there.sum(-2, keepdim=True).clamp_min(1)
        return self.alone(seen, mean.expand_as(seen))


def stochastic(features: int, together: bool) -> ProbabilisticActor:
    body = Together(features, 2) if together else Alone(features, 2)
    extract = TensorDictModule(NormalParamExtractor("biased_softplus_0.5"), [("agents", "raw")], [LOC, SCALE])
    read = TensorDictModule(body, [OBSERVATION, MASK] if together else [OBSERVATION], [("agents", "raw")])
    return ProbabilisticActor(
        TensorDictSequential(read, extract),
        in_keys={"loc": LOC, "scale": SCALE},
        out_keys=[ACTION],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": LOW, "high": HIGH},
        return_log_prob=True,
        log_prob_key=("agents", "action_log_prob"),
    )


def value(features: int, together: bool) -> ValueOperator:
    body = Together(features, 1) if together else Alone(features, 1)
    return ValueOperator(body, [OBSERVATION, MASK] if together else [OBSERVATION], [("agents", "state_value")])


def make(name: str, features: int) -> tuple[TensorDictModuleBase, LossModule]:
    """The policy and its loss: ``ppo`` sees one vehicle, the critic of ``mappo`` and ``graph`` as a whole see all."""
    if name in OFF_POLICY:
        squash = TanhModule(in_keys=[ACTION], low=LOW, high=HIGH)
        actor = TensorDictSequential(TensorDictModule(Alone(features, 1), [OBSERVATION], [ACTION]), squash)
        critic = ValueOperator(Alone(features + 1, 1), [OBSERVATION, ACTION], [("agents", "state_action_value")])
        if name == "ddpg":
            return actor, MaskedDDPGLoss(actor, critic, gamma=0.95)
        return actor, MaskedTD3Loss(actor, critic, bounds=(LOW, HIGH), gamma=0.95)
    kind = {"ppo": MaskedPPOLoss, "mappo": MaskedMAPPOLoss, "graph": MaskedGraphPPOLoss}[name]
    policy = stochastic(features, name == "graph")
    return policy, kind(policy, value(features, name != "ppo"), normalize_advantage=True, gamma=0.95, lmbda=0.9)


def train(name: str = "ppo", batches: int = 50, updates: int = 16, num_envs: int = 16, steps: int = 60) -> list[float]:
    """Train, and return the mean reward per vehicle and step of every batch."""
    torch.manual_seed(0)
    contexts = ProceduralSource({"inflow_vph_per_lane": 500.0, "adoption": 0.5})
    env = TwinEnv(num_envs, contexts, config=EnvConfig(horizon_s=25.0 + steps, hold_s=2.0, emit=()))
    policy, loss = make(name, len(env.observation_names))
    target = None
    if name in OFF_POLICY:
        noise = AdditiveGaussianModule(env.full_action_spec[ACTION], 1.0, 1.0, action_key=ACTION, safe=False)
        policy, target = TensorDictSequential(policy, noise), SoftUpdate(loss, tau=0.05)
    else:
        loss.make_value_estimator()
    frames = num_envs * steps // 2
    buffer = ReplayBuffer(storage=LazyTensorStorage(frames * (4 if target else 1)), batch_size=frames // 4)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-3)
    collector = Collector(
        env, policy, frames_per_batch=frames, total_frames=frames * batches, auto_register_policy_transforms=False
    )
    history = []
    for batch in collector:  # [num_envs, time], agents [num_envs, time, slots]
        history.append(float(batch["next", "agents", "reward"][batch["agents", "mask"]].mean()))
        if target is None:
            loss.value_estimator(batch)
        buffer.extend(batch.reshape(-1))
        for _ in range(updates):
            losses = loss(buffer.sample())
            sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimiser.step()
            optimiser.zero_grad()
            if target is not None:
                target.step()
        print(f"{name} batch {len(history):3d}   mean reward {history[-1]:.3f}", flush=True)
    collector.shutdown()
    return history


if __name__ == "__main__":
    train()
