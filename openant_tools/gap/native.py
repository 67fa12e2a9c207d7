"""Effects written into an MJCF with MuJoCo's own features: edits of the text that `model.mjcf.write_model` has written.

Forms of servos: what is slow to move its setpoint becomes a `pid`; what brakes by back-EMF, or gives less torque the faster
it turns, a `dcmotor`. Friction and cogging of gears stay without torque, so they stand in a `dcmotor` of their own that has no
control (`input="none"`): the file has no more controls than before. Play and compliance are hinges in series.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import NDArray

from openant_tools.gap.laws import DAMPED, HARD, TEETH
from openant_tools.gap.robot import Robot, tilted
from openant_tools.model.body import torso_body
from openant_tools.model.mjcf import actuator_element, in_degrees, joint_element, number, numbers
from openant_tools.model.plant import Plant, is_filtered, is_motor, samples_for

__all__ = ["BRISTLE_RAD", "Edit", "edit"]

Array = NDArray[np.float64]
Element = etree._Element

#: what stands in for none where MuJoCo wants a positive motor constant: its back-EMF is the square
NO_MOTOR = 1e-5
#: rad that teeth bend before they slide (LuGre), the share of the stiffest spring that a step can follow, and the share of
#: its critical damping: more of it is carried into the sliding
BRISTLE_RAD, BRISTLE_STEP, BRISTLE_DAMPING = 3e-4, 0.2, 0.05
#: share of the friction at rest that is left at speed at least: with none, bristles have nothing to slide on
LEAST_SLIDING = 0.05
#: of stops: how little of their spring gives way
STOP_IMPEDANCE = "0.99 0.9999 0.0001"
#: m from the torso to where the cable's tendons end: their direction and length change by a per cent while it walks a metre
FAR_M = 100.0


@dataclass
class Edit:
    """What was done to a file.

    Attributes:
        notes: what it does not carry as simulated, one line each.
        hinges: joint → the hinges put in series with it.
    """

    notes: list[str]
    hinges: dict[str, list[str]]


def edit(root: Element, plant: Plant, robot: Robot) -> Edit:
    """Put into a document what a compiled variant cannot say.

    Args:
        root: of the document, as written for the plant.
        plant: compiled from it, on the floor.
        robot: how it differs; what `Robot.model` changes is in the document already.
    """
    done = Edit([], {})
    for j, joint in enumerate(plant.joints):
        _servo(root, plant, robot, j, done)
        _stops(root, plant, robot, j)
        _gears(root, plant, robot, j)
        _series(root, plant, robot, j, done)
        _encoder(root, plant, robot, joint, done.hinges.get(joint, ()))
    _body(root, plant, robot, done)
    _imu(root, plant, robot, done)
    return done


def _servo(root: Element, plant: Plant, robot: Robot, j: int, done: Edit) -> None:
    """The servo of joint j: what its setpoint passes, and what its torque follows."""
    model, i, joint = plant.model, int(plant.actuator[j]), plant.joints[j]
    element = actuator_element(root, plant, j)
    lag = float(robot.lag[j]) + (float(model.actuator_dynprm[i, 0]) if is_filtered(model, i) else 0.0)
    slew, no_load = float(robot.slew[j]), float(robot.no_load[j])
    dof = int(plant.dof[j])
    share = float(robot.electrical[j])
    slope = share / (1 - share) * float(model.dof_damping[dof])
    stiffness, velocity, limit = _loop(model, i)
    motor = (slope > 0 or math.isfinite(no_load)) and math.isfinite(limit)
    if lag > 0 and (motor or math.isfinite(slew)):
        done.notes.append(f"{joint}: MuJoCo filters no setpoint of such a servo; its lag acts as a delay as long")
    if motor or is_motor(model, i):
        _as_motor(root, element, model, i, stiffness, velocity, limit, slope, no_load, slew, joint)
    elif math.isfinite(slew):
        _as_pid(element, model, i, stiffness, velocity + slope, limit, slew)
    elif slope > 0:
        _set_gains(element, stiffness, velocity + slope)
    filtered = element.tag in ("position", "general")
    if robot.lag[j] > 0 and filtered:
        # MuJoCo shows what its filter says a step later, which belongs to the lag.
        lag = max(lag - plant.timestep, 0.1 * lag)
        if element.tag == "general":
            element.set("dyntype", "filterexact")
            element.set("dynprm", number(lag))
        else:
            element.set("timeconst", number(lag))
    late = float(model.actuator_delay[i]) + float(robot.delay[j]) + (0.0 if filtered else lag)
    if late > 0 and late != float(model.actuator_delay[i]):
        element.set("delay", number(late))
        element.set("nsample", str(max(int(model.actuator_history[i, 0]), samples_for(late, plant.timestep))))
        element.set("interp", "linear")


def _loop(model: mujoco.MjModel, i: int) -> tuple[float, float, float]:
    """Stiffness, velocity gain and torque limit of a servo."""
    if is_motor(model, i):
        resistance, constant, _, _, kp, _, kd, vmax = model.actuator_gainprm[i][:8]
        return float(kp), float(kd - constant**2 / resistance), float(constant * vmax / resistance)
    limit = float(model.actuator_forcerange[i, 1]) if model.actuator_forcelimited[i] else math.inf
    return -float(model.actuator_biasprm[i, 1]), -float(model.actuator_biasprm[i, 2]), limit


def _set_gains(element: Element, stiffness: float, velocity: float) -> None:
    if element.tag == "general":
        element.set("gainprm", numbers([stiffness]))
        element.set("biasprm", numbers([0.0, -stiffness, -velocity]))
    else:
        element.set("kp", number(stiffness))
        element.attrib.pop("dampratio", "")
        element.set("kv", number(velocity))


#: attributes that every servo has with the same meaning
_KEPT = ("name", "joint", "user", "delay", "nsample", "interp")


def _bare(element: Element, model: mujoco.MjModel, i: int, tag: str) -> None:
    """Another kind of servo in the place of this one; what its class said of it, it says itself."""
    kept = {name: value for name, value in element.attrib.items() if name in _KEPT}
    element.tag = tag
    element.attrib.clear()
    for name, value in kept.items():
        element.set(name, value)
    if model.actuator_ctrllimited[i]:
        element.set("ctrlrange", numbers(model.actuator_ctrlrange[i]))
    samples, interpolation = (int(value) for value in model.actuator_history[i])
    if samples:
        element.set("nsample", str(samples))
        element.set("interp", ("zoh", "linear", "cubic")[interpolation])
        element.set("delay", number(model.actuator_delay[i]))
    for name, value in (("armature", model.actuator_armature[i]), ("damping", model.actuator_damping[i])):
        if value:
            element.set(name, number(value))
    if model.actuator_group[i]:
        element.set("group", str(model.actuator_group[i]))


def _as_pid(
    element: Element, model: mujoco.MjModel, i: int, stiffness: float, velocity: float, limit: float, slew: float
) -> None:
    _bare(element, model, i, "pid")
    for name, value in (("kp", stiffness), ("kv", velocity), ("slewmax", slew)):
        element.set(name, number(value))
    if math.isfinite(limit):
        element.set("forcerange", numbers([-limit, limit]))
    else:
        element.set("forcelimited", "false")


def _as_motor(
    root: Element,
    element: Element,
    model: mujoco.MjModel,
    i: int,
    stiffness: float,
    velocity: float,
    limit: float,
    slope: float,
    no_load: float,
    slew: float,
    joint: str,
) -> None:
    """A DC motor of resistance 1 Ω whose constant K decides how its torque falls with speed, by K² (plant.motor_form).

    Its controller takes its own back-EMF back, so that K² does not brake below the limit of its voltage; what is to brake
    stands in the derivative gain. Beyond, the torque falls from the limit at rest to nothing at the no-load speed where a
    speed limit is at work; where it is not, K² is the damping that the duty does not clip.
    """
    square = limit / no_load if math.isfinite(no_load) else max(slope, NO_MOTOR**2)
    constant = math.sqrt(square)
    _bare(element, model, i, "dcmotor")
    element.set("input", "pos")
    element.set("motorconst", numbers([constant, constant]))
    element.set("resistance", "1")
    element.set(
        "controller",
        numbers([stiffness, 0, velocity + slope, slew if math.isfinite(slew) else 0, 0, limit / constant]),
    )
    # It has no attribute for its force range, which braking would else exceed; a class has.
    name = f"motor_{joint}"
    defaults = root.find("default")
    if defaults is None:
        defaults = etree.Element("default")
        root.insert(0, defaults)
    made = etree.SubElement(defaults, "default", {"class": name})
    made.tail = "\n    "
    if math.isfinite(no_load):
        etree.SubElement(made, "general", forcelimited="true", forcerange=numbers([-limit, limit]))
    else:
        etree.SubElement(made, "general", forcelimited="false", forcerange="0 0")
    element.set("class", name)


def _stops(root: Element, plant: Plant, robot: Robot, j: int) -> None:
    low, high = float(robot.stop_low[j]), float(robot.stop_high[j])
    if not (math.isfinite(low) or math.isfinite(high)):
        return
    model, joint = plant.model, int(plant.model.dof_jntid[plant.dof[j]])
    element = joint_element(root, plant.joints[j], plant.path)
    reading = float(robot.zero[j])
    given = model.jnt_range[joint] if model.jnt_limited[joint] else (-2 * math.pi, 2 * math.pi)
    ends = np.array([max(given[0], low + reading), min(given[1], high + reading)])
    element.set("range", numbers(np.degrees(ends) if _turns(model, joint) and in_degrees(root) else ends))
    element.set("limited", "true")
    # It throws back as that of `laws` does.
    _stop(element, plant.timestep / (HARD / 2), math.sqrt(HARD) / 2)


def _stop(joint: Element, seconds: float, damping: float) -> None:
    """The time constant and the damping ratio of a joint's ends."""
    joint.set("solreflimit", numbers([seconds, damping]))
    joint.set("solimplimit", STOP_IMPEDANCE)


