"""MultiWii Serial Protocol as Betaflight speaks it: one codec for both ends of the cable.

Framing (all numbers little-endian, facts/imu.md D1):

* v1        `$ M dir size cmd payload xor`, the XOR over size, cmd and payload;
* v1 jumbo  `$ M dir 255 cmd size16 payload xor`, for payloads of 255 bytes and more, device to host only;
* v2        `$ X dir flags cmd16 size16 payload crc8`, CRC-8/DVB-S2 over flags … payload;
* v2 over v1: a v1 frame with cmd 255 whose payload is `flags cmd16 size16 payload crc8`; both checksums must hold.

`dir` is `<` for a request, `>` for a reply and `!` for an error reply.

The parser takes any bytes in any portions, never raises and never waits for more than one largest frame. A frame comes
out only if its checksums hold, and a payload becomes a measurement only if it has exactly the length that belongs:
an 8-bit checksum alone lets one random frame in 256 through.
"""

from __future__ import annotations

import enum
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from openant_tools.errors import HardwareFault

__all__ = [
    "Analog",
    "ApiVersion",
    "Attitude",
    "AttitudeQuaternion",
    "BoardAlignment",
    "BoardInfo",
    "Command",
    "Direction",
    "FcVersion",
    "FlightStatus",
    "Framing",
    "MspError",
    "MspFrame",
    "MspParser",
    "RawImu",
    "Uid",
    "crc8_dvb_s2",
    "decode_multiple",
    "encode",
    "encode_multiple",
    "request",
]

V1_JUMBO_SIZE = 255
V2_FRAME_ID = 255
DEVICE_RECEIVE_LIMIT = 192  # payload bytes that Betaflight's serial buffer takes (facts/imu.md D1)
HOST_RECEIVE_LIMIT = 4096  # longest reply that Betaflight sends is a block of flash, 4 kB


class MspError(HardwareFault):
    """A payload that is not the message it claims to be."""


class Direction(enum.Enum):
    """The third byte of every frame."""

    REQUEST = ord("<")
    REPLY = ord(">")
    ERROR = ord("!")


class Framing(enum.Enum):
    """Which of the three envelopes a frame wears; jumbo is v1's answer to length, not a choice."""

    V1 = "v1"
    V2 = "v2"
    V2_OVER_V1 = "v2 over v1"


class Command(enum.IntEnum):
    """The message numbers that an IMU needs (facts/imu.md D2)."""

    API_VERSION = 1
    FC_VARIANT = 2
    FC_VERSION = 3
    BOARD_INFO = 4
    BOARD_ALIGNMENT = 38
    SET_BOARD_ALIGNMENT = 39
    REBOOT = 68
    STATUS = 101
    RAW_IMU = 102
    ATTITUDE = 108
    ALTITUDE = 109
    ANALOG = 110
    STATUS_EX = 150
    UID = 160
    ATTITUDE_QUATERNION = 167
    ACC_CALIBRATION = 205
    MULTIPLE_MSP = 230
    EEPROM_WRITE = 250


def command_name(command: int) -> str:
    """Name of a message number for people, such as `RAW_IMU (102)`."""
    try:
        return f"{Command(command).name} ({command})"
    except ValueError:
        return f"message {command}"


# --- checksums ---------------------------------------------------------------------------------------------------


def _crc8_table() -> bytes:
    table = bytearray()
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1) ^ 0xD5 if crc & 0x80 else crc << 1
            crc &= 0xFF
        table.append(crc)
    return bytes(table)


_CRC8 = _crc8_table()


def crc8_dvb_s2(data: bytes | bytearray) -> int:
    """CRC-8/DVB-S2: polynomial 0xD5, initial value 0; of `123456789` it is 0xBC."""
    crc = 0
    for byte in data:
        crc = _CRC8[crc ^ byte]
    return crc


def _xor(data: bytes | bytearray) -> int:
    check = 0
    for byte in data:
        check ^= byte
    return check


# --- framing -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MspFrame:
    """One frame. `command` is 0 … 255 in v1 and 0 … 65535 in v2; `flags` exists in v2 only."""

    direction: Direction
    command: int
    payload: bytes = b""
    framing: Framing = Framing.V1
    flags: int = 0


