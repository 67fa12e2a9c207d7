"""The robot itself as a Gymnasium environment: `gymnasium.make("openant/AntHardware-v0", robot="my-ant")`.

Timing contract: an action's commands leave with the next cycle of the engine and hold for `dt`, a whole number of
cycles; the observation returned is what the last of them measured. Who answers within a cycle (10 ms) has the next
action leave exactly `dt` after the last one. Who takes longer makes the period longer: that is measured from command to
command (`info["period_s"]`), counted (`info["overruns"]`) and told, and `info["dt"]` is the time that really passed.

What a robot cannot do is a truncation with a reason. What `comms.restart.RULES` lets begin again by itself, `reset` waits
for, and says what for; what has ended for good begins again by the builder's word alone, and `reset` raises until then. A
virtual robot has nobody beside it: one that walked out of the camera's view, fell or wound up its cable is put back after
a while, unless it is to be `unattended` as a real one. A policy that turns one way winds up the cable: before that is too
much, `reset` turns the robot back on the spot.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_env.base import AntBase, Observation, OnFall
from openant_env.link import RobotLink, engine_config, engine_rate
from openant_env.robots import simulated_robot
from openant_env.tasks import BackAndForth
from openant_env.turning import HALF_S, turning_action
from openant_tools.comms.restart import Interlock, MotionStopped, Restart, StopCause, longest_wait_s
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.files import read_toml
from openant_tools.numbers import exact, number, percent
from openant_tools.recording.run import Facts
from openant_tools.robot.derating import derating_of
from openant_tools.robot.folder import RobotFolder

__all__ = ["AntHardware"]

Array = NDArray[np.float64]

#: s for the legs to come to rest after the ramp to the start
SETTLE_S = 0.3
#: s without a sample of the IMU
IMU_PATIENCE_S = 0.5
#: s upside down: a robot that tumbles for a moment has not fallen
FALLEN_S = 1.0
#: m/s² along the body's z axis that a robot on its feet reads at least
UPRIGHT_M_S2 = 5.0
#: turns of the torso either way that a cable from above takes, and from which on `reset` turns it back
CABLE_TURNS, WINDING_TURNS = 2.0, 1.5
#: s for which turning back is tried; in simulation a turn and a half takes less than 8 (tests/env/test_turning.py)
TURN_BACK_S = 30.0
#: share of an engine's cycle by which a period may be too long before it counts as an overrun
LATE_SHARE = 0.5
#: K below the limit that stops a motion, to which a servo cools before it goes on
COOLED_K = 15.0
#: s of one look at a robot that is waited for, and between two words about the same trouble
LOOK_S, REPEAT_S = 0.25, 30.0
#: s after which someone is there who puts a virtual robot back
HELP_S = 5.0
#: after which a robot that was seen must not have been moved by hands, to stand up by itself
_SAME_POSE = (StopCause.SILENCE, StopCause.STALL)

_log = logging.getLogger("openant_env")


class AntHardware(AntBase):
    """A walking Open Ant on a floor under a camera, real or virtual, without episodes.

    Spaces, reward and info are those of `openant/Ant-v0` (`openant_env.ant`). In addition info holds `period_s` (s, from
    the last command to this one), `overruns` (steps so far that began late), `observation_age_s` (s, of joints, IMU and
    position, as of the step's end), `missed` (answers of servos that did not come in this step), `joint_temperatures`
    (°C), `joint_loads` (A or share of full load, as the servos measure) and `supply_v`; `derating`, the share of each joint's
    way from its rest that is left to it by the `[derating]` rules of robot.toml, 1 for a cool servo; `stop_cause` where a
    stop ended it, a `comms.restart.StopCause`; and `void` where that came in the way of a step: its action was not carried
    out, so that there is nothing to learn from it.

    Args:
        robot: a robot's folder (or its robot.toml). None only with `virtual`: an Ant as the guide says.
        virtual: a virtual robot in place of the ports of robot.toml: a scenario, the ready file of a running one, or
            "default". One that is started here stands on the floor where its scenario allows.
        clock: "real" or "stepped", of a virtual robot started here; None for stepped unless its scenario says otherwise.
        task, task_options, dt, action_range, observation_order, on_fall, time_limit_s: as in `openant_env.ant`. The
            circle's centre is that of robot.toml's `[arena]`, else where the robot stands first, unless `task_options`
            say otherwise.
        bus, imu, camera: in place of what robot.toml names.
        recordings: folder for the recording of every connection; None: `recordings/` of the robot's folder.
        record_pictures: these recordings hold the camera's pictures, too (JPEG, five a second at most).
        tag_patience_s: s without a pose, which keeps its last value meanwhile, after which the robot counts as lost.
        patience_s: s that `reset` waits for a robot that needs help before it gives up; None: for ever.
        attended: somebody is there who calls `resume` (as the space bar of our commands does): where motion has ended for
            good, `reset` waits for that instead of raising.
        unattended: nobody is there, nor comes: `reset` waits no longer than `comms.restart.longest_wait_s`, and a virtual robot
            is not put back.
        notice: called with what the user should know; default: the log.
        render_mode: None, or `"rgb_array"`: what the overhead camera sees.

    Raises:
        BadInput, HardwareFault: in one line, what is missing.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        *,
        robot: str | Path | None = None,
        virtual: str | None = None,
        clock: str | None = None,
        task: str = BackAndForth.name,
        task_options: Mapping[str, Any] | None = None,
        dt: float | None = None,
        action_range: str | None = None,
        observation_order: str = "platform",
        on_fall: OnFall = "truncate",
        time_limit_s: float | None = None,
        bus: str | None = None,
        imu: str | None = None,
        camera: str | int | None = None,
        recordings: str | Path | None = None,
        record_pictures: bool = False,
        tag_patience_s: float = 2.0,
        patience_s: float | None = None,
        attended: bool = False,
        unattended: bool = False,
        notice: Callable[[str], None] | None = None,
        render_mode: str | None = None,
    ) -> None:
        if robot is None and virtual is None:
            raise BadInput("no robot is named", remedy="give robot=DIR, or virtual='default' for a virtual one")
        super().__init__(
            simulated_robot(robot, effects=False),
            task=task, task_options=task_options, dt=dt, action_range=action_range, observation_order=observation_order,
            on_fall=on_fall, time_limit_s=time_limit_s,
        )  # fmt: skip
        if render_mode not in (None, "rgb_array"):
            raise BadInput(f"render mode {render_mode!r} does not exist here", remedy="use 'rgb_array' or None")
        self.render_mode = render_mode
        self._chosen_origin = "origin" in (task_options or {})
        centre = self.robot.arena.centre_m
        if centre is not None and not self._chosen_origin:
            self.origin = centre[0], centre[1]
        self._tag_patience_s = float(tag_patience_s)
        self._patience_s = math.inf if patience_s is None else float(patience_s)
        if attended and unattended:
            raise BadInput("a robot is attended or unattended", remedy="give one of them")
        self._attended, self._unattended = attended, unattended
        self._notice = notice or _log.warning
        self._interlock = Interlock("openant_env")
        #: why motion may begin again, where it was stopped
        self._restart: Restart | None = None
        self._stop_cause: StopCause | None = None
        self._said_why, self._remedy = "", "look at the robot"
        self._paused = threading.Event()
        self._why_paused = ""
        self._held = contextlib.ExitStack()
        folder = None if robot is None else RobotFolder.at(robot)
        described = None if folder is None else folder.config()
        self._derating = None
        if folder is not None:
            said = read_toml(folder.config_file)
            self._derating = derating_of(said, str(folder.config_file))
        rate_hz = engine_rate(self.dt)
        self._cycle_s = 1.0 / rate_hz
        try:
            found: Mapping[str, str | None] = {}
            if virtual is not None:
                found = self._held.enter_context(_virtual(virtual, clock))
            config = engine_config(
                described,
                rate_hz=rate_hz,
                bus=bus or found.get("bus"),
                imu=imu or found.get("imu"),
                camera=found.get("camera") if camera is None else camera,
                control=found.get("control"),
                folder=folder,
            )
            kept = recordings if recordings is not None else None if folder is None else folder.recordings
            facts = Facts(
                joints=self.robot.joints,
                setup="floor",
                protocol="walk",
                model=str(self.robot.model_path.resolve()),
                extra={"dt_s": self.dt, "rate_hz": rate_hz, "task": self.task.name},
            )
            self.link = RobotLink(
                config,
                recordings=None if kept is None else Path(kept),
                pictures=record_pictures,
                facts=facts,
                robot_toml=None if folder is None else folder.config_file.read_text(encoding="utf-8"),
                notice=self._notice,
            )
            self._held.callback(self.link.close)
            self.link.connect()
        except BaseException:
            self._held.close()
            raise
        self._bind()

    def _bind(self) -> None:
        """Look every name up once, and forget what was."""
        at, joints = self.link.columns, self.robot.joints
        index = np.zeros(len(self.layout), np.intp)
        for block in ("pos", "vel"):
            index[self.layout.slices[block]] = [at[f"{block}.{joint}"] for joint in joints]
        for block in ("acc", "gyro"):
            index[self.layout.slices[block]] = [at[f"{block}.{axis}"] for axis in "xyz"]
        direction = self.layout.slices["direction"]
        self._direction_at = direction.start
        index[direction] = at["t"]  # anything that is always there; the task fills it in
        self._index = index
        self._pose_at = [at["base.x"], at["base.y"], at["base.yaw"]]
        self._temp_at = [at[f"temp.{joint}"] for joint in joints]
        self._ok_at = [at[f"ok.{joint}"] for joint in joints]
        self._effort_at = [
            at[f"{'cur' if servo.model.has_current_sensor else 'load'}.{servo.joint}"]
            for servo in self.link.config.servos
        ]
        self._volt_at = [at[f"volt.{joint}"] for joint in joints]
        self._observation = np.full(len(index), np.nan)
        self._pose = np.full(3, np.nan)
        self._temps, self._efforts = np.full(len(joints), np.nan), np.full(len(joints), np.nan)
        self._volts = math.nan
        #: s, the robot's clock: of the last row, of its command, of the last pose and sample
        self._t = self._cmd_t = self._pose_t = self._imu_t = math.nan
        #: s, the host's clock: when the newest observation was made
        self._observed_at = time.monotonic()
        self._fallen_s = self._wound_rad = 0.0
        #: on its back or side, by most of the last look at one that is waited for
        self._lies = False
        #: turning back did not help
        self._tangled = False
        self._overruns = 0
        self._told_late = self._told_warm = -math.inf
        self._shares = np.ones(len(joints))
        #: joint → whether it is left to cool down
        self._cooling: dict[str, bool] = {}
        self._reason = ""
        self._ready = False

    # ---------------------------------------------------------------------------------------------- pause and resume

    def pause(self, why: str = "paused by hand") -> None:
        """End the step in progress with a truncation; `reset` then waits for `resume`. From any thread."""
        self._why_paused = why
        self._paused.set()

    def resume(self) -> None:
        """The builder's word that motion may go on, after a pause or an end for good; from any thread.

        Whoever gives it has looked at the robot, so its cable counts as unwound.
        """
        self._unwound()
        self._restart = self._interlock.word()
        self.link.forget_stop()
        self._paused.clear()

    @property
    def paused(self) -> bool:
        return self._paused.is_set()

    # ---------------------------------------------------------------------------------------------- reset and step

    @property
    def origin(self) -> tuple[float, float] | None:
        """Where the circle's centre is, m; None where there is no circle, or nobody has chosen one and the robot has not stood yet."""
        return (self.task.ox, self.task.oy) if self._chosen_origin and isinstance(self.task, BackAndForth) else None

    @origin.setter
    def origin(self, centre_m: tuple[float, float]) -> None:
        if isinstance(self.task, BackAndForth):
            (self.task.ox, self.task.oy), self._chosen_origin = centre_m, True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Have the robot stand where it is, after waiting for whatever it needs.

        Args:
            seed: of the reward direction.
            options: `direction_rad`, the first reward direction; `resume`, True for the builder's word, see `resume`.

        Raises:
            MotionStopped: motion has ended for good, and nobody has said that it may go on.
            HardwareFault: it still needs help after `patience_s`.
        """
        super().reset(seed=seed)
        chosen = options or {}
        unknown = set(chosen) - {"direction_rad", "resume"}
        if unknown:
            raise BadInput(
                f"no such reset option on a robot: {sorted(unknown)[0]}",
                remedy="direction_rad or resume; a robot stands where it is",
            )
        word = chosen.get("resume", False)
        if not isinstance(word, bool):
            raise BadInput(f"the reset option resume is {word!r}", remedy="True, where you have looked at the robot")
        if word:
            self.resume()
        self._stand_up()
        x, y, yaw = self._pose.tolist()
        if not self._chosen_origin:
            self.origin = x, y
        self.task.reset(x, y, self.np_random, chosen.get("direction_rad"))
        self.average_reward.clear()
        self._seconds, self._cmd_t, self._reason = 0.0, math.nan, ""
        self._ready = True
        hx, hy = math.cos(yaw), math.sin(yaw)
        return self._observe(hx, hy), self._info(x, y, hx, hy, self._observation) | self._more(0.0, 0)

    def step(self, action: NDArray[Any]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command the joints for `dt` seconds; see the class.

        Raises:
            BadInput: the action has another shape or is not finite, or the environment was not reset.
        """
        if not self._ready:
            raise BadInput("the robot does not stand yet", remedy="reset the environment first")
        chosen_at = time.monotonic()
        self._set_command(action)
        self._derate()
        before = self._t
        try:
            rows, number = self.link.go(self._command, self.dt, (self._observed_at, chosen_at))
        except HardwareFault as fault:
            return self._stopped(str(fault), _cause(fault), fault)
        mine = rows[rows[:, self.link.columns["goal"]] == number]
        if not len(mine):
            return self._stopped("the engine played nothing of this step", StopCause.STALL)
        self._take(rows)
        period = self._timed(float(mine[0, self.link.columns["cmd_t"]]))
        elapsed = self._t - before
        self._seconds += elapsed
        x, y, yaw = self._pose.tolist()
        reward = self.task.reward(x, y)
        self.average_reward.add(reward, elapsed)
        hx, hy = math.cos(yaw), math.sin(yaw)
        observation = self._observe(hx, hy)
        missed = int((rows[:, self._ok_at] == 0.0).sum())
        info = self._info(x, y, hx, hy, self._observation) | {"dt": elapsed} | self._more(period, missed)
        terminated, truncated = self._judge(elapsed, info)
        if terminated or truncated:
            self._reason, self._ready = info["reason"], False
        return observation, reward, terminated, truncated, info

    @property
    def real_time(self) -> bool:
        """Whether the robot goes on while an agent chooses: all but a virtual one whose time is stepped."""
        return not self.link.stepped

    def render(self) -> NDArray[np.uint8] | None:
        """The overhead camera's newest picture, (height, width, 3), at most 640 wide; None without `rgb_array`.

        Raises:
            HardwareFault: the camera has not sent one.
        """
        if self.render_mode is None:
            return None
        picture = self.link.picture()
        if picture is None:
            raise HardwareFault("the overhead camera has not sent a picture yet", remedy="reset the environment first")
        return picture

    def _derate(self) -> None:
        """Let a servo that is warm go less far from its rest, so that it cools instead of shutting down."""
        if self._derating is None:
            return
        share = self._derating.share(dict(zip(self.robot.joints, self._temps.tolist(), strict=True)))
        self._shares = np.array([share[joint] for joint in self.robot.joints])
        self._command[:] = self.actions.rest + self._shares * (self._command - self.actions.rest)
        if self._shares.min() < 1.0 and self._t - self._told_warm > REPEAT_S:
            self._told_warm = self._t
            joint = int(self._shares.argmin())
            self._notice(
                f"{self.robot.joints[joint]} is at {number(self._temps[joint], '°C', decimals=0)}: it goes {percent(self._shares[joint])} of "
                "the way that it is told"
            )

    def _stopped(
        self, why: str, cause: StopCause, fault: HardwareFault | None = None
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """A step that torque off ended: what was seen last stands in, and no reward is given for it."""
        self._reason, self._ready = why, False
        self._ended_by(cause, why, fault)
        self._seconds += self.dt
        x, y, yaw = self._pose.tolist()
        hx, hy = math.cos(yaw), math.sin(yaw)
        info = self._info(x, y, hx, hy, self._observation) | self._more(math.nan, 0) | {
            "reason": why, "stop_cause": cause.value, "void": True,
        }  # fmt: skip
        return self._observation.astype(np.float32), 0.0, False, True, info

    def _take(self, rows: Array) -> None:
        """The newest sound reading of everything; what did not come keeps its last."""
        at = self.link.columns
        for out, index in (
            (self._observation, self._index), (self._temps, self._temp_at), (self._efforts, self._effort_at)
        ):  # fmt: skip
            values = rows[:, index]
            newest = values[-1]
            if not np.isfinite(newest).all():
                newest = _last_sound(values)
            np.copyto(out, newest, where=np.isfinite(newest))
        pose = rows[:, self._pose_at]
        seen = np.flatnonzero(np.isfinite(pose).all(axis=1))
        if len(seen):
            turned = pose[seen[-1], 2] - self._pose[2]
            if math.isfinite(turned):
                self._wound_rad += math.remainder(turned, 2.0 * math.pi)
            self._pose = pose[seen[-1]].copy()
            self._pose_t = float(rows[seen[-1], at["base_t"]])
        sampled = rows[np.isfinite(rows[:, at["acc.x"]])]
        if len(sampled):
            self._imu_t = float(sampled[-1, at["imu_t"]])
        volts = rows[-1, self._volt_at]
        if np.isfinite(volts).any():
            self._volts = float(np.nanmean(volts))
        self._t = float(rows[-1, at["t"]])

    def _timed(self, cmd_t: float) -> float:
        """s from the last step's command to this one's; what is too long is counted and told."""
        period, self._cmd_t = cmd_t - self._cmd_t, cmd_t
        if not math.isfinite(period):
            return self.dt  # the first step since a reset follows no command
        if period > self.dt + LATE_SHARE * self._cycle_s:
            self._overruns += 1
            if cmd_t - self._told_late > REPEAT_S:
                self._told_late = cmd_t
                self._notice(
                    f"a step took {number(period, 's')} instead of {number(self.dt, 's')}, the {self._overruns}. late one: "
                    "this computer is busy"
                )
        return period

    def _judge(self, elapsed: float, info: dict[str, Any]) -> tuple[bool, bool]:
        """Whether the step ended it, terminated and truncated; the reason goes into info."""
        up = self._observation[self.layout.slices["acc"]][2]
        self._fallen_s = self._fallen_s + elapsed if up < 0.0 else 0.0
        lost, silent = self._t - self._pose_t, self._t - self._imu_t
        if self._fallen_s >= FALLEN_S and self._on_fall != "ignore":
            self.link.release()
            self._truncate(info, StopCause.FALL, "the robot lies on its back")
            return self._on_fall == "terminate", self._on_fall == "truncate"
        if lost > self._tag_patience_s:
            self._truncate(
                info, StopCause.TAG, f"the camera has not seen the robot for {number(lost, 's', decimals=1)}"
            )
        elif silent > IMU_PATIENCE_S:
            self._truncate(info, StopCause.IMU, f"the IMU has sent nothing for {number(silent, 's', decimals=1)}")
        elif self._wound:
            self._truncate(info, StopCause.CABLE, self._winding)
        elif self._turns > WINDING_TURNS:
            self._truncate(info, StopCause.WINDING, f"{self._winding}, and is turned back")
        elif self._paused.is_set():
            info["reason"], info["stop_cause"] = self._why_paused, StopCause.BY_HAND.value
        elif self._seconds >= self._time_limit_s - 0.5 * self.dt:
            info["reason"] = "time limit"
        return False, "reason" in info

    def _truncate(self, info: dict[str, Any], cause: StopCause, why: str) -> None:
        info["reason"], info["stop_cause"] = why, cause.value
        self._ended_by(cause, why)

    def _ended_by(self, cause: StopCause, why: str, fault: HardwareFault | None = None) -> None:
        """What the table makes of a stop."""
        self._remedy = "look at the robot"
        if fault is not None:
            why = f"{fault.where}: {fault.what}" if fault.where else fault.what
            self._remedy = fault.remedy or self._remedy
        self._stop_cause, self._said_why = cause, why
        if cause is StopCause.HARDWARE_ERROR:
            return  # counted for each servo that is rebooted
        if self.link.virtual and not self._unattended and cause in (StopCause.FALL, StopCause.CABLE):
            self._restart = Restart()  # who puts it back gives the word
            return
        self._restart = self._interlock.stopped(cause, why, self.link.now())

    def _observe(self, hx: float, hy: float) -> Observation:
        at = self._direction_at
        self._observation[at], self._observation[at + 1] = self.task.observed_direction(hx, hy)
        self._observed_at = time.monotonic()
        return self._observation.astype(np.float32)

    def _more(self, period: float, missed: int) -> dict[str, Any]:
        """What only a robot has to say."""
        waited = 0.0 if self.link.stepped else max(0.0, time.monotonic() - self._t)
        return {
            "period_s": period,
            "overruns": self._overruns,
            "observation_age_s": {
                "joints": waited,
                "imu": self._t - self._imu_t + waited,
                "position": self._t - self._pose_t + waited,
            },
            "missed": missed,
            "joint_temperatures": self._temps.copy(),
            "joint_loads": self._efforts.copy(),
            "derating": self._shares.copy(),
            "supply_v": self._volts,
        }

    # ------------------------------------------------------------------------------------------------- getting it back

    def _stand_up(self) -> None:
        """Wait until nothing is in the way, saying what it is, and stand."""
        said, said_at, waited, helped_at = "", -math.inf, 0.0, 0.0
        began = self.link.now()
        while True:
            self._need_word()
            why = self._in_the_way()
            if why is None and self._stop_cause is StopCause.HARDWARE_ERROR and self._restart is None:
                # Its alert bit said so, but no servo owns to an error: no reboot was counted.
                self._restart = self._interlock.stopped(self._stop_cause, self._said_why, self.link.now())
            if why is None and not self._interlock.ended:
                try:
                    rows = self.link.stand(self.actions.rest, SETTLE_S, self._restart)
                    self._restart = None
                    self._take(rows)
                    why = self._unseen()
                    if why is None and self._turns > WINDING_TURNS:
                        why = self._turn_back()
                    if why is None:
                        break
                    self._let_down()  # it may wait for long
                except HardwareFault as fault:
                    why = str(fault)
                    self._reason = why
                    self._ended_by(_cause(fault), why, fault)
                    self.link.drop()
            self._need_word()
            why = why or self._why_paused
            if self._unattended and waited > (longest := longest_wait_s(self._stop_cause)):
                self._interlock.end(f"{why} (for {exact(longest / 60, 'min')}, and nobody is there)")
                self._need_word()
            if waited > self._patience_s:
                raise HardwareFault(f"the robot cannot go on: {why}", remedy="help it, and start again")
            kind = re.sub(r"\d+", "", why)[:24]  # of a servo that cools each degree is no news
            if kind != said or waited - said_at > REPEAT_S:
                self._notice(f"waiting: {why}")
                said, said_at = kind, waited
            hands = waited - helped_at > HELP_S and self._out_of_place and not self._unattended
            if hands and self.link.put_back():
                self._notice("the virtual robot is put back where it began")
                self._unwound()
                helped_at = waited
            self.link.look(LOOK_S)
            waited = self.link.now() - began
        if said:
            self._notice(f"going on after {number(waited, 's')}")
        self._fallen_s, self._stop_cause = 0.0, None

    def _turn_back(self) -> str | None:
        """Turn on the spot until the cable is not wound up any more; why not, in words, where that does not work."""
        self._notice(f"{self._winding}: turning back")
        way, wound_up = -math.copysign(1.0, self._wound_rad), abs(self._turns)
        half_s, began, k = max(1, round(HALF_S / self.dt)) * self.dt, self.link.now(), 0
        while self._wound_rad * way < 0.0:
            if self._paused.is_set():
                return self._why_paused
            if self.link.now() - began > TURN_BACK_S:
                self._tangled = True
                why = f"the cable was wound up by {number(wound_up, 'turns', decimals=1)}, and turning back left {number(self._turns, decimals=1)}"
                self._ended_by(StopCause.CABLE, why)
                return why
            self._stride(turning_action(self.robot.joints, way, k), half_s)
            k += 1
            up = self._observation[self.layout.slices["acc"]][2]
            self._fallen_s = self._fallen_s + half_s if up < 0.0 else 0.0
            if self._fallen_s >= FALLEN_S and self._on_fall != "ignore":
                self.link.release()
                return "the robot fell while it turned back"
            why_unseen = self._unseen()
            if why_unseen is not None:
                return why_unseen
        # Legs are led back in the air, where no foot sticks, and set down at once: by a ramp's time it has tipped over.
        for action in (turning_action(self.robot.joints, 0.0, k), np.zeros(len(self.robot.joints))):
            self._stride(action, half_s)
        self._notice(f"turned back in {number(self.link.now() - began, 's')}")
        self._take(self.link.stand(self.actions.rest, SETTLE_S))
        return self._unseen()

    def _stride(self, action: Array, seconds: float) -> None:
        """Go so for a while, less far where a servo is warm, and see what came of it."""
        self._set_command(action)
        self._derate()
        self._take(self.link.go(self._command, seconds)[0])

    def _need_word(self) -> None:
        """Where motion has ended for good: have whoever is there asked, or refuse."""
        if not self._interlock.ended:
            return
        why = f"motion has ended for good: {self._interlock.ended}"
        if not self._attended:
            self.link.let_down()
            raise MotionStopped(
                why,
                remedy=f"{self._remedy}; then reset(options={{'resume': True}}), or start the command again",
                cause=self._stop_cause or StopCause.UNKNOWN,
            )
        if not self._paused.is_set():
            self.pause(f"{why}; look at the robot, then resume")

    def _let_down(self) -> None:
        """Have it lie down; a stop on the way is one like any other."""
        fault = self.link.let_down()
        if fault is not None:
            self._reason = str(fault)
            self._ended_by(_cause(fault), self._reason, fault)

    def _in_the_way(self) -> str | None:
        """Why the robot cannot stand up yet; what software can do about it has been done."""
        if self._paused.is_set():
            self._let_down()
            return self._why_paused
        try:
            if not self.link.connected or (self._reason and not self.link.standing):
                # After a stop everything is looked at anew: ids, registers, turns that a power cut has forgotten.
                self.link.connect()
                self._reason = ""
                if self._restart is not None and self._restart.cause in _SAME_POSE:
                    moved = self.link.moved()
                    if moved is not None:
                        self._interlock.end(moved)
                        return moved
            if self.link.standing and not self._reason:
                return None
            rows = self.link.look(LOOK_S)
            if rows is None or not len(rows):
                return "the robot does not answer"
            self._take(rows)
            # A robot that is set down is thrown about for a moment; one that lies does so for most of a look.
            up = rows[:, self.link.columns["acc.z"]]
            self._lies = bool(np.isfinite(up).any() and np.nanmedian(up) < UPRIGHT_M_S2)
            return self._trouble()
        except HardwareFault as fault:
            if _cause(fault) is StopCause.STORAGE:
                self._ended_by(StopCause.STORAGE, str(fault), fault)
            self.link.drop()
            return str(fault)

    @property
    def _out_of_place(self) -> bool:
        """Whether it takes hands to go on: the robot lies on its back or side, is wound up, or stands out of view."""
        return not self._paused.is_set() and (self._lying or self._wound or not self._seen)

    @property
    def _lying(self) -> bool:
        return self._lies and self._on_fall != "ignore"

    @property
    def _turns(self) -> float:
        """By which the cable is wound up, either way."""
        return abs(self._wound_rad) / (2.0 * math.pi)

    @property
    def _winding(self) -> str:
        return f"the cable is wound up by {number(self._turns, 'turns', decimals=1)} to the {'left' if self._wound_rad > 0 else 'right'}"

    @property
    def _wound(self) -> bool:
        return self._tangled or self._turns > CABLE_TURNS

    def _unwound(self) -> None:
        """Somebody has looked after the cable."""
        self._wound_rad, self._tangled = 0.0, False

    @property
    def _seen(self) -> bool:
        return self._t - self._pose_t < self._tag_patience_s

    def _trouble(self) -> str | None:
        """What the servos and sensors of a robot have to say against its standing up."""
        hot = self._hot()
        if hot is not None:
            self._let_down()
            return hot
        errors = self.link.errors()
        if errors:
            for joint in errors:
                self._stop_cause = StopCause.HARDWARE_ERROR
                why = f"{joint} has shut itself down again after its reboot"
                self._restart = self._interlock.stopped(self._stop_cause, why, self.link.now(), joint)
                if self._restart is None:
                    return why
            self.link.reboot(list(errors))
            return f"{', '.join(errors)} had shut down, and are started again"
        if self._wound:
            self._let_down()
            why = f"{self._winding}: turn the robot back by hand, in the camera's view"
            self._ended_by(StopCause.CABLE, why)
            return why
        if self._lying:
            self.link.release()
            why = "the robot lies on its back or side: put it on its feet"
            self._ended_by(StopCause.FALL, why)
            return why
        unseen = self._unseen()
        if unseen is not None:
            self._let_down()
        return unseen

    def _hot(self) -> str | None:
        guards = self.link.config.guards
        if guards.temperature_margin_k is None:
            return None
        for servo, temperature in zip(self.link.config.servos, self._temps.tolist(), strict=True):
            limit = self.link.limits_c[servo.joint] - guards.temperature_margin_k
            cooled = limit - COOLED_K
            tripped = self._cooling.get(servo.joint, False)
            self._cooling[servo.joint] = temperature >= (cooled if tripped else limit - 1.0)
            if self._cooling[servo.joint]:
                return f"{servo.joint} is at {number(temperature, '°C', decimals=0)}, and cools down to {number(cooled, '°C', decimals=0)}"
        return None

    def _unseen(self) -> str | None:
        """Which reading is missing, so that there is nothing to learn from."""
        if not self._seen:
            return "the camera does not see the robot: look at light, focus, and both tags in view"
        if not self._t - self._imu_t < IMU_PATIENCE_S:
            return "the IMU sends nothing: look at its cable"
        if not np.isfinite(self._observation).all():
            missing = self.layout.names[int(np.flatnonzero(~np.isfinite(self._observation))[0])]
            return f"there is no reading of {missing}"
        return None

    def close(self) -> None:
        """Lay the robot down, torque off, recording closed; a virtual robot that was started here ends."""
        self._ready = False
        self._held.close()


def _cause(fault: HardwareFault) -> StopCause:
    return fault.cause if isinstance(fault, MotionStopped) else StopCause.UNKNOWN


def _last_sound(values: Array) -> Array:
    """The last finite value of every column, NaN where there is none."""
    sound = np.isfinite(values)
    last = len(values) - 1 - np.argmax(sound[::-1], axis=0)
    out: Array = np.where(sound.any(axis=0), values[last, np.arange(values.shape[1])], np.nan)
    return out


@contextlib.contextmanager
def _virtual(source: str, clock: str | None) -> Any:
    """What the ready file of the virtual robot says; one started here is put on the floor where that is possible."""
    from openant_tools.virtual.process import clock_of_its_own, placeable, placed, virtual_robot

    if source.endswith(".toml") and not Path(source).is_file():
        remedy = "name a scenario (NAME.toml) or a ready file, or 'default' for a healthy robot"
        raise BadInput("there is no such scenario", where=source, remedy=remedy)
    with contextlib.ExitStack() as stack:
        if placeable(source):
            given = clock_of_its_own(source) if clock is None else clock
            source = stack.enter_context(placed(source, "floor", 0.0))
            clock = given
        yield stack.enter_context(virtual_robot(source, clock=clock))
