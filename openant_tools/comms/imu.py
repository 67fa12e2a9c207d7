"""The IMU: a Betaflight flight controller polled over MSP, in SI units and body axes (x forward, y left, z up).

How a poll goes. The flight controller's serial task runs 100 times a second unless told otherwise
(`serial_update_rate_hz`) and handles one request a run. So accelerometer, gyro and attitude are fetched together by
MULTIPLE_MSP where the firmware has it, and in turn where it has not. A reply is made when the request is handled and
leaves at once: its values are as old as the way back, however long the request had to wait. `connect` therefore
measures the bare way there and back (the shortest of a few polls at different phases of the task) and stamps samples
`reply time − shortest round trip / 2`; a request's midpoint would be early by half its wait, up to 5 ms.

Scales. Most gyros have 2000/32768 °/s per LSB, some (ST's) 0.070 °/s, and no message tells which: nothing at rest shows
it, so `openant calib imu` measures it by a turn and `openant calib arena` against the tag, and who opens the driver passes
on what was measured. The accelerometer's scale belongs to the firmware (API ≤ 1.45: 512 LSB/g; later: the sensor's own,
1024, 2048 or 4096), so it is taken from the API version and held against gravity: where the two disagree, gravity decides
and the notes say so. Where it was measured, that is used, as long as gravity does not say that it is another by now.

Nothing here waits longer than it is told: `service` never waits, `read` waits until its deadline. A reply that lay
unread between two calls of `service` came at an unknown time between them: whoever wants sharp stamps reads, or serves
often.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from openant_tools.comms import msp
from openant_tools.comms.clock import Clock, portions
from openant_tools.comms.line import Line, PortGone, SerialLine
from openant_tools.comms.msp import Command, Direction, Framing, MspParser
from openant_tools.errors import HardwareFault
from openant_tools.numbers import number

__all__ = ["Imu", "ImuInfo", "ImuSample", "ImuStatistics", "open_imu"]

#: m/s², by definition
STANDARD_GRAVITY = 9.80665
#: The USB port of a flight controller ignores it; boards behind a real UART are set to this.
IMU_BAUD = 115_200
#: s that an answer may take, and how often, and for how long, a board that may still be starting is asked first
REPLY_TIMEOUT_S = 0.05
HANDSHAKE_TRIES = 3
HANDSHAKE_TIMEOUT_S = 0.3
#: Half a second of silence: the port is closed and opened again, which frees a stuck USB endpoint.
TIMEOUTS_BEFORE_REOPEN = 10
#: s between two tries to open a port that is gone
REOPEN_EVERY_S = 0.5
#: Sensor noise changes the last bits of every reading; this long without any change is a sensor that hangs.
FROZEN_S = 0.5
#: s over which the rate of samples is counted
RATE_WINDOW_S = 2.0

#: samples by which rest is judged, and how often it is tried
REST_SAMPLES = 40
REST_TRIES = 3
#: At rest: the accelerometer's norm scatters less than this share of itself, the gyro less than this.
REST_ACC_SCATTER = 0.03
REST_GYRO_RAD_S = 0.15
#: Neighbouring scales are a factor 2 apart; an uncalibrated accelerometer is off by a few per cent.
SCALE_TOLERANCE = 0.2

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class ImuSample:
    """One reading.

    Attributes:
        t: when it was measured, s, on the driver's clock.
        acc: specific force in m/s² (+9.81 on z at rest).
        gyro: angular rate in rad/s.
        roll, pitch, yaw: the flight controller's own attitude in rad, rotations about z, then y, then x (pitch is
            positive nose down, yaw counter-clockwise from where the board was powered on). None before the first.
        yaw_step: resolution of `yaw` in rad: one degree in ATTITUDE, 0 from a quaternion.
        attitude_t: when the attitude was measured; in alternate polling it is older than `t`.
        mag: raw magnetometer, or None on boards without one.
        round_trip: from the request to the reply, s.
        t_error: half the time for which nobody looked whether the reply was there, s; 0 from `read`.
    """

    t: float
    acc: Vector
    gyro: Vector
    roll: float | None
    pitch: float | None
    yaw: float | None
    yaw_step: float
    attitude_t: float | None
    mag: tuple[int, int, int] | None
    round_trip: float
    t_error: float


@dataclass(frozen=True)
class ImuInfo:
    """What answered, how it is polled, and what was measured while connecting.

    Attributes:
        polling: "multiple" (one request for all) or "alternate".
        acc_lsb_per_g, gyro_lsb_per_dps: the scales in use. gravity: |acc| at rest with it, m/s², or None where the robot moved.
        rate_hz: samples a second when polled back to back. round_trip_s: the shortest one.
        gyro_bias: mean rate at rest in rad/s, or None where the robot moved; samples are not corrected by it.
        notes: what a builder should know, in whole sentences.
    """

    api: msp.ApiVersion
    variant: str
    firmware: str
    board: msp.BoardInfo
    uid: str
    polling: str
    has_magnetometer: bool
    acc_lsb_per_g: float
    gyro_lsb_per_dps: float
    gravity: float | None
    gyro_bias: Vector | None
    rate_hz: float
    round_trip_s: float
    notes: tuple[str, ...]


@dataclass
class ImuStatistics:
    """Counts since `connect`; `rate_hz` is over the last two seconds."""

    requests: int = 0
    samples: int = 0
    timeouts: int = 0
    error_replies: int = 0
    undecodable: int = 0
    broken_frames: int = 0
    repeats: int = 0
    reconnects: int = 0
    recent: deque[float] = field(default_factory=deque, repr=False)

    @property
    def rate_hz(self) -> float:
        """Samples a second over the last two seconds."""
        return (len(self.recent) - 1) / (self.recent[-1] - self.recent[0]) if len(self.recent) > 2 else 0.0

    def count(self, t: float) -> None:
        """One more sample at `t`."""
        self.samples += 1
        self.recent.append(t)
        while self.recent[0] < t - RATE_WINDOW_S:
            self.recent.popleft()


def open_imu(path: str, clock: Clock, *, gyro_counts_per_dps: float = 0.0, acc_counts_per_g: float = 0.0) -> Imu:
    """Connect to the flight controller at `path`; scales as `Imu` takes them.

    Raises:
        HardwareFault: no such port, silence, another kind of device, or the controller's command line is open.
    """
    imu = Imu(
        lambda: SerialLine(path, IMU_BAUD), clock, where=path,
        gyro_counts_per_dps=gyro_counts_per_dps, acc_counts_per_g=acc_counts_per_g,
    )  # fmt: skip
    imu.connect()
    return imu


class Imu:
    """The driver. `connect` first; then `service` as often as you like, or `read`.

    Args:
        open_line: opens the port; called again after an unplug.
        clock: the time that samples are stamped with.
        where: what the port is called in messages.
        gyro_counts_per_dps, acc_counts_per_g: raw counts for 1 °/s and for 1 g, as they were measured; 0 where they were
            not: then the gyro has the step that most have, and gravity tells the accelerometer's among the known ones.
    """

    def __init__(
        self, open_line: Callable[[], Line], clock: Clock, *, where: str, gyro_counts_per_dps: float = 0.0,
        acc_counts_per_g: float = 0.0,
    ) -> None:  # fmt: skip
        self.where = where
        self._gyro_lsb_per_dps = gyro_counts_per_dps or msp.RAD_PER_DEG / msp.GYRO_RAD_S_PER_LSB
        self._acc_measured = acc_counts_per_g
        self.statistics = ImuStatistics()
        self._open_line = open_line
        self._clock = clock
        self._line: Line | None = None
        self._parser = MspParser()
        self._seen = bytearray()
        self._info: ImuInfo | None = None
        self._rotation: tuple[_Poll, ...] = ()
        self._outstanding: _Poll | None = None
        self._turn = 0
        self._sent_at = 0.0
        self._silent = 0
        self._gone = False  # the port itself failed; we also close it ourselves, to open a silent board again
        self._reopen_at = 0.0
        self._attitude: _Attitude | None = None
        self._raw: msp.RawImu | None = None
        self._changed_at = 0.0
        self._same = 0
        self._empty_at = 0.0
        self._arrived = 0.0
        self._arrived_error = 0.0
        self._last: ImuSample | None = None
        self._stranger: str | None = None
        self._proved = False

    @property
    def info(self) -> ImuInfo:
        """What `connect` found."""
        if self._info is None:
            raise HardwareFault("the flight controller is not connected", where=self.where)
        return self._info

    @property
    def last(self) -> ImuSample | None:
        """The newest sample, however old; its age is the caller's to judge."""
        return self._last

    def fault(self) -> HardwareFault | None:
        """What is wrong at this moment, or None: unplugged, another board in its place, silent, or frozen."""
        now = self._clock.now()
        if self._stranger:
            return HardwareFault(
                f"another flight controller ({self._stranger}) answers where {self.info.uid} did",
                where=self.where,
                remedy="connect again so that its scale is measured",
            )
        if self._line is None and self._gone:
            return HardwareFault("the flight controller is unplugged", where=self.where, remedy="look at its USB cable")
        since = self._last.t if self._last else self._sent_at
        if self._silent and now - since > 4 * REPLY_TIMEOUT_S:
            return self._silence(f"for {number(now - since, 's', decimals=1)}")
        if self._raw is not None and now - self._changed_at > FROZEN_S and self._same > 10:
            return HardwareFault(
                f"the IMU has sent the same reading for {number(now - self._changed_at, 's', decimals=1)}",
                where=self.where,
                remedy="its sensor hangs: power the flight controller off and on",
            )
        return None

    def close(self) -> None:
        """Let go of the port."""
        if self._line is not None:
            self._line.close()
            self._line = None

    # --- connecting ----------------------------------------------------------------------------------------------

    def connect(self) -> ImuInfo:
        """Open the port, prove what answers, find how to poll it and measure scale, rate and round trip (about 1 s).

        Raises:
            HardwareFault: see `open_imu`.
        """
        self.close()
        self._line = self._open_line()
        self._forget()
        self._stranger = None
        self._info = None
        self.statistics = ImuStatistics()
        try:
            self._info = self._handshake()
        except HardwareFault:
            self.close()
            raise
        return self._info

    def _handshake(self) -> ImuInfo:
        api = msp.ApiVersion.decode(self._ask(Command.API_VERSION, proof=True))
        variant = self._ask(Command.FC_VARIANT).decode("ascii", "replace")
        if variant != "BTFL":
            raise HardwareFault(
                f"the flight controller runs {variant!r}, whose sensor scales are not known",
                where=self.where,
                remedy="flash Betaflight 4.3 or newer (variant BTFL)",
            )
        firmware = str(msp.FcVersion.decode(self._ask(Command.FC_VERSION)))
        board = msp.BoardInfo.decode(self._ask(Command.BOARD_INFO))
        uid = str(msp.Uid.decode(self._ask(Command.UID)))
        status = msp.FlightStatus.decode(self._ask(Command.STATUS))
        if not status.has_accelerometer or not status.has_gyro:
            missing = "accelerometer" if status.has_gyro else "gyro"
            raise HardwareFault(
                f"the flight controller reports no {missing}",
                where=self.where,
                remedy="its sensor is switched off (acc_hardware = NONE) or broken",
            )
        notes: list[str] = []
        if board.accelerometer_uncalibrated:
            notes.append(
                "Betaflight says that the accelerometer was never calibrated; the calibration step settles it."
            )
        self._choose_polling(api, notes)
        multiple = len(self._rotation) == 1
        rate, samples = self._rate()
        for _ in range(REST_TRIES - 1):
            if _at_rest(samples):
                break
            rate, samples = self._rate()
        shortest = self._shortest_round_trip()
        scale, gravity, bias = self._scale(api, samples, notes)
        if rate < 0.9 * (100 if multiple else 50):
            notes.append(
                f"Only {number(rate, decimals=0)} samples/s arrive; `set serial_update_rate_hz = 1000` in Betaflight's command line "
                "lifts its own limit."
            )
        return ImuInfo(
            api=api,
            variant=variant,
            firmware=firmware,
            board=board,
            uid=uid,
            polling="multiple" if multiple else "alternate",
            has_magnetometer=status.has_magnetometer,
            acc_lsb_per_g=scale,
            gyro_lsb_per_dps=self._gyro_lsb_per_dps,
            gravity=gravity,
            gyro_bias=bias,
            rate_hz=rate,
            round_trip_s=shortest,
            notes=tuple(notes),
        )

    def _choose_polling(self, api: msp.ApiVersion, notes: list[str]) -> None:
        """One request for everything where the firmware can, else raw readings and attitude in turn."""
        attitude = Command.ATTITUDE
        if (api.major, api.minor) >= (1, 48) and self._has(Command.ATTITUDE_QUATERNION):
            attitude = Command.ATTITUDE_QUATERNION
        both = _Poll.of(Command.RAW_IMU, attitude)
        try:
            both.split(self._ask(Command.MULTIPLE_MSP, both.payload))
        except (_Refused, msp.MspError):
            notes.append("This firmware does not bundle messages (MULTIPLE_MSP), so the rate is halved.")
            self._rotation = (_Poll.of(Command.RAW_IMU), _Poll.of(attitude))
        else:
            self._rotation = (both,)
        self._turn = 0

    def _has(self, command: Command) -> bool:
        try:
            self._ask(command)
        except _Refused:
            return False
        return True

    def _ask(self, command: Command, payload: bytes = b"", *, proof: bool = False) -> bytes:
        """One request of the handshake; tried again, since a controller that still boots drops requests."""
        for _ in range(HANDSHAKE_TRIES):
            sent = self._send(msp.request(command, payload))
            for frame in self._frames(sent + HANDSHAKE_TIMEOUT_S):
                if frame.command != command or frame.direction is Direction.REQUEST:
                    continue
                if frame.direction is Direction.ERROR:
                    raise _Refused(
                        f"the flight controller does not answer {msp.command_name(command)}", where=self.where
                    )
                return frame.payload
        raise self._no_answer(first=proof)

    def _frames(self, deadline: float) -> Iterator[msp.MspFrame]:
        """Frames as they come until the deadline."""
        line = self._port()
        for data in portions(self._clock, line, deadline):
            self._empty_at = self._clock.now()
            self._heard(line)
            self._seen += data
            del self._seen[:-512]
            yield from self._parser.feed(data)

    def _no_answer(self, first: bool) -> HardwareFault:
        """Why nothing sensible came back, as far as what did come back tells."""
        seen = bytes(self._seen)
        if not seen:
            return self._silence("to an MSP request")
        if b"\xff\xff\xfd\x00" in seen:
            return HardwareFault(
                "a Dynamixel servo answers here, no flight controller",
                where=self.where,
                remedy="the ports of bus and IMU are swapped in robot.toml",
            )
        # In its command line the controller repeats what is typed, so the request itself comes back.
        if b"$M<" in seen or b"CLI" in seen or b"\r\n# " in seen:
            return HardwareFault(
                "the flight controller is in its command line (CLI), where it answers no MSP",
                where=self.where,
                remedy="type `exit` there, or unplug it and plug it in again",
            )
        if first:
            return HardwareFault(
                f"what answers here is no flight controller (it sent {seen[:8].hex(' ')} …)",
                where=self.where,
                remedy="name the flight controller's port",
            )
        return self._silence("in mid-handshake")

    def _silence(self, how: str) -> HardwareFault:
        return HardwareFault(
            f"the flight controller is silent ({how})",
            where=self.where,
            remedy="close Betaflight Configurator, then unplug it and plug it in again",
        )

    # --- measuring while connecting --------------------------------------------------------------------------------

    def _rate(self) -> tuple[float, list[msp.RawImu]]:
        """Samples a second when polled back to back, and what they said."""
        raws: list[msp.RawImu] = []
        times: list[float] = []
        patience = self._clock.now() + 20 * REPLY_TIMEOUT_S + REST_SAMPLES * REPLY_TIMEOUT_S
        while len(raws) < REST_SAMPLES:
            reply = self._exchange()
            if reply is None:
                if self._clock.now() > patience:
                    raise self._silence("when polled for readings")
            elif reply.raw is not None:
                raws.append(reply.raw)
                times.append(reply.received)
        return (len(times) - 1) / max(times[-1] - times[0], 1e-9), raws

    def _shortest_round_trip(self) -> float:
        """The way there and back without the wait: polls at phases spread over the serial task's period."""
        shortest = math.inf
        for k in range(24):
            # Multiples of the golden ratio fall evenly into any period, also one that is not 10 ms.
            self._clock.sleep_until(self._clock.now() + 0.01 * (k * 0.6180339887 % 1.0))
            reply = self._exchange()
            if reply is not None:
                shortest = min(shortest, reply.received - reply.sent)
        return shortest if math.isfinite(shortest) else 0.0

    def _exchange(self) -> _Reply | None:
        """Send the next request of the rotation and wait for its reply; None where none came in time."""
        poll = self._next()
        sent = self._send(poll.request)
        for frame in self._frames(sent + REPLY_TIMEOUT_S):
            reply = self._take(poll, frame, sent)
            if reply is not None:
                return reply
        self._parser.reset()
        return None

    def _scale(
        self, api: msp.ApiVersion, samples: Sequence[msp.RawImu], notes: list[str]
    ) -> tuple[float, float | None, Vector | None]:
        """Accelerometer scale, |acc| with it and the gyro's mean; the latter two are None where the robot moved."""
        mean = math.fsum(math.hypot(*raw.acc) for raw in samples) / len(samples)
        to_rad = msp.RAD_PER_DEG / self._gyro_lsb_per_dps
        rates = [tuple(v * to_rad for v in raw.gyro) for raw in samples]
        bias = (_mean(rates, 0), _mean(rates, 1), _mean(rates, 2))
        measured = self._acc_measured
        expected = msp.acc_scales(api)
        if mean == 0.0:
            raise HardwareFault(
                "the accelerometer reads zero on all axes", where=self.where, remedy="it is switched off or broken"
            )
        if not _at_rest(samples):
            inherited = measured or float(expected[0])
            notes.append(
                f"The robot moved while connecting, so the accelerometer scale ({number(inherited, 'LSB/g', decimals=0)} "
                f"{'as measured' if measured else f'by API {api}'}) is not checked against gravity."
            )
            return inherited, None, None
        if measured and abs(math.log(mean / measured)) <= math.log1p(SCALE_TOLERANCE):
            return measured, mean / measured * STANDARD_GRAVITY, bias
        known = sorted({msp.ACC_LSB_PER_G_OLD, *msp.ACC_LSB_PER_G_NEW})
        scale: float = min(known, key=lambda lsb: abs(math.log(mean / lsb)))
        if abs(math.log(mean / scale)) > math.log1p(SCALE_TOLERANCE):
            raise HardwareFault(
                f"the accelerometer reads {number(mean, 'LSB', decimals=0)} at rest, which is 1 g in no known scale "
                f"({', '.join(map(str, known))} LSB/g)",
                where=self.where,
                remedy="calibrate the accelerometer in Betaflight, board level and still, then connect again",
            )
        if measured:
            notes.append(
                f"Gravity says {number(scale, 'LSB/g', decimals=0)} where {number(measured, decimals=0)} had been measured (other firmware, another board?); "
                "gravity decides: run `openant calib imu` again."
            )
        elif scale not in expected:
            notes.append(
                f"Gravity says {number(scale, 'LSB/g', decimals=0)} where API {api} promises {' or '.join(map(str, expected))}; "
                "gravity decides."
            )
        return scale, mean / scale * STANDARD_GRAVITY, bias

    # --- polling ---------------------------------------------------------------------------------------------------

    def service(self) -> ImuSample | None:
        """Read what has arrived, send what is due, and return at once: the newest sample that came in, or None.

        Timeouts are counted, the port is closed and opened again after half a second of silence, and an unplugged
        controller is taken back when its port returns (its serial number proves that it is the same). What is wrong
        meanwhile, `fault` tells.
        """
        info = self.info
        now = self._clock.now()
        if self._line is None:
            self._try_reopen(now)
            return None
        line, newest = self._line, None
        try:
            for data in portions(self._clock, line, now):
                self._heard(line)
                broken = self._parser.broken
                frames = self._parser.feed(data)
                if (frames and not self._parser.clean) or self._parser.broken > broken:
                    self.statistics.broken_frames += 1
                    self._give_up()
                    continue
                for frame in frames:
                    newest = self._receive(frame, info) or newest
                if self._line is not line:
                    break
            self._empty_at = now
            if self._outstanding is not None and self._clock.now() - self._sent_at > REPLY_TIMEOUT_S:
                self._time_out()
            if self._outstanding is None and self._line is line:
                self._outstanding = self._next() if self._proved else _PROOF
                self._send(self._outstanding.request)
        except PortGone:
            self._gone = True
            self._lose(self._clock.now())
        return newest

    def read(self, deadline: float) -> ImuSample:
        """The next sample.

        Raises:
            HardwareFault: none came by the deadline; the message says why.
        """
        while True:
            sample = self.service()
            if sample is not None:
                return sample
            now = self._clock.now()
            if now >= deadline:
                raise self.fault() or self._silence("by the deadline")
            if self._line is None:
                self._clock.sleep_until(min(deadline, self._reopen_at))
            elif self._clock.wait_readable(self._line, min(deadline, self._sent_at + REPLY_TIMEOUT_S + 1e-4)):
                self._empty_at = self._clock.now()  # the bytes came this instant

    def _receive(self, frame: msp.MspFrame, info: ImuInfo) -> ImuSample | None:
        poll = self._outstanding
        if poll is None:
            return None  # a reply that was given up for lost
        if frame.command == poll.command and frame.direction is Direction.ERROR:
            self.statistics.error_replies += 1
            self._outstanding = None
            return None
        if poll is _PROOF:
            self._prove(frame, info)
            return None
        reply = self._take(poll, frame, self._sent_at)
        if reply is None:
            return None
        self._outstanding = None
        self._silent = 0
        if reply.raw is None:
            return None
        return self._sample(reply, info)

    def _sample(self, reply: _Reply, info: ImuInfo) -> ImuSample:
        raw = reply.raw
        assert raw is not None
        t = reply.received - info.round_trip_s / 2.0
        if raw == self._raw:
            self.statistics.repeats += 1
            self._same += 1
        else:
            self._raw, self._changed_at, self._same = raw, t, 0
        to_si, to_rad = STANDARD_GRAVITY / info.acc_lsb_per_g, msp.RAD_PER_DEG / info.gyro_lsb_per_dps
        attitude = self._attitude
        sample = ImuSample(
            t=t,
            acc=(raw.acc[0] * to_si, raw.acc[1] * to_si, raw.acc[2] * to_si),
            gyro=(raw.gyro[0] * to_rad, raw.gyro[1] * to_rad, raw.gyro[2] * to_rad),
            roll=attitude.roll if attitude else None,
            pitch=attitude.pitch if attitude else None,
            yaw=attitude.yaw if attitude else None,
            yaw_step=attitude.yaw_step if attitude else msp.RAD_PER_DEG,
            attitude_t=attitude.received - info.round_trip_s / 2.0 if attitude else None,
            mag=raw.mag if info.has_magnetometer else None,
            round_trip=reply.received - reply.sent,
            t_error=reply.received_error,
        )
        self._last = sample
        self.statistics.count(t)
        return sample

    def _take(self, poll: _Poll, frame: msp.MspFrame, sent: float) -> _Reply | None:
        """The reply to `poll` in this frame; None where it is another frame or cannot be decoded."""
        if frame.command != poll.command or frame.direction is not Direction.REPLY or not self._parser.clean:
            return None
        raw: msp.RawImu | None = None
        received, error = self._arrived, self._arrived_error
        try:
            for command, payload in zip(poll.wanted, poll.split(frame.payload), strict=True):
                if command == Command.RAW_IMU:
                    raw = msp.RawImu.decode(payload)
                else:
                    self._attitude = _Attitude.decode(command, payload, received)
        except msp.MspError:
            self.statistics.undecodable += 1
            return None
        return _Reply(sent, received, error, raw)

    def _heard(self, line: Line) -> None:
        """When did the bytes just read arrive? A stepped clock knows; else between the last look at the line and now."""
        now = self._clock.arrivals(line)[-1][1]
        if self._clock.stepped:
            self._arrived, self._arrived_error = now, 0.0
        else:
            earliest = min(now, max(self._empty_at, self._sent_at))
            self._arrived, self._arrived_error = (now + earliest) / 2.0, (now - earliest) / 2.0

    def _prove(self, frame: msp.MspFrame, info: ImuInfo) -> None:
        """After a reopening: is it the same board?"""
        if frame.command != Command.UID or frame.direction is not Direction.REPLY:
            return
        self._outstanding = None
        try:
            uid = str(msp.Uid.decode(frame.payload))
        except msp.MspError:
            return
        self._stranger = None if uid == info.uid else uid
        if self._stranger is None:
            self._proved = True
            self.statistics.reconnects += 1
        else:
            self._lose(self._clock.now())

    def _time_out(self) -> None:
        self.statistics.timeouts += 1
        self._silent += 1
        self._give_up()
        if self._silent >= TIMEOUTS_BEFORE_REOPEN:
            self._lose(self._clock.now())
            self._silent = 1  # still silent, whatever the port says

    def _give_up(self) -> None:
        """The reply under way is lost; its remains must not be taken for the next one."""
        self._outstanding = None
        self._parser.reset()

    def _lose(self, now: float) -> None:
        self.close()
        self._reopen_at = now + REOPEN_EVERY_S

    def _try_reopen(self, now: float) -> None:
        if now < self._reopen_at:
            return
        self._reopen_at = now + REOPEN_EVERY_S
        try:
            self._line = self._open_line()
        except HardwareFault:
            self._gone = True
            return  # not there yet
        self._gone = False
        silent = self._silent
        self._forget()
        self._silent = silent

    def _forget(self) -> None:
        """A new connection: nothing is under way and nothing is proved."""
        self._parser = MspParser()
        self._seen.clear()
        self._outstanding = None
        self._proved = self._info is None
        self._silent = 0
        self._turn = 0

    def _next(self) -> _Poll:
        poll = self._rotation[self._turn % len(self._rotation)]
        self._turn += 1
        return poll

    def _send(self, data: bytes) -> float:
        """One frame in one write, never a part of one: Betaflight takes a lone `#` or `R` for a command."""
        line = self._port()
        self._parser.reset()
        self._sent_at = self._clock.now()
        line.write(data)
        self.statistics.requests += 1
        return self._sent_at

    def _port(self) -> Line:
        if self._line is None:
            raise PortGone(self.where)
        return self._line


