"""Robots of a set that are recorded through the virtual robot's bus: real packets, real firmware, their real time on the wire.

The virtual robot's world stands in this process, and our own driver talks to it over a line whose clock jumps from event to
event. Scatter goes into its scenario as values of motors and as effects within their tolerance. Each row writes the goals, then
reads all servos, as our engine does; so a command here comes before its row's samples, and in the batch simulator after them.
"""

from __future__ import annotations

import math
import tomllib
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import tomlkit
from numpy.typing import NDArray

from openant_tools.blind.commands import RATE_HZ, Motion
from openant_tools.blind.draw import Answer, Drawn
from openant_tools.blind.log import facts_of, imu_columns, tracker_columns
from openant_tools.blind.robot import TrueRobot, true_robot
from openant_tools.blind.simulate import COPPER_PER_K, WARM_C
from openant_tools.comms.bus import Bus, BusTiming
from openant_tools.comms.lateness import Lateness
from openant_tools.comms.servos import Block, Servo, Servos
from openant_tools.recording.run import Run
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import PLATFORM_PWM_LIMIT_COUNTS, kit
from openant_tools.virtual.scenario import parse_scenario
from openant_tools.virtual.world import World

__all__ = ["record_through_bus", "scenario_of"]

#: s of standing before each run, and of standing up before the first in a place
SETTLE_S, RISE_S = 0.6, 1.5
#: of the world's body, averaged for what the IMU gives: two of its polls, about a low-pass of 50 Hz
IMU_SAMPLES = 2
#: °C, of the virtual robot's resistances
COLD_C = 25.0
#: What acts where this host samples IMU and tracker, and not in the world.
_SENSED = frozenset({"imu_misalignment", "imu_bias", "tracker_scale"})


def scenario_of(answer: Answer, setup: str, heading_rad: float) -> str:
    """The scenario of a robot, as TOML: scatter and effects."""
    robot = true_robot(replace(answer, effects=(), outside=None))
    document: dict[str, Any] = {
        "seed": answer.seed % 2**31,
        "robot": {"kit": "standard", "setup": setup, "pose": "home", "heading_rad": heading_rad, "step_s": 5e-4},
        "clock": {"mode": "stepped"},
        "camera": {"present": False},
        "supply": {"volts": robot.servos.supply_v, "resistance_ohm": robot.servos.supply_ohm},
        "room": {"ambient_c": robot.ambient_c},
        "servo": [_servo(robot, k) for k in range(len(JOINTS))],
        "effect": [_entry(drawn) for drawn in (*_scatter(robot, setup), *_wrong(answer, robot))],
    }
    return tomlkit.dumps(document)


def _servo(robot: TrueRobot, k: int) -> dict[str, Any]:
    servos = robot.servos
    joint = list(JOINTS.values())[k]
    nominal = kit("standard").servo(joint.kind)
    gain = float(nominal.register("position_p_gain").default or 0) / nominal.position_p_divisor
    # The virtual robot states a cold winding's resistance.
    cold = float(servos.resistance[k]) / (1 + COPPER_PER_K * (WARM_C - COLD_C))
    return {
        "joint": joint.name,
        "pwm_limit": PLATFORM_PWM_LIMIT_COUNTS,
        "mount_rad": np.pi + float(servos.zero[k]),
        "motor": {
            "kt": float(servos.kt[k]), "resistance": cold, "ke": float(servos.ke[k]), "viscous": float(servos.viscous[k]),
            "armature": float(servos.rotor[k] + robot.mechanics.output_armature[k]),
            "stiffness_scale": float(servos.p_gain[k]) / gain, "coulomb_nm": float(servos.coulomb[k]),
            "encoder_noise_rad": robot.senses.encoder_rad, "current_noise_a": robot.senses.current_a,
            "action_delay_s": robot.clocks.base_s,
        },
    }  # fmt: skip


