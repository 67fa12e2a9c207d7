"""A robot as simulations of the gap know it: how it differs from the given model, in every way that the catalogue names.

It is plain data. Effects and tolerances change it; `gap.simulation` plays it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.model.body import floor_contacts, link_bodies, scale_mass, torso_body
from openant_tools.model.plant import Plant
from openant_tools.model.servo import (
    hold_still,
    read_armature,
    read_damping,
    read_friction,
    read_stiffness,
    read_velocity_gain,
    torque_limit,
    usual_torque,
    write_armature,
    write_damping,
    write_friction,
    write_stiffness,
    write_torque_limit,
    write_velocity_gain,
)

__all__ = ["USUAL_NOISE", "Cable", "Form", "Reference", "Robot", "Seen", "tilted"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Form:
    """The numerical form of a simulation, none of which is true of a robot: what holds for one only is no evidence.

    Attributes:
        integrator: mjtIntegrator. elliptic: cones, else pyramids. impratio: how much stiffer friction is than contact.
        smooth_friction: dry friction as a steep function of velocity (rad/s where it is reached), 0 as a constraint.
        bristle: dry friction as bristles that bend by this angle (rad) before they slide (LuGre), 0 as a constraint.
        encoder_rad: steps in which a servo's own loop sees its joint, 0 for none.
        contact_damping, contact_give, contact_depth: factors on the damping ratio of contacts, on how far from rigid their
            impedance is, and on the depth at which it is reached.
        loop_behind: a servo measures behind its play or spring, as encoders on output shafts do; a written MJCF, whose
            servos measure their own joint, cannot.
        tells_duty: what a servo says of its torque is what it puts on its motor, which back-EMF takes nothing from.
        tells_asked: and it is what a healthy motor would make of it: a servo knows its current, not what becomes of it.
        one_packet: one packet brings every joint its command, so that one that is late is late for all; else each by itself.
        never_early: no command acts before its usual time, however its clock scatters.
    """

    integrator: int = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    elliptic: bool = True
    impratio: float = 10.0
    smooth_friction: float = 0.0
    bristle: float = 0.0
    encoder_rad: float = 0.0
    contact_damping: float = 1.0
    contact_give: float = 1.0
    contact_depth: float = 1.0
    loop_behind: bool = True
    tells_duty: bool = True
    tells_asked: bool = False
    one_packet: bool = True
    never_early: bool = False


@dataclass(frozen=True)
class Seen:
    """What runs show of a robot's motion.

    Attributes:
        speed: rad/s, (joints,) that the commands often ask for. low, high: rad, between which the joint was seen.
        encoder_rad: the steps of its encoders, 0 where none show.
    """

    speed: Array
    low: Array
    high: Array
    encoder_rad: float


@dataclass(frozen=True)
class Reference:
    """The given model's own numbers, per joint, by which sizes of effects are drawn and bounded.

    Attributes:
        torque: N·m, what its servo usually gives. stiffness, damping, limit, armature, friction: as the model says; limit may be inf.
        robot_kg: mass of everything that is not the world.
        floor: whether some run stands on a floor. imu, tracker: whether some run has them.
        seen: what the runs show.
    """

    torque: Array
    stiffness: Array
    damping: Array
    limit: Array
    armature: Array
    friction: Array
    robot_kg: float
    floor: bool
    imu: bool
    tracker: bool
    seen: Seen

    @property
    def speed(self) -> Array:
        return self.seen.speed

    @property
    def low(self) -> Array:
        return self.seen.low

    @property
    def high(self) -> Array:
        return self.seen.high

    @classmethod
    def of(cls, plant: Plant, *, floor: bool, imu: bool, tracker: bool, seen: Seen) -> Reference:
        n, model = range(len(plant.joints)), plant.model

        def read(number: Callable[[mujoco.MjModel, Plant, int], float]) -> Array:
            return np.array([number(model, plant, j) for j in n])

        world = set(np.flatnonzero(model.body_weldid == 0).tolist())
        mass = float(sum(model.body_mass[k] for k in range(model.nbody) if k not in world))
        return cls(
            torque=read(usual_torque),
            stiffness=read(read_stiffness),
            damping=np.maximum(read(read_damping) + read(read_velocity_gain), 1e-6),
            limit=read(torque_limit),
            armature=read(read_armature),
            friction=read(read_friction),
            robot_kg=max(mass, 1e-3),
            floor=floor,
            imu=imu,
            tracker=tracker,
            seen=seen,
        )


@dataclass
class Cable:
    """What a cable does to the torso: force_n (3,) in the world, damping_n_s_m, and a spring to where the robot started."""

    force_n: Array = field(default_factory=lambda: np.zeros(3))
    damping_n_s_m: float = 0.0
    stiffness_n_m: float = 0.0


@dataclass
class Robot:
    """How one robot differs from the model; nothing at all as it is made. Arrays are (joints,).

    Attributes:
        low, high: rad, between which each joint was seen to move.
        scale: kind → factor on what the model says ("stiffness", "damping" with the velocity gain, "armature",
            "torque_limit", "link_mass"). lacks: kind → the part of it that the motor lacks, not its loop.
        add: kind → what comes on top ("coulomb_friction", N·m; "armature", kg·m²).
        zero: rad, added to what the encoder reads. start: rad, how far from where the runs begin it rests, as dry friction
            lets it. length: factors on the links. delay, lag: s, of commands. slew: rad/s, inf for none.
        no_load: rad/s at which the torque limit has fallen to nothing, inf for none.
        electrical: share of the damping that goes with the torque.
        stop_low, stop_high: rad, where a stop stands that should not be there; ∓inf for none.
        play: rad. compliance: rad per N·m.
        derating: share of the torque lost per °C of heat, see `laws`; derating_s: s, how fast it comes; heat_c: °C as a run
            begins; warming_c: more from run to run.
        laws: (effect, parameter) → values of the effects that act between steps (`openant_tools.effects`).
        payload_kg, payload_m: (3,) in the torso's frame. torso_kg: added to it.
        floor_friction, softness, contact_damping, contact_give, contact_depth, impratio: factors; `give` on how far from rigid
            contacts are (solimp), the last on how much stiffer friction is than contact.
        adhesion_n: force of each foot. tilt: (2,) rad, how far downhill lies along the floor's x and y.
        jitter_s: deviation of when a command acts. dropout: share of commands lost, (joints,); longest_s: at a stretch.
        shared_dropout: all joints lose the same commands.
        switching: when torque goes or comes, between the earliest (−1) and the latest (1) that a log's rows leave open.
        log_delay: s by which a signal's log lags: "pos", "vel", "imu", "acc" beyond that, "base".
        imu_rotation: (3,) rad. gyro_bias (3,) rad/s, acc_bias (3,) m/s². base_scale, base_yaw: of the tracker.
        noise: signal → deviation of one sample; what else its sensors do by chance.
        form: of its simulation. creeps: whether joints that dry friction holds give way as they do in MuJoCo by default.
    """

    joints: int
    low: Array = field(default_factory=lambda: np.zeros(0))
    high: Array = field(default_factory=lambda: np.zeros(0))
    scale: dict[str, Array] = field(default_factory=dict)
    lacks: dict[str, Array] = field(default_factory=dict)
    add: dict[str, Array] = field(default_factory=dict)
    zero: Array = field(init=False)
    start: Array = field(init=False)
    length: Array = field(init=False)
    delay: Array = field(init=False)
    lag: Array = field(init=False)
    slew: Array = field(init=False)
    no_load: Array = field(init=False)
    electrical: Array = field(init=False)
    stop_low: Array = field(init=False)
    stop_high: Array = field(init=False)
    play: Array = field(init=False)
    compliance: Array = field(init=False)
    derating: Array = field(init=False)
    derating_s: float = 20.0
    heat_c: float = 0.0
    warming_c: float = 0.0
    laws: dict[tuple[str, str], Array] = field(default_factory=dict)
    payload_kg: float = 0.0
    payload_m: Array = field(default_factory=lambda: np.zeros(3))
    torso_kg: float = 0.0
    floor_friction: float = 1.0
    softness: float = 1.0
    contact_damping: float = 1.0
    contact_give: float = 1.0
    contact_depth: float = 1.0
    impratio: float = 1.0
    adhesion_n: float = 0.0
    tilt: Array = field(default_factory=lambda: np.zeros(2))
    cable: Cable = field(default_factory=Cable)
    jitter_s: float = 0.0
    dropout: Array = field(init=False)
    longest_s: float = 0.1
    shared_dropout: bool = True
    switching: float = 0.0
    log_delay: dict[str, float] = field(default_factory=dict)
    imu_rotation: Array = field(default_factory=lambda: np.zeros(3))
    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))
    acc_bias: Array = field(default_factory=lambda: np.zeros(3))
    base_scale: float = 1.0
    base_yaw: float = 0.0
    noise: dict[str, float] = field(default_factory=dict)
    form: Form | None = None
    creeps: bool = False

    def __post_init__(self) -> None:
        n = self.joints
        for name in ("zero", "start", "delay", "lag", "electrical", "play", "compliance", "derating", "dropout"):
            setattr(self, name, np.zeros(n))
        self.length = np.ones(n)
        self.slew, self.no_load = np.full(n, np.inf), np.full(n, np.inf)
        self.stop_low, self.stop_high = np.full(n, -np.inf), np.full(n, np.inf)

    def copy(self) -> Robot:
        return copy.deepcopy(self)

    def factor(self, kind: str) -> Array:
        """The factor of a kind, to be changed in place."""
        return self.scale.setdefault(kind, np.ones(self.joints))

    def weaken(self, kind: str, joints: NDArray[np.int64], factor: float) -> None:
        """Scale what the motors of some joints make of what they are asked."""
        self.factor(kind)[joints] *= factor
        self.lacks.setdefault(kind, np.ones(self.joints))[joints] *= factor

    def more(self, kind: str) -> Array:
        """What is added to a kind, to be changed in place."""
        return self.add.setdefault(kind, np.zeros(self.joints))

    def law(self, effect: str, parameter: str) -> Array:
        """An effect's parameter, to be changed in place."""
        return self.laws.setdefault((effect, parameter), np.zeros(self.joints))

    def model(self, plant: Plant, scratch: mujoco.MjData | None = None) -> mujoco.MjModel:
        """A variant of the plant's model with all of this that a compiled model can carry.

        Args:
            scratch: of the plant's model, to compute with, where many variants are made: it takes longer to make than to use.
        """
        model = copy.copy(plant.model)
        for kind, factors in self.scale.items():
            if kind == "link_mass":
                for j in np.flatnonzero(factors != 1.0):
                    scale_mass(model, link_bodies(model, plant, int(j)), float(factors[j]))
                continue
            for read, write in _NUMBERS[kind]:
                for j in np.flatnonzero(factors != 1.0):
                    value = read(plant.model, plant, int(j))
                    if np.isfinite(value) and value != 0:
                        write(model, plant, int(j), float(value * factors[j]))
        for kind, amounts in self.add.items():
            ((read, write),) = _NUMBERS[kind]
            for j in np.flatnonzero(amounts):
                write(model, plant, int(j), max(read(model, plant, int(j)) + float(amounts[j]), 0.0))
        for j in np.flatnonzero(self.length != 1.0):
            _stretch(model, link_bodies(model, plant, int(j)), float(self.length[j]))
        shared = self.electrical > 0
        model.dof_damping[plant.dof[shared]] *= 1 - self.electrical[shared]
        if not self.creeps:
            hold_still(model, plant)
        self._body(model, plant)
        mujoco.mj_setConst(model, scratch or mujoco.MjData(model))
        return model

    def _body(self, model: mujoco.MjModel, plant: Plant) -> None:
        torso = torso_body(model, plant)
        if self.torso_kg and model.body_mass[torso] > 0:
            scale_mass(model, np.array([torso]), max(0.1, 1 + self.torso_kg / float(model.body_mass[torso])))
        if self.payload_kg and torso:
            add_mass(model, torso, self.payload_kg, self.payload_m)
        contacts = floor_contacts(model)
        model.geom_friction[contacts.geoms, 0] *= self.floor_friction
        model.pair_friction[contacts.pairs, :2] *= self.floor_friction
        mine = self.softness, self.contact_damping, self.contact_give, self.contact_depth
        _soften(model.geom_solref, model.geom_solimp, contacts.geoms, *mine)
        _soften(model.pair_solref, model.pair_solimp, contacts.pairs, *mine)
        model.opt.impratio *= self.impratio
        if (form := self.form) is not None:
            like = 1.0, form.contact_damping, form.contact_give, form.contact_depth
            _soften(model.geom_solref, model.geom_solimp, contacts.geoms, *like)
        if self.adhesion_n:
            # Where the floor has priority, it alone decides what its contacts are like.
            model.flg_adhesion = True
            model.geom_adhesion[contacts.geoms] = self.adhesion_n
        if self.tilt.any():
            model.opt.gravity[:] = tilted(plant.model.opt.gravity, self.tilt)