def encode(frame: MspFrame) -> bytes:
    """Bytes of one frame, to be sent in one write.

    Raises:
        ValueError: a command or payload that the chosen framing cannot carry.
    """
    size = len(frame.payload)
    if frame.framing is Framing.V1:
        return _encode_v1(frame.direction, frame.command, frame.payload)
    if not 0 <= frame.command <= 0xFFFF or size > 0xFFFF or not 0 <= frame.flags <= 0xFF:
        raise ValueError(f"MSP v2 carries no command {frame.command} with flags {frame.flags} and {size} bytes")
    body = struct.pack("<BHH", frame.flags, frame.command, size) + frame.payload
    body += bytes([crc8_dvb_s2(body)])
    if frame.framing is Framing.V2:
        return b"$X" + bytes([frame.direction.value]) + body
    return _encode_v1(frame.direction, V2_FRAME_ID, body)


def _encode_v1(direction: Direction, command: int, payload: bytes) -> bytes:
    size = len(payload)
    if not 0 <= command <= 0xFF or size > 0xFFFF:
        raise ValueError(f"MSP v1 carries no command {command} with {size} bytes")
    if size < V1_JUMBO_SIZE:
        body = bytes([size, command]) + payload
    elif direction is Direction.REQUEST:
        raise ValueError(f"a request of {size} bytes: only replies may be longer than {V1_JUMBO_SIZE - 1}")
    else:
        body = struct.pack("<BBH", V1_JUMBO_SIZE, command, size) + payload
    return b"$M" + bytes([direction.value]) + body + bytes([_xor(body)])


def request(command: int, payload: bytes = b"", framing: Framing = Framing.V1) -> bytes:
    """Bytes of a request."""
    return encode(MspFrame(Direction.REQUEST, command, payload, framing))


_DIRECTIONS = {direction.value: direction for direction in Direction}


class MspParser:
    """Turns a stream of bytes, in any portions, into frames.

    Args:
        limit: longest payload that is believed, in bytes; a header that claims more is no frame.
        rescan: after a broken frame, look for a frame inside its bytes (a host that lost bytes wants that); a device
            drops a broken frame whole, as the firmware does.

    Attributes:
        broken: frames dropped for a checksum, a length or an unknown direction.
        stray: how many bytes stood outside every frame.
    """

    def __init__(self, limit: int = HOST_RECEIVE_LIMIT, *, rescan: bool = True) -> None:
        self.broken = 0
        self.stray = 0
        self._flaws = 0
        self._limit = limit
        self._rescan = rescan
        self._buffer = bytearray()

    @property
    def clean(self) -> bool:
        """Whether whole frames and nothing else came since `reset`.

        One reply is due to one request. Where a byte was lost or slipped in, an 8-bit checksum at the wrong place still
        holds once in 256 times, but something is then left over or missing: a host believes clean replies only.
        """
        return not self._buffer and self.broken + self.stray == self._flaws

    def reset(self) -> None:
        """Forget a frame that has begun, and what was not clean."""
        self._buffer.clear()
        self._flaws = self.broken + self.stray

    def feed(self, data: bytes | bytearray) -> list[MspFrame]:
        """Frames completed by these bytes, in order."""
        self._buffer += data
        frames: list[MspFrame] = []
        at = 0
        while at < len(self._buffer):
            start = self._buffer.find(b"$", at)
            if start != at:
                end = len(self._buffer) if start < 0 else start
                self.stray += end - at
                at = end
                continue
            length = self._length(at)
            if length is None or length > len(self._buffer) - at:
                break
            frame = _decode(self._buffer[at : at + length]) if length else None
            if frame is not None:
                frames.append(frame)
                at += length
            elif length and not self._rescan:
                self.broken += 1
                at += length
            else:
                self.broken += length > 0
                self.stray += 1
                at += 1
        del self._buffer[:at]
        return frames

    def _length(self, at: int) -> int | None:
        """Whole length of the frame that begins at `at`: None while the header is incomplete, 0 if it is no frame."""
        head = self._buffer[at : at + 8]
        if (len(head) > 1 and head[1] not in b"MX") or (len(head) > 2 and head[2] not in _DIRECTIONS):
            return 0
        if len(head) < 4:
            return None
        if head[1:2] == b"X":
            if len(head) < 8:
                return None
            size, frame = int.from_bytes(head[6:8], "little"), 9
        elif head[3] == V1_JUMBO_SIZE and head[2] != Direction.REQUEST.value:
            if len(head) < 7:
                return None
            size, frame = int.from_bytes(head[5:7], "little"), 8
        else:
            size, frame = head[3], 6
        return size + frame if size <= self._limit else 0


