"""What a trained policy commands over a while, for whoever plays commands and knows no agents."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_agents.policies import Policy, load_policy
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import write_table

__all__ = ["commands_of", "write_commands"]

#: s of robot time that a policy walks for a table: many rounds of any gait, and both ways of back-and-forth
TABLE_S = 60.0


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


def write_commands(env: gymnasium.Env[Any, Any], run: Path, table: Path) -> None:
    """Write what the policy of a training run commands in a simulation as a table, for whoever plays recordings.

    Raises:
        BadInput: no training run, or one of another robot.
    """
    commands = commands_of(env, load_policy(run, env), seconds=TABLE_S)
    joints = tuple(env.unwrapped.robot.joints)
    columns = {f"cmd.{joint}": column for joint, column in zip(joints, commands.T, strict=True)}
    facts = Facts(joints=joints, setup="floor", protocol="walk", notes=f"commanded by {run} in the simulation")
    times = float(env.unwrapped.dt) * np.arange(len(commands), dtype=np.float64)
    write_table(Run(table.stem, facts, times, columns), table)
