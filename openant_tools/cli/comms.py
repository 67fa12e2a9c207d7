"""`openant comms`: the bus. Which ports there are, who answers, how fast it goes, what it loses."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.cli.comms_blind import blind
from openant_tools.cli.comms_diagnose import diagnose, timing
from openant_tools.cli.comms_reboot import reboot
from openant_tools.cli.comms_soak import soak
from openant_tools.cli.hardware import engine_config, port_option, robot_of
from openant_tools.cli.log import aside
from openant_tools.cli.options import SECONDS, driver_option, json_option, robot_option
from openant_tools.cli.virtual_for_command import virtual_option
from openant_tools.numbers import number, percent
from openant_tools.virtual.process import clock_of_its_own, virtual_robot

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from openant_tools.comms.messages import EngineConfig
    from openant_tools.comms.scan import Scan

__all__ = ["comms"]


@click.group()
def comms() -> None:
    """The bus: ports, who answers, how fast it goes, what it loses.

    \b
      openant comms ports                     adapters that are plugged in, and their latency timers
      openant comms scan --port /dev/ttyUSB0  every servo at every baud rate, in two seconds
      openant comms watch                     live: angles, losses by cause, round trips
      openant comms diagnose soak.mcap        what loses the communication, and what to do about it
      openant comms reboot --id 31            clears a hardware error that a servo has latched
    """


for _command in (blind, diagnose, reboot, soak, timing):
    comms.add_command(_command)


@comms.command()
@json_option
def ports(json_file: Path | None) -> None:
    """List serial ports by what is plugged in; sends nothing to any of them."""
    from openant_tools.comms.ports import WANTED_LATENCY_MS, Host, udev_rule

    host = Host()
    found = host.ports()
    slow = False
    for port in found:
        timer = "" if port.latency_timer_ms is None else f"  latency timer {port.latency_timer_ms} ms"
        slow = slow or (port.latency_timer_ms or 0) > WANTED_LATENCY_MS
        words = {"bus": "servo bus", "imu": "flight controller", "unknown": port.product or "unknown"}[port.kind]
        click.echo(f"{port.stable_path}  {words}  {port.vendor_id}:{port.product_id}{timer}")
        for holder in host.readers(port.path):
            click.echo(f"  held by {holder.command} (process {holder.pid})")
        group = host.missing_group(port.path)
        if group:
            click.echo(f"  you may not open it: run `sudo usermod -aG {group} $USER` and log in again")
    for lonely in host.adapters_without_driver():
        click.echo(f"adapter {lonely} has no driver: run `sudo modprobe ftdi_sio`")
    if not found:
        click.echo("no USB serial port is plugged in", err=True)
    if slow:
        click.echo("\nEach read waits for the latency timer. This sets it to 1 ms for good:\n" + udev_rule())
    if json_file:
        _write_json(json_file, [vars(port) | {"kind": port.kind} for port in found])


@comms.command()
@click.option("--port", "paths", multiple=True, metavar="PATH", help="A bus; may be repeated. Default: every U2D2.")
@virtual_option
@click.option("--baud", "bauds", multiple=True, type=int, help="Only this rate; may be repeated. Default: all eight.")
@click.option(
    "--id", "wanted", multiple=True, type=click.IntRange(0, 252), help="Ask for this id, too, and why it is silent."
)
@driver_option
@json_option
def scan(
    paths: Sequence[str], virtual_source: str | None, bauds: Sequence[int], wanted: Sequence[int], driver: str,
    json_file: Path | None,
) -> None:  # fmt: skip
    """List every servo: port, baud rate, id, model, firmware. Nothing is written.

    Exit code 1 where something answers garbled, or where others may be missing from the list: the reason is on stderr.
    """

    from openant_tools.comms.ports import Host
    from openant_tools.comms.silence import LEVELS
    from openant_tools.comms.troubles import SILENCE
    from openant_tools.errors import HardwareFault

    console = aside()
    rows: list[dict[str, Any]] = []
    bad = False
    with contextlib.ExitStack() as stack:
        control = None
        if virtual_source is not None:
            clock = "real" if driver == "sdk" else clock_of_its_own(virtual_source)
            robot = stack.enter_context(virtual_robot(virtual_source, clock=clock, camera=False))
            paths, control = (*paths, str(robot["bus"])), robot["control"]
        buses = list(paths) or [port.stable_path for port in Host().ports() if port.kind == "bus"]
        if not buses:
            raise HardwareFault("no U2D2 is plugged in", remedy="plug it in, or name another adapter with --port")
        for path in buses:
            with console.status(f"{path}: asking at every baud rate"):
                result, silent = _scan_one(path, control, bauds, wanted, driver)
            for servo in result.servos:
                note = "  two servos share this id?" if servo.clash else ""
                note += "  reports a hardware error: `openant comms reboot`" if servo.alert else ""
                if servo.return_level < 2:
                    level, answers = servo.return_level, LEVELS[servo.return_level]
                    note += f"  Status Return Level {level}, answers {answers}: {SILENCE['return_level'].do}"
                click.echo(
                    f"{path}  {servo.baud:>7} baud  id {servo.id:>3}  {servo.model}  firmware {servo.firmware}{note}"
                )
                bad = bad or servo.clash
                rows.append(
                    {
                        "id": servo.id, "baud": servo.baud, "model_number": servo.model_number,
                        "firmware": servo.firmware, "model": servo.model, "port": path, "clash": servo.clash,
                        "alert": servo.alert, "return_level": servo.return_level, "certain": result.certain,
                    }
                )  # fmt: skip
            for words in result.garbled.values():
                bad = True
                click.echo(words)
            for words in result.doubts:
                bad = True
                click.echo(f"{path}: the list may be partial: {words}", err=True)
            if silent:
                bad = True
                click.echo(f"{path}: {silent}", err=True)
    if json_file:
        _write_json(json_file, rows)
    if not rows and not bad:
        raise HardwareFault("nothing answered at any baud rate", where=", ".join(buses), remedy=SILENCE["nobody"].do)
    if bad:
        raise SystemExit(1)


def _scan_one(
    path: str, control: str | None, bauds: Sequence[int], wanted: Sequence[int], driver: str
) -> tuple[Scan, str]:
    """What one port has, and why those of `wanted` are silent that are not there."""
    from openant_tools.comms.scan import BAUDS, KNOWN, scan, scan_by_sdk
    from openant_tools.comms.setup import open_bus
    from openant_tools.comms.silence import diagnose

    if driver == "sdk":
        result = scan_by_sdk(path, bauds or BAUDS)
        missing = [id for id in wanted if all(one.id != id for one in result.servos)]
        return result, f"no answer from {', '.join(map(str, missing))}" if missing else ""
    bus = open_bus(path, (bauds or BAUDS)[0] if len(bauds) == 1 else BAUDS[0], control)
    try:
        result = scan(bus, bauds or BAUDS, known=(*wanted, *(id for id in KNOWN if id not in wanted)))
        missing = [id for id in wanted if all(one.id != id for one in result.servos)]
        silent = diagnose(bus, missing, [*(one.id for one in result.servos), *missing]).words if missing else ""
    finally:
        bus.close()
    return result, silent


@comms.command()
@port_option
@virtual_option
@robot_option
@click.option("--seconds", type=SECONDS, default=3.0, show_default=True, help="How long to measure the rate.")
@json_option
def bench(
    port: str | None, virtual_source: str | None, robot: Path | None, seconds: float, json_file: Path | None
) -> None:
    """Measure the rate this bus reaches and the quiet time it needs after a write. Torque is off, nothing moves."""

    from openant_tools.comms.bench import measure_gap, measure_rate
    from openant_tools.comms.lateness import REMEDY
    from openant_tools.comms.servos import Servos
    from openant_tools.comms.setup import open_bus
    from openant_tools.comms.silence import explaining

    console = aside()
    # Stepped, a virtual robot shows its bus and nothing of what else this machine does.
    with engine_config(robot_of(robot, needed=False), port, virtual_source) as config:
        bus = open_bus(config.port, config.baud, config.control)
        try:
            servos = Servos(bus, config.servos)
            with explaining(bus, config.chain):
                servos.identify()
                delays = servos.read_all("return_delay_time")
                bus.timing = replace(bus.timing, return_delay_s=max(delays.values()) * 2e-6)
                timer = bus.measure_latency_timer(servos.ids[0])
                with console.status("rate"):
                    rate = measure_rate(bus, servos.ids, seconds)
                with console.status("gap after a write"):
                    trials, gap = measure_gap(bus, servos.ids)
            late = bus.clock.lateness.words
        finally:
            bus.close()
    click.echo(f"{rate.words}: write {len(servos.ids)} goals, read {len(servos.ids)} blocks of 27 bytes")
    if rate.believable:
        click.echo(
            f"  {percent(rate.share)} of the {number(rate.limit_hz, 'Hz', decimals=0)} that the wire allows; {percent(rate.lost, decimals=2)} lost"
        )
    if late:
        click.echo(f"{late}: losses and rate are in part its own → {REMEDY}", err=True)
    click.echo(
        f"  latency timer about {number(1e3 * timer, 'ms', decimals=0)}; return delay {max(delays.values()) * 2} µs at most"
    )
    click.echo("quiet time after a write → failed reads")
    for trial in trials:
        click.echo(f"  {number(1e3 * trial.gap_s, 'ms', decimals=1):>7}   {trial.failed:2} of {trial.tries}")
    click.echo(f"smallest loss-free gap: {'none of these' if gap is None else number(1e3 * gap, 'ms', decimals=1)}")
    if json_file:
        content = {
            "rate": rate.as_dict(), "gaps": [vars(trial) for trial in trials], "gap_s": gap,
            "latency_timer_s": timer, "return_delay_s": max(delays.values()) * 2e-6,
        }  # fmt: skip
        _write_json(json_file, content)


@comms.command()
@port_option
@virtual_option
@robot_option
@click.option("--seconds", type=SECONDS, metavar="S", help="Stop after so long. Default: until Ctrl-C.")
@driver_option
@json_option
def watch(
    port: str | None, virtual_source: str | None, robot: Path | None, seconds: float | None, driver: str,
    json_file: Path | None,
) -> None:  # fmt: skip
    """Show the bus live: angles, supply, heat, and per servo what is lost and how long answers take. Torque is off.

    With --driver sdk the vendor's own code asks, five times a second: what it loses, too, these tools are not to blame for.
    """
    from rich.console import Console
    from rich.live import Live

    from openant_tools.comms import messages
    from openant_tools.comms.engine_process import EngineProcess

    console = Console()
    statistics: dict[str, Any] = {}
    folder = robot_of(robot, needed=False)
    if driver == "sdk":
        with engine_config(folder, port, virtual_source, clock="real") as config:
            statistics = _watch_by_sdk(console, config, seconds)
    else:
        with engine_config(folder, port, virtual_source, clock="real") as config, EngineProcess(config) as engine:
            end = None if seconds is None else time.monotonic() + seconds
            with contextlib.suppress(KeyboardInterrupt), Live(console=console, auto_refresh=False) as live:
                while end is None or time.monotonic() < end:
                    time.sleep(0.2)
                    rows = engine.telemetry()
                    statistics = engine.ask(messages.Statistics())
                    if len(rows):
                        live.update(_table(engine.columns, rows[-1], statistics), refresh=True)
    if not console.is_terminal:
        console.line()  # in a file the last table ends without its own
    if json_file:
        _write_json(json_file, statistics)


def _watch_by_sdk(console: Console, config: EngineConfig, seconds: float | None) -> dict[str, Any]:
    """Ask with the vendor's SDK until the time is over or Ctrl-C; what it lost, by servo."""
    from rich.live import Live
    from rich.table import Table

    from openant_tools.comms.servos import BLOCK, BLOCK_ADDRESS, BLOCK_SIZE, Block
    from openant_tools.comms.vendor_sdk import VendorSdk

    ids, cycles = [servo.id for servo in config.servos], 0
    end = None if seconds is None else time.monotonic() + seconds
    with (
        VendorSdk(config.port, config.baud) as sdk,
        Live(console=console, auto_refresh=False) as live,
        contextlib.suppress(KeyboardInterrupt),
    ):
        while end is None or time.monotonic() < end:
            found = sdk.sync_read(ids, BLOCK_ADDRESS, BLOCK_SIZE)
            cycles += 1
            table = Table(title=f"{cycles} cycles, asked by the vendor's SDK", box=None, padding=(0, 1, 0, 0))
            for name in ("joint", "angle", "V", "°C", "lost", "in its words"):
                table.add_column(name, justify="left" if name in ("joint", "in its words") else "right")
            for servo in config.servos:
                data, cells = found.get(servo.id), ("", "", "")
                if data is not None:
                    block = Block._make(BLOCK.unpack(data))
                    angle = servo.to_joint(block.position * servo.model.registers["present_position"].scale)
                    cells = (
                        number(angle, "rad", decimals=1),
                        number(block.voltage / 10, decimals=1),
                        f"{block.temperature}",
                    )
                lost = sum(sdk.lost.get(servo.id, {}).values())
                table.add_row(servo.joint, *cells, f"{lost}/{sdk.asked[servo.id]}", sdk.why(servo.id))
            live.update(table, refresh=True)
            time.sleep(0.2)
    servos = [
        {"joint": one.joint, "id": one.id, "asked": sdk.asked[one.id], "lost": dict(sdk.lost.get(one.id, {}))}
        for one in config.servos
    ]
    return {"driver": "sdk", "cycles": cycles, "servos": servos}


