"""What all screens work on: the robot's folder, where it is plugged in, and what is shown of it. Knows no Textual."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openant_tools.bringup.walk import standing
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.messages import EngineConfig, Notice, Stopped
from openant_tools.comms.release import release_all
from openant_tools.comms.setup import config_of_robot, config_of_unknown_robot, find_bus, imu_of_robot
from openant_tools.comms.state import passport_registers
from openant_tools.errors import BadInput, HardwareFault, system_faults
from openant_tools.procedure.step import Bench
from openant_tools.robot.config import CONFIG_NAME
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.faults import FaultList
from openant_tools.tui.feeds import Feed, History, LiveFeed, ReplayFeed
from openant_tools.tui.process import Process
from openant_tools.tui.training import PlayProcess, TrainingProcess
from openant_tools.virtual.process import VIRTUAL_DEFAULT, read_ready_file, ready_file, virtual_robot

__all__ = ["Session"]

Array = NDArray[np.float64]


class Session:
    """One robot, real or virtual, and the rows that its engine (or a recording) brings.

    Attributes:
        path: the robot's folder, whether or not it is one yet.
        virtual: what the ready file of a virtual robot says; None where the robot is real.
        feed: where rows come from now; None where there are none.
        history: the rows of the last seconds.
        selected: the joint that all screens show as chosen.
        notices: what the engine had to say, until somebody takes it.
        doing: what takes its time in the background; "" for nothing.
        training: the run that was started last, which goes on whatever is on the screen.
        diagnosing: the diagnosis that was started last, or the model that is being improved by one.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.virtual: Mapping[str, str | None] | None = None
        self.feed: Feed | None = None
        self.history = History(JOINT_NAMES)
        self.faults = FaultList()
        self.selected = JOINT_NAMES[0]
        self.notices: list[str] = []
        self.doing = ""
        self.training: TrainingProcess | PlayProcess | None = None
        self.diagnosing: Process | None = None
        self._engine: EngineProcess | None = None
        #: s, when the last row came
        self._heard = 0.0
        #: of a virtual robot that somebody else started, and may start anew
        self._ready_file: Path | None = None
        self._virtual_process = contextlib.ExitStack()
        #: one thread connects or starts a robot at a time
        self._busy = threading.Lock()
        self._say_who_holds()

    # ---- the robot -----------------------------------------------------------------------------------------------

    @property
    def folder(self) -> RobotFolder | None:
        """The robot's folder, or None while there is no robot.toml."""
        return RobotFolder(self.path) if (self.path / CONFIG_NAME).is_file() else None

    @property
    def name(self) -> str:
        return self.path.resolve().name

    def robots_here(self) -> list[Path]:
        """The robots' folders in `path`, where that is none itself: in order of their names."""
        if not self.path.is_dir():
            return []
        try:
            return sorted(file.parent for file in self.path.glob(f"*/{CONFIG_NAME}"))
        except OSError:
            return []

    def new_place(self, name: str) -> Path:
        """Where a new robot's folder may be made: this name in `path`, with a number where something stands there."""
        tries = (self.path / (name if k == 1 else f"{name}-{k}") for k in range(1, 1000))
        return next(place for place in tries if not place.exists() or (place.is_dir() and not any(place.iterdir())))

    def open(self, path: Path) -> None:
        """Work on another robot's folder."""
        self.disconnect()
        self.path = path
        self.history = History(JOINT_NAMES)
        self._say_who_holds()

    def _say_who_holds(self) -> None:
        who = None if self.folder is None else self.folder.holder
        if who is not None:
            self.notices.append(
                f"this robot is held by {who}: here you can read its findings and recordings, but neither watch, move nor change it"
            )

    def create(self, path: Path, kit: str) -> None:
        """Make a robot's folder with the nominal values of its kit; raises BadInput."""
        with system_faults(where=path, again="try again"):
            create_robot(path, kit)
        self.open(path)

    def bench(self) -> Bench:
        """Where procedures work. Raises BadInput while there is no robot's folder, or none is there yet that is being started."""
        if self.doing:  # else what a virtual robot is to be asked would go to whatever is plugged in
            raise BadInput(f"not yet: {self.doing}", where=self.path, remedy="begin once that is done")
        folder = self.folder
        if folder is None:
            raise BadInput("there is no robot.toml here", where=self.path, remedy="make a robot's folder: Setup, key s")
        if self.virtual is None:
            return Bench(folder)
        self._find_virtual()
        bus, imu, camera, control = (self.virtual[key] for key in ("bus", "imu", "camera", "control"))
        return Bench(folder, bus, imu, camera, control)

    def start_virtual(self, source: str | None, clock: str | None = "real") -> None:
        """Start a virtual robot, or use a running one, in place of whatever was there; takes seconds.

        Args:
            source: as `virtual.process.virtual_robot` takes it; None for the box of loose motors that belongs to this
                folder, whose servos remember what was written to them, and which is built as far as the walk got.
            clock: of a robot that is started here.

        Raises:
            OpenAntError: it cannot be started.
        """
        with self._busy, system_faults(where=self.path, again="try again"):
            self._disconnect()
            self._virtual_process.close()
            self.virtual = self._ready_file = None
            self.history = History(self.history.joints)  # what was read there is not of another robot
            folder = self.folder
            if source is None and folder is not None:
                from openant_tools.bringup.persistent_robot import persistent_robot  # it loads MuJoCo

                box = self._virtual_process.enter_context(persistent_robot(VIRTUAL_DEFAULT, folder.path, clock))
                box.builder.resume(standing(folder)["legs"].state == "ok")
                self.virtual = {"bus": box.bus, "imu": box.imu, "camera": box.camera, "control": box.control}
            else:
                process = virtual_robot(source or VIRTUAL_DEFAULT, clock=clock)
                self.virtual = self._virtual_process.enter_context(process)
                self._ready_file = ready_file(source or VIRTUAL_DEFAULT)

    def _find_virtual(self) -> None:
        """Where a virtual robot that somebody else started listens now; as before where its ready file cannot be read."""
        if self._ready_file is not None:
            with contextlib.suppress(BadInput, OSError):
                self.virtual = read_ready_file(self._ready_file)

    def end_virtual(self) -> None:
        with self._busy:
            self._disconnect()
            self._virtual_process.close()
            self.virtual = self._ready_file = None
            self.history = History(self.history.joints)  # what was read there is not of another robot

    # ---- watching it ---------------------------------------------------------------------------------------------

    @property
    def watching(self) -> bool:
        return self._engine is not None

    def connect(self) -> None:
        """Start an engine that reads the robot, torque off; takes seconds.

        Raises:
            OpenAntError: no bus, or not all servos answer.
        """
        with self._busy, system_faults(where=self.path, again="try again"):
            if self._engine is None:
                self._find_virtual()
                self._engine = EngineProcess(self._config())

    def disconnect(self) -> None:
        """Give the bus free; torque goes off."""
        with self._busy:
            self._disconnect()

    def _disconnect(self) -> None:
        engine, self._engine = self._engine, None
        if engine is not None:
            engine.close()

    def _config(self) -> EngineConfig:
        """Of who watches: nothing is written and torque stays off."""
        port = control = imu = None
        if self.virtual is not None:
            port, control, imu = self.virtual["bus"], self.virtual["control"], self.virtual["imu"]
        folder = self.folder
        if folder is None:
            config = config_of_unknown_robot(find_bus(port), control, still=True)
        else:
            robot = folder.config()
            journal = str(folder.journal)
            more = {
                "imu": imu_of_robot(robot, imu),
                "journal": journal,
                "still": True,
                "passport": passport_registers(folder, real=self.virtual is None),
            }
            config = config_of_robot(robot, port, control=control, **more)
        return config

    def release(self) -> int:
        """The stop key: torque off everywhere, now, from any thread; how many were told.

        Training on the robot has an engine in its own process: it is told as Ctrl-C tells it, and saves.
        """
        told = release_all()
        if self.training is not None and self.training.where != "sim" and self.training.running:
            self.training.stop()
            told += 1
        return told

    # ---- what the screens draw -----------------------------------------------------------------------------------

    @property
    def replay(self) -> ReplayFeed | None:
        return self.feed if isinstance(self.feed, ReplayFeed) else None

    def play(self, feed: ReplayFeed | None) -> None:
        """Show a recording on every screen instead of the robot; None for the robot again."""
        self._show(feed)

    def tick(self) -> None:
        """Take in what came since the last tick, from the newest engine of this process or the recording."""
        if self.replay is None:
            self._follow_engines()
        if self.feed is not None:
            rows = self.feed.rows()
            if self.replay is not None and self.replay.jumped:
                self.history.clear()
                self.replay.jumped = False
            self._take(rows)
            if self.replay is None:
                self.faults.watch(self.history)
        elif len(self.history.rows):
            self._take(())
        if self._engine is not None:
            self._hear(self._engine)

    def _take(self, rows: Array | tuple[()]) -> None:
        """Add rows to the history; where none came, so many seconds it has been."""
        if len(rows):
            self.history.add(np.asarray(rows))
            self._heard = time.monotonic()
        self.history.wait(0.0 if self.replay is not None else time.monotonic() - self._heard)

    def _follow_engines(self) -> None:
        """Show the engine that runs, be it ours or one that a procedure has started."""
        if isinstance(self.feed, LiveFeed) and not self.feed.ended:
            return
        running = list(EngineProcess.running)
        if running:
            self._show(LiveFeed(running[-1], "live"))
        elif self.feed is not None:
            before = self.history
            self._show(None)
            self.history = before.left()

    def read(self, angles_rad: Mapping[str, float]) -> None:
        """Show what a procedure has read by itself, joint → its angle, torque off."""
        if self.feed is not None or not angles_rad:
            return
        if self.history.over or set(self.history.joints) != set(angles_rad):
            self.history = History(tuple(angles_rad), before=self.history)
        self._heard = time.monotonic()
        self.history.read(angles_rad, self._heard)
        self.history.wait(0.0)

    def _show(self, feed: Feed | None) -> None:
        if self.feed is not None:
            self.feed.close()
        before = None if self.replay is not None or isinstance(feed, ReplayFeed) else self.history
        self.feed = feed
        live, joints = isinstance(feed, LiveFeed), JOINT_NAMES if feed is None else feed.joints
        self.history = History(joints, self._bounds(), live=live, before=before)

    def _bounds(self) -> Mapping[str, tuple[float, float]]:
        """Between what this robot's observations were measured, while it is watched or replayed.

        A step that has the bus may be the one that measures them anew, or teach a leg where its ends are.
        """
        folder = self.folder
        if folder is None or (self._engine is None and self.replay is None):
            return {}
        try:
            return folder.config().observation
        except BadInput:
            return {}

    def _hear(self, engine: EngineProcess) -> None:
        try:
            for event in engine.events():
                if isinstance(event, Stopped):
                    self.faults.note(event.joint or "", f"stopped: {event.what}")
                elif isinstance(event, Notice):
                    self.notices.append(event.text)
            ended = engine.ended
        except HardwareFault:
            ended = True
        if ended:
            self.faults.note("", "the engine has ended; torque is off")
            with contextlib.suppress(HardwareFault):
                engine.close()  # or it would be followed for ever, and nobody could watch anew
            self._engine = None

    @property
    def learning(self) -> bool:
        return self.training is not None and self.training.running

    @property
    def computing(self) -> bool:
        """Whether a diagnosis is under way."""
        return self.diagnosing is not None and self.diagnosing.running

    def close(self) -> None:
        """Torque off, training saved, processes gone."""
        self._show(None)
        self.disconnect()
        for process in (self.training, self.diagnosing):
            if process is not None:
                process.close()
        self._virtual_process.close()
