"""Make shards to learn from: one random experiment each, with what every cause does to it, healthy robots and ill ones.

    python -m benchmarks.gap_training.shards FOLDER --first 0 --count 100 [--jobs 2]

A shard is whole or not there, so that an interrupted command goes on where it was, on any number of machines that share the folder
(joblib's backends: Dask or Ray). About half a minute of one core and 10 MB each.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import joblib
import numpy as np

from benchmarks.gap_training.experiments import Experiment, experiment
from benchmarks.gap_training.rows import read_shard, refined_place
from openant_tools.arrays import write_arrays
from openant_tools.errors import BadInput
from openant_tools.files import json_text, write_text
from openant_tools.gap.ensemble import robots_at, templates_at, templates_of
from openant_tools.gap.population import Case, applicable, draw
from openant_tools.gap.refine import refined

#: robots of a shard: healthy ones that make the measure, and others that are learned from
MEASURE, HEALTHY, ILL = 72, 30, 110
#: of those some that are refined as a diagnosis would, healthy and ill ones
REFINED = 2, 6
#: robots that one batch simulates
BATCH = 53


def shard(seed: int, folder: Path) -> float:
    """Make one; how many seconds it took, 0 where it was there or where too little of its motion can be used."""
    place = folder / f"{seed:05d}.npz"
    if place.exists():
        return 0.0
    begun = time.monotonic()
    try:
        made = experiment(seed, folder)
    except BadInput:
        return 0.0
    write_shard(place, made, _cases(made, seed, MEASURE + HEALTHY, ILL), MEASURE)
    write_refined(folder, seed, made)
    return time.monotonic() - begun


def write_shard(place: Path, made: Experiment, cases: Sequence[Case], measure: int) -> None:
    """What every cause does to an experiment, and what these robots do; of them the first `measure` healthy ones make the measure."""
    protocol = made.protocol
    bank = templates_of(protocol)
    arrays = {f"templates{k}": _small(x) for k, x in enumerate(templates_at(protocol, bank))}
    parts = [robots_at(protocol, cases[n : n + BATCH], n) for n in range(0, len(cases), BATCH)]
    nominal = protocol.nominal()
    for k, one in enumerate(protocol.runs):
        arrays[f"robots{k}"] = _small(np.concatenate([part[k] for part in parts]))
        arrays[f"log{k}"] = one.features(nominal[k])[0]
        arrays[f"known{k}"] = one.layout.known(one.seen)
    facts = {
        "bank": [_stated(case) for case in bank],
        "cases": [_stated(case) for case in cases],
        "truth": _stated(made.truth),
        "measure": measure,
        "runs": [
            {
                "setup": str(one.plant.setup),
                "seconds": one.run.duration_s,
                "groups": one.layout.groups(),
                "joints": {signal: one.layout.joints_of(signal) for signal in one.layout.groups()},
            }
            for one in protocol.runs
        ],
        "reference": {
            name: np.asarray(getattr(protocol.reference, name)).tolist()
            for name in ("torque", "stiffness", "damping", "limit", "armature", "friction", "robot_kg")
        },
    }
    write_text(place.with_suffix(".json"), json_text(facts))
    write_arrays(place, arrays)


def write_refined(folder: Path, seed: int, made: Experiment) -> None:
    """What the likeliest causes of some of its robots do at the sizes that fit them best, as a diagnosis looks at it."""
    done, rng = read_shard(folder, seed), np.random.default_rng((31, seed))
    count = np.array([len(case.causes) for case in done.learned[: len(done.robots) - MEASURE]])
    some = [
        rng.choice(np.flatnonzero(kind), n, replace=False)
        for kind, n in ((count == 0, REFINED[0]), (count > 0, REFINED[1]))
    ]
    scale, stated, arrays = done.scale(done.known), {}, {}
    for robot in np.concatenate(some).tolist():
        cases, features = refined(
            scale, done.robots[MEASURE + robot],
            lambda cases: np.concatenate(templates_at(made.protocol, cases), axis=1),
        )  # fmt: skip
        stated[robot] = [_stated(case) for case in cases]
        arrays[f"robot{robot}"] = _small(features)
    place = refined_place(folder, seed)
    write_text(place.with_suffix(".json"), json_text(stated))
    write_arrays(place, arrays)


def _small(features: np.ndarray) -> np.ndarray:
    return features.astype(np.float16)


def _stated(case: Case) -> dict[str, list[object]]:
    return {name: [list(joints), x] for name, (joints, x) in case.causes.items()}


def _cases(made: Experiment, seed: int, healthy: int, ill: int) -> list[Case]:
    causes, k = applicable(made.protocol), 0
    out: dict[bool, list[Case]] = {True: [], False: []}
    while len(out[True]) < healthy or len(out[False]) < ill:
        case = draw(made.protocol, 100_000 * (seed + 1) + k, causes)
        out[not case.causes].append(case)
        k += 1
    return [*out[True][:healthy], *out[False][:ill]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    seeds = range(options.first, options.first + options.count)
    made = joblib.Parallel(n_jobs=options.jobs, return_as="generator")(
        joblib.delayed(shard)(seed, options.folder) for seed in seeds
    )
    for seed, seconds in zip(seeds, made, strict=True):
        print(json.dumps({"seed": seed, "seconds": round(seconds, 1)}), flush=True)


if __name__ == "__main__":
    main()