def _scatter(robot: TrueRobot, setup: str) -> list[Drawn]:
    """Links, floor and torso, as effects so small that they are none."""
    mechanics = robot.mechanics
    small = [
        Drawn("link_mass", (name,), {"scale": float(mechanics.link_scale[k])}, "small") for k, name in enumerate(JOINTS)
    ]
    if setup == "floor":
        across = float(np.hypot(*mechanics.gravity[:2]))
        small += [
            Drawn("floor_friction", "body", {"sliding": mechanics.friction}, "small"),
            Drawn("contact_softness", "body", {"time_constant_s": mechanics.contact_s}, "small"),
            Drawn(
                "floor_tilt", "body",
                {
                    "angle_rad": float(np.arcsin(across / 9.81)),
                    "direction": float(np.arctan2(mechanics.gravity[1], mechanics.gravity[0])),
                },
                "small",
            ),
        ]  # fmt: skip
        if mechanics.torso_kg > 0:
            small.append(Drawn("payload", "body", {"mass_kg": mechanics.torso_kg}, "small"))
    return small


def _wrong(answer: Answer, robot: TrueRobot) -> list[Drawn]:
    """The answer's effects; what would set a value and forget the robot's own is made to keep it."""
    out = []
    for drawn in answer.effects:
        if drawn.effect in _SENSED:
            continue
        if drawn.effect == "link_mass":
            # The virtual robot's entry replaces a link's scale: keep each link's own.
            own = robot.mechanics.link_scale
            out += [
                Drawn("link_mass", (name,), {"scale": drawn.parameters["scale"] * float(own[k])}, drawn.size)
                for k, name in enumerate(JOINTS)
            ]
        else:
            out.append(drawn)
    return out


def _entry(drawn: Drawn) -> dict[str, Any]:
    joints = drawn.joints if isinstance(drawn.joints, str) else list(drawn.joints)
    return {"effect": drawn.effect, "joints": joints, "parameters": dict(drawn.parameters)}


def record_through_bus(
    answer: Answer, played: Sequence[Motion], keep: Callable[[Motion, Run], None] = lambda motion, run: None
) -> list[Run]:
    """Play a set's motions on one robot and record them; `keep` gets each run when it is done."""
    robot = true_robot(answer)
    places = list(dict.fromkeys((motion.setup, motion.heading_rad) for motion in played))
    runs: dict[str, Run] = {}
    for setup, heading_rad in places:
        scenario = parse_scenario(tomllib.loads(scenario_of(answer, setup, heading_rad)))
        host = _Host(World(scenario.world))
        for number, motion in enumerate(played):
            if (motion.setup, motion.heading_rad) == (setup, heading_rad):
                runs[motion.name] = _record(host, robot, motion, number)
                keep(motion, runs[motion.name])
    return [runs[motion.name] for motion in played]


@dataclass
class _Wire:
    """`comms.line.Line` and `comms.clock.Clock` in one, over a world's wire."""

    world: World
    path: str = "virtual"
    baud: int = 1_000_000
    written: int = 0
    received: int = 0
    stepped: bool = True
    lateness: Lateness = field(default_factory=lambda: Lateness(real=False))
    _t: float = 0.0
    _coming: deque[tuple[float, bytes]] = field(default_factory=deque)
    _arrivals: list[tuple[int, float]] = field(default_factory=list)

    def fileno(self) -> int:
        return -1

    def write(self, data: bytes) -> None:
        self.written += len(data)
        self._coming.extend((reply.t, reply.data) for reply in self.world.line.receive(data, self._t, self.baud))

    def read(self) -> bytes:
        out, self._arrivals = b"", []
        while self._coming and self._coming[0][0] <= self._t:
            at, data = self._coming.popleft()
            out += data
            self.received += len(data)
            self._arrivals.append((self.received, at))
        return out

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def close(self) -> None:
        pass

    def now(self) -> float:
        return self._t

    def sleep_until(self, t: float) -> None:
        self._t = max(self._t, t)
        self.world.advance(self._t)

    def write_from(self, t: float) -> None:
        self.sleep_until(t)

    def wait_readable(self, line: object, deadline: float) -> bool:
        if self._coming and self._coming[0][0] <= max(deadline, self._t):
            self.sleep_until(self._coming[0][0])
            return True
        self.sleep_until(deadline)
        return False

    def arrivals(self, line: object) -> list[tuple[int, float]]:
        return self._arrivals

    def in_time(self, at: float, deadline: float) -> bool:
        return at <= deadline


