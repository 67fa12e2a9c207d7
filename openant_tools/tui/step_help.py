"""What F1 says of a step: what it is for, the words that it uses, what goes wrong and how that looks, and its page."""

from __future__ import annotations

from collections.abc import Mapping

from openant_tools.procedure.step import Step

__all__ = ["step_doc", "step_help"]

#: name → (what it is for, its words, what goes wrong and how that looks, its page)
_HELP: Mapping[str, tuple[str, str, str, str]] = {
    "connect": (
        "Everything later goes over three lines: the servos' bus, the flight controller, the camera. This finds them and sees "
        "that none of them is slow.",
        "**Adapter** (U2D2): the box between USB and the servos' cable. **Baud rate**: bits a second on that cable; all servos "
        "must have the same. **Latency timer**: how long the adapter's driver waits before it hands an answer on.",
        "No port: the cable is a charger's cable without data, or your user may not open it (`dialout` group). A latency "
        "timer of 16 ms: a third of the robot's speed; the step says the command that sets 1 ms.",
        "bring-up.md",
    ),
    "estop": (
        "Before anything moves you prove that the stop key works: one servo holds, you press space, it lets go.",
        "**Torque**: a servo with torque on holds its angle with force; off, it turns by hand. **Watchdog**: in the servo "
        "itself, lets go when nobody has spoken to it for a moment.",
        "It still holds after the key: pull the power plug, and do not go on. Nothing to hold: 12 V is not on, the LED of a "
        "servo blinks once when it is.",
        "bring-up.md",
    ),
    "ids": (
        "Servos come from the factory with the same number, so the bus cannot tell them apart. Each gets its own, one at a "
        "time, and proves by a nudge which one it is.",
        "**ID**: the number that a servo answers to. **Baud rate**: how fast it talks. **Return delay**: how long it waits "
        "before it answers; 0 here.",
        "*Two servos answer at once*: two with one number are on the cable; pull all but one. *Nothing answers*: the plug is "
        "not in to the click, or 12 V is off. *The wrong model*: hips and knees have different servos.",
        "bring-up.md",
    ),
    "centre": (
        "The horn must go on at one angle, or the joint cannot reach both of its ends. The servo turns to that angle and holds "
        "it while you screw.",
        "**Horn**: the disc on the servo's shaft that carries the leg. **Spline**: the teeth of the shaft; the horn fits in "
        "steps of 45° here. **Mounting angle**: 180° in the servo's own count.",
        "It stops before its angle: something blocks the shaft. It turns while you screw: hold the horn, not the leg. One step "
        "of the spline off: found later as 45° in Zeros.",
        "bring-up.md",
    ),
    "legs": (
        "A bad plug is quickly mended while the shell is open. Each leg proves its cable, its range and its motor.",
        "**Nudge**: a turn of a few degrees with little force. **Range**: from stop to stop, by hand.",
        "Answers lost while you wiggle: that plug is not in to the click. A nudge that the leg does not follow: the horn's screw "
        "is missing. Too little range: a cable or a screw is in the way.",
        "bring-up.md",
    ),
    "inventory": (
        "Every servo has some forty settings in memory; this compares them all with what they should be, and mends what differs "
        "after you say so.",
        "**EEPROM**: memory that stays without power. **PWM limit**: how much of its power a servo may use.",
        "A setting that differs again the next day: another program writes it (the Dynamixel Wizard does). An old firmware "
        "cannot do fast reads: it works, slower.",
        "dynamixel.md",
    ),
    "zeros": (
        "A servo knows its own angle, not the leg's. With straight legs you show it where zero is, and by moving each leg which "
        "servo is in it and which way it turns.",
        "**Zero**: the servo's angle with the leg straight. **Direction**: 1, or −1 for a mirrored leg. **Spline**: see "
        "Centring; a wrong one is off by 45°.",
        "*45° off*: the horn sits one step wrong. *A few degrees beside the grid*: the leg was not straight, or its horn slips. "
        "*Another servo turned*: two are swapped, which is mended in the file.",
        "bring-up.md",
    ),
    "bounds": (
        "How far each joint goes, by hand and by a slow sweep, and how large each sensor's value gets. Guards and learning need "
        "both.",
        "**Limit**: the angle at which a command is cut off. **Bound**: between what an observation lies in practice.",
        "An end that is never reached: a cable is too short. Friction at one end: something rubs there.",
        "bring-up.md",
    ),
    "imu": (
        "Scale, bias, noise and mounting of the sensor that feels turns and gravity.",
        "**IMU**: gyro and accelerometer on the flight controller. **Bias**: what it says at rest, where it should say nothing. "
        "**Counts**: the raw numbers that it sends; so many make 1 g (the pull of gravity), so many a turn of 1 °/s.",
        "Poses that disagree: it was still moving. Gravity that is not 9.8 m/s²: the board's range is set otherwise in "
        "Betaflight.",
        "imu-and-camera.md",
    ),
    "arena": (
        "Where the robot is, comes from a camera above it and tags: this measures the camera's height, the origin, the circle, "
        "and how late the picture is.",
        "**Tag**: a printed square that a camera reads, with a number; one lies at the **origin**, from where places are "
        "measured, one is on the robot. **ChArUco board**: a printed chessboard with tags in its fields; pictures of it say how the "
        "lens bends what it shows. **Field of view**: how wide the lens looks, by its data sheet. **Latency**: the age of a "
        "picture when it arrives; **stamps** are the times that the camera's driver gives its pictures.",
        "No tag seen: glare, or it is printed too small. A size that does not fit the height: the tag's edge in robot.toml is "
        "not what you printed.",
        "imu-and-camera.md",
    ),
    "comms": (
        "Counts what gets lost on the bus, at rest and while the legs swing, and says which part loses it.",
        "**Round trip**: from question to answer. **Write-to-read gap**: the pause that servos need between being told and being "
        "asked.",
        "Losses only while it moves: a cable that bends. Losses at one servo and all behind it: the plug before it. Everything at "
        "once: the power plug.",
        "comms.md",
    ),
    "thermal": (
        "How warm the servos get while they hold, how they cool, and from that how long the robot can work.",
        "**Soak**: holding one pose until it is warm. **Two-node fit**: each servo as a motor that warms within minutes in a case "
        "that warms within an hour. **Shutdown**: a servo that is too hot lets go and must be restarted.",
        "A servo much warmer than its neighbours: its joint rubs, or its leg carries more. Warming for ever: rest between "
        "sessions, the forecast says how long.",
        "thermal.md",
    ),
    "identify": (
        "Plays motions, records, and finds what the data sheets do not know: stiffness, friction, inertia, zeros. The result is "
        "a model for MuJoCo.",
        "**Excitation**: a motion chosen because it tells much. **Held out**: a recording that judges the model and that it was "
        "not fitted to. **Floor**: what no model could beat.",
        "A fit that is not accepted: the robot was touched, or a leg hit the stand. A friction that is far from its neighbours': "
        "that joint rubs.",
        "identify.md",
    ),
    "gap": (
        "How far the calibrated simulation is from the robot, on a motion that it has not seen.",
        "**Gap**: mean error of position over half a second, in milliradians. **Floor**: by how much two plays of one motion "
        "differ.",
        "A gap well above the floor: `openant gap diagnose` (key g) says what the model lacks, and by how much.",
        "gap.md",
    ),
    "passport": (
        "One page with all that is known of this robot, to keep, to compare with later, and to send along with a question.",
        "**Provenance**: where a value came from, measured or from a data sheet.",
        "*Not measured* beside a value: that step is still to do. *Again*: a step that it builds on was done since.",
        "robot-folder.md",
    ),
    "check": (
        "Before a session: is the robot still what its passport says?",
        "**Passport**: see the walk's last step.",
        "It names the joint and the likely part: a horn that slipped, a cable, a servo that was swapped.",
        "bring-up.md",
    ),
    "knee-torque": (
        "Whether the knees can carry this robot at all: for how long on four legs, and on the two of a trot.",
        "**Nominal torque**: what a servo bears for hours. **Stall torque**: the most it gives, for seconds, at its supply and "
        "**PWM limit**.",
        "*Heats*: it carries more than it bears for long; it will walk, with rests. *Gives way*: it cannot stand so.",
        "bench.md",
    ),
    "stiffness": (
        "How hard a joint pulls towards its goal, by two instruments that know nothing of each other: grams under its foot, and "
        "the duty that the servo says it gives.",
        "**Duty**: the share of full power. **P divisor**: by what the firmware divides its gain; the manual and measurements "
        "differ.",
        "*Nothing holds the leg*: the foot did not touch. Scale and servo disagree: the torso moved, or the lever is not what "
        "was measured.",
        "bench.md",
    ),
    "floor-friction": (
        "How slippery the floor is. Feet that slip in simulation and hold on the floor, or the other way round, spoil every gait.",
        "**μ**: the tangent of the angle where it slides. **Static** until it slides, **kinetic** while it does.",
        "One reading has no interval: turn the robot and repeat. Too little: the plate was not level when it was called level.",
        "bench.md",
    ),
    "undo": (
        "Takes back the last step's writes to the servos' memory, newest first.",
        "**Journal**: the list of every such write, with the value before.",
        "A servo that does not answer is named and left; plug it in and do it again.",
        "bring-up.md",
    ),
}


def step_help(step: Step) -> str:
    """What F1 says of a step; Markdown."""
    why, words, wrong, _ = _HELP[step.name]
    return f"# {step.title}\n\n{why}\n\n{words}\n\n**What goes wrong:** {wrong}\n"


def step_doc(step: Step) -> str:
    """The page of docs/ on a step."""
    return _HELP[step.name][3]
