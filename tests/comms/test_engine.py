"""The engine on a virtual robot in a process of its own: motions, guards, and every way to die with torque on."""

from __future__ import annotations

import functools
import json
import os
import re
import resource
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from builder import COARSE

from openant_tools.comms import engine_process, messages
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.guards import Guards
from openant_tools.comms.lateness import losses
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.restart import Interlock, MotionStopped, Restart, StopCause
from openant_tools.comms.setup import camera_of_robot, config_of_unknown_robot, imu_of_robot
from openant_tools.errors import HardwareFault
from openant_tools.recording.pictures import read_pictures
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts
from openant_tools.recording.tables import read_run
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.kit import home_angles
from openant_tools.virtual.process import virtual_robot

HOME = np.array(home_angles())
#: Patience of a test on a loaded machine; the engine itself promises 0.5 s (benchmarks/fault_campaign.py measures it).
PATIENCE_S = 20.0


def start(folder: Path, clock: str) -> Iterator[dict[str, str]]:
    scenario = folder / "blind.toml"
    scenario.write_text(f"{COARSE}[camera]\npresent = false\n[clock]\ndoze = true\n")
    with virtual_robot(str(scenario), clock=clock) as robot:
        yield dict(robot)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """A virtual Ant in real time."""
    yield from start(tmp_path_factory.mktemp("live"), "real")


@pytest.fixture(scope="module")
def stepped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """A virtual Ant whose time moves with the engine's; each test leaves its torque off."""
    yield from start(tmp_path_factory.mktemp("stepped"), "stepped")


def config(robot: dict[str, str], **changes: object) -> EngineConfig:
    return replace(config_of_unknown_robot(robot["bus"], robot["control"]), **changes)  # type: ignore[arg-type]


def state(robot: dict[str, str]) -> dict[str, object]:
    control = VirtualControl(robot["control"])
    try:
        return control.ask("state")
    finally:
        control.close()


def torques(robot: dict[str, str]) -> list[bool]:
    return list(state(robot)["torque_enable"].values())  # type: ignore[attr-defined]


def answers(robot: dict[str, str]) -> bool:
    try:
        return bool(config(robot))
    except HardwareFault:
        return False


def again_where_late(test: Callable[..., None]) -> Callable[..., None]:
    """Three tries for a test in real time, where what it was told blames this computer: then it says nothing of the engine."""

    @functools.wraps(test)
    def tried(*given: Any, **named: Any) -> None:
        for left in (2, 1, 0):
            try:
                return test(*given, **named)
            except (AssertionError, HardwareFault) as error:
                if not left or "this computer was late" not in str(error):
                    raise

    return tried


def wait_until(what: Callable[[], bool]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < give_up, "it never happened"
        time.sleep(0.02)


def connected(robot: dict[str, str]) -> EngineProcess:
    """An engine on a robot in real time: a busy machine may keep virtual servos from answering for longer than a bus waits."""
    give_up = time.monotonic() + PATIENCE_S
    while True:
        try:
            return EngineProcess(config(robot))
        except HardwareFault as fault:
            if "answer" not in str(fault) or time.monotonic() > give_up:
                raise


# ---- motions -----------------------------------------------------------------------------------------------------


def test_torque_comes_on_where_the_robot_stands_and_moves_do_not_jump(stepped: dict[str, str]) -> None:
    with EngineProcess(config(stepped)) as engine:
        before = engine.description["position"]
        start = engine.ask(messages.Torque(True))
        assert np.abs(start - before).max() < 0.01
        engine.ask(messages.Ramp(HOME))
        rows = engine.telemetry()
        commands = rows[:, [engine.columns.index(f"cmd.{joint}") for joint in JOINT_NAMES]]
        steps = np.abs(np.diff(commands, axis=0)).max()
        assert steps < 1.0 / 100 * 1.02  # 1 rad/s
        end = engine.ask(messages.Hold(0.5))
        assert np.abs(end - HOME).max() < 0.05
    assert not any(torques(stepped))


def test_recordings_hold_what_was_commanded_and_measured(stepped: dict[str, str], tmp_path: Path) -> None:
    wave = HOME + 0.2 * np.sin(np.arange(100) / 100 * 2 * np.pi)[:, None]
    with EngineProcess(config(stepped)) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(HOME))
        engine.ask(messages.Record(str(tmp_path / "run"), Facts(JOINT_NAMES, setup="stand")))
        engine.ask(messages.Play(wave, "wave"))
        path, cycles = engine.ask(messages.StopRecording())
    run = read_recording(path).run
    assert len(run.t) == cycles == 100
    command = run.signal("cmd")
    assert np.abs(command - wave).max() < 2 * np.pi / 4096
    assert run.signal("ok").all()
    assert np.nanmax(np.abs(run.signal("pos") - command)) < 0.2
    assert np.all(run.t - run.column("cmd_t") >= 0.2e-3 - 1e-9)
    assert np.diff(run.t) == pytest.approx(0.01, abs=1e-3)
    assert run.facts.extra["baud"] == 1_000_000
    assert run.facts.extra["latency_timer_ms"] == 1.0
    assert run.facts.registers["knee_fl"]["pwm_limit"] == 442
    assert ["hip_fl", "knee_fl"] in run.facts.extra["chain"]