class _Refused(HardwareFault):
    """An error reply: the firmware does not know the message."""


@dataclass(frozen=True)
class _Poll:
    """A request that is sent again and again: one message, or several in one."""

    command: int
    wanted: tuple[int, ...]
    payload: bytes
    request: bytes

    @classmethod
    def of(cls, *wanted: int) -> _Poll:
        command, payload = (wanted[0], b"") if len(wanted) == 1 else (Command.MULTIPLE_MSP, bytes(wanted))
        # The CRC of v2 sees every burst of up to 8 bits, which v1's XOR does not.
        return cls(command, wanted, payload, msp.request(command, payload, Framing.V2))

    def split(self, payload: bytes) -> list[bytes]:
        return msp.decode_multiple(self.wanted, payload) if len(self.wanted) > 1 else [payload]


_PROOF = _Poll.of(Command.UID)


@dataclass(frozen=True)
class _Reply:
    sent: float
    received: float
    received_error: float
    raw: msp.RawImu | None


@dataclass(frozen=True)
class _Attitude:
    roll: float
    pitch: float
    yaw: float
    yaw_step: float
    received: float

    @classmethod
    def decode(cls, command: int, payload: bytes, received: float) -> _Attitude:
        if command == Command.ATTITUDE:
            a = msp.Attitude.decode(payload)
            yaw = math.remainder(-a.yaw * msp.RAD_PER_DEG, 2 * math.pi)  # Betaflight counts headings clockwise
            return cls(a.roll * msp.RAD_PER_DEG / 10, a.pitch * msp.RAD_PER_DEG / 10, yaw, msp.RAD_PER_DEG, received)
        q = msp.AttitudeQuaternion.decode(payload)
        roll = math.atan2(2 * (q.w * q.x + q.y * q.z), 1 - 2 * (q.x * q.x + q.y * q.y))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (q.w * q.y - q.x * q.z))))
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
        return cls(roll, pitch, yaw, 0.0, received)


def _at_rest(samples: Sequence[msp.RawImu]) -> bool:
    norms = [math.hypot(*raw.acc) for raw in samples]
    mean = math.fsum(norms) / len(norms)
    scatter = math.sqrt(math.fsum((norm - mean) ** 2 for norm in norms) / len(norms))
    fastest = max(abs(v) for raw in samples for v in raw.gyro) * msp.GYRO_RAD_S_PER_LSB
    return fastest < REST_GYRO_RAD_S and scatter < REST_ACC_SCATTER * mean


def _mean(rates: Sequence[tuple[float, ...]], axis: int) -> float:
    return math.fsum(rate[axis] for rate in rates) / len(rates)
