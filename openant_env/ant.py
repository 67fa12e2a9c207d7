"""The simulated Open Ant as a Gymnasium environment: `gymnasium.make("openant/Ant-v0")`.

A step of this environment is one call of `mj_step` over all its physics steps, one gather from the sensor readings,
and a microsecond of plain arithmetic: it costs little more than the physics alone (benchmarks/env_speed.py).

Timing contract: an action becomes the servos' commands at once and holds for `dt`; the observation returned is
what the sensors read at the last physics step of that time, all at the same instant.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_env.base import AntBase, Observation, OnFall, unit
from openant_env.randomise import Randomiser, intervals_of
from openant_env.rendering import Painter, Window
from openant_env.robots import DT_S, simulated_robot
from openant_env.tasks import BackAndForth
from openant_tools.effects.acting import Acting
from openant_tools.effects.commands import CommandPath
from openant_tools.errors import BadInput
from openant_tools.model.rollout import fill_setpoints
from openant_tools.numbers import exact, literal
from openant_tools.robot.folder import RobotFolder

__all__ = ["Ant"]

#: s that the robot stands before the first observation, so that it neither falls nor swings at reset.
SETTLE_S = 2.0
#: m/s and rad/s; a robot that moves faster than this after that time does not stand.
RESTLESS = 0.5
#: m, how far beyond its circle a robot may be before the camera follows it; how far that stands from the circle's rim
ROOM_M, DISTANCE_M = 0.15, 1.0
#: m, from which the robot is let down onto the floor before it settles (the published simulation's start).
START_HEIGHT_M = 0.2

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class Ant(AntBase):
    """A walking Open Ant on a floor, without episodes.

    Actions: (8,) in −1…1, one a joint, mapped onto `action_range` and kept within the calibrated limits.
    Observations: (24,) float32 in the order of `observation_names`; SI units, neither scaled nor clipped.
    Reward: m, the displacement along the reward direction (`openant_env.tasks`). An average reward per second of
    0.05 is a robot that walks 5 cm/s where it should.

    It ends only where a real robot would need help: `truncated` with `info["reason"]` once the robot lies on its back
    (`on_fall`), the physics has come apart, or `time_limit_s` has passed.

    Args:
        robot: a robot's folder (or its robot.toml); its calibrated model and limits are used. None: the bundled
            nominal robot.
        kit: `"standard"` or `"lite"`, which nominal robot.
        task: `"back-and-forth"` or `"forward"`.
        task_options: for back-and-forth `radius_m`, `origin`, `scored` (`"paper"` or `"platform"`).
        dt: s, the time of one step; a whole number of the model's timesteps. None: as the robot's folder says, 0.12.
        action_range: `"paper"`, `"platform"`, `"sac"`, `"sarsa"` or `"limits"` (`openant_env.actions`). None: as the
            robot's folder says, which is the paper's unless changed.
        observation_order: `"platform"` or `"paper"` (`openant_env.observations`).
        effects: which of the robot's `[[effect]]` entries act: True (all that are enabled), False, or their names.
        randomise: at every reset another robot, drawn from the intervals of the identification in robot.toml
            (`openant_env.randomise`).
        on_fall: what lying on the back means: `"truncate"`, `"terminate"`, or `"ignore"`.
        time_limit_s: s after which to truncate; None: never.
        render_mode: None, `"rgb_array"`, or `"human"`: MuJoCo's viewer, which shows each step in its own time.
        width, height: pixels of a rendered picture.

    Raises:
        BadInput: in one line, what of the robot's folder or of the arguments cannot be used.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": round(1.0 / DT_S)}  # noqa: RUF012

    def __init__(
        self,
        *,
        robot: str | Path | None = None,
        kit: str | None = None,
        task: str = BackAndForth.name,
        task_options: Mapping[str, Any] | None = None,
        dt: float | None = None,
        action_range: str | None = None,
        observation_order: str = "platform",
        effects: bool | Sequence[str] = True,
        randomise: bool = False,
        on_fall: OnFall = "truncate",
        time_limit_s: float | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
    ) -> None:
        self._arguments = {
            "robot": robot, "kit": kit, "task": task, "task_options": task_options, "dt": dt,
            "action_range": action_range, "observation_order": observation_order, "effects": effects,
            "randomise": randomise, "on_fall": on_fall, "time_limit_s": time_limit_s, "render_mode": render_mode, "width": width,
            "height": height,
        }  # fmt: skip
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise BadInput(f"render mode {render_mode!r} does not exist", remedy="use 'human', 'rgb_array' or None")
        super().__init__(
            simulated_robot(robot, kit=kit, effects=effects),
            task=task, task_options=task_options, dt=dt, action_range=action_range, observation_order=observation_order,
            on_fall=on_fall, time_limit_s=time_limit_s,
        )  # fmt: skip
        self._plant = self.robot.load()
        self._randomiser: Randomiser | None = None
        if randomise:
            if self.robot.folder is None:
                raise BadInput(
                    "the nominal robot was not identified: there are no intervals to draw from",
                    remedy="name a robot whose folder has a fit, or leave randomise out",
                )
            folder = RobotFolder(self.robot.folder)
            self._randomiser = Randomiser(self._plant, intervals_of(folder, folder.config()), self.robot.effects)
        self.model: mujoco.MjModel = self._plant.model
        # MuJoCo would start a simulation that has come apart afresh without a word.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.data = mujoco.MjData(self.model)
        self._substeps = _whole_steps(self.dt, self.model.opt.timestep, self.robot.model_path)
        self._take_effects()
        self.render_mode = render_mode
        self._size = (width, height)
        self._painter: Painter | None = None
        self._bind()
        self._settled = self._settle()
        self._window = Window(self.model, self.data, self.dt) if render_mode == "human" else None

    def _bind(self) -> None:
        """Look every name up once, and keep views into the simulation's memory, which never moves."""
        model, data, joints = self.model, self.data, self.robot.joints
        where = self.robot.model_path
        self._setpoints = self._plant.ctrl
        self._free_qpos, torso = _free_body(model, where)
        self._ctrl = data.ctrl
        self._sensordata = data.sensordata
        self._torso_position = data.xpos[torso]
        self._torso_rotation = data.xmat[torso]

        index = np.zeros(len(self.layout), np.intp)
        index[self.layout.slices["pos"]] = [_sensor(model, f"pos.{joint}", 1, where) for joint in joints]
        index[self.layout.slices["vel"]] = [_sensor(model, f"vel.{joint}", 1, where) for joint in joints]
        for block, name in (("acc", "accelerometer"), ("gyro", "gyro")):
            index[self.layout.slices[block]] = _sensor(model, name, 3, where) + np.arange(3)
        self._sensor_index = index
        self._observation = np.zeros(len(index))
        self._direction_at = self.layout.slices["direction"].start

    def _take_effects(self) -> None:
        """What acts beside the model: between its steps, on the way of commands, and in sensors."""
        robot, timestep, sensing = self.robot, self.model.opt.timestep, self.robot.sensing
        stepped = bool(robot.effects) or robot.commands is not None
        effects = robot.effects if self._randomiser is None else self._randomiser.effects
        self._acting = Acting(self._plant, self.data, effects) if stepped else None
        self._path = None if robot.commands is None else CommandPath(robot.commands, timestep)
        self._bias: NDArray[np.float64] | None = None
        if sensing is not None and (sensing.gyro_bias.any() or sensing.acc_bias.any()):
            self._bias = np.zeros(len(self.layout))
            self._bias[self.layout.slices["gyro"]] = sensing.gyro_bias
            self._bias[self.layout.slices["acc"]] = sensing.acc_bias
        self._tracker = sensing if sensing is not None and sensing.tracks_wrong else None
        # The pose that the tracker tells is so many steps of the environment and of the physics old.
        late = 0 if self._tracker is None else round(self._tracker.latency_s / timestep)
        steps_late = late // self._substeps
        self._late = late % self._substeps
        self._poses: deque[tuple[float, float, float, float]] = deque(maxlen=steps_late + 1)
        self._plain = self._path is None and self._tracker is None

    def _become(self) -> None:
        """Stand as the robot that was drawn."""
        self._take_effects()
        self._settled = self._settle()

    def _settle(self) -> NDArray[np.float64]:
        """The state of a robot that stands with the command of action 0: setpoint filters and delay buffers full."""
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        rest = self.actions.rest
        data.qpos[self._free_qpos : self._free_qpos + 3] = (0.0, 0.0, START_HEIGHT_M)
        data.qpos[self._plant.qpos] = rest
        fill_setpoints(self._plant, data, rest)
        self._advance(max(1, round(SETTLE_S / model.opt.timestep)))
        at_rest = np.abs(data.qvel).max() < RESTLESS  # false for NaN
        if not at_rest or self._torso_rotation[8] < 0.0:
            raise BadInput(
                "the robot does not come to stand in this model",
                where=self.robot.model_path,
                remedy="check masses, stiffness and the timestep",
            )
        data.qvel[:] = 0.0
        state = np.empty(mujoco.mj_stateSize(model, _STATE))
        mujoco.mj_getState(model, data, state, _STATE)
        return state

    # ---------------------------------------------------------------------------------------------- reset and step

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Stand the robot up at the circle's centre with a random heading.

        Args:
            seed: of the heading and of the reward direction.
            options: `heading_rad`, `position` (x, y in m) and `direction_rad` (the first reward direction) to choose
                them.
        """
        super().reset(seed=seed)
        if self._randomiser is not None:
            self._randomiser.draw(self.np_random)
            self._become()
        chosen = options or {}
        unknown = set(chosen) - {"heading_rad", "position", "direction_rad"}
        if unknown:
            raise BadInput(f"no such reset option: {sorted(unknown)[0]}", remedy="heading_rad, position, direction_rad")
        heading = chosen.get("heading_rad")
        if heading is None:
            heading = self.np_random.uniform(-math.pi, math.pi)
        x, y = chosen.get("position", (self.task.ox, self.task.oy) if isinstance(self.task, BackAndForth) else (0, 0))

        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        mujoco.mj_setState(model, data, self._settled, _STATE)
        free = self._free_qpos
        data.qpos[free : free + 2] = x, y
        # The settled robot may have turned by a hair: take its yaw out, then turn it to the chosen heading.
        w, qx, qy, qz = data.qpos[free + 3 : free + 7]
        turn = heading - math.atan2(2.0 * (w * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        turned = np.empty(4)
        yaw = np.array([math.cos(0.5 * turn), 0.0, 0.0, math.sin(0.5 * turn)])
        mujoco.mju_mulQuat(turned, yaw, data.qpos[free + 3 : free + 7].copy())
        data.qpos[free + 3 : free + 7] = turned
        mujoco.mj_forward(model, data)

        self._poses.extend([self._pose()] * (self._poses.maxlen or 0))
        if self._acting is not None:
            self._acting.reset()
        if self._path is not None:
            self._path.reset(self.actions.rest)
        x, y, hx, hy = self._pose()
        if self._tracker is not None:
            x, y, hx, hy = self._tracker.tracked(x, y, hx, hy)
        self.task.reset(x, y, self.np_random, chosen.get("direction_rad"))
        self.average_reward.clear()
        self._seconds = 0.0
        observation = self._observe(hx, hy)
        if self._window is not None:
            self._window.show()
        return observation, self._info(x, y, hx, hy, self._observation)

    def _advance_imperfectly(self) -> None:
        """A step in which commands scatter or a tracker is late."""
        before = self._substeps - self._late
        if self._path is None or self._acting is None:
            self._advance(before)
            self._poses.append(self._pose())
            self._advance(self._late)
            return
        setpoints = self._path.play(self._command, self._substeps, self.np_random)
        self._acting.play(setpoints[:before])
        self._poses.append(self._pose())
        self._acting.play(setpoints[before:])

    def _pose(self) -> tuple[float, float, float, float]:
        x, y, _ = self._torso_position.tolist()
        return x, y, *unit(self._torso_rotation[0], self._torso_rotation[3])

    def _advance(self, steps: int) -> None:
        if self._acting is None:
            mujoco.mj_step(self.model, self.data, nstep=steps)
        else:
            self._acting.step(steps)

    def step(self, action: NDArray[Any]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command the joints for `dt` seconds.

        Args:
            action: (8,), clipped to −1…1.

        Returns:
            Observation (24,), reward (m), terminated, truncated, and info: `position` (m), `heading` and
            `reward_direction` (unit vectors in the world), `average_reward_m_s` (over 120 s, since reset), `time_s`
            (since reset), `dt` (s, of this step), `reason` where it ended, and `out_of_bounds` (names) where an
            observation lies beyond what was measured on the robot. Everything is the caller's to keep.

        Raises:
            BadInput: the action has another shape, or is not finite.
        """
        self._set_command(action)
        self._ctrl[self._setpoints] = self._command
        if self._plain:
            self._advance(self._substeps)
        else:
            self._advance_imperfectly()
        self._seconds += self.dt

        x, y, z = self._torso_position.tolist()
        readings = self._sensordata
        if not math.isfinite(readings.dot(readings) + x + y + z):
            # The last sound observation stands in for what can no longer be measured; a learner must not see NaN.
            info = self._info(math.nan, math.nan, math.nan, math.nan, self._observation)
            info["reason"] = "the physics has come apart"
            return self._observation.astype(np.float32), 0.0, False, True, info
        forward_x, _, _, forward_y, _, _, _, _, up_z = self._torso_rotation.tolist()
        hx, hy = unit(forward_x, forward_y)
        if self._tracker is not None:
            x, y, hx, hy = self._tracker.tracked(*self._poses[0])
        reward = self.task.reward(x, y)
        self.average_reward.add(reward, self.dt)
        observation = self._observe(hx, hy)
        info = self._info(x, y, hx, hy, self._observation)
        if self._window is not None:
            self._window.show()
        terminated = truncated = False
        if up_z < 0.0 and self._on_fall != "ignore":
            terminated, truncated = self._on_fall == "terminate", self._on_fall == "truncate"
            info["reason"] = "the robot lies on its back"
        elif self._seconds >= self._time_limit_s - 0.5 * self.dt:
            truncated = True
            info["reason"] = "time limit"
        return observation, reward, terminated, truncated, info

    def _observe(self, hx: float, hy: float) -> Observation:
        observation = self._observation
        # mode="clip" lets numpy write into `out` without a buffer between; every index is in range.
        self._sensordata.take(self._sensor_index, out=observation, mode="clip")
        if self._bias is not None:
            observation += self._bias
        at = self._direction_at
        observation[at], observation[at + 1] = self.task.observed_direction(hx, hy)
        return observation.astype(np.float32)

    # --------------------------------------------------------------------------------------------------- pictures

    def render(self) -> NDArray[np.uint8] | None:
        """The robot, the reward direction, and the circle it turns at, (height, width, 3); None without `rgb_array`:
        the window of `human` is drawn by each step.

        The camera stays where the circle is, so that one sees the robot get on, and follows one that leaves it.

        Raises:
            NoOpenGL: there is nothing to draw with on this machine.
        """
        if self.render_mode != "rgb_array":
            return None
        if self._painter is None:
            # Without a graphics card the finest edges and shadows would take twice the time of a step and its picture.
            quality = self.model.vis.quality
            quality.offsamples, quality.shadowsize = min(2, quality.offsamples), min(1024, quality.shadowsize)
            self._painter = Painter(self.model, *self._size)
        x, y, z = self._torso_position.tolist()
        task = self.task
        more: dict[str, Any] = {}
        circle = (task.ox, task.oy, task.radius_m) if isinstance(task, BackAndForth) else None
        if circle is not None:
            ox, oy, radius = circle
            beyond = max(0.0, 1.0 - (radius + ROOM_M) / max(math.hypot(x - ox, y - oy), 1e-9))
            more = {"camera_at": (ox + beyond * (x - ox), oy + beyond * (y - oy), z), "distance_m": DISTANCE_M + radius}
        return self._painter.frame(self.data, look_at=(x, y, z), arrow=(task.ux, task.uy), circle=circle, **more)

    def close(self) -> None:
        """Give the OpenGL context back, and the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None
        if self._painter is not None:
            self._painter.close()
            self._painter = None

    # ------------------------------------------------------------------------------------------- going on elsewhere

    def get_state(self) -> dict[str, Any]:
        """All that a step depends on, as plain numbers, lists and arrays: `set_state` goes on from it bit for bit."""
        state = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, state, _STATE)
        return {
            "physics": state,
            "task": self.task.get_state(),
            "average_reward": self.average_reward.get_state(),
            "seconds": self._seconds,
            "observation": self._observation.copy(),
            "random": self.np_random.bit_generator.state,
            "effects": [] if self._acting is None else self._acting.get_state(),
            "commands": {} if self._path is None else self._path.get_state(),
            "poses": [list(pose) for pose in self._poses],
            "drawn": [] if self._randomiser is None else self._randomiser.drawn.tolist(),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on where `get_state` was called, in this process or in another.

        Raises:
            BadInput: the state is one of another model.
        """
        physics = np.asarray(state["physics"], np.float64)
        if physics.shape != self._settled.shape:
            raise BadInput(
                "this saved state belongs to another model",
                where=self.robot.model_path,
                remedy="use the model that it was saved with",
            )
        if self._randomiser is not None:
            self._randomiser.become(np.asarray(state["drawn"]))
            self._become()
        mujoco.mj_setState(self.model, self.data, physics, _STATE)
        mujoco.mj_forward(self.model, self.data)
        # mj_forward leaves a warm start of its own behind; the saved one makes the next step the same, bit for bit.
        mujoco.mj_setState(self.model, self.data, physics, _STATE)
        self.task.set_state(state["task"])
        self.average_reward.set_state(state["average_reward"])
        self._seconds = float(state["seconds"])
        self._observation[:] = np.asarray(state["observation"])
        self.np_random.bit_generator.state = state["random"]
        if self._acting is not None:
            self._acting.set_state(state["effects"])
        if self._path is not None:
            self._path.set_state(state["commands"])
        self._poses.extend(tuple(pose) for pose in state["poses"])

    def __getstate__(self) -> dict[str, Any]:
        return {"arguments": self._arguments, "spec": self.spec, "state": self.get_state()}

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        self.__init__(**pickled["arguments"])  # type: ignore[misc]
        self.spec = pickled["spec"]
        self.set_state(pickled["state"])


