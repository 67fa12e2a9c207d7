"""The thread between an environment and the robot: the engine's process, what it measured, and how to get it back.

Real or virtual makes no difference here but for time: that of a stepped robot passes only while someone waits for it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms import messages
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.restart import POSE_RAD, MotionStopped, Restart, StopCause
from openant_tools.comms.setup import camera_of_robot, config_of_robot, config_of_unknown_robot, imu_of_robot, open_bus
from openant_tools.comms.state import passport_registers
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.numbers import exact, number
from openant_tools.recording.run import Facts
from openant_tools.robot.config import RobotConfig
from openant_tools.robot.folder import RobotFolder

__all__ = ["ENGINE_HZ", "RobotLink", "engine_config", "engine_rate"]

Array = NDArray[np.float64]

#: commands and reads a second, about: a bus of eight servos at 1 Mbaud manages 300
ENGINE_HZ = 100.0
#: s from a reboot to the first answer of a servo, with a margin
BOOT_S = 0.8
#: s between two looks at legs that sink after a stop, until none has moved by more than so many rad; so often at most.
#: Against the back-EMF of their gears knees sink with some 0.3 rad/s.
SINK_S, AT_REST_RAD, SINK_LOOKS = 1.0, 0.02, 6


def engine_rate(dt: float) -> float:
    """The engine's cycles a second, near `ENGINE_HZ`, such that a step of `dt` s is a whole number of them.

    Raises:
        BadInput: no such rate is near enough.
    """
    cycles = round(dt * ENGINE_HZ)
    if not dt > 0.0 or cycles < 1 or not 0.7 <= cycles / dt / ENGINE_HZ <= 1.5:
        raise BadInput(f"dt = {exact(dt, 's')} is too short for the bus", remedy="use 0.01 s or more")
    return cycles / dt


def engine_config(
    robot: RobotConfig | None,
    *,
    rate_hz: float,
    bus: str | None = None,
    imu: str | None = None,
    camera: str | int | None = None,
    control: str | None = None,
    folder: RobotFolder | None = None,
) -> EngineConfig:
    """The engine for walking: bus, IMU and camera, which a learner needs all three.

    Args:
        robot: its robot.toml; None for a virtual robot that nobody has described.
        bus, imu, camera, control: in place of what robot.toml names.
        folder: of the robot, whose journal takes EEPROM writes and whose passport says what is set in its servos.

    Raises:
        BadInput, HardwareFault: one of the three is not known or not there.
    """
    if robot is not None:
        assumed = [joint for joint in robot.motors if _nominal(robot, f"motors.{joint}.zero_offset_rad")]
        if assumed:
            raise BadInput(
                f"the zeros of {', '.join(assumed[:2])}{' …' if len(assumed) > 2 else ''} were never measured: the robot "
                "would move otherwise than it is told",
                where="robot.toml",
                remedy="calibrate it: `openant bringup`, or `openant calib zeros`",
            )
    seen = {"imu": imu_of_robot(robot, imu), "camera": camera_of_robot(robot, camera)}
    for what, port, step in (("flight controller", "ports.imu", "imu"), ("overhead camera", "ports.camera", "arena")):
        if seen[step if step == "imu" else "camera"] is None:
            raise BadInput(
                f"the robot has no {what} yet, without which nothing can be learned on it",
                where="robot.toml",
                remedy=f"set {port} and run `openant calib {step}`",
            )
    more: dict[str, Any] = {**seen, "rate_hz": rate_hz}
    if folder is not None:
        more |= {"journal": str(folder.journal), "passport": passport_registers(folder, real=control is None)}
    if robot is None:
        assert bus is not None  # of a virtual robot
        return config_of_unknown_robot(bus, control, **more)
    return config_of_robot(robot, bus, control=control, **more)


class RobotLink:
    """One robot, with torque off until it is asked to stand.

    Args:
        config: the hardware.
        recordings: folder for one recording a connection; None to record nothing.
        pictures: whether they hold the camera's, too.
        facts: of these recordings.
        robot_toml: kept inside them.
        notice: called with what the user should know.

    Attributes:
        columns: name → place in a row of telemetry.
        limits_c: joint → °C at which its servo would shut down.
        virtual: whether it is a virtual robot, which has nobody beside it.
    """

    def __init__(
        self,
        config: EngineConfig,
        *,
        recordings: Path | None,
        pictures: bool = False,
        facts: Facts,
        robot_toml: str | None,
        notice: Callable[[str], None],
    ) -> None:
        self.config, self._notice = config, notice
        self._recordings, self._facts, self._robot_toml = recordings, facts, robot_toml
        self._pictures = pictures
        self._control = VirtualControl(config.control) if config.control else None
        self.stepped = bool(self._control is not None and self._control.ask("now")["stepped"])
        self._engine: EngineProcess | None = None
        self.virtual = self._control is not None
        self._found: Array | None = None
        #: joint → rad, where those that were heard after a stop came to rest; None where there was no stop
        self._sunk: dict[str, float] | None = None
        self._standing = False
        self.recorded: list[Path] = []

    # ---- life ----------------------------------------------------------------------------------------------------

    @property
    def connected(self) -> bool:
        """Whether the engine is there and has not ended."""
        return self._engine is not None and not self._engine.ended

    @property
    def standing(self) -> bool:
        """Whether torque is on and nothing has switched it off since."""
        return self.connected and self._standing

    def connect(self) -> None:
        """Open the hardware anew: who is there, registers, turns, sensors; a recording begins. Torque stays off.

        Raises:
            MotionStopped: what is done from here on cannot be recorded any more.
            HardwareFault: it is not there, or not all of it.
        """
        self.drop()
        self._engine = engine = EngineProcess(self.config)
        self.columns = {name: k for k, name in enumerate(engine.columns)}
        registers = engine.description["registers"]
        self.limits_c = {joint: float(table["temperature_limit"]) for joint, table in registers.items()}
        if self._found is None:
            self._found = np.asarray(engine.description["position"], float)
        self._tell()
        if self._recordings is not None:
            volts = engine.ask(messages.ReadRegister("present_input_voltage"))
            facts = replace(self._facts, supply_v=round(sum(volts.values()) / len(volts) * 0.1, 2))
            try:
                self._recordings.mkdir(parents=True, exist_ok=True)
                path = _free_name(self._recordings)
                engine.ask(messages.Record(str(path), facts, self._robot_toml, pictures=self._pictures))
            except (OSError, HardwareFault) as error:
                if not self.recorded:  # nothing was begun yet: the place is wrong from the start
                    raise
                where = str(self._recordings)
                raise MotionStopped(
                    f"nothing more is recorded: {error}", where=where, cause=StopCause.STORAGE
                ) from error
            self.recorded.append(path)

    def drop(self) -> None:
        """Let the engine go: torque off, recording closed."""
        engine, self._engine, self._standing = self._engine, None, False
        if engine is not None:
            engine.close()

    def close(self) -> None:
        """Lay the robot down as it was found, torque off, and let go of everything; may be called again."""
        try:
            self.let_down()
        finally:
            self.drop()
            if self._control is not None:
                self._control.close()
                self._control = None

    # ---- moving --------------------------------------------------------------------------------------------------

    def stand(self, pose: Array, settle_s: float, restart: Restart | None = None) -> Array:
        """Torque on, slowly to a pose (joints,) rad, and wait for the legs to come to rest.

        Args:
            restart: after a stop, why motion may begin again.

        Returns:
            Telemetry rows of the waiting.

        Raises:
            HardwareFault: it was stopped, or cannot begin.
        """
        engine = self._need_engine()
        if not self._standing:
            engine.ask(messages.Torque(True, restart))
            self._standing = True
        elif restart is not None:
            self._notice(str(restart))
        self._sunk = None
        with self._noticing_stops():
            engine.ask(messages.Ramp(pose))
            engine.telemetry()
            engine.ask(messages.Hold(settle_s))
        return self._rows()

    def go(self, target: Array, seconds: float, agent: tuple[float, float] | None = None) -> tuple[Array, int]:
        """Command a goal (joints,) rad for `seconds`; it stays in force until the next one.

        Args:
            agent: s on the host's monotonic clock, when the observation was made and the action chosen, for the recording.

        Returns:
            Telemetry rows since the last call, oldest first, and the number that those of this goal bear.

        Raises:
            HardwareFault: a guard, the bus or the engine stopped it.
        """
        engine = self._need_engine()
        with self._noticing_stops():
            # A stepped robot's time stands still while an agent computes: there is nothing to keep.
            goal = messages.Goal(target, seconds, measured=False, agent=None if self.stepped else agent)
            number = engine.start(goal)
            engine.wait(number)
        return self._rows(), number

    def let_down(self) -> HardwareFault | None:
        """Slowly back to how the robot was found, then torque off: from standing it would fall.

        Returns:
            What stopped it on its way: what cannot lie down is let go where it is.
        """
        if not self.standing or self._found is None or self._engine is None:
            return None
        limits = [self.config.limits_rad.get(s.joint, (-np.inf, np.inf)) for s in self.config.servos]
        low, high = np.array(limits).T
        try:
            with self._noticing_stops():
                self._engine.ask(messages.Ramp(np.clip(self._found, low, high)))
                self._engine.ask(messages.Torque(False))
        except HardwareFault as fault:
            return fault
        finally:
            self._standing = False
        return None

    def release(self) -> None:
        """Torque off now, wherever the robot is: it is no place to lie down slowly from."""
        if self._engine is not None:
            with contextlib.suppress(HardwareFault):
                self._engine.ask(messages.Torque(False))
        self._standing = False

    def moved(self) -> str | None:
        """Whether hands have moved the robot between a stop and this connection, in words; None where it lies as it lay."""
        if self._sunk is None or self._engine is None:
            return None
        if not self._sunk:
            return "no servo was heard between the stop and now: nobody knows whether it is as it was"
        here = np.asarray(self._engine.description["position"], float).tolist()
        seen = {servo.joint: angle for servo, angle in zip(self.config.servos, here, strict=True)}
        apart, joint = max((abs(seen[joint] - angle), joint) for joint, angle in self._sunk.items())
        return f"{joint} was moved by {number(apart, 'rad')} since the stop" if apart > POSE_RAD else None

    def forget_stop(self) -> None:
        """The builder has looked: where the robot lay after the last stop does not count."""
        self._sunk = None

    def now(self) -> float:
        """s, the robot's clock."""
        if self.stepped and self._control is not None:
            return float(self._control.ask("now")["t"])
        return time.monotonic()

    def look(self, seconds: float) -> Array | None:
        """Let time pass; telemetry rows of it, None where the robot is not connected."""
        if self._engine is not None and not self._engine.ended:
            with contextlib.suppress(HardwareFault):
                self._engine.telemetry()
                self._engine.ask(messages.LetPass(seconds))
                return self._rows()
        self.wait(seconds)
        return None

    def picture(self) -> NDArray[np.uint8] | None:
        """The overhead camera's newest picture, (height, width, 3) in RGB; None where there is none."""
        found: NDArray[np.uint8] | None = self._need_engine().ask(messages.TakePicture())
        return found

    def wait(self, seconds: float) -> None:
        """Let time pass while there is no engine."""
        if self.stepped and self._control is not None:
            self._control.ask("advance", to=self._control.ask("now")["t"] + seconds)
        else:
            time.sleep(seconds)

    # ---- getting it back -----------------------------------------------------------------------------------------

    def errors(self) -> dict[str, int]:
        """joint → Hardware Error Status of those that report something.

        Raises:
            HardwareFault: they do not answer.
        """
        status: Mapping[str, int] = self._need_engine().ask(messages.ReadRegister("hardware_error_status"))
        return {joint: value for joint, value in status.items() if value}

    def reboot(self, joints: list[str]) -> None:
        """Start servos anew that have shut down; the engine goes for that long.

        Raises:
            HardwareFault: the bus is not there, or one refuses.
        """
        self.drop()
        bus = open_bus(self.config.port, self.config.baud, self.config.control)
        try:
            for servo in self.config.servos:
                if servo.joint in joints:
                    bus.reboot(servo.id)
        finally:
            bus.close()
        self.wait(BOOT_S)

    def put_back(self) -> bool:
        """Have a virtual robot on its floor set where it began, as a person would; False where there is none."""
        if self._control is None or not self.virtual:
            return False
        try:
            self._control.ask("put")
        except HardwareFault:
            return False
        return True

    # ---- inside --------------------------------------------------------------------------------------------------

    def _need_engine(self) -> EngineProcess:
        if self._engine is None:
            raise HardwareFault("the robot is not connected", where=self.config.port, remedy="reset the environment")
        return self._engine

    @contextlib.contextmanager
    def _noticing_stops(self) -> Any:
        try:
            yield
        except HardwareFault:
            self._standing = False
            self._note_where_it_lies()
            raise
        finally:
            self._tell()

    def _note_where_it_lies(self) -> None:
        self._sunk = {}
        engine = self._engine
        if engine is None or engine.ended:
            return
        with contextlib.suppress(HardwareFault):
            engine.telemetry()
            for _ in range(SINK_LOOKS):
                engine.ask(messages.LetPass(SINK_S))
                rows, sinking = engine.telemetry(), False
                for servo in self.config.servos:
                    angles = rows[:, self.columns[f"pos.{servo.joint}"]]
                    angles = angles[np.isfinite(angles)]
                    if len(angles):
                        self._sunk[servo.joint] = float(angles[-1])
                        sinking |= bool(np.ptp(angles) > AT_REST_RAD)
                if not sinking:
                    break

    def _rows(self) -> Array:
        rows: Array = self._need_engine().telemetry()
        return rows

    def _tell(self) -> None:
        if self._engine is None:
            return
        for event in self._engine.events():
            if isinstance(event, messages.Notice):
                self._notice(event.text)
            elif isinstance(event, messages.Stopped):
                self._standing = False


def _nominal(robot: RobotConfig, path: str) -> bool:
    """Whether a value is what the kit's guide says, and nobody has looked."""
    entry = robot.provenance_of(path)
    return entry is None or entry.how == "nominal"


def _free_name(folder: Path) -> Path:
    """A name for a recording that sorts by time: walk-20261122-0215.mcap, with -2, -3 … where it is taken."""
    stem, n = time.strftime("walk-%Y%m%d-%H%M"), 1
    while (path := folder / (f"{stem}.mcap" if n == 1 else f"{stem}-{n}.mcap")).exists():
        n += 1
    return path
