"""Serial ports of a host, from trees of /sys, /proc and /dev as they were recorded."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from places import DATA

from openant_tools.comms.line import SerialLine
from openant_tools.comms.ports import Host, explain_open_error, udev_rule
from openant_tools.comms.setup import find_bus
from openant_tools.errors import HardwareFault

# Kept as a list and not as files: names with colons cannot be checked out everywhere.
RECORDED = DATA / "host_ant.txt"


@pytest.fixture
def host(tmp_path: Path) -> Host:
    for line in RECORDED.read_text().splitlines():
        kind, _, rest = line.partition(" ")
        name, _, content = rest.partition(" ")
        path = tmp_path / name
        if kind == "D":
            path.mkdir(parents=True, exist_ok=True)
        elif kind in "FL":
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content + "\n") if kind == "F" else path.symlink_to(content)
    return Host(tmp_path / "sys", tmp_path / "proc", tmp_path / "dev")


def test_a_bus_is_told_by_its_usb_identity_and_has_a_path_that_stays(host: Host) -> None:
    bus, imu = host.ports()
    assert (bus.kind, bus.serial_number, bus.driver, bus.latency_timer_ms) == ("bus", "FT6S4DSP", "ftdi_sio", 16)
    assert bus.stable_path.endswith("by-id/usb-FTDI_USB__-__Serial_Converter_FT6S4DSP-if00-port0")
    assert (imu.kind, imu.driver, imu.latency_timer_ms) == ("imu", "cdc_acm", None)


def test_the_stable_path_leads_to_the_same_timer(host: Host) -> None:
    bus = host.ports()[0]
    assert host.latency_timer_ms(bus.stable_path) == 16
    assert host.set_latency_timer_ms(bus.stable_path)
    assert host.latency_timer_ms(bus.path) == 1


def test_a_timer_that_cannot_be_set_is_told_from_one_that_can(host: Host) -> None:
    assert not host.set_latency_timer_ms(str(host.dev / "ttyACM0"))
    assert "ftdi_sio" in udev_rule()
    assert 'ATTR{latency_timer}="1"' in udev_rule()


def test_who_holds_a_port_and_not_one_whose_name_is_longer(host: Host) -> None:
    [holder] = host.holders(host.ports()[0].stable_path)
    assert (holder.pid, holder.command) == (4242, "/opt/ROBOTIS/DynamixelWizard2/DynamixelWizard2")


def test_an_adapter_without_a_driver_is_seen(host: Host) -> None:
    assert host.adapters_without_driver() == ["FT9LONELY"]


def test_the_one_bus_is_found_by_itself(host: Host) -> None:
    assert find_bus(None, host=host) == host.ports()[0].stable_path
    assert find_bus("/dev/mine", host=host) == "/dev/mine"
    empty = Host(host.sys / "none", host.proc, host.dev / "none")
    (host.sys / "none" / "class").mkdir(parents=True)
    with pytest.raises(HardwareFault, match=r"no U2D2 is plugged in → .*--virtual"):
        find_bus(None, host=empty)


def explained(path: str, code: int, host: Host) -> str:
    return str(explain_open_error(path, OSError(code, os.strerror(code)), host))


def test_every_way_a_port_does_not_open(host: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    path = host.ports()[0].path
    assert "DynamixelWizard2 (process 4242) → close that program first" in explained(path, errno.EBUSY, host)
    missing = explained("/dev/ttyUSB9", errno.ENOENT, host)
    assert "there is no such port → the bus that is plugged in is" in missing
    monkeypatch.setattr(Host, "missing_group", lambda self, path: "dialout")
    assert "sudo usermod -aG dialout $USER" in explained(path, errno.EACCES, host)
    assert "nobody answers there" in explained("socket://localhost:1", errno.ECONNREFUSED, host)


def process(host: Host, pid: int, parent: int, *words: str, port: str = "/dev/ttyUSB0") -> None:
    """One more process on a recorded host; "" for a port that it has not open."""
    folder = host.proc / str(pid)
    (folder / "fd").mkdir(parents=True)
    (folder / "cmdline").write_bytes(b"".join(word.encode() + b"\0" for word in words))
    (folder / "comm").write_text(f"{Path(words[0]).name[:15]}\n")
    (folder / "stat").write_text(f"{pid} (a (name) S 1 2) S {parent} 1 1 0\n")
    if port:
        (folder / "fd" / "9").symlink_to(port)


ENGINE = ("/venv/bin/python3", "-m", "openant_tools.comms.engine", "5", "6")
ITS_GUARDIAN = ("/venv/bin/python3", "-I", "-S", "/venv/lib/openant_tools/comms/guardian.py", "7", "ff", "0.2")


@pytest.mark.parametrize(
    ("pid", "words", "named"),
    [
        (19511, ("/venv/bin/python3", "/venv/bin/openant"), "openant"),
        (1, ("/venv/bin/python3", "-m", "openant_tools.cli", "sysid", "record", "--yes"), "openant sysid record"),
        (19511, ("python", "/home/me/walk.py", "openant"), "python /home/me/walk.py openant"),
    ],
)
def test_who_holds_a_port_by_an_engine_is_the_program_that_started_it(
    host: Host, pid: int, words: tuple[str, ...], named: str
) -> None:
    """Even in a container, where that may be process 1."""
    (host.proc / "4242" / "fd" / "17").unlink()
    process(host, pid, 0, *words, port="")
    process(host, 19551, pid, *ENGINE)
    process(host, 19560, 19551, *ITS_GUARDIAN)
    said = explained(host.ports()[0].path, errno.EBUSY, host)
    assert f": it is held by {named} (process {pid}) → close that program first" in said


def test_an_engine_whose_program_cannot_be_found_out_is_named_itself(host: Host) -> None:
    (host.proc / "4242" / "fd" / "17").unlink()
    process(host, 1, 0, "/sbin/init", port="")
    process(host, 19551, 1, *ENGINE)  # its program has died
    process(host, 19561, 0, *ITS_GUARDIAN)  # of a container: its engine is not to be seen
    said = explained(host.ports()[0].path, errno.EBUSY, host)
    assert f"{' '.join(ENGINE)} (process 19551), {' '.join(ITS_GUARDIAN)} (process 19561) → " in said
    (host.proc / "19551" / "fd" / "9").unlink()
    (host.proc / "19561" / "fd" / "9").unlink()
    assert "another program holds it → " in explained(host.ports()[0].path, errno.EBUSY, host)


def test_the_far_end_of_a_pseudo_terminal_and_that_of_another_container_hold_none(tmp_path: Path) -> None:
    host = Host(proc=tmp_path / "proc")
    near, far = os.openpty()
    try:
        path = os.ttyname(far)
        for pid, words in ((31, ("openant", "virtual", "start")), (32, ("minicom",)), (33, ("bash",))):
            process(host, pid, 1, *words, port="")
        (host.proc / "31" / "fdinfo").mkdir()
        (host.proc / "31" / "fdinfo" / "8").write_text(f"pos:\t0\ntty-index:\t{Path(path).name}\n")
        for pid in (31, 32):
            (host.proc / str(pid) / "fd" / "9").symlink_to(path)
        # Of the same name in a /dev/pts of its own, where another device stands.
        elsewhere = tmp_path / "dev" / "pts"
        elsewhere.mkdir(parents=True)
        (elsewhere / Path(path).name).symlink_to("/dev/null")
        (host.proc / "33" / "fd" / "9").symlink_to(elsewhere / Path(path).name)
        assert [holder.pid for holder in host.readers(path)] == [32]
    finally:
        os.close(near)
        os.close(far)


def test_a_missing_driver_is_named(host: Host) -> None:
    (host.sys / "class" / "tty" / "ttyUSB0").unlink()
    assert "sudo modprobe ftdi_sio" in explained("/dev/ttyUSB9", errno.ENOENT, host)


def test_real_errors_come_in_the_same_words(tmp_path: Path) -> None:
    with pytest.raises(HardwareFault, match="there is no such port"):
        SerialLine(str(tmp_path / "ttyUSB0"), 1_000_000)
    plain = tmp_path / "file"
    plain.write_text("")
    with pytest.raises(HardwareFault, match="is this a serial port"):
        SerialLine(str(plain), 1_000_000)
    with pytest.raises(HardwareFault, match="nobody answers there"):
        SerialLine("socket://localhost:9", 1_000_000)
