"""From what a user names (a port, a robot's folder, a virtual robot) to what the engine needs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from openant_tools.comms.bus import Bus, BusTiming
from openant_tools.comms.clock import Clock, RealClock, SteppedClock, VirtualControl
from openant_tools.comms.line import SerialLine
from openant_tools.comms.messages import EngineConfig, ImuConfig
from openant_tools.comms.ports import Host
from openant_tools.comms.servos import Servo
from openant_tools.comms.silence import explaining
from openant_tools.comms.state import of_robot_toml
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.robot.config import RobotConfig
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import ANGLE_LIMIT_RAD, NOMINAL_ZERO_RAD, PLATFORM_PWM_LIMIT_COUNTS
from openant_tools.robot.servo import servo_model

if TYPE_CHECKING:
    from openant_tools.comms.body_camera import CameraConfig

__all__ = ["camera_of_robot", "config_of_robot", "config_of_unknown_robot", "find_bus", "imu_of_robot", "open_bus"]


def find_bus(port: str | None, robot: RobotConfig | None = None, host: Host | None = None) -> str:
    """The bus to use: the port named, else robot.toml's, else the one adapter that is plugged in.

    Raises:
        HardwareFault: there is none, or several.
    """
    if port:
        return port
    if robot is not None and robot.ports.bus:
        return str(robot.ports.bus)
    buses = [found for found in (host or Host()).ports() if found.kind == "bus"]
    if len(buses) == 1:
        return buses[0].stable_path
    if not buses:
        raise HardwareFault(
            "no U2D2 is plugged in", remedy="plug it in, name another adapter with --port, or use --virtual"
        )
    names = ", ".join(found.stable_path for found in buses)
    raise HardwareFault(f"several buses are plugged in: {names}", remedy="name one with --port")


def open_bus(port: str, baud: int, control: str | None = None) -> Bus:
    """A bus for tools that ask a few questions and own nothing: scan, calibration of loose motors."""
    remote = VirtualControl(control) if control else None
    line = SerialLine(port, baud)
    clock: Clock = RealClock(None if remote is None else remote.robot_pid)
    if remote is not None and remote.ask("now")["stepped"]:
        clock = SteppedClock(remote, bus=line)
    latency = Host().latency_timer_ms(port)
    return Bus(line, clock, BusTiming(latency_timer_s=BusTiming.latency_timer_s if latency is None else latency * 1e-3))


def imu_of_robot(robot: RobotConfig | None, port: str | None = None) -> ImuConfig | None:
    """The IMU at `port`, else at robot.toml's, mounted as that says; None where neither names one."""
    where = port or (str(robot.ports.imu) if robot is not None and robot.ports.imu else None)
    if where is None or robot is None:
        return None if where is None else ImuConfig(where)
    imu = robot.imu
    return ImuConfig(
        where, imu.mounting_rad, imu.gyro_bias_rad_s, imu.acc_bias_m_s2, imu.gyro_counts_per_dps, imu.acc_counts_per_g
    )


