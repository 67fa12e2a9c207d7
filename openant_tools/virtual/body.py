"""The robot's mechanics in MuJoCo: geometry of the nominal model on its stand, on the floor, or motors in a box.

Only masses, joints and contacts come from the MJCF; its actuators are removed. Motor torques enter through
`qfrc_applied`. Coulomb friction is MuJoCo's `frictionloss`, since an explicit friction torque would chatter at rest,
but its size is ours at every step (it may depend on speed and load); the rotor's inertia is `armature`, or, where the
gear has play or spring, a rotor of our own (see `drives`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.robot.joints import JOINTS
from openant_tools.robot.mjcf import nominal_mjcf

__all__ = ["Body", "BodySettings", "Payload", "Tether"]

Array = NDArray[np.float64]

#: m/s²
GRAVITY = 9.81
#: kg·m², the horn of a motor that lies in the box.
HORN_KG_M2 = 2e-5
#: rad, by which successive angles never come near each other again
GOLDEN_ANGLE = 2.399963
#: m, centre of the torso when it lies on the floor with its legs straight.
LYING_HEIGHT = 0.078


@dataclass(frozen=True)
class Payload:
    """A mass fixed to the torso, at a position in the torso's frame."""

    mass_kg: float
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Tether:
    """A tether on the torso: a constant force, a damper and a spring to an anchor, all in the world's frame."""

    force_n: tuple[float, float, float] = (0.0, 0.0, 0.0)
    damping_n_s_m: float = 0.0
    stiffness_n_m: float = 0.0
    anchor_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass
class BodySettings:
    """What the mechanics are like.

    Attributes:
        kit: "standard" or "lite". setup: "stand", "floor" or "loose".
        pose_rad: joint → angle at the start.
        link_scale: joint → scale of the mass and inertia of the link that it moves.
        blocked: joint → angle of a stop that should not be there.
        tilt_rad, tilt_direction_rad: of the ground, and where downhill is (from x towards y).
        floor_friction: sliding coefficient; contact_time_s: time constant of the contacts.
        adhesion_n: force with which each foot sticks to the floor it touches.
    """

    kit: str = "standard"
    setup: str = "stand"
    timestep_s: float = 1e-3
    pose_rad: Mapping[str, float] = field(default_factory=dict)
    heading_rad: float = 0.0
    position_m: tuple[float, float] = (0.0, 0.0)
    link_scale: Mapping[str, float] = field(default_factory=dict)
    blocked: Mapping[str, float] = field(default_factory=dict)
    payloads: Sequence[Payload] = ()
    tilt_rad: float = 0.0
    tilt_direction_rad: float = 0.0
    floor_friction: float | None = None
    contact_time_s: float | None = None
    adhesion_n: float = 0.0
    cable: Tether | None = None


