"""A Betaflight flight controller as its USB port sees it: MSP in, MSP out, sensors in between; no I/O, no clock.

The host feeds it time and bytes:

* `receive(data, t)`: bytes that arrived at `t`;
* `transmit(t)`: bytes that have left by `t`; it runs the serial task (100 times a second) up to `t`;
* `next_event(t)`: the next time at which something can happen, for hosts that step from event to event;
* `connected`: False while it is unplugged, boots, or sits in its ROM bootloader: then the host closes the port.

Times never run backwards; `truth` must then give the body's state of that moment. What moves the attitude filter is
called at least every 10 ms of robot time, else it integrates coarser.

The IMU is strapped to the body by a mounting rotation, has bias, scale error, noise and quantisation, and its firmware
estimates the attitude from them as the real one does, with a complementary filter (Mahony, IEEE TAC 2008, the form with
proportional gain only), so that yaw drifts and roll and pitch follow accelerations.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.comms import msp
from openant_tools.comms.msp import Command, Direction, MspFrame
from openant_tools.numbers import literal

__all__ = ["BodyState", "FlightController", "FlightControllerSettings"]

Array = NDArray[np.float64]

#: m/s², by definition
STANDARD_GRAVITY = 9.80665
I16 = 32767
#: s between two looks at its motion while nobody asks
IDLE_S = 0.01
#: Silence after a lone byte outside every frame, until it is taken for a command (facts/imu.md D1).
LONE_BYTE_SILENCE_S = 0.1
#: From power to the first answer over USB.
BOOT_S = 1.5
#: Betaflight's default dcm_kp 2500/10000.
ATTITUDE_GAIN = 0.25
#: Accelerations outside 0.9 … 1.1 g do not correct the attitude.
ATTITUDE_GATE = 0.1
#: s that a calibration of the accelerometer takes
ACC_CALIBRATION_S = 1.0
#: Full speed USB hands over once a millisecond; half of that on average.
USB_LATENCY_S = 0.5e-3

BANNER = b"\r\nEntering CLI Mode, type 'exit' to reboot, or 'help'\r\n\r\n# "


class BodyState(Protocol):
    """The body at one instant. All vectors in body axes (x forward, y left, z up).

    Attributes:
        quaternion: w x y z, world from body.
        rate: angular velocity, rad/s.
        specific_force: at the IMU, m/s²; +9.81 on z at rest.
    """

    @property
    def quaternion(self) -> Array: ...
    @property
    def rate(self) -> Array: ...
    @property
    def specific_force(self) -> Array: ...


@dataclass(frozen=True)
class FlightControllerSettings:
    """What a scenario may set of the flight controller (`[imu]`).

    Attributes:
        api_minor: 45 (firmware 4.4), 46 (4.5), 47 (2025) or 48 (2026). Until 45 the accelerometer has 512 LSB/g, which
            is what the platform's own code divides this board's readings by, whatever firmware it runs.
        acc_lsb_per_g: of the sensor, from API 1.46 on: 2048, 1024 or 4096.
        rate_hz: runs of the serial task a second (`serial_update_rate_hz`, 100 … 2000).
        mount_rpy: rotation of the board in the body, rad about x, then y, then z (body from board).
        acc_bias, acc_scale, acc_noise: m/s², factor, m/s² (one standard deviation of a reading); board axes.
        gyro_bias, gyro_scale, gyro_noise: rad/s, factor, rad/s; the bias is what the calibration at power-on left.
        magnetometer: boards for small drones mostly have none.
        multiple_msp: whether MULTIPLE_MSP is known (since August 2018).
        acc_calibrated: False sets the problem bit of BOARD_INFO.
        uid: three 32-bit words.
    """

    api_minor: int = 45
    acc_lsb_per_g: int = 2048
    rate_hz: float = 100.0
    mount_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    acc_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    acc_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    acc_noise: float = 0.03
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gyro_noise: float = 0.003
    magnetometer: bool = False
    multiple_msp: bool = True
    acc_calibrated: bool = True
    identifier: str = "S743"
    target: str = "STM32H743"
    board: str = "KAKUTEH7MINI"
    manufacturer: str = "HBRO"
    gyro_rate_hz: int = 8000
    uid: tuple[int, int, int] = (0x0033001B, 0x3039510C, 0x38363334)

    @property
    def lsb_per_g(self) -> int:
        """The scale that RAW_IMU has."""
        return msp.ACC_LSB_PER_G_OLD if self.api_minor <= 45 else self.acc_lsb_per_g


#: Firmware that goes with an API minor.
VERSIONS = {
    44: msp.FcVersion(4, 3, 2),
    45: msp.FcVersion(4, 4, 3),
    46: msp.FcVersion(4, 5, 1),
    47: msp.FcVersion(25, 12, 1, "2025.12.1"),
    48: msp.FcVersion(26, 6, 0, "2026.6.0"),
}


@dataclass
class _Calibration:
    """An accelerometer calibration under way: the mean over a second becomes level."""

    until: float
    readings: list[Array] = field(default_factory=list)


class FlightController:
    """One board. `truth` is asked for the body's state whenever the firmware reads its sensors.

    Attributes:
        silent: a fault: it takes requests and answers none.
        frozen: a fault: the sensors' last readings stand still.
        refused: a fault: messages that it answers with an error.
        mode: "msp", "cli" or "bootloader".
    """

    def __init__(
        self, settings: FlightControllerSettings, truth: Callable[[], BodyState], rng: np.random.Generator
    ) -> None:
        if settings.api_minor not in VERSIONS:
            raise ValueError(f"API 1.{settings.api_minor}: one of {', '.join(f'1.{m}' for m in VERSIONS)}")
        self.settings = settings
        self.silent = False
        self.frozen = False
        self.refused: set[int] = set()
        self.mode = "msp"
        #: s between two looks at the sensors while nobody asks
        self.idle_s = IDLE_S
        self._truth = truth
        self._rng = rng
        self._plugged = True
        self._boot_until = 0.0
        self._rate_hz = settings.rate_hz
        self._rate_typed = settings.rate_hz
        self._alignment = msp.BoardAlignment(0, 0, 0)
        self._alignment_set = self._alignment
        self._alignment_stored = self._alignment
        self._acc_trim = np.zeros(3)
        self._acc_calibrated = settings.acc_calibrated
        self._mount = rotation_from_rpy(*settings.mount_rpy)
        self._start(0.0)

    def _start(self, t: float) -> None:
        """Power-on: everything that is not stored is new."""
        self.mode = "msp"
        self._parser = msp.MspParser(msp.DEVICE_RECEIVE_LIMIT, rescan=False)
        self._requests: deque[MspFrame] = deque()
        self._out: deque[tuple[float, bytes]] = deque()
        self._lone: tuple[int, float] | None = None
        self._typed = bytearray()
        self._alignment = self._alignment_set = self._alignment_stored
        self._board = rotation_from_rpy(*np.deg2rad([self._alignment.roll, self._alignment.pitch, self._alignment.yaw]))
        self._tick_at = self._grid(t)
        self._tick = t
        self._attitude: Array | None = None
        #: the body's when it last looked
        self._quaternion = np.array([1.0, 0.0, 0.0, 0.0])
        self._acc = np.zeros(3)
        self._gyro = np.zeros(3)
        self._calibration: _Calibration | None = None

    # --- the host's side -------------------------------------------------------------------------------------------

    @property
    def connected(self) -> bool:
        """Whether the USB port exists at this moment."""
        return self._plugged and self.mode != "bootloader" and self._tick >= self._boot_until

    def unplug(self, t: float) -> None:
        """Pull the USB cable, which is also its power."""
        self._tick = max(self._tick, t)
        self._plugged = False

    def plug(self, t: float) -> None:
        """Put the cable back: it boots, and is there after `BOOT_S`."""
        self._plugged = True
        self._boot(t)

    def reboot(self, t: float) -> None:
        """What a brown-out of its regulator or `exit` in the command line does."""
        self._boot(t)

    def _boot(self, t: float) -> None:
        self._boot_until = t + BOOT_S
        self._start(t)

    def receive(self, data: bytes, t: float) -> None:
        """Bytes from the cable at `t`."""
        self._advance(t)
        if not self.connected or not data:
            return
        if self.mode == "cli":
            self._type(data, t)
            return
        frames = self._parser.feed(data[:-1])
        stray = self._parser.stray
        frames += self._parser.feed(data[-1:])
        self._requests.extend(frame for frame in frames if frame.direction is Direction.REQUEST)
        # Only a byte outside every frame that nothing follows is a command.
        lone = data[-1] in b"#R" and self._parser.stray > stray
        self._lone = (data[-1], t) if lone else None

    def transmit(self, t: float) -> bytes:
        """Bytes that have left by `t` and were not taken before."""
        self._advance(t)
        out = bytearray()
        while self._out and self._out[0][0] <= t:
            out += self._out.popleft()[1]
        return bytes(out) if self.connected else b""

    def next_event(self, t: float) -> float:
        """The next time after `t` at which bytes may leave or the mode may change."""
        times = [self._grid(t) if self._requests or self._attitude is None else t + self.idle_s]
        if self._out:
            times.append(max(t, self._out[0][0]))
        if self._lone is not None:
            times.append(self._lone[1] + LONE_BYTE_SILENCE_S)
        if t < self._boot_until:
            times = [self._boot_until]
        return min(times)

    # --- the firmware's tasks ----------------------------------------------------------------------------------------

    def _grid(self, t: float) -> float:
        """The first run of the serial task after `t`."""
        return (math.floor(t * self._rate_hz + 1e-6) + 1) / self._rate_hz

    def _advance(self, t: float) -> None:
        if t < self._boot_until:
            self._tick = max(self._tick, t)
            return
        if self._lone is not None and t - self._lone[1] >= LONE_BYTE_SILENCE_S:
            self._obey(*self._lone)
        while self._tick_at <= t and self._requests:
            run = self._tick_at
            self._tick_at = self._grid(run)
            self._sense(run)
            reply = self._answer(self._requests.popleft(), run)
            if reply is not None and not self.silent:
                self._out.append((run + USB_LATENCY_S, reply))
        if self._tick_at <= t:
            self._tick_at = self._grid(t)  # the runs since had nothing to do
        if t - self._tick >= self.idle_s or self._attitude is None:
            self._sense(t)

    def _sense(self, t: float) -> None:
        """Read the sensors and carry the attitude filter on."""
        dt = t - self._tick
        self._tick = max(self._tick, t)
        s, body = self.settings, self._truth()
        turned, self._quaternion = _rotation_vector(self._quaternion, body.quaternion), np.array(body.quaternion)
        if self.frozen:
            return
        noise = self._rng.standard_normal(6)
        acc = (self._mount.T @ body.specific_force) * s.acc_scale + s.acc_bias + s.acc_noise * noise[:3]
        self._acc = self._board @ acc - self._acc_trim
        self._gyro = self._turning(body.rate, noise[3:])
        if self._calibration is not None:
            self._calibrate(t)
        if self._attitude is None:
            if _is_weight(self._acc):  # let go above the floor, it feels nothing at first
                self._attitude = level_attitude(self._acc)
        elif dt > 0:
            # It reads its gyro thousands of times a second: between two looks it turns by what the body did, whatever feet that chatter
            # do to the rate of an instant.
            self._attitude = mahony(self._attitude, self._turning(turned / dt, noise[3:]), self._acc, dt)

    def _turning(self, rate: Array, noise: Array) -> Array:
        """What the gyro reads of a rate (rad/s, body axes), in the axes of the board."""
        s = self.settings
        turning: Array = self._board @ ((self._mount.T @ rate) * s.gyro_scale + s.gyro_bias + s.gyro_noise * noise)
        return turning

    def _calibrate(self, t: float) -> None:
        calibration = self._calibration
        assert calibration is not None
        calibration.readings.append(self._acc + self._acc_trim)
        if t >= calibration.until:
            self._acc_trim = np.mean(calibration.readings, axis=0) - [0.0, 0.0, STANDARD_GRAVITY]
            self._acc_calibrated = True
            self._calibration = None

    def _raw(self) -> msp.RawImu:
        acc = _i16(self._acc / STANDARD_GRAVITY * self.settings.lsb_per_g)
        gyro = _i16(self._gyro / msp.GYRO_RAD_S_PER_LSB)
        mag = (0, 0, 0)
        if self.settings.magnetometer and self._attitude is not None:
            # Middle latitudes: half a gauss, 60° down, 1090 LSB a gauss.
            mag = _i16(rotation(self._attitude).T @ np.array([0.25, 0.0, -0.43]) * 1090.0)
        return msp.RawImu(acc, gyro, mag)

    def _angles(self) -> msp.Attitude:
        r = rotation(self._level())
        roll = math.atan2(r[2, 1], r[2, 2])
        pitch = math.asin(max(-1.0, min(1.0, -r[2, 0])))
        yaw = math.degrees(-math.atan2(r[1, 0], r[0, 0])) % 360.0
        # Whole degrees by integer division of tenths.
        return msp.Attitude(
            round(math.degrees(roll) * 10), round(math.degrees(pitch) * 10), round(yaw * 10) // 10 % 360
        )

    def _level(self) -> Array:
        return np.array([1.0, 0.0, 0.0, 0.0]) if self._attitude is None else self._attitude

    def _answer(self, request: MspFrame, t: float) -> bytes | None:
        payload = None if request.command in self.refused else self._payload(request.command, request.payload, t)
        direction = Direction.ERROR if payload is None else Direction.REPLY
        reply = msp.encode(MspFrame(direction, request.command, payload or b"", request.framing, request.flags))
        if request.command == Command.REBOOT and payload is not None:
            self._boot(t)
        return reply

    def _payload(self, command: int, given: bytes, t: float) -> bytes | None:
        """Payload of the reply, or None for an error reply."""
        s = self.settings
        sensors = 0b100001 | (4 if s.magnetometer else 0)
        if command in self.refused:
            return None
        if command == Command.API_VERSION:
            return msp.ApiVersion(0, 1, s.api_minor).encode()
        if command == Command.FC_VARIANT:
            return b"BTFL"
        if command == Command.FC_VERSION:
            return VERSIONS[s.api_minor].encode()
        if command == Command.BOARD_INFO:
            problems = 0 if self._acc_calibrated else 1
            info = msp.BoardInfo(
                *(s.identifier, 0, 0, 0, s.target, s.board, s.manufacturer, bytes(32)),
                *(9, 2, s.gyro_rate_hz, problems, 1, 1),
            )
            return info.encode()
        if command == Command.BOARD_ALIGNMENT:
            return self._alignment_set.encode()
        if command == Command.SET_BOARD_ALIGNMENT:
            try:
                self._alignment_set = msp.BoardAlignment.decode(given)
            except msp.MspError:
                return None
            return b""
        if command == Command.EEPROM_WRITE:
            self._alignment_stored = self._alignment_set
            return b""
        if command in (Command.STATUS, Command.STATUS_EX):
            # The controller is never armed: no receiver is bound (bit 2 of the arming-disable flags).
            rest = bytes([3, 0, 0, 29]) + (4).to_bytes(4, "little")
            return msp.FlightStatus(125, 0, sensors, 0, 0, 12, rest).encode()
        if command == Command.RAW_IMU:
            return self._raw().encode()
        if command == Command.ATTITUDE:
            return self._angles().encode()
        if command == Command.ATTITUDE_QUATERNION and s.api_minor >= 48:
            return msp.AttitudeQuaternion(*self._level()).encode()
        if command == Command.ALTITUDE:
            return msp.Altitude(0.0, 0.0).encode()
        if command == Command.ANALOG:
            return msp.Analog(0.0, 0.0, 0, 0.0).encode()
        if command == Command.UID:
            return msp.Uid(s.uid).encode()
        if command == Command.ACC_CALIBRATION:
            self._calibration = _Calibration(t + ACC_CALIBRATION_S)
            return b""
        if command == Command.REBOOT:
            return b"\x00"
        if command == Command.MULTIPLE_MSP and s.multiple_msp:
            parts = [self._payload(inner, b"", t) for inner in given if inner != Command.MULTIPLE_MSP]
            if len(parts) < len(given) or any(part is None or len(part) > 255 for part in parts):
                return None
            return msp.encode_multiple(part for part in parts if part is not None)
        return None

    # --- bytes that are no MSP -----------------------------------------------------------------------------------

    def _obey(self, byte: int, t: float) -> None:
        """A lone byte was followed by silence."""
        self._lone = None
        if byte == ord("#"):
            self.mode = "cli"
            self._out.append((t + LONE_BYTE_SILENCE_S, BANNER))
        else:
            self.mode = "bootloader"

    def _type(self, data: bytes, t: float) -> None:
        """The command line: it repeats what is typed and knows the few commands that matter here."""
        for byte in data:
            if byte in b"\r\n":
                line, self._typed = bytes(self._typed).decode("ascii", "replace").strip(), bytearray()
                answer = self._command(line, t)
                if answer is None:
                    return
                self._out.append((t, b"\r\n" + answer + b"\r\n# "))
            elif 32 <= byte < 127:
                self._typed.append(byte)
                self._out.append((t, bytes([byte])))

    def _command(self, line: str, t: float) -> bytes | None:
        name, _, value = (part.strip() for part in line.removeprefix("set ").partition("="))
        if line == "exit":
            self._boot(t)
            return None
        if line == "save":
            self._rate_hz = self._rate_typed
            self._boot(t)
            return None
        if line == "version":
            return f"# Betaflight / {self.settings.target} {VERSIONS[self.settings.api_minor]}".encode()
        if name == "serial_update_rate_hz" and value.isdigit() and 100 <= int(value) <= 2000:
            self._rate_typed = float(value)
            return f"{name} set to {value}".encode()
        if line in ("get serial_update_rate_hz", ""):
            return f"serial_update_rate_hz = {literal(self._rate_typed)}".encode() if line else b""
        return b"unknown command, try 'help'"


# --- rotations ---------------------------------------------------------------------------------------------------


def rotation(q: Array) -> Array:
    """Rotation matrix of the unit quaternion w x y z."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Rotation about z by yaw, y by pitch, x by roll: Rz·Ry·Rx, rad."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _rotation_vector(before: Array, now: Array) -> Array:
    """(3,) rad in body axes, from one attitude to another (quaternions w x y z)."""
    turned = np.empty(3)
    mujoco.mju_subQuat(turned, now, before)
    return turned


