"""Playing a trained policy and measuring it, without learning."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_env.metrics import AverageReward
from openant_tools.errors import BadInput

__all__ = ["Evaluation", "evaluate"]

Policy = Callable[[NDArray[np.float32]], NDArray[np.float32]]
Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class Evaluation:
    """What a policy achieved.

    Attributes:
        average_reward_m_s: m/s, over the whole time.
        seconds: s, robot time.
        steps: environment steps.
        progress_m: m, the sum of rewards: displacement along the reward direction.
        path_m: m, the length of the way that the torso went, from step to step.
        turns: how often the reward direction changed.
        late: steps that began later than they should, of a robot in real time.
        helped: why and how often the robot had to be set up again.
        seed: of the resets.
    """

    average_reward_m_s: float
    seconds: float
    steps: int
    progress_m: float
    path_m: float
    turns: int
    late: int
    helped: dict[str, int]
    seed: int

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def evaluate(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    *,
    seconds: float,
    seed: int = 0,
    report: Callable[[float, float], None] | None = None,
    frames: int = 0,
    frames_from_s: float = 0.0,
    frame_every: int = 1,
    begin: Callable[[], None] | None = None,
) -> tuple[Evaluation, list[Frame]]:
    """Play a policy for some time.

    Args:
        env: of `openant_env`, or any other whose info holds `dt`, `position` and `reward_direction`.
        policy: action from observation.
        seconds: s of robot time.
        seed: of the first reset.
        report: called after each step with the robot time so far (s) and the average reward so far (m/s).
        frames: how many pictures to take (the environment must render).
        frames_from_s, frame_every: from when on, and at every how many steps.
        begin: called after each reset, for a policy that remembers.

    Returns:
        The figures, and the pictures.

    Raises:
        BadInput: a time that is not above 0.
    """
    if not seconds > 0.0:
        raise BadInput(f"there is nothing to evaluate in {seconds:g} s", remedy="give a time above 0")
    average = AverageReward(math.inf)
    helped: Counter[str] = Counter()
    pictures: list[Frame] = []
    progress = path = 0.0
    steps = turns = late = since_picture = 0
    observation, info = env.reset(seed=seed)
    if begin is not None:
        begin()
    while average.seconds < seconds - 1e-9:
        before = info
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        late = int(info.get("overruns", 0))
        if not info.get("void", False):  # a stop came in the way of this step: nothing was done
            average.add(float(reward), float(info["dt"]))
            progress += float(reward)
            steps += 1
        path += float(np.linalg.norm(np.nan_to_num(info["position"] - before["position"])))
        turns += bool((info["reward_direction"] != before["reward_direction"]).any())
        if len(pictures) < frames and average.seconds > frames_from_s:
            if since_picture % frame_every == 0:
                pictures.append(env.render())
            since_picture += 1
        if report is not None:
            report(average.seconds, average.value)
        if terminated or truncated:
            helped[str(info.get("reason", "the episode ended"))] += 1
            observation, info = env.reset()
            if begin is not None:
                begin()
    result = Evaluation(average.value, average.seconds, steps, progress, path, turns, late, dict(helped), seed)
    return result, pictures
