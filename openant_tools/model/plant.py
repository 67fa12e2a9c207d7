"""A model set up for one kind of run: compiled, its position servos found, ready to be rolled out.

One MJCF serves two setups (formats, section 1). On the **stand** the free joint is removed, the torso stays where the
model puts it, gravity is on and nothing of the robot touches the world; contacts of the robot with itself stay as in
the model. On the **floor** the model is compiled as it is.
"""

from __future__ import annotations

import copy
import difflib
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.model.attribute import Stated, set_stated
from openant_tools.model.stripped import strip_colliding, strip_visual
from openant_tools.numbers import number
from openant_tools.robot.model_file import check_model_file

__all__ = [
    "Plant",
    "Setup",
    "beside_servos",
    "is_filtered",
    "is_motor",
    "load_plant",
    "position_servos",
    "setup_of",
    "without_words",
    "world_bodies",
]

_log = logging.getLogger(__name__)

Ints = NDArray[np.int64]

#: an actuator in this group is one whose torque is off: it is disabled as a group, which is how MuJoCo drops its force
TORQUE_OFF_GROUP = 30


class Setup(StrEnum):
    """How the robot stands in a run."""

    STAND = "stand"
    FLOOR = "floor"


def setup_of(words: str | None) -> Setup:
    """The setup that a run's `setup` means: `floor`, or anything else (a bench, a stand, nothing said) as fixed."""
    return Setup.FLOOR if words is not None and words.strip().lower() == Setup.FLOOR else Setup.STAND


@dataclass(frozen=True)
class Form:
    """What `load_plant` made of the servos, so that a model of the same layout can be had again."""

    electrical: bool = False
    delayed: bool = False
    lagging: bool = False