class _Host:
    """A robot in its place, its bus, and what its IMU has seen last."""

    def __init__(self, world: World) -> None:
        self.world, self.wire = world, _Wire(world)
        self.bus = Bus(self.wire, self.wire, BusTiming(return_delay_s=0.0, latency_timer_s=1e-3))
        self.bus.guarded = True  # these servos end with this process
        parts = kit("standard")
        self.servos = Servos(
            self.bus,
            [Servo(name, joint.id, parts.servo(joint.kind), 1, math.pi) for name, joint in JOINTS.items()],
        )
        self.servos.identify()
        self.servos.set_torque(True)
        self.imu: deque[NDArray[np.float64]] = deque(maxlen=IMU_SAMPLES)
        world.events.append(lambda t: self.imu.append(np.concatenate([world.body.gyro, world.body.accelerometer])))
        self.risen = False

    def rest(self, commands: NDArray[np.float64], seconds: float) -> None:
        self.servos.write_goals(self.servos.goal_counts(commands.tolist()))
        self.wire.sleep_until(self.wire.now() + seconds)


def _record(host: _Host, robot: TrueRobot, motion: Motion, number: int) -> Run:
    chance = np.random.default_rng([robot.seed, number, 2])
    drives, n = host.world.drives, len(motion.commands)
    warm = robot.ambient_c + 2 + robot.warming_k * number / 6
    drives.case[:] = drives.winding[:] = warm
    host.rest(motion.commands[0], SETTLE_S if host.risen else RISE_S)
    host.risen = True
    start = host.wire.now() + 0.1
    t, cmd_t, poses = np.empty(n), np.empty(n), np.empty((n, 7))
    imu, blocks = np.empty((n, 6)), []
    limp = np.zeros(len(JOINTS), bool)
    for k, (command, hanging) in enumerate(zip(motion.commands, motion.limp, strict=True)):
        late = float(np.clip(chance.standard_normal(), -3, 3)) * robot.clocks.row_s
        host.wire.sleep_until(start + k / RATE_HZ + late)
        if (hanging != limp).any():
            host.servos.write_all(
                "torque_enable", {name: int(not hangs) for name, hangs in zip(JOINTS, hanging, strict=True)}
            )
            limp = hanging
        cmd_t[k] = host.servos.write_goals(host.servos.goal_counts(command.tolist()))
        blocks.append([block for _, block in host.servos.read_blocks()])
        t[k] = host.bus.request_at
        imu[k] = np.mean(host.imu, axis=0)
        poses[k] = [*host.world.body.position, *host.world.body.quaternion]
    off = np.clip(chance.standard_normal(n), -3, 3) * robot.clocks.stamp_s
    columns = _columns(motion, blocks)
    columns.update(imu_columns(robot.senses, imu, chance))
    if motion.setup == "floor" and robot.tracker:
        columns.update(tracker_columns(robot.senses, poses, chance))
    columns["cmd_t"] = cmd_t + off - t[0] - off[0]
    return Run(motion.name, facts_of(motion), t + off - t[0] - off[0], columns)


def _columns(motion: Motion, blocks: Sequence[Sequence[Block | None]]) -> dict[str, NDArray[Any]]:
    """Counts to units; a servo that did not answer in time leaves its samples empty."""
    parts, columns = kit("standard"), dict[str, NDArray[Any]]()
    for j, (name, joint) in enumerate(JOINTS.items()):
        model = parts.servo(joint.kind)
        servo = Servo(name, joint.id, model, 1, math.pi)
        rows = [row[j] for row in blocks]

        def column(counts: str, register: str, rows: list[Block | None] = rows, model: Any = model) -> NDArray[Any]:
            scale = model.registers[register].scale
            return np.array([math.nan if row is None else getattr(row, counts) * scale for row in rows])

        columns[f"cmd.{name}"] = motion.commands[:, j].copy()
        columns[f"pos.{name}"] = column("position", "present_position") - servo.zero_rad
        columns[f"vel.{name}"] = column("velocity", "present_velocity")
        effort = "present_current" if model.has_current_sensor else "present_load"
        columns[f"{'cur' if model.has_current_sensor else 'load'}.{name}"] = column("effort", effort)
        columns[f"pwm.{name}"] = column("pwm", "present_pwm")
        columns[f"volt.{name}"] = column("voltage", "present_input_voltage")
        columns[f"temp.{name}"] = column("temperature", "present_temperature")
        columns[f"torque.{name}"] = 1.0 - motion.limp[:, j]
        columns[f"ok.{name}"] = np.array([float(row is not None) for row in rows])
    return columns
