"""Excitations, and `openant sysid record`, `comms scan`, `comms bench` from the command line on a virtual robot."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.cli.comms import comms
from openant_tools.cli.sysid_record import DEFAULT_PROTOCOL, record
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.recording.reader import read_recording
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.sysid.excitation import Around, InTurn, Multisine, Releases
from openant_tools.sysid.floor_motion import LegLifts, Scrub, Twitch, WeightShifts
from openant_tools.sysid.plan_file import read_plan, write_plan
from openant_tools.sysid.protocols import FULL, PROTOCOLS, CommandSpace, Protocol, protocol, protocols
from openant_tools.sysid.record import takes
from openant_tools.sysid.tracking import tracking
from openant_tools.virtual.process import clock_of_its_own, placeable, placed

RATE = 100.0
SPACE = CommandSpace.around_home()


@given(
    st.sampled_from(sorted(PROTOCOLS)),
    st.floats(5, 60),
    st.integers(0, 2**32 - 1),
    st.sampled_from([20.0, 50.0, 100.0]),
)
@settings(max_examples=40)
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
    with pytest.raises(BadInput, match=r"2 s is too short"):
        protocol("stand", 2.0)
    with pytest.raises(BadInput, match="limits of knee_fl leave no room around the home pose"):
        CommandSpace.around_home({"knee_fl": (-0.5, 0.5)})


def test_the_default_tells_most_apart_in_about_40_s_on_stand_and_floor() -> None:
    parts = protocols(FULL)
    assert DEFAULT_PROTOCOL == FULL
    assert [(part.setup, round(part.heading_rad, 3)) for part in parts] == [
        ("stand", 0.0),
        ("floor", 0.0),
        ("floor", 1.571),
    ]
    assert sum(part.seconds for part in parts) == pytest.approx(40, abs=1)
    assert [part.setup for part in protocols(FULL, setup="stand")] == ["stand"]
    with pytest.raises(BadInput, match="chirp is played on the stand, not on the floor → leave out --setup floor"):
        protocols("chirp", setup="floor")


def test_one_joint_alone_means_alone() -> None:
    segment = InTurn(16.0, Multisine(1.0, low_hz=0.5))
    moved = segment.offsets(np.arange(1600) / RATE, SPACE, np.random.default_rng(0)) != 0
    assert moved.sum(1).max() == 1
    assert (moved.sum(0) > 150).all()


def test_around_moves_the_middle_and_stays_inside() -> None:
    segment = Around(6.0, Multisine(1.0), (0.5,))
    offsets = segment.offsets(np.arange(600) / RATE, SPACE, np.random.default_rng(0))
    assert offsets[100:500].mean(0) == pytest.approx(0.5 * SPACE.half, abs=0.1)
    assert (np.abs(offsets) <= SPACE.half).all()
    with pytest.raises(BadInput, match="a middle for 3 joints, where 8 move"):
        Around(6.0, Multisine(1.0), (0.1, 0.2, 0.3)).offsets(np.arange(10) / RATE, SPACE, np.random.default_rng(0))


@pytest.mark.parametrize("name", ["releases", "drops"])
def test_torque_is_off_for_a_while_and_never_at_the_ends(name: str) -> None:
    made = protocol(name)
    limp = made.limp(SPACE, RATE)
    assert limp.shape == made.commands(SPACE, RATE).shape
    assert 0.1 < limp.mean() < 0.4
    assert not limp[:100].any()
    assert not limp[-100:].any()


def test_weight_shifts_and_scrub_push_the_body_nowhere() -> None:
    t, chance = np.arange(400) / RATE, np.random.default_rng(1)
    shifts = WeightShifts(4.0).offsets(t, SPACE.standing(), chance)
    assert np.abs(shifts.sum(1)).max() < 1e-9  # what gives way on one side is raised on the other
    scrub = Scrub(4.0).offsets(t, SPACE.standing(), chance)
    assert np.abs(scrub.sum(1)).max() < 1e-9
    legs = {name: scrub[:, k] for k, name in enumerate(SPACE.joints)}
    assert legs["hip_fl"] == pytest.approx(-legs["hip_fr"])
    assert legs["hip_fl"] == pytest.approx(legs["hip_rr"])


def test_a_lifted_leg_has_both_neighbours_turned_towards_it() -> None:
    offsets = LegLifts(8.0).offsets(np.arange(800) / RATE, SPACE.standing(), np.random.default_rng(0))
    middle = dict(zip(SPACE.joints, offsets[500], strict=True))  # the third leg, front left
    assert middle["knee_fl"] > 0.2
    assert (middle["hip_rl"], middle["hip_fr"]) == (pytest.approx(-0.25), pytest.approx(0.25))
    assert sum(abs(value) > 1e-6 for value in middle.values()) == 3


def test_motions_on_the_floor_need_an_ant() -> None:
    space = CommandSpace(("shoulder",), np.zeros(1), -np.ones(1), np.ones(1))
    with pytest.raises(BadInput, match="need the eight joints of an Open Ant"):
        protocol("gait").commands(space, RATE)


def test_names_tell_repeat_floor_hot_and_held_out_apart() -> None:
    made = takes(Path("a.mcap"), protocols(FULL), 3, repeats=2, hold_out_seed=9, hot_s=60.0)
    assert [take.path.name for take in made] == [
        "a.mcap", "a-2.mcap", "a-held-out.mcap", "a-hot.mcap",
        "a-floor.mcap", "a-floor-2.mcap", "a-floor-held-out.mcap",
        "a-floor-90.mcap", "a-floor-90-2.mcap", "a-floor-90-held-out.mcap",
    ]  # fmt: skip
    by_name = {take.path.stem: take for take in made}
    assert by_name["a-2"].repeat_of == by_name["a-hot"].repeat_of == "a"
    assert by_name["a-floor-90-2"].repeat_of == "a-floor-90"
    assert (by_name["a-held-out"].seed, by_name["a-held-out"].held_out, by_name["a-2"].seed) == (9, True, 3)
    assert by_name["a-hot"].work_s == 60.0


# ---- plans as files ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(PROTOCOLS))
def test_every_protocol_survives_being_written_as_a_plan(name: str, tmp_path: Path) -> None:
    write_plan(tmp_path / "plan.toml", protocols(name), "a test")
    for read, made in zip(read_plan(tmp_path / "plan.toml"), protocols(name), strict=True):
        assert (read.setup, read.heading_rad) == (made.setup, pytest.approx(made.heading_rad))
        assert len(read.segments) == len(made.segments)
        assert read.seconds == pytest.approx(made.seconds, abs=0.01)
        a, b = read.commands(SPACE, RATE, 1), made.commands(SPACE, RATE, 1)
        n = min(len(a), len(b))
        # Times are written to a tenth of a millisecond: a step may come a sample later.
        assert np.mean(np.abs(a[:n] - b[:n]) > 0.02) < 0.02


GOOD_PLAN = 'schema = "openant.plan/1"\n[[recording]]\nsetup = "stand"\n[[recording.segment]]\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("schema = ", "is not TOML"),
        ("a = 1", "is no plan: its schema is not 'openant.plan/1' → make one with `openant sysid plan --out`"),
        ('schema = "openant.plan/1"', r"has no \[\[recording\]\]"),
        ('schema = "openant.plan/1"\n[[recording]]\nsetup = "moon"', "recording 1: `setup` is not stand or floor"),
        ('schema = "openant.plan/1"\n[[recording]]\nsetup = "stand"', r"has no \[\[recording.segment\]\]"),
        (GOOD_PLAN + 'kind = "Chrip"\nseconds = 3', "segment 1: there is no motion 'Chrip' → did you mean 'Chirp'"),
        (GOOD_PLAN + 'kind = "Chirp"', "Chirp lacks `seconds`"),
        (GOOD_PLAN + 'kind = "Chirp"\nseconds = 3\nlow = 3', "Chirp knows no 'low' → use seconds, low_hz"),
        (GOOD_PLAN + 'kind = "Chirp"\nseconds = nan', "`seconds` is not a number"),
        (GOOD_PLAN + 'kind = "Chirp"\nseconds = 3\nshare = 1.4', "`share` is 1.4, not a share between 0 and 1"),
        (GOOD_PLAN + 'kind = "Chirp"\nseconds = 3\nlow_hz = -1', "`low_hz` is -1, it must be more than 0"),
        (GOOD_PLAN + 'kind = "Chirp"\nseconds = 3000', "takes 3002 s → keep it below 600 s"),
        (GOOD_PLAN + 'kind = "Multisine"\nseconds = 3\nlines = 0', "`lines` is not a whole number from 1 on"),
        (GOOD_PLAN + 'kind = "Gait"\nseconds = 3', "has a motion for the floor on the stand"),
        (GOOD_PLAN.replace("stand", "floor") + 'kind = "Releases"\nseconds = 3', "lets go of legs that carry the robot"),
        (GOOD_PLAN + 'kind = "InTurn"\nseconds = 3', "InTurn lacks `of`"),
        (GOOD_PLAN + 'kind = "Around"\nseconds = 3\nshares = [2.0]\nof = {kind = "Rest", seconds = 1}', "not shares between"),
    ],
)  # fmt: skip
def test_a_bad_plan_says_where_and_what(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(BadInput, match=words):
        read_plan(path)


def test_a_missing_plan_says_so(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="No such file or directory → name a plan file"):
        read_plan(tmp_path / "none.toml")


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


def test_a_camera_that_looks_for_no_tag_yet_is_told_before_the_robot_moves(tmp_path: Path) -> None:
    """The default plays on the stand first, and looks through the camera on the floor alone."""
    folder = create_robot(tmp_path / "ant").path
    arguments = ["--virtual", "--robot", str(folder), "--out", str(tmp_path / "run.mcap"), "--yes"]
    result = CliRunner().invoke(record, arguments)
    assert isinstance(result.exception, BadInput)
    assert "camera.body_tag_id is not known yet" in str(result.exception)
    assert "--no-camera" in str(result.exception)
    assert "--setup stand" in str(result.exception)
    assert not list(tmp_path.glob("*.mcap"))
    blind = tmp_path / "blind.toml"
    blind.write_text("[camera]\npresent = false\n")
    quick = ["--robot", str(folder), "--rate", "50", "--yes"]
    stand = ["--setup", "stand", "--protocol", "stand", "--seconds", "5"]
    for source, name, more in (([str(blind)], "blind", ["--seconds", "20"]), ([], "stand", stand)):
        out = ["--virtual", *source, "--out", str(tmp_path / f"{name}.mcap")]
        result = CliRunner().invoke(record, [*out, *quick, *more])
        assert result.exit_code == 0, result.output


def test_a_camera_that_shows_nothing_is_told_before_the_robot_moves(tmp_path: Path) -> None:
    """A real robot's: its port is not even opened."""
    camera = str(tmp_path / "video9")
    folder = create_robot(tmp_path / "ant", values={"camera.body_tag_id": 12, "ports.camera": camera}).path
    arguments = ["--port", "/dev/ttyUSB9", "--robot", str(folder), "--out", str(tmp_path / "run.mcap"), "--yes"]
    result = CliRunner().invoke(record, [*arguments, "--setup", "floor"])
    assert isinstance(result.exception, HardwareFault)
    assert camera in str(result.exception)
    assert "--no-camera" in str(result.exception)
    # Nobody is asked to put it on the floor, and on the stand the camera is not needed.
    result = CliRunner().invoke(record, arguments)
    assert "left out, since nobody is asked to move the robot: on the floor" in result.stderr
    assert "/dev/ttyUSB9" in str(result.exception)


