"""The gait that unwinds a cable turns the simulated robot on the spot, in every range of actions."""

from __future__ import annotations

import math

import gymnasium
import pytest

import openant_env  # noqa: F401
from openant_env.hardware import WINDING_TURNS
from openant_env.turning import HALF_S, turning_action


@pytest.mark.parametrize(("action_range", "dt", "way"), [("paper", 0.12, 1), ("sac", 0.12, -1), ("sarsa", 0.05, 1)])
def test_a_turn_and_a_half_takes_less_than_eight_seconds(action_range: str, dt: float, way: int) -> None:
    env = gymnasium.make("openant/Ant-v0", kit="standard", action_range=action_range, dt=dt).unwrapped
    _, info = env.reset(seed=1)
    turned, (hx, hy), start = 0.0, info["heading"], info["position"]
    heading, seconds, far = math.atan2(hy, hx), 0.0, 0.0
    for k in range(1000):
        for _ in range(round(HALF_S / dt)):
            _, _, terminated, truncated, info = env.step(turning_action(env.robot.joints, way, k))
            assert not terminated
            assert not truncated
            hx, hy = info["heading"]
            now = math.atan2(hy, hx)
            turned, heading = turned + math.remainder(now - heading, 2.0 * math.pi), now
            seconds, far = seconds + dt, max(far, math.dist(info["position"], start))
        if turned * way > 2.0 * math.pi * WINDING_TURNS:
            break
    assert seconds < 8.0
    assert far < 0.2, "on the spot"
    env.close()
