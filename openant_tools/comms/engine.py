"""The process that owns the hardware: bus and recorder in one fixed-rate loop, torque off however it ends.

Run as `python -m openant_tools.comms.engine`, by `engine_process.EngineProcess`, with a socket pair to its parent: it
takes `messages`, answers each, and tells events. When the parent dies the socket ends, and torque goes off; a suspended
parent (Ctrl-Z) ends motion, too. Should this process be killed or suspended, its guardian sends the same packet; should
both die, each servo's Bus Watchdog stops its motion. This is the only way to torque: a bus without all that refuses it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from openant_tools import numbers
from openant_tools.comms import messages
from openant_tools.comms.body_sensors import BodySensors
from openant_tools.comms.bus import Answer
from openant_tools.comms.checked import checked
from openant_tools.comms.engine_port import EnginePort
from openant_tools.comms.examination import cause_of, examined, watchdogs_tripped
from openant_tools.comms.faults import BrokenAnswer, Cause, NeverSilent, NoAnswer
from openant_tools.comms.following import Behind
from openant_tools.comms.guardian_process import BEAT_S
from openant_tools.comms.guards import Trip
from openant_tools.comms.hardware import Hardware, report_leftovers, take_over
from openant_tools.comms.lateness import processor_s
from openant_tools.comms.limp import LimpJoints
from openant_tools.comms.line import PortGone
from openant_tools.comms.messages import WATCHDOG_UNIT_S, EngineConfig
from openant_tools.comms.motion import Motion, held, hold, play, ramp
from openant_tools.comms.motion_queue import MotionQueue
from openant_tools.comms.parent import Parent, ParentGone
from openant_tools.comms.recorder import Recorder
from openant_tools.comms.restart import StopCause
from openant_tools.comms.ring import Ring, joint_values
from openant_tools.comms.servos import Block
from openant_tools.comms.silence import explained
from openant_tools.errors import BadInput, HardwareFault, OpenAntError, system_fault
from openant_tools.recording.writer import RecordingStopped
from openant_tools.scheduling import LOOP, in_time
from openant_tools.signals import TOLD_TO_GO

__all__ = ["Engine", "main", "run"]


#: s for which the parent may take its time to hear the last words
LAST_WORDS_S = 0.5
#: what to do where the port has gone: the watchdog stops servos, it does not let them go
PORT_GONE = (
    "the servos' watchdog stops them, and they hold where they are: plug the USB cable in again at once, which switches torque off, "
    "or cut their power before you touch them"
)
#: s for which the recording's thread may keep the interpreter from a cycle that is due; Python's own 5 ms are half a cycle
SWITCH_S = 2e-4
#: s between two notes of what a virtual robot takes of this computer
PROCESSOR_EVERY_S = 10.0


def run(config: EngineConfig, parent: Parent, ring: Ring) -> None:
    """Connect, loop until the parent says so, dies, or the process is told to end, and release whatever happens."""

    def end(number: int, frame: object) -> None:
        parent.ended = True

    for number in TOLD_TO_GO:
        signal.signal(number, end)
    # Ctrl-C at the terminal is for the parent, which then tells us; a loop half way through a cycle is no place.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(ParentGone), contextlib.ExitStack() as owned:
        owned.callback(parent.flush, LAST_WORDS_S)
        try:
            engine = _connected(config, parent, ring, owned)
            if engine is not None:
                with contextlib.nullcontext() if engine.stepped else in_time(LOOP):
                    engine.loop()
        except HardwareFault as error:  # a virtual robot that ended
            parent.notice(str(error))


def _connected(config: EngineConfig, parent: Parent, ring: Ring, owned: contextlib.ExitStack) -> Engine | None:
    """The loop, ready; None where there is no connection, which the parent has been told.

    Args:
        owned: takes what is done in the end, in reverse: torque off first, then the recording closed, the guardian sent
            home, sensors and port closed; none of them prevents the next.
    """
    try:
        port = EnginePort(config, parent.notice)
        owned.callback(lambda: port.line.close())
        sensors = BodySensors()
        owned.callback(sensors.close)
        owned.callback(port.guardian.dismiss)
        recorder = Recorder(config, port)
        owned.callback(_end_recording, recorder, parent)
        hardware = take_over(config, port, sensors, owned, parent.notice)
        parent.say(messages.Reply(0, value=hardware.description()))
    except (OpenAntError, OSError) as error:
        fault = system_fault(error, again="connect again") if isinstance(error, OSError) else error
        parent.say(messages.Reply(0, error=(fault.what, fault.where, fault.remedy)))
        return None
    return Engine(hardware, recorder, parent, ring)


def _end_recording(recorder: Recorder, parent: Parent) -> None:
    try:
        recorder.end()
    except RecordingStopped as error:
        parent.notice(str(error))


class Engine:
    """The loop on a robot that is connected.

    Args:
        ring: telemetry, one row a cycle.
    """

    def __init__(self, hardware: Hardware, recorder: Recorder, parent: Parent, ring: Ring) -> None:
        self._hardware, self._recorder, self._parent, self._ring = hardware, recorder, parent, ring
        self.config, self._port, self._servos = hardware.config, hardware.port, hardware.servos
        self._bus, self._clock, self._sensors = hardware.port.bus, hardware.port.clock, hardware.sensors
        self._period = 1.0 / self.config.rate_hz
        self._queue = MotionQueue()
        self._limp = LimpJoints(hardware.servos, self.config.rate_hz)
        self._torque = False
        #: (number, until when) of commands that only let time pass
        self._looks: list[tuple[int, float]] = []
        #: what ended motion last; torque comes on again only with a reason then
        self._trip: Trip | None = None
        #: joints that stand where they were not sent, rad from there, told and gone on with
        self._behind: dict[str, float] = {}
        #: the line talks without a pause, and it has been told
        self._restless = False
        self._cycles = self._overruns = 0
        self._worst_wake = 0.0
        #: when it was noted last what a virtual robot takes of this computer, s
        self._noted_at = -float("inf")

    @property
    def stepped(self) -> bool:
        """Whether a virtual robot's time stands still between cycles."""
        return self._clock.stepped

    # ---- the loop ------------------------------------------------------------------------------------------------

    def loop(self) -> None:
        """Cycles until the parent has ended.

        Raises:
            ParentGone: it has died.
        """
        clock = self._clock
        due, cycles = clock.now(), 1
        clock.lateness.mark()
        while not self._parent.ended:
            if clock.stepped and not self._queue.motions and not self._looks:
                # A virtual robot's time stands still while there is nothing to do. What is asked for within the cycle
                # begins with the next one, as it would in real time.
                self._look_after()
                self._take_commands(wait=True)
                due = max(due, clock.now())
                continue
            self._pass_time(due)
            wake = clock.now() - due
            self._look_after()
            self._take_commands(wait=False)
            try:
                self._cycle(wake, cycles)
            except PortGone as error:
                self._port.lose()
                self._stopped(Trip(str(error.what), PORT_GONE, cause=StopCause.PORT))
            except HardwareFault as fault:
                # A servo that had to answer did not, or refused: what its motion waits for will not come.
                why = self._asked_why(fault)
                self._stopped(Trip(why.what, why.remedy or "", cause=cause_of(fault)))
            self._end_looks()
            self._parent.flush()
            late = int((clock.now() - due) / self._period)
            self._overruns += late > 0
            cycles = 1 + late
            due += cycles * self._period

    def _pass_time(self, due: float) -> None:
        """Wait for the next cycle; the IMU's samples and the camera's poses come meanwhile."""
        clock = self._clock
        try:
            self._sensors.take_until(due, self._recorder)
        except RecordingStopped as error:
            self._recording_failed(error)
        for news in self._sensors.news():
            self._parent.notice(news)
        # Who reads seldom, as a soak does, hears and looks after everyone as often as others.
        while not clock.stepped and not self._parent.ended and due - clock.now() > BEAT_S:
            clock.sleep_until(clock.now() + BEAT_S)
            self._look_after()
            self._take_commands(wait=False)
        clock.sleep_until(due)

    def _look_after(self) -> None:
        """Every cycle: that the guardian lives and knows that we do, that we were not suspended, nor our parent."""
        port, guardian = self._port, self._port.guardian
        now, before = time.monotonic(), port.alive_at
        port.alive_at = now
        if self._torque and not self._clock.stepped and now - before > port.patience_s:
            self._stopped(
                Trip(
                    f"this computer stood still for {numbers.number(now - before, 's', decimals=1)}: torque is off now",
                    "close what else keeps it busy, or let it not go to sleep",
                    cause=StopCause.STALL,
                )
            )
        if guardian.ended():
            why = guardian.replace(port.line.fileno(), self._torque)
            if why and self._torque:
                words = f"the guardian was ended from outside, and {why}"
                self._stopped(Trip(words, "find out what ends processes here", cause=StopCause.GUARDIAN))
            else:
                then = f"{why}: torque stays off" if why else "another one guards now"
                self._parent.notice(
                    f"the guardian that switches torque off if this program dies was ended from outside: {then}"
                )
        if now - guardian.told_at > BEAT_S:
            port.beat()
            if self._torque and self._parent.suspended():
                self._stopped(
                    Trip(
                        "the program that moves the robot was suspended",
                        "bring it back with `fg`, and begin again",
                        cause=StopCause.BY_HAND,
                    )
                )

        self._note_virtual_robot(now)

    def _note_virtual_robot(self, now: float) -> None:
        """Keep with the recording what a virtual robot in real time takes of this computer, from time to time."""
        pid = self._clock.lateness.robot_pid
        if pid is None or self._clock.stepped or now - self._noted_at < PROCESSOR_EVERY_S:
            return
        self._noted_at = now
        used = processor_s(pid)
        if used is not None:
            with contextlib.suppress(RecordingStopped):  # told by the next cycle's row
                self._recorder.event("virtual robot", processor_s=used, processors=os.cpu_count())

    def _end_looks(self) -> None:
        now = self._clock.now()
        for look in [look for look in self._looks if look[1] <= now]:
            self._looks.remove(look)
            self._parent.say(messages.Reply(look[0]))

    def _cycle(self, wake: float, cycles: int) -> None:
        if self._port.lost:
            gone = [(Answer(servo.id, None, 0, Cause.PORT), None) for servo in self._servos.servos]
            self._record(self._clock.now(), None, wake, gone, None)
            self._try_reopen()
            return
        queue, limp = self._queue, self._limp
        cmd_t: float | None = None
        ended: Motion | None = None
        agent: tuple[float, float] | None = None
        queue.number = 0
        if self._torque and queue.motions:
            motion = queue.motions[0]
            queue.number = motion.number
            agent = motion.agent if motion.done == 0 else None
            queue.goal = motion.step(cycles)
            if (motion.limp_now != limp.now).any():
                queue.goal = limp.switch(motion)
            if limp.now.any():
                # The goal follows a leg that hangs free: whenever torque comes back, there is nothing to jump to.
                queue.goal = np.where(limp.now, limp.angles, queue.goal)
            queue.counts = self._servos.goal_counts(queue.goal.tolist())
            if motion.ended:
                ended = queue.motions.popleft()
        if self._torque and queue.counts is not None:
            cmd_t = self._servos.write_goals(queue.counts)
        answers = self._servos.read_blocks()
        if self._torque and queue.motions and queue.motions[0].limp is not None:
            limp.see(answers)
        t, before = self._bus.request_at, self._port.asked_at
        limp.make_sure()
        self._port.asked_at = t
        self._cycles += 1
        self._worst_wake = max(self._worst_wake, wake)
        # What holds up this cycle's waits makes the loop as late as waking up late does.
        late = self._clock.lateness.cycle(wake)
        self._record(t, cmd_t, late, answers, agent)
        self._telemetry(t, cmd_t, wake, answers)
        if self._bus.restless and not self._restless:
            # Told once an episode; where something moves, it ends: what is heard on such a line is chance.
            fault = self._bus.never_silent()
            if self._torque:
                self._stopped(Trip(fault.what, fault.remedy or "", cause=StopCause.PORT))
            else:
                self._parent.notice(str(fault))
        self._restless = self._bus.restless
        if self._torque:
            near, trip = self._follows(t, answers, ended)
            trip = self._hardware.watch.check(t, answers) or self._stood_still(t - before) or trip
            if trip is not None:
                self._stopped(examined(trip, self._hardware))
            elif ended is not None and ended.arrives and not near:
                # It holds its last row until all joints are there, or one has stood away from it for too long.
                queue.motions.appendleft(ended)
                return
        if ended is not None:
            self._motion_ended(ended)

    def _follows(
        self, t: float, answers: list[tuple[Answer, Block | None]], ended: Motion | None
    ) -> tuple[bool, Trip | None]:
        """Whether all joints are near where they were sent; the reason to stop where one has stayed away from it."""
        queue, following = self._queue, self._hardware.following
        motion = ended or (queue.motions[0] if queue.motions else None)
        if following is None or queue.goal is None or motion is None or not motion.judged:
            return True, None
        near, behind = following.check(t, queue.goal, self._limp.now, answers)
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
        self._parent.notice(f"{behind.trip.what}; going on anyway")
        self._recorder.event("behind", joint=joint, away_rad=away)

    def _stood_still(self, seconds: float) -> Trip | None:
        if seconds < self.config.watchdog_s - WATCHDOG_UNIT_S:
            return None
        return watchdogs_tripped(self._hardware, seconds)

    def _motion_ended(self, motion: Motion) -> None:
        waiting = self._queue.waits_for(motion)
        here = self._hardware.measure() if waiting and motion.measured else None
        for number in self._queue.answered(motion):
            self._parent.say(messages.Reply(number, value=here))
        self._parent.say(messages.Finished(motion.name))

    def _record(
        self, t: float, cmd_t: float | None, late: float, answers: Sequence[tuple[Answer, Block | None]],
        agent: tuple[float, float] | None,
    ) -> None:  # fmt: skip
        writer = self._recorder.writer
        if writer is None:
            return
        torque = [self._torque and not limp for limp in self._limp.now.tolist()]
        try:
            self._recorder.cycle(writer, (t, cmd_t, late), self._queue.counts, torque, answers, agent)
        except RecordingStopped as error:
            self._recording_failed(error)

    def _telemetry(
        self, t: float, cmd_t: float | None, wake: float, answers: list[tuple[Answer, Block | None]]
    ) -> None:
        nan, goal = float("nan"), self._queue.goal
        row = [t, nan if cmd_t is None else cmd_t, wake, float(self._torque), *self._sensors.newest(t)]
        row.append(float(self._queue.number))
        for k, (servo, (answer, block)) in enumerate(zip(self._servos.servos, answers, strict=True)):
            row += joint_values(servo, nan if goal is None else float(goal[k]), answer, block)
        self._ring.put(row)

    # ---- stops ---------------------------------------------------------------------------------------------------

    def _torque_off(self) -> list[str]:
        """Joints that do not confirm it."""
        self._torque = False
        self._limp.end()
        self._queue.clear()
        return self._hardware.torque_off()

    def _stopped(self, trip: Trip, where: str | None = None) -> None:
        """Release everyone, make sure, which on a bad line may take a while, and tell what is known then.

        Args:
            where: what it concerns, where that is not the bus.
        """
        if not self._port.lost:
            with contextlib.suppress(HardwareFault):
                self._servos.torque_off_now()
        given_up = self._queue.give_up()
        if left := self._torque_off():
            holding = f"{', '.join(left)} may still hold: cut the power before you touch the robot"
            trip = replace(trip, remedy=f"{trip.remedy}; {holding}" if trip.remedy else holding)
        with contextlib.suppress(RecordingStopped):  # told by the next cycle's row
            self._recorder.event("stopped", what=trip.what, joint=trip.joint, cause=trip.cause.value)
        self._trip = trip
        self._parent.say(messages.Stopped(trip.what, trip.remedy, trip.joint, trip.cause))
        for number in given_up:
            self._parent.say(messages.Reply(number, error=(trip.what, where, trip.remedy), cause=trip.cause))

    def _asked_why(self, fault: HardwareFault) -> HardwareFault:
        """A servo's silence with its cause: the servos are asked, once torque is off."""
        if not isinstance(fault, NoAnswer | BrokenAnswer) or isinstance(fault, NeverSilent) or self._port.lost:
            return fault
        self._torque_off()
        return explained(self._bus, fault, self.config.chain)

    def _recording_failed(self, error: RecordingStopped) -> None:
        """The disk is full: the robot must not go on moving for a recording that nobody will have."""
        self._recorder.failed(error)
        self._stopped(Trip(error.what, error.remedy or "", cause=StopCause.STORAGE), error.where)
        # Who only lets time pass does so for this recording, too.
        for number, _ in self._looks:
            self._parent.say(_refusal(number, None, error))
        self._looks.clear()

    def _try_reopen(self) -> None:
        try:
            if self._port.reopen():
                report_leftovers(self._servos, self._parent.notice)
                self._port.holding = False
                self._parent.notice("the port is back")
        except HardwareFault:
            self._port.lost = True

    # ---- commands ------------------------------------------------------------------------------------------------

    def _take_commands(self, *, wait: bool) -> None:
        """Do what the parent has asked for; raises ParentGone where it is no more."""
        for number, command in self._parent.commands(wait=wait):
            try:
                answer = self._do(number, command)
            except PortGone as error:
                if not self._port.lost:
                    self._port.lose()
                answer = _refusal(number, command, error)
            except OpenAntError as error:
                answer = _refusal(number, command, error)
            except ParentGone:
                raise
            except Exception as error:  # ours: whoever waits is told, and nothing moves on with it
                what = f"{type(command).__name__} failed in the engine: {type(error).__name__}: {error}"
                self._stopped(Trip(what, "report it, with this line and the command that you gave"))
                answer = messages.Reply(number, error=(what, None, None), cause=StopCause.UNKNOWN)
            if answer is not None:
                self._parent.say(answer)

    def _do(self, number: int, command: messages.Command) -> messages.Reply | None:
        """One command; None where its reply comes later."""
        command = checked(command, self._servos, self.config.limits_rad)
        if isinstance(command, messages.Stop):
            self._stopped(Trip("stopped by hand", "", cause=StopCause.BY_HAND))
            return messages.Reply(number)
        if isinstance(command, messages.LetPass):
            if self._recorder.stopped is not None:
                raise self._recorder.stopped
            self._looks.append((number, self._clock.now() + command.seconds))
            return None
        if self._port.lost:
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
            messages.TakePicture: lambda number, _: messages.Reply(number, value=self._sensors.picture()),
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
                self._parent.notice(str(command.restart))
                self._recorder.event("restart", **asdict(command.restart))
            self._trip = None
        return messages.Reply(number, value=self._queue.goal)

    def _switch_on(self) -> None:
        self._hardware.look_at_registers(moves=True)
        try:
            counts = self._hardware.switch_on()
        except HardwareFault:
            self._torque_off()
            raise
        goal = np.array(self._servos.joint_rad(counts))
        self._queue.counts, self._queue.goal = counts, goal
        self._limp.begin(goal)
        self._torque = True
        self._port.beat()
        self._port.asked_at = self._clock.now()
        self._hardware.watch.reset(self._port.asked_at)
        if self._hardware.following is not None:
            self._hardware.following.reset()
        self._behind = {}

    def _do_move(self, number: int, command: messages.Ramp | messages.Play | messages.Hold) -> None:
        goal = self._queue.goal
        if self._refused_limp(number) or goal is None:
            return
        rate, settings = self.config.rate_hz, self._hardware.settings
        if isinstance(command, messages.Hold):
            motions = [hold(goal, command.seconds, rate)]
        elif isinstance(command, messages.Ramp):
            settings.check_goals(command.target[None, :])
            motions = [ramp(goal, command.target, rate)]
        else:
            settings.check_goals(command.commands)
            motions = play(goal, command.commands, rate, command.name, command.limp)
        self._queue.add(number, motions)

    def _refused_limp(self, number: int) -> bool:
        """Whether torque is off, so that nothing can move: whoever has not yet heard why it went off is told now."""
        if self._torque:
            return False
        if self._trip is None:
            raise BadInput("torque is off", remedy="switch it on first")
        error = (self._trip.what, None, self._trip.remedy)
        self._parent.say(messages.Reply(number, error=error, cause=self._trip.cause))
        return True

    def _do_goal(self, number: int, command: messages.Goal) -> None:
        if self._refused_limp(number):
            return
        self._hardware.settings.check_goals(command.target[None, :])
        rows = held(command.target, command.seconds, self.config.rate_hz)
        motion = Motion("goal", rows, number=number, measured=command.measured, judged=False)
        motion.agent = command.agent
        self._queue.replace(number, motion)

    def _do_record(self, number: int, command: messages.Record) -> messages.Reply:
        recorder = self._recorder
        if recorder.writer is not None:
            raise BadInput(f"{recorder.writer.path} is being recorded", remedy="stop that recording first")
        if command.pictures and not self._sensors.has_camera:
            raise BadInput(
                "no camera sends pictures that could be recorded", remedy="look at its cable, or record without"
            )
        extra: dict[str, Any] = {"ids": {servo.joint: servo.id for servo in self._servos.servos}}
        if self._sensors.imu is not None:
            scales = self._sensors.imu.info
            extra["imu"] = {"gyro_counts_per_dps": scales.gyro_lsb_per_dps, "acc_counts_per_g": scales.acc_lsb_per_g}
        if self.config.chain:
            extra["chain"] = [list(cable) for cable in self.config.chain]
        recorder.stopped = None
        self._hardware.look_at_registers(moves=self._torque)
        if self.config.anyway:
            extra |= {"anyway": True, "behind_rad": dict(self._behind)}
        writer = recorder.begin(command, self._servos.servos, self._hardware.settings, extra)
        return messages.Reply(number, value=str(writer.path))

    def _do_stop_recording(self, number: int, command: messages.StopRecording) -> messages.Reply:
        """Also where the recording ended before, it is told: nobody takes a part for the whole."""
        recorder = self._recorder
        stopped, recorder.stopped = recorder.stopped, None
        if stopped is not None:
            raise stopped
        try:
            return messages.Reply(number, value=recorder.end())
        except RecordingStopped as error:
            self._recording_failed(error)
            recorder.stopped = None
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
        self._hardware.settings.ours.setdefault(command.joint, {})[command.register] = command.counts
        return messages.Reply(number, value=self._servos.journal[seen:])

    def _statistics(self) -> dict[str, object]:
        names = {servo.id: servo.joint for servo in self._servos.servos}
        return self._bus.statistics.as_dict(names) | {
            "cycles": self._cycles,
            "overruns": self._overruns,
            "worst_wake_s": self._worst_wake,
            "late": self._clock.lateness.words,
        }


def _refusal(number: int, command: messages.Command | None, error: OpenAntError) -> messages.Reply:
    """The reply to a command that failed; with a cause where nothing is recorded any more, or motion cannot begin."""
    ends = isinstance(error, RecordingStopped) or (
        isinstance(command, messages.Torque) and not isinstance(error, BadInput)
    )
    return messages.Reply(
        number, error=(error.what, error.where, error.remedy), cause=cause_of(error) if ends else None
    )


def main() -> None:
    """Argument: file descriptors of the connection and of the ring. The config comes first over the connection."""
    sys.setswitchinterval(SWITCH_S)
    connection, ring_fd = Connection(int(sys.argv[1])), int(sys.argv[2])
    config, width = connection.recv()
    run(config, Parent(connection), Ring(width, ring_fd))


if __name__ == "__main__":
    main()
