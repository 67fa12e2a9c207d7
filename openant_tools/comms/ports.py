"""Serial ports: which are there, which is a servo bus, who holds one, and why one does not open.

A port is told by its USB identity, never by sending bytes: Betaflight takes `R` followed by silence as "reboot to the
boot loader", and any packet's checksum may end so. What the host knows is behind `Host`, so that all of this is tested
on recorded trees of /sys, /proc and /dev.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from openant_tools.comms.troubles import PORT
from openant_tools.errors import HardwareFault
from openant_tools.lock import command_line

__all__ = ["FLIGHT_CONTROLLER", "U2D2", "Host", "Port", "PortHolder", "explain_open_error", "udev_rule"]

#: USB VID:PID of ROBOTIS' U2D2 (FTDI FT232H) and of STM32 flight controllers (virtual COM port).
U2D2 = ("0403", "6014")
FLIGHT_CONTROLLER = ("0483", "5740")
#: 1 ms instead of the driver's 16: every reply of a servo is shorter than the adapter's buffer.
WANTED_LATENCY_MS = 1
#: what the command line of an engine and of its guardian holds
ENGINE, GUARDIAN = "openant_tools.comms.engine", "guardian.py"
#: as which `python -m` starts the command line
OPENANT = ("openant_tools", "openant_tools.cli")
_TTY_MAJOR_NAMES = ("ttyUSB", "ttyACM")

Kind = Literal["bus", "imu", "unknown"]


@dataclass(frozen=True)
class Port:
    """One serial port of this host.

    Attributes:
        path: the device, such as /dev/ttyUSB0.
        by_id: the path that stays the same over re-plugging and reboots, where there is one.
        kind: what its USB identity says it is.
        latency_timer_ms: of an FTDI adapter.
    """

    path: str
    by_id: str | None = None
    vendor_id: str = ""
    product_id: str = ""
    serial_number: str = ""
    product: str = ""
    driver: str = ""
    latency_timer_ms: int | None = None

    @property
    def kind(self) -> Kind:
        identity = (self.vendor_id, self.product_id)
        return "bus" if identity == U2D2 else "imu" if identity == FLIGHT_CONTROLLER else "unknown"

    @property
    def stable_path(self) -> str:
        return self.by_id or self.path


@dataclass(frozen=True)
class PortHolder:
    """A process that has a port open."""

    pid: int
    command: str


@dataclass(frozen=True)
class Host:
    """What this module asks of the machine: three trees. Tests give it recorded ones."""

    sys: Path = Path("/sys")
    proc: Path = Path("/proc")
    dev: Path = Path("/dev")

    def ports(self) -> list[Port]:
        """Every USB serial port, buses first, then by path."""
        found = [self._port(tty) for tty in self._ttys()] if (self.sys / "class").is_dir() else list(_by_pyserial())
        order = {"bus": 0, "imu": 1, "unknown": 2}
        return sorted(found, key=lambda port: (order[port.kind], port.path))

    def _ttys(self) -> Iterator[Path]:
        folder = self.sys / "class" / "tty"
        if folder.is_dir():
            yield from sorted(tty for tty in folder.iterdir() if tty.name.startswith(_TTY_MAJOR_NAMES))

    def _port(self, tty: Path) -> Port:
        interface = (tty / "device").resolve()
        usb = next((at for at in (interface, *interface.parents) if (at / "idVendor").is_file()), None)
        driver = (tty / "device" / "driver").resolve().name if (tty / "device" / "driver").exists() else ""
        return Port(
            path=str(self.dev / tty.name),
            by_id=self._by_id(tty.name),
            vendor_id=_text(usb / "idVendor") if usb else "",
            product_id=_text(usb / "idProduct") if usb else "",
            serial_number=_text(usb / "serial") if usb else "",
            product=_text(usb / "product") if usb else "",
            driver=driver,
            latency_timer_ms=self.latency_timer_ms(str(self.dev / tty.name)),
        )

    def _by_id(self, name: str) -> str | None:
        folder = self.dev / "serial" / "by-id"
        if folder.is_dir():
            for link in sorted(folder.iterdir()):
                if link.is_symlink() and Path(os.readlink(link)).name == name:
                    return str(link)
        return None

    def adapters_without_driver(self) -> list[str]:
        """U2D2s on the USB that have become no serial port: their serial numbers (or places)."""
        folder, lonely = self.sys / "bus" / "usb" / "devices", list[str]()
        claimed = {port.serial_number for port in self.ports()}
        if folder.is_dir():
            for device in sorted(folder.iterdir()):
                if (_text(device / "idVendor"), _text(device / "idProduct")) == U2D2:
                    number = _text(device / "serial")
                    if number not in claimed:
                        lonely.append(number or device.name)
        return lonely

    # ---- the latency timer ---------------------------------------------------------------------------------------

    def _latency_file(self, path: str) -> Path:
        return self.sys / "bus" / "usb-serial" / "devices" / self._name(path) / "latency_timer"

    def latency_timer_ms(self, path: str) -> int | None:
        """What the FTDI driver waits before it hands over a short reply; None where the port has no such timer."""
        text = _text(self._latency_file(path))
        return int(text) if text.isdigit() else None

    def set_latency_timer_ms(self, path: str) -> bool:
        """Set it to what is wanted, and read it back. False where it did not take: see `udev_rule`."""
        try:
            self._latency_file(path).write_text(str(WANTED_LATENCY_MS))
        except OSError:
            pass  # no such timer, or not ours to write: the value read back says so
        return self.latency_timer_ms(path) == WANTED_LATENCY_MS

    # ---- who holds it, and why it does not open ------------------------------------------------------------------

    def _name(self, path: str) -> str:
        return Path(os.path.realpath(path)).name

    def holders(self, path: str) -> list[PortHolder]:
        """Processes that have the port open, as far as this user may see them."""
        name, found = self._name(path), list[PortHolder]()
        try:
            processes = sorted(
                (entry for entry in self.proc.iterdir() if entry.name.isdigit()), key=lambda p: int(p.name)
            )
        except OSError:
            return found
        for process in processes:
            try:
                targets = {descriptor.name: os.readlink(descriptor) for descriptor in (process / "fd").iterdir()}
            except OSError:
                continue  # another user's, or gone meanwhile
            if any(
                Path(target).name == name and "/dev/" in target and _may_be(path, process / "fd" / number)
                for number, target in targets.items()
            ):
                words = _bytes(process / "cmdline").replace(b"\0", b" ").decode(errors="replace").strip()
                found.append(PortHolder(int(process.name), words or _text(process / "comm")))
        return found

    def readers(self, path: str) -> list[PortHolder]:
        """Other programs that have the port open, as their users know them: each takes some of the bytes that come.

        This process, its guardian and the far end of a pseudo-terminal are none. An engine and its guardian are the
        program that started them.
        """
        name, own = self._name(path), os.getpid()
        far = name if Path(os.path.realpath(path)).parent.name == "pts" else None
        found = dict[int, PortHolder]()
        for holder in self.holders(path):
            ours = holder.pid == own or (self._is_guardian(holder.pid) and self._parent(holder.pid) == own)
            if not ours and not (far and self._is_far_end(holder.pid, far)):
                program = self._program_of(holder)
                found.setdefault(program.pid, program)
        return list(found.values())

    def _program_of(self, holder: PortHolder) -> PortHolder:
        """Who started a guardian, and an engine; itself where that cannot be seen, is gone, or has started us, too."""
        pid = holder.pid
        if self._is_guardian(pid):
            parent = self._parent(pid)
            pid = parent if parent and self._is_engine(parent) else pid
        if self._is_engine(pid):
            parent = self._parent(pid)
            pid = parent if parent and self._is_python(parent) and parent not in self._ancestors() else pid
        return holder if pid == holder.pid and not self._is_openant(pid) else PortHolder(pid, self._command(pid))

    def _words(self, pid: int) -> list[str]:
        return [word.decode(errors="replace") for word in _bytes(self.proc / str(pid) / "cmdline").split(b"\0") if word]

    def _command(self, pid: int) -> str:
        """What a process was started as: of ours as its user typed it, to the first option."""
        words = self._words(pid)
        at = _openant_at(words)
        if at is not None:
            return command_line("openant", words[at:])
        return " ".join(words) or _text(self.proc / str(pid) / "comm")

    def _is_openant(self, pid: int) -> bool:
        return _openant_at(self._words(pid)) is not None

    def _is_engine(self, pid: int) -> bool:
        return ENGINE in self._words(pid)

    def _is_guardian(self, pid: int) -> bool:
        return any(Path(word).name == GUARDIAN for word in self._words(pid))

    def _is_python(self, pid: int) -> bool:
        """Whether it may have started an engine: one whose parent has died is the child of whoever takes such in."""
        words = self._words(pid)
        return bool(words) and ("python" in Path(words[0]).name.lower() or self._is_openant(pid))

    def _ancestors(self) -> set[int]:
        found, pid = set[int](), self._parent(os.getpid())
        while pid and pid not in found:
            found.add(pid)
            pid = self._parent(pid)
        return found

    def _parent(self, pid: int) -> int | None:
        # "41 (a name) S 40 …": a name may hold blanks and brackets
        fields = _text(self.proc / str(pid) / "stat").rpartition(")")[2].split()
        return int(fields[1]) if len(fields) > 1 else None

    def _is_far_end(self, pid: int, number: str) -> bool:
        """Whether a process holds the master of pseudo-terminal `number`."""
        try:
            files = list((self.proc / str(pid) / "fdinfo").iterdir())
        except OSError:
            return False
        return any(["tty-index:", number] == line.split() for file in files for line in _text(file).splitlines())

    def missing_group(self, path: str) -> str | None:
        """The group that owns the port, where this user is not in it."""
        if sys.platform == "win32":
            return None
        import grp

        try:
            gid = os.stat(path).st_gid
        except OSError:
            return None
        if os.geteuid() == 0 or gid in os.getgroups():
            return None
        try:
            return grp.getgrgid(gid).gr_name
        except KeyError:
            return str(gid)


def udev_rule() -> str:
    """The rule that sets every U2D2's latency timer to 1 ms when it is plugged, and how to install it."""
    rule = f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{{latency_timer}}="{WANTED_LATENCY_MS}"'
    return (
        f"echo '{rule}' | sudo tee /etc/udev/rules.d/99-openant-latency.rules\n"
        "sudo udevadm control --reload && sudo udevadm trigger --action=add --subsystem-match=usb-serial"
    )


