"""One bundle for a bug report: what runs here, what is plugged in, the robot's config and last findings, the end of the log.

What tells who or where somebody is does not leave the machine: user and host names, home folders, serial numbers in the
names of ports, and passwords in addresses are replaced in every text before it is packed.
"""

from __future__ import annotations

import getpass
import importlib.metadata
import io
import platform
import re
import socket
import sys
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from openant_tools.comms.ports import Host
from openant_tools.errors import BadInput
from openant_tools.files import json_text, write_bytes
from openant_tools.optional import opencv
from openant_tools.robot.folder import RobotFolder

__all__ = ["Mask", "bundle", "gather"]

#: bytes of the end of a log, and findings, that go along
TAIL, FINDINGS = 200_000, 30
_HOME = re.compile(r"(/home/|/Users/|[A-Za-z]:(?:\\+|/)Users(?:\\+|/))[^/\\\s\"':;,]+")
_BY_ID = re.compile(r"(usb-[\w.\-]*?_)[A-Za-z0-9.]{4,}(?=-(?:if|port)\d)")
_MAC_PORT = re.compile(r"((?:tty|cu)\.(?:usbmodem|usbserial)-?)[\w.\-]+")
_IN_ADDRESS = re.compile(r"(\w+://)[^/\s:@\"']+(?::[^/\s@\"']*)?@")


@dataclass(frozen=True)
class Mask:
    """Replaces what is private in a text.

    Attributes:
        words: text → what stands for it, longest first.
    """

    words: tuple[tuple[str, str], ...]

    @classmethod
    def of_this_machine(cls, serials: Iterable[str] = (), home: Path | None = None) -> Mask:
        """By who runs this, where, and the serial numbers of what is plugged in."""
        private: dict[str, str] = {str(home or Path.home()): "~"}
        host = socket.gethostname()
        for name, word in ((host, "HOST"), (host.partition(".")[0], "HOST"), (_user(), "USER")):
            if len(name) > 1:
                private.setdefault(name, word)
        for serial in serials:
            if len(serial) > 3:
                private.setdefault(serial, "SERIAL")
        private.pop("/", None)
        return cls(tuple(sorted(private.items(), key=lambda pair: -len(pair[0]))))

    def __call__(self, text: str) -> str:
        for word, instead in self.words:
            # A name inside a longer word is another word; a path may go on.
            text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(word)}(?![A-Za-z0-9])", instead, text, flags=re.IGNORECASE)
        text = _HOME.sub(r"\1USER", text)
        text = _BY_ID.sub(r"\1SERIAL", text)
        text = _MAC_PORT.sub(r"\1SERIAL", text)
        return _IN_ADDRESS.sub(r"\1USER:PASSWORD@", text)


def gather(folder: RobotFolder | None, logs: Iterable[Path], host: Host | None = None) -> dict[str, str]:
    """Name in the bundle → its text, masked.

    Args:
        folder: the robot's; None where there is none.
        logs: files whose end goes along, where they are there.
    """
    ports = (host or Host()).ports()
    texts = {
        "versions.txt": _versions(),
        "ports.json": json_text([vars(port) | {"kind": port.kind} for port in ports], indent=2),
    }
    if folder is not None:
        named = [folder.config_file, folder.journal, folder.path / "errors.log"]
        findings = sorted(folder.findings.glob("*.json"), key=lambda file: file.stat().st_mtime)[-FINDINGS:]
        for file in (*named, *findings):
            texts |= _tail(file, f"robot/{file.relative_to(folder.path)}")
    for log in logs:
        texts |= _tail(log, f"log/{log.name}")
    serials = [port.serial_number for port in ports]
    mask = Mask.of_this_machine(serials)
    return {name: mask(text) for name, text in texts.items()}


def bundle(texts: dict[str, str], out: Path) -> None:
    """Write them as one .zip.

    Raises:
        BadInput: `out` is no name of a .zip.
        OSError: it cannot be written.
    """
    if out.suffix != ".zip":
        raise BadInput("a bundle is a .zip", where=out, remedy="name it openant-support.zip")
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(name, text)
    write_bytes(out, data.getvalue())


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # a container without a name for its user
        return ""


def _versions() -> str:
    packages = sorted({f"{one.metadata['Name']} {one.version}" for one in importlib.metadata.distributions()})
    head = [f"Python {sys.version.split()[0]} ({sys.executable})", platform.platform(), opencv().words]
    return "\n".join([*head, "", *packages]) + "\n"


def _tail(file: Path, name: str) -> dict[str, str]:
    try:
        with file.open("rb") as stream:
            stream.seek(0, io.SEEK_END)
            if stream.seek(max(0, stream.tell() - TAIL)):
                stream.readline()  # half a serial number is none that the mask would know
            return {name: stream.read().decode("utf-8", "replace")}
    except OSError:
        return {}
