"""Where an environment's robot comes from: the bundled nominal model, or a robot's own folder."""

from __future__ import annotations

import functools
import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_env.observations import ObservationLayout
from openant_tools.effects.commands import CommandEffects
from openant_tools.effects.entries import check_pair, commands_of, sensing_of, values_of
from openant_tools.effects.rollout import EffectValues
from openant_tools.effects.sensing import SensingEffects
from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.robot.config import ACTION_PRESETS, ActionRange, Arena, EffectEntry
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import ANGLE_LIMIT_RAD
from openant_tools.robot.mjcf import nominal_model_path

__all__ = ["DT_S", "SimulatedRobot", "simulated_robot"]

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

#: s, the paper's step of SAC.
DT_S = 0.12

# Nominal bounds of what the sensors read while an Open Ant walks, for robots whose folder has no measured ones.
JOINT_SPEED_RAD_S = 8.0  # above the no-load speed of every kit's servos, 4.8 to 7.3 rad/s
ACCELERATION_M_S2 = 2 * 9.81
ANGULAR_VELOCITY_RAD_S = 4.0


@dataclass(frozen=True)
class SimulatedRobot:
    """A robot as an environment needs it.

    Attributes:
        model_path: its MJCF.
        low, high: (joints,) rad, the limits of commands.
        action_range: what actions of −1…1 mean unless someone asks for another range.
        dt_s: s, the length of a step unless someone asks for another.
        measured_bounds: name of an observation → (low, high), as far as they were measured.
        arena: the circle to learn in.
        folder: the robot's folder, None for the nominal one.
        identified: whether its model is one that was fitted to it; the nominal robot is what it is.
        effects: what acts beside the model, between its steps; commands: on the way to the servos; sensing: in sensors.
        entries: where that stands in robot.toml; None where nothing is to act.
    """

    model_path: Path
    low: Array
    high: Array
    action_range: ActionRange
    dt_s: float
    measured_bounds: Mapping[str, tuple[float, float]]
    folder: Path | None
    identified: bool = True
    effects: EffectValues = field(default_factory=dict)
    commands: CommandEffects | None = None
    sensing: SensingEffects | None = None
    joints: tuple[str, ...] = tuple(JOINTS)
    arena: Arena = field(default_factory=Arena)
    entries: tuple[EffectEntry, ...] | None = None

    def load(self) -> Plant:
        """Its model on the floor, with the sensors `pos.J` and `vel.J` added where the file has none.

        Raises:
            BadInput: MuJoCo cannot load it, it lacks one of the joints, or an effect was fitted with another model.
        """
        plant = load_plant(self.model_path, self.joints, Setup.FLOOR, drawn=True)
        if self.entries is not None:
            where = None if self.folder is None else RobotFolder(self.folder).config_file
            for line in check_pair(self.entries, plant.model, self.model_path, where):
                _say_once(line)
        present = {plant.model.sensor(i).name for i in range(plant.model.nsensor)}
        missing = [
            name for kind in ("pos", "vel") for joint in self.joints if (name := f"{kind}.{joint}") not in present
        ]
        if not missing:
            return plant
        # The platform's own models measure no joints; sensors behind all others change no address of the plant's.
        spec = mujoco.MjSpec.from_file(str(self.model_path))
        kinds = {"pos": mujoco.mjtSensor.mjSENS_JOINTPOS, "vel": mujoco.mjtSensor.mjSENS_JOINTVEL}
        for name in missing:
            kind, _, joint = name.partition(".")
            spec.add_sensor(name=name, type=kinds[kind], objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)
        return replace(plant, model=spec.compile())

    def model_sha256(self) -> str:
        """Which model this is: the hash of its file."""
        return hashlib.sha256(self.model_path.read_bytes()).hexdigest()

    def bounds(self, layout: ObservationLayout) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Low and high of each observation, each (len(layout),): measured where they were, else nominal."""
        nominal: dict[str, tuple[float, float]] = {}
        for joint, low, high in zip(self.joints, self.low, self.high, strict=True):
            nominal[f"pos.{joint}"] = (float(low), float(high))
            nominal[f"vel.{joint}"] = (-JOINT_SPEED_RAD_S, JOINT_SPEED_RAD_S)
        for axis in ("along", "left"):
            nominal[f"direction.{axis}"] = (-1.0, 1.0)
        for axis in "xyz":
            nominal[f"acc.{axis}"] = (-ACCELERATION_M_S2, ACCELERATION_M_S2)
            nominal[f"gyro.{axis}"] = (-ANGULAR_VELOCITY_RAD_S, ANGULAR_VELOCITY_RAD_S)
        pairs = np.array([self.measured_bounds.get(name, nominal[name]) for name in layout.names], np.float32)
        return pairs[:, 0].copy(), pairs[:, 1].copy()


def simulated_robot(
    robot: str | Path | None = None, *, kit: str | None = None, effects: bool | Sequence[str] = True
) -> SimulatedRobot:
    """The robot in a folder, or the nominal one.

    Args:
        robot: a robot's folder or its robot.toml; None for the bundled nominal robot.
        kit: `standard` or `lite`, of the nominal robot; a folder says itself what robot it holds.
        effects: which `[[effect]]` entries of the folder act: True (all enabled), False, or their names.

    Raises:
        BadInput: no such folder or kit, or a robot that cannot be simulated as it is described.
    """
    if robot is None:
        if not isinstance(effects, bool):
            raise BadInput(
                "the nominal robot has no effects to choose from", remedy="name a robot whose robot.toml has them"
            )
        high = np.array([ANGLE_LIMIT_RAD[joint.kind] for joint in JOINTS.values()])
        model = nominal_model_path(kit or "standard")
        return SimulatedRobot(model, -high, high, ACTION_PRESETS["platform"], DT_S, {}, None)

    if kit is not None:
        raise BadInput("a robot's folder says itself which kit it is", where=robot, remedy="leave kit out")
    folder = RobotFolder.at(robot)
    config = folder.config()
    present = [effect for effect in config.effects if effect.enabled]
    acting = _chosen(present, effects, folder)
    motors = [config.motors[joint] for joint in JOINTS]
    return SimulatedRobot(
        model_path=folder.model_path(config),
        low=np.array([motor.min_rad for motor in motors]),
        high=np.array([motor.max_rad for motor in motors]),
        action_range=config.actions.range,
        dt_s=config.timing.dt_s,
        measured_bounds=config.observation,
        folder=folder.path,
        identified=(source := config.provenance_of("model")) is not None and source.how != "nominal",
        effects=values_of(acting, tuple(JOINTS), folder.config_file),
        commands=commands_of(acting, tuple(JOINTS), folder.config_file),
        sensing=sensing_of(acting, folder.config_file),
        arena=config.arena,
        entries=None if effects is False else tuple(acting),
    )


@functools.cache
def _say_once(line: str) -> None:
    """A line of the log, however many environments are made."""
    _log.warning("%s", line)


def _chosen(present: Sequence[EffectEntry], wanted: bool | Sequence[str], folder: RobotFolder) -> list[EffectEntry]:
    """The entries of robot.toml that are to act."""
    if isinstance(wanted, bool):
        return list(present) if wanted else []
    names = {effect.effect for effect in present}
    strangers = sorted(set(wanted) - names)
    if strangers:
        raise BadInput(
            f"no enabled effect is called {strangers[0]}",
            where=folder.config_file,
            remedy=f"it has {', '.join(sorted(names)) or 'none'}",
        )
    return [effect for effect in present if effect.effect in wanted]
