"""Where an environment's robot comes from: the bundled nominal model, or a robot's own folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_env.observations import Layout
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import ANGLE_LIMIT_RAD
from openant_tools.robot.mjcf import nominal_model_path

__all__ = ["SimulatedRobot", "simulated_robot"]

Array = NDArray[np.float64]

# Nominal bounds of what the sensors read while an Open Ant walks, for robots whose folder has no measured ones.
JOINT_SPEED_RAD_S = 8.0  # above the no-load speed of every kit's servos, 4.8 to 7.3 rad/s
ACCELERATION_M_S2 = 2 * 9.81
ANGULAR_VELOCITY_RAD_S = 4.0


@dataclass(frozen=True)
class SimulatedRobot:
    """A robot as an environment needs it.

    Attributes:
        model_path: its MJCF.
        joints: in the order of actions and observations.
        low, high: (joints,) rad, the limits of commands.
        measured_bounds: observation name → (low, high), as far as they were measured.
        folder: the robot's folder, None for the nominal one.
    """

    model_path: Path
    joints: tuple[str, ...]
    low: Array
    high: Array
    measured_bounds: dict[str, tuple[float, float]]
    folder: Path | None

    def load(self) -> Plant:
        """Its model on the floor, with the sensors `pos.J` and `vel.J` added where the file has none.

        Raises:
            BadInput: MuJoCo cannot load it, or it lacks one of the joints.
        """
        plant = load_plant(self.model_path, self.joints, Setup.FLOOR)
        present = {plant.model.sensor(i).name for i in range(plant.model.nsensor)}
        missing = [joint for joint in self.joints if not {f"pos.{joint}", f"vel.{joint}"} <= present]
        if not missing:
            return plant
        # The platform's own models measure no joints; sensors behind all others change no address of the plant's.
        spec = mujoco.MjSpec.from_file(str(self.model_path))
        for prefix, kind in (("pos", mujoco.mjtSensor.mjSENS_JOINTPOS), ("vel", mujoco.mjtSensor.mjSENS_JOINTVEL)):
            for joint in self.joints:
                if f"{prefix}.{joint}" not in present:
                    spec.add_sensor(
                        name=f"{prefix}.{joint}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint
                    )
        return replace(plant, model=spec.compile())

    def bounds(self, layout: Layout) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Low and high of each observation, each (len(layout),): measured where they were, else nominal."""
        nominal: dict[str, tuple[float, float]] = {}
        for joint, low, high in zip(self.joints, self.low, self.high, strict=True):
            nominal[f"position.{joint}"] = (float(low), float(high))
            nominal[f"velocity.{joint}"] = (-JOINT_SPEED_RAD_S, JOINT_SPEED_RAD_S)
        for axis in ("along", "left"):
            nominal[f"direction.{axis}"] = (-1.0, 1.0)
        for axis in "xyz":
            nominal[f"acceleration.{axis}"] = (-ACCELERATION_M_S2, ACCELERATION_M_S2)
            nominal[f"angular_velocity.{axis}"] = (-ANGULAR_VELOCITY_RAD_S, ANGULAR_VELOCITY_RAD_S)
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
    kinds = [joint.kind for joint in JOINTS.values()]
    high = np.array([ANGLE_LIMIT_RAD[kind] for kind in kinds])
    return SimulatedRobot(nominal_model_path(kit or "standard"), tuple(JOINTS), -high, high, {}, None)
