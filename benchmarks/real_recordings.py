"""Identification on real recordings of other people's servos: each motion in turn, by what was fitted to the others.

    python benchmarks/real_recordings.py [--shared ../shared/realdata] [--only bam-xl330|sage-so101] [--no-effects] [--cache FILE]

Prints Markdown: the error of the model as given on a motion that no fit saw, root mean square of position over the full run,
and what share of it a fit leaves. `plain` is our best model for plain MuJoCo and `with effects` the best that we find (the plain
one where no effect pays): neither fitted nor chosen by that motion. `--hold-out` is what stays of that one where the motion judges
it, which may only send all of it back: the given model unless it is better at 0.5 s and over the full run. `foretold` is what the
fit itself says of its best, by motions left out of it in turn. `pooled` is the root of summed squares over the root of summed
squares, motion by motion.

For the XL330 a peer runs beside ours, the *quick fit* that a user would write: seven numbers of one servo in plain MuJoCo, with
weak priors, by Nelder–Mead on the full-run error; of five starts the one that fits best. It sees and is judged by the same
runs.

Finished cells are kept in --cache, so that an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from openant_tools import sysid
from openant_tools.files import write_text
from openant_tools.model.gap import gap
from openant_tools.model.plant import Plant, load_plant
from openant_tools.model.rollout import Rollouts

#: A Feetech STS3215 of an SO-101 about an axis without gravity. Stiffness and damping: BAM's M1 figures of this servo at its
#: default gain of 32 and 7.4 V, halved for the gain of 16 in the log; what it turns (kg·m²) is a guess that a fit may book
#: in the armature.
TURNED_KG_M2 = {"Rotation": 0.02, "Wrist_Roll": 0.001}
SO101 = """
<mujoco model="so101_{joint}">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 0" mass="0.5" diaginertia="{turned} {turned} {turned}"/>
      <joint name="{joint}" type="hinge" axis="0 0 1" armature="0.028" damping="0.61"/>
    </body>
  </worldbody>
  <actuator>
    <position name="{joint}" joint="{joint}" kp="8.65" forcerange="-2.9 2.9"/>
  </actuator>
</mujoco>
"""

#: rad; less is no motion
MOVES_RAD = 0.05

#: the quick fit's unknowns, where each starts and the deviation of its prior: shares of the given stiffness and torque limit,
#: velocity gain and damping (N·m·s/rad), dry friction (N·m), armature (kg·m²), zero (rad)
START = np.array([1.0, 1.0, 0.0344, 0.002, 0.05, 0.0017, 0.0])
DEVIATION = np.array([0.15, 0.2, 0.01, 0.01, 0.03, 0.0005, 0.01])
#: what its errors weigh against its priors: a deviation in rad, and a factor; its simulations from each start, and its starts
ERROR_RAD, PRIOR, SIMULATIONS, STARTS = 0.08, 0.005, 260, 5

Array = NDArray[np.float64]


def quick_model(plant: Plant, u: Array) -> mujoco.MjModel:
    """The given model with the quick fit's numbers, u deviations from where they start."""
    stiffness, torque, velocity_gain, damping, friction, armature, zero = START + DEVIATION * u
    model = copy.copy(plant.model)
    model.actuator_gainprm[0, 0] *= abs(stiffness)
    model.actuator_biasprm[0, 1] *= abs(stiffness)
    model.actuator_biasprm[0, 2] = -max(velocity_gain, 0.0)
    model.actuator_forcerange[0] *= abs(torque)
    model.dof_damping[0], model.dof_frictionloss[0] = max(damping, 0.0), max(friction, 0.0)
    model.dof_armature[0], model.qpos0[0] = abs(armature), zero
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def quick_fit(plant: Plant, runs: Sequence[sysid.Run]) -> mujoco.MjModel:
    """The model that the quick fit ends with."""
    rollouts = [Rollouts(plant, [run], nthread=1) for run in runs]
    measured = [run.signal("pos", plant.joints) for run in runs]

    def cost(u: Array) -> float:
        model = [quick_model(plant, u)]
        errors = [gap(told, one(model).pos[0]) for told, one in zip(measured, rollouts, strict=True)]
        return float(np.square(errors).sum()) / ERROR_RAD**2 + PRIOR * float(u @ u)

    ends = []
    for seed in range(STARTS):
        start = 0.3 * np.random.default_rng(seed).normal(size=len(START)) if seed else np.zeros(len(START))
        simplex = start + np.vstack([np.zeros(len(START)), np.eye(len(START))])
        options = {"maxfev": SIMULATIONS, "initial_simplex": simplex}
        ends.append(minimize(cost, start, method="Nelder-Mead", options=options))
    return quick_model(plant, min(ends, key=lambda end: float(end.fun)).x)


