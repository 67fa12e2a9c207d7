"""Stand on a plate while the builder tilts it, and read the angle off the accelerometer: the live half of the friction
procedure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.messages import EngineConfig
from openant_tools.errors import BadInput
from openant_tools.procedure.journal import append_writes
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD
from openant_tools.sysid.bench.friction import BODY_UP, onset_angle, up_direction
from openant_tools.sysid.bench.heed import heed

__all__ = ["tilt_trials"]

Array = NDArray[np.float64]

#: what is read between two looks at the builder
SLICE_S = 0.5
#: at rest on the level plate
LEVEL_S = 1.0
#: a builder who does not come back: the knees have borne the robot long enough
LONGEST_S = 120.0


def tilt_trials(
    config: EngineConfig,
    trials: int,
    *,
    level: Callable[[], bool] = lambda: False,
    begin: Callable[[int], None] = lambda trial: None,
    ended: Callable[[float], bool],
    notice: Callable[[str], None] = lambda text: None,
    journal: Path | None = None,
) -> list[float]:
    """Angles (rad) at which the robot began to slide, one a trial; it stands at home with torque on.

    Args:
        config: with an IMU.
        level: called once the robot stands; True when the plate is level, so that its normal can be taken from there;
            False to take the body's own up.
        begin: called before each trial; returns when the builder begins to tilt.
        ended: called with the seconds of this trial; True when it has slid.

    Raises:
        BadInput: there is no IMU, or it does not read gravity at rest.
        HardwareFault: a guard stopped it; torque is off.
    """
    if config.imu is None:
        raise BadInput("no flight controller is known", remedy="name it in robot.toml, ports.imu, or type the angles")
    pose = np.array([HOME_RAD[JOINTS[servo.joint].kind] for servo in config.servos])
    angles: list[float] = []
    with EngineProcess(config) as engine:
        heed(engine, notice)
        if journal is not None:
            append_writes(journal, engine.description["eeprom_writes"], "sysid tilt")
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(pose))
        up = BODY_UP
        if level():
            engine.telemetry()  # what came before, while it stood up, says nothing of the plate
            up = up_direction(_sample(engine, LEVEL_S)[1])
        for trial in range(trials):
            begin(trial)
            heed(engine, notice)
            t: list[Array] = []
            acc: list[Array] = []
            seconds = 0.0
            engine.telemetry()
            while seconds < LONGEST_S and not ended(seconds):
                times, forces = _sample(engine, SLICE_S)
                t.append(times)
                acc.append(forces)
                seconds += SLICE_S
            if not t:
                raise BadInput("the trial ended before it began", remedy="tilt first, then press Enter")
            angles.append(onset_angle(np.concatenate(t), np.concatenate(acc), up))
        engine.ask(messages.Torque(False))
    return angles


def _sample(engine: EngineProcess, seconds: float) -> tuple[Array, Array]:
    """Times (n,) and specific force (n, 3) while holding for `seconds`."""
    engine.ask(messages.Hold(seconds))
    rows = engine.telemetry()
    columns = [engine.columns.index(f"acc.{axis}") for axis in "xyz"]
    return rows[:, engine.columns.index("t")], rows[:, columns]
