"""Servos that keep silent, and why: a builder's bus with every habit that has been taken for a bad cable."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from places import ROOT
from talker import READER, Talker, talking
from wire import IDS, ant

from openant_tools.calib.mute import let_answer, silenced
from openant_tools.cli.comms import comms
from openant_tools.comms import lateness, protocol1, troubleshooting
from openant_tools.comms.bench import RateTrial
from openant_tools.comms.clock import RealClock
from openant_tools.comms.faults import NoAnswer
from openant_tools.comms.ports import Host
from openant_tools.comms.reboot import reboot
from openant_tools.comms.scan import scan
from openant_tools.comms.setup import open_bus
from openant_tools.comms.silence import diagnose, explained
from openant_tools.comms.troubles import PORT, SILENCE
from openant_tools.procedure.journal import Journal
from openant_tools.procedure.step import Answer, Bench, Declined, Event, Intent, drive
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.folder import create_robot

MEGABAUD = ("--baud", "1000000")


def run(*words: str) -> Result:
    return CliRunner().invoke(comms, list(words))


def scanned(talker: Talker, tmp_path: Path, *more: str) -> tuple[Result, list[dict[str, object]]]:
    found = tmp_path / "found.json"
    result = run("scan", "--port", talker.path, *MEGABAUD, "--json", str(found), *more)
    return result, json.loads(found.read_text())


def ids(rows: Sequence[dict[str, object]]) -> list[object]:
    return [row["id"] for row in rows]


# ---- a list that may be partial says so --------------------------------------------------------------------------------


def test_ids_that_answer_a_broadcast_as_late_as_the_vendor_allows_are_all_listed(tmp_path: Path) -> None:
    with talking(tmp_path, 1, 41, 200, 252, slot_s=3e-3) as talker:
        for _ in range(3):  # a busy computer that heard an answer too late says that the list may be partial
            result, rows = scanned(talker, tmp_path)
            assert ids(rows) == [1, 41, 200, 252]
            if result.exit_code == 0:
                break
    assert all(row["certain"] for row in rows)
    assert result.exit_code == 0, result.output


def test_a_servo_that_answers_only_when_asked_alone_makes_the_list_uncertain(tmp_path: Path) -> None:
    with talking(tmp_path, 10, 31, shy=(31,)) as talker:
        result, rows = scanned(talker, tmp_path)
    assert ids(rows) == [10, 31]
    assert result.exit_code == 1
    assert not any(row["certain"] for row in rows)
    assert "servo 31 answers when asked alone" in result.stderr


def test_garbage_among_answers_makes_the_list_uncertain(tmp_path: Path) -> None:
    with talking(tmp_path, 10, 11, noise=b"\x00\x7f\x13") as talker:
        result, rows = scanned(talker, tmp_path)
    assert ids(rows) == [10, 11]
    assert result.exit_code == 1
    assert "no packet came among the answers" in result.stderr
    assert not any(row["certain"] for row in rows)


def test_a_servo_in_protocol_1_is_found_and_named_with_what_mends_it(tmp_path: Path) -> None:
    with talking(tmp_path, 10, 31, old=(31,)) as talker:
        result, rows = scanned(talker, tmp_path, "--id", "31")
        assert not talker.written  # a scan writes nothing
    assert ids(rows) == [10]
    assert result.exit_code == 1
    assert re.search(r"servo 31 speaks Protocol 1.0 at 1000000 baud → `openant calib inventory`", result.stderr)
    assert "cable" not in result.stderr


@pytest.mark.parametrize(("level", "answers"), [(0, "pings only"), (1, "pings and reads, and no writes")])
def test_a_status_return_level_is_said_beside_the_servo(tmp_path: Path, level: int, answers: str) -> None:
    with talking(tmp_path, 10, 31) as talker:
        talker.memory[31][68] = level
        result, rows = scanned(talker, tmp_path)
        assert not talker.written
    assert ids(rows) == [10, 31]
    assert f"Status Return Level {level}, answers {answers}: `openant calib inventory`" in result.stdout


def test_another_program_that_reads_the_port_is_named(tmp_path: Path) -> None:
    with talking(tmp_path, 10, 11) as talker:
        other = subprocess.Popen([sys.executable, "-c", READER, talker.path], stdout=subprocess.PIPE)
        assert other.stdout is not None
        other.stdout.readline()
        try:
            for _ in range(2):
                result, rows = scanned(talker, tmp_path)
                assert result.exit_code == 1
                assert f"another program reads this port, {sys.executable} -c" in result.stderr
                assert f"(process {other.pid})" in result.stderr
                assert not any(row["certain"] for row in rows)
            result = run("watch", "--port", talker.path, "--seconds", "1")
            assert f"(process {other.pid})" in str(result.exception)
            assert "cable" not in str(result.exception)
        finally:
            other.kill()
            other.wait()


def test_a_reader_that_nobody_can_see_is_told_by_answers_that_vanish(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, line = ant()
    honest, turn = line.read, iter(range(10**6))

    def robbed() -> bytes:
        data = honest()
        return b"" if data and next(turn) % 2 else data

    monkeypatch.setattr(line, "read", robbed)
    found = diagnose(bus, [31], IDS, host=Host(proc=tmp_path))
    assert found.cause == "unseen_reader"
    assert found.words.startswith("another program reads this port: answers came and were gone")


def test_the_vendors_sdk_lists_the_same(tmp_path: Path) -> None:
    with talking(tmp_path, 10, 41) as talker:
        result, rows = scanned(talker, tmp_path, "--driver", "sdk")
    assert result.exit_code == 0, result.output
    assert [(row["id"], row["model_number"], row["firmware"]) for row in rows] == [(10, 1020, 46), (41, 1020, 46)]


def test_a_healthy_bus_of_eight_rates_is_scanned_within_its_time() -> None:
    bus, line = ant()
    before = line.now()
    found = scan(bus)
    assert [one.id for one in found.servos] == IDS
    assert found.certain
    assert line.now() - before < 2.2  # on the wire's own clock


# ---- why one is silent ---------------------------------------------------------------------------------------------------


def test_the_cable_is_named_once_all_else_is_excluded() -> None:
    bus, line = ant()
    line.wire.settings.lost |= dict.fromkeys(range(3, 8), 1.0)
    found = diagnose(bus, IDS[3:], IDS)
    assert found.cause == "cable"
    assert "look at the cable between hip_fr and knee_fr" in found.remedy


def test_each_leg_has_its_own_cable() -> None:
    bus, line = ant()
    line.wire.settings.lost |= {1: 1.0, 4: 1.0, 5: 1.0}
    chain = [["hip_rr", "knee_rr"], ["hip_fr", "knee_fr"], ["hip_fl", "knee_fl"], ["hip_rl", "knee_rl"]]
    found = diagnose(bus, [IDS[1], IDS[4], IDS[5]], IDS, chain)
    assert "between hip_rr and knee_rr" in found.words
    assert "between the adapter or board and hip_fl" in found.words


def test_a_servo_left_at_another_rate_is_found_there() -> None:
    bus, line = ant()
    line.wire.servos[5].set("baud_rate", 1)
    line.wire.servos[5].settle()
    line.wire.servos[5].boot(0.0)
    line.sleep_until(3.0)
    found = diagnose(bus, [31], IDS)
    assert (found.cause, found.values["baud"]) == ("other_baud", 57_600)
    assert line.baud == 1_000_000


def test_nobody_at_all_is_supply_and_first_cable() -> None:
    bus, line = ant()
    line.wire.settings.lost |= dict.fromkeys(range(8), 1.0)
    with pytest.raises(NoAnswer) as error:
        bus.require(bus.sync_read(132, 4, IDS))
    why = explained(bus, error.value)
    assert "nobody answers, at any baud rate or in Protocol 1.0 → is the supply on" in str(why)


def test_a_servo_that_answers_again_is_no_cable() -> None:
    bus, _ = ant()
    assert diagnose(bus, [31], IDS).cause == "intermittent"


@pytest.mark.parametrize(("late", "cause"), [(False, "return_level"), (True, "host_late")])
def test_silence_to_reads_is_a_setting_only_while_this_computer_is_punctual(
    late: bool, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, line = ant()
    line.wire.servos[5].set("status_return_level", 0)
    if late:  # starved: it misses what it waits for, and no servo has a part in it
        monkeypatch.setattr(type(bus.clock.lateness), "cycle", lambda self, wake_s=0.0: 0.2)
    found = diagnose(bus, [31], IDS)
    assert found.cause == cause
    assert ("inventory" in found.remedy) is not late


def test_an_answer_that_an_adapter_holds_back_is_late_and_not_lost(tmp_path: Path) -> None:
    with talking(tmp_path, 10, late_s=0.045) as talker:
        result = run("scan", "--port", talker.path, *MEGABAUD, "--id", "10")
    assert "cable" not in result.output
    assert "id  10" in result.output


# ---- what has its command ------------------------------------------------------------------------------------------------


def test_a_latched_error_is_named_cleared_and_leaves_torque_off(tmp_path: Path) -> None:
    with talking(tmp_path, 10, 31) as talker:
        talker.memory[31][70], talker.memory[31][64] = 0x20, 1
        words = ("reboot", "--port", talker.path, "--id", "31")
        asked = run(*words)
        assert "add --yes" in str(getattr(asked.exception, "remedy", ""))
        assert not talker.rebooted
        result = run(*words, "--yes")
        assert result.exit_code == 0, result.output
        assert "servo 31 has switched itself off after overload" in result.output
        assert "power it off and on" in result.output
        assert "will reboot servo 31" in result.output
        assert "torque_enable 0" in result.output
        assert talker.rebooted == [31]
        assert (talker.memory[31][64], talker.memory[31][70]) == (0, 0)
        again = run(*words, "--yes")
        assert "nothing to clear" in again.output
        assert talker.rebooted == [31]


@pytest.mark.parametrize(
    ("address", "value", "why"),
    [(146, 78, "78 °C and its limit is 80 °C"), (144, 80, "8.0 V and is set to bear 9.5 to 16.0")],
)
def test_no_reboot_while_the_cause_stands(tmp_path: Path, address: int, value: int, why: str) -> None:
    with talking(tmp_path, 31) as talker:
        talker.memory[31][70], talker.memory[31][address] = 0x04, value
        result = run("reboot", "--port", talker.path, "--id", "31", "--yes")
        assert result.exit_code == 1
        assert why in result.output
        assert not talker.rebooted


class Silent:
    """A face with nobody at it."""

    def answer(self, event: Event) -> Answer:
        return None


def test_nothing_is_rebooted_that_is_not_granted(tmp_path: Path) -> None:
    with talking(tmp_path, 31) as talker:
        talker.memory[31][70], talker.memory[31][64] = 0x20, 1
        bus = open_bus(talker.path, 1_000_000)
        try:
            procedure = reboot(bus, 31, "servo 31", "openant comms reboot")
            with pytest.raises(Declined, match="not done: reboot servo 31"):
                drive(procedure, Silent())
        finally:
            bus.close()
        assert not talker.rebooted
        assert not talker.written


def test_an_error_that_comes_back_at_once_is_said(tmp_path: Path) -> None:
    with talking(tmp_path, 31, coming_back=(31,)) as talker:
        talker.memory[31][70] = 0x08
        result = run("reboot", "--port", talker.path, "--id", "31", "--yes")
    assert result.exit_code == 1
    assert "reports motor encoder again at once" in result.output


def test_protocol_1_is_ended_after_the_question_and_stands_in_the_journal(tmp_path: Path) -> None:
    bench = Bench(create_robot(tmp_path / "ant"))
    with talking(tmp_path, 31, old=(31,)) as talker:
        talker.memory[31][64] = 1  # torque on locks the memory
        bus = open_bus(talker.path, 1_000_000)
        try:
            mute = silenced(bus, [bench.folder.config().motors["knee_fl"]])
            procedure = let_answer(bench, bus, mute, "openant calib inventory")
            said = next(procedure)
            intent = next(procedure)
            assert "speaks Protocol 1.0" in str(said)
            assert not talker.written  # nothing before it is granted
            assert isinstance(intent, Intent)
            assert [str(change) for change in intent.registers] == ["knee_fl: protocol_type 1 → 2"]
            procedure.send(True)
            assert (talker.memory[31][13], talker.memory[31][64]) == (2, 0)
        finally:
            bus.close()
    [entry] = Journal(bench.folder.journal).entries()
    assert (entry.write.register, entry.write.old, entry.write.new) == ("protocol_type", 1, 2)


# ---- protocol 1.0 --------------------------------------------------------------------------------------------------------


def test_protocol_1_packets_are_the_vendors() -> None:
    assert protocol1.ping(1).hex(" ") == "ff ff 01 02 01 fb"  # e-manual's example
    assert protocol1.read(1, 0x2B, 1).hex(" ") == "ff ff 01 04 02 2b 01 cc"  # e-manual's example
    reply = bytes.fromhex("ff ff 01 03 00 20 db")
    assert protocol1.statuses(b"\xff" + reply + b"\xff\xff\x01\x02\x00\x00") == [
        protocol1.Protocol1Status(1, 0, b"\x20")
    ]


# ---- this computer was late ----------------------------------------------------------------------------------------------


def recording(late: bool, lossy: bool) -> Run:
    """Eight hundred rows in which knee_fl loses one answer in ten, in rows in which the loop was late or not."""
    n = 800
    lost = np.arange(n) % 10 == 3 if lossy else np.zeros(n, bool)
    wake = np.where(lost & late, 0.041, 1e-4)
    columns = {"wake": wake, "ok.knee_fl": (~lost).astype(float), "err.knee_fl": np.where(lost, "timeout", "")}
    return Run("run", Facts(("knee_fl",)), np.arange(n) * 0.01, columns)


def test_what_is_lost_in_late_cycles_is_no_loss_of_a_cable() -> None:
    mine, theirs = lateness.losses(recording(True, True)), lateness.losses(recording(False, True))
    assert mine.counted.mean() == 0
    assert mine.words.startswith("this computer was late by up to 41 ms in 10 % of cycles: 10.0 % of all answers")
    assert theirs.counted.mean() == pytest.approx(0.1)
    assert theirs.words == ""
    assert lateness.losses(recording(False, False)).words == ""


def test_a_wait_that_returns_late_is_noted() -> None:
    clock = RealClock()
    clock.lateness.cycle()
    clock.lateness.note(0.041)
    assert clock.lateness.cycle() >= 0.041
    assert clock.lateness.cycle(wake_s=0.002) < 0.04
    assert "late by up to" in clock.lateness.words


def test_no_rate_is_given_that_the_wire_does_not_allow() -> None:
    assert RateTrial(100, 1.0, 120.0, 132.0, 0.0).words == "up to 120 cycles/s"
    assert RateTrial(250, 1.0, 250.0, 132.0, 0.0).words.startswith("no rate, as this port is faster than a wire")
    assert "250" not in RateTrial(250, 1.0, 250.0, 132.0, 0.0).words


# ---- the page ------------------------------------------------------------------------------------------------------------


def test_the_page_is_what_the_program_says() -> None:
    page = ROOT / "docs" / "troubleshooting.md"
    assert page.read_text() == troubleshooting.page(), (
        "python -m openant_tools.comms.troubleshooting > docs/troubleshooting.md"
    )
    assert all(trouble.symptom in troubleshooting.page() for trouble in (*SILENCE.values(), *PORT.values()))
