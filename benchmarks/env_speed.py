"""How much a step of the environment costs above its physics: python benchmarks/env_speed.py

The same commands from the same state are played by the environment and by bare `mj_step`, by turns and many times over;
of each step the quickest repetition counts, which is what it takes when nobody else uses the machine. From the bare
loop the cost of the call itself, measured with no physics in it, is taken off: what is left is the time in MuJoCo's C.
The share is C time over environment time, 1 is perfect.
"""

from __future__ import annotations

import time

import gymnasium
import mujoco
import numpy as np

import openant_env  # noqa: F401

STEPS = 100
ROUNDS = 15
#: share to reach, by physics steps in a step of the environment (facts of the project: 0.95 at 24, 0.97 at 60)
TARGETS = {24: 0.95, 60: 0.97, 120: 0.97}


def measure(substeps: int) -> tuple[float, float]:
    """µs a step of the environment and of the C loop."""
    env = gymnasium.make("openant/Ant-v0", dt=substeps / 1000.0).unwrapped
    model, data = env.model, env.data
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, 8)).astype(np.float32)
    commands = env.actions.centre + env.actions.half * actions
    env.reset(seed=0)
    for action in actions:  # into motion, so that contacts come and go
        env.step(action)
    start = env.get_state()
    now = time.perf_counter_ns
    ours, bare = np.empty((ROUNDS, STEPS)), np.empty((ROUNDS, STEPS))
    for r in range(ROUNDS):
        env.set_state(start)
        for k, action in enumerate(actions):
            began = now()
            env.step(action)
            ours[r, k] = now() - began
        env.set_state(start)
        for k, command in enumerate(commands):
            began = now()
            data.ctrl[:] = command
            mujoco.mj_step(model, data, nstep=substeps)
            bare[r, k] = now() - began
    calls = np.empty(1000)
    for k in range(len(calls)):
        began = now()
        data.ctrl[:] = commands[0]
        mujoco.mj_step(model, data, nstep=0)
        calls[k] = now() - began
    return ours.min(axis=0).mean() / 1e3, (bare.min(axis=0).mean() - calls.min()) / 1e3


def main() -> None:
    print("physics steps  share of C loop  target  env µs/step  C µs/step  env steps/s")
    for substeps, target in TARGETS.items():
        ours, c_loop = measure(substeps)
        print(f"{substeps:13d}  {c_loop / ours:15.3f}  {target:6.2f}  {ours:11.0f}  {c_loop:9.0f}  {1e6 / ours:11.0f}")


if __name__ == "__main__":
    main()
