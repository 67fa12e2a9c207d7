"""Playing a trained policy and measuring it, without learning: from several starts, in both of its ways to act.

*Sampled*: actions are drawn as in training, which is what the policy was rewarded for. *Likeliest*: the mean action of SAC,
the greedy primitive of SARSA. A policy whose gait lives on its noise walks sampled and may stand still for good as its
likeliest action, in a pose whose action is that pose; therefore both are measured and labelled.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_agents.policies import Policy
from openant_agents.training import in_time_with
from openant_env.metrics import AverageReward
from openant_tools.errors import BadInput
from openant_tools.numbers import exact, number

__all__ = ["LIKELIEST", "SAMPLED", "Frame", "Plays", "PolicyPlay", "Way", "evaluate", "film"]

Way = Literal["sampled", "likeliest"]
SAMPLED: Way = "sampled"
LIKELIEST: Way = "likeliest"

#: a torso that has not left this distance (m) around its last place for this time (s) stands still
STILL_M = 0.01
STILL_S = 5.0

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class PolicyPlay:
    """What a policy achieved from one start.

    Attributes:
        average_reward_m_s: m/s, over the whole time.
        seconds: s, robot time.
        steps: environment steps.
        progress_m: m, the sum of rewards: displacement along the reward direction.
        path_m: m, the length of the way that the torso went, from step to step.
        turns: how often the reward direction changed.
        late: steps that began later than they should, of a robot in real time.
        helped: why and how often the robot had to be set up again.
        stood_still: whether it ended standing still, for `STILL_S` or half of the time at least.
        seed: of the reset and of the policy's chance.
    """

    average_reward_m_s: float
    seconds: float
    steps: int
    progress_m: float
    path_m: float
    turns: int
    late: int
    helped: dict[str, int]
    stood_still: bool
    seed: int


@dataclass(frozen=True)
class Plays:
    """What a policy achieved in one way of acting, from all starts."""

    way: Way
    plays: tuple[PolicyPlay, ...]

    @property
    def rewards(self) -> NDArray[np.float64]:
        """(starts,) m/s."""
        return np.array([play.average_reward_m_s for play in self.plays])

    @property
    def mean(self) -> float:
        """m/s."""
        return float(self.rewards.mean())

    @property
    def median(self) -> float:
        """m/s."""
        return float(np.median(self.rewards))

    @property
    def low(self) -> float:
        """m/s, of the worst start."""
        return float(self.rewards.min())

    @property
    def high(self) -> float:
        """m/s, of the best start."""
        return float(self.rewards.max())

    @property
    def stood_still(self) -> int:
        """How many starts ended standing still."""
        return sum(play.stood_still for play in self.plays)

    @property
    def typical(self) -> PolicyPlay:
        """The play whose reward is nearest to the median."""
        return min(self.plays, key=lambda play: abs(play.average_reward_m_s - self.median))

    @property
    def helped(self) -> Counter[str]:
        """Why and how often the robot had to be set up again."""
        return sum((Counter(play.helped) for play in self.plays), Counter[str]())

    def as_dict(self) -> dict[str, Any]:
        answer: dict[str, Any] = {"median": self.median, "low": self.low, "high": self.high}
        return answer if self.way == SAMPLED else {**answer, "stood_still": self.stood_still}


def evaluate(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    *,
    way: Way,
    seconds: float,
    starts: int,
    seed: int = 0,
    progress: Callable[[float, str], None] = lambda share, words: None,
) -> Plays:
    """Play a policy from several starts.

    Args:
        env: of `openant_env`, or any other whose info holds `dt`, `position` and `reward_direction`.
        way: how it acts.
        seconds: s of robot time from each start.
        starts: how many resets: other headings in a simulation; a robot stands up where it is.
        seed: of the first start; each further one has the next.
        progress: called after each step with the share that is done; its words say what was achieved so far.

    Raises:
        BadInput: a time that is not above 0, or no start.
    """
    if not seconds > 0.0 or starts < 1:
        raise BadInput(
            f"there is nothing to evaluate in {starts} × {exact(seconds, 's')}", remedy="give a time above 0"
        )

    def played(start: int) -> PolicyPlay:
        def tell(done: float, average: float) -> None:
            achieved = number(100 * average, "cm/s", sign=True, decimals=1)
            words = f"start {start + 1} of {starts}, {way} {achieved}"
            progress((start + done / seconds) / starts, words)

        with in_time_with(env):
            return _play(env, policy, way, seconds, seed + start, tell, lambda: None)

    return Plays(way, tuple(played(start) for start in range(starts)))


def film(env: gymnasium.Env[Any, Any], policy: Policy, *, way: Way, seconds: float, seed: int) -> list[Frame]:
    """A play once more, with a picture of each of its steps; the environment must render."""
    frames: list[Frame] = []
    _play(env, policy, way, seconds, seed, lambda done, average: None, lambda: frames.append(env.render()))
    return frames


def _play(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    way: Way,
    seconds: float,
    seed: int,
    tell: Callable[[float, float], None],
    draw: Callable[[], None],
) -> PolicyPlay:
    act = policy.sample if way == SAMPLED else policy.likeliest
    average = AverageReward(math.inf)
    helped: Counter[str] = Counter()
    progress = path = 0.0
    steps = turns = late = 0
    policy.seed(seed)
    observation, info = env.reset(seed=seed)
    policy.begin()
    times, places = [0.0], [info["position"]]
    while average.seconds < seconds - 1e-9:
        before = info
        observation, reward, terminated, truncated, info = env.step(act(observation))
        late = int(info.get("overruns", 0))
        if not info.get("void", False):  # a stop came in the way of this step: nothing was done
            average.add(float(reward), float(info["dt"]))
            progress += float(reward)
            steps += 1
            times.append(average.seconds)
            places.append(info["position"])
        path += float(np.linalg.norm(np.nan_to_num(info["position"] - before["position"])))
        turns += bool((info["reward_direction"] != before["reward_direction"]).any())
        draw()
        tell(average.seconds, average.value)
        if terminated or truncated:
            helped[str(info.get("reason", "the episode ended"))] += 1
            observation, info = env.reset()
            policy.begin()
    still = stands_still(times, places)
    return PolicyPlay(average.value, average.seconds, steps, progress, path, turns, late, dict(helped), still, seed)


def stands_still(times: Sequence[float], places: Sequence[NDArray[np.float64]]) -> bool:
    """Whether a torso keeps to its place (m, at these times in s) in the last `STILL_S`, or half of a shorter play."""
    t, xy = np.asarray(times), np.asarray(places)
    last = xy[t >= t[-1] - min(STILL_S, 0.5 * (t[-1] - t[0]))]
    away = np.linalg.norm(last - last[-1], axis=1)
    # Of a place that is not known nobody knows whether it was left.
    return bool(len(last) > 1 and (away < STILL_M).all())
