"""Environments as other people's code uses them: episodes that end, many at once, pictures and windows."""

from __future__ import annotations

import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

import openant_env  # noqa: F401
from openant_tools.errors import BadInput


def limit(name: str, **options: Any) -> int | None:
    spec = gymnasium.make(name, **options).spec
    return None if spec is None or spec.max_episode_steps in (None, -1) else spec.max_episode_steps


def test_episodes_end_after_1000_steps_and_the_papers_task_never() -> None:
    assert limit("openant/Ant-v0") == limit("openant/AntForward-v0") == 1000
    assert gymnasium.make("openant/AntForward-v0").unwrapped.task.name == "forward"
    for endless in (
        gymnasium.make("openant/AntContinuing-v0"),
        gymnasium.make("openant/Ant-v0", max_episode_steps=-1),
    ):
        assert not isinstance(endless, TimeLimit)
    env = gymnasium.make("openant/Ant-v0", dt=0.02, max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step(np.zeros(8, np.float32))[3] for _ in range(3)] == [False, False, True]


@pytest.mark.parametrize(("dt", "fps"), [(0.12, 8), (0.05, 20), (0.02, 50)])
def test_pictures_a_second_follow_the_step(dt: float, fps: int) -> None:
    assert gymnasium.make("openant/Ant-v0", dt=dt, render_mode="rgb_array").metadata["render_fps"] == fps


def test_many_walk_as_each_would_alone() -> None:
    many = gymnasium.make_vec("openant/Ant-v0", num_envs=3, dt=0.02, max_episode_steps=4)
    assert type(many.unwrapped).__name__ == "ManyAnts"
    alone = [gymnasium.make("openant/Ant-v0", dt=0.02, max_episode_steps=4) for _ in range(3)]
    observations, _ = many.reset(seed=5)
    singles = [env.reset(seed=5 + k)[0] for k, env in enumerate(alone)]
    assert np.array_equal(observations, singles)
    random = np.random.default_rng(0)
    for step in range(9):
        actions = random.uniform(-1, 1, (3, 8)).astype(np.float32)
        observations, rewards, terminated, truncated, infos = many.step(actions)
        if step % 5 == 4:  # the step after an end is a reset
            singles = [env.reset()[0] for env in alone]
            assert np.array_equal(observations, singles)
            assert not rewards.any()
            continue
        for k, env in enumerate(alone):
            single, reward, _, cut, info = env.step(actions[k])
            assert np.array_equal(observations[k], single)
            assert (rewards[k], truncated[k]) == (reward, cut)
            assert np.array_equal(infos["position"][k], info["position"])
        assert not terminated.any()
        assert truncated.all() == (step % 5 == 3)
    with pytest.raises(BadInput, match=r"give \(3, 8\)"):
        many.step(np.zeros((2, 8)))
    many.close()


def test_a_window_needs_a_screen_and_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("platform.system", lambda: "Linux")
    with pytest.raises(BadInput) as refused:
        gymnasium.make("openant/Ant-v0", render_mode="human")
    assert str(refused.value) == (
        "there is no screen here to open a window on → use render_mode='rgb_array', or run it under `xvfb-run`"
    )


def test_the_window_shows_every_step_and_may_be_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[float] = []

    told_to_close, drawn_to_the_end = threading.Event(), threading.Event()

    def draw() -> None:
        told_to_close.wait(10)
        time.sleep(0.05)
        drawn_to_the_end.set()

    def launch_passive(model: Any, data: Any, **how: bool) -> Any:
        threading.Thread(target=draw, daemon=True).start()
        return SimpleNamespace(
            is_running=lambda: len(seen) < 3, sync=lambda: seen.append(data.time), close=told_to_close.set
        )

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setitem(sys.modules, "mujoco.viewer", SimpleNamespace(launch_passive=launch_passive))
    env = gymnasium.make("openant/Ant-v0", dt=0.02, render_mode="human")
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros(8, np.float32))
    assert len(seen) == 3, "reset, two steps, and then it was closed"
    assert np.allclose(np.diff(seen), 0.02)
    assert env.render() is None
    env.close()
    assert drawn_to_the_end.is_set(), "a process that ends while a window still draws hangs in the graphics driver"