@dataclass(frozen=True)
class Plant:
    """A compiled model and where its position servos are in it.

    Attributes:
        model: compiled for `setup`.
        setup: stand or floor.
        joints: names of the servo joints, in the order asked for.
        qpos, dof: (joints,) addresses of each joint's position and velocity.
        actuator: (joints,) id of the actuator that drives each joint.
        ctrl: (joints,) address of that actuator's position setpoint in `ctrl`.
        tree: (joints,) kinematic tree of each joint; joints of different trees do not move each other on the stand.
        path: the file the model was read from.
        form: what was made of its servos.
        step_s: the model's own time step, where it is simulated in others; see `lead_s`.
    """

    model: mujoco.MjModel
    setup: Setup
    joints: tuple[str, ...]
    qpos: Ints
    dof: Ints
    actuator: Ints
    ctrl: Ints
    tree: Ints
    path: Path
    form: Form = Form()
    step_s: float | None = None

    @property
    def timestep(self) -> float:
        return float(self.model.opt.timestep)

    @property
    def lead_s(self) -> float:
        """By how much earlier than in the model's own steps commands act.

        A step's force is that of its beginning and its command the mean over all of it, which so acts early by half a step.
        """
        return 0.0 if self.step_s is None else (self.timestep - self.step_s) / 2

    def stepped(self, timestep: float) -> Plant:
        """The same in other steps, which stand for those of the model."""
        model = copy.copy(self.model)
        model.opt.timestep = timestep
        return replace(self, model=model, step_s=self.timestep if self.step_s is None else self.step_s)

    @property
    def encoder_delay_s(self) -> float:
        """By how much later than it was a position is said, by sensors `pos.J` with a delay.

        Raises:
            BadInput: joints differ in that.
        """
        model = self.model
        ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, f"pos.{joint}") for joint in self.joints]
        delays = {float(model.sensor_delay[i]) if i >= 0 else 0.0 for i in ids}
        if len(delays) > 1:
            raise BadInput(
                f"sensors pos.J say positions up to {number(max(delays), 's')} late, but not all of them the same",
                where=self.path, remedy="give them one delay",
            )  # fmt: skip
        return delays.pop()

    @property
    def free_joint(self) -> int | None:
        """The id of the free joint of the base, None on the stand or where the model has none."""
        free = np.flatnonzero(self.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        return int(free[0]) if len(free) else None

    def restated(self, values: Stated) -> mujoco.MjModel:
        """The model with other values in some attributes of its file: compiled anew, of the same layout.

        Raises:
            BadInput: MuJoCo cannot compile it with these.
        """
        form = self.form
        again = load_plant(
            self.path,
            self.joints,
            self.setup,
            electrical=form.electrical,
            delayed=form.delayed,
            lagging=form.lagging,
            stated=values,
        )
        again.model.opt.timestep = self.timestep  # which a plant may have changed since it was loaded
        return again.model

    def with_torque_off(self, model: mujoco.MjModel, off: NDArray[np.bool_]) -> mujoco.MjModel:
        """A copy of `model` (same layout as the plant's) in which the joints marked in `off` have no torque."""
        if not off.any():
            return model
        limp = copy.copy(model)
        limp.actuator_group[self.actuator[off]] = TORQUE_OFF_GROUP
        limp.opt.disableactuator |= 1 << TORQUE_OFF_GROUP
        return limp


def without_words() -> None:
    """Let MuJoCo say nothing on the terminal, and write no file where this process happens to run.

    That a simulation falls apart is said by who asked for it. Each process has to be told by itself, also one that was handed a plant.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_log.debug)


def load_plant(
    path: Path | str,
    joints: Sequence[str] | None = None,
    setup: Setup = Setup.STAND,
    *,
    electrical: bool = False,
    delayed: bool = False,
    lagging: bool = False,
    stated: Stated | None = None,
    drawn: bool = False,
) -> Plant:
    """Read an MJCF and set it up.

    Args:
        path: the MJCF.
        joints: names of the joints to play and compare; None takes every joint that a position servo drives.
        setup: stand or floor.
        electrical: turn position servos into DC motors that move as they do (`motor_form`), so that a part of the joint's
            damping can be made back-EMF.
        delayed: give every servo a buffer of past commands, so that it can act late by up to LONGEST_DELAY_S; the delay
            itself stays what the model says.
        lagging: filter the setpoint of every servo that can have it (`filter_form`), with no lag as yet. What is filtered
            does not become a DC motor: MuJoCo's has no filter.
        stated: attributes of the file that are to have other values.
        drawn: keep what only a picture shows: textures, and meshes whole. Without them every copy is as small as its physics.

    Raises:
        BadInput: the file is missing or MuJoCo cannot load it, it has no position-controlled joint, or it lacks one of
            `joints`.
    """
    path = Path(path)
    without_words()
    # What cannot be compiled without its looks may compile with them, or MuJoCo says what is wrong with the file itself.
    whole = partial(
        load_plant, path, joints, setup,
        electrical=electrical, delayed=delayed, lagging=lagging, stated=stated, drawn=True,
    )  # fmt: skip
    if not path.is_file():
        raise BadInput("no such model file", where=path, remedy="name an MJCF with --model MODEL.xml")
    check_model_file(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        set_stated(spec, stated or {})
        if not drawn:
            strip_visual(spec)
        original = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        if not drawn:
            return whole()
        words = " ".join(str(error).split())
        remedy = "mend the file at the place it names"
        raise BadInput(f"MuJoCo cannot load it: {words}", where=path, remedy=remedy) from error
    if original.nu == 0:
        raise BadInput(
            "the model has no actuators", where=path, remedy="give each joint a <position> actuator in its MJCF"
        )
    servos = position_servos(original)
    if not servos:
        raise BadInput(
            "no joint of the model is driven by a position servo",
            where=path,
            remedy="use <position> actuators (or <general> with biasprm '0 -kp -kv', <pid>, <dcmotor input=\"pos\">)",
        )
    if joints is None:
        joints = list(servos)
    for joint in joints:
        if joint not in servos:
            near = difflib.get_close_matches(joint, list(servos), n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"its position-controlled joints are {', '.join(servos)}"
            raise BadInput(f"the model has no position-controlled joint {joint!r}", where=path, remedy=hint)

    for joint in joints if electrical or delayed or lagging else ():
        filtered = lagging and filter_form(spec.actuators[servos[joint]], original)
        if electrical and not filtered:
            motor_form(spec.actuators[servos[joint]], original, joint)
        if delayed:
            buffer_commands(spec.actuators[servos[joint]], LONGEST_DELAY_S, original.opt.timestep)
    if electrical or delayed or lagging:
        original = spec.compile()
    if setup is Setup.STAND:
        _put_on_stand(spec, original)
    try:
        stripped = not drawn and strip_colliding(spec, original)
        model = spec.compile() if stripped or setup is Setup.STAND else original
    except ValueError:
        if drawn:
            raise
        return whole()
    actuator = [servos[joint] for joint in joints]
    ids = [model.joint(joint).id for joint in joints]
    dof = model.jnt_dofadr[ids].astype(np.int64)
    return Plant(
        model=model,
        setup=setup,
        joints=tuple(joints),
        qpos=model.jnt_qposadr[ids].astype(np.int64),
        dof=dof,
        actuator=np.array(actuator, np.int64),
        ctrl=model.actuator_ctrladr[actuator].astype(np.int64),
        tree=model.dof_treeid[dof].astype(np.int64),
        path=path,
        form=Form(electrical, delayed, lagging),
    )


def position_servos(model: mujoco.MjModel) -> dict[str, int]:
    """Joint name → id of the actuator that controls its position, in the order of the actuators.

    A position servo pulls towards its setpoint: affine bias −kp on the joint's position (`position`, `general`, `pid`),
    or a DC motor, and its control is a position. Where several drive one joint, the one of the joint's own name counts.
    """
    servos: dict[str, int] = {}
    for i in range(model.nactuator):
        if not _pulls_to_setpoint(model, i):
            continue
        name = model.joint(int(model.actuator_trnid[i, 0])).name
        if name not in servos or model.actuator(i).name == name:
            servos[name] = i
    return servos


def beside_servos(model: mujoco.MjModel, joint: int, servo: int) -> list[int]:
    """Ids of the other position servos of the joint (an id) that the actuator `servo` drives."""
    return [
        i
        for i in range(model.nactuator)
        if i != servo and _pulls_to_setpoint(model, i) and int(model.actuator_trnid[i, 0]) == joint
    ]


def _pulls_to_setpoint(model: mujoco.MjModel, i: int) -> bool:
    """Whether an actuator controls the position of a hinge or slide."""
    # Of such joints, `jointinparent` is the same as `joint`.
    if int(model.actuator_trntype[i]) not in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        return False
    joint = int(model.actuator_trnid[i, 0])
    if int(model.jnt_type[joint]) not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
        return False
    inputs = int(model.actuator_ctrlspec[i])  # 0 where it is not said, as in `general`
    if inputs and not inputs & POSITION_INPUT:
        return False
    if model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_INTEGRATOR:
        return False  # `intvelocity`: its control is a velocity
    affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and model.actuator_biasprm[i, 1] < 0
    return bool(affine or is_motor(model, i))


#: What `motor_form` leaves in a DC motor of the joint's damping: as little as can be told from none, since its motor
#: constant must be positive.
LEAST_SHARE = 1e-4
#: indices into a DC motor's gainprm (MuJoCo 4, checked by a test): resistance, motor constant, gains, voltage limit
RESISTANCE, MOTOR_CONSTANT, KP, KD, VMAX = 0, 1, 4, 6, 7
#: `input="pos"`
POSITION_INPUT = int(mujoco.mjtCtrlInput.mjINPUT_POS)


def motor_form(actuator: mujoco.MjsActuator, model: mujoco.MjModel, joint: str) -> bool:
    """Turn a position servo of a spec into a DC motor that moves the joint in the same way; False where that cannot be.

    A servo's duty is clipped, τ = clip(kp e − kv ω, ±L), and its back-EMF brakes on top of that, clip or not, as long as
    it has torque. A `position` actuator has nowhere to put the second part: joint damping stays without torque, and kv
    is clipped. In MuJoCo's DC motor of constant K and resistance 1 Ω both are right: the share K² of the damping is back-EMF,
    the derivative gain K² + kv takes back the compensation that its controller would add, and Vmax = L / K clips the duty.

    A servo whose setpoint is filtered, whose force is unlimited, or whose joint has no damping stays as it is.
    """
    i = actuator.id
    dof = int(model.jnt_dofadr[model.joint(joint).id])
    damping = float(model.dof_damping[dof])
    plain = (
        model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
        and math.isclose(model.actuator_gainprm[i, 0], -model.actuator_biasprm[i, 1], rel_tol=1e-9)
        and model.actuator_biasprm[i, 0] == 0
        and model.actuator_forcelimited[i]
        and math.isclose(model.actuator_forcerange[i, 0], -model.actuator_forcerange[i, 1])
        and np.array_equal(model.actuator_gear[i], [1, 0, 0, 0, 0, 0])
        and damping > 0
    )
    if not plain:
        return False
    stiffness, velocity = float(model.actuator_gainprm[i, 0]), -float(model.actuator_biasprm[i, 2])
    limit = float(model.actuator_forcerange[i, 1])
    back_emf = LEAST_SHARE * damping
    constant = math.sqrt(back_emf)
    actuator.set_to_dcmotor(
        motorconst=[constant, constant],
        resistance=1.0,
        controller=[stiffness, 0.0, velocity + back_emf, 0.0, 0.0, limit / constant],
        ctrlspec=POSITION_INPUT,
    )
    actuator.forcelimited = 0
    actuator.forcerange = [0.0, 0.0]
    return True


def filter_form(actuator: mujoco.MjsActuator, model: mujoco.MjModel) -> bool:
    """Let the setpoint of a position servo of a spec pass a first-order filter (`timeconst`); False where that cannot be.

    Its time constant is 0 until it is set (`set_lag`). A servo that has a filter keeps it.
    """
    i = actuator.id
    plain = (
        model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
    )
    if plain:
        actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        actuator.dynprm[0] = 0.0
        actuator.actearly = 1
    return plain or is_filtered(model, i)


def set_lag(model: mujoco.MjModel, actuator: int, time_constant: float) -> None:
    """Set the time constant (s) of a filtered servo.

    A filter shows a setpoint one step after it came, which is how a file's `timeconst` acts. Without lag there is no filter:
    there the setpoint must act at once, which MuJoCo calls early.
    """
    model.actuator_dynprm[actuator, 0] = time_constant
    model.actuator_actearly[actuator] = time_constant <= 0


def is_filtered(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator's setpoint passes a first-order filter."""
    return int(model.actuator_dyntype[actuator]) in (
        int(mujoco.mjtDyn.mjDYN_FILTER),
        int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
    )


#: s; the longest delay of a command that a fit considers: several periods of a 50 Hz loop
LONGEST_DELAY_S = 0.1
#: `interp="linear"`: with a zero-order hold a delay moves by whole steps only, and a fit cannot follow it
LINEAR = 1


def buffer_commands(actuator: mujoco.MjsActuator, longest_s: float, timestep: float) -> None:
    """Give an actuator a buffer for delays up to `longest_s`, unless it has a longer one; its delay stays as it is."""
    actuator.nsample = max(int(actuator.nsample), samples_for(longest_s, timestep))
    actuator.interp = max(int(actuator.interp), LINEAR)


def samples_for(delay_s: float, timestep: float) -> int:
    """The commands that a buffer must hold to be read `delay_s` late, with one on each side to interpolate."""
    return math.ceil(delay_s / timestep - 1e-9) + 2


def is_motor(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator is a DC motor."""
    return bool(model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_DCMOTOR)


def _put_on_stand(spec: mujoco.MjSpec, original: mujoco.MjModel) -> None:
    """Fix the base of `spec` and keep it from touching the world; `original` is the same spec, compiled as it was given."""
    weld, parent = original.body_weldid, original.body_parentid
    # Elements keep the ids of the first compilation until the next, so the original's tables describe the spec's.
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    world = world_bodies(original)
    for geom in spec.geoms:
        if int(original.geom_bodyid[geom.id]) in world:
            geom.contype = geom.conaffinity = 0
    for pair in list(spec.pairs):
        ends = original.geom(pair.geomname1).bodyid, original.geom(pair.geomname2).bodyid
        if any(int(body[0]) in world for body in ends):
            spec.delete(pair)

    # Once the base is welded to the world, MuJoCo's parent-child filter no longer keeps it from touching its own legs.
    # The pairs that the filter kept apart before are excluded by name, so that self-contacts stay as in the model.
    bodies = {body.id: body for body in spec.bodies}
    filters = not original.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    bases = {int(weld[joint.parent.id]) for joint in free} if filters else set()
    for child in range(1, original.nbody):
        above = int(weld[parent[weld[child]]])
        if above not in bases or int(weld[child]) == above:
            continue
        for base in np.flatnonzero(weld == above):
            for body in (bodies[int(base)], bodies[child]):
                body.name = body.name or f"unnamed_body_{body.id}"
            spec.add_exclude(bodyname1=bodies[int(base)].name, bodyname2=bodies[child].name)
    for joint in free:
        spec.delete(joint)
    for key in list(spec.keys):
        spec.delete(key)  # a keyframe's qpos counts the free joint's seven numbers


def world_bodies(model: mujoco.MjModel) -> set[int]:
    """The bodies that are the world: all that cannot move, but for what carries a joint, which is a robot's fixed base."""
    fixed = model.body_weldid == 0
    world = set(np.flatnonzero(fixed).tolist())
    for body in np.flatnonzero(~fixed):
        above = int(model.body_parentid[body])
        while above != 0 and fixed[above]:
            world.discard(above)
            above = int(model.body_parentid[above])
    return world