def _swing(n: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """hip_fl swings from -0.25 to 0.25 rad and is let go in the middle for half a second; all else stays at home."""
    s = np.clip(np.arange(n) / 40, 0, 1)
    commands = np.repeat(HOME[None, :], n, axis=0)
    commands[:, 4] += -0.25 + 0.5 * s**3 * (10 - 15 * s + 6 * s**2)
    limp = np.zeros(commands.shape, bool)
    limp[22:72, 4] = True
    return commands, limp


def test_one_joint_is_let_go_and_caught_where_it_hangs_while_the_others_hold(
    stepped: dict[str, str], tmp_path: Path
) -> None:
    commands, limp = _swing()
    with EngineProcess(config(stepped)) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(commands[0]))
        engine.ask(messages.Record(str(tmp_path / "run"), Facts(JOINT_NAMES, setup="stand")))
        engine.ask(messages.Play(commands, "swing", limp))
        path, _ = engine.ask(messages.StopRecording())
        assert all(torques(stepped))
    run = read_recording(path).run
    torque, cmd, pos = run.signal("torque"), run.signal("cmd"), run.signal("pos")
    off = torque[:, 4] == 0
    assert off.sum() == pytest.approx(50, abs=2)
    assert (np.delete(torque, 4, axis=1) == 1).all()
    # The goal follows the leg, then leads it back gently.
    assert np.abs(cmd[off, 4][1:] - pos[off, 4][:-1]).max() < 2 * np.pi / 4096
    back = cmd[np.flatnonzero(off)[-1] :, 4]
    assert np.abs(np.diff(back)).max() < 1.0 / 100 * 1.1
    assert cmd[-1, 4] == pytest.approx(commands[-1, 4], abs=0.01)
    assert np.abs(np.delete(pos - commands[:1], 4, axis=1)).max() < 0.05


def test_a_leg_that_was_let_go_is_guarded_too(stepped: dict[str, str]) -> None:
    commands, limp = _swing()
    limits = dict.fromkeys(JOINT_NAMES, (-1.5, 1.5)) | {"hip_fl": (-0.3, 0.27)}
    commands[23:, 4] = 0.0
    limp[22:, 4], limp[-1, 4] = True, False
    commands[:23, 4] = np.linspace(-0.25, 0.24, 23)
    guarded = config(stepped, limits_rad=limits, guards=Guards(angle_margin_rad=0.0))
    with EngineProcess(guarded) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(commands[0]))
        with pytest.raises(HardwareFault, match=r"hip_fl .*°, outside its limits −17\.2 to 15\.5°"):
            engine.ask(messages.Play(commands, "swing", limp))
        assert not any(torques(stepped))


def test_a_motion_may_not_begin_nor_end_without_torque(stepped: dict[str, str]) -> None:
    commands, limp = _swing()
    limp[-1, 4] = True
    with EngineProcess(config(stepped)) as engine:
        engine.ask(messages.Torque(True))
        with pytest.raises(HardwareFault, match="must begin and end with the torque of all joints on"):
            engine.ask(messages.Play(commands, "swing", limp))