def explain_open_error(path: str, error: Exception, host: Host | None = None) -> HardwareFault:
    """Why a port does not open, and what to do: missing, busy and by whom, or forbidden and which group."""
    cause, values = _why_closed(path, error, host or Host())
    trouble = PORT[cause]
    return HardwareFault(trouble.says.format(**values), where=path, remedy=trouble.do.format(**values))


def _why_closed(path: str, error: Exception, host: Host) -> tuple[str, dict[str, str]]:
    """The key of `troubles.PORT`, and what its words need."""
    code, values = getattr(error, "errno", None), {"error": str(error)}
    if "://" in path:
        return "nobody_listens", values
    if code == errno.ENOENT or not os.path.lexists(path):
        known = [port.stable_path for port in host.ports() if port.kind == "bus"]
        if known:
            return "elsewhere", {"other": known[0]}
        return "no_driver" if host.adapters_without_driver() else "missing", {}
    if code in (errno.EACCES, errno.EPERM):
        group = host.missing_group(path)
        return ("forbidden", {"group": group}) if group else ("forbidden_by_mode", {})
    if code in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "lock" in str(error).lower():
        holders = host.readers(path)
        who = ", ".join(f"{holder.command} (process {holder.pid})" for holder in holders)
        return ("held", {"who": who}) if holders else ("held_by_unseen", {})
    if sys.platform == "darwin" and "/tty." in path:
        return "dial_in", {**values, "other": path.replace("/tty.", "/cu.")}
    return "no_port", values