def _turns(model: mujoco.MjModel, joint: int) -> bool:
    return bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE)


def _gears(root: Element, plant: Plant, robot: Robot, j: int) -> None:
    """Friction and torque of the gears, with or without current."""

    def law(effect: str, parameter: str) -> float:
        values = robot.laws.get((effect, parameter))
        return 0.0 if values is None else float(values[j])

    joint = plant.joints[j]
    quadratic = law("viscous_nonlinear", "coefficients")
    if quadratic:
        element = joint_element(root, joint, plant.path)
        element.set("damping", numbers([plant.model.dof_damping[plant.dof[j]], quadratic]))
    static = law("stribeck_friction", "static_nm")
    if static:
        # The joint's own dry friction slides on the same bristles.
        own = float(plant.model.dof_frictionloss[plant.dof[j]])
        joint_element(root, joint, plant.path).set("frictionloss", "0")
        inertia = max(float(plant.model.dof_M0[plant.dof[j]]), 1e-6)
        rest = own + static
        stiffness = min(rest / BRISTLE_RAD, BRISTLE_STEP * inertia / plant.timestep**2)
        bristles = [stiffness, 2 * BRISTLE_DAMPING * math.sqrt(stiffness * inertia)]
        sliding = max(own + law("stribeck_friction", "coulomb_nm"), LEAST_SLIDING * rest)
        _gear(root, joint, "friction", "lugre", [*bristles, sliding, rest, law("stribeck_friction", "velocity_rad_s")])
    amplitude = law("cogging", "amplitude_nm")
    if amplitude:
        periods = law("cogging", "periods")
        # It repeats with the gear's own angle, which the encoder reads with its zero.
        _gear(root, joint, "cogging", "cogging", [amplitude, periods, -periods * float(robot.zero[j])])


