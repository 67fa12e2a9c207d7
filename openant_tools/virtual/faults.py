"""What goes wrong on this robot while it runs: `[[fault]]` entries of a scenario, and faults switched by hand.

Every 2 ms the faults that are on are laid over the healthy state, so that a fault that ends leaves no trace. Names of
causes are those of formats, section 7; a few more make what a bench campaign needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.virtual.imperfections import nearest
from openant_tools.virtual.servo_power import ENCODER_ERROR
from openant_tools.virtual.world import World

__all__ = ["CAUSES", "Fault", "Faults"]

_REQUIRED = object()

#: cause → parameters with their defaults. `where` is a joint, a pair of joints (the cable between them), "all" or none.
CAUSES: Mapping[str, Mapping[str, Any]] = {
    # a plug that loses contact when the robot shakes: openings a second per rad/s of all joints together
    "power_connector": {"openings_per_rad": 0.05, "open_s": 0.02, "always": False},
    "supply_weak": {"volts": None, "resistance_ohm": 0.8},
    # open while the joint `depends_on` is beyond an angle; without one, always; `flicker` is the share that conducts
    "broken_wire": {"depends_on": None, "above_rad": None, "below_rad": None, "flicker": 0.0, "power": False},
    "bad_servo": {"fraction": 0.2},
    "bad_cable": {"fraction": 0.1},
    "line_noise": {"byte_error": 0.001},
    "return_delay": {"delay_s": 0.0005},
    "latency_timer": {"timer_s": 0.016},
    "host_stall": {"every_s": 1.0, "for_s": 0.05},
    "usb_unplug": {"device": "bus"},
    "duplicate_id": {"of": _REQUIRED},
    "write_read_gap": {"gap_s": 0.001},
    # not causes of lost communication, but what else befalls a robot
    "overheated": {"temperature_c": 85.0},
    # single answers in which the temperature is anything
    "temperature_glitch": {"fraction": 0.01},
    "encoder_error": {},
    "imu_silent": {},
    "imu_frozen": {},
    "camera_frozen": {},
    "camera_stalled": {},
}

_NEEDS_WHERE = frozenset(
    {"broken_wire", "bad_servo", "bad_cable", "duplicate_id", "overheated", "encoder_error"}
)  # fmt: skip


@dataclass
class Fault:
    """One fault: from `from_s` to `to_s` (s since power-on); `where` as joints, empty for the whole robot."""

    cause: str
    where: tuple[str, ...] = ()
    from_s: float = 0.0
    to_s: float = math.inf
    parameters: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, table: Mapping[str, Any], joints: Sequence[str], place: str) -> Fault:
        """A fault from a scenario's table or a control request; BadInput says what is wrong with it."""
        rest = dict(table)
        cause = rest.pop("cause", None)
        if not isinstance(cause, str) or cause not in CAUSES:
            raise BadInput(f"no fault has the cause {cause!r}", where=place, remedy=nearest(str(cause), CAUSES))
        where = rest.pop("where", ())
        if not isinstance(where, str | list | tuple | None):
            raise BadInput(f"where = {where!r}", where=place, remedy='where = "knee_fl", or a list of joints')
        names = () if where in ("all", None) else (where,) if isinstance(where, str) else tuple(where)
        for name in names:
            if name not in joints:
                raise BadInput(f"no joint {name!r}", where=place, remedy=nearest(str(name), joints))
        if cause in _NEEDS_WHERE and not names:
            raise BadInput(f"{cause} needs a joint", where=place, remedy='where = "knee_fl", or two for a cable')
        from_s, to_s = rest.pop("from_s", 0.0), rest.pop("to_s", math.inf)
        parameters = dict(CAUSES[cause])
        for name, value in rest.items():
            if name not in parameters:
                known = [*parameters, "where", "from_s", "to_s"]
                raise BadInput(f"{cause} has no setting {name!r}", where=place, remedy=nearest(name, known))
            parameters[name] = value
        for name in ("of", "depends_on"):
            value = parameters.get(name)
            if value is _REQUIRED or (value is not None and value not in joints):
                raise BadInput(f"{cause} needs {name} = a joint", where=place, remedy=nearest(str(value), joints))
        for name, value in (("from_s", from_s), ("to_s", to_s), *parameters.items()):
            if (
                name.endswith(("_s", "_v", "_rad", "_ohm", "fraction", "byte_error", "volts", "_c"))
                and value is not None
            ):
                good = isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)
                if not good or (value < 0 and not name.endswith("_rad")):
                    raise BadInput(f"{name} = {value!r}", where=place, remedy="a number, not below zero")
        return cls(cause, names, float(from_s), float(to_s), parameters)


