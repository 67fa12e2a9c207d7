"""How much of a real servo each law of friction explains: two gains fitted, the third held out, each in turn.

Rungs: none, viscous, Coulomb, both, Stribeck, load-dependent, and that with more of it at rest; each with the nominal supply
and with the logged voltage. The last rung is what `sysid fit` chooses by itself, with its defaults: parameters, effects, supply.
The figure is the root mean square of measured minus simulated position over whole runs, pooled over the three gains held out;
beside it what the same law leaves of runs that it was fitted to. Of the gain that is held out the stiffness is the same share of
the given one as of those that were fitted. Finished fits are kept in --cache, so that an interrupted run goes on where it was.

    python benchmarks/friction_ladder.py ../shared/realdata/bam-xl330 [--rung load] [--cache FILE]
    python benchmarks/friction_ladder.py ../shared/realdata/bam-xl330 --motions [--rung load]

With --motions each gain is fitted by itself instead: each of its motions by what was fitted to its other motions alone, beside
the error of the model as it was given.

The folder holds run tables, and beside each the model of its gain that its facts name.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools import sysid
from openant_tools.files import write_text
from openant_tools.model.gap import gap
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run
from openant_tools.sysid.dataset import Dataset, gaps, sensor_floor
from openant_tools.sysid.identify import dataset_of
from openant_tools.sysid.parameter import KINDS, choose
from openant_tools.sysid.problem import Problem

#: what every rung fits: the servo's own numbers, and that its back-EMF ends with the torque
SERVO = ("stiffness", "armature", "zero_offset", "electrical_damping")
#: s; laws that act between steps take time by the step, and at 2 ms rms errors differ from those at 1 ms by under 1 %
STEP_S = 0.002
RUNGS = {
    "none": (),
    "viscous": ("damping",),
    "Coulomb": ("coulomb_friction",),
    "both": ("damping", "coulomb_friction"),
    "Stribeck": ("damping", "coulomb_friction", "stribeck_friction_static_nm", "stribeck_friction_velocity_rad_s"),
    "load": ("damping", "coulomb_friction", "load_friction"),
    "load, at rest": ("damping", "coulomb_friction", "load_friction", "load_friction_at_rest"),
}
#: the last rung
CHOSEN = "what the fit chooses"


def by_model(runs: Sequence[Run], *, volts: bool) -> dict[Path, Dataset]:
    """One dataset for each model that the runs name."""
    groups: dict[Path, list[Run]] = {}
    for run in runs:
        assert run.model_path is not None, f"{run.name} names no model"
        groups.setdefault(run.model_path, []).append(run)
    datasets = {}
    for path, members in sorted(groups.items()):
        plant = load_plant(path, None, Setup.STAND, electrical=True)
        plant.model.opt.timestep = max(STEP_S, plant.timestep)
        datasets[path] = Dataset.prepare(plant, members, measured_supply=volts)
    return datasets


def fit(datasets: Sequence[Dataset], kinds: Sequence[str], start: dict[str, float]) -> dict[str, float]:
    """Each kind's number in prior deviations, fitted to these datasets from a first guess."""
    parameters = choose(datasets[0].plant, [kind for kind in KINDS if kind in (*SERVO, *kinds)])
    runs = [run for data in datasets for run in data.runs]
    floor = np.maximum(sensor_floor(runs, datasets[0].plant.joints), 1e-6)
    problem = Problem(datasets, parameters, floor, tempered=True)
    first = np.array([start.get(p.kind, c) for p, c in zip(parameters, problem.centre, strict=True)])
    found = problem.solve(first if start else None)
    return {p.kind: float(u) for p, u in zip(parameters, found.u, strict=True)}


def error(datasets: Sequence[Dataset], kinds: Sequence[str], u: dict[str, float]) -> float:
    """rad, full runs."""
    parameters = choose(datasets[0].plant, [kind for kind in KINDS if kind in (*SERVO, *kinds)])
    return float(gaps(datasets, parameters, [np.array([u[p.kind] for p in parameters])])[0].full)


def chosen(fitted: Sequence[Run], judged: Sequence[Run]) -> dict[str, Any]:
    """What `sysid fit` makes of runs, and its error (rad, full runs) on others, which may be of a gain that it has not seen."""
    found = sysid.fit(fitted)
    best = found.with_effects or found
    u = dict(zip(best.parameters, best.u.tolist(), strict=True))
    shares: dict[str, list[float]] = defaultdict(list)
    for parameter, value in u.items():
        if parameter.model is not None:
            shares[parameter.kind].append(value)
    for path in {run.model_path.resolve() for run in judged if run.model_path} - set(best.models):
        alike = {parameter.kind: parameter for parameter in u if parameter.model is not None}
        u |= {replace(alike[kind], model=path): float(np.mean(values)) for kind, values in shares.items()}
    sets = [dataset_of(best, run) for run in judged]
    left = gaps(sets, list(u), [np.array(list(u.values()))])[0].full
    values = {value.name: [value.value, value.words] for value in best.values}
    return {"values": values, "effects": best is not found, "supply": best.datasets[0].measured_supply, "error": left}