def _gear(root: Element, joint: str, what: str, attribute: str, values: Sequence[float]) -> None:
    element = etree.SubElement(
        _last(root, "actuator"), "dcmotor", name=f"{what}.{joint}", joint=joint, input="none",
        motorconst=numbers([NO_MOTOR, NO_MOTOR]), resistance="1",
    )  # fmt: skip
    element.set(attribute, numbers(values))
    element.tail = "\n  "


def _last(root: Element, tag: str) -> Element:
    """The last section of that name, made where there is none."""
    found = [element for element in root if element.tag == tag]
    if found:
        return found[-1]
    made = etree.SubElement(root, tag)
    made.text, made.tail = "\n    ", "\n"
    return made


def _series(root: Element, plant: Plant, robot: Robot, j: int, done: Edit) -> None:
    """Hinges behind the servo: play, and a spring."""
    play, compliance = float(robot.play[j]), float(robot.compliance[j])
    if not (play or compliance):
        return
    joint, model, dof = plant.joints[j], plant.model, int(plant.dof[j])
    element = joint_element(root, joint, plant.path)
    shape = {name: str(value) for name, value in element.attrib.items() if name in ("axis", "pos", "class")}
    turn = math.degrees(1.0) if _turns(model, int(model.dof_jntid[dof])) and in_degrees(root) else 1.0
    both = bool(play and compliance)
    rotor = max(float(model.dof_armature[dof]), 1e-6)
    link = max(float(model.dof_M0[dof]) - float(model.dof_armature[dof]), 1e-6)
    made = []
    for name, there in (("play", play), ("spring", compliance)):
        if not there:
            continue
        hinge = etree.Element("joint", {**shape, "name": f"{name}.{joint}"})
        if element.get("type"):
            hinge.set("type", str(element.get("type")))
        # What its class says of the servo's joint is not true of it.
        for attribute in ("damping", "frictionloss", "stiffness", "ref", "springref"):
            hinge.set(attribute, "0")
        hinge.set("armature", "1e-5" if both else "0")
        if name == "play":
            hinge.set("range", numbers([-play / 2 * turn, play / 2 * turn]))
            hinge.set("limited", "true")
            # As stiff, and as damped, as the teeth of `laws`, between the two inertias that they part.
            between = link * rotor / (link + rotor)
            ratio = DAMPED * math.sqrt(min(link, rotor) / between)
            _stop(hinge, math.sqrt(between / TEETH) / ratio, ratio)
        else:
            stiffness = 1 / compliance
            hinge.set("limited", "false")
            hinge.set("stiffness", number(stiffness))
            hinge.set("damping", number(2 * DAMPED * math.sqrt(stiffness * min(link, rotor))))
        made.append(hinge)
    at = element
    for hinge in made:
        hinge.tail = element.tail
        at.addnext(hinge)
        at = hinge
    names = [str(hinge.get("name")) for hinge in made]
    done.hinges[joint] = names
    fixed = etree.SubElement(_last(root, "tendon"), "fixed", name=f"output.{joint}")
    fixed.tail = "\n  "
    for name in (joint, *names):
        etree.SubElement(fixed, "joint", joint=name, coef="1")
    what = "play" if play else "spring"
    done.notes.append(
        f"{joint}: MuJoCo's servo measures before its {what}; pos.{joint} reads behind it, as an encoder does"
    )


