"""What a protocol will do to a robot, simulated before it is played: how fast, how strong, how close to itself, how upright.

A plain simulation of the model, step by step, with the engine's own rule for legs that are released and caught; its
positions, read as an encoder would, serve as the recording that is yet to be made.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.motion import catch
from openant_tools.model.plant import Plant, Setup
from openant_tools.model.rollout import fill_setpoints
from openant_tools.model.servo import read_damping, read_electrical, read_velocity_gain, torque_limit
from openant_tools.numbers import number
from openant_tools.recording.run import Facts, Run
from openant_tools.sysid.excitation import CommandSpace
from openant_tools.sysid.protocols import Protocol

__all__ = ["ENCODER_RAD", "Forecast", "Peak", "forecast"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: a Dynamixel X counts 4096 steps a turn
ENCODER_RAD = 2 * np.pi / 4096
#: m; parts of the robot that stay farther apart than this are not measured
NEAR_M = 0.05
#: s between two looks at how far parts are apart
LOOK_S = 0.02
#: rad; a body that leans so far has fallen, or is about to
FALLEN_RAD = 0.6
#: share of its torque from which a servo counts as saturated
SATURATED = 0.98
#: as `comms.guards.Guards.angle_margin_rad`
ANGLE_MARGIN_RAD = 0.2
#: s to settle on the feet, joints held
SETTLE_S = 1.0


@dataclass(frozen=True)
class Peak:
    """What one joint goes through.

    Attributes:
        speed_rad_s, torque_nm: largest, of the simulated motion.
        no_load_rad_s: speed at which the servo's torque is used up by its own damping; infinite where the model has none.
        limit_nm: the servo's torque limit; infinite where the model has none.
        saturated: share of the time with torque at the limit.
        rms_nm: root mean square torque, which heats the motor.
        low_rad, high_rad: how far it moved.
    """

    joint: str
    speed_rad_s: float
    no_load_rad_s: float
    torque_nm: float
    limit_nm: float
    saturated: float
    rms_nm: float
    low_rad: float
    high_rad: float


@dataclass(frozen=True)
class Forecast:
    """One recording, as it is expected.

    Attributes:
        run: commands as the engine will send them, positions as the encoders will read them.
        clearance_m: smallest distance between two parts of the robot, at most NEAR_M; negative: they touch.
        nearest: names of those parts; empty where nothing comes near.
        lean_rad: largest angle of the torso from upright on the floor, 0 on the stand.
        torso_down: whether the torso touches the floor.
        travel_m: how far the torso is from where it began, at most.
        astray: joints that a guard would stop: without torque they leave the commands' range by more than it allows.
    """

    protocol: Protocol
    run: Run
    peaks: tuple[Peak, ...]
    clearance_m: float
    nearest: tuple[str, ...]
    lean_rad: float
    torso_down: bool
    travel_m: float
    astray: tuple[str, ...]

    @property
    def objections(self) -> list[str]:
        """Why this must not be played."""
        where = f"on the {self.protocol.setup}"
        out = []
        if self.clearance_m < 0:
            out.append(f"{where} {' and '.join(self.nearest)} touch each other")
        if self.astray:
            out.append(f"{where} {', '.join(self.astray)} goes farther than a guard allows")
        if self.lean_rad > FALLEN_RAD:
            out.append(f"{where} the body leans by {number(self.lean_rad, 'rad', decimals=0)}")
        if self.torso_down:
            out.append(f"{where} the torso touches the floor")
        return out


def forecast(
    plant: Plant, protocol: Protocol, space: CommandSpace, commands: Array, limp: Bools, rate_hz: float, name: str
) -> Forecast:
    """Simulate a protocol's commands.

    Args:
        plant: the model, set up as the protocol is played.
        space: where commands may go.
        commands: (n, joints) rad at `rate_hz`.
        limp: (n, joints), where torque is off.
        name: of the run.
    """
    model, data = plant.model, mujoco.MjData(plant.model)
    commands = commands.copy()
    data.qpos[plant.qpos] = commands[0]
    fill_setpoints(plant, data, commands[0])
    joint = plant.free_joint if plant.setup is Setup.FLOOR else None
    if joint is not None:
        _settle(plant, data, commands[0])
    mujoco.mj_forward(model, data)
    base = slice(0, 0) if joint is None else slice(int(model.jnt_qposadr[joint]), int(model.jnt_qposadr[joint]) + 7)
    began = data.qpos[base][:2].copy()
    watch = _Watch.of(plant)
    n, nj = commands.shape
    pos, vel, torque = (np.zeros((n, nj)) for _ in range(3))
    lean = travel = 0.0
    variants: dict[bytes, mujoco.MjModel] = {}
    looks, rows_a_look = [], max(1, round(LOOK_S * rate_hz))
    for row in range(n):
        for j in np.flatnonzero(limp[row - 1] & ~limp[row]) if row else ():
            catch(commands, row, int(j), float(data.qpos[plant.qpos[j]]), rate_hz)
        if row:
            commands[row] = np.where(limp[row], pos[row - 1], commands[row])
        here = variants.setdefault(limp[row].tobytes(), plant.with_torque_off(model, limp[row]))
        pos[row] = data.qpos[plant.qpos]
        data.ctrl[plant.ctrl] = commands[row]
        steps = round((row + 1) / rate_hz / plant.timestep) - round(row / rate_hz / plant.timestep)
        mujoco.mj_step(here, data, steps)
        torque[row] = np.where(limp[row], 0.0, data.actuator_force[plant.actuator])
        vel[row] = data.qvel[plant.dof]
        if joint is not None:
            lean = max(lean, _lean(data.qpos[base][3:]))
            travel = max(travel, float(np.hypot(*(data.qpos[base][:2] - began))))
        if row % rows_a_look == 0:
            looks.append(watch.look(data))
    clearance, nearest = min(((distance, names) for distance, names, _ in looks), default=(NEAR_M, ()))
    run = _run(plant, protocol, commands, limp, pos, rate_hz, name)
    peaks = tuple(_peak(plant, k, pos[:, k], vel[:, k], torque[:, k], limp[:, k]) for k in range(nj))
    down = any(touches for _, _, touches in looks)
    beyond = np.maximum(pos - space.high, space.low - pos).max(axis=0)
    astray = tuple(joint for joint, by in zip(plant.joints, beyond, strict=True) if by > ANGLE_MARGIN_RAD)
    return Forecast(protocol, run, peaks, clearance, nearest, lean, down, travel, astray)


def _settle(plant: Plant, data: mujoco.MjData, pose: Array) -> None:
    """Let the base come to rest with the joints held, then leave it there at rest."""
    for _ in range(round(SETTLE_S / plant.timestep)):
        data.qpos[plant.qpos], data.qvel[plant.dof] = pose, 0
        mujoco.mj_step(plant.model, data)
    data.qpos[plant.qpos] = pose
    data.qvel[:] = 0
    data.time = 0


def _lean(quat: Array) -> float:
    """Angle between the torso's z axis and the world's."""
    upright = 1 - 2 * (quat[1] ** 2 + quat[2] ** 2)
    return float(np.arccos(np.clip(upright, -1, 1)))


@dataclass(frozen=True)
class _Watch:
    """How near the robot's parts come to each other: its collision detection, with wider margins."""

    model: mujoco.MjModel
    data: mujoco.MjData
    own: Bools
    torso: int

    @classmethod
    def of(cls, plant: Plant) -> _Watch:
        wide = copy.copy(plant.model)
        wide.geom_margin[:] += NEAR_M
        torso = -1 if plant.free_joint is None else int(wide.jnt_bodyid[plant.free_joint])
        # The robot is what hangs together with its joints; the floor is body 0, but so is a torso on the stand.
        weld = wide.body_weldid[wide.geom_bodyid]
        own = (weld != 0) | (wide.geom_bodyid != 0)
        return cls(wide, mujoco.MjData(wide), own, torso)

    def look(self, data: mujoco.MjData) -> tuple[float, tuple[str, ...], bool]:
        """(smallest distance m, the parts, whether the torso is on the floor)."""
        model, apart = self.model, self.data
        apart.qpos[:] = data.qpos
        mujoco.mj_kinematics(model, apart)
        mujoco.mj_collision(model, apart)
        nearest: tuple[float, tuple[str, ...]] = (NEAR_M, ())
        down = False
        for contact in apart.contact[: apart.ncon]:
            a, b = int(contact.geom[0]), int(contact.geom[1])
            if self.own[a] and self.own[b]:
                if contact.dist < nearest[0]:
                    nearest = float(contact.dist), (self._name(a), self._name(b))
            elif contact.dist < 0 and self.torso >= 0:
                part = b if not self.own[a] else a
                down |= int(model.geom_bodyid[part]) == self.torso
        return *nearest, down

    def _name(self, geom: int) -> str:
        return str(self.model.geom(geom).name or self.model.body(int(self.model.geom_bodyid[geom])).name)


