"""Connect: the ports by their USB identity, the adapter's latency timer, and whether a flight controller answers."""

from __future__ import annotations

from openant_tools.calib.wires import clock_of, opened_bus, opened_imu
from openant_tools.comms.ports import WANTED_LATENCY_MS, Host, Port, udev_rule
from openant_tools.comms.setup import find_bus
from openant_tools.errors import HardwareFault, OpenAntError
from openant_tools.numbers import number
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Bench, Intent, Procedure, Progress, Say
from openant_tools.robot.config import Provenance, RobotConfig

__all__ = ["connect"]

COMMAND = "openant calib connect"


def connect(bench: Bench, host: Host | None = None) -> Procedure:
    """Find bus, IMU and camera; no byte goes to a port that is not named or known.

    Raises:
        HardwareFault: there is no bus, or it does not open; the message says who holds it or which group is missing.
    """
    host = host or Host()
    yield Progress(None, "looking for adapters")
    ports = host.ports()
    for port in ports:
        yield Say(f"{port.stable_path}: {_words(port)}")
    config = bench.folder.config()
    bus = find_bus(bench.bus, config, host)
    evidence, problems = list[Evidence](), list[str]()

    latency = host.latency_timer_ms(bus)
    if latency is not None and latency > WANTED_LATENCY_MS:
        yield Intent(f"set the latency timer of {bus} from {latency} to {WANTED_LATENCY_MS} ms")
        if not host.set_latency_timer_ms(bus):
            problems.append(
                f"the adapter's latency timer is {latency} ms and cannot be set by this user: each read waits so long "
                f"→ {udev_rule()}"
            )
        latency = host.latency_timer_ms(bus)
    if latency is not None:
        evidence.append(Evidence("latency timer", float(latency), "ms", f"driver of {bus}"))
    yield Progress(0.3, f"opening {bus}")
    with opened_bus(bench):
        pass
    yield Say(f"the bus is {bus}", "ok")

    imu = bench.imu or (str(config.ports.imu) if config.ports.imu else None) or _only(ports, "imu")
    if imu is None:
        problems.append("no flight controller is plugged in → plug its USB cable in, or go on without an IMU")
    else:
        yield Progress(0.6, f"asking the flight controller at {imu}")
        found, fault = _ask_imu(bench, imu)
        if fault is not None:
            problems.append(f"IMU: {fault}")
        else:
            assert found is not None
            evidence.append(Evidence("IMU rate", found[1], "Hz", f"{found[0]} at {imu}"))
            yield Say(f"the flight controller is {found[0]}, {number(found[1], 'samples/s', decimals=0)}", "ok")
    camera = bench.camera if bench.camera is not None else config.ports.camera
    seen = "no camera yet"
    if camera == "":
        yield Say(
            "no camera is known yet: the Arena step asks for it. All steps before it go without, and so does training in simulation; "
            "to learn on the floor the robot needs one"
        )
    else:
        yield Progress(0.8, f"looking through the camera {camera}")
        try:
            shown = _picture_of(bench, config, camera)
        except OpenAntError as fault:
            seen = "the camera shows nothing"
            problems.append(f"camera: {fault}; only what happens on the floor (Arena, learning) needs it")
        else:
            seen = f"the camera {camera}"
            yield Say(f"the camera is {camera}, {shown}; the Arena step looks for its tags", "ok")

    if not bench.virtual:
        # A virtual robot's ports are gone with it: they are named on the command line, not kept.
        kept: dict[str, str] = {"ports.bus": bus} | ({"ports.imu": imu} if imu else {})
        bench.folder.update(kept, provenance=Provenance("found", COMMAND, None))
    ok = not any("IMU:" in problem for problem in problems)
    return Finding(
        "connect",
        ok,
        f"the bus is {bus}"
        + (f", the IMU {imu}" if imu and ok else ", the IMU does not answer" if imu else ", no IMU")
        + f", {seen}",
        tuple(evidence),
        "" if ok else "mend what is listed, then run it again",
        COMMAND,
        data={"bus": bus, "imu": imu, "camera": camera, "ports": [vars(port) for port in ports]},
        problems=tuple(problems),
    )


def _ask_imu(bench: Bench, port: str) -> tuple[tuple[str, float] | None, OpenAntError | None]:
    bench = Bench(bench.folder, bench.bus, port, bench.camera, bench.control)
    try:
        with opened_imu(bench) as (imu, _):
            info = imu.info
            return (
                f"{info.variant} {info.firmware} (API {info.api}) on {info.board.board or 'a board'}",
                info.rate_hz,
            ), None
    except HardwareFault as fault:
        return None, fault


def _picture_of(bench: Bench, config: RobotConfig, source: str | int) -> str:
    """What a picture of the camera is like, in words.

    Raises:
        OpenAntError: none comes, or OpenCV is not installed.
    """
    from openant_tools.comms.camera import CameraSettings, look  # not without OpenCV

    info = look(CameraSettings(source, exposure=config.camera.exposure, focus=config.camera.focus), clock_of(bench))
    return f"{info.width} × {info.height} pixels"


def _only(ports: list[Port], kind: str) -> str | None:
    found = [port.stable_path for port in ports if port.kind == kind]
    return found[0] if len(found) == 1 else None


def _words(port: Port) -> str:
    kind = {"bus": "servo adapter (U2D2)", "imu": "flight controller", "unknown": "unknown: left alone"}[port.kind]
    timer = f", latency timer {port.latency_timer_ms} ms" if port.latency_timer_ms is not None else ""
    return f"{kind}, driver {port.driver or '?'}{timer}"