class Faults:
    """Lays faults over a world; hangs itself on the world's polls when there is the first one.

    Args:
        unplug: called with ("bus" | "imu" | "camera", plugged) when a USB device goes or comes.
        imu: the flight controller, whose `silent` and `frozen` are switched. camera: told by `fault`.
    """

    def __init__(
        self,
        world: World,
        faults: Sequence[Fault] = (),
        *,
        unplug: Callable[[str, bool], None] | None = None,
        imu: Any = None,
        camera: Any = None,
    ) -> None:
        self.world = world
        self.faults: list[Fault] = list(faults)
        self.unplug, self.imu, self.camera = unplug, imu, camera
        self._random = np.random.default_rng(world.settings.seed + 7919)
        bus = world.line.settings
        self._latency, self._gap, self._noise = bus.latency_timer_s, bus.write_read_gap_s, bus.byte_error
        self._supply = (world.settings.supply.volts, world.settings.supply.resistance_ohm)
        self._open_until = -math.inf
        self._stall_at = -math.inf
        self._unplugged: set[str] = set()
        self._registers: dict[tuple[int, str], int] = {}
        self._camera_fault: str | None = None
        self._last = 0.0
        self._watching = False
        if self.faults:
            self._watch()

    def request(self, request: Mapping[str, Any]) -> None:
        """A control request: `{"cause", "where", "on", …}`; with `"on": false` all faults like it end."""
        table = {key: value for key, value in request.items() if key not in ("do", "on")}
        if request.get("on", True):
            table.setdefault("from_s", self.world.now)
            self.faults.append(Fault.of(table, self.world.joints, "fault"))
        else:
            rest: dict[str, Any] = {key: table[key] for key in ("cause", "where") if key in table}
            if rest.get("cause") == "duplicate_id":
                rest["of"] = self.world.joints[0]
            like = Fault.of(rest, self.world.joints, "fault")
            self.faults = [
                fault
                for fault in self.faults
                if fault.cause != like.cause or (like.where and fault.where != like.where)
            ]
        self._watch()
        self.apply(self.world.now)

    def _watch(self) -> None:
        if not self._watching:
            self.world.events.append(self.apply)
            self._watching = True
            self.apply(self.world.now)

    # ---- the healthy state, and what is laid over it ----

    def apply(self, now: float) -> None:
        """Set everything that faults touch for this moment."""
        world, bus = self.world, self.world.line.settings
        elapsed, self._last = now - self._last, now
        bus.cut, bus.lost, bus.broken = set(), {}, {}
        bus.latency_timer_s, bus.write_read_gap_s, bus.byte_error = self._latency, self._gap, self._noise
        path = np.ones(len(world.joints))
        volts, ohm = self._supply
        unplugged: set[str] = set()
        silent = frozen = False
        camera: str | None = None
        registers: dict[tuple[int, str], int] = {}
        garbled: dict[int, float] = {}
        for fault in self.faults:
            if not fault.from_s <= now < fault.to_s:
                continue
            p = fault.parameters
            behind = self._behind(fault.where)
            match fault.cause:
                case "power_connector":
                    if self._opens(fault, now, elapsed):
                        path[behind] = 0.0
                case "supply_weak":
                    volts = volts if p["volts"] is None else p["volts"]
                    ohm = p["resistance_ohm"]
                case "broken_wire":
                    if self._parted(p):
                        bus.cut.add(behind[0])
                        if p["power"]:
                            path[behind] = 0.0
                case "bad_servo":
                    self._degrade([world.joints.index(fault.where[-1])], p["fraction"])
                case "bad_cable":
                    self._degrade(behind, p["fraction"])
                case "line_noise":
                    bus.byte_error = p["byte_error"]
                case "return_delay":
                    for k in behind:
                        registers[k, "return_delay_time"] = min(254, round(p["delay_s"] / 2e-6))
                case "latency_timer":
                    bus.latency_timer_s = p["timer_s"]
                case "host_stall":
                    if now - self._stall_at >= p["every_s"]:
                        self._stall_at = now
                        bus.stalled_until = now + p["for_s"]
                case "usb_unplug":
                    unplugged.add(p["device"])
                case "duplicate_id":
                    twin = world.servos[world.joints.index(p["of"])]
                    registers[world.joints.index(fault.where[0]), "id"] = twin.id
                case "write_read_gap":
                    bus.write_read_gap_s = p["gap_s"]
                case "overheated":
                    for k in self._at(fault.where):
                        world.drives.case[k] = max(world.drives.case[k], p["temperature_c"])
                case "temperature_glitch":
                    garbled |= dict.fromkeys(self._at(fault.where) or range(len(path)), p["fraction"])
                case "encoder_error":
                    for k in self._at(fault.where):
                        world.servos[k].raise_hardware_error(ENCODER_ERROR)
                case "imu_silent":
                    silent = True
                case "imu_frozen":
                    frozen = True
                case "camera_frozen":
                    camera = "frozen"
                case "camera_stalled":
                    camera = "stalled"
        world.set_supply(volts, ohm)
        world.drives.set_path(path)
        world.drives.garbled = garbled
        self._set_registers(registers)
        self._set_devices(unplugged)
        if self.imu is not None:
            self.imu.silent, self.imu.frozen = silent, frozen
        if "camera" in unplugged:
            camera = "gone"
        if self.camera is not None and camera != self._camera_fault:
            self.camera.fault(camera)
            self._camera_fault = camera

    def _at(self, where: Sequence[str]) -> list[int]:
        return [self.world.joints.index(name) for name in where]

    def _behind(self, where: Sequence[str]) -> list[int]:
        """Positions that hang behind a joint's cable (or the cable between two), it included; all without one."""
        if not where:
            return list(range(len(self.world.joints)))
        places = self._at(where)
        for chain in self.world.line.settings.chains:
            if places[0] in chain:
                # Between two joints: the outer one's side.
                first = max(list(chain).index(k) for k in places if k in chain)
                return list(chain)[first:]
        return places

    def _opens(self, fault: Fault, now: float, elapsed: float) -> bool:
        p = fault.parameters
        if p["always"]:
            return True
        shaking = float(np.abs(self.world.body.v).sum())
        if now >= self._open_until and self._random.random() < p["openings_per_rad"] * shaking * elapsed:
            self._open_until = now + p["open_s"] * float(self._random.uniform(0.3, 1.7))
        return now < self._open_until

    def _parted(self, p: Mapping[str, Any]) -> bool:
        if p["depends_on"] is not None:
            angle = float(self.world.body.q[self.world.joints.index(p["depends_on"])])
            above, below = p["above_rad"], p["below_rad"]
            apart = (above is None or angle > above) and (below is None or angle < below)
            if not apart:
                return False
        return not p["flicker"] or bool(self._random.random() >= p["flicker"])

    def _degrade(self, places: Sequence[int], fraction: float) -> None:
        """Half of what a bad contact costs is lost whole, there or back, half arrives broken."""
        bus = self.world.line.settings
        passes = math.sqrt(max(0.0, 1 - fraction / 2))
        whole = (1 - fraction) / (1 - fraction / 2) if fraction < 1 else 0.0
        for k in places:
            bus.lost[k] = 1 - (1 - bus.lost.get(k, 0.0)) * passes
            bus.broken[k] = 1 - (1 - bus.broken.get(k, 0.0)) * whole

    def _set_registers(self, wanted: Mapping[tuple[int, str], int]) -> None:
        for (k, name), healthy in list(self._registers.items()):
            if (k, name) not in wanted:
                self.world.servos[k].set(name, healthy)
                del self._registers[k, name]
        for (k, name), counts in wanted.items():
            if (k, name) not in self._registers:
                self._registers[k, name] = self.world.servos[k].get(name)
                self.world.servos[k].set(name, counts)

    def _set_devices(self, unplugged: set[str]) -> None:
        if self.unplug is None or unplugged == self._unplugged:
            return
        for device in unplugged ^ self._unplugged:
            self.unplug(device, device not in unplugged)
        self._unplugged = unplugged
