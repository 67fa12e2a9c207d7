"""The servo in a written model: what its setpoint passes, and what its torque follows.

Lag, limited rates, back-EMF and a torque that falls with speed all decide which of MuJoCo's servos stands for it, so that they
are written together: what is slow to move its setpoint becomes a `pid`; what brakes by back-EMF, or gives less torque the
faster it turns, a `dcmotor`.
"""

from __future__ import annotations

import math

import mujoco
from lxml import etree

from openant_tools.effects.document import NO_MOTOR, Document, Element, Writer
from openant_tools.model.mjcf import actuator_element, number, numbers
from openant_tools.model.plant import is_filtered, is_motor, samples_for

__all__ = ["servo"]


def _write(document: Document, j: int) -> None:
    """The servo of joint j: what its setpoint passes, and what its torque follows."""
    root, plant, robot = document.root, document.plant, document.robot
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
        document.notes.append(f"{joint}: MuJoCo filters no setpoint of such a servo; its lag acts as a delay as long")
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
_COMMON = ("name", "joint", "user", "delay", "nsample", "interp")


def _bare(element: Element, model: mujoco.MjModel, i: int, tag: str) -> None:
    """Another kind of servo in the place of this one; what its class said of it, it says itself."""
    same = {name: value for name, value in element.attrib.items() if name in _COMMON}
    element.tag = tag
    element.attrib.clear()
    for name, value in same.items():
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


servo = Writer(10, joint=_write)
