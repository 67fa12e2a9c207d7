"""Any trained policy, ready to play: what a run's `run.json` says it is, decides how it is loaded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_agents.runs import read_facts
from openant_tools.errors import BadInput

__all__ = ["Policy", "load_policy"]

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Policy:
    """What plays in an environment.

    Attributes:
        act: action (joints,) from observation, once a step.
        begin: to be called after each reset.
        step: environment steps of training that it had when it was saved.
        agent: `sac` or `sarsa`.
    """

    act: Callable[[Array], Array]
    begin: Callable[[], None]
    step: int
    agent: str


def load_policy(folder: Path, env: gymnasium.Env[Any, Any], *, explore: bool = False) -> Policy:
    """The policy of a training run.

    Args:
        folder: the run's.
        env: that it is to play in.
        explore: whether it acts as in training, or takes what it holds best.

    Raises:
        BadInput: no such run, or one whose observations or actions are not the environment's.
    """
    agent = read_facts(folder).get("agent")
    if agent == "sac":
        from openant_agents import sac

        learner, step = sac.load_policy(folder, env)
        return Policy(lambda observation: learner.act(observation, explore=explore), _nothing, step, "sac")
    if agent == "sarsa":
        from openant_agents import sarsa

        policy, step = sarsa.load_policy(folder, env, explore=explore)
        return Policy(policy, policy.begin, step, "sarsa")
    raise BadInput(f"nobody knows how to play an agent called {agent!r}", where=folder, remedy="update openant-tools")


def _nothing() -> None:
    """A policy that remembers nothing has nothing to forget."""