def _decode(data: bytearray) -> MspFrame | None:
    """The frame in these bytes, or None where a checksum or an inner length is wrong."""
    direction = _DIRECTIONS[data[2]]
    if data[1:2] == b"X":
        return _decode_v2(direction, data[3:], Framing.V2)
    if _xor(data[3:-1]) != data[-1]:
        return None
    jumbo = data[3] == V1_JUMBO_SIZE and direction is not Direction.REQUEST
    payload = data[7:-1] if jumbo else data[5:-1]
    if data[4] == V2_FRAME_ID:
        return _decode_v2(direction, payload, Framing.V2_OVER_V1)
    return MspFrame(direction, data[4], bytes(payload), Framing.V1)


def _decode_v2(direction: Direction, body: bytearray, framing: Framing) -> MspFrame | None:
    """`body` is flags … crc8."""
    if len(body) < 6 or crc8_dvb_s2(body[:-1]) != body[-1]:
        return None
    flags, command, size = struct.unpack_from("<BHH", body)
    if size != len(body) - 6:
        return None
    return MspFrame(direction, command, bytes(body[5:-1]), framing, flags)


# --- messages ----------------------------------------------------------------------------------------------------

RAD_PER_DEG = 3.141592653589793 / 180.0
GYRO_RAD_S_PER_LSB = 2000.0 / 32768.0 * RAD_PER_DEG  # most ±2000 deg/s parts; always raw LSB (facts/imu.md D2)
ACC_LSB_PER_G_OLD = 512  # until API 1.45 the firmware itself divided every sensor down to this (Betaflight #13026)
ACC_LSB_PER_G_NEW = (2048, 1024, 4096)  # from API 1.46 the sensor's own scale, most common first
QUATERNION_LSB = 32767.0


class _Payload:
    """Reads a payload from front to back by length; what newer firmware appended stays unread."""

    def __init__(self, command: int, data: bytes) -> None:
        self.command, self.data, self.at = command, data, 0

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def take(self, count: int) -> bytes:
        if count > self.left:
            raise MspError(f"the reply to {command_name(self.command)} ends after {len(self.data)} bytes")
        self.at += count
        return self.data[self.at - count : self.at]

    def unpack(self, form: str) -> tuple[int, ...]:
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def text(self) -> str:
        """A string with its length in front."""
        return self.take(self.take(1)[0]).decode("ascii", "replace")


def _exactly(command: Command, form: str, payload: bytes) -> tuple[int, ...]:
    expected = struct.calcsize("<" + form)
    if len(payload) != expected:
        raise MspError(f"the reply to {command_name(command)} has {len(payload)} bytes where {expected} belong")
    return struct.unpack("<" + form, payload)


def _text(data: str, limit: int = 255) -> bytes:
    raw = data.encode("ascii", "replace")[:limit]
    return bytes([len(raw)]) + raw


@dataclass(frozen=True)
class ApiVersion:
    """API_VERSION: major 1, and a minor of 45 for Betaflight 4.4, 46 for 4.5, 47 for the 2025 line, 48 for 2026."""

    protocol: int
    major: int
    minor: int

    @classmethod
    def decode(cls, payload: bytes) -> ApiVersion:
        """Payload of three bytes."""
        return cls(*_Payload(Command.API_VERSION, payload).unpack("BBB"))

    def encode(self) -> bytes:
        """Payload of the reply."""
        return bytes([self.protocol, self.major, self.minor])

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}"


@dataclass(frozen=True)
class BoardInfo:
    """BOARD_INFO, whose length grew with the firmware: what an older firmware does not send is None or empty."""

    identifier: str
    hardware_revision: int
    type: int = 0
    capabilities: int = 0
    target: str = ""
    board: str = ""
    manufacturer: str = ""
    signature: bytes = bytes(32)
    mcu: int | None = None
    config_state: int | None = None
    gyro_rate_hz: int | None = None
    problems: int | None = None
    spi_devices: int | None = None
    i2c_devices: int | None = None

    @property
    def accelerometer_uncalibrated(self) -> bool:
        """Bit 0 of the problems (API 1.43 and later)."""
        return bool((self.problems or 0) & 1)

    @classmethod
    def decode(cls, payload: bytes) -> BoardInfo:
        """Read by length: fields after the end of the payload stay at their defaults."""
        data = _Payload(Command.BOARD_INFO, payload)
        identifier = data.take(4).decode("ascii", "replace")
        values: dict[str, int | str | bytes] = {"hardware_revision": data.unpack("H")[0]}
        fields: Sequence[tuple[str, str]] = (
            ("type", "B"),
            ("capabilities", "B"),
            ("target", "text"),
            ("board", "text"),
            ("manufacturer", "text"),
            ("signature", "signature"),
            ("mcu", "B"),
            ("config_state", "B"),
            ("gyro_rate_hz", "H"),
            ("problems", "I"),
            ("spi_devices", "B"),
            ("i2c_devices", "B"),
        )
        for name, form in fields:
            if not data.left:
                break
            if form == "text":
                values[name] = data.text()
            elif form == "signature":
                values[name] = data.take(32)
            else:
                values[name] = data.unpack(form)[0]
        return cls(identifier, **values)  # type: ignore[arg-type]  # names and kinds stand in the table above

    def encode(self) -> bytes:
        """Payload of the reply, up to the first field that is None."""
        out = self.identifier.encode("ascii", "replace")[:4].ljust(4)
        out += struct.pack("<HBB", self.hardware_revision, self.type, self.capabilities)
        out += _text(self.target) + _text(self.board) + _text(self.manufacturer) + self.signature
        tail = (
            (self.mcu, "B"),
            (self.config_state, "B"),
            (self.gyro_rate_hz, "H"),
            (self.problems, "I"),
            (self.spi_devices, "B"),
            (self.i2c_devices, "B"),
        )
        for value, form in tail:
            if value is None:
                break
            out += struct.pack("<" + form, value)
        return out


