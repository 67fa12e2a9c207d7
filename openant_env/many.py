"""Many simulated Ants at once, on all cores: `gymnasium.make_vec("openant/Ant-v0", num_envs=16)`.

Each is an `Ant` of its own; their physics, which is nearly all of a step, runs without Python's lock and so side by side
in threads. An Ant that has ended is reset by the next step, whose action it does not see (Gymnasium's "next step" mode).
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from openant_env.ant import Ant
from openant_tools.errors import BadInput

__all__ = ["ManyAnts"]

Numbers = NDArray[Any]


class ManyAnts(VectorEnv):  # type: ignore[misc]
    """A batch of Ants of the same robot, task and options.

    Args:
        num_envs: how many.
        max_episode_steps: after which each is truncated; None or -1: never.
        options: as `openant_env.ant.Ant` takes them.

    Raises:
        BadInput: in one line, which argument cannot be used.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, num_envs: int = 1, *, max_episode_steps: int | None = None, **options: Any) -> None:
        if num_envs < 1:
            raise BadInput(f"{num_envs} environments", remedy="make 1 or more")
        if options.get("render_mode") == "human":
            raise BadInput("many robots in one window", remedy="use render_mode='rgb_array', or make a single one")
        self.num_envs = num_envs
        self.envs = [Ant(**options) for _ in range(num_envs)]
        first = self.envs[0]
        self.render_mode = first.render_mode
        self.metadata = {**type(self).metadata, "render_fps": first.metadata["render_fps"]}
        self.single_observation_space, self.single_action_space = first.observation_space, first.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._limit = max_episode_steps if max_episode_steps is not None and max_episode_steps > 0 else None
        self._steps = np.zeros(num_envs, int)
        self._ended = np.zeros(num_envs, bool)
        self._threads = ThreadPoolExecutor(min(num_envs, os.cpu_count() or 1), thread_name_prefix="ants")

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Numbers, dict[str, Any]]:
        """Stand them up: (num_envs, 24) observations, and infos by name.

        Args:
            seed: of the first; the others take the numbers after it. Or one each.
            options: as `Ant.reset` takes them; `reset_mask`, (num_envs,) of bool, for those alone that it marks.
        """
        super().reset(seed=None)
        seeds = (
            [None if seed is None else seed + k for k in range(self.num_envs)] if not isinstance(seed, list) else seed
        )
        if len(seeds) != self.num_envs:
            raise BadInput(
                f"{len(seeds)} seeds for {self.num_envs} environments", remedy="give one each, or one number"
            )
        chosen = dict(options or {})
        mask = np.asarray(chosen.pop("reset_mask", np.ones(self.num_envs, bool)), bool)
        if not hasattr(self, "_observations"):
            self._observations = np.zeros(self.observation_space.shape, np.float32)
        infos: dict[str, Any] = {}
        for k in np.flatnonzero(mask).tolist():
            self._observations[k], info = self.envs[k].reset(seed=seeds[k], options=chosen)
            infos = self._add_info(infos, info, k)
        self._steps[mask], self._ended[mask] = 0, False
        return self._observations.copy(), infos

    def step(self, actions: Numbers) -> tuple[Numbers, Numbers, Numbers, Numbers, dict[str, Any]]:
        """Command all of them for `dt` seconds; (num_envs, 8) actions."""
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape:
            raise BadInput(f"actions have shape {actions.shape}", remedy=f"give {self.action_space.shape}")
        n = self.num_envs
        rewards, terminated, truncated = np.zeros(n), np.zeros(n, bool), np.zeros(n, bool)
        again = self._ended.copy()

        def one(k: int) -> tuple[Any, dict[str, Any]]:
            if again[k]:
                return self.envs[k].reset()
            observation, rewards[k], terminated[k], truncated[k], info = self.envs[k].step(actions[k])
            return observation, info

        infos: dict[str, Any] = {}
        self._observations = np.zeros(self.observation_space.shape, np.float32)
        for k, (observation, info) in enumerate(self._threads.map(one, range(n))):
            self._observations[k] = observation
            infos = self._add_info(infos, info, k)
        self._steps = np.where(again, 0, self._steps + 1)
        if self._limit is not None:
            truncated |= self._steps >= self._limit
        self._ended = terminated | truncated
        return self._observations.copy(), rewards, terminated, truncated, infos

    def render(self) -> tuple[Any, ...] | None:
        """A picture each; None without a render mode."""
        return None if self.render_mode is None else tuple(env.render() for env in self.envs)

    def close_extras(self, **how: Any) -> None:
        """Give threads and OpenGL contexts back."""
        self._threads.shutdown()
        for env in self.envs:
            env.close()
