"""How long a decision of SARSA(λ) takes: tiles, choice and update, against a coder with a dictionary in plain Python.

    python benchmarks/sarsa_speed.py [--decisions 600]

The paper's sizes: 24 observations, 192 tilings of 4, 8 primitives, traces that fade to 1e-4 (24 decisions). The plain
coder is written as the literature has it; both learn from the same observations. A robot decides every 500 ms; 5 ms is what
the project allows. Times are of the processor, so that other programs on the machine do not count.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from openant_agents.sarsa import Sarsa, SarsaSettings
from openant_agents.tile_coding import TileCoder

#: decisions of one coder before it is the other's turn
TURN = 50


def ours(observations: np.ndarray) -> Callable[[int], None]:
    settings = SarsaSettings()
    coder = TileCoder(np.full(24, -1.0), np.ones(24), tiles=4, tilings=192, rows=2**25)
    agent = Sarsa(coder, 8, settings, seed=0)
    rows_before, action_before = coder.rows_of(observations[0]), 0

    def decide(k: int) -> None:
        nonlocal rows_before, action_before
        rows = agent.rows_of(observations[k])
        action = agent.choose(rows)
        agent.learn(rows_before, action_before, 0.01, 0.5, rows, action)
        rows_before, action_before = rows, action

    return decide


def plain(observations: np.ndarray) -> Callable[[int], None]:
    settings = SarsaSettings()
    index: dict[tuple[int, ...], int] = {}
    weights = [[0.0] * 2**20 for _ in range(8)]
    traces: list[tuple[list[int], int, float]] = []
    random = np.random.default_rng(0)
    fading = (settings.gamma * settings.trace) ** 10

    def tiles(observation: list[float]) -> list[int]:
        steps = [int((value + 1.0) * 2.0 * 192) for value in observation]
        rows = []
        for tiling in range(192):
            box, shift = [tiling], tiling
            for step in steps:
                box.append((step + shift) // 192)
                shift += 2 * tiling
            rows.append(index.setdefault(tuple(box), len(index)))
        return rows

    rows_before, action_before = tiles(observations[0].tolist()), 0

    def decide(k: int) -> None:
        nonlocal rows_before, action_before
        rows = tiles(observations[k].tolist())
        values = [sum(w[row] for row in rows) for w in weights]
        action = int(random.integers(8)) if random.random() < settings.epsilon else int(np.argmax(values))
        before = weights[action_before]
        error = 0.05 + settings.gamma**10 * values[action] - sum(before[row] for row in rows_before)
        traces[:] = [(r, a, s * fading) for r, a, s in traces if s * fading >= 1e-4]
        traces.append((rows_before, action_before, 1.0))
        for r, a, strength in traces:
            w, step = weights[a], settings.step_size * error * strength
            for row in r:
                w[row] += step
        rows_before, action_before = rows, action

    return decide


def measure(count: int) -> dict[str, np.ndarray]:
    """ms of each decision of ours and of the plain coder, by turns of fifty."""
    random = np.random.default_rng(0)
    # A walk that comes back, as a robot's does, through boxes most of which are new.
    phase = np.arange(count)[:, None] * 0.7 + random.uniform(0, 6, 24)
    observations = np.clip(0.8 * np.sin(phase) + 0.1 * random.standard_normal((count, 24)), -1, 1)
    coders = {"ours": ours(observations), "dictionary, plain Python": plain(observations)}
    taken: dict[str, list[float]] = {name: [] for name in coders}
    for first in range(1, count, TURN):
        for name, decide in coders.items():
            for k in range(first, min(first + TURN, count)):
                begun = time.thread_time()
                decide(k)
                taken[name].append(1e3 * (time.thread_time() - begun))
    return {name: np.array(each[50:]) for name, each in taken.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--decisions", type=int, default=600)
    found = measure(parser.parse_args().decisions)
    print("| coder | median, ms | p99, ms | longest, ms |")
    print("|---|---|---|---|")
    for name, each in found.items():
        print(f"| {name} | {np.median(each):.3f} | {np.percentile(each, 99):.3f} | {each.max():.3f} |")
    mine, theirs = (np.median(each) for each in found.values())
    print(f"\n{theirs / mine:.1f} times as fast")


if __name__ == "__main__":
    main()
