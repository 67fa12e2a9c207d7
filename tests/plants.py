"""Models of small robots as strings, and what each kind of robot would record when it is driven."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from plain import actuator_of

from openant_tools.recording.run import Facts, Run

Array = NDArray[np.float64]

#: 4096 positions a turn
ENCODER_RAD = 2 * np.pi / 4096

SERVO = 'name="joint" joint="joint"'
#: options of a model that a fit simulates a thousand times: as large steps as the pendulum's own dynamics allow
COARSE = 'timestep="0.002" integrator="implicitfast"'


#: of the world: what falls below the pendulum would land on it; on a stand nothing does
BENCH = '<geom name="bench" type="plane" size="1 1 0.1" pos="0 0 -0.12"/>'


def pendulum(
    servo: str = f'<position {SERVO} kp="8" forcerange="-1.5 1.5"/>',
    *,
    joint: str = 'damping="0.12" armature="0.006" frictionloss="0.03"',
    compiler: str = '<compiler angle="radian"/>',
    option: str = 'timestep="0.001" integrator="implicitfast"',
    more: str = "",
) -> str:
    """A servo that lifts 0.3 kg at 0.1 m."""
    return f"""\
<mujoco model="pendulum">
  {compiler}
  <option {option}/>
  <worldbody>
    {BENCH}
    <body name="arm">
      <joint name="joint" axis="0 1 0" {joint}/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.1" size="0.01" mass="0.02"/>
      <geom name="bob" type="sphere" pos="0 0 -0.1" size="0.04" mass="0.3"/>
    </body>
  </worldbody>
  <actuator>
    {servo}
  </actuator>
  {more}
</mujoco>
"""


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def sweep(t: Array, joints: int, reach: float = 0.6, low_hz: float = 0.3, high_hz: float = 2.5) -> Array:
    """Commands that start and end at 0 and hold for 20 ms each: a chirp, then steps, (n, joints) rad."""
    held = np.floor((t - t[0]) / 0.02 + 1e-9) * 0.02
    seconds = float(t[-1] - t[0])
    out = np.empty((len(t), joints))
    for j in range(joints):
        u = held / (0.6 * seconds)
        rate = np.log(high_hz / low_hz)
        chirp = np.sin(2 * np.pi * low_hz * 0.6 * seconds * (np.exp(rate * u) - 1) / rate + 1.7 * j)
        fade = np.clip(held / 0.3, 0, 1) * np.clip((0.62 * seconds - held) / 0.3, 0, 1)
        levels = np.random.default_rng(j).uniform(-1, 1, 64)
        step = levels[np.floor(held / 0.7 + 0.37 * j).astype(int) % 64] * (held < seconds - 0.4)
        out[:, j] = reach * np.where(u < 1.03, chirp * fade, 0.7 * step)
    return out


def drive(
    model: Any,
    joints: Sequence[str],
    t: Array,
    command: Array,
    *,
    noise: float = 0.0,
    quantum: float = 0.0,
    torque: Array | None = None,
    seed: int = 0,
) -> dict[str, Array]:
    """What a robot of this model records: columns `cmd.J`, `pos.J` and, where given, `torque.J`.

    The robot's own time step need not divide the rows' spacing: at each row the last step is a shorter one. It starts at
    rest at its first command.
    """
    data = mujoco.MjData(model)
    address = [int(model.joint(joint).qposadr[0]) for joint in joints]
    servos = [actuator_of(model, joint) for joint in joints]
    control = model.actuator_ctrladr[servos]
    data.qpos[address] = command[0]
    h = float(model.opt.timestep)
    off = np.zeros(command.shape, bool) if torque is None else torque == 0
    position = np.empty(command.shape)
    for k in range(len(t)):
        position[k] = data.qpos[address]
        data.ctrl[control] = command[k]
        model.actuator_group[:] = 0
        model.actuator_group[np.array(servos)[off[k]]] = 30
        model.opt.disableactuator = (1 << 30) if off[k].any() else 0
        if k + 1 < len(t):
            steps = max(1, round((t[k + 1] - t[k]) / h))
            model.opt.timestep = (t[k + 1] - t[k]) / steps
            mujoco.mj_step(model, data, steps)
    model.opt.timestep = h
    chance = np.random.default_rng(seed)
    position += noise * chance.standard_normal(position.shape)
    if quantum:
        position = np.round(position / quantum) * quantum
    columns = {f"cmd.{joint}": command[:, j] for j, joint in enumerate(joints)}
    columns |= {f"pos.{joint}": position[:, j] for j, joint in enumerate(joints)}
    if torque is not None:
        columns |= {f"torque.{joint}": torque[:, j].astype(float) for j, joint in enumerate(joints)}
    return columns


def jittering(seconds: float, rate_hz: float, jitter_s: float = 0.0, seed: int = 0, start: float = 17.25) -> Array:
    """Time stamps of a host: (n,) s, strictly increasing, each off its beat by up to `jitter_s`."""
    t = start + np.arange(round(seconds * rate_hz)) / rate_hz
    return t + np.random.default_rng(seed).uniform(-jitter_s, jitter_s, len(t))


def run_of(columns: dict[str, Array], t: Array, joints: Sequence[str], name: str = "run", **facts: Any) -> Run:
    return Run(name, Facts(tuple(joints), **facts), t, columns)
