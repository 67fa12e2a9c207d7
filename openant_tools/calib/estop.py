"""Emergency stop: the stop key, and the guardian that acts when the program dies, proven on whatever servo answers."""

from __future__ import annotations

import contextlib
import os
import signal
import time

from openant_tools.calib.wires import BOOT_S, bare_config, opened_bus, wait
from openant_tools.comms import messages
from openant_tools.comms.bus import Bus
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.scan import Scanned, scan
from openant_tools.comms.servos import Servo
from openant_tools.errors import HardwareFault
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Ask, Bench, Hands, Intent, Procedure, Progress, RegisterChange, Say
from openant_tools.robot.servo import servo_model

__all__ = ["estop"]

COMMAND = "openant calib estop"
#: s within which the guardian has said its word and given the port back.
GUARDIAN_S = 3.0


def estop(bench: Bench) -> Procedure:
    """Torque on at rest, stop key, read back; torque on again, the program killed, read back.

    Raises:
        HardwareFault: no servo answers.
    """
    first = next(iter(bench.folder.config().motors))
    with opened_bus(bench) as bus:
        yield Progress(None, "looking for a servo at every baud rate")
        seen = _usable(bus)
        if not seen:
            yield Hands(f"Plug one servo in (the one for {first} will do), 12 V on.", "plug", first)
            wait(bus.clock, BOOT_S)
            yield Progress(None, "looking for a servo at every baud rate")
            seen = _usable(bus)
    if not seen:
        raise HardwareFault(
            "no servo answers at any baud rate",
            remedy="is 12 V on, and the cable in to the click? Only one servo at a time",
        )
    baud = max({one.baud for one in seen}, key=[one.baud for one in seen].count)
    seen = [one for one in seen if one.baud == baud]
    names = ", ".join(f"id {one.id} ({one.model})" for one in seen)
    yield Intent(
        f"switch torque on where {names} stands, then stop it, twice; it is not told to turn",
        tuple(RegisterChange(f"id {one.id}", "torque_enable", 0, 1, "off → on") for one in seen),
        moves=True,
    )
    servos = [Servo(f"id {one.id}", one.id, servo_model(one.model_number)) for one in seen]
    config = bare_config(bench, servos, baud)
    with EngineProcess(config) as engine:
        engine.ask(messages.Torque(True))
        on = engine.ask(messages.ReadRegister("torque_enable"))
        if not all(on.values()):
            raise HardwareFault(f"torque does not come on at {', '.join(j for j, value in on.items() if not value)}")
        yield Say("torque is on: the horn resists your fingers", "info")
        yield Ask("Stop it now, with the stop key.", ("stop",), default="stop")
        engine.stop()
        off = engine.ask(messages.ReadRegister("torque_enable"))
    stopped = not any(off.values())
    yield Say("stopped: torque is off, read back" if stopped else "torque is STILL ON", "ok" if stopped else "fail")

    yield Progress(0.6, "the same with the program killed")
    killed = EngineProcess(config)
    try:
        killed.ask(messages.Torque(True))
        os.kill(killed.pid, signal.SIGKILL)
    finally:
        with contextlib.suppress(HardwareFault):
            killed.close()
    _until_guardian_left(bench, baud)
    with opened_bus(bench, baud) as bus:
        left = [one.id for one in seen if bus.read(one.id, 64, 1) != b"\0"]
    yield Say(
        "killed: torque is off all the same; a second small program, the guardian, saw to it"
        if not left
        else f"id {', '.join(map(str, left))} kept torque",
        "fail" if left else "ok",
    )
    problems = [f"{joint} kept torque after the stop key" for joint, value in off.items() if value]
    problems += [f"id {id} kept torque after its program was killed" for id in left]
    ok = not problems
    of_all, source = f"of {len(seen)}", "torque_enable (64), read back"
    return Finding(
        "estop",
        ok,
        "the stop key and a killed program both leave torque off" if ok else "torque stays on: do not go on",
        (
            Evidence("torque still on after the stop key", float(sum(map(bool, off.values()))), of_all, source),
            Evidence("torque still on after the program was killed", float(len(left)), of_all, source),
        ),
        "" if ok else "pull the power plug; report this with the robot's folder",
        COMMAND,
        data={"servos": [vars(one) for one in seen]},
        problems=tuple(problems),
    )


def _until_guardian_left(bench: Bench, baud: int) -> None:
    """The guardian keeps the port for as long as it repeats its packet; real time even where the robot's is stepped."""
    give_up = time.monotonic() + GUARDIAN_S
    while True:
        try:
            with opened_bus(bench, baud):
                return
        except HardwareFault:
            if time.monotonic() > give_up:
                raise
            time.sleep(0.05)


def _usable(bus: Bus) -> list[Scanned]:
    """Those that answer clearly; the platform's rate and the factory's are tried first and are enough if one is there."""
    for bauds in ((1_000_000, 57_600), None):
        found = scan(bus) if bauds is None else scan(bus, bauds)
        servos = [one for one in found.servos if not one.clash]
        if servos:
            return servos
    return []
