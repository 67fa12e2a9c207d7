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
        sample: action (joints,) from observation as in training, drawn by chance; once a step.
        likeliest: the action that it holds best: SAC's mean, SARSA's greedy primitive; once a step.
        begin: to be called after each reset.
        seed: begins its chance anew.
        step: environment steps of training that it had when it was saved.
        agent: `sac` or `sarsa`.
    """

    sample: Callable[[Array], Array]
    likeliest: Callable[[Array], Array]
    begin: Callable[[], None]
    seed: Callable[[int], None]
    step: int
    agent: str


def load_policy(folder: Path, env: gymnasium.Env[Any, Any]) -> Policy:
    """The policy of a training run.

    Args:
        folder: the run's.
        env: that it is to play in.

    Raises:
        BadInput: no such run, or one whose observations or actions are not the environment's.
    """
    agent = read_facts(folder).get("agent")
    if agent == "sac":
        from openant_agents import sac

        learner, step = sac.load_policy(folder, env)
        return Policy(
            learner.act, lambda seen: learner.act(seen, explore=False), _nothing, learner.begin_chance, step, "sac"
        )
    if agent == "sarsa":
        from openant_agents import sarsa

        policy, step = sarsa.load_policy(folder, env)
        return Policy(policy.sample, policy.greedy, policy.begin, policy.seed, step, "sarsa")
    raise BadInput(f"nobody knows how to play an agent called {agent!r}", where=folder, remedy="update openant-tools")


def _nothing() -> None:
    """A policy that remembers nothing has nothing to forget."""
