"""Small batches and observations, and what tests of several algorithms do with them."""

from typing import Any

import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from izoo.algos.actions.action_modes import ActionSpace
from izoo.algos.learners.set_ppo import SetPPO
from izoo.contexts.features import feature
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.frame import observation_names
from izoo.envs.mdp.observation import DISTANCE_SCALE_M, SPEED_SCALE_MPS, TIME_SCALE_S

LOW, HIGH, FEATURES = -4.5, 2.6, 5
SPACE = ActionSpace(LOW, HIGH)


def make_frames(n: int = 2, t: int = 6, a: int = 4, seed: int = 0) -> TensorDict:
    """A batch ``[n, t]`` as an environment makes it, with noise in its empty slots.

    Agent 1 of environment 0 leaves at step 2, and another takes its slot at step 5; the last slot stays empty. Episode
    0 of environment 1 ends at step 3; environment 0 is empty at step 4.
    """
    generator = torch.Generator().manual_seed(seed)
    shape = (n, t, a)
    mask = torch.ones(shape, dtype=torch.bool)
    mask[:, :, -1] = False
    terminated = torch.zeros(*shape, 1, dtype=torch.bool)
    if t > 5:
        mask[0, 3:5, 1] = False
        terminated[0, 2, 1] = True
        mask[0, 4] = False
        terminated[0, 3] = mask[0, 3].unsqueeze(-1)
    truncated = torch.zeros_like(terminated)
    if t > 4 and n > 1:
        truncated[1, 3] = mask[1, 3].unsqueeze(-1)
    observation = torch.randn(*shape, FEATURES, generator=generator)
    following = torch.randn(*shape, FEATURES, generator=generator)
    next_mask = mask & ~terminated.squeeze(-1)
    for step in range(t - 1):
        goes_on = ~truncated[:, step].flatten(1).any(1)  # the environment; a leaver's slot stays empty for a step
        following[goes_on, step] = observation[goes_on, step + 1]
        next_mask[goes_on, step] = mask[goes_on, step + 1]
    successor = {
        "observation": following,
        "mask": next_mask,
        "reward": torch.randn(*shape, 1, generator=generator),
        "done": terminated | truncated,
        "terminated": terminated,
        "truncated": truncated,
    }
    agents = TensorDict({"observation": observation, "mask": mask}, shape)
    return TensorDict({"agents": agents, "next": TensorDict({"agents": TensorDict(successor, shape)}, [n, t])}, [n, t])


def act(algorithm: Any, batch: TensorDict, seed: int = 1, kind: ExplorationType = ExplorationType.RANDOM) -> TensorDict:
    """Let the policy act on every frame of a copy of ``batch``."""
    torch.manual_seed(seed)
    with torch.no_grad(), set_exploration_type(kind):
        return algorithm.policy(batch.clone())


def shake(module: torch.nn.Module, spread: float = 0.3, seed: int = 5) -> None:
    """Move the parameters of ``module``, so that they differ from those it began with."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(spread * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(seed)))


def with_noise(batch: TensorDict, noise: float) -> TensorDict:
    """A copy of ``batch`` with ``noise`` in everything that empty slots hold."""
    noisy = batch.clone()
    for group in (noisy["agents"], noisy["next", "agents"]):
        for key in set(group.keys()) & {"observation", "action", "loc", "scale", "action_log_prob"}:
            group[key][~group["mask"]] = noise
    noisy["next", "agents", "reward"][~noisy["agents", "mask"]] = noise
    return noisy


def reordered(batch: TensorDict) -> TensorDict:
    """The agents of ``batch`` in another order, behind three empty slots."""
    wide, order = TensorDict(batch_size=batch.batch_size), torch.tensor([2, 3, 0, 1])
    for place in ("agents", ("next", "agents")):
        wide[place] = torch.cat([torch.zeros_like(batch[place][..., :3]), batch[place][..., order]], -1)
    return wide


def observed(config: EnvConfig, **values: float) -> torch.Tensor:
    """An observation ``[F]`` of ``values`` in SI units, 0 elsewhere."""
    names = observation_names(config)
    row = torch.zeros(len(names))
    for name, value in values.items():
        scale = feature(name.removeprefix("context_")).scale if name.startswith("context_") else 1.0
        if name in ("signal_time_left", "signal_second_green", "signal_third_green"):
            scale = TIME_SCALE_S
        for ending, unit in (("speed", SPEED_SCALE_MPS), ("distance", DISTANCE_SCALE_M)):
            scale = unit if name.endswith(ending) else scale
        row[names.index(name)] = value / scale
    return row


def alone(algorithm: SetPPO, observation: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Values ``[*M, A]``, one frame at a time, of its valid agents alone; 0 in empty slots."""
    values = torch.zeros(mask.shape)
    network = algorithm.critic.module.network
    for place in torch.cartesian_prod(*(torch.arange(size) for size in mask.shape[:-1])).tolist():
        here = tuple(place)
        valid = mask[here]
        if valid.any():
            everyone = torch.ones(1, int(valid.sum()), dtype=torch.bool)
            with torch.no_grad():
                values[here][valid] = network(observation[here][valid].unsqueeze(0), everyone)[0, :, 0]
    return values
