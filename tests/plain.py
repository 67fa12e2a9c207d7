"""Playing a run table in plain MuJoCo: nothing of ours but the files, by the letter of formats, sections 1 and 5."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: a group that nothing else uses: its actuators can be disabled one by one
LIMP = 29


@dataclass(frozen=True)
class Table:
    """The columns of a run table and the facts beside it."""

    columns: dict[str, Array]
    facts: dict[str, Any]

    @property
    def t(self) -> Array:
        return self.columns["t"]

    def column(self, name: str, default: float = np.nan) -> Array:
        return self.columns.get(name, np.full(len(self.t), default))


def read_table(path: Path) -> Table:
    table = pyarrow.parquet.read_table(path) if path.suffix == ".parquet" else pyarrow.csv.read_csv(path)
    columns = {
        name: np.array(table[name].to_numpy(zero_copy_only=False), float)
        for name in table.column_names
        if not name.startswith("err.")
    }
    return Table(columns, json.loads(path.with_suffix(".json").read_text()))


def on_floor(path: Path) -> Any:
    return mujoco.MjModel.from_xml_path(str(path))


def on_stand(path: Path) -> Any:
    """The free joint is removed, and no geom of the world touches anything.

    A torso without its free joint is welded to the world, and MuJoCo filters contacts between a body and its parent only
    where the parent is not: what hangs on the torso is excluded by name, as it was filtered before.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    for key in list(spec.keys):
        spec.delete(key)
    for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
        rigid = [joint.parent]
        while rigid:
            body = rigid.pop()
            for child in body.bodies:
                if child.joints:
                    for one in _rigid_with(joint.parent):
                        spec.add_exclude(bodyname1=one.name, bodyname2=child.name)
                else:
                    rigid.append(child)
        spec.delete(joint)
    for geom in spec.worldbody.geoms:
        geom.contype = geom.conaffinity = 0
    return spec.compile()


def _rigid_with(body: Any) -> list[Any]:
    return [body] + [other for child in body.bodies if not child.joints for other in _rigid_with(child)]


def actuator_of(model: Any, joint: str) -> int:
    """The actuator named like the joint, else the one that drives it."""
    named = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, joint)
    if named >= 0:
        return int(named)
    return int(np.flatnonzero(model.actuator_trnid[:, 0] == model.joint(joint).id)[0])


def play(model: Any, table: Table, joints: list[str], velocities: Array | None = None) -> Array:
    """Simulated `pos.J` at the rows, (rows, joints), interpolated between the steps.

    Args:
        velocities: (joints,) rad/s at the start; default at rest.
    """
    model.actuator_group[:] = 0
    data = mujoco.MjData(model)
    t, h = table.t, model.opt.timestep
    command = np.stack([table.column(f"cmd.{joint}") for joint in joints], axis=1)
    sent = np.where(np.isnan(table.column("cmd_t")), t, table.column("cmd_t"))
    limp = np.stack([table.column(f"torque.{joint}", 1.0) for joint in joints], axis=1) == 0
    actuators = [actuator_of(model, joint) for joint in joints]
    if "base.x" in table.columns and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        place = [f"base.{axis}" for axis in ("x", "y", "z", "qw", "qx", "qy", "qz")]
        data.qpos[:7] = [table.column(name)[0] for name in place]
    for j, joint in enumerate(joints):
        data.joint(joint).qpos = table.column(f"pos.{joint}")[0]
        data.joint(joint).qvel = 0.0 if velocities is None else velocities[j]
        i = actuators[j]
        data.ctrl[model.actuator_ctrladr[i]] = command[0, j]
        filters = (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
        if model.actuator_dyntype[i] in filters:
            data.act[model.actuator_actadr[i]] = command[0, j]
        if model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_PID and model.actuator_dynprm[i, 1] > 0:
            data.act[model.actuator_actadr[i]] = command[0, j]
        if model.actuator_history[i, 0]:
            filled = np.full((model.actuator_history[i, 0], 1), command[0, j])
            mujoco.mj_initCtrlHistory(model, data, i, None, filled)
    times = t[0] + h * np.arange(int((t[-1] - t[0]) / h) + 2)
    encoder = np.empty((len(times), len(joints)))
    order = 0
    for step, now in enumerate(times):
        while order < len(t) and sent[order] <= now + h / 2:  # the step that begins nearest to when it was sent
            for j, i in enumerate(actuators):
                if not np.isnan(command[order, j]):
                    data.ctrl[model.actuator_ctrladr[i]] = command[order, j]
            order += 1
        at = max(0, np.searchsorted(t, now + 1e-9, side="right") - 1)
        model.opt.disableactuator = 1 << LIMP if limp[at].any() else 0
        for j, i in enumerate(actuators):
            model.actuator_group[i] = LIMP if limp[at, j] else 0
        mujoco.mj_step(model, data)
        # Sensors show the state in which the step began.
        encoder[step] = [data.sensor(f"pos.{joint}").data[0] for joint in joints]
    return np.stack([np.interp(t, times, column) for column in encoder.T], axis=1)


def gap(table: Table, simulated: Array, joints: list[str]) -> float:
    """Root mean square of measured minus simulated, rad."""
    error = np.stack([table.column(f"pos.{joint}") for joint in joints], axis=1) - simulated
    return float(np.sqrt(np.nanmean(error**2)))
