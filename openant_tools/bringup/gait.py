"""How well it walks, in words; and the training after which one sees it walk."""

from __future__ import annotations

from collections.abc import Mapping

from openant_tools.numbers import number

__all__ = ["FIRST_STEPS", "STEP_S", "WALKS_M_S", "first_look", "steps_of", "walks", "walks_at"]

#: m/s, the slowest that the paper calls competent walking; below it a robot shuffles on the spot
WALKS_M_S = 0.02
#: s, agent → length of its step in the paper
STEP_S: Mapping[str, float] = {"sac": 0.12, "sarsa": 0.05}
#: of training in simulation, for a first look: a quarter of an hour of robot time
FIRST_STEPS = 7000


def walks(reward_m_s: float) -> bool:
    """Whether an average reward is that of a robot that walks."""
    return reward_m_s >= WALKS_M_S


def walks_at(reward_m_s: float) -> str:
    """`walks at 13.5 cm/s`, or `does not walk yet (−2.3 cm/s)`."""
    speed = f"{number(100 * reward_m_s, decimals=1)} cm/s"
    return f"walks at {speed}" if walks(reward_m_s) else f"does not walk yet ({speed})"


def steps_of(agent: str, minutes: float) -> int:
    """How many steps of an agent are so much robot time."""
    return round(60 * minutes / STEP_S[agent])


def first_look(steps: int = FIRST_STEPS) -> tuple[str, ...]:
    """Options of `openant train sac` with which it walks within so few steps, if less well in the end than with the paper's."""
    return "--learning-start", str(min(500, steps)), "--entropy-start", "0.1", "--batch", "128"
