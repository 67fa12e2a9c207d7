"""What only one system has is one file's business each; nothing here runs Windows or macOS, so fakes stand in for them."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from places import ROOT
from serial.tools import list_ports
from sources import modules

from openant_tools import lock
from openant_tools.comms.ports import Host, explain_open_error
from openant_tools.errors import BadInput

#: module that some systems lack → where it may be imported
ONLY_IN = {
    "fcntl": {"openant_tools/lock.py", "openant_tools/virtual/ports.py"},
    "msvcrt": {"openant_tools/lock.py"},
    "pty": {"openant_tools/virtual/ports.py"},
    "tty": {"openant_tools/virtual/ports.py", "openant_tools/cli/walking.py"},
    "termios": {"openant_tools/cli/walking.py"},
    "grp": {"openant_tools/comms/ports.py"},
}
#: signals that Windows lacks: `openant_tools/signals.py` has them by getattr; the guardian imports nothing of ours
SIGNALS_IN = {"openant_tools/comms/guardian.py"}


def test_what_a_system_may_lack_is_named_in_one_file() -> None:
    found: dict[str, set[str]] = {name: set() for name in ONLY_IN}
    signals = set()
    for module in modules():
        for node in module.nodes:
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [str(node.module)]
            for name in set(names) & set(found):
                found[name].add(module.name)
            if isinstance(node, ast.Attribute) and node.attr in ("SIGHUP", "SIGTSTP"):
                signals.add(module.name)
    assert found == ONLY_IN
    assert signals == SIGNALS_IN


def test_whether_there_is_a_terminal_is_asked_in_one_place_which_knows_that_a_stream_may_be_closed() -> None:
    asking = {
        module.name
        for module in modules()
        if any(isinstance(node, ast.Attribute) and node.attr == "isatty" for node in module.nodes)
    }
    assert asking == {"openant_tools/cli/streams.py"}, "ask `has_terminal`"


def test_analysis_and_simulation_need_nothing_that_windows_lacks() -> None:
    lacking = """
import os, signal, sys
for name in ("fcntl", "termios", "pty", "tty", "grp", "pwd", "resource"):
    sys.modules[name] = None
for name in ("SIGHUP", "SIGTSTP"):
    delattr(signal, name)
del os.geteuid
import openant_env.ant, openant_tools.cli.gap_diagnose, openant_tools.cli.rec, openant_tools.cli.sysid_fit
import openant_tools.comms.ports, openant_tools.exchange.urdf, openant_tools.gap.diagnose, openant_tools.sysid.library
from openant_tools.cli.leaving import end_with_the_terminal, heed_signals
from openant_tools.gap.cache import cache_folder
heed_signals()
end_with_the_terminal()
cache_folder()
"""
    done = subprocess.run([sys.executable, "-c", lacking], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr


class Bytes:
    """Windows' locks on bytes, as far as they are used: one descriptor a file has a byte, until it is closed."""

    LK_NBLCK = 2

    def __init__(self) -> None:
        self.held: dict[int, int] = {}

    def locking(self, descriptor: int, mode: int, count: int) -> None:
        file = os.fstat(descriptor).st_ino
        holder = self.held.get(file)
        assert os.lseek(descriptor, 0, os.SEEK_CUR) > 2**20  # what others want to read is not locked
        if holder is not None and holder != descriptor and is_open(holder):
            raise OSError(36, "deadlock avoided")
        self.held[file] = descriptor


def is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


def test_a_lock_on_bytes_keeps_others_out_and_names_its_holder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(lock.ANCESTORS, raising=False)  # which a test before, that held a folder, may have left
    monkeypatch.setattr(lock, "FLOCK", False)
    monkeypatch.setitem(sys.modules, "msvcrt", Bytes())  # type: ignore[arg-type]
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("signal 0 is Ctrl-C on Windows"))
    path = tmp_path / "ant" / ".lock"
    claim = lock.Claim(path, "this robot is held by {}", remedy="end that program", wait_s=0.01)
    holder = lock.holder(path)
    assert holder is not None
    assert holder.pid == os.getpid()
    with pytest.raises(BadInput, match=rf"held by .*\(process {os.getpid()}\)"):
        lock.Claim(path, "this robot is held by {}", remedy="end that program", wait_s=0.01)
    claim.release()
    assert lock.holder(path) is None
    lock.Claim(path, "{}", remedy="", wait_s=0.01).release()


def test_a_mac_has_no_trees_of_files_and_two_names_for_each_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def usb(device: str, vid: int | None, pid: int | None) -> Any:
        return SimpleNamespace(device=device, vid=vid, pid=pid, serial_number="FT6S4DSP", product="U2D2")

    mac = Host(tmp_path / "sys", tmp_path / "proc", tmp_path / "dev")
    there = [usb("/dev/tty.usbserial-FT6S4DSP", 0x0403, 0x6014), usb("/dev/cu.Bluetooth", None, None)]
    monkeypatch.setattr(list_ports, "comports", lambda: there)
    (bus,) = mac.ports()
    assert (bus.path, bus.kind, bus.latency_timer_ms) == ("/dev/cu.usbserial-FT6S4DSP", "bus", None)
    assert mac.holders(bus.path) == []
    monkeypatch.setattr(sys, "platform", "darwin")
    (tmp_path / "tty.usbserial").touch()
    said = explain_open_error(str(tmp_path / "tty.usbserial"), OSError(6, "not configured"), mac)
    assert "cu.usbserial" in str(said)