def by_motion(runs: Sequence[Run], rung: str, volts: bool, cache: dict[str, Any], file: Path) -> None:
    """Each motion of each gain, fitted to the others of that gain: a row of errors over the given model's."""
    models: dict[Path, list[Run]] = {}
    for run in runs:
        assert run.model_path is not None
        models.setdefault(run.model_path, []).append(run)
    cells, samples, squares = [], [], []
    for path, members in sorted(models.items()):
        for held in members:
            key = f"{rung}, {'logged' if volts else 'nominal'}, {held.name}"
            shown = list(by_model([held], volts=volts).values())
            if key not in cache:
                others = by_model([run for run in members if run is not held], volts=volts)
                u = fit(list(others.values()), RUNGS[rung], {})
                cache[key] = {"u": u, "error": error(shown, RUNGS[rung], u)}
                write_text(file, json.dumps(cache, indent=1) + "\n")
            plant = load_plant(path)
            given = gap(held.signal("pos", plant.joints), Rollouts(plant, [held])().pos[0])
            found = cache[key]["error"]
            cells.append(f"{found / given:.2f}")
            samples.append(int(np.isfinite(shown[0].measured).sum()))
            squares.append((given**2, found**2))
    before, after = np.sqrt(np.average(squares, axis=0, weights=samples))
    supply = "logged" if volts else "nominal"
    row = " | ".join([*cells, f"{before:.4f} → {after:.4f}", f"{after / before:.2f}"])
    print(f"| {rung} | {supply} | {row} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rung", action="append", choices=[*RUNGS, CHOSEN])
    parser.add_argument("--cache", type=Path, default=Path("friction_ladder.json"))
    parser.add_argument("--motions", action="store_true", help="one gain at a time, each motion held out")
    options = parser.parse_args()
    runs = [read_run(path) for path in sorted(options.folder.glob("*.parquet"))]
    cache = json.loads(options.cache.read_text()) if options.cache.exists() else {}

    if options.motions:
        names = [run.name for path in sorted({str(run.model_path) for run in runs}) for run in runs
                 if str(run.model_path) == path]  # fmt: skip
        print(f"| rung | supply | {' | '.join(names)} | pooled, rad | ratio |")
        print("|---|---|" + "---|" * (len(names) + 2))
        for rung in [rung for rung in options.rung or RUNGS if rung in RUNGS]:
            for volts in (False, True):
                by_motion(runs, rung, volts, cache, options.cache)
        return
    gains = list(by_model(runs, volts=False))
    print(f"| rung | supply | fitted to all | {' | '.join(path.stem for path in gains)} | held out |")
    print("|---|---|---|" + "---|" * (len(gains) + 1))

    def row(rung: str, supply: str, errors: Sequence[float]) -> None:
        """`errors`: fitted to all, then each gain held out."""
        samples = [sum(int(np.isfinite(run.signal("pos", run.joints)).sum()) for run in runs if run.model_path == path)
                   for path in gains]  # fmt: skip
        pooled = math.sqrt(float(np.average(np.square(errors[1:]), weights=samples)))
        cells = " | ".join(f"{value:.4f}" for value in (*errors, pooled))
        print(f"| {rung} | {supply} | {cells} |", flush=True)

    for rung in options.rung or (*RUNGS, CHOSEN):
        if rung == CHOSEN:
            for held in (*gains, None):
                key = f"{rung}, {held.stem if held else 'all'}"
                if key not in cache:
                    fitted = [run for run in runs if run.model_path != held]
                    cache[key] = chosen(fitted, [run for run in runs if held in (None, run.model_path)])
                    write_text(options.cache, json.dumps(cache, indent=1) + "\n")
            row(rung, "its own", [cache[f"{rung}, {held.stem if held else 'all'}"]["error"] for held in (None, *gains)])
            continue
        for volts in (False, True):
            sets = by_model(runs, volts=volts)
            errors = []
            for held in (None, *sets):
                key = f"{rung}, {'logged' if volts else 'nominal'}, {held.stem if held else 'all'}"
                if key not in cache:
                    train = [data for path, data in sets.items() if path != held]
                    # From where the rung below ended: the servo's own numbers change little.
                    below = [k for k in cache if k.endswith(key.partition(", ")[2])]
                    start = cache[below[-1]]["u"] if below else {}
                    u = fit(train, RUNGS[rung], start)
                    judged = list(sets.values()) if held is None else [sets[held]]
                    cache[key] = {"u": u, "error": error(judged, RUNGS[rung], u)}
                    write_text(options.cache, json.dumps(cache, indent=1) + "\n")
                errors.append(cache[key]["error"])
            row(rung, "logged" if volts else "nominal", errors)


if __name__ == "__main__":
    main()
