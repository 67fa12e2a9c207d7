"""Excitations, and `openant sysid record`, `comms scan`, `comms bench` from the command line on a virtual robot."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.cli.comms import comms
from openant_tools.cli.sysid_record import record
from openant_tools.errors import BadInput
from openant_tools.recording.reader import read_recording
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.sysid.protocols import PROTOCOLS, CommandSpace, protocol

RATE = 100.0
SPACE = CommandSpace.around_home()


@given(
    st.sampled_from(sorted(PROTOCOLS)),
    st.floats(5, 60),
    st.integers(0, 2**32 - 1),
    st.sampled_from([20.0, 50.0, 100.0]),
)
@settings(max_examples=40, deadline=None)
def test_every_protocol_stays_in_bounds_and_begins_and_ends_at_rest_at_home(
    name: str, seconds: float, seed: int, rate: float
) -> None:
    commands = protocol(name, seconds).commands(SPACE, rate, seed)
    assert abs(len(commands) / rate - seconds) < 0.2
    assert commands[0] == pytest.approx(SPACE.home)
    assert commands[-1] == pytest.approx(SPACE.home)
    quiet = int(0.05 * rate) + 1
    assert np.abs(commands[:quiet] - SPACE.home).max() < 5e-3
    assert np.abs(commands[-quiet:] - SPACE.home).max() < 5e-3
    assert (commands >= SPACE.low - 1e-9).all()
    assert (commands <= SPACE.high + 1e-9).all()


SUDDEN = ("full", "stand", "steps", "saturating-steps", "square", "releases", "drops")


@pytest.mark.parametrize("name", [name for name in PROTOCOLS if name not in SUDDEN])
def test_smooth_protocols_are_slow_enough_to_follow(name: str) -> None:
    commands = protocol(name).commands(SPACE, RATE, 3)
    assert np.abs(np.diff(commands, axis=0)).max() * RATE < 1.3 * SPACE.speed + 0.5


def test_steps_are_no_larger_than_said() -> None:
    assert np.abs(np.diff(protocol("steps").commands(SPACE, RATE, 5), axis=0)).max() <= 0.35 + 1e-9


def test_every_joint_is_excited_in_its_own_way() -> None:
    commands = protocol("stand").commands(SPACE, RATE, 0) - SPACE.centre
    moving = commands[150:900]
    correlation = np.corrcoef(moving.T)
    assert np.abs(correlation[~np.eye(8, dtype=bool)]).max() < 0.97
    assert (moving.std(0) > 0.05).all()


def test_the_same_seed_plays_the_same() -> None:
    first, second, other = (protocol("stand").commands(SPACE, RATE, seed) for seed in (4, 4, 5))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_what_cannot_be_played_is_refused() -> None:
    with pytest.raises(BadInput, match=r"no protocol 'chrip' → use one of full, stand, chirp"):
        protocol("chrip")
    with pytest.raises(BadInput, match=r"2\.0 s is too short"):
        protocol("stand", 2.0)
    with pytest.raises(BadInput, match="limits of knee_fl leave no room around the home pose"):
        CommandSpace.around_home({"knee_fl": (-0.5, 0.5)})


# ---- sysid record ------------------------------------------------------------------------------------------------


def test_a_virtual_robot_is_recorded_and_the_recording_says_what_was_played(tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    result = CliRunner().invoke(
        record,
        [
            "--virtual",
            "--protocol",
            "chirp",
            "--seconds",
            "6",
            "--seed",
            "7",
            "--repeat",
            "2",
            "--out",
            str(out),
            "--yes",
        ],
    )
    assert result.exit_code == 0, result.output
    first, second = read_recording(out).run, read_recording(tmp_path / "run-2.mcap").run
    commands = protocol("chirp", 6.0).commands(SPACE, RATE, 7)
    assert np.abs(first.signal("cmd") - commands).max() < 2 * np.pi / 4096
    assert first.signal("cmd") == pytest.approx(second.signal("cmd"))
    assert second.facts.repeat_of == "run"
    facts = first.facts
    assert (facts.protocol, facts.setup, facts.joints) == ("chirp", "stand", JOINT_NAMES)
    assert facts.supply_v == pytest.approx(12.0, abs=0.3)
    assert facts.motors["knee_fl"] == "XM430-W350-T"
    assert facts.registers["hip_rr"]["position_p_gain"] == 700
    assert facts.resolution["pos"] == pytest.approx(2 * np.pi / 4096)
    assert (first.t - first.column("cmd_t")).min() >= 0.2e-3 - 1e-9
    # At rest at both ends, and following in between.
    assert np.abs(first.signal("vel")[:5]).max() < 0.1
    assert np.sqrt(np.mean((first.signal("pos") - commands) ** 2)) < 0.2


def test_without_a_word_nothing_moves(tmp_path: Path) -> None:
    result = CliRunner().invoke(record, ["--virtual", "--out", str(tmp_path / "run.mcap")])
    assert isinstance(result.exception, BadInput)
    assert "nobody is there to ask → add --yes" in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_is_never_overwritten_nor_made_as_a_table(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(b"old")
    for name, words in (("run.mcap", "there is a recording already"), ("run.parquet", "a recording is a .mcap file")):
        result = CliRunner().invoke(record, ["--virtual", "--out", str(tmp_path / name), "--yes"])
        assert isinstance(result.exception, BadInput)
        assert words in str(result.exception)
    assert (tmp_path / "run.mcap").read_bytes() == b"old"


def test_ctrl_c_leaves_torque_off_and_a_whole_recording(tmp_path: Path) -> None:
    out, ready = tmp_path / "run.mcap", tmp_path / "ready.json"
    cli = [sys.executable, "-m", "openant_tools.cli"]
    robot = subprocess.Popen(
        [*cli, "virtual", "start", "--ready-file", str(ready)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        _wait(ready.is_file)
        command = ["--virtual", str(ready), "--out", str(out), "--yes"]
        call = (
            "from openant_tools.cli import _interrupt; import signal; signal.signal(signal.SIGTERM, _interrupt); "
            f"from openant_tools.cli.sysid_record import record; record({command!r}, standalone_mode=False)"
        )
        player = subprocess.Popen([sys.executable, "-c", call], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        _wait(out.is_file)
        time.sleep(2.0)
        os.kill(player.pid, signal.SIGINT)
        player.wait(30)
        from openant_tools.comms.clock import VirtualControl

        control = VirtualControl(json.loads(ready.read_text())["control"])
        assert not any(control.ask("state")["torque_enable"].values())
        control.close()
    finally:
        robot.send_signal(signal.SIGINT)
        robot.wait(10)
    recording = read_recording(out)
    assert recording.damage is None
    assert len(recording.run.t) > 20


def _wait(what: object) -> None:
    give_up = time.monotonic() + 30
    while not what():  # type: ignore[operator]
        assert time.monotonic() < give_up
        time.sleep(0.05)


# ---- comms -------------------------------------------------------------------------------------------------------


def test_scan_lists_every_servo_as_promised(tmp_path: Path) -> None:
    found = tmp_path / "found.json"
    result = CliRunner().invoke(comms, ["scan", "--virtual", "--json", str(found)])
    assert result.exit_code == 0, result.output
    servos = json.loads(found.read_text())
    assert [servo["id"] for servo in servos] == [10, 11, 20, 21, 30, 31, 40, 41]
    assert {servo["baud"] for servo in servos} == {1_000_000}
    assert {servo["model_number"] for servo in servos} == {1020, 1080}
    assert all("firmware" in servo for servo in servos)


def test_scan_of_a_rate_that_nobody_speaks_says_so() -> None:
    result = CliRunner().invoke(comms, ["scan", "--virtual", "--baud", "57600"])
    assert "nothing answered at any baud rate → is the supply on" in str(result.exception)


def test_ports_need_no_hardware() -> None:
    assert CliRunner().invoke(comms, ["ports"]).exit_code == 0
