"""Centring: each bare servo turns slowly to its mounting angle and holds it while the horn goes on."""

from __future__ import annotations

import math

from openant_tools.calib.wires import BOOT_S, journalled, opened_bus, robot_servos, wait
from openant_tools.errors import BadInput
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Ask, Bench, Hands, Intent, Live, Look, Procedure, Progress, RegisterChange, Say
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import NOMINAL_ZERO_RAD
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE

__all__ = ["centre"]

COMMAND = "openant calib centre"
#: 0.229 rpm units: 0.24 rad/s, slow enough to take a finger away
SLOW_COUNTS = 10
CENTRE_PWM = 0.3
#: An unloaded servo stops within friction of its goal: 23 pulses.
CLOSE_RAD = 0.035
LONGEST_S = 20.0
POSITION_MODE = 3
DRAWINGS = {
    "hip": """\
        horn (seen from above)
          ___                 the mark on the horn points straight OUT,
    body | o-|---> leg        away from the torso, along the diagonal;
         |___|                cable side of the servo towards the torso
""",
    "knee": """\
        horn (seen from the side)
          ___                 the lower leg points straight OUT,
    hip--| o-|---> foot       in line with the upper leg, level;
         |___|                up is where the servo's label can be read
""",
}


def centre(bench: Bench) -> Procedure:
    """Every servo in turn; torque goes off when its horn is screwed on.

    Raises:
        BadInput: a servo is in a leg already and can hardly turn freely; the message says which.
    """
    config = bench.folder.config()
    motors = [motor for motor in config.motors.values() if not bench.joints or motor.joint in bench.joints]
    goal = round(NOMINAL_ZERO_RAD / RAD_PER_PULSE)
    centred, problems, evidence = list[str](), list[str](), list[Evidence]()
    with opened_bus(bench) as bus:
        if all(bus.ping(motor.id, insist=True) is None for motor in motors):
            yield Hands("Connect the servos, still without horns, one behind the other; 12 V on.", "plug")
            wait(bus.clock, BOOT_S)
        for k, motor in enumerate(motors):
            joint, kind = motor.joint, JOINTS[motor.joint].kind
            yield Progress(k / len(motors), f"{joint} ({k + 1} of {len(motors)})")
            if bus.ping(motor.id, insist=True) is None:
                problems.append(
                    f"{joint} (id {motor.id}) does not answer → plug it in and run the step again with --joint {joint}"
                )
                continue
            servos = journalled(bus, robot_servos(config, [joint]), bench, COMMAND)
            servos.set_torque(False)
            mode, at = servos.read_counts("operating_mode", joint), servos.read_counts("present_position", joint)
            changes = [RegisterChange(joint, "operating_mode", mode, POSITION_MODE)] if mode != POSITION_MODE else []
            yield Look(f"{joint}: how its horn goes on", DRAWINGS[kind])
            yield Intent(
                f"turn {joint} slowly from {math.degrees(at * RAD_PER_PULSE):.0f}° to {math.degrees(goal * RAD_PER_PULSE):.0f}° "
                "and hold it there; keep the shaft free",
                tuple(changes),
                moves=True,
            )
            servos.write_counts("operating_mode", joint, POSITION_MODE)
            try:
                servos.write_counts("profile_velocity", joint, SLOW_COUNTS)
                servos.set_torque(True, [joint])
                servos.write_counts("goal_pwm", joint, round(CENTRE_PWM * PWM_FULL))
                servos.write_counts("goal_position", joint, goal)
                give_up = bus.clock.now() + LONGEST_S
                while abs(servos.read_counts("present_position", joint) - goal) * RAD_PER_PULSE > CLOSE_RAD:
                    wait(bus.clock, 0.2)
                    at = servos.read_counts("present_position", joint)
                    yield Live({joint: at * RAD_PER_PULSE}, "rad", "turning")
                    if bus.clock.now() > give_up:
                        break
                wait(bus.clock, 0.5)
                reached = servos.read_counts("present_position", joint)
                off = (reached - goal) * RAD_PER_PULSE
                if abs(off) > CLOSE_RAD:
                    problems.append(
                        f"{joint}: stopped {math.degrees(off):+.0f}° from its mounting angle → is the shaft blocked?"
                    )
                    continue
                evidence.append(Evidence(f"{joint} off its mounting angle", off, "rad", "encoder, holding"))
                if (
                    yield Ask(
                        f"{joint} holds. Put the horn on as drawn and drive its screw in. Done?",
                        ("yes", "no"),
                        default="yes",
                    )
                ) != "yes":
                    problems.append(f"{joint}: no horn yet → run the step again with --joint {joint}")
                    continue
                after = (servos.read_counts("present_position", joint) - goal) * RAD_PER_PULSE
                if abs(after - off) > CLOSE_RAD:
                    yield Say(f"{joint} was turned by {math.degrees(after - off):+.1f}° while the horn went on", "warn")
                centred.append(joint)
            finally:
                servos.set_torque(False, [joint])
                servos.write_counts("profile_velocity", joint, 0)
    if not motors:
        raise BadInput("no joint is named", remedy="leave out --joint")
    return Finding(
        "centre",
        not problems,
        f"{len(centred)} of {len(motors)} horns are on at the mounting angle of {math.degrees(NOMINAL_ZERO_RAD):.0f}°",
        tuple(evidence),
        "mend what is listed and run it again" if problems else "",
        COMMAND,
        data={"centred": centred},
        problems=tuple(problems),
    )
