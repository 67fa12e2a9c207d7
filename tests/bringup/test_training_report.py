"""The page of a training run on a robot, made from what the run left behind: recordings, curve, interventions, log."""

from __future__ import annotations

import html
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from openant_tools.bringup.run_log import add_to_log, read_log
from openant_tools.bringup.training_report import DONE, read_training, training_report
from openant_tools.cli import main
from openant_tools.errors import BadInput
from openant_tools.recording.run import Facts
from openant_tools.recording.telemetry import Cycle, RecordedAnswer, ServoChannel
from openant_tools.recording.writer import RecordingWriter

CHANNEL = ServoChannel("knee_fl", "XL430-W250-T", 31, 1, 0.0, {"pos": 2 * np.pi / 4096, "temp": 1.0})
STEP_ROWS, STEPS = 12, 40
#: steps that were too long, and by how many rows of 10 ms
BUSY, SLOW = {10, 11}, {20}


def record(path: Path, first_s: float) -> None:
    """Forty steps of 0.12 s: in two the bus's process was late, in one the agent; then the robot lies, torque off."""
    now, wake = first_s, 0.0
    facts = Facts(joints=("knee_fl",), setup="floor", extra={"dt_s": 0.12, "rate_hz": 100.0})
    registers = {"knee_fl": {"temperature_limit": 72}}

    def row(agent: tuple[float, float] | None, torque: bool, lost: bool = False) -> None:
        good = RecordedAnswer({"pos": 2048, "temp": 40 + int(now - first_s)}, True, "", 0.001)
        writer.cycle(
            Cycle(
                now, (2048,), now - 1e-3, wake, (RecordedAnswer(None, False, "timeout") if lost else good,), (torque,),
                *(agent or (None, None)),
            )
        )  # fmt: skip

    with RecordingWriter(path, facts=facts, channels=(CHANNEL,), registers=registers, clock=lambda: now) as writer:
        writer.event("virtual robot", processor_s=10.0, processors=2)
        for k in range(STEPS):
            thought = 0.03 if k in SLOW else 0.002
            agent = (now - 0.001 - thought - 0.001, now - 0.002)
            for i in range(STEP_ROWS + (3 if k + 1 in BUSY | SLOW else 0)):
                if i % 6 == 0:
                    writer.pose(now - 0.1, position=(0.0, 0.0, 0.1), yaw=0.0)
                wake = 0.03 if k + 1 in BUSY and i == 5 else 0.0
                row(agent if i == 0 else None, True, lost=k == 5 and i == 3)
                now += 0.01
        writer.event("virtual robot", processor_s=10.0 + 0.5 * (now - first_s), processors=2)
        for _ in range(100):
            row(None, False)
            now += 0.01


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    (folder / "recordings").mkdir()
    record(folder / "recordings" / "walk-1.mcap", 100.0)
    record(folder / "recordings" / "walk-2.mcap", 200.0)
    (folder / "recordings" / "walk-3.mcap").write_bytes(b"\x89MCAP0\r\n")  # killed as it began
    (folder / "run.json").write_text(json.dumps({"schema": "openant.train/1", "agent": "sac", "seed": 1}))
    curve = "".join(f"{1000 * k},{120.0 * k},{0.01 * k}\n" for k in range(1, 11))
    (folder / "learning_curve.csv").write_text("step,seconds,average_reward_m_s\n" + curve)
    why = "the camera has not seen the robot for 2.{} s"
    (folder / "interventions.csv").write_text(
        f"step,seconds,reason\n90,60.0,{why.format(0)}\n180,300.0,{why.format(1)}\n200,400.0,/tmp/bus: the port is gone → look\n"
    )
    for words in (
        "begun, unattended", "motion begins again by itself after tag, 1 of 20", "ended: the port is\ngone",
        "begun, unattended", "motion begins again by itself after tag, 1 of 20",
    ):  # fmt: skip
        add_to_log(folder, words)
    return folder


