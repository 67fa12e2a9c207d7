"""The paper's learning curves and ablations, in simulation: one command a figure.

    python benchmarks/paper_figures.py sac            # five seeds, an hour of robot time each
    python benchmarks/paper_figures.py sarsa
    python benchmarks/paper_figures.py layer-norm     # SAC with and without; so do the next two
    python benchmarks/paper_figures.py learning-start # 5,000 steps and 2,000
    python benchmarks/paper_figures.py reward-scale   # 1 and 100

Runs lie in OUT/runs, those with the paper's settings once for all figures, and go on where they were stopped; what is long
enough is not trained again. Every figure is the mean and ± 3 standard errors over seeds of the average reward over 120 s; the
command says how many seeds reach what the project asks of the agent, and when.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# One thread a process: the matrices are small, and seeds share the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from joblib import Parallel, delayed

from openant_tools.workers import tied

#: m/s that the project asks of each agent within an hour
ASKED_M_S = {"sac": 0.05, "sarsa": 0.01}
HOUR = {"sac": 30_000, "sarsa": 72_000}


@dataclass(frozen=True)
class Figure:
    """What is trained for a figure.

    Attributes:
        agent: `sac` or `sarsa`.
        variants: name → settings that differ from the paper's; none of them is `paper` in all figures.
        words: what it shows.
    """

    agent: str
    variants: Mapping[str, Mapping[str, Any]]
    words: str


FIGURES: Mapping[str, Figure] = {
    "sac": Figure("sac", {"paper": {}}, "the paper's settings"),
    "sarsa": Figure("sarsa", {"paper": {}}, "the paper's settings"),
    "layer-norm": Figure(
        "sac",
        {"paper": {}, "no-layer-norm": {"layer_norm": False}},
        "the paper: LayerNorm learns faster, with less variance",
    ),
    "learning-start": Figure(
        "sac", {"paper": {}, "start-5000": {"learning_start": 5_000}}, "the paper: starting earlier loses nothing"
    ),
    "reward-scale": Figure(
        "sac", {"paper": {}, "scale-1": {"reward_scale": 1.0}}, "the paper: larger rewards learn much faster"
    ),
}


def train_one(agent: str, folder: Path, steps: int, seed: int, changed: Mapping[str, Any]) -> float:
    """Train one seed, or go on with it; s of processor time that it took now."""
    import gymnasium

    import openant_env  # noqa: F401
    from openant_agents import sac, sarsa
    from openant_agents.runs import read_curve

    curve = folder / "learning_curve.csv"
    if curve.is_file() and max((point.step for point in read_curve(folder)), default=0) >= steps:
        return 0.0
    begun = time.process_time()
    options: dict[str, Any] = {"kit": "standard", "task": "back-and-forth"}
    if agent == "sarsa":
        options |= {"dt": 0.05, "action_range": "sarsa"}
    env = gymnasium.make("openant/AntContinuing-v0", **options)
    facts = {"id": "openant/Ant-v0", "options": options}
    if agent == "sac":
        sac.train(env, folder=folder, steps=steps, seed=seed, settings=sac.SacSettings(**changed), env_facts=facts)
    else:
        sarsa.train(
            env, folder=folder, steps=steps, seed=seed, settings=sarsa.SarsaSettings(**changed), env_facts=facts
        )
    return time.process_time() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", choices=sorted(FIGURES))
    parser.add_argument("--out", type=Path, default=Path("paper-figures"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, help="default: an hour of robot time")
    parser.add_argument("--jobs", type=int, default=2)
    chosen = parser.parse_args()
    figure = FIGURES[chosen.figure]
    steps = chosen.steps or HOUR[figure.agent]
    work = [
        (chosen.out / "runs" / f"{figure.agent}-{name}-{seed}", seed, changed)
        for seed in range(chosen.seeds)
        for name, changed in figure.variants.items()
    ]
    times = Parallel(n_jobs=chosen.jobs, return_as="generator")(
        delayed(tied(train_one))(figure.agent, folder, steps, seed, changed) for folder, seed, changed in work
    )
    for (folder, _, _), seconds in zip(work, times, strict=True):
        print(f"{folder}: {seconds:.0f} s of processor time", flush=True)

    from openant_agents.curves import band, group_runs, plot_groups, read_run_curve

    curves = [read_run_curve(folder) for folder, _, _ in work]
    groups = group_runs(curves)
    picture = chosen.out / f"{chosen.figure}.png"
    plot_groups(groups, picture, singly=len(groups) == 1)
    asked = ASKED_M_S[figure.agent]
    print(f"{chosen.figure}: {figure.words}")
    for name, members in groups.items():
        reached = [
            next((p.seconds / 60 for p in curve.points if p.seconds >= 120 and p.average_reward_m_s > asked), None)
            for curve in members
        ]
        times_min = ", ".join("never" if minutes is None else f"{minutes:.0f} min" for minutes in reached)
        together = band(members)
        print(
            f"  {name}: {together.mean[-1]:+.1f} ± {3 * together.error[-1]:.1f} cm/s after {together.minutes[-1]:.0f} min;"
            f" above {100 * asked:.0f} cm/s: {sum(m is not None for m in reached)} of {len(members)} seeds ({times_min})"
        )
    print(f"wrote {picture}")


if __name__ == "__main__":
    main()