def _whole_steps(dt: float, timestep: float, where: Path) -> int:
    """How many physics steps a step of the environment takes.

    Raises:
        BadInput: dt is no whole number of them.
    """
    ratio = dt / timestep if timestep > 0.0 else math.nan
    steps = round(ratio) if math.isfinite(ratio) else 0
    if steps < 1 or abs(ratio - steps) > 1e-6 * steps:
        below = max(1, math.floor(ratio)) * timestep if math.isfinite(ratio) else timestep
        raise BadInput(
            f"dt = {exact(dt, 's')} is no whole number of the model's timestep of {exact(timestep, 's')}",
            where=where,
            remedy=f"use dt = {literal(below)} or {literal(below + timestep)}",
        )
    return steps


def _free_body(model: mujoco.MjModel, where: Path) -> tuple[int, int]:
    """Where the free joint's coordinates begin in qpos, and the body that it moves."""
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if len(free) != 1:
        raise BadInput(
            f"the model has {len(free)} free joints; a walking robot has one",
            where=where,
            remedy="give the torso a <freejoint/>",
        )
    return int(model.jnt_qposadr[free[0]]), int(model.jnt_bodyid[free[0]])


def _sensor(model: mujoco.MjModel, name: str, size: int, where: Path) -> int:
    """Where a sensor's reading begins in sensordata."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if index < 0 or model.sensor_dim[index] != size:
        raise BadInput(
            f"the model has no sensor {name} of {size} number{'s' if size > 1 else ''}",
            where=where,
            remedy="add a <gyro> and an <accelerometer> of these names at the IMU's site",
        )
    return int(model.sensor_adr[index])
