"""What came of commands: accelerations read from speeds, and the advice that stands for them."""

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from izoo.algos.actions.action_modes import AdviseAction, DirectAction, ResidualAction
from izoo.algos.actions.action_wrappers import RAW_ACTION, ExecutedAcceleration, SpeedCap
from izoo.algos.actions.residual import Correction, NominalDriver
from izoo.algos.learners import base
from izoo.algos.learners.ddpg import DDPGConfig
from izoo.algos.learners.registry import make_algorithm
from izoo.algos.learners.td3 import TD3Config
from izoo.contexts.procedural import procedural_context
from izoo.envs import EnvConfig, TwinEnv
from izoo.envs.mdp.frame import observation_names

ENV = EnvConfig(horizon_s=160.0, num_agents=16, num_vehicles=64, hold_s=1.0, emit=())
BUSY = procedural_context(inflow_vph_per_lane=500.0, adoption=0.5)


class Told(TensorDictModuleBase):
    """Tells every CV to accelerate so."""

    in_keys, out_keys = [base.MASK], [base.ACTION]

    def __init__(self, accel_mps2: float) -> None:
        super().__init__()
        self.accel_mps2 = accel_mps2

    def forward(self, frame: TensorDictBase) -> TensorDictBase:
        return frame.set(base.ACTION, (self.accel_mps2 * frame[base.MASK]).unsqueeze(-1))


def drive(policy: TensorDictModuleBase, steps: int = 60) -> TensorDictBase:
    """A batch ``[2, steps]`` of the twin."""
    world = TwinEnv(2, BUSY, config=ENV, threads=1, surrogate="compiled")
    with torch.no_grad():
        batch = world.rollout(steps, policy, break_when_any_done=False)
    world.close()
    return batch


def test_accelerations_are_read_from_speeds_of_the_simulation() -> None:
    """Who brakes gently, and does not come to a stand, does as told; who is told to speed up does what it can."""
    speed = observation_names(ENV).index("speed")
    braked = drive(Told(-0.3))
    accel = ExecutedAcceleration(ENV)(braked)
    mask = braked[base.MASK] & braked["next", "agents", "mask"]
    free = mask & (braked["next", "agents", "observation"][..., speed] > 0.02)
    told = accel[free].squeeze(-1)
    assert int(free.sum()) > 60
    assert float((told - -0.3).abs().median()) < 1e-3 and float((told > -0.3 + 0.05).float().mean()) < 0.02
    pushed = drive(Told(2.6))
    accel, mask = ExecutedAcceleration(ENV)(pushed), pushed[base.MASK] & pushed["next", "agents", "mask"]
    assert float(accel[mask].max()) <= 2.6 + 1e-3 and float((accel[mask] < 1.0).float().mean()) > 0.3
    left = pushed[base.MASK] & ~pushed["next", "agents", "mask"]
    assert left.any() and torch.equal(accel[left], pushed[base.ACTION][left]), "whose speed is unknown did as told"


def test_in_the_last_decision_it_is_the_command() -> None:
    """It may be shorter than the others, so that a change of speed says less than it seems to."""
    batch = drive(Told(2.6), ENV.decisions)
    ends = batch["next", "agents", "done"][..., 0] & batch["next", "agents", "mask"] & batch[base.MASK]
    assert ends.any()
    assert torch.equal(ExecutedAcceleration(ENV)(batch)[ends], batch[base.ACTION][ends])


def test_a_learner_stores_what_was_applied_and_the_batch_stays_as_it_is() -> None:
    batch = drive(Told(2.6), steps=30)
    small = {"hidden": (8,), "learning_starts": 10**6, "rows_per_frame": None, "n_step": 1, "replay_rows": 5000}
    stored = {}
    for config in (TD3Config(**small), DDPGConfig(**small)):  # type: ignore[arg-type]
        algorithm = make_algorithm(config, DirectAction(), ENV)
        algorithm.update(batch, 0.0)
        learned = getattr(algorithm, "learned", algorithm)
        stored[config.name] = learned.replay.state_dict()["rows"]["agents/action"]
    mask = batch[base.MASK]
    torch.testing.assert_close(stored["ddpg"], batch[base.ACTION][mask])
    torch.testing.assert_close(stored["td3"], ExecutedAcceleration(ENV)(batch)[mask])
    assert (batch[base.ACTION][mask] == 2.6).all()


def test_advice_that_changed_nothing_is_stored_as_none() -> None:
    cap = SpeedCap(ENV, 1.5)
    speed, limit, heard = torch.tensor([10.0, 10.0, 10.0, 10.0]), torch.full((4,), 15.0), torch.ones(4).bool()
    heard[3] = False
    advice = torch.tensor([0.5, 0.5, 0.0, 0.5])
    told, defer = cap.command((speed, limit, heard), advice)
    assert told[0] == -1.5 and defer.tolist() == [False, False, True, True]
    applied = torch.tensor([-1.5, -3.0, -1.0, -1.0])
    assert cap.carried_out((speed, limit, heard), advice, applied).tolist() == [0.5, 0.0, 0.0, 0.0]


def test_a_correction_is_what_the_vehicle_was_held_back_by() -> None:
    correction = Correction(NominalDriver(ENV))
    accel, guided = torch.tensor([-0.5, -0.5, 1.0, 1.0]), torch.tensor([True, True, False, False])
    advice, applied = torch.tensor([0.4, -0.4, 0.3, -0.3]), torch.tensor([-0.9, -0.7, -1.0, 0.2])
    found = correction.carried_out((accel, guided), advice, applied)
    torch.testing.assert_close(found, torch.tensor([0.4, 0.2, 2.0, 0.0]))


@pytest.mark.parametrize("action", [AdviseAction(), ResidualAction(half_width_mps2=0.8)])
def test_advice_is_stored_within_its_bounds_and_as_emitted_where_it_was_carried_out(action: object) -> None:
    algorithm = make_algorithm(TD3Config(hidden=(8,), learning_starts=10**6), action, ENV)  # type: ignore[arg-type]
    batch = drive(algorithm.policy, steps=40)
    found = algorithm.carried_out(batch, algorithm.executed(batch))  # type: ignore[attr-defined]
    mask = batch[base.MASK]
    assert float(found[mask].abs().max()) <= algorithm.bound + 1e-6  # type: ignore[attr-defined]
    same = (found == batch[RAW_ACTION])[mask]
    assert same.any()
    if isinstance(action, AdviseAction):
        assert bool((found[mask][~same] == 0).all())
