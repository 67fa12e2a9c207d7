"""How much a step of the environment costs above its physics: python benchmarks/env_speed.py

Against MuJoCo's own C loop (`mujoco.rollout`, one thread) over the same commands from the same state, in the same run
and by turns, so that a busy machine slows both alike. The share is C time over environment time, 1 is perfect.
"""

from __future__ import annotations

import statistics
import time

import gymnasium
import mujoco.rollout
import numpy as np

import openant_env  # noqa: F401

STEPS = 60
ROUNDS = 25
#: share to reach, by physics steps in a step of the environment (facts of the project: 0.95 at 24, 0.97 at 60)
TARGETS = {24: 0.95, 60: 0.97, 120: 0.97}


def measure(substeps: int) -> tuple[float, float, float]:
    """Share of the C loop (median over rounds), and ms a step of the environment and of the C loop (best round)."""
    env = gymnasium.make("openant/Ant-v0", dt=substeps / 1000.0).unwrapped
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, 8)).astype(np.float32)
    env.reset(seed=0)
    for action in actions:  # into motion, so that contacts come and go
        env.step(action)
    start = env.get_state()
    commands = env.actions.centre + env.actions.half * actions
    control = np.repeat(commands, substeps, axis=0)[None]
    initial = np.empty((1, mujoco.mj_stateSize(env.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    mujoco.mj_getState(env.model, env.data, initial[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    data = mujoco.MjData(env.model)
    ours, c_loop = [], []
    for _ in range(ROUNDS):
        env.set_state(start)
        began = time.thread_time()
        for action in actions:
            env.step(action)
        ours.append((time.thread_time() - began) / STEPS)
        began = time.thread_time()
        mujoco.rollout.rollout(env.model, data, initial, control)
        c_loop.append((time.thread_time() - began) / STEPS)
    share = statistics.median(c / o for c, o in zip(c_loop, ours, strict=True))
    return share, 1e3 * min(ours), 1e3 * min(c_loop)


def main() -> None:
    print("substeps  share of C loop  target   env ms/step   C ms/step   env steps/s")
    for substeps, target in TARGETS.items():
        share, ours, c_loop = measure(substeps)
        print(f"{substeps:8d}  {share:15.3f}  {target:6.2f}  {ours:12.3f}  {c_loop:10.3f}  {1e3 / ours:12.0f}")


if __name__ == "__main__":
    main()