def test_a_plan_is_played_with_legs_released_and_caught_then_on_the_floor(tmp_path: Path) -> None:
    stand = Protocol("mine", "", (Releases(3.0, speed_rad_s=2.0),))
    floor = Protocol("mine", "", (Twitch(2.0),), "floor", np.pi / 2)
    write_plan(tmp_path / "plan.toml", (stand, floor), "a test")
    arguments = ["--virtual", "--plan", str(tmp_path / "plan.toml"), "--out", str(tmp_path / "run.mcap"), "--yes"]
    result = CliRunner().invoke(record, [*arguments, "--no-camera"])
    assert result.exit_code == 0, result.output
    run = read_recording(tmp_path / "run.mcap").run
    torque = run.signal("torque")
    off = torque[:, 2] == 0
    assert 0.5 < off.sum() / RATE < 0.9
    assert np.array_equal(torque, np.repeat(torque[:, :1], 8, axis=1))
    assert np.abs(run.signal("pwm")[off][1:]).max() == 0
    # Caught where it hangs: the first command with torque is the position, and then no jump.
    first = int(np.flatnonzero(off)[-1]) + 1
    cmd, pos = run.signal("cmd"), run.signal("pos")
    assert np.abs(cmd[first] - pos[first - 1]).max() < 0.01
    assert np.abs(np.diff(cmd[first:], axis=0)).max() < 1.3 / RATE
    # It coasted on, farther than a servo that stops.
    assert (np.abs(pos[first - 1] - pos[np.flatnonzero(off)[0]])[::2] > 0.05).all()
    facts = read_recording(tmp_path / "run-floor-90.mcap").run.facts
    assert (facts.setup, facts.protocol, facts.heading_rad) == ("floor", "mine", pytest.approx(np.pi / 2))
    assert facts.extra["segments"] == [
        {"start_s": 0.3, "kind": "Twitch", "seconds": 2.0, "hz": 8.0, "amplitude_rad": 0.05}
    ]