def _soften(
    solref: Array, solimp: Array, at: NDArray[np.int64], softness: float, damping: float, give: float, depth: float
) -> None:
    """Multiply what contacts are like, in place: time constant, damping ratio, how far from rigid, and how deep that is reached."""
    standard = solref[at, :1] > 0  # else it holds stiffness and damping themselves
    solref[at] *= np.where(standard, [softness, damping], 1.0)
    if give != 1:  # else nothing is rounded
        solimp[at, :2] = 1 - (1 - solimp[at, :2]) * give
    solimp[at, 2] *= depth


def _stretch(model: mujoco.MjModel, bodies: NDArray[np.int64], factor: float) -> None:
    """Make links longer: where their own shapes, masses and the links after them are, in the frames of their joints."""
    moved = np.flatnonzero(np.isin(model.body_parentid, bodies))
    model.body_pos[moved] *= factor
    model.body_ipos[bodies] *= factor
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
    model.geom_pos[geoms] *= factor
    rods = geoms[np.isin(model.geom_type[geoms], _RODS)]
    model.geom_size[rods, 1] *= factor


def add_mass(model: mujoco.MjModel, body: int, mass: float, position: Array) -> None:
    """Fix a point mass (kg) to a body at a position in its frame; the inertia stays physical, its axes stay the body's."""
    old, com = float(model.body_mass[body]), model.body_ipos[body].copy()
    total = old + mass
    centre = (old * com + mass * position) / total
    reduced = old * mass / total
    apart = position - com
    # The point mass adds its moment about the common centre; off-diagonal parts are dropped with the axes kept.
    model.body_inertia[body] += reduced * (apart @ apart - apart**2)
    model.body_mass[body], model.body_ipos[body] = total, centre


def tilted(gravity: Array, tilt: Array) -> Array:
    """Gravity as a floor inclined by `tilt` (rad, towards downhill along its x and y) feels it; its norm stays."""
    angle = float(np.hypot(*tilt))
    downhill = tilt / max(angle, 1e-12) * np.sin(angle)
    down = np.array([downhill[0], downhill[1], -np.cos(angle)])
    out: Array = down * float(np.linalg.norm(gravity))
    return out


#: kind of a scale or an amount → how each number of a servo that it stands for is read and set
_NUMBERS = {
    "stiffness": ((read_stiffness, write_stiffness),),
    "damping": ((read_damping, write_damping), (read_velocity_gain, write_velocity_gain)),
    "armature": ((read_armature, write_armature),),
    "torque_limit": ((torque_limit, write_torque_limit),),
    "coulomb_friction": ((read_friction, write_friction),),
}
#: shapes whose second size is half their length
_RODS = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
#: signal → the sensors' own noise of one sample where nothing is known of them
USUAL_NOISE: Mapping[str, float] = {
    "pos": 0.0008, "vel": 0.024, "torque": 0.02, "volt": 0.004, "gyro": 0.01, "acc": 0.08, "base": 0.002, "yaw": 0.007,
}  # fmt: skip
