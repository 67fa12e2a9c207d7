"""Everything that happens between two bytes: servos, motors, mechanics, supply and heat, brought forward in time.

Time is a plain number of seconds since the robot was switched on. Whoever holds the world (the server in real time, a
test step by step) says until when; the world never looks at a clock.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import kit as kit_by_name
from openant_tools.robot.servo import ServoModel, baud_code
from openant_tools.virtual.body import Body, BodySettings
from openant_tools.virtual.bus import BusSettings, Wire
from openant_tools.virtual.drives import Drive, Drives
from openant_tools.virtual.hands import Grip, Tilting
from openant_tools.virtual.motor import MotorSettings
from openant_tools.virtual.servo import ServoDevice
from openant_tools.virtual.servo_power import OVERLOAD_ERROR

__all__ = ["MOUNT_EIGHTHS", "ServoSetup", "SupplySettings", "World", "WorldSettings", "standard_servos"]

#: s between two looks of firmware and supply at themselves.
POLL_S = 5e-3
#: s between two steps of heat: a winding takes many seconds
HEAT_S = 2e-2
#: s of standstill before mechanics are left out, and for how long at most.
REST_S, DOZE_S = 0.1, 2.0
#: s from one look to the next meanwhile, where nothing hangs on the polls, and the fewest steps worth leaving out.
NAP_S, SHORTEST_NAP = 0.1, 4
#: Eighths of a turn from the servo's zero to the joint's: horns go on in steps of 45°, and half a turn keeps the whole
#: range of every joint away from the encoder's seam.
MOUNT_EIGHTHS = 4
#: A servo calls it overload when nearly all of its stall current flows this long; unpublished.
OVERLOAD_SHARE, OVERLOAD_S = 0.8, 2.0


@dataclass
class ServoSetup:
    """One servo as it was bought, set up and built in.

    Attributes:
        joint: what it moves. model, firmware: what it is.
        registers: name → counts that stand in its EEPROM or RAM at the start.
        reversed: mounted so that the joint's positive direction is the servo's negative.
        spline_offset: horn put on that many eighths of a turn away from where the guide says.
        mount_rad: shaft angle at the joint's zero, in place of the guide's; zero_error_rad: what is added to it.
        motor: motor, gear and sensor; None for the data sheet's.
    """

    joint: str
    model: ServoModel
    firmware: int = 46
    registers: dict[str, int] = field(default_factory=dict)
    reversed: bool = False
    spline_offset: int = 0
    mount_rad: float | None = None
    zero_error_rad: float = 0.0
    motor: MotorSettings | None = None
    clock_ppm: float = 0.0


@dataclass
class SupplySettings:
    """One supply for all: V without load, and the resistance of supply, connector and cables in Ω."""

    volts: float = 12.0
    resistance_ohm: float = 0.0


@dataclass
class WorldSettings:
    """All that the world is made of; `openant_tools.virtual.scenario` fills it from a file."""

    servos: list[ServoSetup]
    body: BodySettings = field(default_factory=BodySettings)
    bus: BusSettings = field(default_factory=BusSettings)
    supply: SupplySettings = field(default_factory=SupplySettings)
    ambient_c: float = 25.0
    #: the room swings about `ambient_c` by so many K, once in so many s, rising at first
    ambient_swing_k: float = 0.0
    ambient_period_s: float = 3600.0
    doze: bool = False
    seed: int = 0
    #: what differs from the defaults of `FlightControllerSettings`
    imu: dict[str, Any] = field(default_factory=dict)
    #: the same for `OverheadCameraSettings`
    camera: dict[str, Any] = field(default_factory=dict)


def standard_servos(kit: str = "standard", *, factory: bool = False) -> list[ServoSetup]:
    """The eight servos of a kit: set up as the platform's guide says, or as they come from the factory."""
    parts = kit_by_name(kit)
    setups = []
    for joint in JOINTS.values():
        model = parts.servo(joint.kind)
        registers = {} if factory else {"id": joint.id, "baud_rate": baud_code(1_000_000), "return_delay_time": 0}
        setups.append(ServoSetup(joint.name, model, registers=registers))
    return setups