def test_what_became_of_a_run_is_read_from_what_it_left(run: Path) -> None:
    record = read_training(run)
    assert record.robot_s == 1200.0
    assert record.speed_m_s == pytest.approx(0.08), "the mean of the last five windows of 120 s"
    assert (record.alone, record.words_given) == (2, 1)
    assert [line.words for line in read_log(run)[0]][2] == "ended: the port is gone"

    steps = record.steps
    assert len(steps.period) == 2 * (STEPS - 1)
    assert int(steps.late.sum()) == 6
    assert steps.period[~steps.late] == pytest.approx(np.full(72, 0.12), abs=1e-6)
    assert steps.reasons == {
        "the bus's process was late: this computer is busy": 4, "the agent took long to decide": 2,
    }  # fmt: skip
    assert np.nanmin(steps.position) >= 0.1, "a pose is used only once it has come"
    assert np.nanmax(steps.position) < 0.2
    assert record.processors == pytest.approx(0.5)
    assert record.of_processors == 2
    assert (record.answers, record.lost) == (2 * (STEPS * STEP_ROWS + 9 + 100), {"timeout": 2})

    [knee] = record.heat
    assert (knee.hottest.max(), knee.limit_c) == (45.0, 72.0)
    spent = record.seconds_of
    assert list(spent) == list(DONE)
    assert spent["walking"] == pytest.approx(2 * 4.9, abs=0.8)
    assert spent["torque off, watched"] == pytest.approx(2.0, abs=0.1)
    assert len(record.unreadable) == 1


def test_the_command_makes_the_page_again(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    forecast = tmp_path / "forecast.json"
    when = {"value": 1800.0, "low": 1500.0, "high": 2100.0}
    forecast.write_text(json.dumps({"joints": [{"joint": "knee_fl", "seconds_to_limit": when}]}))
    found = tmp_path / "found.json"
    with pytest.raises(SystemExit) as end:
        main(["train", "report", str(run), "--forecast", str(forecast), "--json", str(found)])
    assert end.value.code == 0
    said = capsys.readouterr().out
    assert said.startswith("8.0 cm/s at the end of 20.0 min of robot time, 7.7 % of steps late; 3 interventions")
    page = " ".join(html.unescape((run / "report" / "report.html").read_text()).split())
    for words in (
        "its limit after 30 min (25 to 35)", "the camera has not seen the robot for … s", "the agent took long to decide",
        "The virtual robot took 0.50 of this computer's 2 processors", "motion begins again by itself after tag, 1 of 20",
    ):  # fmt: skip
        assert words in page, words
    answer = json.loads(found.read_text())
    assert (answer["late"], answer["steps"], answer["words_given"]) == (6, 78, 1)


def test_what_is_no_run_on_a_robot_is_refused(tmp_path: Path, run: Path) -> None:
    with pytest.raises(BadInput, match="no training run here"):
        read_training(tmp_path)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(BadInput, match="no recordings of a robot"):
        read_training(tmp_path)
    with pytest.raises(BadInput, match="it is no forecast"):
        read_training(run, run / "run.json")


def test_a_run_in_stepped_time_has_no_deadlines_to_miss(run: Path) -> None:
    record = read_training(run)
    empty = type(record.steps).together([])
    page = training_report(type(record)(**{**vars(record), "steps": empty, "interventions": []})).html()
    assert "in stepped time" in page
    assert "The robot never had to be set up again." in page


@pytest.mark.parametrize("resumed", [False, True])
def test_rows_that_a_power_cut_tore_are_left_out_and_told(run: Path, tmp_path: Path, resumed: bool) -> None:
    whole = read_training(run)
    folder = shutil.copytree(run, tmp_path / "run")
    for name, torn in (("log.csv", "2026-11-28T20:1"), ("learning_curve.csv", "11000,13"), ("interventions.csv", "9")):
        with (folder / name).open("a") as stream:
            stream.write(torn)
    if resumed:
        with (folder / "log.csv").open("a") as stream:  # by the next line, which the torn one takes along
            stream.write("2026-11-28T20:20:00.000+00:00,begun\n2026-11-28T20:20:01.000+00:00,at it\n")
    record = read_training(folder)
    assert [line.words for line in record.log] == [line.words for line in whole.log] + ["at it"] * resumed
    assert (record.curve == whole.curve).all()
    assert record.interventions == whole.interventions
    assert [Path(words.partition(":")[0]).name for words in record.unreadable[1:]] == [
        "learning_curve.csv", "interventions.csv", "log.csv",
    ]  # fmt: skip
    assert "log.csv: row 6 torn, and left out" in html.unescape(training_report(record).html())
    (folder / "log.csv").write_text("nothing\nof the kind\n")
    with pytest.raises(BadInput, match=r"log\.csv: no row is what it should be"):
        read_training(folder)


def test_a_run_that_ended_before_its_curve_began_claims_no_speed(run: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(run, tmp_path / "run")
    (folder / "learning_curve.csv").write_text("step,seconds,average_reward_m_s\n")
    verdict = training_report(read_training(folder)).answer.verdict
    assert verdict.startswith("Ended before its speed was noted, 7.7 % of steps late")
    assert "unknown" not in verdict