def test_the_sine_protocol_shows_a_delay_of_one_step(tmp_path: Path) -> None:
    """As the paper saw it at an XL430: with 50 commands a second, 20 ms later at every frequency."""
    kit = '[robot]\nkit = "lite"\n[clock]\nmode = "stepped"\n'
    delay = '[[effect]]\neffect = "action_delay"\njoints = "all"\nparameters = { delay_s = 0.02 }\n'
    seen = []
    for name, text in (("prompt", kit), ("late", kit + delay)):
        (tmp_path / f"{name}.toml").write_text(text)
        out = tmp_path / f"{name}.mcap"
        arguments = ["--protocol", "sine", "--seconds", "8", "--rate", "50", "--out", str(out), "--yes"]
        result = CliRunner().invoke(record, ["--virtual", str(tmp_path / f"{name}.toml"), *arguments])
        assert result.exit_code == 0, result.output
        assert "knee_fl follows later by" in result.output
        seen.append(np.array([joint.late_s for joint in tracking(read_recording(out).run)]))
    prompt, late = seen
    assert prompt.shape == (8, 2)
    assert late - prompt == pytest.approx(0.02, abs=2e-3)


def test_a_virtual_robot_is_put_where_it_is_needed_unless_it_says_itself_where_it_is(tmp_path: Path) -> None:
    (tmp_path / "ant.toml").write_text('seed = 4\n[robot]\nkit = "lite"\neeprom = "memory.json"\n')
    with placed(str(tmp_path / "ant.toml"), "floor", 1.5) as source:
        table = tomllib.loads(Path(source).read_text())
    assert table["seed"] == 4
    assert table["robot"] == {
        "kit": "lite", "eeprom": str(tmp_path / "memory.json"), "setup": "floor", "heading_rad": 1.5,
    }  # fmt: skip
    with placed(str(tmp_path / "ant.toml"), "stand", 0.0) as source:
        assert source == str(tmp_path / "ant.toml")
    for name, text in (("loose.toml", '[robot]\nsetup = "loose"\n'), ("sealed.toml", 'sealed = "x"\n'), ("r.json", "")):
        (tmp_path / name).write_text(text)
        assert not placeable(str(tmp_path / name))