class World:
    """The robot and everything around it.

    Attributes:
        servos: the devices, in the order of `settings.servos`. line: the wire that they hang on.
        time: s since power-on.
        events: called with the time at every poll, before firmware and supply look; faults hang on it.
    """

    def __init__(self, settings: WorldSettings) -> None:
        self.settings = settings
        joints = [setup.joint for setup in settings.servos]
        self.joints = tuple(joints)
        self._build_body()
        self.servos = [self._build(setup, Drive(self.drives, k)) for k, setup in enumerate(settings.servos)]
        self.line = Wire(self.servos, settings.bus, self.advance, seed=settings.seed + 1)
        if not settings.bus.chains:
            settings.bus.chains = _chains_by_leg(joints)
        self.events: list[Callable[[float], None]] = []
        self._tilting: Tilting | None = None
        self._steps = self._heated = 0
        self._poll_every = max(1, round(POLL_S / settings.body.timestep_s))
        self._heat_every = max(1, round(HEAT_S / settings.body.timestep_s))
        self._overloaded_s = np.zeros(len(joints))
        #: leave mechanics out while everything stands still, for soaks of hours
        self.doze = settings.doze
        self._touched, self._rest_since = -1, 0
        self.now = 0.0

    def _build_body(self) -> None:
        """Mechanics, motors and gears as the settings have them."""
        settings = self.settings
        self.body = Body(settings.body, self.joints)
        motors = [setup.motor or MotorSettings.of(setup.model) for setup in settings.servos]
        signs = np.array([-1.0 if setup.reversed else 1.0 for setup in settings.servos])
        mount = np.array(
            [
                (MOUNT_EIGHTHS * math.pi / 4 if setup.mount_rad is None else setup.mount_rad)
                + setup.spline_offset * math.pi / 4
                + sign * setup.zero_error_rad
                for setup, sign in zip(settings.servos, signs, strict=True)
            ]
        )
        self.drives = Drives(self.body, motors, signs, mount, seed=settings.seed)
        self.drives.ambient = settings.ambient_c
        self.drives.touching = self._touching(motors)
        self.drives.winding[:] = self.drives.case[:] = settings.ambient_c
        self.set_supply(settings.supply.volts, settings.supply.resistance_ohm)
        self._heavy_a = OVERLOAD_SHARE * settings.supply.volts / self.drives.resistance

    def _touching(self, motors: Sequence[MotorSettings]) -> np.ndarray[Any, Any] | None:
        """W/K between the cases of servos that are screwed to each other: hip and knee of one leg."""
        conductance = np.zeros((len(motors), len(motors)))
        for chain in _chains_by_leg(self.joints) if self.settings.body.setup != "loose" else ():
            for one, other in itertools.pairwise(chain):
                conductance[one, other] = conductance[other, one] = min(motors[one].leg_w_k, motors[other].leg_w_k)
        return conductance if conductance.any() else None

    def _warm(self) -> None:
        """Let heat flow over the time since the last call."""
        seconds, self._heated = (self._steps - self._heated) * self.settings.body.timestep_s, self._steps
        settings = self.settings
        if settings.ambient_swing_k:
            phase = 2 * math.pi * self._steps * settings.body.timestep_s / settings.ambient_period_s
            self.drives.ambient = settings.ambient_c + settings.ambient_swing_k * math.sin(phase)
        self.drives.heat(seconds)

    def assemble(self, setup: str) -> None:
        """Take the motors out of the box and build the robot, or put it elsewhere; every servo starts anew.

        What the servos have in their EEPROM stays; the robot stands or lies as at a start.
        """
        self.settings.body.setup = setup
        self._tilting = None
        was = self.drives
        self._build_body()
        self.drives.time, self.drives.now = was.time, self.now
        self.drives.winding, self.drives.case = was.winding, was.case
        self.drives.supply_v, self.drives.supply_ohm = was.supply_v, was.supply_ohm
        self.line.plugged = set(range(len(self.servos)))
        for k, servo in enumerate(self.servos):
            servo.motor = Drive(self.drives, k)
            servo.power_off()
            servo.power_on(self.now)

    def _build(self, setup: ServoSetup, drive: Drive) -> ServoDevice:
        servo = ServoDevice(setup.model, drive, firmware=setup.firmware, clock_ppm=setup.clock_ppm)
        ram = {}
        for name, counts in setup.registers.items():
            register = setup.model.register(name)
            if register.area == "EEPROM":
                servo.set(name, counts)
            else:
                ram[name] = counts
        servo.boot(0.0, mute=False)
        for name, counts in ram.items():
            servo.set(name, counts)
        servo.settle()
        return servo

    # ---- time ----

    def advance(self, t: float) -> None:
        """Bring everything to time t (s); a time already passed changes nothing."""
        dt = self.settings.body.timestep_s
        target = math.floor(t / dt + 1e-9)
        drives = self.drives
        while self._steps < target:
            if self.doze and self._asleep(target):
                continue
            drives.step(self._steps)
            self._steps += 1
            if self._steps % self._poll_every == 0:
                self._poll(POLL_S, protect=self._steps % self._heat_every == 0)
            if self._steps % self._heat_every == 0:
                self._warm()
        self.now = drives.now = max(self.now, t)

    def _asleep(self, target: int) -> bool:
        """While all stands still, let only heat go on: one bound of NAP_S without mechanics. True where it did so.

        It wakes on whatever the drives are told, and by itself once in DOZE_S, so that what creeps or warms is seen.
        """
        drives, dt = self.drives, self.settings.body.timestep_s
        if drives.touched != self._touched or self._tilting is not None or not drives.at_rest:
            self._touched, self._rest_since = drives.touched, self._steps
            return False
        resting = (self._steps - self._rest_since) * dt
        if resting < REST_S:
            return False
        if resting > REST_S + DOZE_S:
            self._rest_since = self._steps
            return False
        longest = self._heat_every if self.events else round(NAP_S / dt)
        nap = min(longest, target - self._steps)
        if nap < SHORTEST_NAP:
            return False
        self._steps += nap
        drives.time += nap * dt
        self._poll(nap * dt, protect=True)
        self._warm()
        return True

    def _poll(self, elapsed: float, *, protect: bool) -> None:
        """Let faults, hands, firmware and supply look at what `elapsed` (s) brought."""
        now = self._steps * self.settings.body.timestep_s
        self.now, self.drives.now = max(self.now, now), now
        for event in self.events:
            event(now)
        if self._tilting is not None:
            self.body.hold(*self._tilting.at(now))
            if self._tilting.ended(now):
                self._tilting = None
        drives = self.drives
        drives.watch_supply(elapsed)
        for k, servo in enumerate(self.servos):
            if drives.starving and drives.starved_s[k] > drives.motors[k].reset_s:
                if servo.powered:
                    servo.power_off()
                    drives.powered[k] = 0.0
            elif not servo.powered and k in self.line.plugged and drives.starved_s[k] == 0:
                drives.powered[k] = 1.0
                servo.power_on(now)
            elif servo.powered:
                servo.watch_bus(now)
                if protect:
                    servo.protect(drives.voltage_at(k), float(drives.case[k]))
        heavy = np.abs(drives.current) > self._heavy_a
        if heavy.any():
            self._overloaded_s = np.where(heavy, self._overloaded_s + elapsed, 0.0)
            for k in map(int, np.flatnonzero(self._overloaded_s > OVERLOAD_S)):
                self.servos[k].raise_hardware_error(OVERLOAD_ERROR)
        else:
            self._overloaded_s[:] = 0.0

    def plug(self, k: int, plugged: bool) -> None:
        """Put servo k on the cable, which powers it, or take it off."""
        if plugged and k not in self.line.plugged:
            self.line.plugged.add(k)
            self.drives.powered[k] = 1.0
            self.servos[k].power_on(self.now)
        elif not plugged and k in self.line.plugged:
            self.line.plugged.discard(k)
            self.drives.powered[k] = 0.0
            self.servos[k].power_off()

    # ---- what hands do ----

    def turn_by_hand(self, k: int, angles: Sequence[float], leg_s: float) -> None:
        """Take joint k and lead it from where it is through `angles` (rad), `leg_s` (s) each; the last one is held."""
        here = float(self.body.q[k])
        self.drives.grips[k] = Grip(self.drives.time, (here, *angles), leg_s)
        self.drives.touched += 1

    def let_go(self) -> None:
        """Hands off every joint; a tilted torso stays as it is."""
        self.drives.grips.clear()
        self.drives.touched += 1

    def put(self, position_m: Sequence[float] | None, rotation_rad: Sequence[float] | None) -> None:
        """Pick the robot up and put it on the floor, by default on its feet where it began; (2,) m and (3,) rad."""
        body = self.settings.body
        here = body.position_m if position_m is None else position_m
        self.body.put(here, (0.0, 0.0, body.heading_rad) if rotation_rad is None else rotation_rad)
        self.drives.touched += 1

    def tilt_by_hand(self, rotation_rad: Sequence[float], seconds: float) -> None:
        """Turn the torso on its stand to an attitude, as a rotation vector in the world, rad."""
        self._tilting = Tilting.to(self.now, self.body.quaternion, rotation_rad, seconds)

    @property
    def line_baud(self) -> int:
        """The rate taken for a port that has none (TCP): that of most servos on the line."""
        bauds = [self.servos[k].baud for k in self.line.plugged] or [57_600]
        return max(set(bauds), key=bauds.count)

    # ---- what faults change ----

    def set_supply(self, volts: float, resistance_ohm: float) -> None:
        self.drives.supply_v, self.drives.supply_ohm = volts, resistance_ohm

    # ---- what is true ----

    @property
    def lit(self) -> list[str]:
        """Joints whose servo's LED is on."""
        pairs = zip(self.joints, self.servos, strict=True)
        return [joint for joint, servo in pairs if servo.powered and servo.get("led")]

    def state(self) -> dict[str, Any]:
        """The truth behind the sensors, for tests and people: rad, rad/s, N·m, A, V, °C, m."""
        drives, body = self.drives, self.body

        def per_joint(values: Sequence[Any] | np.ndarray[Any, Any]) -> dict[str, Any]:
            return {joint: _plain(value) for joint, value in zip(self.joints, values, strict=True)}

        return {
            "t": self.now,
            "setup": self.settings.body.setup,
            "angle": per_joint(body.q),
            "velocity": per_joint(body.v),
            "torque": per_joint(drives.joint_torque),
            "current": per_joint(drives.current),
            "duty": per_joint(drives.duty),
            "temperature": per_joint(drives.case),
            "winding_temperature": per_joint(drives.winding),
            "torque_enable": per_joint([servo.torque for servo in self.servos]),
            "powered": per_joint([servo.powered for servo in self.servos]),
            "shut_down": per_joint([servo.shut_down for servo in self.servos]),
            "hardware_error": per_joint([servo.memory[70] for servo in self.servos]),
            "id": per_joint([servo.id for servo in self.servos]),
            "baud": per_joint([servo.baud for servo in self.servos]),
            "plugged": per_joint([k in self.line.plugged for k in range(len(self.servos))]),
            "supply_v": drives.voltage,
            "base": {
                "position": body.position.tolist(),
                "quaternion": body.quaternion.tolist(),
                "gyro": body.gyro.tolist(),
                "acceleration": body.accelerometer.tolist(),
            },
        }


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value


def _chains_by_leg(joints: Sequence[str]) -> list[list[int]]:
    """One cable a leg, hip first, as the robot is wired; what is no joint of ours hangs on its own cable."""
    chains: dict[str, list[int]] = {}
    for k, name in enumerate(joints):
        leg = JOINTS[name].leg.name if name in JOINTS else name
        chains.setdefault(leg, []).append(k)
    return list(chains.values())