@pytest.mark.skipif(not hasattr(resource, "prlimit"), reason="limits of another process are Linux'")
def test_a_full_disk_ends_motion_until_the_builder_says_otherwise(stepped: dict[str, str], tmp_path: Path) -> None:
    with EngineProcess(config(stepped)) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Record(str(tmp_path / "full"), Facts(JOINT_NAMES)))
        unlimited = resource.prlimit(engine.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(engine.pid, resource.RLIMIT_FSIZE, (60_000, unlimited[1]))
        with pytest.raises(MotionStopped, match=r"the recording stopped; .* is kept, \d+ rows") as stopped:
            engine.ask(messages.Hold(60.0))
        assert stopped.value.cause is StopCause.STORAGE
        resource.prlimit(engine.pid, resource.RLIMIT_FSIZE, unlimited)
        assert not any(torques(stepped))
        with pytest.raises(HardwareFault, match="does not begin again by itself"):
            engine.ask(messages.Torque(True))
        for command in (messages.LetPass(0.1), messages.StopRecording()):  # neither overlooks that nothing is recorded
            with pytest.raises(MotionStopped, match="the recording stopped"):
                engine.ask(command)
        assert not any(torques(stepped))
        engine.ask(messages.Torque(True, Restart()))
        engine.ask(messages.Record(str(tmp_path / "run"), Facts(JOINT_NAMES)))
        engine.ask(messages.Hold(0.2))
        assert engine.ask(messages.StopRecording())[1] >= 15
    assert read_recording(tmp_path / "run.mcap").damage is None


def test_a_motion_that_the_watchdog_stopped_is_not_taken_for_going_on(live: dict[str, str]) -> None:
    for _ in range(3):  # on a busy computer servos may be found silent first, by its own fault, which it says
        with connected(live) as engine:
            engine.ask(messages.Torque(True))
            moving = engine.start(messages.Play(np.repeat(HOME[None, :], 3000, axis=0)))
            time.sleep(0.3)
            os.kill(engine.pid, signal.SIGSTOP)
            time.sleep(0.5)
            os.kill(engine.pid, signal.SIGCONT)
            with pytest.raises(HardwareFault) as stopped:
                wait_until(lambda engine=engine, moving=moving: engine.done(moving))
            if "this computer was late" in str(stopped.value):
                continue
            assert re.search(r"stood still for 0\.\d+ s, and the servos' Bus Watchdog stopped", str(stopped.value))
            with pytest.raises(HardwareFault, match="does not begin again by itself"):
                engine.ask(messages.Torque(True))
            engine.ask(messages.Torque(True, Interlock("comms soak").stopped(StopCause.STALL, "", 0.0)))
            engine.ask(messages.Hold(0.1))
            return
    pytest.fail("this computer is too busy to tell")


def test_what_cannot_be_is_refused_and_nothing_moves(stepped: dict[str, str]) -> None:
    with EngineProcess(config(stepped)) as engine:
        with pytest.raises(HardwareFault, match="torque is off"):
            engine.ask(messages.Ramp(HOME))
        engine.ask(messages.Torque(True))
        with pytest.raises(HardwareFault, match=r"114\.59° for hip_rr is outside its limits −45\.00 to 45\.00°"):
            engine.ask(messages.Ramp(np.full(8, 2.0)))
        with pytest.raises(HardwareFault, match="EEPROM is locked"):
            engine.ask(messages.WriteRegister("hip_rr", "pwm_limit", 400))


def test_a_second_connect_finds_the_port_taken(live: dict[str, str]) -> None:
    settings = config(live)
    with EngineProcess(settings) as engine, pytest.raises(HardwareFault, match=rf"held by .*process {engine.pid}"):
        EngineProcess(settings)


@pytest.mark.parametrize("full", [False, True])
def test_a_journal_that_cannot_be_written_keeps_the_servos_as_they_were_and_says_so(
    stepped: dict[str, str], tmp_path: Path, full: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    journal = tmp_path / "journal.jsonl"
    if full:
        journal.symlink_to("/dev/full")
    else:
        journal.mkdir()
    limit = {"hip_rr": {"temperature_limit": 71}}
    with pytest.raises(HardwareFault) as refused:
        EngineProcess(config(stepped, journal=str(journal), registers=limit))
    why = "No space left on device" if full else "Is a directory"
    assert str(refused.value) == (
        f"{journal}: the journal cannot be written ({why}), so temperature_limit of hip_rr was not written to its servo → "
        "make room there, or make the robot's folder one that can be written to, and try again"
    )
    assert "Traceback" not in capfd.readouterr().err
    with EngineProcess(config(stepped)) as engine:
        assert engine.description["registers"]["hip_rr"]["temperature_limit"] != 71


# ---- guards ------------------------------------------------------------------------------------------------------


def test_the_stop_key_releases_at_once(live: dict[str, str]) -> None:
    with connected(live) as engine:
        engine.ask(messages.Torque(True))
        moving = engine.start(messages.Play(np.repeat(HOME[None, :], 3000, axis=0)))
        time.sleep(0.3)
        engine.stop()
        assert not any(torques(live))
        with pytest.raises(HardwareFault, match="stopped by hand"):
            engine.done(moving)


def test_a_joint_out_of_bounds_stops_the_motion(stepped: dict[str, str]) -> None:
    settings = config(stepped, guards=Guards(angle_margin_rad=-0.5))
    with EngineProcess(settings) as engine:
        engine.ask(messages.Torque(True))
        with pytest.raises(HardwareFault, match=r"is at .*°, outside its limits .* → look for a wrong zero"):
            engine.ask(messages.Ramp(np.full(8, 0.6)))
        [stopped] = [event for event in engine.events() if isinstance(event, messages.Stopped)]
        assert stopped.joint in JOINT_NAMES
    assert not any(torques(stepped))


def test_a_silent_servo_stops_the_motion(live: dict[str, str]) -> None:
    with connected(live) as engine:
        engine.ask(messages.Torque(True))
        moving = engine.start(messages.Play(np.repeat(HOME[None, :], 3000, axis=0)))
        control = VirtualControl(live["control"])
        control.ask("unplug", joint="knee_fl")
        try:
            with pytest.raises(HardwareFault, match=r"has not answered for .* → look at the cable between hip_fl"):
                wait_until(lambda: engine.done(moving))
        finally:
            control.ask("plug", joint="knee_fl")
            control.close()
    wait_until(lambda: answers(live))  # a servo that gets its power back is mute for a while
    wait_until(lambda: not any(on for k, on in enumerate(torques(live)) if JOINT_NAMES[k] != "knee_fl"))


def test_a_servo_that_is_silent_just_when_a_motion_ends_stops_it_in_words(live: dict[str, str]) -> None:
    control = VirtualControl(live["control"])
    with connected(live) as engine:
        engine.ask(messages.Torque(True))
        control.ask("unplug", joint="knee_fl")
        try:
            with pytest.raises(HardwareFault, match=r"knee_fl \(id 31\).* (does|did|has) not answer"):
                engine.ask(messages.Hold(0.01))
            assert engine.ask(messages.Statistics())["cycles"] > 0  # it lives on
        finally:
            control.ask("plug", joint="knee_fl")
            control.close()
    wait_until(lambda: answers(live))


def test_a_computer_that_stood_still_takes_the_blame_for_what_it_missed(live: dict[str, str], tmp_path: Path) -> None:
    with connected(live) as engine:
        engine.ask(messages.Record(str(tmp_path / "run.mcap"), Facts(joints=tuple(JOINT_NAMES))))
        for _ in range(5):
            os.kill(engine.description["pid"], signal.SIGSTOP)
            time.sleep(0.06)
            os.kill(engine.description["pid"], signal.SIGCONT)
            engine.ask(messages.LetPass(0.2))
        engine.ask(messages.StopRecording())
        said = engine.ask(messages.Statistics())["late"]
    assert "this computer was late by up to" in said
    run = read_run(tmp_path / "run.mcap", need=())
    assert run.column("wake").max() > 0.04
    judged = losses(run).counted  # of no reads at all, where this computer was late all the time
    assert (judged.sum(axis=0) < 0.01 * max(len(judged), 1)).all()


def test_two_servos_with_one_id_are_told_from_a_cable(live: dict[str, str]) -> None:
    """A common read stays silent from the first missing id on; asked one by one, the two give themselves away."""
    control = VirtualControl(live["control"])
    with connected(live) as engine:
        engine.ask(messages.Torque(True))
        moving = engine.start(messages.Play(np.repeat(HOME[None, :], 3000, axis=0)))
        control.ask("fault", cause="duplicate_id", where="knee_rr", of="hip_fl", on=True)
        try:
            with pytest.raises(HardwareFault, match=r"knee_rr \(id 11\) is silent and .* hip_fl .* both have id 30"):
                wait_until(lambda: engine.done(moving))
        finally:
            control.ask("fault", cause="duplicate_id", where="knee_rr", on=False)
            control.close()


@again_where_late
def test_unplugging_stops_the_motion_and_plugging_in_goes_on_from_there(live: dict[str, str], tmp_path: Path) -> None:
    out = tmp_path / f"run-{len(list(tmp_path.iterdir()))}.mcap"
    control = VirtualControl(live["control"])
    with connected(live) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Record(str(out), Facts(JOINT_NAMES)))
        moving = engine.start(messages.Play(np.repeat(HOME[None, :], 3000, axis=0)))
        time.sleep(0.5)
        control.ask("fault", cause="usb_unplug", device="bus", on=True)
        try:
            with pytest.raises(HardwareFault, match=r"the port is gone .* watchdog stops them"):
                wait_until(lambda: engine.done(moving))
        finally:
            control.ask("fault", cause="usb_unplug", device="bus", on=False)
        said: list[str] = []

        def back() -> bool:
            said.extend(event.text for event in engine.events() if isinstance(event, messages.Notice))
            return "the port is back" in said

        wait_until(back)
        assert any("torque was still on" in text for text in said)
        assert not any(torques(live))
        engine.ask(messages.Torque(True, Restart()))  # whoever plugged it in again says so
        engine.ask(messages.Hold(0.2))
    control.close()
    recording = read_recording(out)
    assert recording.damage is None
    ends = [(event["kind"], event["cause"]) for event in recording.events if event["kind"] in ("stopped", "restart")]
    assert ends == [("stopped", "port"), ("restart", None)]


@again_where_late
def test_plugging_in_while_the_program_ends_switches_torque_off(live: dict[str, str]) -> None:
    """What the watchdog has stopped holds on; who gives up at a port that is gone still waits a moment for it."""
    control = VirtualControl(live["control"])
    back = threading.Timer(1.0, lambda: control.ask("fault", cause="usb_unplug", device="bus", on=False))
    try:
        with connected(live) as engine:
            engine.ask(messages.Torque(True))
            moving = engine.start(messages.Play(np.repeat(HOME[None, :], 3000, axis=0)))
            time.sleep(0.3)
            control.ask("fault", cause="usb_unplug", device="bus", on=True)
            with pytest.raises(HardwareFault, match="they hold where they are: plug the USB cable in again at once"):
                wait_until(lambda: engine.done(moving))
            back.start()
        assert not any(torques(live))
    finally:
        back.join()
        control.close()


@again_where_late
def test_a_servo_that_does_not_hear_that_it_is_to_let_go_is_named(live: dict[str, str]) -> None:
    """Its data wire is broken, its power is not: it holds on."""
    control = VirtualControl(live["control"])
    with connected(live) as engine:
        engine.ask(messages.Torque(True))
        moving = engine.start(messages.Play(np.repeat(HOME[None, :], 3000, axis=0)))
        control.ask("fault", cause="broken_wire", where=["hip_fl", "knee_fl"], on=True)
        try:
            with pytest.raises(
                HardwareFault, match=r"knee_fl.* may still hold: cut the power before you touch the robot"
            ):
                wait_until(lambda: engine.done(moving))
            assert torques(live)[JOINT_NAMES.index("knee_fl")]
        finally:
            control.ask("fault", cause="broken_wire", where=["hip_fl", "knee_fl"], on=False)
            control.close()
    wait_until(lambda: answers(live))


def test_an_engine_that_stands_still_is_not_waited_for_for_ever(
    live: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_process, "SILENT_LOOKS", 10)
    with connected(live) as engine:
        engine.ask(messages.Torque(True))
        moving = engine.start(messages.Hold(60.0))
        os.kill(engine.pid, signal.SIGSTOP)
        try:
            with pytest.raises(HardwareFault, match="the engine does not answer and reads nothing for 1 s"):
                engine.wait(moving)
            wait_until(lambda: not any(torques(live)))  # its guardian has switched it off
        finally:
            os.kill(engine.pid, signal.SIGCONT)


# ---- dying with torque on ----------------------------------------------------------------------------------------

PARENT = textwrap.dedent(
    """
    import json, sys, time, pickle
    import numpy as np
    from openant_tools.comms import messages
    from openant_tools.comms.engine_process import EngineProcess
    from openant_tools.recording.run import Facts
    config, home, out = pickle.loads(bytes.fromhex(sys.argv[1]))
    engine = EngineProcess(config)
    engine.ask(messages.Torque(True))
    engine.ask(messages.Record(out, Facts(tuple(s.joint for s in config.servos))))
    t = np.arange(60 * 100) / 100
    engine.start(messages.Play(home + 0.2 * np.sin(2 * np.pi * t)[:, None]))
    print(json.dumps({"engine": engine.pid, "guardian": engine.description["guardian_pid"]}), flush=True)
    time.sleep(120)
    """
)


@pytest.fixture
def moving(live: dict[str, str], tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], dict[str, int], Path]]:
    """A program that moves the legs: its process, the ids of engine and guardian, and its recording."""
    import pickle

    out, log = tmp_path / "run.mcap", tmp_path / "log"
    payload = pickle.dumps((config(live), HOME, str(out))).hex()
    for left in (2, 1, 0):
        with log.open("wb") as errors:
            words = [sys.executable, "-c", PARENT, payload]
            parent = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=errors, text=True)
        assert parent.stdout is not None
        said = parent.stdout.readline()
        if said:
            break
        assert left, log.read_text()
        assert "this computer was late" in log.read_text()
    pids = json.loads(said)
    wait_until(lambda: all(torques(live)))
    time.sleep(1.5)  # a second of recording reaches the disk
    yield parent, pids, out
    parent.kill()
    parent.wait()
    wait_until(lambda: not alive(pids["engine"]) and not alive(pids["guardian"]))


