"""Own reward: a TorchRL transform over the raw columns of ``("agents", "reward_vector")`` and of all vehicles.

Weights of the built-in terms need no code: ``EnvConfig(reward=RewardConfig(eta=0.5, comfort=1.0))``.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, RewardSum, TransformedEnv
from torchrl.envs.transforms import Transform

from izoo.contexts.procedural import procedural_context
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.envs.mdp.reward import REWARD_VECTOR

COLUMN = {name: column for column, name in enumerate(REWARD_VECTOR)}
REWARD = ("agents", "reward")


class PlatoonReward(Transform):
    """Pay a CV for its speed and against its emission, and every CV against the spread of the fleet's speeds.

    Args:
        spread_weight: weight of the spread, per m/s.
    """

    def __init__(self, spread_weight: float = 0.5) -> None:
        super().__init__(in_keys=[("agents", "reward_vector")], out_keys=[REWARD])
        self.spread_weight = spread_weight

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        terms = next_tensordict["agents", "reward_vector"]  # [*B, A, R], 0 in slots that did not act
        own = terms[..., COLUMN["speed_mps"]] / 15.0 - terms[..., COLUMN["emission_g"]]
        vehicles = next_tensordict["vehicles"]  # [*B, V], human-driven ones too
        present, speed = vehicles["present"], vehicles["speed_mps"]
        count = present.sum(-1, keepdim=True).clamp_min(1)
        mean = torch.where(present, speed, 0.0).sum(-1, keepdim=True) / count
        spread = torch.where(present, (speed - mean).abs(), 0.0).sum(-1, keepdim=True) / count
        reward = own - self.spread_weight * spread
        acted = tensordict["agents", "mask"]  # a mask, not a product: what did not act is paid nothing
        next_tensordict[REWARD] = torch.where(acted, reward, torch.zeros_like(reward)).unsqueeze(-1)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset


def make_env(horizon_s: float) -> TransformedEnv:
    """Return an environment that pays :class:`PlatoonReward` and sums it up per slot."""
    config = EnvConfig(horizon_s=horizon_s, emit=("vehicles", "reward_vector"))
    base = EcoDrivingEnv(procedural_context(adoption=0.5), config=config, seed=0)
    return TransformedEnv(base, Compose(PlatoonReward(), RewardSum(in_keys=[REWARD])))


def main(horizon_s: float = 200.0) -> TensorDict:
    """Play an episode with random accelerations."""
    env = make_env(horizon_s)
    batch = env.rollout(10_000)
    paid = batch["next", "agents", "reward"][batch["agents", "mask"]]
    print(f"{len(paid)} rewards, mean {paid.mean():.3f}")
    env.close()
    return batch


if __name__ == "__main__":
    main()
