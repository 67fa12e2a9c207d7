"""What environment and agents cost, against the project's targets, in one run: python benchmarks/agents_speed.py

Every ratio is taken by turns and by the processor's own clock (environment: the quickest repetition), so that a busy machine
slows both sides alike; the last three rows are real time, and say what the machine had to do besides.

The other sides: a bare C loop over `mj_step`; the usual structure of SAC's update, and Stable-Baselines3's own; a tile coder
with a dictionary in plain Python. An hour of the robot is taken from some hundred steps of acting, walking and learning, on
either side in the same environment.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import env_speed
import gymnasium
import numpy as np
import sac_speed
import sarsa_speed
import torch

from openant_agents.async_training import LearnerProcess
from openant_agents.learner import Job
from openant_agents.sac import Sac, SacSettings

#: s, the loop that acts while another process learns, and how many times
LOOP_S, LOOPS = 0.05, 300
HOUR_STEPS = 150


def hour(ours: Sac, usual: sac_speed.Usual) -> float:
    """Time of a simulated hour of ours over that of the usual structure."""
    env = gymnasium.make("openant/Ant-v0", kit="standard").unwrapped
    seen = [env.reset(seed=0)[0]]

    def mine() -> None:
        action = ours.act(seen[0])
        then, reward, terminated, _, info = env.step(action)
        ours.replay.add(seen[0], action, reward, info["dt"], terminated, then)
        seen[0] = then
        ours.update()

    def theirs() -> None:
        with torch.no_grad():  # log π too, as the usual actor gives both
            action = usual.actor(torch.from_numpy(seen[0])[None], usual._normal(1))[0][0].numpy()
        seen[0] = env.step(action)[0]
        usual.update()

    turns = [(sac_speed.timed(mine, 15), sac_speed.timed(theirs, 15)) for _ in range(HOUR_STEPS // 15)]
    return float(np.median([a / b for a, b in turns]))


def deadlines(agent: Sac, before: Callable[[], object]) -> np.ndarray:
    """ms from each deadline of a loop to its action, where something is done before each."""
    observation, taken = np.zeros(sac_speed.OBSERVATIONS, np.float32), []
    begun = time.monotonic()
    for k in range(1, LOOPS + 1):
        deadline = begun + k * LOOP_S
        time.sleep(max(0.0, deadline - time.monotonic()))
        before()
        agent.act(observation)
        taken.append(1e3 * (time.monotonic() - deadline))
    return np.array(taken[20:])


def beside_a_learner() -> np.ndarray:
    """`deadlines` while another process learns without a pause."""
    settings = SacSettings(learning_start=0)
    agent = Sac(sac_speed.OBSERVATIONS, sac_speed.ACTIONS, replace(settings, buffer=1), seed=0)
    with tempfile.TemporaryDirectory() as name:
        rows = np.random.default_rng(0).normal(size=(4096, agent.replay.width)).astype(np.float32)
        (Path(name) / "transitions.f32").write_bytes(rows.tobytes())
        job = Job(Path(name), settings, sac_speed.OBSERVATIONS, sac_speed.ACTIONS, 0, "cpu", 1e6)
        learner = LearnerProcess(job, agent)
        try:
            return deadlines(agent, learner.follow)
        finally:
            learner.close()


def main() -> None:
    torch.set_num_threads(1)
    print("| what | target | then | here |\n|---|---|---|---|", flush=True)

    def row(what: str, first: str, then: str, here: str) -> None:
        print(f"| {what} | {first} | {then} | {here} |", flush=True)

    for substeps, first, then in ((24, 0.95, 0.97), (60, 0.97, 0.99)):
        env_us, c_us = env_speed.measure(substeps)
        row(f"env step as a share of a C loop, {substeps} physics steps", f"{first}", f"{then}", f"{c_us / env_us:.3f}")
    settings = SacSettings(buffer=4096)
    ours, usual = sac_speed.learner(settings), sac_speed.Usual(settings)
    mine, theirs, ratio = sac_speed.compared(ours.update, usual.update)
    row(
        "SAC updates/s, LayerNorm, against the usual structure",
        "1.5",
        "1.9",
        f"{ratio:.2f} ({mine:.0f} against {theirs:.0f})",
    )
    plain = sac_speed.learner(replace(settings, layer_norm=False))
    mine, theirs, ratio = sac_speed.compared(plain.update, sac_speed.stable_baselines())
    row(
        "SAC updates/s, none, against Stable-Baselines3", "1.4", "1.6", f"{ratio:.2f} ({mine:.0f} against {theirs:.0f})"
    )
    row(
        "one action, median / p99", "60 / 120 µs", "30 / 60 µs", "{:.0f} / {:.0f} µs".format(*sac_speed.action_us(ours))
    )
    row("a simulated hour of SAC, against the usual structure's time", "0.75", "0.6", f"{hour(ours, usual):.2f}")
    found = sarsa_speed.measure(1000)
    own, python = (np.median(each) for each in found.values())
    row("SARSA(λ) decision against a dictionary in plain Python", "10×", "40×", f"{python / own:.1f}× ({own:.2f} ms)")
    for what, asked, later, waited in (
        ("deadline to action beside a learner, 50 ms loop, p99", "2 ms", "1 ms", beside_a_learner()),
        ("the same with nobody learning: what the machine takes", "–", "–", deadlines(ours, lambda: None)),
        ("the same, an update before each action (`--learn sync`)", "–", "–", deadlines(ours, ours.update)),
    ):
        here = f"{np.percentile(waited, 99):.1f} ms (median {np.median(waited):.1f})"
        row(what, asked, later, f"{here}, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