def _by_pyserial() -> Iterator[Port]:
    """macOS and Windows: what pyserial knows of USB serial ports. `cu.` and not `tty.`, which waits for a carrier."""
    from serial.tools import list_ports

    for found in list_ports.comports():
        if found.vid is not None:
            yield Port(
                path=found.device.replace("/dev/tty.", "/dev/cu."),
                vendor_id=f"{found.vid:04x}",
                product_id=f"{found.pid:04x}",
                serial_number=found.serial_number or "",
                product=found.product or "",
            )


def _may_be(path: str, descriptor: Path) -> bool:
    """Whether an open file of that name may be this port: each container has a /dev/pts of its own, with the same names."""
    try:
        there, here = os.stat(descriptor), os.stat(path)
    except OSError:
        return True  # not to be found out: its name says so
    pseudo = Path(os.path.realpath(path)).parent.name == "pts"
    return there.st_rdev == here.st_rdev and (not pseudo or there.st_dev == here.st_dev)


def _openant_at(words: list[str]) -> int | None:
    """Where in a process's words those for `openant` begin; None where it is another program."""
    python = bool(words) and "python" in Path(words[0]).name.lower()
    for k, word in enumerate(words[: 6 if python else 1]):
        if Path(word).name in ("openant", "openant.exe") or (k and words[k - 1] == "-m" and word in OPENANT):
            return k + 1
        if word.endswith(".py"):
            break
    return None


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _text(path: Path) -> str:
    return _bytes(path).decode(errors="replace").strip()
