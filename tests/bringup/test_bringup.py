"""From loose motors to a passport, by the commands that a builder types."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
from builder import robot

from openant_tools.bringup.passport import write_passport
from openant_tools.bringup.persistent_robot import persistent_robot
from openant_tools.bringup.walk import WALK, do, next_step, standing, step, walk
from openant_tools.cli.calib import calib
from openant_tools.comms.clock import VirtualControl
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.procedure.finding import Finding, keep
from openant_tools.procedure.relay import relayed, within
from openant_tools.procedure.step import Answer, Ask, Declined, Event, Intent, Progress, StepAt
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINT_NAMES

TITLES = (
    "Connect", "Emergency stop", "Motor IDs", "Centring", "Leg by leg", "Inventory", "Zeros and directions", "Observation bounds",
    "IMU", "Arena", "Comms health", "Thermal soak", "Identification", "Gap check", "Passport",
)  # fmt: skip


def openant(*arguments: str | Path, timeout: float = 900) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "openant_tools.cli", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=timeout, stdin=subprocess.DEVNULL, check=False
    )


# ---- the walk as data -------------------------------------------------------------------------------------------------


def test_the_walk_has_its_steps_in_the_order_in_which_one_builds():
    assert tuple(step.title for step in WALK.values()) == TITLES
    names = list(WALK)
    assert all(names.index(need) < names.index(name) for name, one in WALK.items() for need in one.needs)


@pytest.mark.parametrize("name", WALK)
def test_every_step_is_there_and_says_what_it_does(name):
    one = WALK[name]
    module, _, function = one.procedure.partition(":")
    assert callable(getattr(__import__(module, fromlist=[function]), function))
    assert one.does.endswith(".")


def test_an_unknown_step_is_refused_with_the_known_ones():
    with pytest.raises(BadInput, match="there is no step 'legz'"):
        step("legz")


def test_every_step_of_building_is_a_command_that_explains_itself():
    for name in ("connect", "estop", "ids", "centre", "legs", "inventory", "zeros", "bounds", "imu", "arena", "undo"):
        command = calib.commands[name]
        assert command.help


# ---- standing, resuming -----------------------------------------------------------------------------------------------


def found(name: str, ok: bool = True) -> Finding:
    problems = () if ok else (f"{name}: it says no",)
    return Finding(name, ok, f"{name} done", (), "", f"openant calib {name}", problems=problems)


def test_a_new_robot_has_everything_to_do(tmp_path):
    states = standing(create_robot(tmp_path / "ant"))
    assert {now.state for now in states.values()} == {"todo"}
    assert states["ids"].waits_for == ("connect", "estop")


def test_a_step_whose_need_was_done_again_is_stale(tmp_path):
    folder = create_robot(tmp_path / "ant")
    for name in ("connect", "estop"):
        keep(found(name), folder)
    path = keep(found("connect"), folder)
    later = json.loads(path.read_text()) | {"date": "2999-01-01T00:00:00Z"}
    path.with_name("connect-29990101T000000Z.json").write_text(json.dumps(later))
    states = standing(folder)
    assert (states["connect"].state, states["estop"].state) == ("ok", "stale")


def test_a_passport_that_is_older_than_any_step_is_stale(tmp_path):
    folder = create_robot(tmp_path / "ant")
    for name in WALK:
        keep(found(name), folder)
    assert standing(folder)["passport"].state == "ok"
    path = keep(found("thermal"), folder)
    later = json.loads(path.read_text()) | {"date": "2999-01-01T00:00:00Z"}
    path.with_name("thermal-29990101T000000Z.json").write_text(json.dumps(later))
    assert standing(folder)["passport"].state == "stale"


def test_a_fault_becomes_the_finding_of_its_step_and_the_walk_goes_on(tmp_path):
    with robot(tmp_path / "ant", robot={"setup": "loose"}) as ant:
        builder = ant.builder()
        builder.hands.do = lambda hands: None  # type: ignore[method-assign]
        finding = do(WALK["estop"], ant.bench, builder)
        assert not finding.ok
        assert finding.what == "no servo answers at any baud rate"
        assert standing(ant.folder)["estop"].state == "failed"


def test_a_closed_terminal_resumes_at_the_step_that_was_not_done(tmp_path):
    class Closing:
        """Grants, until the step Motor IDs begins."""

        def __init__(self, builder) -> None:
            self.builder = builder

        def answer(self, event: Event) -> Answer:
            if isinstance(event, Intent) and "make this" in event.words:
                raise KeyboardInterrupt
            return self.builder.answer(event)

    with robot(tmp_path / "ant", robot={"setup": "loose"}) as ant:
        with pytest.raises(KeyboardInterrupt):
            walk(ant.bench, Closing(ant.builder()))
        states = standing(ant.folder)
        assert [states[name].state for name in ("connect", "estop", "ids")] == ["ok", "ok", "todo"]
        following = next_step(ant.folder)
        assert following is not None
        assert following.step.name == "ids", "as the command says when it is left"
        assert not any(ant.torque())

        class Begun(Exception):
            pass

        def before(event: Event) -> None:
            if isinstance(event, StepAt):
                raise Begun(event.step.name, event.place, event.finding)

        with pytest.raises(Begun) as first:
            walk(ant.bench, ant.builder(before=before))
        assert first.value.args == ("ids", 3, None)


def test_a_step_that_says_no_may_be_done_again_at_once(tmp_path):
    """Without power no servo answers; the builder is asked, switches it on, and goes on with the walk."""

    class Begun(Exception):
        pass

    with robot(tmp_path / "ant", robot={"setup": "loose"}) as ant:
        builder = ant.builder(answers={"Emergency stop says no": "do it again"})
        does, builder.hands.do = builder.hands.do, lambda hands: None  # type: ignore[method-assign]

        def before(event: Event) -> None:
            if isinstance(event, Ask) and "says no" in event.question:
                builder.hands.do = does  # type: ignore[method-assign]
            if isinstance(event, StepAt) and event.step.name == "ids":
                raise Begun

        builder.before = before
        with pytest.raises(Begun):
            walk(ant.bench, builder)
        told = [event.finding.ok for event in builder.events if isinstance(event, StepAt) and event.finding is not None]
        assert told == [True, False, True]


def test_steps_that_need_what_said_no_are_left_out_in_words(tmp_path):
    folder = create_robot(tmp_path / "ant")
    for name in WALK:
        keep(found(name, ok=name not in ("identify", "gap")), folder)
    with robot(tmp_path / "ant") as ant:
        builder = ant.builder()
        builder.before = lambda event: (_ for _ in ()).throw(Declined("no")) if isinstance(event, Intent) else None
        with pytest.raises(Declined):
            walk(ant.bench, builder)  # it begins with Identification, and asks before anything moves
    keep(found("zeros", ok=False), folder)
    with robot(tmp_path / "ant") as ant:
        builder = ant.builder()
        builder.before = lambda event: (_ for _ in ()).throw(Declined("no")) if isinstance(event, Progress) else None
        with pytest.raises(Declined):
            walk(ant.bench, builder)


def test_work_with_callbacks_is_a_procedure_and_ends_when_it_is_closed():
    seen, ended = [], []

    def work(progress):
        try:
            progress(0.0, "begun")
            for k in range(1000):
                progress(k / 1000, "working")
        finally:
            ended.append(True)
        return 7

    procedure = relayed(work)
    seen.append(next(procedure))
    procedure.close()
    assert seen == [Progress(0.0, "begun")]
    assert ended == [True]
    result = []

    def whole():
        result.append((yield from relayed(work)))

    assert len(list(whole())) == 1001
    assert result == [7]


def test_work_that_is_a_part_tells_its_share_of_the_whole_and_is_ended_with_it():
    ended, answers = [], []

    def work():
        try:
            answers.append((yield Ask("how far?")))
            yield Progress(0.5, "half")
            yield Progress(None, "who knows")
            return 7
        finally:
            ended.append(True)

    procedure = within((0.2, 1.0), work())
    assert procedure.send(None) == Ask("how far?")
    assert procedure.send("so far") == Progress(pytest.approx(0.6), "half")
    assert next(procedure) == Progress(None, "who knows")
    with pytest.raises(StopIteration) as over:
        next(procedure)
    assert (over.value.value, answers, ended) == (7, ["so far"], [True])
    procedure = within((0.0, 0.2), work())
    next(procedure)
    procedure.close()
    assert ended == [True, True]


def test_what_the_work_raises_is_raised_by_the_procedure():
    def work(progress):
        raise HardwareFault("it fell")

    with pytest.raises(HardwareFault, match="it fell"):
        next(relayed(work))


# ---- the passport -----------------------------------------------------------------------------------------------------


def test_a_passport_says_what_is_known_and_what_is_not(tmp_path):
    folder = create_robot(tmp_path / "ant")
    keep(found("zeros"), folder)
    keep(Finding("imu", False, "no IMU answers", (), "", "", problems=("IMU: it is silent → unplug it",)), folder)
    html, markdown = write_passport(folder)
    page, text = html.read_text(), markdown.read_text()
    for words in (
        "Zeros and directions",
        "zeros done",
        "IMU: it is silent",
        "hip_rr",
        "XM430-W350-T",
        "openant train sac",
    ):
        assert words in page
        assert words in text
    assert "not done" in text
    assert "0.100 m and 0.045 m" in text


def test_a_passport_links_every_recording_and_tells_once_what_joints_share(tmp_path):
    folder = create_robot(tmp_path / "ant")
    folder.recordings.mkdir(exist_ok=True)
    for name in ("a.mcap", "b.mcap"):
        (folder.recordings / name).write_text("")
    zeros = dict.fromkeys((f"motors.{joint}.zero_offset_rad" for joint in JOINT_NAMES), 0.1)
    folder.update(zeros, provenance=Provenance("measured", "openant calib zeros"))
    folder.update(
        {"arena.radius_m": 0.3}, provenance=Provenance("measured", "a test", "recordings/a.mcap, recordings/b.mcap")
    )
    page = write_passport(folder)[0].read_text()
    assert page.count("openant calib zeros") == 1
    assert "motors.*.zero_offset_rad (8 joints)" in page
    for name in ("a.mcap", "b.mcap"):
        assert f'<a href="./recordings/{name}">{name}</a>' in page


# ---- the commands -----------------------------------------------------------------------------------------------------


def test_without_a_terminal_nothing_is_granted(tmp_path):
    result = openant("calib", "inventory", "--robot", tmp_path / "ant", "--virtual", scenario(tmp_path))
    assert result.returncode == 2
    assert "nobody is there to ask → add --yes if it may" in result.stderr


def test_a_step_alone_exits_with_1_where_it_says_no(tmp_path):
    file = scenario(tmp_path, '[[servo]]\njoint = "knee_rr"\nmodel = "XL430-W250-T"\nid = 11\nbaud = 1000000\n')
    report = tmp_path / "inventory.json"
    result = openant("calib", "inventory", "--robot", tmp_path / "ant", "--virtual", file, "--yes", "--json", report)
    assert result.returncode == 1
    assert "NOT OK" in result.stdout
    assert "knee_rr is a XL430-W250-T, the place is for a XM430-W350-T → put the right servo in" in result.stdout
    assert json.loads(report.read_text())["ok"] is False


def test_a_joint_that_is_none_is_refused_in_one_line(tmp_path):
    result = openant("calib", "ids", "--robot", tmp_path / "ant", "--joint", "hip_xx")
    assert result.returncode == 2
    assert result.stderr.startswith("openant: there is no joint 'hip_xx'")


def scenario(folder: Path, more: str = "") -> Path:
    path = folder / "robot.toml.scenario.toml"
    path.write_text(f'[robot]\nsetup = "stand"\n[clock]\nmode = "stepped"\n[camera]\npresent = false\n{more}')
    return path


def test_the_box_remembers_what_was_written_to_its_servos(tmp_path):
    given = tmp_path / "given.toml"
    given.write_text('[robot]\nsetup = "loose"\n[camera]\npresent = false\n')
    for kept in (1, 77):
        with persistent_robot(str(given), tmp_path) as box:
            assert box.kit == "standard"
            state = VirtualControl(box.control).ask("state")
            assert (state["setup"], state["id"]["hip_rr"]) == ("loose", kept)
        write_id(tmp_path, 77)


def write_id(folder: Path, id: int) -> None:
    """Let the kept memory of hip_rr say another id, as a step would have left it."""
    from openant_tools.virtual.eeprom import EepromFile
    from openant_tools.virtual.scenario import load_scenario
    from openant_tools.virtual.start import build

    world = build(load_scenario(folder / "virtual.toml"))
    world.servos[0].set("id", id)
    EepromFile(folder / "virtual-eeprom.json").write(world)


def test_a_virtual_robot_does_not_outlive_who_started_it(tmp_path):
    code = (
        "import time\nfrom openant_tools.virtual.process import virtual_robot\n"
        f"with virtual_robot({str(scenario(tmp_path))!r}) as found:\n    print(found['control'], flush=True)\n    time.sleep(600)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    control = Path(parent.stdout.readline().strip())
    assert control.exists()
    parent.kill()
    parent.wait()
    give_up = time.monotonic() + 60.0
    while control.exists():  # it takes its folder away when it ends
        assert time.monotonic() < give_up
        time.sleep(0.05)