def _table(columns: Sequence[str], row: Sequence[float], statistics: Mapping[str, Any]) -> Table:
    from rich import box
    from rich.table import Table

    values = dict(zip(columns, row, strict=True))
    comb = statistics["comb_period_s"]
    title = f"{statistics['cycles']} cycles, worst wake-up {number(1e3 * statistics['worst_wake_s'], 'ms', decimals=1)} late"
    if statistics["late"]:
        title += f"; {statistics['late']}: losses are in part its own"
    if comb:
        title += f"; answers come in the beat of a {number(1e3 * comb, 'ms', decimals=0)} latency timer: see `openant comms ports`"
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for name in ("joint", "angle", "V", "°C", "effort", "p50 ms", "p99 ms", "lost", "by cause"):
        table.add_column(name, justify="left" if name in ("joint", "by cause") else "right", no_wrap=True)
    for servo in statistics["servos"]:
        joint = servo["joint"]
        current, load = values[f"cur.{joint}"], values[f"load.{joint}"]
        causes = ", ".join(f"{cause} {count}" for cause, count in servo["lost"].items())
        table.add_row(
            joint,
            number(values[f"pos.{joint}"], "rad", decimals=1),
            number(values[f"volt.{joint}"], decimals=1),
            number(values[f"temp.{joint}"], decimals=0),
            number(current, "A", decimals=2) if current == current else percent(load),
            *(number(1e3 * servo[key], decimals=2) if servo[key] else "" for key in ("latency_p50_s", "latency_p99_s")),
            percent(servo["loss"], decimals=2),
            causes + (f", retries {servo['retries']}" if servo["retries"] else ""),
        )
    return table


def _write_json(path: Path, content: object) -> None:
    from openant_tools.files import json_text, write_text

    write_text(path, json_text(content, indent=2))
