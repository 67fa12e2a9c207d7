"""Leg by leg: cable, range and nudge of one leg before the next is built and the shell is closed."""

from __future__ import annotations

import math

import numpy as np

from openant_tools.calib.bounds import Unwrapped
from openant_tools.calib.ids import nudge
from openant_tools.calib.lost_answers import most_lost
from openant_tools.calib.wires import BOOT_S, differs, in_joints, opened_bus, robot_servos, servo_angles, wait
from openant_tools.comms.bus import Bus
from openant_tools.comms.faults import Cause
from openant_tools.comms.lateness import LATE_S, REMEDY
from openant_tools.comms.servos import BLOCK_ADDRESS, BLOCK_SIZE, Servos
from openant_tools.errors import HardwareFault
from openant_tools.numbers import number, span
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Ask, Bench, Hands, Intent, Live, Procedure, Progress, Say, Subroutine
from openant_tools.procedure.unfinished import Parts
from openant_tools.robot.config import RobotConfig
from openant_tools.robot.joints import JOINTS, LEGS, Leg
from openant_tools.robot.kit import ANGLE_LIMIT_RAD

__all__ = ["legs"]

COMMAND = "openant calib legs"
#: Reads while the builder moves the leg and wiggles its cables: so long once the range was seen, and the longest that hands
#: are waited for.
READ_S, LONGEST_S = 3.0, 60.0
#: Share of the kit's range that a hand must reach at a leg that is not in its shell yet.
RANGE_SHARE = 0.6
NUDGE_RAD, NUDGED_RAD = 0.1, 0.04
#: by how much further than hands have moved it a leg may hang
SLACK_RAD = 0.1
AGAIN, GO_ON = "try again", "go on with the next"


def legs(bench: Bench) -> Procedure:
    """Each leg on its own; what one leg lacks is named before the next begins."""
    config = bench.folder.config()
    wanted = [leg for leg in LEGS if not bench.joints or any(joint.endswith(leg.name) for joint in bench.joints)]
    problems, evidence, proven = list[str](), list[Evidence](), list[str]()
    parts = Parts(bench, "legs", [leg.words for leg in wanted], bench.joints)
    if parts.before:
        yield Say(parts.words)
        words = "Go on with the next leg; those that are proven stay as they are, the torso on its stand."
        yield Hands(words, "assemble", setup="stand")
    else:
        yield Hands(
            "Build the legs one after the other; the torso stands on its stand, cables out.", "assemble", setup="stand"
        )
        yield Hands("Take every leg off the cable.", "unplug")
    with opened_bus(bench) as bus:
        wait(bus.clock, BOOT_S)
        odd = {leg.name: _differs(bus, leg, config, parts) for leg in wanted if leg.words in parts.before}
    for k, leg in enumerate(wanted):
        if leg.words in parts.before:
            if not odd[leg.name]:
                proven.append(leg.name)
                evidence += [Evidence(**one) for one in parts.before[leg.words].get("evidence", ())]
                continue
            yield Say(f"the {leg.words} leg is not as it was left: {odd[leg.name]}; it is done again", "warn")
        while True:
            yield Progress(k / len(wanted), f"{leg.words} leg ({k + 1} of {len(wanted)})")
            try:
                found, ends = yield from _one(bench, leg, config)
                trouble = ""
            except HardwareFault as fault:
                found, ends, trouble = [], {}, str(fault)
            if not trouble:
                evidence += found
                proven.append(leg.name)
                parts.done(leg.words, evidence=[vars(one) for one in found], ends_rad=ends)
                yield Say(f"{leg.words} leg: cable, range and nudge are good", "ok")
                break
            if (yield Ask(trouble, (AGAIN, GO_ON), default=GO_ON)) != AGAIN:
                problems.append(f"{leg.words} leg: {trouble}")
                break
    return Finding(
        "legs",
        not problems,
        f"{len(proven)} of {len(wanted)} legs are proven",
        tuple(evidence),
        "mend what is listed and run it again; the shell stays open" if problems else "close the shell",
        COMMAND,
        data={"proven": proven},
        problems=tuple(problems),
    )


def _differs(bus: Bus, leg: Leg, config: RobotConfig, parts: Parts) -> str:
    """What of a leg that was proven does not read as it was left; "" where all does."""
    joints = [f"hip_{leg.name}", f"knee_{leg.name}"]
    for joint in joints:
        another = differs(bus, config.motors[joint])
        if another:
            return f"{joint}: {another}"
    servos = Servos(bus, robot_servos(config, joints))
    now = in_joints(servos, servo_angles(servos)[0])
    for joint, (low, high) in parts.before[leg.words].get("ends_rad", {}).items():
        off = (now[joint] - (low + high) / 2 + math.pi) % (2 * math.pi) - math.pi
        if abs(off) > (high - low) / 2 + SLACK_RAD:
            return f"{joint} is at {number(now[joint], 'rad', decimals=0)}, hands moved it from {span(low, high, 'rad', decimals=0)}"
    return ""