def _run(plant: Plant, protocol: Protocol, commands: Array, limp: Bools, pos: Array, rate_hz: float, name: str) -> Run:
    joints = plant.joints
    columns = {f"cmd.{joint}": commands[:, k] for k, joint in enumerate(joints)}
    columns |= {f"pos.{joint}": np.round(pos[:, k] / ENCODER_RAD) * ENCODER_RAD for k, joint in enumerate(joints)}
    if limp.any():
        columns |= {f"torque.{joint}": (~limp[:, k]).astype(float) for k, joint in enumerate(joints)}
    heading = protocol.heading_rad if protocol.setup == "floor" else None
    facts = Facts(
        joints, setup=protocol.setup, protocol=protocol.name, heading_rad=heading, resolution={"pos": ENCODER_RAD}
    )
    return Run(name, facts, np.arange(len(commands)) / rate_hz, columns)


def _peak(plant: Plant, j: int, pos: Array, vel: Array, torque: Array, limp: Bools) -> Peak:
    model = plant.model
    limit = torque_limit(model, plant, j)
    damping = read_damping(model, plant, j) + read_velocity_gain(model, plant, j)
    driven = torque[~limp]
    # What a DC motor's actuator gives is what its back-EMF leaves; its duty is saturated where it gives all of that.
    back = read_electrical(model, plant, j) * read_damping(model, plant, j)
    full = np.abs(driven + back * vel[~limp]) > SATURATED * limit
    return Peak(
        plant.joints[j],
        float(np.abs(vel).max()),
        limit / damping if damping > 0 else np.inf,
        float(np.abs(driven).max(initial=0.0)),
        limit,
        float(full.mean()) if len(driven) else 0.0,
        float(np.sqrt(np.mean(driven**2))) if len(driven) else 0.0,
        float(pos.min()),
        float(pos.max()),
    )
