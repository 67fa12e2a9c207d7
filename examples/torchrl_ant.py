"""TorchRL collects on a simulated Open Ant and learns from it: an actor by its own rewards, REINFORCE in a few lines.

pip install openant-tools torchrl
python examples/torchrl_ant.py          a few hundred steps, to see that it runs
python examples/torchrl_ant.py 30000    an hour of robot time
"""

import sys

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.transforms import Compose, DoubleToFloat, StepCounter
from torchrl.envs.utils import check_env_specs
from torchrl.modules import ProbabilisticActor, TanhNormal

import openant_env  # noqa: F401  (registers the environments)

torch.set_num_threads(1)  # networks this small wait for each other on more
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 300
env = TransformedEnv(GymEnv("openant/Ant-v0"), Compose(DoubleToFloat(), StepCounter(max_steps=100)))
check_env_specs(env)
observations, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
network = torch.nn.Sequential(
    torch.nn.Linear(observations, 64), torch.nn.Tanh(), torch.nn.Linear(64, 2 * actions), NormalParamExtractor()
)
policy = ProbabilisticActor(
    TensorDictModule(network, ["observation"], ["loc", "scale"]),
    in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True, spec=env.action_spec,
)  # fmt: skip
optimiser = torch.optim.Adam(policy.parameters(), 1e-3)
made = 0
while made < steps:
    play = env.rollout(100, policy)
    reward = play["next", "reward"].squeeze(-1)
    to_come = reward.flip(0).cumsum(0).flip(0)
    log_prob = policy.get_dist(play).log_prob(play["action"])
    loss = -(log_prob * (to_come - to_come.mean())).mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    made += len(reward)
print(f"{made} steps; the last play went {100 * reward.sum().item():+.1f} cm in {100 * 0.12:g} s")
