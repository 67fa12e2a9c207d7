"""Put a whole virtual robot together: from a scenario, or the healthy standard Ant, to a server ready to run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openant_tools.optional import installed
from openant_tools.virtual.body import Body
from openant_tools.virtual.camera_scene import OverheadCameraSettings
from openant_tools.virtual.camera_stream import VirtualCamera
from openant_tools.virtual.eeprom import EepromFile
from openant_tools.virtual.faults import Faults
from openant_tools.virtual.flight_controller import FlightController, FlightControllerSettings
from openant_tools.virtual.scenario import Scenario, load_scenario
from openant_tools.virtual.server import Server
from openant_tools.virtual.world import NAP_S, World

__all__ = ["BodyTruth", "assemble", "build", "serve"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BodyTruth:
    """What the flight controller's sensors feel: the torso of this body."""

    body: Body

    @property
    def quaternion(self) -> Array:
        return self.body.quaternion

    @property
    def rate(self) -> Array:
        return self.body.gyro

    @property
    def specific_force(self) -> Array:
        return self.body.accelerometer


def build(scenario: Scenario | None = None) -> World:
    """The world of a scenario, its servos plugged as it says; for use without ports."""
    scenario = scenario or Scenario()
    world = World(scenario.world)
    if scenario.plugged is not None:
        for k, joint in enumerate(world.joints):
            world.plug(k, joint in scenario.plugged)
    if scenario.eeprom is not None:
        EepromFile(scenario.eeprom).attach(world)
    return world


def assemble(script: Scenario, *, clock: str | None = None, tcp: bool = False, camera: bool | None = None) -> Server:
    """A server for a scenario, its ports open.

    Args:
        clock: "real" or "stepped"; None for what the scenario says.
        tcp: put the bus on a TCP port.
        camera: whether to start the camera's process; None for what the scenario says. Without OpenCV there is none.
    """
    stepped = script.stepped if clock is None else clock == "stepped"
    seed = script.world.seed
    eye = None
    if (script.camera if camera is None else camera) and installed("cv2"):
        # Started first: its process gets ready while this one builds the robot.
        eye = VirtualCamera(OverheadCameraSettings(**script.world.camera), seed + 3, stepped=stepped)
    try:
        world = build(script)
        settings = FlightControllerSettings(**script.world.imu)
        imu = FlightController(settings, lambda: BodyTruth(world.body), np.random.default_rng(seed + 2))
        if world.doze:
            imu.idle_s = NAP_S
        server = Server(world, stepped=stepped, imu=imu, camera=eye, tcp=tcp)
    except BaseException:
        if eye is not None:
            eye.close()
        raise
    faults = Faults(world, script.faults, unplug=server.set_plugged, imu=imu, camera=eye)
    server.fault = faults.request
    server.sealed = script.sealed
    return server


def serve(
    scenario: Path | None = None,
    *,
    clock: str | None = None,
    tcp: bool = False,
    key_file: Path | None = None,
    camera: bool | None = None,
) -> Server:
    """`assemble` for a scenario file; None for a healthy standard Ant on its stand. Raises BadInput."""
    script = load_scenario(scenario, key_file) if scenario is not None else Scenario()
    return assemble(script, clock=clock, tcp=tcp, camera=camera)