def camera_of_robot(robot: RobotConfig | None, source: str | int | None = None) -> CameraConfig | None:
    """The camera `source`, else robot.toml's, with that robot's lens and tags; None where neither names a camera.

    Raises:
        BadInput: nobody has said which tag the robot wears.
    """
    where = source if source is not None else "" if robot is None else robot.ports.camera
    if where == "":
        return None
    from openant_tools.comms.body_camera import CameraConfig
    from openant_tools.comms.camera import CameraSettings
    from openant_tools.comms.intrinsics import Intrinsics
    from openant_tools.comms.tags import TagSetup

    if robot is None:
        return CameraConfig(CameraSettings(where))
    seen = robot.camera
    if seen.body_tag_id < 0:
        raise BadInput(
            "camera.body_tag_id is not known yet", where="robot.toml", remedy="set it to the number of the robot's tag"
        )
    lens, parts = None, (seen.size_px, seen.focal_px, seen.centre_px)
    if any(part is not None for part in parts) and any(part is None for part in parts):
        remedy = "give camera.size_px, focal_px and centre_px together, or none of them"
        raise BadInput("the lens is described in part", where="robot.toml", remedy=remedy)
    if seen.size_px is not None and seen.focal_px is not None and seen.centre_px is not None:
        (width, height), (fx, fy), (cx, cy) = seen.size_px, seen.focal_px, seen.centre_px
        k1, k2, p1, p2, k3 = seen.distortion
        lens = Intrinsics(round(width), round(height), fx, fy, cx, cy, (k1, k2, p1, p2, k3), "robot.toml")
    x, y, z = seen.body_tag_position_m
    return CameraConfig(
        CameraSettings(where, exposure=seen.exposure, focus=seen.focus, latency_s=seen.latency_s),
        TagSetup(
            seen.tag_family, seen.origin_tag_id, seen.body_tag_id, seen.origin_tag_size_m, seen.body_tag_size_m,
            (x, y, z), seen.body_tag_yaw_rad,
        ),
        lens,
        math.degrees(seen.fov_diagonal_rad),
    )  # fmt: skip


def config_of_robot(robot: RobotConfig, port: str | None = None, **more: object) -> EngineConfig:
    """The engine's config for a robot that has a robot.toml; `more` goes to `EngineConfig`."""
    servos = tuple(
        Servo(motor.joint, motor.id, motor.servo, motor.direction, motor.zero_offset_rad)
        for motor in robot.motors.values()
    )
    pwm_limit = of_robot_toml(robot)["pwm_limit"]
    return EngineConfig(
        port=find_bus(port, robot),
        servos=servos,
        baud=robot.bus.baud,
        limits_rad={motor.joint: (motor.min_rad, motor.max_rad) for motor in robot.motors.values()},
        registers={servo.joint: {"pwm_limit": pwm_limit} for servo in servos},
        watchdog_s=robot.bus.watchdog_s,
        write_read_gap_s=robot.bus.write_read_gap_s,
        chain=robot.bus.chain,
        **more,  # type: ignore[arg-type]
    )


def config_of_unknown_robot(port: str, control: str | None = None, **more: object) -> EngineConfig:
    """The engine's config for an Ant that nobody has described: the guide's ids, models as they answer, kit limits.

    Raises:
        HardwareFault: not all eight answer at 1 Mbaud.
    """
    bus = open_bus(port, 1_000_000, control)
    try:
        bus.names = {joint.id: joint.name for joint in JOINTS.values()}
        found = {joint.name: bus.ping(joint.id, insist=True) for joint in JOINTS.values()}
        with explaining(bus):
            bus.require_all({JOINTS[name].id: seen is not None for name, seen in found.items()})
        servos = tuple(
            Servo(name, seen.id, servo_model(seen.model_number), 1, NOMINAL_ZERO_RAD)
            for name, seen in found.items()
            if seen is not None
        )
    finally:
        bus.close()
    return EngineConfig(
        port=port,
        servos=servos,
        control=control,
        limits_rad=_kit_limits(),
        registers={servo.joint: {"pwm_limit": PLATFORM_PWM_LIMIT_COUNTS} for servo in servos},
        chain=_virtual_chain(control),
        **more,  # type: ignore[arg-type]
    )


def _virtual_chain(control: str | None) -> tuple[tuple[str, ...], ...]:
    """How a virtual robot is wired; empty where the robot is real."""
    if control is None:
        return ()
    remote = VirtualControl(control)
    try:
        return tuple(tuple(cable) for cable in remote.ask("wiring")["chain"])
    finally:
        remote.close()


def _kit_limits() -> Mapping[str, tuple[float, float]]:
    return {name: (-ANGLE_LIMIT_RAD[joint.kind], ANGLE_LIMIT_RAD[joint.kind]) for name, joint in JOINTS.items()}
