"""A signal of the log is older than its row says."""

from __future__ import annotations

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.effect import Effect, Ints, Scope, Values, amount
from openant_tools.effects.robot import Robot

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    for signal in ("pos", "vel", "imu"):
        robot.log_delay[signal] = robot.log_delay.get(signal, 0.0) + values[signal]


def _write_encoder(document: Document, j: int) -> None:
    for signal in ("pos", "vel"):
        document.delayed(document.encoder(signal, j), document.robot.log_delay.get(signal, 0.0))


def _write_imu(document: Document) -> None:
    delay = document.robot.log_delay.get("imu", 0.0)
    for sensor in document.inertial() if delay > 0 else ():
        document.delayed(sensor, delay)


effect = Effect(
    name="sensor_delay",
    family="timing",
    words="a signal is logged later than it was measured",
    scopes=(Scope.ALL, Scope.BODY),
    # A healthy servo's velocity register is a filtered one, and low-pass filters (25 Hz) make a gyroscope late.
    quantities=(
        amount("pos", "s", 0.004, 0.06),
        amount("vel", "s", 0.012, 0.08, tolerance=0.012),
        amount("imu", "s", 0.004, 0.06, tolerance=0.007),
    ),
    enter=_enter,
    native=True,
    writer=Writer(90, joint=_write_encoder, body=_write_imu),
    told=True,
    vector=True,
    unseen=frozenset({"vel", "imu"}),
    stated=lambda values, reference, joints: {
        f"{signal}.delay_s": value for signal, value in values.items() if value > 0
    },
    restored=lambda given, x, reference, joints: {
        signal: given.get(f"{signal}.delay_s", 0.0) for signal in ("pos", "vel", "imu")
    },
)