class Body:
    """The mechanics of n joints; `q` and `v` are views into the simulation, (n,) rad and rad/s.

    Args:
        joints: names in the order of the servos. On the stand and on the floor they are the robot's eight, in its own
            order; in a box any names.
    """

    def __init__(self, settings: BodySettings, joints: Sequence[str]) -> None:
        self.settings = settings
        self.joints = tuple(joints)
        spec = _loose(joints) if settings.setup == "loose" else _robot(settings)
        spec.option.timestep = settings.timestep_s
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        model, data = self.model, self.data
        self.on_floor = settings.setup == "floor"
        rows = [int(model.joint(name).qposadr[0]) for name in joints]
        dofs = [int(model.joint(name).dofadr[0]) for name in joints]
        # The eight hinges stand behind one another, so slices (views) serve; asserted, not assumed.
        assert rows == list(range(rows[0], rows[0] + len(rows)))
        assert dofs == list(range(dofs[0], dofs[0] + len(dofs)))
        self._dofs = slice(dofs[0], dofs[0] + len(dofs))
        self.q: Array = data.qpos[rows[0] : rows[0] + len(rows)]
        self.v: Array = data.qvel[self._dofs]
        self.torque: Array = data.qfrc_applied[self._dofs]
        self.frictionloss: Array = model.dof_frictionloss[self._dofs]
        self.damping: Array = model.dof_damping[self._dofs]
        self.armature: Array = model.dof_armature[self._dofs]
        self._torso = model.body("torso").id if settings.setup != "loose" else -1
        knees = [JOINTS[name] for name in joints if name in JOINTS and JOINTS[name].kind == "knee"]
        self._feet = [model.geom(f"lower_{joint.leg.name}").id for joint in knees] if self.on_floor else []
        links = ("root_", "upper_", "lower_")
        self._links = [g for g in range(self.model.ngeom) if self.model.geom(g).name.startswith(links)]
        #: (3,) rad/s in the torso's axes, with which hands turn a torso that has no joint of its own
        self.held_rate: Array = np.zeros(3)
        self.reset()

    def hold(self, quaternion: Array, rate: Array) -> None:
        """A hand has the torso in this attitude (4,) and turns it at this rate (3,) rad/s; on the stand only."""
        self.model.body_quat[self._torso] = quaternion
        self.held_rate = rate

    def reset(self) -> None:
        """The start: joints at the pose, torso on the stand or lying on the floor."""
        mujoco.mj_resetData(self.model, self.data)
        s = self.settings
        for k, name in enumerate(self.joints):
            # Bare motors lie in their box at whatever angle they were last turned to: here one of each, far from the seam.
            anywhere = 1.5 * math.sin(GOLDEN_ANGLE * (k + 1)) if s.setup == "loose" else 0.0
            self.q[k] = s.pose_rad.get(name, anywhere)
        if self.on_floor:
            half = s.heading_rad / 2
            self.data.qpos[:7] = (*s.position_m, LYING_HEIGHT, math.cos(half), 0.0, 0.0, math.sin(half))
        mujoco.mj_forward(self.model, self.data)

    def put(self, position_m: Sequence[float], rotation_rad: Sequence[float]) -> None:
        """Hands set the robot on the floor, still, its legs as they are: torso at (2,) m, turned by (3,) rad."""
        self.data.qpos[:7] = (*position_m, 0.0, 1.0, 0.0, 0.0, 0.0)
        mujoco.mju_quatIntegrate(self.data.qpos[3:7], np.array(rotation_rad, float), 1.0)
        self.data.qvel[:6] = 0.0
        mujoco.mj_forward(self.model, self.data)
        lowest = min(min(az, bz) - radius for _, _, az, _, _, bz, radius in self.limbs())
        self.data.qpos[2] = max(LYING_HEIGHT, -lowest)
        mujoco.mj_forward(self.model, self.data)

    def set_gear(self, frictionloss: Array, viscous: Array, armature: Array) -> None:
        """Friction and rotor inertia at the joints, (n,) N·m, N·m·s/rad, kg·m²."""
        self.frictionloss[:] = frictionloss
        self.damping[:] = viscous
        self.armature[:] = armature
        # What MuJoCo derives from the inertias (the constraints' scaling) follows them.
        pose = self.data.qpos.copy()
        mujoco.mj_setConst(self.model, self.data)
        self.data.qpos[:] = pose
        mujoco.mj_forward(self.model, self.data)

    def link_inertia(self) -> Array:
        """(n,) kg·m² about each joint with every other joint locked, without armature, in this pose."""
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, full)
        return np.diag(full)[self._dofs] - self.armature

    def step(self) -> None:
        """One time step with the torques that stand in `torque`."""
        if self.on_floor and (self.settings.cable or self.settings.adhesion_n):
            self._pull()
        mujoco.mj_step(self.model, self.data)

    def _pull(self) -> None:
        data = self.data
        wrench = data.xfrc_applied[self._torso]
        wrench[:] = 0.0
        cable = self.settings.cable
        if cable is not None:
            wrench[:3] = cable.force_n
            wrench[:3] -= cable.damping_n_s_m * data.qvel[:3]
            wrench[:3] -= cable.stiffness_n_m * (data.qpos[:3] - np.asarray(cable.anchor_m))
        if self.settings.adhesion_n:
            pull = np.array([0.0, 0.0, -self.settings.adhesion_n])
            for geom in self._feet:
                body = self.model.geom_bodyid[geom]
                touching = (data.contact.geom == geom).any(axis=1)
                data.xfrc_applied[body] = 0.0
                if touching.any():
                    # It sticks where it touches, which turns the leg about its own centre besides.
                    arm = data.contact.pos[touching].mean(axis=0) - data.xipos[body]
                    data.xfrc_applied[body] = [*pull, *np.cross(arm, pull)]

    # ---- what sensors of the body see ----

    @property
    def has_torso(self) -> bool:
        return self._torso >= 0

    @property
    def position(self) -> Array:
        """(3,) m, the torso's centre in the world."""
        return self.data.xpos[self._torso].copy() if self.has_torso else np.zeros(3)

    @property
    def quaternion(self) -> Array:
        """(4,) w x y z, the torso's attitude in the world."""
        return self.data.xquat[self._torso].copy() if self.has_torso else np.array([1.0, 0.0, 0.0, 0.0])

    @property
    def rotation(self) -> Array:
        """(3, 3), world from torso."""
        return self.data.xmat[self._torso].reshape(3, 3).copy() if self.has_torso else np.eye(3)

    @property
    def velocity(self) -> Array:
        """(6,) of the torso in world axes: m/s, then rad/s."""
        if not self.on_floor:
            return np.zeros(6)
        return np.concatenate([self.data.qvel[:3], self.rotation @ self.data.qvel[3:6]])

    def limbs(self) -> list[list[float]]:
        """The legs as capsules in the world: ax, ay, az, bx, by, bz, radius, m."""
        model, data = self.model, self.data
        out: list[list[float]] = []
        for geom in self._links:
            reach = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
            centre = data.geom_xpos[geom]
            out.append([*(centre - reach).tolist(), *(centre + reach).tolist(), float(model.geom_size[geom, 0])])
        return out

    @property
    def gyro(self) -> Array:
        """(3,) rad/s in the torso's frame."""
        return self.data.sensor("gyro").data + self.held_rate if self.has_torso else np.zeros(3)

    @property
    def accelerometer(self) -> Array:
        """(3,) m/s², specific force in the torso's frame: +9.81 on z at rest on level ground."""
        return self.data.sensor("accelerometer").data.copy() if self.has_torso else np.array([0.0, 0.0, GRAVITY])


