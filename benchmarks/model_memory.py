"""Peak memory and time of `gap measure` and `sysid fit` on one arm with and without its looks: python benchmarks/model_memory.py

An arm of six joints, drawn by meshes as a CAD program exports them and standing on a textured floor, and the same arm of bare
capsules. Both move alike, since inertia is stated. Target: within 10 % of each other, and at most 0.5 GB.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np

from openant_tools.model.plant import load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import write_table

JOINTS = tuple(f"joint_{k}" for k in range(6))
#: of the targets: share of the bare arm's, and MB
WITHIN, MOST_MB = 1.10, 500.0
TEXTURE = (
    '<asset><texture name="floor" type="2d" builtin="checker" rgb1=".1 .2 .3" rgb2=".2 .3 .4" width="4096" height="4096"/>'
    '<material name="floor" texture="floor"/>{meshes}</asset>'
)


def lump(path: Path, rings: int, seed: int) -> None:
    """A dented ball of 4 × rings² triangles."""
    around = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    rough, n = np.random.default_rng(seed), 2 * rings
    with path.open("w", encoding="utf-8") as out:
        for up in np.linspace(0, np.pi, rings):
            for r, a in zip(0.02 * (1 + 0.05 * rough.random(n)), around, strict=True):
                x, y, z = r * np.sin(up) * np.cos(a), r * np.sin(up) * np.sin(a), 2 * r * np.cos(up) - 0.04
                out.write(f"v {x:.6f} {y:.6f} {z:.6f}\n")
        for ring in range(rings - 1):
            for k in range(n):
                a, b = ring * n + k + 1, ring * n + (k + 1) % n + 1
                out.write(f"f {a} {a + n} {b}\nf {b} {a + n} {b + n}\n")


def arm(folder: Path, rings: int) -> Path:
    """The MJCF of the arm in a folder, drawn by meshes of so many rings; bare with none."""
    meshes, opened = "", ""
    for k, joint in enumerate(JOINTS):
        geoms = '<geom type="capsule" fromto="0 0 0 0 0 -0.08" size="0.01" contype="0" conaffinity="0"/>'
        if rings:
            lump(folder / f"{joint}.obj", rings, k)
            meshes += f'<mesh name="{joint}" file="{joint}.obj"/>'
            geoms += f'<geom type="mesh" mesh="{joint}" contype="0" conaffinity="0" group="2"/>'
        opened += (
            f'<body pos="0 0 {-0.08 if k else 1}"><inertial pos="0 0 -0.04" mass="0.08" diaginertia="5e-5 5e-5 1e-5"/>'
            f'<joint name="{joint}" axis="{k % 2} {1 - k % 2} 0" damping="0.3" armature="0.01" frictionloss="0.03"/>{geoms}'
        )
    servos = "".join(f'<position name="{j}" joint="{j}" kp="8" forcerange="-4 4"/>' for j in JOINTS)
    look = TEXTURE.format(meshes=meshes) if rings else ""
    floor = f'<geom type="plane" size="1 1 0.1" {"material=" + chr(34) + "floor" + chr(34) if rings else ""}/>'
    path = folder / ("drawn.xml" if rings else "bare.xml")
    path.write_text(
        f'<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>{look}'
        f"<worldbody>{floor}{opened}{'</body>' * len(JOINTS)}</worldbody><actuator>{servos}</actuator></mujoco>",
        encoding="utf-8",
    )
    return path


def recorded(model: Path, seconds: float) -> Run:
    """What a robot with a tenth more stiffness does on sines of its joints."""
    t = np.arange(0.0, seconds, 0.01)
    columns = {}
    for k, joint in enumerate(JOINTS):
        columns[f"cmd.{joint}"] = 0.4 * np.sin(2 * np.pi * (0.3 + 0.11 * k) * t)
        columns[f"pos.{joint}"] = columns[f"cmd.{joint}"].copy()
    plant = load_plant(model, JOINTS)
    plant.model.actuator_gainprm[:, 0] *= 1.1
    plant.model.actuator_biasprm[:, 1] *= 1.1
    run = Run("run", Facts(JOINTS, setup="stand", resolution={"pos": 0.001534}), t, columns)
    pos = Rollouts(plant, [run])().pos[0]
    columns.update({f"pos.{joint}": np.round(pos[:, j] / 0.001534) * 0.001534 for j, joint in enumerate(JOINTS)})
    return run


def cost(*command: str) -> tuple[float, float]:
    """Peak memory of a command (MB) and its CPU time (s)."""
    process = subprocess.Popen(
        [sys.executable, "-m", "openant_tools.cli", *command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1):
        raise RuntimeError(f"{command} ended with {process.returncode}")
    return used.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3), used.ru_utime + used.ru_stime


def prepare(folder: Path, rings: int, seconds: float) -> None:
    bare, drawn = arm(folder, 0), arm(folder, rings)
    print(
        f"the drawn model as MuJoCo compiles it: {mujoco.mj_sizeModel(mujoco.MjModel.from_xml_path(str(drawn))) / 1e6:.0f} MB\n"
    )
    write_table(recorded(bare, seconds), folder / "run.csv")


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--rings", type=int, default=220, help="of each mesh: 4 × rings² triangles")
    parser.add_argument("--seconds", type=float, default=6.0, help="of the recording")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as made_in:
        folder = Path(made_in)
        # In a process of its own: what this one ever held counts as the peak of those that it starts.
        made = multiprocessing.get_context("spawn").Process(target=prepare, args=(folder, asked.rings, asked.seconds))
        made.start()
        made.join()
        run = str(folder / "run.csv")
        print("| command | bare | drawn | memory | CPU time |\n|---|---|---|---|---|")
        for words, rest in (
            (("gap", "measure"), ()),
            (("sysid", "fit"), ("--no-effects", "--out", str(folder / "fit"))),
        ):
            costs = [cost(*words, run, "--model", str(folder / f"{name}.xml"), *rest) for name in ("bare", "drawn")]
            (mb, cpu), (more_mb, more_cpu) = costs
            good = more_mb <= min(WITHIN * mb, MOST_MB) and more_cpu <= WITHIN * cpu
            print(
                f"| `{' '.join(words)}` | {mb:.0f} MB, {cpu:.1f} s | {more_mb:.0f} MB, {more_cpu:.1f} s "
                f"| × {more_mb / mb:.2f} | × {more_cpu / cpu:.2f} {'' if good else '(misses)'} |"
            )


if __name__ == "__main__":
    main()
