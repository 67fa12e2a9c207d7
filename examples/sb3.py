"""Stable-Baselines3 learns on a simulated Open Ant, by nothing but Gymnasium.

    pip install openant-tools stable-baselines3
    python examples/sb3.py            a few hundred steps, to see that it runs
    python examples/sb3.py 30000      an hour of robot time

For your own robot: gymnasium.make("openant/Ant-v0", robot="my-ant").
"""

import sys

import gymnasium
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy

import openant_env  # noqa: F401  (registers the environments)

torch.set_num_threads(1)  # networks this small wait for each other on more
steps = int(sys.argv[1]) if len(sys.argv) > 1 else 300
env = gymnasium.make("openant/Ant-v0", max_episode_steps=100)
model = SAC("MlpPolicy", env, learning_starts=100, gamma=0.95, policy_kwargs={"net_arch": [64, 64]}, seed=0)
model.learn(steps)
mean, spread = evaluate_policy(model, env, n_eval_episodes=2)
seconds = 100 * env.unwrapped.dt
print(
    f"after {steps} steps: {100 * mean / seconds:+.2f} ± {100 * spread / seconds:.2f} cm/s over episodes of {seconds:g} s"
)
