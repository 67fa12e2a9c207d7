"""Do 95 % intervals hold the truth? Fits of virtual robots whose values are known: python benchmarks/sysid_truth.py

Robots are one-joint pendulums and two-joint legs on servos; every third is a leg on a hip whose axis is vertical, so that nothing
shows that joint's zero. Each draws its values around the given model's, with a scatter of its own between half of the tolerance
of a build and twice it, a noisy encoder of 4096 steps, stamps that jitter, and a sampling moment that its stamps do not tell. It
is simulated by another integrator and in steps eight times as fine as the fit's. Each is fitted on one run and judged on
another. With --wrong-priors every zero lies 0.2 rad away from the given one besides, and every gain is 40 % greater or less.

Fits already in --out are not made again, so that a run can be stopped and gone on with. Prints Markdown: for each kind of
parameter what it was called; of what was called identified, weak or (against the prior) in conflict how many intervals hold the
truth, with the 95 % interval of that share after Clopper and Pearson, and the mean error in standard deviations.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from openant_tools.errors import BadInput
from openant_tools.recording.run import Facts, Run
from openant_tools.sysid.identify import identify
from openant_tools.workers import end_with

Array = NDArray[np.float64]

#: share of intervals that must hold the truth
TARGET = (0.93, 0.98)
ENCODER_RAD = 2 * math.pi / 4096
ROWS_HZ, FITTED_S, JUDGED_S = 100.0, 5.0, 3.0
#: steps of the fit's model (as the nominal Ant's) and of the robot, s
STEP_S, TRUE_STEP_S = 0.001, 0.000125
#: half tolerance of a build (effects.md), as log(value)
HALF_TOLERANCE = {"stiffness": 0.075, "damping": 0.125, "armature": 0.15}
GIVEN = {"stiffness": 8.0, "damping": 0.12, "armature": 0.006, "coulomb_friction": 0.03}
#: robots of which a third has no more delay than the row's own
NOISE_RAD, JITTER_S = (1e-4, 6e-4), 1e-3
LONGEST_DELAY_S, ZERO_STD_RAD, SAMPLING_STD_S = 0.025, math.radians(0.5), 0.001
#: how far off priors are that are wrong: a zero, rad, and a gain, as log(value)
WRONG_ZERO_RAD, WRONG_GAIN = 0.2, math.log(1.4)
#: what is said to be known
KNOWN = ("identified", "weak", "conflict")

PENDULUM = """
<body name="arm">
  <joint name="a" axis="0 1 0" {servo}/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.01" mass="0.02"/>
  <geom type="sphere" pos="0 0 -0.1" size="0.04" mass="0.3"/>
</body>"""
LEG = """
<body name="upper">
  <joint name="a" axis="{axis}" {servo}/>
  <geom type="capsule" fromto="0 0 0 0 0.06 -0.06" size="0.015" mass="0.12"/>
  <body name="lower" pos="0 0.06 -0.06">
    <joint name="b" axis="0 1 0" {servo}/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.12" size="0.012" mass="0.1"/>
  </body>
</body>"""
FRAME = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{step}" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>{body}</worldbody>
  <actuator>{servos}</actuator>
</mujoco>"""
ROBOTS = {
    "pendulum": (PENDULUM, ("a",)),
    "leg": (LEG.replace("{axis}", "1 0 0"), ("a", "b")),
    "leg on a hip": (LEG.replace("{axis}", "0 0 1"), ("a", "b")),
}


def given_model(kind: str) -> str:
    body, joints = ROBOTS[kind]
    servo = 'damping="{damping}" armature="{armature}" frictionloss="{coulomb_friction}"'.format(**GIVEN)
    servos = "".join(
        f'<position name="{j}" joint="{j}" kp="{GIVEN["stiffness"]}" forcerange="-1.5 1.5"/>' for j in joints
    )
    return FRAME.format(step=STEP_S, body=body.format(servo=servo), servos=servos)


def draw(joints: Sequence[str], chance: np.random.Generator, wrong_priors: bool) -> dict[str, dict[str, float]]:
    """kind → joint → true value."""
    truth: dict[str, dict[str, float]] = defaultdict(dict)
    scatter = chance.uniform(0.5, 2.0)
    delay = chance.uniform(0.0, LONGEST_DELAY_S) if chance.random() < 2 / 3 else 0.0
    for joint in joints:
        for kind, half in HALF_TOLERANCE.items():
            truth[kind][joint] = GIVEN[kind] * math.exp(scatter * half * chance.standard_normal())
        truth["coulomb_friction"][joint] = chance.uniform(0.0, 0.12)
        truth["zero_offset"][joint] = scatter * ZERO_STD_RAD * chance.standard_normal()
        truth["action_delay"][joint] = delay
        if wrong_priors:
            truth["stiffness"][joint] *= math.exp(WRONG_GAIN * chance.choice([-1, 1]))
            truth["zero_offset"][joint] += WRONG_ZERO_RAD * chance.choice([-1, 1])
    return truth


