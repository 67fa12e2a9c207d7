"""Simulation steps per second of `Rollouts` against a bare loop of `mj_step`: python benchmarks/rollout_speed.py

Both play the same commands from the same start on the same model. The bare loop runs on one thread and stays in C from
one command to the next (`mj_step(model, data, nstep)`): physics and nothing else. `Rollouts` does what a fit asks of it:
many variants of the model, positions and velocities at every row of the recording.

On one thread, time is the CPU time of that thread, which does not count what other programs take. On all cores it is wall
time: there the machine should be idle. All take turns in one run; the table gives medians of the ratios of neighbours.
Rates above 1 are no magic: a rollout leaves out what nobody reads (sensors, and contacts where no two parts come near each
other), and several simulations a call spare the start of each.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from openant_tools.model.gap import HORIZON_S
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid.protocols import CommandSpace, protocol

#: what `Rollouts` should reach of the bare loop, times the number of cores
TARGET = 0.9
#: rows and commands a second
ROWS_HZ, COMMANDS_HZ = 100.0, 20.0
SECONDS = 12.0
#: variants of the model in one call: a Jacobian of a small fit
VARIANTS = 8

PENDULUM = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="joint" axis="0 1 0" damping="0.1" armature="0.005" frictionloss="0.03"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.01" mass="0.05"/>
      <geom type="sphere" pos="0 0 -0.1" size="0.03" mass="0.4"/>
    </body>
  </worldbody>
  <actuator><position name="joint" joint="joint" kp="8" forcerange="-1.2 1.2"/></actuator>
</mujoco>
"""


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    name: str
    plant: Plant
    horizon: float | None


def recorded(plant: Plant) -> Run:
    """A run as a robot would have made it: the commands of the stand protocol and the positions they lead to."""
    joints = plant.joints
    if set(joints) == set(CommandSpace.around_home().joints):
        space = CommandSpace.around_home(joints=joints)
    else:
        n = len(joints)
        space = CommandSpace(joints, np.zeros(n), np.full(n, -0.8), np.full(n, 0.8))
    commands = protocol("stand", SECONDS).commands(space, COMMANDS_HZ)
    commands = np.repeat(commands, round(ROWS_HZ / COMMANDS_HZ), axis=0)
    t = np.arange(len(commands)) / ROWS_HZ
    columns = {f"cmd.{joint}": commands[:, j] for j, joint in enumerate(joints)}
    draft = Run("run", Facts(joints), t, columns | {f"pos.{joint}": commands[:, j] for j, joint in enumerate(joints)})
    position = Rollouts(plant, [draft])().pos[0]
    return Run("run", Facts(joints), t, columns | {f"pos.{joint}": position[:, j] for j, joint in enumerate(joints)})


class BareLoop:
    """The run's commands, played by `mj_step` alone."""

    def __init__(self, plant: Plant, run: Run) -> None:
        self.model, self.data = plant.model, mujoco.MjData(plant.model)
        rollouts = Rollouts(plant, [run])
        self.start = rollouts.segments[0].state
        self.nstep = round(1.0 / COMMANDS_HZ / plant.timestep)
        rows = slice(None, None, round(ROWS_HZ / COMMANDS_HZ))
        self.controls = np.zeros((len(run.t[rows]), plant.model.nu))
        self.controls[:, plant.ctrl] = run.signal("cmd", plant.joints)[rows]

    @property
    def steps(self) -> int:
        return self.nstep * len(self.controls)

    def __call__(self) -> None:
        model, data, nstep = self.model, self.data, self.nstep
        mujoco.mj_setState(model, data, self.start, mujoco.mjtState.mjSTATE_INTEGRATION)
        for control in self.controls:
            data.ctrl[:] = control
            mujoco.mj_step(model, data, nstep)


def rate(steps: int, work: Callable[[], object], clock: Callable[[], float]) -> float:
    began = clock()
    work()
    return steps / (clock() - began)


def measure(case: Case, rounds: int) -> list[str]:
    """The cells of the case's row."""
    run = recorded(case.plant)
    bare = BareLoop(case.plant, run)
    one = Rollouts(case.plant, [run], case.horizon, nthread=1)
    many = Rollouts(case.plant, [run], case.horizon)
    models = [case.plant.model] * VARIANTS
    steps = VARIANTS * one.steps
    for work in (bare, lambda: one(models), lambda: many(models)):
        work()
    cores = os.cpu_count() or 1
    figures = []
    for _ in range(rounds):
        alone = rate(bare.steps, bare, time.thread_time)
        single = rate(steps, lambda: one(models), time.thread_time)
        wall = rate(bare.steps, bare, time.perf_counter)
        together = rate(steps, lambda: many(models), time.perf_counter)
        figures.append((alone, single, together, single / alone, together / wall / cores))
    bare_rate, one_rate, all_rate, per_thread, per_core = (statistics.median(x) for x in zip(*figures, strict=True))
    horizon = "full run" if case.horizon is None else f"{case.horizon:g} s"
    rates = [f"{1e-3 * value:.0f}" for value in (bare_rate, one_rate, all_rate)]
    return [case.name, horizon, *rates, f"{per_thread:.2f}", f"{per_core:.2f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    ant = nominal_model_path("standard")
    with tempfile.TemporaryDirectory() as folder:
        pendulum = Path(folder) / "pendulum.xml"
        pendulum.write_text(PENDULUM)
        plants = {
            "pendulum": load_plant(pendulum),
            "Ant, stand": load_plant(ant),
            "Ant, floor": load_plant(ant, setup=Setup.FLOOR),
        }
    print("| model | re-initialised | bare `mj_step`, 1 thread | `Rollouts`, 1 thread | `Rollouts`, all cores "
          "| ratio, 1 thread | ratio per core |")  # fmt: skip
    print("|---|---|---|---|---|---|---|")
    for name, plant in plants.items():
        for horizon in (None, HORIZON_S):
            print(f"| {' | '.join(measure(Case(name, plant, horizon), rounds))} |", flush=True)
    print(f"\nThousands of steps a second; {os.cpu_count()} cores, {platform.machine()}, MuJoCo {mujoco.__version__}, "
          f"load {os.getloadavg()[0]:.1f}. Target: ratios of {TARGET} and more.")  # fmt: skip


if __name__ == "__main__":
    main()