def alive(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


def test_who_finds_the_port_taken_is_told_the_program_and_neither_its_engine_nor_the_virtual_robot(
    live: dict[str, str], moving: tuple[subprocess.Popen[str], dict[str, int], Path]
) -> None:
    parent, _, _ = moving
    with pytest.raises(HardwareFault) as taken:
        EngineProcess(config(live))
    assert re.findall(r"process (\d+)", str(taken.value)) == [str(parent.pid)]


def test_killing_the_parent_releases_the_robot_and_keeps_the_recording(
    live: dict[str, str], moving: tuple[subprocess.Popen[str], dict[str, int], Path]
) -> None:
    parent, pids, out = moving
    parent.kill()
    wait_until(lambda: not any(torques(live)))
    wait_until(lambda: not alive(pids["engine"]))
    assert len(read_recording(out).run.t) > 30


def test_killing_the_engine_leaves_it_to_the_guardian(
    live: dict[str, str], moving: tuple[subprocess.Popen[str], dict[str, int], Path]
) -> None:
    _, pids, out = moving
    os.kill(pids["engine"], signal.SIGKILL)
    wait_until(lambda: not any(torques(live)))
    assert len(read_recording(out).run.t) > 30


def test_killing_both_leaves_it_to_the_servos_watchdog_and_the_next_connect_says_so(
    live: dict[str, str], moving: tuple[subprocess.Popen[str], dict[str, int], Path]
) -> None:
    parent, pids, _ = moving
    os.kill(pids["engine"], signal.SIGSTOP)  # or it starts another guardian in between
    os.kill(pids["guardian"], signal.SIGKILL)
    os.kill(pids["engine"], signal.SIGKILL)
    parent.kill()
    wait_until(lambda: not alive(pids["engine"]) and not alive(pids["guardian"]))
    time.sleep(0.5)
    assert all(torques(live))  # as in the real servo: the motion has stopped, torque is still on
    before = state(live)["angle"]
    time.sleep(0.3)
    assert state(live)["angle"] == pytest.approx(before, abs=0.01)
    with connected(live) as engine:
        notices = [event.text for event in engine.events() if isinstance(event, messages.Notice)]
        assert any("torque was still on" in text for text in notices)
        assert any("Bus Watchdog" in text and "cleared" in text for text in notices)
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(HOME))