def fill(
    cell: dict[str, Any],
    columns: Sequence[str],
    held: sysid.Run,
    others: Sequence[sysid.Run],
    model: Path,
    joints: Sequence[str] | None,
    also: Sequence[str],
) -> None:
    """What is missing of the errors (rad) on one motion of the given model and of what was fitted to the others."""
    given = sysid.judge(held, model, joints=joints)
    cell["given"] = given.gap.full
    if "quick fit" in columns and "quick fit" not in cell:
        plant, shown = load_plant(model, joints), given.runs[0]
        quick = quick_fit(plant, sysid.judge(others, model, joints=joints).runs)
        cell["quick fit"] = gap(shown.signal("pos", plant.joints), Rollouts(plant, [shown])([quick]).pos[0])
    if "plain" not in cell:
        found = sysid.fit(others, model, joints=joints, also=also, beyond_mujoco="with effects" in columns)
        best = found.with_effects or found
        plain, richer = (sysid.judge(held, one).gap for one in (found, best))
        stays = richer.horizon < given.gap.horizon and richer.full < given.gap.full
        cell |= {"plain": plain.full, "with effects": richer.full, "--hold-out": (richer if stays else given.gap).full}
        cell["foretold"] = given.gap.full * best.after.full / best.before.full
        cell["accepted"] = list(dict.fromkeys(name.partition(".")[0] for name in best.accepted))
        cell["supply"] = best.datasets[0].measured_supply


def table(
    title: str,
    groups: dict[Path, list[sysid.Run]],
    cache: Path,
    joints: Sequence[str] | None = None,
    also: Sequence[str] = (),
    peer: bool = False,
    effects: bool = True,
) -> None:
    kept = json.loads(cache.read_text()) if cache.exists() else {}
    columns = ["plain", *(["with effects"] if peer and effects else []), "--hold-out", "foretold"]
    columns = [*(["quick fit"] if peer else []), *columns]
    print(f"\n### {title}\n\n| held out | given, rad | {' | '.join(columns)} | accepted |")
    print(f"|---|---|{'---|' * len(columns)}---|")

    def row(name: str, cells: Sequence[dict[str, Any]], accepted: str = "") -> None:
        given, *left = (math.sqrt(sum(one[column] ** 2 for one in cells)) for column in ("given", *columns))
        shares = " | ".join(f"{one / given:.2f}" for one in left)
        print(f"| {name} | {given / math.sqrt(len(cells)):.4f} | {shares} | {accepted} |", flush=True)

    everything = []
    for model, runs in groups.items():
        cells = []
        for held in runs:
            key = f"{title}: {held.name}"
            if not {*columns} <= {*kept.setdefault(key, {})}:
                begun = time.monotonic()
                fill(kept[key], columns, held, [run for run in runs if run is not held], model, joints, also)
                write_text(cache, json.dumps(kept, indent=1) + "\n")
                print(f"{held.name}: {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
            cells.append(kept[key])
            row(held.name, cells[-1:], ", ".join(kept[key]["accepted"]) or "nothing")
        if len(groups) > 1:
            row(f"*pooled: {model.stem}*", cells)
        everything += cells
    row("*pooled*", everything)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "realdata")
    parser.add_argument("--only", choices=["bam-xl330", "sage-so101"])
    parser.add_argument("--joint", action="append", choices=list(TURNED_KG_M2), help="of sage-so101; default both")
    parser.add_argument("--no-effects", action="store_true", help="plain MuJoCo alone: a quarter of a minute a cell")
    parser.add_argument("--work", type=Path, default=Path("/tmp/real_recordings"))
    parser.add_argument("--cache", type=Path, default=Path("real_recordings.json"))
    options = parser.parse_args()
    if not options.shared.is_dir():
        parser.error(f"no recordings in {options.shared}")
    if options.only != "sage-so101":
        groups: dict[Path, list[sysid.Run]] = defaultdict(list)
        for path in sorted((options.shared / "bam-xl330").glob("*.parquet")):
            run = sysid.load(path)
            assert run.model_path is not None
            groups[run.model_path].append(run)
        title = "bam-xl330, plain" if options.no_effects else "bam-xl330"
        table(title, groups, options.cache, peer=True, effects=not options.no_effects)
    if options.only != "bam-xl330":
        recorded = [sysid.load(path) for path in sorted((options.shared / "sage-so101").glob("*.parquet"))]
        for words, also in (("delay", []), ("delay and lag", ["actuator_lag"])):
            for joint in options.joint or TURNED_KG_M2:
                turned = TURNED_KG_M2[joint]
                model = options.work / f"so101_{joint}.xml"
                model.parent.mkdir(parents=True, exist_ok=True)
                model.write_text(SO101.format(joint=joint, turned=turned).strip())
                # Where the joint is not commanded to move there is nothing to identify.
                runs = [run for run in recorded if np.ptp(run.column(f"cmd.{joint}")) > MOVES_RAD]
                table(f"sage-so101, joint {joint}, {words}", {model: runs}, options.cache, [joint], also)


if __name__ == "__main__":
    main()