@dataclass(frozen=True)
class FcVersion:
    """FC_VERSION: three numbers (from 2025 on the first is year − 2000) and, from then on, the name as a string."""

    major: int
    minor: int
    patch: int
    name: str = ""

    @classmethod
    def decode(cls, payload: bytes) -> FcVersion:
        """Payload of three bytes, or three and a string with its length in front."""
        data = _Payload(Command.FC_VERSION, payload)
        major, minor, patch = data.unpack("BBB")
        return cls(major, minor, patch, data.text() if data.left else "")

    def encode(self) -> bytes:
        """Payload of the reply."""
        return bytes([self.major, self.minor, self.patch]) + (_text(self.name) if self.name else b"")

    def __str__(self) -> str:
        return self.name or f"{self.major}.{self.minor}.{self.patch}"


@dataclass(frozen=True)
class BoardAlignment:
    """BOARD_ALIGNMENT, whole degrees; writing it takes effect after EEPROM_WRITE and a reboot."""

    roll: int
    pitch: int
    yaw: int

    @classmethod
    def decode(cls, payload: bytes) -> BoardAlignment:
        """Payload of 3 × i16."""
        return cls(*_exactly(Command.BOARD_ALIGNMENT, "3h", payload))

    def encode(self) -> bytes:
        """Payload of the reply, and of the request that sets it."""
        return struct.pack("<3h", self.roll, self.pitch, self.yaw)


@dataclass(frozen=True)
class FlightStatus:
    """The part of STATUS and STATUS_EX that every firmware sends."""

    cycle_us: int
    i2c_errors: int
    sensors: int
    flags: int
    profile: int
    load_percent: int
    rest: bytes = b""

    @property
    def has_accelerometer(self) -> bool:
        """Bit 0 of the sensors."""
        return bool(self.sensors & 1)

    @property
    def has_magnetometer(self) -> bool:
        """Bit 2 of the sensors."""
        return bool(self.sensors & 4)

    @property
    def has_gyro(self) -> bool:
        """Bit 5 of the sensors."""
        return bool(self.sensors & 32)

    @classmethod
    def decode(cls, payload: bytes) -> FlightStatus:
        """Payload of at least 13 bytes; what follows them is kept in `rest`."""
        data = _Payload(Command.STATUS_EX, payload)
        cycle, errors, sensors, flags, profile, load = data.unpack("HHHIBH")
        return cls(cycle, errors, sensors, flags, profile, load, data.take(data.left))

    def encode(self) -> bytes:
        """Payload of the reply."""
        head = (self.cycle_us, self.i2c_errors, self.sensors, self.flags, self.profile, self.load_percent)
        return struct.pack("<HHHIBH", *head) + self.rest


@dataclass(frozen=True)
class RawImu:
    """RAW_IMU: sensor units, with the board's alignment, gyro filter and calibration applied; mag is 0 if absent."""

    acc: tuple[int, int, int]
    gyro: tuple[int, int, int]
    mag: tuple[int, int, int] = (0, 0, 0)

    @classmethod
    def decode(cls, payload: bytes) -> RawImu:
        """Payload of 9 × i16, exactly."""
        v = _exactly(Command.RAW_IMU, "9h", payload)
        return cls((v[0], v[1], v[2]), (v[3], v[4], v[5]), (v[6], v[7], v[8]))

    def encode(self) -> bytes:
        """Payload of the reply."""
        return struct.pack("<9h", *self.acc, *self.gyro, *self.mag)


