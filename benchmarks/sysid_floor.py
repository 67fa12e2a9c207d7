"""What a robot that scrubs tells of its floor: python benchmarks/sysid_floor.py [--robots 5]

Simulated Ants, each on a floor of its own (sliding friction and softness scattered by one deviation more than a build's), pull
their hips against each other for 8 s until feet slip. They are stepped four times as finely as the fit steps; only their
encoders are logged, and nobody tracks them. One run is fitted and another held out. Prints Markdown.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np

from openant_tools.recording.run import Facts, Run
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid.identify import identify
from openant_tools.sysid.protocols import CommandSpace, protocol

#: standard deviations of log(value)
SCATTER = {"floor_friction": 0.15, "contact_softness": 0.25}
STEP_S, ROWS_HZ, SECONDS = 0.0005, 100.0, 8.0
NOISE_RAD, ENCODER_RAD = 3e-4, 2 * math.pi / 4096
DROP_S = 2.0


def scrub(text: str, truth: dict[str, float], seed: int) -> Run:
    """What an Ant logs that scrubs on this floor."""
    robot = mujoco.MjModel.from_xml_string(text)
    robot.opt.timestep = STEP_S
    floor = robot.geom("floor").id
    robot.geom_friction[floor, 0], robot.geom_solref[floor, 0] = truth["floor_friction"], truth["contact_softness"]
    command = protocol("scrub", SECONDS).commands(CommandSpace.around_home(), ROWS_HZ, seed)
    data = mujoco.MjData(robot)
    address = [robot.joint(joint).qposadr[0] for joint in JOINT_NAMES]
    control = [robot.actuator(joint).id for joint in JOINT_NAMES]
    data.qpos[address] = data.ctrl[control] = command[0]
    data.qpos[2] = 0.25
    mujoco.mj_step(robot, data, round(DROP_S / STEP_S))
    position = np.empty(command.shape)
    for k, row in enumerate(command):
        position[k] = data.qpos[address]
        data.ctrl[control] = row
        mujoco.mj_step(robot, data, round(1 / ROWS_HZ / STEP_S))
    position += NOISE_RAD * np.random.default_rng(seed).standard_normal(position.shape)
    position = np.round(position / ENCODER_RAD) * ENCODER_RAD
    columns = {f"cmd.{joint}": command[:, j] for j, joint in enumerate(JOINT_NAMES)}
    columns |= {f"pos.{joint}": position[:, j] for j, joint in enumerate(JOINT_NAMES)}
    return Run(f"scrub {seed}", Facts(JOINT_NAMES, setup="floor"), np.arange(len(command)) / ROWS_HZ, columns)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=5)
    options = parser.parse_args()
    text = nominal_model_path("standard").read_text()
    print("| friction | found | 95 % | softness, ms | found | 95 % | held-out error, mrad | time, s |")
    print("|---|---|---|---|---|---|---|---|")
    with TemporaryDirectory() as folder:
        model = Path(folder) / "ant.xml"
        model.write_text(text.replace('timestep="0.001"', 'timestep="0.002"'))
        for seed in range(options.robots):
            chance = np.random.default_rng(seed)
            given = {"floor_friction": 0.6, "contact_softness": 0.02}
            truth = {kind: value * math.exp(SCATTER[kind] * chance.standard_normal()) for kind, value in given.items()}
            fitted, held_out = (scrub(text, truth, 2 * seed + k) for k in range(2))
            begun = time.monotonic()
            result = identify([fitted], model, [held_out], kinds=list(given))
            seconds = time.monotonic() - begun
            cells = []
            for value, scale in zip(result.values, (1.0, 1e3), strict=True):
                true = truth[value.name.partition(".")[0]]
                cells += [f"{scale * true:.3g}", f"{scale * value.value:.3g}"]
                cells += [
                    "–"
                    if value.low is None or value.high is None
                    else f"{scale * value.low:.3g} – {scale * value.high:.3g}"
                ]
            error = f"{1e3 * result.before.full:.2f} → {1e3 * result.after.full:.2f}"
            print(f"| {' | '.join(cells)} | {error} | {seconds:.0f} |", flush=True)


if __name__ == "__main__":
    main()