def test_sigterm_ends_in_good_order(
    live: dict[str, str], moving: tuple[subprocess.Popen[str], dict[str, int], Path]
) -> None:
    _, pids, out = moving
    os.kill(pids["engine"], signal.SIGTERM)
    wait_until(lambda: not alive(pids["engine"]))
    assert not any(torques(live))
    assert len(read_recording(out).run.t) > 30


def test_body_and_joints_stand_in_one_recording(tmp_path: Path) -> None:
    """On the floor the engine takes poses, pictures and IMU beside the bus, all on one clock."""
    scenario, out = tmp_path / "floor.toml", tmp_path / "run.mcap"
    look = "position = [-0.35, 0.2, 1.3]\nlook_at = [-0.35, 0.2, 0.0]\n"
    scenario.write_text(f'[robot]\nsetup = "floor"\n[camera]\nwidth = 640\nheight = 360\n{look}')
    with virtual_robot(str(scenario), clock="stepped") as robot:
        seen = {"imu": imu_of_robot(None, robot["imu"]), "camera": camera_of_robot(None, robot["camera"])}
        with EngineProcess(config(robot, **seen)) as engine:  # type: ignore[arg-type]
            engine.ask(messages.Torque(True))
            engine.ask(messages.Ramp(HOME))
            engine.ask(messages.Record(str(out), Facts(joints=(), setup="floor"), pictures=True))
            engine.ask(messages.Hold(1.0))
            truth = VirtualControl(robot["control"]).ask("state")["base"]
            row = dict(zip(engine.columns, engine.telemetry()[-1].tolist(), strict=True))
            engine.ask(messages.StopRecording())
    recording = read_recording(out)
    assert recording.pose is not None
    assert len(recording.pose.t) > 15
    x, y, z = truth["position"]
    assert [row["base.x"], row["base.y"], row["base.z"]] == pytest.approx([x + 0.75, y - 0.30, z], abs=0.02)
    assert row["base.yaw"] == pytest.approx(2 * truth["quaternion"][3], abs=0.03)
    assert np.nanmedian(recording.run.columns["base.x"]) == pytest.approx(row["base.x"], abs=5e-3)
    kept = list(read_pictures(out))
    assert [one.t for one in kept] == pytest.approx(recording.pictures.t.tolist())
    assert 5 <= len(kept) <= 6  # of some thirty
    assert np.diff(recording.pictures.t).min() == pytest.approx(0.2, abs=1e-3)
    assert set(recording.pictures.t.round(6)) <= set(recording.pose.t.round(6))
    assert cv2.imdecode(np.frombuffer(kept[-1].jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (360, 640, 3)


def test_pictures_are_recorded_only_where_a_camera_sends_some(live: dict[str, str], tmp_path: Path) -> None:
    with EngineProcess(config(live)) as engine, pytest.raises(HardwareFault, match="no camera sends pictures"):
        engine.ask(messages.Record(str(tmp_path / "run.mcap"), Facts(joints=()), pictures=True))
    assert not (tmp_path / "run.mcap").exists()


def test_a_virtual_robot_that_ends_is_told_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    ready, scenario = tmp_path / "ready.json", tmp_path / "blind.toml"
    scenario.write_text('[camera]\npresent = false\n[clock]\nmode = "stepped"\n')
    words = ["virtual", "start", "--scenario", str(scenario), "--ready-file", str(ready)]
    with subprocess.Popen([sys.executable, "-m", "openant_tools.cli", *words]) as robot:
        while not ready.is_file():
            assert robot.poll() is None
            time.sleep(0.02)
        with EngineProcess(config(json.loads(ready.read_text()))) as engine:
            engine.ask(messages.Torque(True))
            robot.kill()
            # What it notices first is chance: port, clock or process.
            with pytest.raises(HardwareFault):
                engine.ask(messages.Hold(60.0))
    assert "Traceback" not in capfd.readouterr().err