@dataclass(frozen=True)
class Attitude:
    """ATTITUDE: roll and pitch in 0.1°, yaw in whole degrees 0 … 359, clockwise."""

    roll: int
    pitch: int
    yaw: int

    @classmethod
    def decode(cls, payload: bytes) -> Attitude:
        """Payload of 3 × i16, exactly."""
        return cls(*_exactly(Command.ATTITUDE, "3h", payload))

    def encode(self) -> bytes:
        """Payload of the reply."""
        return struct.pack("<3h", self.roll, self.pitch, self.yaw)


@dataclass(frozen=True)
class AttitudeQuaternion:
    """ATTITUDE_QUATERNION (API 1.48 and later): w x y z as fractions of one, earth (x north, z up) from body."""

    w: float
    x: float
    y: float
    z: float

    @classmethod
    def decode(cls, payload: bytes) -> AttitudeQuaternion:
        """Payload of 4 × i16, exactly."""
        raw = _exactly(Command.ATTITUDE_QUATERNION, "4h", payload)
        return cls(*(v / QUATERNION_LSB for v in raw))

    def encode(self) -> bytes:
        """Payload of the reply."""
        return struct.pack("<4h", *(round(v * QUATERNION_LSB) for v in (self.w, self.x, self.y, self.z)))


@dataclass(frozen=True)
class Analog:
    """ANALOG, in volts, ampere hours and amperes."""

    battery_v: float
    used_ah: float
    rssi: int
    current_a: float

    @classmethod
    def decode(cls, payload: bytes) -> Analog:
        """Payload of 7 bytes, or 9 with the finer voltage at its end."""
        data = _Payload(Command.ANALOG, payload)
        coarse, used, rssi, current = data.unpack("BHHh")
        volts = data.unpack("H")[0] / 100.0 if data.left >= 2 else coarse / 10.0
        return cls(volts, used / 1000.0, rssi, current / 100.0)

    def encode(self) -> bytes:
        """Payload of the reply."""
        coarse = min(255, round(self.battery_v * 10))
        numbers = (coarse, round(self.used_ah * 1000), self.rssi, round(self.current_a * 100))
        return struct.pack("<BHHhH", *numbers, round(self.battery_v * 100))


@dataclass(frozen=True)
class Altitude:
    """ALTITUDE, in metres and metres per second, by the barometer where there is one."""

    height_m: float
    climb_m_s: float

    @classmethod
    def decode(cls, payload: bytes) -> Altitude:
        """Payload of i32 cm and i16 cm/s."""
        height, climb = _Payload(Command.ALTITUDE, payload).unpack("ih")
        return cls(height / 100.0, climb / 100.0)

    def encode(self) -> bytes:
        """Payload of the reply."""
        return struct.pack("<ih", round(self.height_m * 100), round(self.climb_m_s * 100))


@dataclass(frozen=True)
class Uid:
    """UID: the microcontroller's serial number, 24 hex digits; it tells one board from another of its kind."""

    words: tuple[int, int, int] = field(default=(0, 0, 0))

    @classmethod
    def decode(cls, payload: bytes) -> Uid:
        """Payload of 3 × u32."""
        a, b, c = _exactly(Command.UID, "3I", payload)
        return cls((a, b, c))

    def encode(self) -> bytes:
        """Payload of the reply."""
        return struct.pack("<3I", *self.words)

    def __str__(self) -> str:
        return "".join(f"{word:08x}" for word in self.words)


def decode_multiple(commands: Sequence[int], payload: bytes) -> list[bytes]:
    """Payloads of the replies that a MULTIPLE_MSP reply carries, in the order of the requested `commands`.

    Raises:
        MspError: where the inner lengths do not add up to the payload exactly.
    """
    data = _Payload(Command.MULTIPLE_MSP, payload)
    parts = [data.take(data.take(1)[0]) for _ in commands]
    if data.left:
        raise MspError(f"the reply to {command_name(Command.MULTIPLE_MSP)} has {data.left} bytes too many")
    return parts


def encode_multiple(parts: Iterable[bytes]) -> bytes:
    """Payload of a MULTIPLE_MSP reply: each part behind its length."""
    return b"".join(bytes([len(part)]) + part for part in parts)


def acc_scales(api: ApiVersion) -> tuple[int, ...]:
    """Accelerometer scales (LSB per g) that firmware of this API may send, most common first (facts/imu.md D2)."""
    return (ACC_LSB_PER_G_OLD,) if (api.major, api.minor) <= (1, 45) else ACC_LSB_PER_G_NEW