def level_attitude(acc: Array) -> Array:
    """Quaternion w x y z with yaw 0 whose roll and pitch put `acc` upright."""
    roll = math.atan2(acc[1], acc[2])
    pitch = math.atan2(-acc[0], math.hypot(acc[1], acc[2]))
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return np.array([cr * cp, sr * cp, cr * sp, -sr * sp])


def _is_weight(acc: Array) -> bool:
    """Whether an acceleration says where up is."""
    return abs(math.hypot(*acc) / STANDARD_GRAVITY - 1.0) < ATTITUDE_GATE


def mahony(q: Array, gyro: Array, acc: Array, dt: float) -> Array:
    """One step of Mahony's complementary filter: rotate by the gyro, lean towards the accelerometer's vertical."""
    w, x, y, z = (float(v) for v in q)
    wx, wy, wz = (float(v) for v in gyro)
    ax, ay, az = (float(v) for v in acc)
    if _is_weight(acc):
        norm = math.sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax / norm, ay / norm, az / norm
        ux, uy, uz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        wx += ATTITUDE_GAIN * (ay * uz - az * uy)
        wy += ATTITUDE_GAIN * (az * ux - ax * uz)
        wz += ATTITUDE_GAIN * (ax * uy - ay * ux)
    h = 0.5 * dt
    out = np.array(
        [
            w - h * (x * wx + y * wy + z * wz),
            x + h * (w * wx + y * wz - z * wy),
            y + h * (w * wy - x * wz + z * wx),
            z + h * (w * wz + x * wy - y * wx),
        ]
    )
    return out / math.sqrt(float(out @ out))


def _i16(values: Array) -> tuple[int, int, int]:
    x, y, z = (int(v) for v in np.clip(np.rint(values), -I16 - 1, I16))
    return x, y, z
