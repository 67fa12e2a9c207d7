"""The vendor's SDK as a second opinion, over a pseudo-terminal in real time: it sees the same servos, and the same silence."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from openant_tools.cli import main

#: one of the eight is not plugged in
SCENARIO = """
[robot]
plugged = ["hip_rr", "knee_rr", "hip_fr", "knee_fr", "hip_fl", "hip_rl", "knee_rl"]
"""


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("robot")
    (folder / "robot.toml").write_text(SCENARIO)
    path = folder / "ready.json"
    start = [sys.executable, "-m", "openant_tools", "virtual", "start", "--no-camera", "--scenario", "robot.toml"]
    with subprocess.Popen([*start, "--ready-file", path], cwd=folder, stdout=subprocess.DEVNULL) as process:
        give_up = time.monotonic() + 60
        while not path.is_file():
            assert process.poll() is None
            assert time.monotonic() < give_up
            time.sleep(0.05)
        yield path
        process.terminate()


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The SDK waits 34 ms, which a busy machine needs at times to wake the virtual robot up."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 300)


def run(*words: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return int(ended.value.code or 0)


def test_the_inventory_asked_by_the_vendor_names_the_silent_servo_and_keeps_nothing(
    ready: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, out = tmp_path / "ant", tmp_path / "inventory.json"
    assert run("config", "new", "--robot", robot) == 0
    asked = ("calib", "inventory", "--driver", "sdk", "--robot", robot, "--virtual", ready, "--json", out)
    assert run(*asked) == 1
    said = capsys.readouterr().out
    assert "knee_fl (id 31): the vendor's SDK gets no answer: There is no status packet" in said
    ids = {
        joint: values["id"] for joint, values in json.loads(out.read_text())["data"]["eeprom"].items() if "id" in values
    }
    assert ids, "a busy machine may lose some, not all"
    assert ids.items() <= {
        "hip_rr": 10, "knee_rr": 11, "hip_fr": 20, "knee_fr": 21, "hip_fl": 30, "hip_rl": 40, "knee_rl": 41,
    }.items()  # fmt: skip
    assert not (robot / "findings").exists() or not list((robot / "findings").glob("*.json"))


def test_its_losses_are_shown_by_servo_in_its_own_words(ready: Path, tmp_path: Path) -> None:
    from openant_tools.comms.vendor_sdk import VendorSdk

    with VendorSdk(json.loads(ready.read_text())["bus"], 1_000_000) as sdk:
        blocks = [sdk.sync_read([10, 31, 40], 132, 4) for _ in range(2)]
        assert all(31 not in block for block in blocks)
        assert "There is no status packet" in sdk.why(31)
        assert any(10 in block for block in blocks)
        assert any(40 in block for block in blocks), "who stands behind a silent one is asked alone"