@pytest.mark.parametrize(
    ("name", "text", "clock"),
    [
        ("default", "", "stepped"),
        ("ant.toml", "seed = 1\n", "stepped"),
        ("real.toml", '[clock]\nmode = "real"\n', None),
        ("ready.json", "{}", None),
    ],
)
def test_a_robot_started_for_one_command_steps_unless_its_scenario_says_otherwise(
    name: str, text: str, clock: str | None, tmp_path: Path
) -> None:
    if name != "default":
        (tmp_path / name).write_text(text)
        name = str(tmp_path / name)
    assert clock_of_its_own(name) == clock


def test_the_list_says_what_is_played_where() -> None:
    result = CliRunner().invoke(record, ["--list"])
    assert result.exit_code == 0
    assert "(default)" in result.output.splitlines()[0]
    for name in PROTOCOLS:
        assert f"\n{name} " in f"\n{result.output}"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--yes"], "no name for the recording → name it with --out"),
        (["--out", "a.mcap", "--plan", "p.toml", "--protocol", "chirp"], "a plan says what to play → leave out"),
        (
            ["--out", "a.mcap", "--protocol", "gait", "--setup", "stand"],
            "gait is played on the floor, not on the stand",
        ),
        (
            ["--out", "a.mcap", "--seed", "4", "--hold-out-seed", "4"],
            "with seed 4 the recording to hold out would play the same",
        ),
        (["--out", "a.mcap", "--rate", "nan"], "--rate is nan → give it a number"),
        (["--out", "a.mcap", "--seconds", "1e9"], "1000000000 s is too long for full → record for 600 s at most"),
        (["--out", "a.mcap", "--seconds", "9"], "9 s is too short for full → give it 20 s or more"),
    ],
)
def test_what_cannot_be_recorded_is_refused(arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(record, ["--virtual", *arguments])
    assert isinstance(result.exception, BadInput)
    assert words in str(result.exception)


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
        [*cli, "virtual", "start", "--no-camera", "--ready-file", str(ready)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        _wait(ready.is_file)
        command = [*cli, "sysid", "record", "--virtual", str(ready), "--out", str(out), "--yes"]
        player = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
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