def commands(t: Array, joints: int, chance: np.random.Generator) -> Array:
    """A chirp, steps and a slow triangle, other ones for each joint and seed, (n, joints) rad."""
    s = (t - t[0]) / (t[-1] - t[0])
    seconds = float(t[-1] - t[0])
    out = np.zeros((len(t), joints))
    for j in range(joints):
        low, high = chance.uniform(0.2, 0.4), chance.uniform(2.0, 3.0)
        u = np.clip(s / 0.4, 0, 1)
        chirp = np.sin(2 * math.pi * low * 0.4 * seconds * ((high / low) ** u - 1) / math.log(high / low))
        levels = chance.uniform(-1, 1, 99)
        steps = levels[(np.maximum(s - 0.4, 0) * seconds / chance.uniform(0.3, 0.5)).astype(int)]
        triangle = 0.4 * (2 * np.abs(2 * ((s * chance.uniform(4, 6)) % 1) - 1) - 1)
        shape = np.where(s < 0.4, chirp * np.clip((0.4 - s) / 0.03, 0, 1), np.where(s < 0.75, steps, triangle))
        out[:, j] = chance.uniform(0.4, 0.7) * shape * np.clip(s / 0.03, 0, 1)
    return out


def record(model: mujoco.MjModel, truth: Mapping[str, Mapping[str, float]], seconds: float, seed: Sequence[int]) -> Run:
    """What the bus logs of this robot."""
    chance = np.random.default_rng(seed)
    joints = tuple(truth["stiffness"])
    for joint in joints:
        i, dof, adr = model.actuator(joint).id, model.joint(joint).dofadr[0], model.joint(joint).qposadr[0]
        model.actuator_gainprm[i, 0], model.actuator_biasprm[i, 1] = (
            truth["stiffness"][joint],
            -truth["stiffness"][joint],
        )
        model.dof_damping[dof], model.dof_armature[dof] = truth["damping"][joint], truth["armature"][joint]
        model.dof_frictionloss[dof], model.qpos0[adr] = truth["coulomb_friction"][joint], truth["zero_offset"][joint]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    t = 3.0 + np.arange(round(seconds * ROWS_HZ)) / ROWS_HZ
    command = commands(t, len(joints), chance)
    acting = t + next(iter(truth["action_delay"].values()))
    # When positions are sampled is the robot's own, the same in all of its runs; a stamp has jitter besides.
    late = np.random.default_rng(seed[:1]).normal(0.0, SAMPLING_STD_S)
    sampled = t + late + 2 * SAMPLING_STD_S
    acting = acting + 2 * SAMPLING_STD_S
    events = np.unique(np.concatenate([acting, sampled]))
    place = {at: k for k, at in enumerate(sampled)}
    data = mujoco.MjData(model)
    control = [int(model.actuator(joint).id) for joint in joints]
    address = [int(model.joint(joint).qposadr[0]) for joint in joints]
    data.qpos[address], data.ctrl[control] = command[0], command[0]
    position = np.empty(command.shape)
    for k, at in enumerate(events):
        if at in place:
            position[place[at]] = data.qpos[address]
        in_force = max(0, int(np.searchsorted(acting, at + 1e-9, side="right")) - 1)
        data.ctrl[control] = command[in_force]
        if k + 1 < len(events):
            steps = math.ceil((events[k + 1] - at) / TRUE_STEP_S - 1e-9)
            model.opt.timestep = (events[k + 1] - at) / steps
            mujoco.mj_step(model, data, steps)
    noise, jitter = chance.uniform(*NOISE_RAD), chance.uniform(0.0, JITTER_S)
    position = np.round((position + noise * chance.standard_normal(position.shape)) / ENCODER_RAD) * ENCODER_RAD
    stamps = t + chance.uniform(-jitter, jitter, len(t))
    columns = {f"cmd.{j}": command[:, k] for k, j in enumerate(joints)}
    columns |= {f"pos.{j}": position[:, k] for k, j in enumerate(joints)}
    return Run("run", Facts(joints, setup="stand", resolution={"pos": ENCODER_RAD}), stamps, columns)