#: joint → between which angles hands have moved it, rad
Ends = dict[str, tuple[float, float]]


def _one(bench: Bench, leg: Leg, config: RobotConfig) -> Subroutine[tuple[list[Evidence], Ends]]:
    """One leg; raises HardwareFault with what is wrong with it."""
    joints = [f"hip_{leg.name}", f"knee_{leg.name}"]
    for joint in joints:
        yield Hands(f"Connect {joint}.", "plug", joint)
    with opened_bus(bench) as bus:
        evidence, ends = yield from _by_hand(bus, joints, config)
    yield Intent(f"nudge {' and '.join(joints)} by {number(NUDGE_RAD, 'rad', decimals=0)}, gently", moves=True)
    for servo in robot_servos(config, joints):  # told from the zero that they had while hands moved them
        joint = servo.joint
        went, _ = yield from nudge(bench, servo, config.bus.baud, NUDGE_RAD)
        evidence.append(Evidence(f"nudge of {joint}", went, "rad", "encoder", least=NUDGED_RAD))
        if went < NUDGED_RAD:
            raise HardwareFault(
                f"{joint} does not follow its motor ({number(went, 'rad', decimals=1)})",
                remedy="is its horn screwed on?",
            )
    return evidence, ends


def _by_hand(bus: Bus, joints: list[str], config: RobotConfig) -> Subroutine[tuple[list[Evidence], Ends]]:
    """Each joint's range and its cables, moved and wiggled by hand, torque off."""
    wait(bus.clock, BOOT_S)
    servos = Servos(bus, robot_servos(config, joints))
    servos.identify()
    servos.set_torque(False)
    evidence = list[Evidence]()
    tracks = {joint: (Unwrapped(), list[float]()) for joint in joints}
    for joint in joints:
        far = ANGLE_LIMIT_RAD[JOINTS[joint].kind] + 0.05
        yield Hands(
            f"Move {joint} from stop to stop, and wiggle its cables meanwhile.", "turn", joint, (far, -far, 0.0),
            while_watching=True,
        )  # fmt: skip
        asked = lost = 0
        give_up, end = bus.clock.now() + LONGEST_S, math.inf
        whole = 2 * ANGLE_LIMIT_RAD[JOINTS[joint].kind]
        while bus.clock.now() < min(end, give_up):
            answers = bus.sync_read(BLOCK_ADDRESS, BLOCK_SIZE, servos.ids)
            if bus.clock.lateness.cycle() <= LATE_S:
                lost += sum(answer.cause not in (None, Cause.LATE) for answer in answers)
            asked += len(answers)
            if asked % 20 == 0:
                try:
                    now = in_joints(servos, servo_angles(servos)[0])
                except HardwareFault:
                    continue  # a loss like the others; it is counted above
                for name, angle in now.items():
                    tracks[name][1].append(tracks[name][0].add(angle))
                if end == math.inf and np.ptp(tracks[joint][1]) >= RANGE_SHARE * whole:
                    end = bus.clock.now() + READ_S
                if (yield Live(now, "rad", f"moving {joint}; Enter when it is done", angles_rad=now)) is True:
                    break
            wait(bus.clock, 0.005)
        yield Hands("Let go.", "free", while_watching=True)
        late = bus.clock.lateness.words
        if late:
            yield Say(f"{late}: what was lost meanwhile says nothing of cables → {REMEDY}", "warn")
        if lost > most_lost(asked):
            raise HardwareFault(
                f"{lost} of {asked} answers were lost while {joint} moved",
                remedy=f"look at the cable before {joint} and at its plugs: press each in to the click",
            )
        seen = float(np.ptp(tracks[joint][1])) if tracks[joint][1] else 0.0
        evidence.append(Evidence(f"range of {joint}", seen, "rad", "by hand", least=RANGE_SHARE * whole))
        share, most = (lost / asked, most_lost(asked) / asked) if asked else (None, None)
        evidence.append(
            Evidence(f"answers lost at {joint}", share, "share", f"{asked} reads while it moved", most=most)
        )
        if seen < RANGE_SHARE * whole:
            raise HardwareFault(
                f"{joint} turned by {number(seen, 'rad', decimals=0)} of {number(whole, 'rad', decimals=0)}",
                remedy="is a screw or a cable in its way?",
            )
    return evidence, {joint: (min(seen), max(seen)) for joint, (_, seen) in tracks.items()}
