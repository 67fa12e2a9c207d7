"""Stand on a plate while the builder tilts it, and read the angle off the accelerometer: the friction procedure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from openant_tools.calib.wires import heard
from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.messages import EngineConfig
from openant_tools.errors import BadInput
from openant_tools.numbers import number
from openant_tools.procedure.step import Hands, Intent, Live, Procedure, Say, Subroutine
from openant_tools.procedure.unfinished import Parts
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD
from openant_tools.sysid.bench.friction import (
    BODY_UP,
    STEEPEST_RAD,
    Slope,
    checked,
    friction_finding,
    onset_angle,
    up_direction,
)

__all__ = ["floor_friction"]

Array = NDArray[np.float64]

#: what is read between two looks at the builder
SLICE_S = 0.5
#: at rest on the level plate, and what hands shake before
LEVEL_S, SETTLE_S = 1.0, 2.0
#: a builder who does not come back: the knees have borne the robot long enough
LONGEST_S = 120.0
#: rad; how far a virtual robot's hands tilt: a floor of friction 0.6 lets it slide there
SLIDES_RAD = math.atan(0.6)


def floor_friction(
    config: EngineConfig,
    trials: int,
    *,
    command: str,
    by_hand: bool = True,
    seconds: float = LONGEST_S,
    slid: bool = True,
    resolution_rad: float = math.radians(0.5),
    parts: Parts | None = None,
) -> Procedure:
    """The floor's friction by the angles at which the robot begins to slide; it stands at home with torque on.

    Args:
        config: with an IMU.
        by_hand: whether somebody is there who says when the plate is level and when the robot slides; else the body's own up
            counts as the plate's normal, and a trial takes `seconds`.
        seconds: of a trial at most.
        slid, resolution_rad: as `friction_finding` takes them.
        parts: the trials by name, `trials` of them, for who may leave in the middle.

    Raises:
        BadInput: there is no IMU, or it does not read gravity at rest.
        HardwareFault: a guard stopped it; torque is off.
    """
    if config.imu is None:
        raise BadInput("no flight controller is known", remedy="name it in robot.toml, ports.imu, or type the angles")
    yield Intent("stand up at home on the plate and hold itself there", moves=True)
    pose = np.array([HOME_RAD[JOINTS[servo.joint].kind] for servo in config.servos])
    before = {} if parts is None else parts.before
    slopes = [Slope(float(facts["angle_rad"]), "static") for facts in before.values()]
    with EngineProcess(config) as engine:
        yield from heard(engine)
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(pose))
        up = BODY_UP
        if by_hand:
            yield Hands("Hold the plate level and still.", "tilt", path_rad=(0.0, 0.0, 0.0))
            engine.ask(messages.Hold(SETTLE_S))
            engine.telemetry()  # what came before, while it stood up, says nothing of the plate
            up = up_direction(_sample(engine, LEVEL_S)[1])
        for trial in range(len(slopes) + 1, trials + 1):
            if by_hand:
                again = f"Trial {trial} of {trials}: turn the robot a little, plate level."
                yield Hands(again, "tilt", path_rad=(0.0, 0.0, 0.0))
                engine.ask(messages.Hold(SETTLE_S))
                words = "Tilt the plate slowly until it slides, then press Enter."
                yield Hands(words, "tilt", path_rad=(SLIDES_RAD, 0.0, 0.0), while_watching=True)
            angle = yield from _trial(engine, up, seconds)
            slopes.append(Slope(checked(angle, "the accelerometer"), "static"))
            if parts is not None:
                parts.done(parts.of[trial - 1], angle_rad=angle)
            yield Say(f"trial {trial}: {number(angle, 'rad')}, μ = {number(math.tan(angle))}", "ok")
        engine.ask(messages.Torque(False))
        if by_hand:
            yield Hands("Put it down level.", "tilt", path_rad=(0.0, 0.0, 0.0), while_watching=True)
    return friction_finding(slopes, command, source="accelerometer", resolution_rad=resolution_rad, slid=slid)


def _trial(engine: EngineProcess, up: Array, seconds: float) -> Subroutine[float]:
    """The angle (rad) at which it began to slide, read until the builder says so, for `seconds` at most."""
    t: list[Array] = []
    acc: list[Array] = []
    engine.telemetry()
    while len(t) * SLICE_S < seconds:
        yield from heard(engine)
        times, forces = _sample(engine, SLICE_S)
        t.append(times)
        acc.append(forces)
        now = np.nanmean(forces, axis=0) if np.isfinite(forces).any() else up
        along = float(np.arccos(np.clip(now @ up / np.linalg.norm(now), -1.0, 1.0)))
        slides = yield Live({"plate": along}, "rad", "Enter when it slides", {"plate": 0.0}, {"plate": STEEPEST_RAD})
        if slides is True:
            break
    return onset_angle(np.concatenate(t), np.concatenate(acc), up)


def _sample(engine: EngineProcess, seconds: float) -> tuple[Array, Array]:
    """Times (n,) and specific force (n, 3) while holding for `seconds`."""
    engine.ask(messages.Hold(seconds))
    rows = engine.telemetry()
    columns = [engine.columns.index(f"acc.{axis}") for axis in "xyz"]
    return rows[:, engine.columns.index("t")], rows[:, columns]