def fit(seed: int, wrong_priors: bool) -> list[dict[str, Any]]:
    """What one robot's fit says of each of its values, and what is true."""
    chance = np.random.default_rng(seed)
    kind = tuple(ROBOTS)[seed % len(ROBOTS)]
    truth = draw(ROBOTS[kind][1], chance, wrong_priors)
    said: dict[str, Any] = {"seed": seed, "wrong_priors": wrong_priors, "robot": kind}
    text = given_model(kind)

    def robot() -> mujoco.MjModel:
        model = mujoco.MjModel.from_xml_string(text)
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICIT
        return model

    runs = [record(robot(), truth, seconds, (seed, k)) for k, seconds in enumerate((FITTED_S, JUDGED_S))]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        path.write_text(text)
        began = time.perf_counter()
        try:
            result = identify(runs[:1], path, runs[1:])
        except BadInput as error:
            return [{**said, "refused": str(error)}]
        seconds = time.perf_counter() - began
    rows = []
    for value in result.values:
        name, _, joint = value.name.partition(".")
        rows.append(
            {
                **said,
                "kind": name,
                "joint": joint,
                "truth": truth[name][joint],
                "value": value.value,
                "low": value.low,
                "high": value.high,
                "verdict": value.verdict,
                "seconds": seconds,
                "torn": value.halves is not None,
            }
        )
    return rows


def held(hits: int, of: int) -> str:
    low = float(beta.ppf(0.025, hits, of - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.975, hits + 1, of - hits)) if hits < of else 1.0
    return f"{100 * hits / of:.1f} % | {100 * low:.1f} … {100 * high:.1f} %"


def table(rows: Sequence[dict[str, Any]], fits: int) -> str:
    lines = ["| parameter | of | identified | weak | conflict | not in the data | tied, fell back | hold the truth "
             "| 95 % interval of that | mean error (σ) |", f"|{'---|' * 10}"]  # fmt: skip
    for kind in [*dict.fromkeys(row["kind"] for row in rows), "all"]:
        mine = [row for row in rows if kind in (row["kind"], "all")]
        words = [row["verdict"] for row in mine]
        counts = [words.count(word) for word in (*KNOWN, "not in the data")]
        cells = [kind if kind == "all" else f"`{kind}`", len(mine), *counts, len(mine) - sum(counts)]
        told = [row for row in mine if row["verdict"] in KNOWN]
        if told:
            hits = sum(row["low"] - 1e-12 <= row["truth"] <= row["high"] + 1e-12 for row in told)
            errors = [(row["value"] - row["truth"]) / max((row["high"] - row["low"]) / 3.92, 1e-12) for row in told]
            spread = 2 * float(np.std(errors)) / math.sqrt(len(errors))
            cells += [held(hits, len(told)), f"{float(np.mean(errors)):+.2f} ± {spread:.2f}"]
        else:
            cells += ["– | –", "–"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    torn = sum(row["torn"] for row in rows)
    seconds = np.median([row["seconds"] for row in rows])
    lines.append(f"\n{fits} fits, {seconds:.1f} s each (median); {torn} of {len(rows)} values with halves that contradict "
                 f"each other. Target: {100 * TARGET[0]:.0f} to {100 * TARGET[1]:.0f} %.")  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=240)
    parser.add_argument("--first", type=int, default=0, help="seed of the first robot")
    parser.add_argument("--wrong-priors", action="store_true")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--seconds", type=float, default=math.inf, help="stop after so long; go on by running again")
    parser.add_argument("--out", type=Path, default=Path("/tmp/sysid_truth.jsonl"))
    options = parser.parse_args()
    rows = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    rows = [row for row in rows if row["wrong_priors"] == options.wrong_priors]
    done = {row["seed"] for row in rows}
    wanted = range(options.first, options.first + options.fits)
    began = time.monotonic()
    left = [seed for seed in wanted if seed not in done]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, context, end_with, (os.getpid(),)) as pool, options.out.open("a") as file:
        running = {pool.submit(fit, seed, options.wrong_priors) for seed in left}
        for k, one in enumerate(as_completed(running)):
            if one.cancelled():
                continue
            file.writelines(json.dumps(row) + "\n" for row in one.result())
            file.flush()
            rows += one.result()
            if time.monotonic() - began > options.seconds:
                for other in running:
                    other.cancel()
            if k % 10 == 9:
                print(f"{k + 1} of {len(left)}, {time.monotonic() - began:.0f} s", file=sys.stderr)
    rows = [row for row in rows if row["seed"] in wanted]
    refused = [row for row in rows if "refused" in row]
    for row in refused:
        print(f"robot {row['seed']}: {row['refused']}", file=sys.stderr)
    print(table([row for row in rows if "refused" not in row], len({row["seed"] for row in rows})))


if __name__ == "__main__":
    main()
