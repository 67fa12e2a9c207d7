"""Soaks on the virtual robot's bus, transaction by transaction: its servos, supply and faults, without spelling packets.

The host here does what the engine does: writes the goals, waits the gap, reads registers 120…146 of all servos, and
calls late what comes after its deadline. Where the host itself stands still, its next cycle begins when it goes on.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import tomlkit
from numpy.typing import NDArray

from openant_tools.blind.soaks import SoakAnswer
from openant_tools.comms.protocol2 import Instruction, sync_read, sync_write
from openant_tools.comms.servos import BLOCK, BLOCK_ADDRESS, BLOCK_SIZE, Block, Servo
from openant_tools.comms.soak import MOVE_S, REST_S, soak_motion
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import ANGLE_LIMIT_RAD, home_angles
from openant_tools.virtual.faults import Faults
from openant_tools.virtual.scenario import Scenario, parse_scenario
from openant_tools.virtual.start import build
from openant_tools.virtual.world import MOUNT_EIGHTHS, World

__all__ = ["Host", "record_transactions", "soak_scenario", "soak_virtual", "swinging_soak"]

Array = NDArray[np.float64]
#: s, physics in steps of it is exact enough for angles that faults hang on
STEP_S = 2e-3
#: s that the host listens beyond what the wire takes (the driver's margin and the timer it believes in)
PATIENCE_S = 5e-3
#: s of standing up before the soak begins
RISE_S = 1.0


@dataclass
class Host:
    """One loop over one world.

    Attributes:
        rate_hz: cycles a second. gap_s: from the end of a write to the read. write_every: a write in every so many cycles.
        jitter_s: how late a healthy loop begins, typically.
    """

    world: World
    rate_hz: float
    gap_s: float = 4e-4
    write_every: int = 1
    jitter_s: float = 2e-4
    seed: int = 0
    unplugged: set[str] = field(default_factory=set)

    def plug(self, device: str, plugged: bool) -> None:
        (self.unplugged.discard if plugged else self.unplugged.add)(device)


def soak_virtual(answer: SoakAnswer, name: str) -> Run:
    """The log of one soak of a set."""
    chance = np.random.default_rng(answer.seed)
    scenario = parse_scenario(tomllib.loads(soak_scenario(answer)))
    host = Host(build(scenario), answer.rate_hz, seed=answer.seed)
    if answer.cause == "write_read_gap":
        host.gap_s = float(chance.uniform(0.2, 0.6)) * answer.parameters["needed_s"]
        host.write_every = int(chance.integers(2, 5))
    run = record_transactions(host, scenario, answer.seconds, name, motion=_motion(answer))
    extra: dict[str, Any] = {"baud": answer.baud}
    if answer.chain_told:
        extra["chain"] = [list(cable) for cable in answer.chain]
    columns = {
        column: values for column, values in run.columns.items() if column.partition(".")[0] not in answer.dropped
    }
    return replace(run, columns=columns, facts=replace(run.facts, extra=extra))


def _motion(answer: SoakAnswer) -> Callable[[float], Array]:
    """(8,) rad at a time: two seconds of gait in every eight, or all the time."""
    chance = np.random.default_rng([answer.seed, 7])
    home = np.array(home_angles())
    reach, phase = chance.uniform(0.15, 0.4, len(home)), chance.uniform(0, 2 * np.pi, len(home))
    hz = chance.uniform(0.4, 1.4, len(home)) if chance.random() < 0.5 else np.full(len(home), chance.uniform(0.4, 1.4))
    # What shows only in motion moves more.
    needs = answer.cause in ("power_connector", "supply_weak", "broken_wire")
    busy = 1.0 if needs else 0.25
    if answer.cause == "supply_weak":
        reach, hz = reach + 0.3, hz + 1.0

    def at(t: float) -> Array:
        swing = reach * np.sin(2 * np.pi * hz * t + phase)
        return np.asarray(home + (swing if (t / 8.0) % 1.0 < busy else 0.0))

    return at


def soak_scenario(answer: SoakAnswer) -> str:
    """The scenario of a soak, as TOML."""
    p = answer.parameters
    bus: dict[str, Any] = {"baud": answer.baud, "chain": [list(cable) for cable in answer.chain]}
    fault: dict[str, Any] = {"cause": answer.cause}
    if answer.where:
        fault["where"] = list(answer.where)[:1]
    faults = [fault]
    match answer.cause:
        case "none":
            faults = []
        case "power_connector":
            fault |= {"openings_per_rad": p["openings_per_rad"], "open_s": p["open_s"]}
        case "supply_weak":
            fault |= {"resistance_ohm": p["resistance_ohm"], "volts": 10.5}
        case "broken_wire":
            angles = np.array([_motion(answer)(t) for t in np.arange(0, 60, 0.05)])
            joint = list(JOINTS).index(answer.where[0])
            # Gravity and friction keep a leg from its very ends: what it reaches lies a little inside.
            edge = float(np.quantile(angles[:, joint], 1 - p["share"] if p["above"] else p["share"]))
            middle = float(np.median(angles[:, joint]))
            edge = middle + 0.85 * (edge - middle)
            fault |= {"depends_on": answer.where[0], "flicker": p["flicker"]}
            fault["above_rad" if p["above"] else "below_rad"] = edge
        case "bad_servo" | "bad_cable":
            fault["fraction"] = p["fraction"]
        case "line_noise":
            fault["byte_error"] = p["byte_error"]
        case "return_delay":
            fault["delay_s"] = p["delay_s"]
            if p["one"]:
                fault["where"] = [answer.chain[-1][-1]]
        case "latency_timer":
            fault["timer_s"] = p["timer_s"]
        case "host_stall":
            fault |= {"every_s": p["every_s"], "for_s": p["for_s"]}
        case "usb_unplug":
            chance = np.random.default_rng([answer.seed, 8])
            faults = []
            for start in chance.uniform(0.05, 0.85, p["times"]) * answer.seconds:
                faults.append({"cause": "usb_unplug", "from_s": float(start), "to_s": float(start + p["for_s"])})
        case "duplicate_id":
            fault |= {"of": answer.where[1]}
        case "write_read_gap":
            fault["gap_s"] = p["needed_s"]
    return tomlkit.dumps(
        {
            "seed": answer.seed % 2**31,
            "robot": {"setup": "stand", "pose": "home", "step_s": STEP_S},
            "clock": {"mode": "stepped", "doze": True},
            "camera": {"present": False},
            "supply": {"volts": 12.0, "resistance_ohm": 0.1},
            "bus": bus,
            "fault": faults,
        }
    )


def swinging_soak(
    scenario: Scenario,
    seconds: float,
    rate_hz: float,
    name: str,
    *,
    still: bool = False,
    progress: Callable[[float, str], None] = lambda share, words: None,
) -> Run:
    """A soak of any scenario with the motion of `openant comms soak`, without bytes and ports."""
    scenario.world.body.timestep_s = max(scenario.world.body.timestep_s, STEP_S)
    scenario.world.doze = True
    world = build(scenario)
    joints = world.joints
    limits = {joint: (-ANGLE_LIMIT_RAD[JOINTS[joint].kind], ANGLE_LIMIT_RAD[JOINTS[joint].kind]) for joint in joints}
    fine = 50.0
    pieces: dict[int, Array] = {}

    def motion(t: float) -> Array:
        piece, at = divmod(t, MOVE_S + REST_S)
        if int(piece) not in pieces:
            pieces.clear()
            pieces[int(piece)] = soak_motion(joints, limits, fine, int(piece))
        return np.asarray(pieces[int(piece)][0 if still else min(int(at * fine), len(pieces[int(piece)]) - 1)])

    run = record_transactions(Host(world, rate_hz), scenario, seconds, name, motion=motion, progress=progress)
    chain = [[joints[k] for k in cable] for cable in world.settings.bus.chains]
    return replace(run, facts=replace(run.facts, extra={**run.facts.extra, "baud": world.line_baud, "chain": chain}))


def record_transactions(
    host: Host,
    scenario: Scenario,
    seconds: float,
    name: str,
    *,
    motion: Callable[[float], Array],
    progress: Callable[[float, str], None] = lambda share, words: None,
) -> Run:
    """Move and read for `seconds` (s); the log as a run (formats, section 1).

    Args:
        motion: goal angles (joints,) rad at a time since the start.
    """
    world, rate = host.world, host.rate_hz
    setups = world.settings.servos
    servos = [
        Servo(
            setup.joint, device.id, setup.model, -1 if setup.reversed else 1,
            MOUNT_EIGHTHS * math.pi / 4 if setup.mount_rad is None else setup.mount_rad,
        )
        for setup, device in zip(setups, world.servos, strict=True)
    ]  # fmt: skip
    ids = [servo.id for servo in servos]
    world.line.transact(sync_write(64, 1, dict.fromkeys(ids, b"\1")), world.now + 0.01)
    goals = _goals(servos, motion(0.0))
    world.line.transact(goals, world.now + 0.01)
    world.advance(world.now + RISE_S)
    # Only a robot that stands is broken: faults count from here.
    start = world.now
    for fault in scenario.faults:
        fault.from_s, fault.to_s = fault.from_s + start, fault.to_s + start
    Faults(world, scenario.faults, unplug=host.plug)
    rows = list(_cycles(host, servos, start, int(seconds * rate), motion, progress))
    return _as_run(name, servos, rows, rate)


def _goals(servos: list[Servo], angles: Array) -> Instruction:
    return sync_write(
        116, 4,
        {
            servo.id: round(servo.to_servo(float(angle)) / servo.model.registers["goal_position"].scale).to_bytes(
                4, "little", signed=True
            )
            for servo, angle in zip(servos, angles, strict=True)
        },
    )  # fmt: skip


@dataclass(slots=True)
class _Row:
    t: float
    wake: float
    cmd_t: float
    goal: Array
    blocks: list[Block | None]
    words: list[str]
    rtt: list[float]


def _cycles(
    host: Host,
    servos: list[Servo],
    start: float,
    count: int,
    motion: Callable[[float], Array],
    progress: Callable[[float, str], None],
) -> Iterator[_Row]:
    world, line = host.world, host.world.line
    chance = np.random.default_rng([host.seed, 9])
    ids, n = [servo.id for servo in servos], len(servos)
    read = sync_read(BLOCK_ADDRESS, BLOCK_SIZE, ids)
    request_bytes = len(read.encode())
    cmd_t, goal = start, motion(0.0)
    free, silent = start, False
    for k in range(count):
        due = start + k / host.rate_hz
        at = max(due, free) + float(chance.exponential(host.jitter_s))
        world.advance(at)
        at = max(at, line.settings.stalled_until)
        wake = at - due
        if "bus" in host.unplugged:
            yield _Row(at, wake, cmd_t, goal, [None] * n, ["port"] * n, [math.nan] * n)
            continue
        wanted = motion(at - start)
        # What stands still is not told again and again: only so may the world doze.
        if k % host.write_every == 0 and (k == 0 or host.write_every > 1 or (wanted != goal).any()):
            goal = wanted
            packet = _goals(servos, goal)
            _, known = line.transact(packet, at)
            cmd_t = known
            at = known + host.gap_s * float(chance.uniform(0.9, 1.1))
        answers, known = line.transact(read, at)
        byte_s = 10 / (world.line_baud or 1_000_000)
        deadline = at + byte_s * (request_bytes + n * (BLOCK_SIZE + 11)) + PATIENCE_S
        by_id = {answer.id: answer for answer in answers}
        blocks: list[Block | None] = []
        words, rtt = [], []
        for id in ids:
            answer = by_id[id]
            status = answer.status
            block, word, took = None, answer.error, math.nan
            if status is not None:
                took = answer.t - at
                block = Block._make(BLOCK.unpack(status.params))
                if answer.t > deadline and line.settings.stalled_until < answer.t - 1e-3:
                    word = "late"
            blocks.append(block)
            words.append(word)
            rtt.append(took)
        lost = any(words)
        if silent and not lost:
            # Servos that began anew lie limp: as the platform's software does, the host switches them on again.
            line.transact(sync_write(64, 1, dict.fromkeys(ids, b"\1")), line.free_at + 1e-3)
        silent = lost
        # Who waits for a silent servo waits to the deadline.
        free = max(known, deadline if lost else known, line.free_at)
        yield _Row(at, max(wake, 0.0), cmd_t, goal, blocks, words, rtt)
        if k % 1000 == 0:
            progress(k / count, "soaking")
    progress(1.0, "soaking")


def _as_run(name: str, servos: list[Servo], rows: list[_Row], rate: float) -> Run:
    t = np.array([row.t for row in rows])
    t = np.maximum.accumulate(t - t[0]) + 1e-9 * np.arange(len(t))
    t0 = rows[0].t
    columns: dict[str, NDArray[Any]] = {}
    for j, servo in enumerate(servos):
        table = servo.model.registers
        effort = "cur" if servo.model.has_current_sensor else "load"
        blocks = [row.blocks[j] for row in rows]
        raw = np.array(
            [(math.nan,) * 7 if b is None else (b.position, b.velocity, b.effort, b.pwm, b.voltage, b.temperature, b.tick)
             for b in blocks], dtype=float,
        )  # fmt: skip
        zero, sign = servo.zero_rad, servo.direction
        columns[f"cmd.{servo.joint}"] = np.array([row.goal[j] for row in rows])
        columns[f"pos.{servo.joint}"] = sign * (raw[:, 0] * table["present_position"].scale - zero)
        columns[f"vel.{servo.joint}"] = sign * raw[:, 1] * table["present_velocity"].scale
        columns[f"{effort}.{servo.joint}"] = sign * raw[:, 2] * servo.model.effort.scale
        columns[f"pwm.{servo.joint}"] = sign * raw[:, 3] * table["present_pwm"].scale
        columns[f"volt.{servo.joint}"] = raw[:, 4] * table["present_input_voltage"].scale
        columns[f"temp.{servo.joint}"] = raw[:, 5]
        columns[f"tick.{servo.joint}"] = raw[:, 6]
        words = np.array([row.words[j] for row in rows], dtype=object)
        columns[f"ok.{servo.joint}"] = (words == "").astype(float)
        columns[f"err.{servo.joint}"] = words
        columns[f"rtt.{servo.joint}"] = np.array([row.rtt[j] for row in rows])
    columns["wake"] = np.array([row.wake for row in rows])
    columns["cmd_t"] = np.array([row.cmd_t - t0 for row in rows])
    facts = Facts(joints=tuple(servo.joint for servo in servos), setup="stand", extra={"rate_hz": rate})
    return Run(name, facts, t, columns)
