"""PPO on TorchRL alone: no Hydra, no izoo.train. What matters with agents that come and go is in ``agent_rows``.

One policy and one value function are shared by all controlled vehicles (CVs), each of which acts on what it sees.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from izoo.contexts.procedural import ProceduralSource
from izoo.envs import EnvConfig, SumoParallelEnv

EPOCHS, MINIBATCH_ROWS, LEARNING_RATE = 4, 1024, 5e-4
KEYS = {
    "value": ("agents", "state_value"),
    "advantage": ("agents", "advantage"),
    "value_target": ("agents", "value_target"),
    "reward": ("agents", "reward"),
    "done": ("agents", "done"),
    "terminated": ("agents", "terminated"),
}


def network(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, outputs))


def make_actor(features: int, low: float, high: float) -> ProbabilisticActor:
    """A normal distribution squashed into ``[low, high]`` m/s^2, from one CV's observation ``[..., F]``."""
    net = network(features, 2)
    last: Any = net[-1]
    with torch.no_grad():
        last.weight.mul_(0.01)
        last.bias[0] = 0.5  # a policy that hardly accelerates blocks the road and learns nothing
    parameters = TensorDictModule(
        nn.Sequential(net, NormalParamExtractor("biased_softplus_0.35", scale_lb=0.01)),
        in_keys=[("agents", "observation")],
        out_keys=[("agents", "loc"), ("agents", "scale")],
    )
    return ProbabilisticActor(
        parameters,
        in_keys={"loc": ("agents", "loc"), "scale": ("agents", "scale")},
        out_keys=[("agents", "action")],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": low, "high": high},
        return_log_prob=True,
        log_prob_key=("agents", "action_log_prob"),
    )


def agent_rows(batch: TensorDictBase) -> TensorDict:
    """Flatten steps ``[N, T]`` with ``[A]`` slots into one row per controlled vehicle and step: padding is gone.

    After this every loss, mean and normalisation of TorchRL is right as it is.
    """
    mask = batch["agents", "mask"]
    names = ("observation", "action", "action_log_prob", "advantage", "value_target")
    rows = {name: batch["agents", name][mask] for name in names}
    rows["advantage"] = (rows["advantage"] - rows["advantage"].mean()) / rows["advantage"].std().clamp_min(1e-6)
    count = int(mask.sum())
    return TensorDict({"agents": TensorDict(rows, [count])}, [count])


def main(
    total_frames: int = 200_000, frames_per_batch: int = 3_900, horizon_s: float = 1000.0, num_workers: int = 2
) -> list[float]:
    """Train; return the mean reward per CV and step of every batch."""
    torch.manual_seed(0)
    torch.set_num_threads(1)  # networks this small gain nothing from threads, which take cores from the simulators
    config = EnvConfig(horizon_s=horizon_s, emit=())  # nothing but what is learnt from: less to copy
    contexts = ProceduralSource({"inflow_vph_per_lane": [250.0, 400.0], "adoption": 0.5})
    env = SumoParallelEnv(num_workers, contexts, config=config, seed=0)
    features = env.observation_spec["agents", "observation"].shape[-1]
    space = env.full_action_spec["agents", "action"].space
    actor = make_actor(features, float(space.low.min()), float(space.high.max()))
    critic = ValueOperator(network(features, 1), in_keys=[("agents", "observation")], out_keys=[KEYS["value"]])
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    gae.set_keys(**KEYS)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_bonus=False, critic_coeff=0.5)
    loss.set_keys(action=("agents", "action"), sample_log_prob=("agents", "action_log_prob"), **KEYS)
    optimiser = torch.optim.Adam(loss.parameters(), lr=LEARNING_RATE)
    collector = Collector(
        env, actor, frames_per_batch=frames_per_batch, total_frames=total_frames, auto_register_policy_transforms=False
    )
    history = []
    for batch in collector:
        paid = batch["next", "agents", "reward"][batch["agents", "mask"]]
        if len(paid) < 2:
            continue  # nobody to learn from
        history.append(paid.mean().item())
        batch["next", "agents", "reward"] *= 0.1  # values of order 1
        with torch.no_grad():
            gae(batch)
        rows = agent_rows(batch)
        for _ in range(EPOCHS):
            for part in torch.randperm(len(rows)).split(MINIBATCH_ROWS):
                losses = loss(rows[part])
                optimiser.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        print(f"batch {len(history):4d}   {len(rows):6d} agent-steps   mean reward {history[-1]:.3f}", flush=True)
    collector.shutdown()
    return history


if __name__ == "__main__":
    main()
