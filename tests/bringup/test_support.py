"""The public face: a bundle for a bug report that tells nobody's secrets, one log, commands that are nearly right."""

from __future__ import annotations

import socket
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from openant_tools.bringup.support import TAIL, Mask, gather
from openant_tools.cli import main
from openant_tools.robot.folder import RobotFolder, create_robot

SECRETS = ("quincy", "lab-pc-7", "FT9HDL4X", "345678901234", "0x8000000", "hunter2", "AB0KXYZ7")


def run(*words: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return int(ended.value.code or 0)


@pytest.fixture
def somebody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RobotFolder:
    """Quincy's machine, and a robot's folder that tells of it in every file."""
    home = tmp_path / "home" / "quincy"
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("XDG_STATE_HOME", str(home / "state"))
    monkeypatch.setattr("getpass.getuser", lambda: "quincy")
    monkeypatch.setattr(socket, "gethostname", lambda: "lab-pc-7.example.org")
    folder = create_robot(home / "my-ant")
    folder.update(
        {
            "ports.bus": "/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_FT9HDL4X-if00-port0",
            "ports.imu": "/dev/serial/by-id/usb-Betaflight_Betaflight_STM32F7x2_345678901234-if00",
            "ports.camera": "rtsp://quincy:hunter2@10.0.0.9/stream",
        }
    )
    folder.findings.mkdir(exist_ok=True)
    (folder.findings / "connect.json").write_text(
        '{"bus": "/dev/tty.usbserial-AB0KXYZ7", "imu": "/dev/cu.usbmodem0x8000000", "host": "LAB-PC-7", '
        '"log": "C:\\\\Users\\\\quincy\\\\log.txt", "model": "/home/quincy/other/calibrated.xml"}'
    )
    return folder


def test_a_bundle_has_what_a_report_needs_and_no_secret(
    somebody: RobotFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("rec", "info", somebody.path / "recordings" / "walk.mcap") == 2  # stands in the log, with its path
    out = tmp_path / "bug.zip"
    assert run("support", "--robot", somebody.path, "--out", out) == 2, "nobody is there to ask"
    assert not out.exists()
    assert run("support", "--robot", somebody.path, "--out", out, "--yes") == 0
    listed = capsys.readouterr().out
    with zipfile.ZipFile(out) as archive:
        texts = {name: archive.read(name).decode() for name in archive.namelist()}
    assert {"versions.txt", "ports.json", "robot/robot.toml", "robot/findings/connect.json", "log/openant.log"} <= set(
        texts
    )
    assert all(name in listed for name in texts)
    for name, text in texts.items():
        for secret in SECRETS:
            assert secret.lower() not in text.lower(), f"{secret} in {name}"
    assert "usb-FTDI_USB__-__Serial_Converter_SERIAL-if00-port0" in texts["robot/robot.toml"]
    assert "~/my-ant/recordings/walk.mcap" in texts["log/openant.log"]
    assert "openant-tools" in texts["versions.txt"]


def test_the_end_of_a_long_log_begins_with_a_whole_line(tmp_path: Path) -> None:
    """Cut anywhere, half a serial number would stand at its beginning, and no pattern knows it."""
    line = "/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_FT9HDL4X-if00-port0 answers\n"
    logs = [tmp_path / f"{extra}.log" for extra in range(len(line))]
    for extra, log in enumerate(logs):
        log.write_text(line * (TAIL // len(line) + 2) + "x" * extra)
    told = gather(None, logs)
    begun = {told[f"log/{log.name}"].splitlines()[0] for log in logs}
    assert begun == {"/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_SERIAL-if00-port0 answers"}


def test_a_name_is_masked_as_a_word_and_not_within_another() -> None:
    mask = Mask((("/home/ann", "~"), ("ann", "USER")))
    assert mask("/home/ann/x by ann, an annual plan of /home/bob") == "~/x by USER, an annual plan of /home/USER"


def test_every_command_can_say_more_or_less_and_the_log_keeps_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert run("config", "new", "--robot", tmp_path / "ant") == 0
    assert "openant config" not in capsys.readouterr().err
    assert run("config", "show", "--robot", tmp_path / "ant", "-v") == 0
    assert run("-q", "config", "show", "--robot", tmp_path / "ant") == 0
    assert capsys.readouterr().err == ""
    assert run("config", "check", "--robot", tmp_path / "ant") == 0
    assert "OpenCV" in capsys.readouterr().err, "-q was of the command before"
    assert run("config", "check", "--robot", tmp_path / "ant", "-q") == 0
    assert capsys.readouterr().err == ""
    log = (tmp_path / "openant" / "openant.log").read_text()
    assert log.count(" INFO openant_tools[") == 5
    assert f"openant config new --robot {tmp_path / 'ant'}" in log
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "ant" / "robot.toml"))  # a file: nothing can be kept there
    assert run("config", "show", "--robot", tmp_path / "ant") == 0
    assert capsys.readouterr().err == ""


def test_a_command_that_is_nearly_right_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("sysd") == 2
    assert "No such command 'sysd'. Did you mean 'sysid'" in capsys.readouterr().err
    assert run("frobnicate") == 2
    assert capsys.readouterr().err == "openant: No such command 'frobnicate' → `openant --help` says what it takes\n"


def test_the_package_runs_as_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "openant_tools", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout.startswith("openant")) == (0, True)
