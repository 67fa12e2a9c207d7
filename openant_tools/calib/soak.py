"""Thermal soak, short: the robot holds its home pose under its own legs' weight while every servo's temperature is kept."""

from __future__ import annotations

import numpy as np

from openant_tools.calib.sweep import play_watched
from openant_tools.calib.wires import engine_config
from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Ask, Bench, Intent, Procedure, Say
from openant_tools.recording.run import Facts
from openant_tools.recording.tables import read_run
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD

__all__ = ["soak"]

COMMAND = "openant calib thermal"
DEFAULT_S, SHORTEST_S, LONGEST_S = 60.0, 10.0, 7200.0
#: K below a servo's own limit at which a short soak already says no.
MARGIN_K = 15.0


def soak(bench: Bench) -> Procedure:
    """Hold, log, and say how warm each servo is and how fast it warms."""
    seconds = yield Ask("For how long?", unit="s", default=DEFAULT_S, low=SHORTEST_S, high=LONGEST_S)
    seconds = float(seconds) if isinstance(seconds, int | float) else DEFAULT_S
    config = bench.folder.config()
    yield Intent(f"hold the home pose for {seconds:.0f} s and keep every temperature", moves=True)
    path = bench.folder.recordings / "soak.mcap"
    with EngineProcess(engine_config(bench, imu=None)) as engine:
        joints = tuple(servo.joint for servo in engine.config.servos)
        home = np.array([HOME_RAD[JOINTS[joint].kind] for joint in joints])
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(home))
        engine.ask(messages.Record(str(path), Facts(joints=joints, setup="stand", protocol="soak"), overwrite=True))
        yield from play_watched(engine, messages.Hold(seconds), seconds, "soaking")
        engine.ask(messages.StopRecording())
        engine.ask(messages.Torque(False))
    run = read_run(path)
    evidence, problems = list[Evidence](), list[str]()
    rise: dict[str, float] = {}
    for joint in joints:
        temperature = run.signal("temp", [joint])[:, 0]
        known = temperature[np.isfinite(temperature)]
        if not len(known):
            continue
        rise[joint] = float(known[-1] - known[0])
        limit = config.motors[joint].servo.temperature_limit_c
        evidence.append(
            Evidence(f"temperature of {joint}", float(known[-1]), "°C", f"register 146 after {seconds:.0f} s")
        )
        if known[-1] > limit - MARGIN_K:
            problems.append(
                f"{joint}: {known[-1]:.0f} °C after {seconds:.0f} s, {limit:.0f} °C is its limit → let it cool; is it blocked?"
            )
    warmest = max(rise, key=lambda joint: rise[joint], default="")
    yield Say(f"the warmest is {warmest}: {rise.get(warmest, 0.0):+.0f} K", "info")
    return Finding(
        "thermal",
        not problems,
        f"after {seconds:.0f} s of holding, {warmest} is {rise.get(warmest, 0.0):.0f} K warmer",
        tuple(evidence),
        "let it cool and look at what is named" if problems else "",
        COMMAND,
        data={"rise_k": rise, "seconds": seconds, "recording": bench.folder.relative(path)},
        problems=tuple(problems),
    )
