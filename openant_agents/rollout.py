"""What a trained policy commands over a while, for whoever plays commands and knows no agents."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_agents.policies import Policy

__all__ = ["commands_of"]


def commands_of(env: gymnasium.Env[Any, Any], policy: Policy, *, seconds: float, seed: int = 0) -> NDArray[np.float64]:
    """(n, joints) rad, one row a step of the environment, of a policy that walks, sampled, for `seconds` (s) of robot time.

    Args:
        env: a simulated Open Ant of `openant_env`; where it ends an episode, the next one follows.
    """
    rows: list[NDArray[np.float64]] = []
    policy.seed(seed)
    observation, _ = env.reset(seed=seed)
    policy.begin()
    while len(rows) * env.unwrapped.dt < seconds:
        observation, _, terminated, truncated, _ = env.step(policy.sample(observation))
        rows.append(env.unwrapped.command)
        if terminated or truncated:
            observation, _ = env.reset()
            policy.begin()
    return np.array(rows)
