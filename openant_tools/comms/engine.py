"""The process that owns the hardware: bus and recorder in one fixed-rate loop, torque off however it ends.

Run as `python -m openant_tools.comms.engine`, by `engine_process.EngineProcess`, with a socket pair to its parent: it
takes `messages`, answers each, and tells events. When the parent dies the socket ends, and torque goes off; a suspended
parent (Ctrl-Z) ends motion, too. Should this process be killed or suspended, its guardian sends the same packet; should
both die, each servo's Bus Watchdog stops its motion. This is the only way to torque: a bus without all that refuses it.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms import guardian, messages
from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bench import bus_limit_hz
from openant_tools.comms.body_imu import BodyImu
from openant_tools.comms.bus import Answer, Bus, Timing
from openant_tools.comms.checked import checked
from openant_tools.comms.clock import Clock, RealClock, SteppedClock, VirtualControl
from openant_tools.comms.faults import BrokenAnswer, Cause, NeverSilent, NoAnswer
from openant_tools.comms.following import Behind, Following
from openant_tools.comms.guards import Trip, Watch
from openant_tools.comms.lateness import REMEDY
from openant_tools.comms.line import PortGone, SerialLine
from openant_tools.comms.messages import WATCHDOG_UNIT_S, EngineConfig
from openant_tools.comms.motion import Motion, catch, held, hold, play, ramp
from openant_tools.comms.ports import WANTED_LATENCY_MS, Host, udev_rule
from openant_tools.comms.restart import StopCause
from openant_tools.comms.ring import ERR_CODES, Ring
from openant_tools.comms.servos import BLOCK_ADDRESS, BLOCK_SIZE, Block, Servo, Servos
from openant_tools.comms.silence import diagnose, explained, reader_words
from openant_tools.comms.state import (
    EXTENDED_POSITION,
    POSITION,
    RECORDED,
    Difference,
    differences,
    expected,
    read_state,
    refusal,
    stopping,
)
from openant_tools.comms.thinning import Thinning
from openant_tools.comms.troubles import SILENCE
from openant_tools.errors import BadInput, HardwareFault, OpenAntError
from openant_tools.numbers import percent
from openant_tools.procedure.journal import EepromWrite, Journal
from openant_tools.recording.resume import continuation
from openant_tools.recording.telemetry import Answer as RecordedAnswer
from openant_tools.recording.telemetry import Cycle, ServoChannel
from openant_tools.recording.writer import RecordingStopped, RecordingWriter
from openant_tools.robot.registers import PWM_FULL

if TYPE_CHECKING:
    from openant_tools.comms.body_camera import BodyCamera, CameraConfig

__all__ = ["Engine", "main"]

Array = NDArray[np.float64]

#: From this firmware on servos have a Bus Watchdog.
WATCHDOG_FIRMWARE = 38
#: Silence of this process, s, after which its guardian switches torque off, and how often it says that it lives.
PATIENCE_S, BEAT_S = 1.0, 0.1
#: s. Guardians that are ended so soon after each other: another would fare no better.
GUARDIAN_LIFE_S = 1.0
#: Bits with which a servo switches torque on by itself (firmware ≥ 45): at a goal, and as it starts.
UNASKED_FIRMWARE, UNASKED = 45, {"drive_mode": 8, "startup_configuration": 1}
#: How long torque off is sent again where servos do not confirm it.
RELEASE_S = 0.5
#: How long the engine waits for a port that vanished to come back, between two tries.
REOPEN_PERIOD_S = 0.5
#: s between two losses whose raw bytes a thin recording keeps: a line that is dead says the same each time.
RAW_PERIOD_S = 0.05
#: rad. No body whose tag is seen from above leans farther.
STEEP_RAD = np.pi / 4
#: The IMU's port is left alone for so long before a cycle begins.
IMU_SLACK_S = 0.3e-3
_ERR_CODE = {word: code for code, word in enumerate(ERR_CODES)}
_UNANSWERED = {cause: RecordedAnswer(None, False, cause.value) for cause in Cause}


class _ParentGone(Exception):
    pass


class Engine:
    """The loop and all it owns. `run` returns when the parent says so, dies, or the process is told to end.

    Args:
        config: the hardware.
        connection: to the parent.
        ring: telemetry, one row a cycle.
    """

    def __init__(self, config: EngineConfig, connection: Connection, ring: Ring) -> None:
        self.config = config
        self._connection = connection
        self._ring = ring
        self._parent = os.getppid()
        self._outbox: deque[Any] = deque(maxlen=4096)
        self._ending = False
        self._torque = False
        self._motions: deque[Motion] = deque()
        self._goal: Array | None = None
        self._limp = np.zeros(len(config.servos), bool)
        self._let_go: list[str] = []
        #: where the joints were in the last cycle of a motion that lets joints go, rad
        self._angles = np.zeros(len(config.servos))
        self._counts: list[int] | None = None
        self._waiting: list[tuple[int, Motion]] = []
        #: (number, until when) of commands that only let time pass
        self._looks: list[tuple[int, float]] = []
        #: what ended motion last; torque comes on again only with a reason then
        self._trip: Trip | None = None
        #: why the recording that was asked for is not written any more, until whoever records is told
        self._unrecorded: RecordingStopped | None = None
        self._recorder: RecordingWriter | None = None
        self._thinning: Thinning | None = None
        #: when the raw bytes of a loss were kept last, s
        self._bytes_at = -np.inf
        self._overruns = 0
        self._worst_wake = 0.0
        #: when the servos were last asked, s
        self._asked_at = 0.0
        self._cycles = 0
        #: number of the goal that this cycle's command belongs to, 0 for none
        self._playing = 0
        self._guardian: subprocess.Popen[bytes] | None = None
        #: when it was replaced last, when we last looked after it, and when we last said to it how we are, s of this computer
        self._replaced_at = self._alive_at = self._beat_at = -np.inf
        #: whether servos without a Bus Watchdog were named
        self._unwatched_told = False
        self._lost = False
        #: the line talks without a pause, and it has been told
        self._restless = False
        #: joint → register → counts that a face has set, in place of what was expected
        self._ours: dict[str, dict[str, int]] = {joint: dict(table) for joint, table in config.registers.items()}
        self._differences: list[Difference] = []
        #: joints that stand where they were not sent, rad from there, told and gone on with
        self._behind: dict[str, float] = {}
        self._imu: BodyImu | None = None
        self._pose_lost = ""
        self._camera: BodyCamera | None = None

    # ---- life ----------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Connect, loop, and release whatever happens."""
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._on_signal)
        # Ctrl-C at the terminal is for the parent, which then tells us; a loop half way through a cycle is no place.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            try:
                self._connect()
            except OpenAntError as fault:
                error = self._asked_why(fault)
                self._say(messages.Reply(0, error=(error.what, error.where, error.remedy)))
                return
            self._say(messages.Reply(0, value=self._description()))
            self._loop()
        except _ParentGone:
            pass
        except HardwareFault as error:  # a virtual robot that ended
            self._outbox.append(messages.Notice(str(error)))
        finally:
            self._release()
            self._flush(patience_s=0.5)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._ending = True

    def _connect(self) -> None:
        config = self.config
        control = VirtualControl(config.control) if config.control else None
        self.clock: Clock = RealClock(None if control is None else control.robot_pid)
        self._line = SerialLine(config.port, config.baud)
        if control is not None and control.ask("now")["stepped"]:
            self.clock = SteppedClock(control, bus=self._line)
        self._latency_timer_s = self._set_latency_timer()
        timing = Timing(
            write_read_gap_s=config.write_read_gap_s, latency_timer_s=self._latency_timer_s or Timing.latency_timer_s
        )
        self._bus = Bus(self._line, self.clock, timing)
        reader = reader_words(config.port)
        if reader:
            self._notice(f"{reader} → {SILENCE['second_reader'].do}")
        self._start_guardian()
        servos = Servos(self._bus, config.servos)
        found = servos.identify()
        known = [replace(servo, firmware=found[servo.joint].firmware) for servo in config.servos]
        self._servos = servos = Servos(self._bus, known, before_write=self._note_write)
        self._report_leftovers()
        delays = servos.read_all("return_delay_time")
        longest = max(delays.values()) * known[0].model.registers["return_delay_time"].scale
        self._bus.timing = replace(timing, return_delay_s=longest)
        self._compare_rate()
        if self._latency_timer_s is None:
            measured = self._bus.measure_latency_timer(known[0].id)
            self._bus.timing = replace(self._bus.timing, latency_timer_s=round(measured, 3))
        if not config.still:
            for joint, table in config.registers.items():
                for register, counts in table.items():
                    servos.write_counts(register, joint, counts)
            self._ensure_position_mode()
            self._ensure_torque_waits()
        self._eeprom_writes = list(servos.journal)
        for words in _changes(servos.journal):
            self._notice(words)
        self._servos = self._on_this_turn()
        self._read_registers()
        for difference in self._differences:
            self._notice(str(difference))
        self._following: Following | None = None
        if config.guards.behind_rad is not None:
            self._following = Following(self._servos.servos, config.guards.behind_rad, self._registers)
        hottest = {joint: float(table["temperature_limit"]) for joint, table in self._registers.items()}
        self._watch = Watch(config.guards, self._servos.servos, config.limits_rad, hottest)
        self._period = 1.0 / config.rate_hz
        if config.imu is not None:
            try:
                self._imu = BodyImu(config.imu, self.clock)
                for note in self._imu.notes:
                    self._notice(f"IMU: {note}")
            except HardwareFault as error:
                self._notice(f"going on without the IMU: {error}")
        if config.camera is not None:
            self._open_camera(config.camera)

    def _compare_rate(self) -> None:
        """Say where more cycles a second are wanted than the wire allows."""
        bus, config = self._bus, self.config
        limit = bus_limit_hz(
            config.baud, len(config.servos), fast=bus.fast.issuperset(self._servos.ids), gap_s=config.write_read_gap_s,
            return_delay_s=bus.timing.return_delay_s,
        )  # fmt: skip
        if config.rate_hz > limit:
            self._notice(
                f"{config.rate_hz:g} cycles/s are wanted, and {len(config.servos)} servos at {config.baud} baud allow "
                f"{limit:.0f}: rows come as fast as they can → a higher baud rate, no return delay (`openant calib "
                "inventory`), or a lower rate"
            )

    def _open_camera(self, config: CameraConfig) -> None:
        from openant_tools.comms.body_camera import BodyCamera  # OpenCV takes its time to load

        try:
            self._camera = BodyCamera(config, self.clock)
            for note in self._camera.notes:
                self._notice(f"camera: {note}")
        except HardwareFault as error:
            self._notice(f"going on without the camera: {error}")

    def _set_latency_timer(self) -> float | None:
        """The adapter's timer, s, set to 1 ms where that is allowed; None where the host cannot tell."""
        host, port = Host(), self.config.port
        now = host.latency_timer_ms(port)
        if now is not None and now > WANTED_LATENCY_MS and not host.set_latency_timer_ms(port):
            self._notice(
                f"the adapter's latency timer is {now} ms, each read waits so long; this sets it to 1 ms for good:\n"
                + udev_rule()
            )
        now = host.latency_timer_ms(port)
        return None if now is None else now * 1e-3

    def _ensure_position_mode(self) -> None:
        """Position mode where the joint's range lies within the encoder's turn, else extended position mode."""
        for joint, mode in self._servos.read_all("operating_mode").items():
            servo = self._servos[joint]
            low, high = self.config.limits_rad.get(joint, (0.0, 0.0))
            ends = servo.to_servo(low) % (2 * np.pi), servo.to_servo(high) % (2 * np.pi)
            across_the_seam = (ends[1] - ends[0]) * servo.direction < 0
            if mode != EXTENDED_POSITION and (mode != POSITION or across_the_seam):
                self._servos.write_counts("operating_mode", joint, EXTENDED_POSITION)

    def _ensure_torque_waits(self) -> None:
        """No servo switches torque on by itself: one that starts anew after a drop of its supply would jump, unguarded."""
        able = [servo.joint for servo in self._servos.servos if (servo.firmware or 0) >= UNASKED_FIRMWARE]
        for register, bit in UNASKED.items() if able else ():
            for joint, value in self._servos.read_all(register, able).items():
                if value & bit:
                    self._servos.write_counts(register, joint, value & ~bit)

    def _report_leftovers(self) -> None:
        """What an earlier program left: torque on, tripped watchdogs, hardware errors."""
        servos = self._servos
        on = [joint for joint, value in servos.read_all("torque_enable").items() if value]
        tripped = servos.tripped_watchdogs()
        if on:
            self._notice(f"torque was still on at {', '.join(on)}: it is off now")
            servos.set_torque(False, on)
        for joint in tripped:
            servos.write_counts("bus_watchdog", joint, 0)
        if tripped:
            self._notice(
                f"the Bus Watchdog of {', '.join(tripped)} had tripped, since the last program ended without a word, "
                "and had locked the goals: cleared"
            )
        for joint, status in servos.read_all("hardware_error_status").items():
            if status:
                for error in servos.hardware_errors(joint):
                    self._notice(f"{joint} (id {servos[joint].id}) reports {error.name}: {error.advice}")

    def _on_this_turn(self) -> Servos:
        """The servos with zeros moved by whole turns, so that each joint reads near the middle of its limits.

        In extended position mode a servo counts over turns, and which one it starts on is chance.
        """
        positions = self._servos.read_all("present_position")
        moved: list[Servo] = []
        for servo in self._servos.servos:
            low, high = self.config.limits_rad.get(servo.joint, (0.0, 0.0))
            seen = positions[servo.joint] * servo.model.registers["present_position"].scale
            middle = servo.to_servo((low + high) / 2)
            turns = round((seen - middle) / (2 * np.pi))
            moved.append(replace(servo, zero_rad=servo.zero_rad + turns * 2 * np.pi))
        return Servos(self._bus, moved, before_write=self._note_write)

    def _note_write(self, change: EepromWrite) -> None:
        if self.config.journal is not None:
            Journal(Path(self.config.journal)).append(change, "engine")

    def _read_registers(self) -> None:
        """What is set in the servos now, and how it differs from what should be."""
        config, servos = self.config, self._servos.servos
        self._registers = read_state(self._servos, self._alive_meanwhile(RECORDED))
        wanted = {
            servo.joint: expected(
                servo.model, ours=self._ours.get(servo.joint, {}), passport=config.passport.get(servo.joint, {})
            )
            for servo in servos
        }
        for joint in wanted:  # set when something is to move, whatever stands there now
            if "pwm_limit" not in self._ours.get(joint, {}):
                wanted[joint].pop("pwm_limit", None)
        self._differences = differences(servos, self._registers, wanted, config.limits_rad)

    def _alive_meanwhile(self, registers: Iterable[str]) -> Iterator[str]:
        """Reading them all takes a busy host a second: who reads has not stood still, and the guardian is told so."""
        for register in registers:
            self._beat()
            now = self.clock.now()
            # The servos' watchdog hears these questions, too; a longer pause is looked into by the next cycle.
            if now - self._asked_at < self.config.watchdog_s - WATCHDOG_UNIT_S:
                self._asked_at = now
            yield register

    def _look_at_registers(self, *, moves: bool) -> None:
        """Read what is set in the servos anew; raises HardwareFault where that makes a motion wrong or unsafe."""
        before = set(self._differences)
        self._read_registers()
        if self._following is not None:
            self._following.take(self._registers)
        for difference in self._differences:
            if difference not in before:
                self._notice(str(difference))
        wrong = stopping(self._differences)
        if wrong and moves and not self.config.anyway:
            what, remedy = refusal(wrong)
            raise HardwareFault(what, where=self.config.port, remedy=remedy)

    def _description(self) -> dict[str, Any]:
        return {
            "joints": self._servos.joints,
            "firmware": {servo.joint: servo.firmware for servo in self._servos.servos},
            "registers": self._registers,
            "differences": self._differences,
            "position": self._measure(),
            "stepped": self.clock.stepped,
            "eeprom_writes": self._eeprom_writes,
            "latency_timer_s": self._bus.timing.latency_timer_s,
            "pid": os.getpid(),
            "guardian_pid": self._guardian.pid if self._guardian else None,
        }

    def _start_guardian(self) -> None:
        """Raises HardwareFault where this computer lets no process begin."""
        packet = p2.sync_write(64, 1, dict.fromkeys((servo.id for servo in self.config.servos), b"\0")).encode()
        fd = self._line.fileno()
        # A stepped robot's time stands still while nobody asks for it: then silence means nothing.
        patience = 0.0 if self.clock.stepped else self._patience_s
        words = [sys.executable, "-I", "-S", guardian.__file__, str(fd), packet.hex(), f"{patience:g}"]
        try:
            self._guardian = subprocess.Popen(words, stdin=subprocess.PIPE, pass_fds=(fd,), start_new_session=True)
        except OSError as error:
            raise HardwareFault(
                f"the guardian that switches torque off if this program dies cannot be started ({error.strerror})",
                remedy="make room on this computer: processes, memory",
            ) from None
        assert self._guardian.stdin is not None
        os.set_blocking(self._guardian.stdin.fileno(), False)
        self._beat_at = -np.inf

    @property
    def _patience_s(self) -> float:
        return max(PATIENCE_S, self.config.watchdog_s)

    def _look_after(self) -> None:
        """Every cycle: that the guardian lives and knows that we do, that we were not suspended, nor our parent."""
        now, before = time.monotonic(), self._alive_at
        self._alive_at = now
        if self._torque and not self.clock.stepped and now - before > self._patience_s:
            self._stopped(
                Trip(
                    f"this computer stood still for {now - before:.1f} s, and torque was switched off meanwhile",
                    "close what else keeps it busy, or let it not go to sleep",
                    cause=StopCause.STALL,
                )
            )
        if self._guardian is not None and self._guardian_gone(self._guardian):
            self._replace_guardian(self._guardian)
        if now - self._beat_at > BEAT_S:
            self._beat()
            if self._torque and self._parent_suspended():
                self._stopped(
                    Trip(
                        "the program that moves the robot was suspended",
                        "bring it back with `fg`, and begin again",
                        cause=StopCause.BY_HAND,
                    )
                )

    @staticmethod
    def _guardian_gone(guardian: subprocess.Popen[bytes]) -> bool:
        """Whether it was killed, or stopped for good."""
        try:
            how = os.waitid(os.P_PID, guardian.pid, os.WEXITED | os.WSTOPPED | os.WNOHANG | os.WNOWAIT)
        except ChildProcessError:
            return True
        return how is not None

    def _replace_guardian(self, gone: subprocess.Popen[bytes]) -> None:
        gone.kill()
        gone.wait()
        if gone.stdin is not None:
            gone.stdin.close()
        self._guardian = None
        now, before = time.monotonic(), self._replaced_at
        self._replaced_at = now
        why = ""
        try:
            self._start_guardian()
        except HardwareFault as error:
            why = error.what
        if not why and now - before < GUARDIAN_LIFE_S and self._torque:
            why = "so was the one before it"
        if why and self._torque:
            words = f"the guardian was ended from outside, and {why}"
            self._stopped(Trip(words, "find out what ends processes here", cause=StopCause.GUARDIAN))
        else:
            then = f"{why}: torque stays off" if why else "another one guards now"
            self._notice(f"the guardian that switches torque off if this program dies was ended from outside: {then}")

    def _beat(self) -> None:
        """Tell the guardian whether torque is on."""
        self._beat_at = self._alive_at = time.monotonic()
        if self._guardian is not None and self._guardian.stdin is not None:
            with contextlib.suppress(OSError):  # it has gone: the next cycle sees to it
                os.write(self._guardian.stdin.fileno(), b"+" if self._bus.guarded else b"-")

    def _parent_suspended(self) -> bool:
        """By Ctrl-Z or SIGSTOP; where the system does not tell (no /proc), the face that gets the signal says stop."""
        try:
            stat = Path(f"/proc/{self._parent}/stat").read_bytes()
        except OSError:
            return False
        return stat.rpartition(b")")[2].split()[:1] == [b"T"]

    def _dismiss_guardian(self) -> None:
        if self._guardian is not None and self._guardian.stdin is not None:
            with contextlib.suppress(OSError):
                self._guardian.stdin.write(b"bye")
                self._guardian.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._guardian.wait(1.0)
            self._guardian = None

    def _release(self) -> None:
        """Torque off, the recording closed, the guardian sent home; none of them prevents the next."""
        if hasattr(self, "_servos"):
            try:
                self._torque_off()
            except HardwareFault as error:
                # The guardian, who is not sent home then, tries once more as this process ends.
                self._outbox.append(messages.Notice(str(error)))
                self._guardian = None
        try:
            self._close_recording()
        except RecordingStopped as error:
            self._notice(str(error))
        self._dismiss_guardian()
        if self._imu is not None:
            self._imu.close()
        if self._camera is not None:
            self._camera.close()
        if hasattr(self, "_line"):
            self._line.close()

    def _torque_off(self) -> None:
        """Release every servo, again and again until each has confirmed or time is up: the line may be bad."""
        self._torque = self._bus.guarded = False
        self._limp[:], self._let_go = False, []
        self._motions.clear()
        self._goal = self._counts = None
        if self._lost:
            return
        left, give_up = list(self._servos.joints), self.clock.now() + RELEASE_S
        try:
            while left:
                self._servos.torque_off_now()
                left = self._servos.still_on(left)
                if self.clock.now() > give_up:
                    break
        except PortGone:
            self._port_lost()
        if left and not self._lost:
            self._notice(
                f"torque off was sent to {', '.join(left)}, but they do not confirm: the servos' own watchdog stops them"
            )

    # ---- the loop ------------------------------------------------------------------------------------------------

    def _loop(self) -> None:
        due, cycles = self.clock.now(), 1
        self.clock.lateness.mark()
        while not self._ending:
            if self.clock.stepped and not self._motions and not self._looks:
                # A virtual robot's time stands still while there is nothing to do. What is asked for within the cycle
                # begins with the next one, as it would in real time.
                self._look_after()
                self._take_commands(block=True)
                due = max(due, self.clock.now())
                continue
            self._pass_time(due)
            wake = self.clock.now() - due
            self._look_after()
            self._take_commands(block=False)
            try:
                self._cycle(wake, cycles)
            except PortGone as error:
                self._port_lost()
                remedy = "look at the USB cable; the servos' watchdog stops them"
                self._stopped(Trip(str(error.what), remedy, cause=StopCause.PORT))
            except HardwareFault as fault:
                # A servo that had to answer did not, or refused: what its motion waits for will not come.
                why = self._asked_why(fault)
                self._stopped(Trip(why.what, why.remedy or "", cause=_cause_of(fault)))
            self._end_looks()
            self._flush()
            late = int((self.clock.now() - due) / self._period)
            self._overruns += late > 0
            cycles = 1 + late
            due += cycles * self._period

    def _end_looks(self) -> None:
        now = self.clock.now()
        for look in [look for look in self._looks if look[1] <= now]:
            self._looks.remove(look)
            self._say(messages.Reply(look[0]))

    def _pass_time(self, due: float) -> None:
        """Wait for the next cycle; the IMU's samples and the camera's poses come meanwhile."""
        try:
            if self._imu is not None:
                for sample in self._imu.until(due - IMU_SLACK_S):
                    if self._recorder is not None:
                        self._recorder.imu(*sample)
            if self._camera is not None:
                self._take_poses(self._camera)
        except RecordingStopped as error:
            self._recording_failed(error)
        for sensor in (self._imu, self._camera):
            news = None if sensor is None else sensor.news()
            if news is not None:
                self._notice(news)
        # Who reads seldom, as a soak does, hears and looks after everyone as often as others.
        while not self.clock.stepped and not self._ending and due - self.clock.now() > BEAT_S:
            self.clock.sleep_until(self.clock.now() + BEAT_S)
            self._look_after()
            self._take_commands(block=False)
        self.clock.sleep_until(due)

    def _take_poses(self, camera: BodyCamera) -> None:
        from openant_tools.comms.tags import BodyPose

        lean = None if self._imu is None else self._imu.lean
        if lean is not None and self._may_lean(*lean[1:]):
            camera.lean(*lean)
        for seen in camera.poses():
            if self._recorder is None:
                continue
            if isinstance(seen, BodyPose):
                self._recorder.pose(
                    seen.t, position=seen.position.tolist(), yaw=seen.yaw, quaternion=seen.quaternion.tolist()
                )
            reason = "" if isinstance(seen, BodyPose) else seen.reason
            if seen.kind != self._pose_lost:
                self._pose_lost = seen.kind
                self._recorder.event("pose lost" if reason else "pose found", taken=seen.t, reason=reason)

    def _may_lean(self, roll: float, pitch: float) -> bool:
        """Whether a lean (rad) can be the body's: an IMU whose place nobody has measured may sit in it any way round."""
        imu = self.config.imu
        return (imu is not None and imu.calibrated) or bool(np.cos(roll) * np.cos(pitch) > np.cos(STEEP_RAD))

    def _cycle(self, wake: float, cycles: int) -> None:
        if self._lost:
            if self._recorder is not None:
                gone = [(Answer(servo.id, None, 0, Cause.PORT), None) for servo in self._servos.servos]
                self._record(self.clock.now(), None, wake, gone, None)
            self._try_reopen()
            return
        cmd_t: float | None = None
        ended: Motion | None = None
        agent: tuple[float, float] | None = None
        self._playing = 0
        if self._torque and self._motions:
            motion = self._motions[0]
            self._playing = motion.number
            agent = motion.agent if motion.done == 0 else None
            self._goal = motion.step(cycles)
            if (motion.limp_now != self._limp).any():
                self._goal = self._release_and_catch(motion)
            if self._limp.any():
                # The goal follows a leg that hangs free: whenever torque comes back, there is nothing to jump to.
                self._goal = np.where(self._limp, self._angles, self._goal)
            self._counts = self._servos.goal_counts(self._goal.tolist())
            if motion.ended:
                ended = self._motions.popleft()
        if self._torque and self._counts is not None:
            cmd_t = self._servos.write_goals(self._counts)
        answers = self._servos.read_blocks()
        if self._torque and self._motions and self._motions[0].limp is not None:
            self._note_angles(answers)
        t, before = self._bus.request_at, self._asked_at
        if self._let_go:
            self._make_sure(self._let_go)
        self._asked_at = t
        self._cycles += 1
        self._worst_wake = max(self._worst_wake, wake)
        # What holds up this cycle's waits makes the loop as late as waking up late does.
        late = self.clock.lateness.cycle(wake)
        if self._recorder is not None:
            self._record(t, cmd_t, late, answers, agent)
        self._telemetry(t, cmd_t, wake, answers)
        if self._bus.restless and not self._restless:
            # Told once an episode; where something moves, it ends: what is heard on such a line is chance.
            fault = self._bus.never_silent()
            if self._torque:
                self._stopped(Trip(fault.what, fault.remedy or "", cause=StopCause.PORT))
            else:
                self._notice(str(fault))
        self._restless = self._bus.restless
        if self._torque:
            near, trip = self._follows(t, answers, ended)
            trip = self._watch.check(t, answers) or self._stood_still(t - before) or trip
            if trip is not None:
                self._stopped(self._explained(trip))
            elif ended is not None and ended.arrives and not near:
                # It holds its last row until all joints are there, or one has stood away from it for too long.
                self._motions.appendleft(ended)
                return
        if ended is not None:
            self._motion_ended(ended)

    def _follows(
        self, t: float, answers: list[tuple[Answer, Block | None]], ended: Motion | None
    ) -> tuple[bool, Trip | None]:
        """Whether all joints are near where they were sent; the reason to stop where one has stayed away from it."""
        motion = ended or (self._motions[0] if self._motions else None)
        if self._following is None or self._goal is None or motion is None or not motion.judged:
            return True, None
        near, behind = self._following.check(t, self._goal, self._limp, answers)
        if behind is None or not self.config.anyway:
            return near, None if behind is None else behind.trip
        self._note_behind(behind)
        return True, None

    def _note_behind(self, behind: Behind) -> None:
        """Go on, since the builder said so, and keep it with the recording; once for each joint."""
        joint, away = behind.servo.joint, abs(behind.command_rad - behind.angle_rad)
        if joint in self._behind:
            return
        self._behind[joint] = round(away, 4)
        self._notice(f"{behind.trip.what}; going on anyway")
        if self._recorder is not None:
            self._recorder.event("behind", joint=joint, away_rad=away)

    def _make_sure(self, let_go: list[str]) -> None:
        """Joints that were let go must be without torque, or the recording lies."""
        self._let_go = []
        self._servos.set_torque(False, self._servos.still_on(let_go))

    def _note_angles(self, answers: list[tuple[Answer, Block | None]]) -> None:
        for k, (servo, (_, block)) in enumerate(zip(self._servos.servos, answers, strict=True)):
            if block is not None:
                self._angles[k] = servo.to_joint(block.position * servo.model.registers["present_position"].scale)

    def _release_and_catch(self, motion: Motion) -> Array:
        """Switch the torque of single joints as a motion says; its row, in which a caught joint's goal is where it hangs."""
        servos, joints = self._servos, self._servos.joints
        before, self._limp = self._limp, motion.limp_now.copy()
        loose = [joint for joint, was, now in zip(joints, before, self._limp, strict=True) if now and not was]
        if loose:
            # All at once, and just before the row that says so is read; who did not hear it is told alone after that.
            servos.write_all("torque_enable", dict.fromkeys(loose, 0))
            self._let_go = loose
        caught = [joint for joint, was, now in zip(joints, before, self._limp, strict=True) if was and not now]
        if caught:
            here = servos.read_all("present_position", caught)
            servos.write_all("goal_position", here)
            servos.set_torque(True, caught)
            for joint, counts in here.items():
                k, servo = joints.index(joint), servos[joint]
                angle = servo.to_joint(counts * servo.model.registers["present_position"].scale)
                catch(motion.commands, motion.done - 1, k, angle, self.config.rate_hz)
        row: Array = motion.commands[motion.done - 1]
        return row

    def _stood_still(self, seconds: float) -> Trip | None:
        """Whether the servos' watchdog has stopped the motion behind our back, since this process was held up."""
        if seconds < self.config.watchdog_s - WATCHDOG_UNIT_S:
            return None
        try:
            tripped = self._servos.tripped_watchdogs()
        except HardwareFault:
            return None  # the guard against silence will see to it
        if not tripped:
            return None
        return Trip(
            f"this computer stood still for {seconds:.2f} s, and the servos' Bus Watchdog stopped the motion",
            "close what else keeps it busy, or let it not go to sleep",
            cause=StopCause.STALL,
        )

    def _motion_ended(self, motion: Motion) -> None:
        waiting = [entry for entry in self._waiting if entry[1] is motion]
        here = self._measure() if waiting and motion.measured else None
        for entry in waiting:
            self._waiting.remove(entry)
            self._say(messages.Reply(entry[0], value=here))
        self._say(messages.Finished(motion.name))

    def _explained(self, trip: Trip) -> Trip:
        """What a cycle's answers alone do not tell, asked once everyone is released."""
        if trip.joint is None or not trip.examine or self._bus.restless:
            return trip
        try:
            self._servos.torque_off_now()
            if trip.examine == "silence":
                return self._who_is_silent(trip)
            if trip.examine == "behind":
                return self._why_behind(trip)
            errors = self._servos.hardware_errors(trip.joint)
        except HardwareFault:
            return trip
        if not errors:
            return trip
        servo = self._servos[trip.joint]
        names = ", ".join(error.name for error in errors)
        what = f"{servo.joint} (id {servo.id}) reports {names}"
        return Trip(what, errors[0].advice, trip.joint, cause=StopCause.HARDWARE_ERROR)

    def _asked_why(self, fault: OpenAntError) -> OpenAntError:
        """A servo's silence with its cause: the servos are asked, once torque is off."""
        if not isinstance(fault, NoAnswer | BrokenAnswer) or isinstance(fault, NeverSilent) or self._lost:
            return fault
        if hasattr(self, "_servos"):
            self._torque_off()
        return explained(self._bus, fault, self.config.chain)

    def _why_behind(self, trip: Trip) -> Trip:
        """The register that keeps a joint from where it was sent, where one differs."""
        self._read_registers()
        mine = [one for one in self._differences if one.joint == trip.joint]
        if not mine:
            return trip
        return replace(trip, what=f"{trip.what}; {mine[0].what}", remedy=mine[0].mended)

    def _who_is_silent(self, trip: Trip) -> Trip:
        """Each servo asked alone: in a common read those behind a silent one wait for it and seem silent, too."""
        silent, broken = list[Servo](), list[Servo]()
        for servo in self._servos.servos:
            seen = [answer for _ in range(3) for answer in self._bus.sync_read(BLOCK_ADDRESS, BLOCK_SIZE, [servo.id])]
            causes = {answer.cause for answer in seen}
            # Only what is the same every time is told: a busy host meets now this, now that.
            if causes == {Cause.CRC}:
                broken.append(servo)
            elif causes == {Cause.TIMEOUT}:
                silent.append(servo)
        if not silent or len(broken) > 1 or (broken and len(silent) > 1):
            late = self.clock.lateness
            if not late.busy or broken:
                return trip
            return Trip(f"{trip.what}; {late.words}", REMEDY, trip.joint, cause=trip.cause)
        first, names = silent[0], ", ".join(f"{servo.joint} (id {servo.id})" for servo in silent)
        if broken:
            [other] = broken
            return Trip(
                f"{names} is silent and what comes from {other.joint} (id {other.id}) is broken",
                f"probably both have id {other.id}: unplug {other.joint}, and `openant comms scan` shows it",
                first.joint,
                cause=trip.cause,
            )
        why = diagnose(
            self._bus, [servo.id for servo in silent], self._servos.ids, self.config.chain, was_there=True
        )  # fmt: skip
        before = f"{trip.what}: " if first.joint == trip.joint else ""
        return Trip(before + why.what, why.remedy, first.joint, cause=trip.cause)

    def _stopped(self, trip: Trip, where: str | None = None) -> None:
        """Release everyone, tell, and only then make sure: on a bad line that may take a while.

        Args:
            where: what it concerns, where that is not the bus.
        """
        if not self._lost:
            with contextlib.suppress(HardwareFault):
                self._servos.torque_off_now()
        if self._recorder is not None:
            with contextlib.suppress(RecordingStopped):  # told by the next cycle's row
                self._recorder.event("stopped", what=trip.what, joint=trip.joint, cause=trip.cause.value)
        self._trip = trip
        self._say(messages.Stopped(trip.what, trip.remedy, trip.joint, trip.cause))
        for number, _ in self._waiting:
            self._say(messages.Reply(number, error=(trip.what, where, trip.remedy), cause=trip.cause))
        self._waiting.clear()
        self._torque_off()

    def _port_lost(self) -> None:
        self._lost = True
        self._reopen_at = self.clock.now() + REOPEN_PERIOD_S
        self._line.close()

    def _try_reopen(self) -> None:
        if self.clock.now() < self._reopen_at:
            return
        self._reopen_at = self.clock.now() + REOPEN_PERIOD_S
        try:
            self._dismiss_guardian()
            self._line = SerialLine(self.config.port, self.config.baud)
            self._bus.line = self._line
            if isinstance(self.clock, SteppedClock):
                self.clock.attach(bus=self._line)
            self._start_guardian()
            self._lost = False
            self._report_leftovers()
            self._notice("the port is back")
        except HardwareFault:
            self._lost = True

    # ---- what a cycle leaves behind ------------------------------------------------------------------------------

    def _record(
        self, t: float, cmd_t: float | None, wake: float, answers: Sequence[tuple[Answer, Block | None]],
        agent: tuple[float, float] | None,
    ) -> None:  # fmt: skip
        assert self._recorder is not None
        recorded = [
            RecordedAnswer(
                {
                    "pos": block.position, "vel": block.velocity, self._effort[k]: block.effort, "pwm": block.pwm,
                    "volt": block.voltage, "temp": block.temperature, "tick": block.tick,
                },
                answer.ok, answer.word, answer.rtt or 0.0,
            )
            if block is not None
            else _UNANSWERED[answer.cause or Cause.SHORT]
            for k, (answer, block) in enumerate(answers)
        ]  # fmt: skip
        n = len(recorded)
        goals: list[int | None] = [None] * n if self._counts is None else list(self._counts)
        try:
            torque = [self._torque and not limp for limp in self._limp.tolist()]
            cycle = Cycle(t, goals, cmd_t, wake, recorded, torque, *(agent or (None, None)))
            if self._thinning is None:
                self._recorder.cycle(cycle)
            else:
                self._record_thinly(self._thinning, self._recorder, cycle)
        except RecordingStopped as error:
            self._recording_failed(error)

    def _record_thinly(self, thinning: Thinning, recorder: RecordingWriter, cycle: Cycle) -> None:
        for kept in thinning.take(cycle):
            recorder.cycle(kept)
        if self._bus.failed is not None:
            (asked, heard), self._bus.failed = self._bus.failed, None
            if cycle.t - self._bytes_at >= RAW_PERIOD_S:
                self._bytes_at = cycle.t
                recorder.event("bytes", asked=asked.hex(), heard=heard.hex())
        counts = thinning.counts(cycle.t)
        if counts is not None:
            recorder.event("counts", **counts)

    def _recording_failed(self, error: RecordingStopped) -> None:
        """The disk is full: the robot must not go on moving for a recording that nobody will have."""
        with contextlib.suppress(RecordingStopped):
            self._close_recording()
        self._unrecorded = error
        self._stopped(Trip(error.what, error.remedy or "", cause=StopCause.STORAGE), error.where)
        # Who only lets time pass does so for this recording, too.
        for number, _ in self._looks:
            self._say(_refusal(number, None, error))
        self._looks.clear()

    def _telemetry(
        self, t: float, cmd_t: float | None, wake: float, answers: list[tuple[Answer, Block | None]]
    ) -> None:
        nan = float("nan")
        body = (nan,) * 6 if self._imu is None else self._imu.newest(t)
        base = (nan,) * 4 if self._camera is None else self._camera.newest(t)
        taken = nan if self._imu is None else self._imu.taken_at, nan if self._camera is None else self._camera.taken_at
        row = [
            t, nan if cmd_t is None else cmd_t, wake, float(self._torque), *body, *base, *taken, float(self._playing)
        ]  # fmt: skip
        for k, (answer, block) in enumerate(answers):
            servo = self._servos.servos[k]
            command = nan if self._goal is None else float(self._goal[k])
            if block is None:
                row += [command, nan, nan, nan, nan, nan, nan, nan, nan, 0.0, _ERR_CODE[answer.word], nan]
                continue
            table, sign = servo.model.registers, servo.direction
            effort = sign * servo.model.effort.to_si(block.effort)
            row += [
                command,
                servo.to_joint(block.position * table["present_position"].scale),
                sign * block.velocity * table["present_velocity"].scale,
                effort if servo.model.has_current_sensor else nan,
                nan if servo.model.has_current_sensor else effort,
                sign * block.pwm * table["present_pwm"].scale,
                block.voltage * table["present_input_voltage"].scale,
                float(block.temperature),
                float(block.tick),
                float(answer.ok),
                _ERR_CODE[answer.word],
                nan if answer.rtt is None else answer.rtt,
            ]
        self._ring.put(row)

    # ---- commands ------------------------------------------------------------------------------------------------

    def _take_commands(self, *, block: bool) -> None:
        """Do what the parent has asked for; raises _ParentGone where it is no more."""
        if os.getppid() != self._parent:
            raise _ParentGone
        try:
            while self._connection.poll(0.2 if block else 0.0):
                received = self._connection.recv_bytes()
                try:
                    number, command = pickle.loads(received)  # from our parent alone, over a socket pair
                except Exception as error:
                    self._notice(f"a message of {len(received)} bytes was refused: it cannot be read ({error})")
                    continue
                if command is None:
                    self._ending = True
                    return
                try:
                    answer = self._do(number, command)
                except PortGone as error:
                    if not self._lost:
                        self._port_lost()
                    answer = _refusal(number, command, error)
                except OpenAntError as error:
                    answer = _refusal(number, command, error)
                except Exception as error:  # ours: whoever waits is told, and nothing moves on with it
                    what = f"{type(command).__name__} failed in the engine: {type(error).__name__}: {error}"
                    self._stopped(Trip(what, "report it, with this line and the command that you gave"))
                    answer = messages.Reply(number, error=(what, None, None), cause=StopCause.UNKNOWN)
                if answer is not None:
                    self._say(answer)
                if block:
                    return
        except (EOFError, ConnectionError):
            raise _ParentGone from None

    def _do(self, number: int, command: messages.Command) -> messages.Reply | None:
        """One command; None where its reply comes later."""
        command = checked(command, self._servos, self.config.limits_rad)
        if isinstance(command, messages.Stop):
            self._stopped(Trip("stopped by hand", "", cause=StopCause.BY_HAND))
            return messages.Reply(number)
        if isinstance(command, messages.Look):
            if self._unrecorded is not None:
                raise self._unrecorded
            self._looks.append((number, self.clock.now() + command.seconds))
            return None
        if self._lost:
            raise PortGone(self.config.port)
        handlers: dict[type, Callable[[int, Any], messages.Reply | None]] = {
            messages.Torque: self._do_torque,
            messages.Ramp: self._do_move,
            messages.Play: self._do_move,
            messages.Hold: self._do_move,
            messages.Goal: self._do_goal,
            messages.Record: self._do_record,
            messages.StopRecording: self._do_stop_recording,
            messages.ReadRegister: self._do_read,
            messages.WriteRegister: self._do_write,
            messages.Statistics: lambda number, _: messages.Reply(number, value=self._statistics()),
            messages.Picture: lambda number, _: messages.Reply(
                number, value=None if self._camera is None else self._camera.picture()
            ),
        }
        return handlers[type(command)](number, command)

    def _do_torque(self, number: int, command: messages.Torque) -> messages.Reply:
        if not command.on:
            self._torque_off()
            return messages.Reply(number)
        if self.config.still:
            raise BadInput("torque stays off: this program only watches")
        if not self._torque:
            if self._trip is not None and command.restart is None:
                raise BadInput(
                    f"motion was stopped and does not begin again by itself: {self._trip.what}",
                    remedy="look at the robot, then start anew",
                )
            self._switch_on()
            if command.restart is not None:
                self._notice(str(command.restart))
                if self._recorder is not None:
                    self._recorder.event("restart", **asdict(command.restart))
            self._trip = None
        return messages.Reply(number, value=self._goal)

    def _switch_on(self) -> None:
        """Torque on where the robot stands, guarded before: goals are set to what is measured before and after."""
        servos = self._servos
        self._look_at_registers(moves=True)
        try:
            self._guard()
            # A motion that was gentle, and was killed, has left its limit behind.
            for joint, counts in servos.read_all("goal_pwm").items():
                full = self._registers[joint]["pwm_limit"]
                if counts != full:
                    servos.write_counts("goal_pwm", joint, full)
            positions = servos.read_all("present_position")
            self._counts = [positions[joint] for joint in servos.joints]
            servos.write_goals(self._counts)
            servos.set_torque(True)
            servos.write_goals(self._counts)
        except HardwareFault:
            self._torque_off()
            raise
        self._goal = np.array(servos.joint_rad(self._counts))
        self._angles = self._goal.copy()
        self._torque = True
        self._beat()
        self._asked_at = self.clock.now()
        self._watch.reset(self._asked_at)
        if self._following is not None:
            self._following.reset()
        self._behind = {}

    def _guard(self) -> None:
        """What must be before torque is: a guardian, and the Bus Watchdog of every servo that has one, armed."""
        if self._guardian is None:
            self._start_guardian()
        servos = self._servos
        for joint in servos.tripped_watchdogs():
            servos.write_counts("bus_watchdog", joint, 0)  # or the goals stay locked
        able = [servo.joint for servo in servos.servos if (servo.firmware or 0) >= WATCHDOG_FIRMWARE]
        for joint in able:
            servos.write_counts("bus_watchdog", joint, round(self.config.watchdog_s / WATCHDOG_UNIT_S))
        unable = [joint for joint in servos.joints if joint not in able]
        if unable and not self._unwatched_told:
            self._unwatched_told = True
            self._notice(
                f"{', '.join(unable)} {'has' if len(unable) == 1 else 'have'} no Bus Watchdog (firmware below "
                f"{WATCHDOG_FIRMWARE}): should this program and its guardian die at once, nothing stops the motion"
            )
        self._bus.guarded = True
        self._beat()

    def _do_move(self, number: int, command: messages.Ramp | messages.Play | messages.Hold) -> None:
        if self._refused_limp(number) or self._goal is None:
            return
        rate = self.config.rate_hz
        if isinstance(command, messages.Hold):
            motions = [hold(self._goal, command.seconds, rate)]
        elif isinstance(command, messages.Ramp):
            self._within_their_limits(command.target[None, :])
            motions = [ramp(self._goal, command.target, rate)]
        else:
            self._within_their_limits(command.commands)
            motions = play(self._goal, command.commands, rate, command.name, command.limp)
        self._motions.extend(motions)
        self._waiting.append((number, motions[-1]))

    def _refused_limp(self, number: int) -> bool:
        """Whether torque is off, so that nothing can move: whoever has not yet heard why it went off is told now."""
        if self._torque:
            return False
        if self._trip is None:
            raise BadInput("torque is off", remedy="switch it on first")
        error = (self._trip.what, None, self._trip.remedy)
        self._say(messages.Reply(number, error=error, cause=self._trip.cause))
        return True

    def _do_goal(self, number: int, command: messages.Goal) -> None:
        if self._refused_limp(number):
            return
        self._within_their_limits(command.target[None, :])
        rows = held(command.target, command.seconds, self.config.rate_hz)
        motion = Motion("goal", rows, number=number, measured=command.measured, judged=False)
        motion.agent = command.agent
        self._motions.clear()
        self._motions.append(motion)
        self._waiting.append((number, motion))

    def _within_their_limits(self, commands: Array) -> None:
        """In position mode a servo refuses goals beyond its own limits, and nobody would be told."""
        if self.config.anyway:
            return
        for k, servo in enumerate(self._servos.servos):
            table = self._registers[servo.joint]
            if table["operating_mode"] != POSITION:
                continue
            ends = commands[:, k].min(), commands[:, k].max()
            scale = servo.model.registers["goal_position"].scale
            counts = [(round(servo.to_servo(angle) / scale), angle) for angle in ends]
            for name, beyond in (
                ("min_position_limit", [angle for count, angle in counts if count < table["min_position_limit"]]),
                ("max_position_limit", [angle for count, angle in counts if count > table["max_position_limit"]]),
            ):
                if beyond:
                    end = servo.to_joint(table[name] * scale)
                    raise HardwareFault(
                        f"{servo.joint} (id {servo.id}) would be sent to {beyond[0]:.3f} rad, but refuses goals beyond "
                        f"{end:.3f} rad: its {name} is {table[name]}",
                        where=self.config.port,
                        remedy="widen it by `openant calib inventory`, or narrow this joint's limits in robot.toml",
                    )

    def _do_record(self, number: int, command: messages.Record) -> messages.Reply:
        if self._recorder is not None:
            raise BadInput(f"{self._recorder.path} is being recorded", remedy="stop that recording first")
        channels = [self._channel(servo) for servo in self._servos.servos]
        self._effort = ["cur" if servo.model.has_current_sensor else "load" for servo in self._servos.servos]
        extra: dict[str, Any] = {
            "baud": self.config.baud,
            "latency_timer_ms": self._bus.timing.latency_timer_s * 1e3,
            "return_delay_s": self._bus.timing.return_delay_s,
        }
        if self._imu is not None:
            scales = self._imu.info
            extra["imu"] = {"gyro_counts_per_dps": scales.gyro_lsb_per_dps, "acc_counts_per_g": scales.acc_lsb_per_g}
        if self.config.chain:
            extra["chain"] = [list(cable) for cable in self.config.chain]
        facts = replace(command.facts, joints=self._servos.joints, extra={**extra, **command.facts.extra})
        if command.thin_s is not None:
            facts = replace(facts, extra={**facts.extra, "rate_hz": self.config.rate_hz, "thinned_s": command.thin_s})
        self._unrecorded = None
        self._look_at_registers(moves=self._torque)
        if self._differences:
            told = [difference.as_fact() for difference in self._differences]
            facts = replace(facts, extra={**facts.extra, "differences": told})
        if self.config.anyway:
            facts = replace(facts, extra={**facts.extra, "anyway": True, "behind_rad": dict(self._behind)})
        continued = None
        if command.resume:
            continued = continuation(command.path, channels, self.clock.now(), wall_counts=not self.clock.stepped)
        try:
            self._recorder = RecordingWriter(
                command.path,
                facts=facts,
                channels=channels,
                registers=self._registers,
                config=command.config,
                clock=self.clock.now,
                overwrite=command.overwrite,
                continued=continued,
            )
        except (TypeError, ValueError, AttributeError) as error:
            raise BadInput(f"Record.facts cannot be recorded: {error}", where=command.path) from error
        self._beat()
        self._thinning = None if command.thin_s is None else Thinning(command.thin_s, self._servos.joints)
        self._bus.failed = None
        if continued is not None:
            self._recorder.event("resumed", pause_s=self.clock.now() + continued.shift_s - continued.last_s)
        return messages.Reply(number, value=str(self._recorder.path))

    def _channel(self, servo: Servo) -> ServoChannel:
        table = servo.model.registers
        names = {
            "pos": "present_position", "vel": "present_velocity", "pwm": "present_pwm",
            "volt": "present_input_voltage", "temp": "present_temperature", "tick": "realtime_tick",
        }  # fmt: skip
        scales = {name: table[register].scale for name, register in names.items()}
        scales["cur" if servo.model.has_current_sensor else "load"] = servo.model.effort.scale
        return ServoChannel(servo.joint, servo.model.name, servo.id, servo.direction, servo.zero_rad, scales)

    def _close_recording(self) -> tuple[str, int] | None:
        if self._recorder is None:
            return None
        recorder, self._recorder = self._recorder, None
        if self._thinning is not None:
            for kept in self._thinning.flush():
                recorder.cycle(kept)
            recorder.event("counts", **self._thinning.rest(self.clock.now()))
        recorder.close()
        return str(recorder.path), recorder.cycles

    def _do_stop_recording(self, number: int, command: messages.StopRecording) -> messages.Reply:
        """Also where the recording ended before, it is told: nobody takes a part for the whole."""
        unrecorded, self._unrecorded = self._unrecorded, None
        if unrecorded is not None:
            raise unrecorded
        try:
            return messages.Reply(number, value=self._close_recording())
        except RecordingStopped as error:
            self._recording_failed(error)
            self._unrecorded = None
            raise

    def _do_read(self, number: int, command: messages.ReadRegister) -> messages.Reply:
        return messages.Reply(number, value=self._servos.read_all(command.register))

    def _do_write(self, number: int, command: messages.WriteRegister) -> messages.Reply:
        if command.register in ("torque_enable", "bus_watchdog"):
            raise BadInput(f"{command.register} is the engine's own", remedy="use `messages.Torque`")
        if command.register.startswith("goal_") and not self._torque:
            why = "" if self._trip is None else f": {self._trip.what}"
            raise BadInput(f"torque is off{why}", remedy="switch it on first")
        seen = len(self._servos.journal)
        self._servos.write_counts(command.register, command.joint, command.counts)
        self._ours.setdefault(command.joint, {})[command.register] = command.counts
        return messages.Reply(number, value=self._servos.journal[seen:])

    def _statistics(self) -> dict[str, object]:
        names = {servo.id: servo.joint for servo in self._servos.servos}
        return self._bus.statistics.as_dict(names) | {
            "cycles": self._cycles,
            "overruns": self._overruns,
            "worst_wake_s": self._worst_wake,
            "late": self.clock.lateness.words,
        }

    def _measure(self) -> Array:
        """Joint angles (joints,) rad, as of now."""
        positions = self._servos.read_all("present_position")
        return np.array(self._servos.joint_rad([positions[joint] for joint in self._servos.joints]))

    # ---- to the parent -------------------------------------------------------------------------------------------

    def _notice(self, text: str) -> None:
        self._say(messages.Notice(text))

    def _say(self, message: messages.Reply | messages.Event) -> None:
        self._outbox.append(message)
        self._flush()

    def _flush(self, patience_s: float = 0.0) -> None:
        """Send what the parent can take now; a face that does not read must not stop the loop."""
        try:
            while self._outbox and select.select([], [self._connection], [], patience_s)[1]:
                self._connection.send(self._outbox.popleft())
        except OSError:
            if patience_s == 0.0:
                raise _ParentGone from None