def _robot(settings: BodySettings) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(nominal_mjcf(settings.kit))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for key in list(spec.keys):
        spec.delete(key)
    floor = spec.geom("floor")
    if settings.setup == "stand":
        spec.delete(spec.joint("root"))
        floor.contype = floor.conaffinity = 0
    if settings.floor_friction is not None:
        floor.friction[0] = settings.floor_friction
    if settings.contact_time_s is not None:
        floor.solref[0] = settings.contact_time_s
    tilt, towards = settings.tilt_rad, settings.tilt_direction_rad
    spec.option.gravity = [
        GRAVITY * math.sin(tilt) * math.cos(towards),
        GRAVITY * math.sin(tilt) * math.sin(towards),
        -GRAVITY * math.cos(tilt),
    ]
    for name, scale in settings.link_scale.items():
        joint = JOINTS[name]
        # mass="0" is given to what is only drawn, and stays 0.
        spec.geom(f"{'upper' if joint.kind == 'hip' else 'lower'}_{joint.leg.name}").mass *= scale
    for n, payload in enumerate(settings.payloads):
        spec.body("torso").add_geom(
            name=f"payload_{n}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.02, 0.0, 0.0],
            pos=list(payload.position_m),
            mass=payload.mass_kg,
            contype=0,
            conaffinity=0,
        )
    for name, angle in settings.blocked.items():
        # A stop is on the far side of home: what lies between stop and home stays reachable.
        joint = spec.joint(name)
        low, high = joint.range if joint.range[1] > joint.range[0] else spec.find_default(JOINTS[name].kind).joint.range
        joint.range = [low, angle] if angle >= 0 else [angle, high]
    return spec


def _loose(joints: Sequence[str]) -> mujoco.MjSpec:
    """Motors that lie in a box: each turns its horn and nothing else."""
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for n, name in enumerate(joints):
        horn = spec.worldbody.add_body(name=f"horn_{name}", pos=[0.1 * n, 0.0, 0.05])
        horn.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
        horn.mass = 0.005
        horn.inertia = [HORN_KG_M2, HORN_KG_M2, HORN_KG_M2]
        horn.explicitinertial = True
    return spec