def _encoder(root: Element, plant: Plant, robot: Robot, joint: str, hinges: Sequence[str]) -> None:
    """The sensors pos.J and vel.J: behind the hinges, and as late as the log."""
    for signal, tag in (("pos", "tendonpos"), ("vel", "tendonvel")):
        element = next(
            e for section in root.iter("sensor") for e in section
            if isinstance(e.tag, str) and e.get("name") == f"{signal}.{joint}"
        )  # fmt: skip
        if hinges:
            element.tag = tag
            del element.attrib["joint"]
            element.set("tendon", f"output.{joint}")
        _late(element, robot.late.get(signal, 0.0), plant.timestep)


def _late(sensor: Element, delay: float, timestep: float) -> None:
    if delay > 0:
        sensor.set("delay", number(delay))
        sensor.set("nsample", str(samples_for(delay, timestep)))
        sensor.set("interp", "linear")


def _body(root: Element, plant: Plant, robot: Robot, done: Edit) -> None:
    torso = _torso(root, plant)
    if robot.payload_kg:
        body = etree.SubElement(torso, "body", name="payload", pos=numbers(robot.payload_m))
        # A geom, not an inertial: the compiler may have been told to take inertia from geoms.
        etree.SubElement(
            body, "geom", name="payload", type="sphere", size="0.005", mass=number(robot.payload_kg), contype="0",
            conaffinity="0", group="1",
        )  # fmt: skip
        body.tail = "\n    "
    if robot.tilt.any():
        _last(root, "option").set("gravity", numbers(tilted(plant.model.opt.gravity, robot.tilt)))
    if robot.impratio != 1:
        # Of the compiled variant, which had it too, only its elements are written.
        _last(root, "option").set("impratio", number(float(plant.model.opt.impratio) * robot.impratio))
    if robot.cone is not None:
        elliptic = robot.cone == int(mujoco.mjtCone.mjCONE_ELLIPTIC)
        _last(root, "option").set("cone", "elliptic" if elliptic else "pyramidal")
    _cable(root, torso, plant, robot)