def _cause_of(error: OpenAntError) -> StopCause:
    """What ended motion, where an error did."""
    if isinstance(error, RecordingStopped):
        return StopCause.STORAGE
    if isinstance(error, PortGone):
        return StopCause.PORT
    return StopCause.SILENCE if isinstance(error, (NoAnswer, BrokenAnswer)) else StopCause.UNKNOWN


def _refusal(number: int, command: messages.Command | None, error: OpenAntError) -> messages.Reply:
    """The reply to a command that failed; with a cause where nothing is recorded any more, or motion cannot begin."""
    ends = isinstance(error, RecordingStopped) or (
        isinstance(command, messages.Torque) and not isinstance(error, BadInput)
    )
    return messages.Reply(
        number, error=(error.what, error.where, error.remedy), cause=_cause_of(error) if ends else None
    )


def _changes(writes: Sequence[EepromWrite]) -> Iterator[str]:
    """What was written to the servos' memory, one line for all that got the same."""
    alike: dict[tuple[str, int, int], list[EepromWrite]] = {}
    for write in writes:
        alike.setdefault((write.register, write.old, write.new), []).append(write)
    for (register, old, new), found in alike.items():
        who = f"{len(found)} servos" if len(found) > 1 else f"{found[0].joint} (id {found[0].id})"
        power = f": at most {percent(new / PWM_FULL)} of full power" if register == "pwm_limit" else ""
        yield f"{who}: {register} {old} → {new}{power}"


def main() -> None:
    """Argument: file descriptors of the connection and of the ring. The config comes first over the connection."""
    connection, ring_fd = Connection(int(sys.argv[1])), int(sys.argv[2])
    config, width = connection.recv()
    Engine(config, connection, Ring(width, ring_fd)).run()


if __name__ == "__main__":
    main()
