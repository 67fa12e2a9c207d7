"""How long it takes to identify a whole robot, and in how much memory: python benchmarks/sysid_speed.py

A standard Ant on its stand, eight joints, eight runs of 10 s at 100 Hz and two that are held out, every kind of parameter
that a calibration fits by default. The robot that made the runs is simulated by another integrator and in smaller steps
than the fit uses, has values of its own in every joint, a noisy encoder of 4096 steps, and stamps that jitter.

Each fit runs in a process of its own, so that its peak memory is its own. With --lengths 1 4 the runs are also four times
as long: memory should not follow. Rollouts are counted in runs of the whole set by one variant of the model.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from openant_tools.model.plant import load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid.identify import identify
from openant_tools.sysid.protocols import CommandSpace, protocol

#: s; the whole fit on two cores
TARGET_S = 60.0
ROWS_HZ = 100.0
#: of the robot that makes the runs
STEP_S, NOISE_RAD, JITTER_S = 0.00025, 3e-4, 0.001
ENCODER_RAD = 2 * math.pi / 4096
FITTED = ("stand", "chirp", "multisine", "steps", "holds", "slow-reversals", "stand", "multisine")
HELD_OUT = ("stand", "multisine")


def robot(seed: int) -> mujoco.MjModel:
    """An Ant whose every joint differs from the nominal one, by about the tolerance of a build."""
    model = load_plant(nominal_model_path("standard")).model
    model.opt.timestep, model.opt.integrator = STEP_S, mujoco.mjtIntegrator.mjINT_IMPLICIT
    chance = np.random.default_rng(seed)
    for joint in JOINT_NAMES:
        i, dof, adr = model.actuator(joint).id, model.joint(joint).dofadr[0], model.joint(joint).qposadr[0]
        scale = math.exp(0.075 * chance.standard_normal())
        model.actuator_gainprm[i, 0] *= scale
        model.actuator_biasprm[i, 1:3] *= scale, math.exp(0.125 * chance.standard_normal())
        model.dof_damping[dof] *= math.exp(0.125 * chance.standard_normal())
        model.dof_armature[dof] *= math.exp(0.15 * chance.standard_normal())
        model.dof_frictionloss[dof] = 0.02 + 0.05 * chance.random()
        model.qpos0[adr] = 0.008 * chance.standard_normal()
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def record(model: mujoco.MjModel, name: str, motion: str, seconds: float, seed: int) -> Run:
    command = protocol(motion, seconds).commands(CommandSpace.around_home(), ROWS_HZ, seed)
    chance = np.random.default_rng(seed)
    t = np.arange(len(command)) / ROWS_HZ + chance.uniform(-JITTER_S, JITTER_S, len(command))
    joint = [int(model.joint(j).qposadr[0]) for j in JOINT_NAMES]
    control = [int(model.actuator(j).id) for j in JOINT_NAMES]
    data = mujoco.MjData(model)
    data.qpos[joint] = command[0]
    position = np.empty(command.shape)
    for k in range(len(t)):
        position[k] = data.qpos[joint]
        data.ctrl[control] = command[k]
        if k + 1 < len(t):
            steps = max(1, round((t[k + 1] - t[k]) / STEP_S))
            model.opt.timestep = (t[k + 1] - t[k]) / steps
            mujoco.mj_step(model, data, steps)
    position += NOISE_RAD * chance.standard_normal(position.shape)
    position = np.round(position / ENCODER_RAD) * ENCODER_RAD
    columns = {f"cmd.{j}": command[:, k] for k, j in enumerate(JOINT_NAMES)}
    columns |= {f"pos.{j}": position[:, k] for k, j in enumerate(JOINT_NAMES)}
    return Run(name, Facts(JOINT_NAMES, setup="stand", protocol=motion), t, columns)


class Meter:
    """Counts what rollouts do, from outside: simulation steps, and the time inside the batch's own loop."""

    def __init__(self) -> None:
        self.steps, self.inside_s, self.calls = 0, 0.0, 0
        rollout, call = Batch.rollout, Rollouts.__call__

        def timed(batch: Batch, nstep: int, *rest: Any, **options: Any) -> Any:
            began = time.perf_counter()
            try:
                return rollout(batch, nstep, *rest, **options)
            finally:
                ids = options.get("ids")
                self.steps += nstep * (batch.nsim if ids is None else len(ids))
                self.inside_s += time.perf_counter() - began

        def counted(rollouts: Rollouts, *rest: Any, **options: Any) -> Any:
            self.calls += 1
            return call(rollouts, *rest, **options)

        Batch.rollout = timed
        Rollouts.__call__ = counted  # type: ignore[method-assign, assignment]


def cpu_s() -> float:
    spent = resource.getrusage(resource.RUSAGE_SELF)
    return spent.ru_utime + spent.ru_stime


def fit_once(length: float, kinds: Sequence[str] | None) -> dict[str, Any]:
    """One fit, measured; in a process of its own."""
    ant = robot(0)
    runs = [record(ant, f"{m} {k}", m, 10.0 * length, k) for k, m in enumerate(FITTED)]
    held_out = [record(ant, f"held out {m}", m, 10.0 * length, 100 + k) for k, m in enumerate(HELD_OUT)]
    before_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    meter = Meter()
    wall, cpu = time.perf_counter(), cpu_s()
    progress = 0

    def tell(done: float, what: str) -> None:
        nonlocal progress
        progress += 1

    result = identify(runs, nominal_model_path("standard"), held_out, kinds=kinds, progress=tell)
    wall, cpu = time.perf_counter() - wall, cpu_s() - cpu
    one = sum(math.ceil(run.duration_s / load_plant(result.model).timestep) for run in runs)
    return {
        "length": length,
        "wall_s": wall,
        "cpu_s": cpu,
        "rollouts": meter.steps / one,
        "calls": meter.calls,
        "outside": 1 - meter.inside_s / wall,
        "parameters": len(result.values),
        "progress": progress,
        "before_mrad": 1e3 * result.before.full,
        "after_mrad": 1e3 * result.after.full,
        "floor_mrad": 1e3 * result.floor,
        "start_mib": before_mib,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lengths", type=float, nargs="+", default=[1.0], help="times 10 s")
    parser.add_argument("--kinds", nargs="+", help="of parameters; default all of a calibration")
    parser.add_argument("--child", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        print(json.dumps(fit_once(options.child, options.kinds)))
        return
    print("| runs | parameters | wall (s) | CPU (s) | rollouts of all runs | outside of `mj_step` | held-out error (mrad) "
          "| floor (mrad) | peak memory (MiB) | of it the fit's |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|")
    for length in options.lengths:
        command = [sys.executable, __file__, "--child", str(length)]
        command += ["--kinds", *options.kinds] if options.kinds else []
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        row = json.loads(done.stdout)
        print(
            f"| {len(FITTED)} × {10 * length:g} s | {row['parameters']} | {row['wall_s']:.0f} | {row['cpu_s']:.0f} "
            f"| {row['rollouts']:.0f} | {100 * row['outside']:.0f} % | {row['before_mrad']:.2f} → {row['after_mrad']:.2f} "
            f"| {row['floor_mrad']:.2f} | {row['peak_mib']:.0f} | {row['peak_mib'] - row['start_mib']:.0f} |",
            flush=True,
        )
    print(f"\n{os.cpu_count()} cores, {platform.machine()}, MuJoCo {mujoco.__version__}, load {os.getloadavg()[0]:.1f}. "
          f"Target: {TARGET_S:.0f} s of wall time on two idle cores, progress shown; memory that does not follow the runs.")  # fmt: skip


if __name__ == "__main__":
    main()