def _torso(root: Element, plant: Plant) -> Element:
    element = joint_element(root, plant.joints[0], plant.path)
    bodies = [element for element in element.iterancestors() if element.tag == "body"]
    return bodies[-1]


def _cable(root: Element, torso: Element, plant: Plant, robot: Robot) -> None:
    """Long tendons along the world's axes: each pulls with a force that hardly changes, and brakes along its axis."""
    cable = robot.cable
    if not (cable.force_n.any() or cable.damping_n_s_m or cable.stiffness_n_m):
        return
    model, body = plant.model, torso_body(plant.model, plant)
    etree.SubElement(torso, "site", name="cable", pos=numbers(model.body_ipos[body]), size="0.001", group="5")
    world, tendons = next(root.iter("worldbody")), _last(root, "tendon")
    place = model.body_pos[body]
    for k, axis in enumerate("xyz"):
        force = float(cable.force_n[k])
        end = place.copy()
        end[k] += FAR_M if force >= 0 else -FAR_M
        etree.SubElement(world, "site", name=f"cable.{axis}", pos=numbers(end), size="0.001", group="5")
        stiffness = cable.stiffness_n_m or abs(force) / FAR_M
        rest = FAR_M - abs(force) / stiffness if stiffness else FAR_M
        tendon = etree.SubElement(
            tendons, "spatial", name=f"cable.{axis}", stiffness=number(stiffness), damping=number(cable.damping_n_s_m),
            springlength=number(max(rest, 0.0)),
        )  # fmt: skip
        etree.SubElement(tendon, "site", site="cable")
        etree.SubElement(tendon, "site", site=f"cable.{axis}")


def _imu(root: Element, plant: Plant, robot: Robot, done: Edit) -> None:
    late, turned = robot.late.get("imu", 0.0), robot.imu_rotation
    if not (late > 0 or turned.any()):
        return
    sensors = [e for section in root.iter("sensor") for e in section if e.tag in ("gyro", "accelerometer")]
    if not sensors:
        done.notes.append("the model has no gyro and no accelerometer that could be turned or late")
    for sensor in sensors:
        _late(sensor, late, plant.timestep)
    for name in dict.fromkeys(str(sensor.get("site")) for sensor in sensors) if turned.any() else ():
        site = next(e for e in root.iter("site") if e.get("name") == name)
        quat, turn = np.zeros(4), np.zeros(4)
        angle = float(np.linalg.norm(turned))
        mujoco.mju_axisAngle2Quat(turn, turned / angle, angle)
        mujoco.mju_mulQuat(quat, turn, plant.model.site(name).quat)
        for other in ("euler", "axisangle", "xyaxes", "zaxis"):
            site.attrib.pop(other, "")
        site.set("quat", numbers(quat))
