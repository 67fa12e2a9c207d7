"""What every procedure stands on: the events, the face that grants, the finding on disk, the journal of writes."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from openant_tools.bringup.walk import standing
from openant_tools.cli.calib import show_finding
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.files import json_text
from openant_tools.procedure.finding import Evidence, Finding, keep, latest, together
from openant_tools.procedure.journal import EepromWrite, Journal
from openant_tools.procedure.step import (
    Answer,
    Ask,
    Bench,
    Declined,
    Event,
    Intent,
    Procedure,
    RegisterChange,
    Say,
    confirmed,
    drive,
)  # fmt: skip
from openant_tools.robot.folder import create_robot


class Scripted:
    """A face that answers from a list and remembers what it saw."""

    def __init__(self, *answers: Answer) -> None:
        self.answers, self.seen = list(answers), list[Event]()

    def answer(self, event: Event) -> Answer:
        self.seen.append(event)
        if isinstance(event, Intent | Ask):
            return self.answers.pop(0)
        return None


class Servo:
    """Stands for what a procedure has open: whether torque is on, what was written."""

    def __init__(self) -> None:
        self.torque, self.written = False, list[int]()


def name_it(servo: Servo) -> Procedure:
    yield Say("looking")
    servo.torque = True
    try:
        number = yield Ask("which id?", unit="", default=10.0)
        yield Intent("write the id", (RegisterChange("hip_rr", "id", 1, 10),))
        servo.written.append(int(number) if isinstance(number, float) else -1)
    finally:
        servo.torque = False
    return Finding("ids", True, "named", (Evidence("id", 10.0, "", "register 7"),), "", "openant calib ids")


def test_a_granted_procedure_runs_to_its_finding():
    servo, face = Servo(), Scripted(20.0, True)
    finding = drive(name_it(servo), face)
    assert finding.ok
    assert servo.written == [20]
    assert not servo.torque
    assert [type(event).__name__ for event in face.seen] == ["Say", "Ask", "Intent"]


def test_what_is_not_granted_is_not_written_and_torque_is_off():
    servo = Servo()
    with pytest.raises(Declined, match="write the id"):
        drive(name_it(servo), Scripted(20.0, False))
    assert servo.written == []
    assert not servo.torque


def test_ctrl_c_at_a_question_lets_the_procedure_put_the_robot_into_order():
    class Interrupting(Scripted):
        def answer(self, event: Event) -> Answer:
            if isinstance(event, Ask):
                raise KeyboardInterrupt
            return super().answer(event)

    servo = Servo()
    with pytest.raises(KeyboardInterrupt):
        drive(name_it(servo), Interrupting())
    assert not servo.torque
    assert servo.written == []


def test_a_fault_of_the_procedure_reaches_the_one_who_runs_it():
    def broken() -> Procedure:
        yield Say("so far so good")
        raise HardwareFault("the cable is out", remedy="plug it in")

    with pytest.raises(HardwareFault, match="the cable is out"):
        drive(broken(), Scripted())


numbers = st.floats(allow_nan=False, allow_infinity=False)
words = st.text(max_size=40)


@given(
    value=st.none() | st.floats(), name=words, unit=words, ok=st.sampled_from([True, False, None]),
    problems=st.lists(words, min_size=1, max_size=3), unsure=st.lists(words, min_size=1, max_size=3),
    data=st.dictionaries(words, numbers | words, max_size=3),
)  # fmt: skip
def test_a_finding_survives_its_json(value, name, unit, ok, problems, unsure, data):
    finding = Finding(
        "zeros", ok, "what", (Evidence(name, value, unit, "source"),), "next", "command",
        (Evidence("p", 1.0, "rad", "fit", 0.5, 1.5),), data, problems=tuple(problems),
        unsure=() if ok is not None else tuple(unsure),
    )  # fmt: skip
    assert Finding.of_json(json.loads(json_text(finding.as_json()))) == finding


@pytest.mark.parametrize("figure", [None, math.nan, math.inf, -math.inf])
def test_a_figure_that_is_not_known_keeps_a_finding_from_saying_yes(figure, tmp_path, capsys):
    evidence = (Evidence("height", 0.1, "m", "tag"), Evidence("scale", figure, "1", "gyro over camera", figure, 1.0))
    finding = Finding(
        "arena", True, "the camera hangs well", evidence, "", "openant calib arena", data={"left": figure}
    )
    assert (finding.ok, finding.verdict) == (None, "cannot judge")
    assert finding.unsure == ("scale is not known (gyro over camera)",)
    assert show_finding(finding, tmp_path / "out.json") == 1
    assert "CANNOT JUDGE: the camera hangs well\n  scale is not known" in capsys.readouterr().out
    content = json.loads((tmp_path / "out.json").read_text(), parse_constant=pytest.fail)
    assert (content["ok"], content["verdict"]) == (None, "cannot judge")
    assert content["evidence"][1]["value"] is content["data"]["left"] is None
    assert "# arena: ? cannot judge" in finding.as_markdown()


def test_a_no_names_what_is_wrong_or_is_none():
    with pytest.raises(ValueError, match="names nothing that is wrong"):
        Finding("arena", False, "camera at 2 m", (), "mend what is listed", "openant calib arena")
    with pytest.raises(ValueError, match="does not say why"):
        Finding("arena", None, "camera at 2 m", (), "", "openant calib arena")
    # A comparison with NaN says no and nobody has written down why: that is not judged, and it is said.
    evidence = (Evidence("tag size", math.nan, "1", "lying robot"),)
    finding = Finding("arena", False, "camera at 2 m", evidence, "mend what is listed", "openant calib arena")
    assert finding.unsure == ("tag size is not known (lying robot)",)
    assert finding.ok is None


def test_several_verdicts_come_to_the_worst_of_them():
    assert together(True, True) is True
    assert together(True, None) is None
    assert together(None, False, True) is False


def test_a_step_that_cannot_judge_is_not_green_and_holds_up_what_needs_it(tmp_path):
    folder = create_robot(tmp_path / "ant")
    keep(Finding("connect", True, "the bus", (Evidence("IMU rate", math.nan, "Hz", "polls"),), "", "command"), folder)
    states = standing(folder)
    assert states["connect"].state == "unsure"
    assert "connect" in states["estop"].waits_for


@pytest.mark.parametrize(("control", "yes"), [(None, False), ("control.sock", True)])
def test_only_a_real_robot_is_looked_at(tmp_path, control, yes):
    """Of a virtual one it is pretended, in words; whoever stands at a real one may say no."""
    bench = Bench(create_robot(tmp_path / "ant"), control=control)
    face = Scripted("no")
    assert drive(confirmed(bench, "Did it blink?"), face) is yes
    (event,) = face.seen
    assert isinstance(event, Say if yes else Ask)
    assert "pretended" in getattr(event, "words", "pretended")


def test_what_was_written_serves_the_next_step_although_not_all_of_it_could_be_judged(tmp_path):
    folder = create_robot(tmp_path / "ant")
    unknown = (Evidence("friction of knee_fl", None, "N·m", "slow sweep"),)
    finding = Finding("bounds", True, "ranges of 8 joints", unknown, "", "openant calib bounds", stands=True)
    path = keep(finding, folder)
    assert standing(folder)["bounds"].state == "unsure"
    assert "bounds" not in standing(folder)["identify"].waits_for
    told = json.loads(path.read_text())
    assert told["stands"] is True
    no = dict(
        told, ok=False, problems=["knee_fl turns beyond its stop → the horn is loose"], date="2999-01-01T00:00:00Z"
    )
    (folder.findings / "bounds-29990101T000000Z.json").write_text(json.dumps(no))
    assert "bounds" in standing(folder)["identify"].waits_for


def test_the_newest_finding_of_a_step_is_found_and_a_torn_one_passed_over(tmp_path):
    folder = create_robot(tmp_path / "ant")
    assert latest(folder, "zeros") is None
    path = keep(Finding("zeros", True, "all straight", (), "", "openant calib zeros"), folder)
    (folder.findings / "zeros-29991231T000000Z.json").write_text('{"step": "zer')
    (folder.findings / "zeros-29991230T000000Z.json").write_text("[]")
    seen = latest(folder, "zeros")
    assert seen is not None
    assert seen.what == "all straight"
    assert "# zeros: ✓ ok" in path.with_suffix(".md").read_text()


def test_the_journal_keeps_old_and_new_and_what_was_taken_back(tmp_path):
    journal = Journal(tmp_path / "journal.jsonl")
    journal.append(EepromWrite("hip_rr", 1, "id", 1, 10, 57_600), "ids")
    journal.append(EepromWrite("hip_rr", 10, "return_delay_time", 250, 0), "ids")
    first, second = journal.open_entries()
    assert (first.write.old, first.write.new, first.write.id_after) == (1, 10, 10)
    journal.append(EepromWrite("hip_rr", 10, "return_delay_time", 0, 250), "undo", second.number)
    assert journal.open_entries() == [first]


def test_a_line_torn_by_a_power_cut_loses_itself_only(tmp_path):
    path = tmp_path / "journal.jsonl"
    journal = Journal(path)
    journal.append(EepromWrite("hip_rr", 1, "id", 1, 10), "ids")
    with open(path, "ab") as file:
        file.write(b'{"time": "2026-')
    journal.append(EepromWrite("knee_rr", 1, "id", 1, 11), "ids")
    assert [entry.write.joint for entry in journal.entries()] == ["hip_rr", "knee_rr"]


def test_a_line_that_is_none_of_ours_is_named(tmp_path):
    path = tmp_path / "journal.jsonl"
    path.write_text('{"somebody": "else"}\n')
    with pytest.raises(BadInput, match="line 1: is no line of the journal"):
        Journal(path).entries()


def test_lines_of_older_versions_are_read(tmp_path):
    path = tmp_path / "journal.jsonl"
    line = {
        "time": "t",
        "command": "sysid record",
        "joint": "hip_rr",
        "id": 10,
        "register": "pwm_limit",
        "old": 885,
        "new": 442,
    }
    path.write_text(json.dumps(line) + "\n")
    Journal(path).append(EepromWrite("hip_rr", 10, "pwm_limit", 442, 885), "config")
    assert [(entry.write.old, entry.write.baud) for entry in Journal(path).entries()] == [(885, None), (442, None)]


def test_the_journal_survives_kill_9_between_a_line_and_its_write(tmp_path):
    path = tmp_path / "journal.jsonl"
    code = (
        "import os, signal\nfrom pathlib import Path\n"
        "from openant_tools.procedure.journal import EepromWrite, Journal\n"
        f"Journal(Path({str(path)!r})).append(EepromWrite('hip_rr', 1, 'id', 1, 10), 'ids')\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    process = subprocess.run([sys.executable, "-c", code], check=False, env=os.environ)
    assert process.returncode == -signal.SIGKILL
    assert [entry.write.new for entry in Journal(path).entries()] == [10]


def test_a_bench_needs_no_more_than_a_folder(tmp_path: Path):
    bench = Bench(create_robot(tmp_path / "ant"))
    assert bench.bus is None
    assert bench.joints == ()
