"""Gymnasium's own `check_env` on each of our simulated environments, and a batch by `make_vec`."""

import gymnasium
from gymnasium.utils.env_checker import check_env

import openant_env  # noqa: F401

names = [name for name in gymnasium.registry if name.startswith("openant/") and "Hardware" not in name]
for name in names:
    check_env(gymnasium.make(name).unwrapped, skip_render_check=True)
envs = gymnasium.make_vec("openant/Ant-v0", num_envs=3)
envs.reset(seed=0)
envs.step(envs.action_space.sample())
envs.close()
print(f"{', '.join(sorted(names))} pass; make_vec gives {envs.num_envs}")
