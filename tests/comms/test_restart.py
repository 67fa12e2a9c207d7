"""What goes on by itself and what does not: the table, the faces that ask it, and recorders on a disk that takes no more."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import resource
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from builder import COARSE, finished
from click.testing import CliRunner
from places import ROOT

from openant_tools.cli.comms import comms
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.restart import (
    RULES,
    Interlock,
    MotionStopped,
    Restart,
    StopCause,
    longest_wait_s,
    restart_page,
    unattended_words,
)
from openant_tools.comms.setup import config_of_unknown_robot
from openant_tools.comms.soak import soak as soak_bus
from openant_tools.errors import OpenAntError
from openant_tools.recording.reader import read_recording
from openant_tools.sysid.protocols import protocol
from openant_tools.sysid.record import Take, record_takes
from openant_tools.thermal.soak import SoakPlan, soak_config
from openant_tools.thermal.soak import soak as soak_servos
from openant_tools.virtual.process import virtual_robot

PAGE = ROOT / "docs" / "restart.md"
#: what ends motion for good by the issue that this table answers
FOR_GOOD = ("storage", "limits", "port", "guardian", "fall", "by_hand", "unknown")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    scenario = tmp_path_factory.mktemp("scenario") / "blind.toml"
    scenario.write_text(f"{COARSE}[camera]\npresent = false\n[clock]\ndoze = true\n")
    with virtual_robot(str(scenario), clock="stepped") as found:
        yield dict(found)  # type: ignore[arg-type]


def config(robot: dict[str, str], rate_hz: float = 30.0) -> EngineConfig:
    return config_of_unknown_robot(robot["bus"], robot["control"], rate_hz=rate_hz)


def torque(robot: dict[str, str]) -> int:
    control = VirtualControl(robot["control"])
    try:
        return sum(control.ask("state")["torque_enable"].values())
    finally:
        control.close()


# ---- the table -----------------------------------------------------------------------------------------------------


def test_the_page_is_made_from_the_table() -> None:
    assert PAGE.read_text(encoding="utf-8") == restart_page(), "python -m openant_tools.comms.restart > docs/restart.md"
    assert set(RULES) == set(StopCause)
    for cause in FOR_GOOD:
        assert not RULES[StopCause(cause)].faces
    assert all(rule.times and rule.within_s and rule.condition for rule in RULES.values() if rule.faces)


def test_a_hardware_error_that_comes_back_after_its_reboot_ends_motion_for_good_at_that_servo_alone() -> None:
    interlock = Interlock("openant_env")
    assert interlock.stopped(StopCause.HARDWARE_ERROR, "overload", 0.0, "knee_fl") == Restart(
        StopCause.HARDWARE_ERROR, 1, 1
    )
    assert interlock.stopped(StopCause.HARDWARE_ERROR, "overload", 10.0, "knee_fr") is not None
    assert interlock.stopped(StopCause.HARDWARE_ERROR, "overload", 900.0, "knee_fl") is None
    assert interlock.ended == "overload (the second time within 1 h)"
    assert interlock.word().cause is None
    assert not interlock.ended
    assert interlock.stopped(StopCause.HARDWARE_ERROR, "overload", 901.0, "knee_fl") is not None


def test_what_may_go_on_does_so_a_stated_number_of_times() -> None:
    interlock = Interlock("comms soak")
    rule = RULES[StopCause.SILENCE]
    for k in range(rule.times):
        restart = interlock.stopped(StopCause.SILENCE, "knee_fl is silent", float(k))
        assert restart == Restart(StopCause.SILENCE, k + 1, rule.times)
        assert str(restart) == f"motion begins again by itself after silence, {k + 1} of {rule.times}"
    assert interlock.stopped(StopCause.SILENCE, "knee_fl is silent", rule.times) is None
    assert Interlock("comms soak").stopped(StopCause.HEAT, "hot", 0.0) is None  # the environment's row


def test_who_leaves_is_told_all_of_the_table_and_nothing_waits_longer_than_it_counts() -> None:
    said = "\n".join(unattended_words())
    alone, ends = said.split("All else ends the run")
    for rule in RULES.values():
        assert rule.what in (alone if "openant_env" in rule.faces else ends)
    assert "the camera does not see the robot: 20× in 10 min, once it is seen again" in alone
    assert longest_wait_s(StopCause.TAG) == 600.0
    assert longest_wait_s(StopCause.HEAT) == longest_wait_s(None) == longest_wait_s(StopCause.BY_HAND) == 3600.0


# ---- disks ---------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def disk_of(monkeypatch: pytest.MonkeyPatch, size: int) -> Iterator[None]:
    """Engines that are started meanwhile find that no file grows beyond `size` bytes (as on a full disk, without root)."""
    plain = subprocess.Popen

    class Limited(plain):  # type: ignore[type-arg,misc,valid-type]
        def __init__(self, args: list[str], **options: object) -> None:
            limited = "openant_tools.comms.engine" in args
            super().__init__(["prlimit", f"--fsize={size}", "--", *args] if limited else args, **options)

    monkeypatch.setattr(subprocess, "Popen", Limited)
    try:
        yield
    finally:
        monkeypatch.undo()


needs_prlimit = pytest.mark.skipif(
    not hasattr(resource, "prlimit") or shutil.which("prlimit") is None, reason="limits of another process are Linux'"
)


@needs_prlimit
@pytest.mark.parametrize("still", [False, True])
def test_a_soak_of_the_bus_ends_for_good_when_the_disk_is_full(
    robot: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, still: bool
) -> None:
    said: list[str] = []
    with disk_of(monkeypatch, 70_000):
        soaked = finished(
            soak_bus(config(robot, 100.0), tmp_path / "soak.mcap", 60.0, move=not still, thin_s=None), said
        )
    assert torque(robot) == 0
    assert "the recording stopped" in soaked.ended
    assert len(soaked.stops) == 1, "nothing moved again"
    assert not soaked.whole
    rows = read_recording(soaked.path).run.t
    assert soaked.cycles == len(rows) > 50, "what was recorded is kept and counted"
    assert soaked.seconds < 60.0


@needs_prlimit
def test_the_command_says_so_in_one_line_and_exits_with_1(
    robot: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready = tmp_path / "ready.json"
    ready.write_text(json.dumps(robot))
    with disk_of(monkeypatch, 70_000):
        done = CliRunner().invoke(
            comms,
            ["soak", "--virtual", str(ready), "--minutes", "1", "--every-cycle", "--out", str(tmp_path / "s"), "--yes"],
        )
    assert done.exit_code == 1, done.output
    [line] = [line for line in done.output.splitlines() if line.startswith("openant: ")]
    assert line.startswith("openant: motion has ended for good: ")
    assert " 0 rows kept" not in done.output


@needs_prlimit
def test_a_soak_of_the_servos_tells_a_full_disk_in_one_line(
    robot: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "warm.mcap"
    plan = SoakPlan(load="hang", seconds=600.0, cool_down_s=10.0)
    with disk_of(monkeypatch, 60_000), pytest.raises(MotionStopped, match=r"kept, \d+ rows") as stopped:
        finished(soak_servos(soak_config(config(robot), 20.0), plan, out))
    assert stopped.value.cause is StopCause.STORAGE
    assert stopped.value.exit_code == 1
    assert torque(robot) == 0
    assert len(read_recording(out).run.t) > 20


@needs_prlimit
def test_recording_an_excitation_ends_with_what_is_kept(
    robot: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run.mcap"
    with disk_of(monkeypatch, 60_000), pytest.raises(MotionStopped, match=r"kept, \d+ rows") as stopped:
        finished(record_takes(config(robot, 100.0), [Take(out, protocol("stand", 30.0), 0)]))
    assert stopped.value.exit_code == 1
    assert torque(robot) == 0
    assert len(read_recording(out).run.t) > 20


def test_a_place_where_nothing_can_be_recorded_is_refused_and_the_engine_lives(
    robot: dict[str, str], tmp_path: Path
) -> None:
    taken, file = tmp_path / "taken.mcap", tmp_path / "file"
    taken.write_bytes(b"mine")
    file.write_text("")
    (tmp_path / "folder.mcap").mkdir()
    cases = {
        taken: "there is a recording already",
        file / "run.mcap": "nothing can be recorded here",
        Path("/proc/run.mcap"): "nothing can be recorded here",
        tmp_path / "folder.mcap": "there is a recording already",
        tmp_path / f"{'x' * 300}.mcap": "nothing can be recorded here",
    }
    for path, words in cases.items():
        with pytest.raises(OpenAntError, match=words) as refused:
            finished(record_takes(config(robot), [Take(path, protocol("stand", 5.0), 0)]))
        assert refused.value.exit_code == 2
        assert torque(robot) == 0
    assert taken.read_bytes() == b"mine"


def test_a_folder_that_is_removed_under_a_recording_ends_motion(tmp_path: Path) -> None:
    """In real time, since somebody else must remove it meanwhile."""
    folder = tmp_path / "gone"
    folder.mkdir()
    with virtual_robot("default", clock="real", camera=False) as found:
        live = {name: str(value) for name, value in found.items()}

        def remove() -> None:
            while not (folder / "soak.mcap").exists():
                time.sleep(0.05)
            time.sleep(1.0)
            shutil.rmtree(folder)

        hand = threading.Thread(target=remove)
        hand.start()
        soaked = finished(soak_bus(config(live, 50.0), folder / "soak.mcap", 60.0, thin_s=None))
        hand.join()
        assert torque(live) == 0
    assert "the file was removed while it was written" in soaked.ended
    assert soaked.cycles == 0


# ---- stops that are no matter of the disk ----------------------------------------------------------------------------


def test_a_soak_swings_again_after_silence_and_says_which_time_it_is(robot: dict[str, str], tmp_path: Path) -> None:
    control, said = VirtualControl(robot["control"]), list[str]()
    now = float(control.ask("now")["t"])
    control.ask("fault", cause="broken_wire", where="knee_fl", on=True, from_s=now + 3.0, to_s=now + 5.0)
    try:
        soaked = finished(soak_bus(config(robot), tmp_path / "soak.mcap", 12.0, thin_s=None), said)
    finally:
        control.ask("fault", cause="broken_wire", where="knee_fl", on=False)
        control.close()
    assert torque(robot) == 0
    assert soaked.whole
    assert len(soaked.stops) == 1
    assert any(words.endswith("going on in 5 s, 1 of 12") for words in said), said
    found = read_recording(soaked.path)
    assert [event["count"] for event in found.events if event["kind"] == "restart"] == [1]
    assert found.run.signal("torque")[-10:].all(), "the legs swing again"


def test_a_soak_whose_port_vanished_listens_on_and_moves_no_more(robot: dict[str, str], tmp_path: Path) -> None:
    control, said = VirtualControl(robot["control"]), list[str]()
    now = float(control.ask("now")["t"])
    control.ask("fault", cause="usb_unplug", on=True, from_s=now + 3.0, to_s=now + 5.0)
    try:
        soaked = finished(soak_bus(config(robot), tmp_path / "soak.mcap", 12.0, thin_s=None), said)
    finally:
        control.ask("fault", cause="usb_unplug", on=False)
        control.close()
    assert torque(robot) == 0
    assert "the port is gone" in soaked.ended
    run = read_recording(soaked.path).run
    after = run.t > run.t[run.column("ok.hip_rr") == 0].max()
    assert after.sum() > 50, "it listens on"
    assert (run.signal("torque")[after] == 0).all(), "and nothing moves again"
    assert not [event for event in read_recording(soaked.path).events if event["kind"] == "restart"]


def test_a_walk_ends_where_motion_has_ended_for_good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from openant_tools.bringup import walk as walking
    from openant_tools.procedure.step import Bench
    from openant_tools.robot.folder import create_robot

    bench, done = Bench(create_robot(tmp_path / "ant")), list[str]()

    def stop(cause: StopCause) -> None:
        def drive(procedure: object, face: object) -> None:
            done.append(cause.value)
            raise MotionStopped("knee_fl is outside its limits", cause=cause)

        monkeypatch.setattr(walking, "drive", drive)

    class Silent:
        def answer(self, event: object) -> None:
            return None

    two = {name: dataclasses.replace(walking.WALK[name], needs=()) for name in ("connect", "imu")}
    monkeypatch.setattr(walking, "WALK", two)
    stop(StopCause.SILENCE)
    assert not walking.walk(bench, Silent())["imu"].ok
    assert done == ["silence"] * 2
    stop(StopCause.LIMITS)
    walking.walk(bench, Silent(), again=True)
    assert done == ["silence"] * 2 + ["limits"]
    stop(StopCause.STORAGE)
    with pytest.raises(MotionStopped):
        walking.walk(bench, Silent(), again=True)
