"""A builder brings a robot up, and makes the mistakes that builders make: the right words appear, nothing moves unasked."""

from __future__ import annotations

import datetime
import itertools
import math
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from boards import TILTS, board_views
from builder import robot
from hypothesis import given
from hypothesis import strategies as st

from openant_tools.bringup.simulated_builder import SimulatedBuilder
from openant_tools.calib import arena as arena_step
from openant_tools.calib.arena import LYING_M, STANDING_M, arena, judge_sizes
from openant_tools.calib.bounds import Unwrapped, bounds
from openant_tools.calib.centre import centre
from openant_tools.calib.comms_health import comms_health
from openant_tools.calib.connect import connect
from openant_tools.calib.estop import estop
from openant_tools.calib.gyro_scale import KNOWN, by_camera, by_hand
from openant_tools.calib.ids import ids
from openant_tools.calib.imu import POSES, imu, mounting
from openant_tools.calib.inventory import inventory
from openant_tools.calib.legs import legs
from openant_tools.calib.undo import undo
from openant_tools.calib.wires import engine_config, opened_imu
from openant_tools.calib.zeros import straight, torso_answer, zeros
from openant_tools.comms import messages
from openant_tools.comms.body_imu import rotation
from openant_tools.comms.camera import CameraInfo
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.intrinsics import CharucoBoard, Intrinsics
from openant_tools.errors import HardwareFault
from openant_tools.procedure.journal import EepromWrite, Journal
from openant_tools.procedure.step import Ask, Bench, Declined, Event, Hands, Intent, Live, Progress, Say, drive
from openant_tools.procedure.unfinished import Parts, unfinished
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts
from openant_tools.robot.config import CameraSection, Provenance
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINT_NAMES, JOINTS

pytestmark = pytest.mark.usefixtures("quarter_rate")
LOOSE = {"robot": {"setup": "loose"}}
HIP = ("hip_rr",)


# ---- connect, stop key ------------------------------------------------------------------------------------------------


def test_connect_finds_bus_and_imu_and_keeps_no_port_of_a_virtual_robot(tmp_path):
    with robot(tmp_path / "ant") as ant:
        finding, _ = ant.do(connect(ant.bench))
        assert finding.ok
        assert finding.data["imu"] == ant.bench.imu
        assert ant.folder.config().ports.bus == ""


def test_connect_says_what_it_sees_of_the_camera_and_what_needs_one(tmp_path):
    with robot(tmp_path / "ant", sees=True, camera={"width": 640, "height": 480}) as ant:
        finding, builder = ant.do(connect(ant.bench))
        assert finding.ok
        assert finding.what.endswith(f"the camera {ant.bench.camera}")
        assert "640 × 480 pixels" in builder.said
        finding, builder = ant.do(connect(replace(ant.bench, camera="http://127.0.0.1:9/stream.mjpg")))
        assert finding.ok, "all steps but the Arena go without"
        assert finding.what.endswith("the camera shows nothing")
        assert finding.problems[0].startswith("camera: http://127.0.0.1:9/stream.mjpg: no picture comes → ")
        ant.builder().hands.do(Hands("", "place", setup="loose"))  # type: ignore[arg-type]
        finding, _ = ant.do(connect(ant.bench))
        assert finding.what.endswith(f"the camera {ant.bench.camera}"), "of loose motors it sees the floor alone"
        finding, builder = ant.do(connect(replace(ant.bench, camera=None)))
        assert finding.what.endswith("no camera yet")
        assert "to learn on the floor the robot needs one" in builder.said


def test_connect_says_where_the_servos_answer_instead_of_the_imu(tmp_path):
    with robot(tmp_path / "ant") as ant:
        finding, _ = ant.do(connect(replace(ant.bench, imu="/nowhere")))
        assert not finding.ok
        assert "IMU: /nowhere: there is no such port" in finding.problems[0]


def test_the_stop_key_is_proven_on_a_factory_fresh_servo(tmp_path):
    with robot(tmp_path / "ant", **LOOSE) as ant:
        finding, builder = ant.do(estop(ant.bench))
        assert finding.ok, finding
        assert "Plug one servo in" in builder.said
        assert not any(ant.torque())


def test_without_power_the_stop_key_cannot_be_proven(tmp_path):
    with robot(tmp_path / "ant", **LOOSE) as ant:
        builder = ant.builder()
        builder.hands.do = lambda hands: None  # type: ignore[method-assign]
        with pytest.raises(HardwareFault, match="no servo answers at any baud rate"):
            ant.do(estop(ant.bench), builder)


# ---- ids --------------------------------------------------------------------------------------------------------------


def test_eight_servos_from_the_box_get_their_ids_and_undo_takes_one_back(tmp_path):
    with robot(tmp_path / "ant", **LOOSE) as ant:
        finding, builder = ant.do(ids(ant.bench))
        assert finding.ok, finding
        assert [ant.register(joint, "id") for joint in JOINT_NAMES] == [joint.id for joint in JOINTS.values()]
        assert {ant.register(joint, "baud_rate") for joint in JOINT_NAMES} == {3}
        assert "hip_rr: id 1 → 10" in builder.granted
        assert not [event for event in builder.events if isinstance(event, Ask)], "nobody can see a virtual servo blink"
        assert builder.said.count("blink and turn? It is the ") == 8
        assert "from now on. (yes: this robot is virtual, that is pretended)" in builder.said
        assert not any(ant.torque())
        entries = Journal(ant.folder.journal).open_entries()
        assert len(entries) == 24
        assert entries[0].write.old == 250
        hands = ant.builder().hands
        hands.do(Hands("", "plug", "hip_rr"))
        ant.server.world.advance(ant.server.world.now + 1.0)
        finding, _ = ant.do(undo(replace(ant.bench, joints=HIP)))
        assert finding.ok, finding
        assert (ant.register("hip_rr", "id"), ant.register("hip_rr", "baud_rate")) == (1, 1)
        assert ant.register("knee_rr", "id") == 11


def test_nothing_is_written_unless_it_is_granted(tmp_path):
    with robot(tmp_path / "ant", **LOOSE) as ant:

        class Refusing:
            def __init__(self) -> None:
                self.builder = ant.builder()

            def answer(self, event: Event):
                return False if isinstance(event, Intent) else self.builder.answer(event)

        with pytest.raises(Declined, match="make this XC430-W240-T"):
            drive(ids(ant.bench), Refusing())
        assert ant.register("hip_rr", "id") == 1
        assert not ant.folder.journal.exists()


def test_two_motors_plugged_at_once_are_told_apart_from_one(tmp_path):
    with robot(tmp_path / "ant", **LOOSE) as ant:
        builder = ant.builder()
        whole = builder.hands.do

        def both(hands: Hands) -> None:
            whole(hands)
            if hands.task == "plug":
                whole(replace(hands, joint="hip_fr"))

        builder.hands.do = both  # type: ignore[method-assign]
        finding, _ = ant.do(ids(replace(ant.bench, joints=HIP)), builder)
        assert not finding.ok
        assert ant.register("hip_rr", "id") == 1
        assert "hip_rr: two servos answer at once" in finding.problems[0]
        assert "unplug all but one" in finding.problems[0]


def test_a_servo_that_stayed_on_the_cable_is_named_as_the_one_to_pull(tmp_path):
    with robot(tmp_path / "ant", **LOOSE) as ant:
        builder = ant.builder()
        whole = builder.hands.do
        builder.hands.do = lambda hands: None if hands.task == "unplug" and hands.joint else whole(hands)  # type: ignore
        finding, _ = ant.do(ids(replace(ant.bench, joints=("hip_rr", "knee_rr"))), builder)
        assert "knee_rr: 2 servos answer" in finding.problems[0]
        assert "pull the cable of hip_rr" in finding.problems[0]


def test_the_wrong_model_is_named_with_the_place_that_it_belongs_to(tmp_path):
    with robot(tmp_path / "ant", **LOOSE) as ant:
        builder = ant.builder(mistakes={"hip_rr": "knee_rr"})
        finding, _ = ant.do(ids(replace(ant.bench, joints=HIP)), builder)
        assert not finding.ok
        assert ant.register("knee_rr", "id") == 1
        assert (
            "this is a XM430-W350-T, but the place is for a XC430-W240-T → it belongs into a knee"
            in finding.problems[0]
        )


def test_a_servo_left_at_4_5_megabaud_is_found_from_the_box(tmp_path):
    with robot(tmp_path / "ant", **LOOSE, servo=[{"joint": "hip_rr", "baud": 4_500_000}]) as ant:
        finding, builder = ant.do(ids(replace(ant.bench, joints=HIP)))
        assert finding.ok
        assert ant.register("hip_rr", "baud_rate") == 3
        assert "4500000 baud" in builder.said


def test_the_cable_out_in_mid_step_leaves_words_and_the_step_can_be_repeated(tmp_path):
    with robot(tmp_path / "ant", **LOOSE) as ant:
        pulled = []

        def pull(event: Event) -> None:
            if isinstance(event, Intent) and not pulled:
                pulled.append(True)
                builder.hands.do(Hands("", "unplug", "hip_rr"))

        builder = ant.builder(before=pull)
        with pytest.raises(HardwareFault, match=r"hip_rr \(id 1\) does not answer at 57600"):
            ant.do(ids(replace(ant.bench, joints=HIP)), builder)
        finding, _ = ant.do(ids(replace(ant.bench, joints=HIP)))
        assert finding.ok
        assert ant.register("hip_rr", "id") == 10


def test_wired_servos_whose_ids_are_exchanged_are_renamed_without_ever_clashing(tmp_path):
    swapped = [{"joint": "hip_rr", "id": 20}, {"joint": "hip_fr", "id": 10}]
    with robot(tmp_path / "ant", servo=swapped) as ant:
        finding, _ = ant.do(ids(ant.bench))
        assert (
            finding.what == "every servo has its id already"
        )  # models and ids are those of an Ant: only hands can tell
        (tmp_path / "ant" / "journal.jsonl").unlink(missing_ok=True)
    with robot(tmp_path / "bee", servo=[{"joint": "hip_rr", "id": 50}]) as ant:
        finding, builder = ant.do(ids(ant.bench))
        assert finding.ok
        assert ant.register("hip_rr", "id") == 10
        assert "Which joint is id 50" in builder.said


def test_a_virtual_robot_looks_itself_which_wired_servo_blinked(tmp_path):
    """Also where the first that would fit is another, and where the robot keeps its truth to itself."""
    mixed = [{"joint": "hip_rl", "id": 50}, {"joint": "hip_rr", "id": 51}, {"joint": "knee_fl", "id": 10}]
    with robot(tmp_path / "ant", servo=mixed) as ant:
        ant.server.sealed = True
        finding, builder = ant.do(ids(ant.bench))
        assert finding.ok, finding
        assert [event.question for event in builder.events if isinstance(event, Ask)] == [
            "8 servos answer under ids of their own: rename them as they are wired, or set bare servos up one at a time?"
        ]
        assert "Which joint is id 50 (XC430-W240-T)? hip_rl (this robot is virtual: it looked" in builder.said
        assert [ant.register(joint, "id") for joint in JOINT_NAMES] == [joint.id for joint in JOINTS.values()]
        assert not any(ant.torque())


# ---- centring, legs ---------------------------------------------------------------------------------------------------


def set_up(**more):
    """Loose servos with their ids, as the step Motor IDs leaves them."""
    servos = [{"joint": j.name, "id": j.id, "baud": 1_000_000, "return_delay_time": 0} for j in JOINTS.values()]
    return {"robot": {"setup": "loose", "pose": {"hip_rr": 0.5}}, "servo": servos, **more}


def test_horns_go_on_at_half_a_turn_and_the_drawing_says_which_way(tmp_path):
    with robot(tmp_path / "ant", **set_up()) as ant:
        finding, builder = ant.do(centre(replace(ant.bench, joints=("hip_rr", "knee_rr"))))
        assert finding.ok, finding
        assert "turn hip_rr slowly from 209° to 180°" in builder.said
        assert shares(builder.events) == [0.0, 0.5]
        assert not any(ant.torque())
        assert abs(ant.server.world.body.q[0]) < 0.03


def shares(events: list[Event]) -> list[float]:
    """How far the step said to be, which never goes back."""
    told = [event.share for event in events if isinstance(event, Progress) and event.share is not None]
    assert told == sorted(told)
    return told


def leave_at(kind: type[Event], words: str):
    """A builder who leaves once an event of this kind says so."""

    def leave(event: Event) -> None:
        said = event.question if isinstance(event, Ask) else getattr(event, "words", "")
        if isinstance(event, kind) and words in said:
            raise KeyboardInterrupt

    return leave


def test_ids_that_were_left_go_on_with_the_next_servo(tmp_path):
    with robot(tmp_path / "ant", **LOOSE) as ant:
        for left_at in ("(knee_rr)", "(hip_fr)"):
            builder = ant.builder(before=leave_at(Hands, left_at))
            with pytest.raises(KeyboardInterrupt):
                ant.do(ids(ant.bench), builder)
        assert "it goes on at 2 of 8: hip_rr was done before" in builder.said
        plugged = [event.joint for event in builder.events if isinstance(event, Hands) and event.task == "plug"]
        assert plugged == ["knee_rr", "hip_fr"]
        ant.do(undo(ant.bench))  # what is taken back is to be done again
        assert unfinished(ant.folder, "ids", virtual=True) is None


def test_a_servo_that_has_its_name_does_not_lose_it_to_the_next_joint(tmp_path):
    """The one plugged in again by mistake, and, on the cable when the step goes on, one that reads otherwise."""
    with robot(tmp_path / "ant", **LOOSE) as ant:
        builder = ant.builder(mistakes={"hip_fr": "hip_rr"}, before=leave_at(Hands, "(knee_fr)"))
        with pytest.raises(KeyboardInterrupt):
            ant.do(ids(ant.bench), builder)
        assert (
            "hip_fr: this servo has id 10, it is hip_rr since before → plug in one that has no name yet" in builder.said
        )
        assert ant.register("hip_rr", "id") == 10
        assert unfinished(ant.folder, "ids", virtual=True).words == "2 of 8"
        ant.server.world.servos[0].set("baud_rate", 1)
        hands = ant.builder().hands
        hands.do(Hands("", "plug", "hip_rr"))
        hands.do(Hands("", "plug", "knee_rr"))
        ant.server.world.advance(ant.server.world.now + 1.0)
        builder = ant.builder(before=leave_at(Hands, "Plug in one servo"))
        with pytest.raises(KeyboardInterrupt):
            ant.do(ids(ant.bench), builder)
        assert not [event for event in builder.events if isinstance(event, Ask)], "one at a time is answered already"
        assert "hip_rr is not as it was left: id 10 answers at 57600 baud; it is done again" in builder.said
        assert "knee_rr is not as it was left" not in builder.said
        assert "(hip_rr)" in builder.events[-1].words


def test_legs_that_were_left_are_read_again_and_only_a_difference_reopens_one(tmp_path, brisk):
    with robot(tmp_path / "ant") as ant:
        with pytest.raises(KeyboardInterrupt):
            ant.do(legs(ant.bench), ant.builder(before=leave_at(Hands, "Connect hip_fl")))
        assert unfinished(ant.folder, "legs", virtual=True).words == "2 of 4"
        servos = dict(zip(JOINT_NAMES, ant.server.world.servos, strict=True))

        def goes_on_with() -> tuple[str, str]:
            builder = ant.builder(before=leave_at(Hands, "Connect"))
            with pytest.raises(KeyboardInterrupt):
                ant.do(legs(ant.bench), builder)
            return builder.events[-1].words, builder.said

        assert goes_on_with()[0] == "Connect hip_fl."
        servos["hip_fr"].set("id", 77)
        words, said = goes_on_with()
        assert words == "Connect hip_fr."
        assert "front right leg is not as it was left: hip_fr: nothing answers under id 20; it is done again" in said
        assert "rear right leg is not" not in said
        servos["hip_rr"].set("homing_offset", 1000)
        words, said = goes_on_with()
        assert words == "Connect hip_rr."
        assert re.search("rear right leg is not as it was left: hip_rr is at 88°, hands moved it from", said)


def test_centring_that_was_left_goes_on_where_it_was_and_reads_again_what_was_done(tmp_path, brisk):
    with robot(tmp_path / "ant", **set_up()) as ant:
        with pytest.raises(KeyboardInterrupt):
            ant.do(centre(ant.bench), ant.builder(before=leave_at(Say, "hip_fr holds")))
        assert not any(ant.torque())
        assert unfinished(ant.folder, "centre", virtual=True).words == "2 of 8"
        mode = ant.server.world.servos[1].model.register("operating_mode")
        ant.server.world.servos[1].memory[mode.address] = 4  # somebody has played with knee_rr meanwhile
        builder = ant.builder(before=leave_at(Say, "knee_fr holds"))
        with pytest.raises(KeyboardInterrupt):
            ant.do(centre(ant.bench), builder)
        assert "it goes on at 3 of 8: hip_rr, knee_rr were done before" in builder.said
        assert "knee_rr is not as it was left: its operating mode is 4, not 3; it is done again" in builder.said
        asked = [
            event.words.split()[0] for event in builder.events if isinstance(event, Say) and "holds." in event.words
        ]
        assert asked == ["knee_rr", "hip_fr", "knee_fr"]


def test_zeros_and_ranges_that_were_left_go_on_with_the_next_joint(tmp_path):
    with robot(tmp_path / "ant") as ant:
        for step, name in ((zeros, "zeros"), (bounds, "bounds")):
            with pytest.raises(KeyboardInterrupt):
                ant.do(step(ant.bench), ant.builder(before=leave_at(Hands, "Move the front right hip")))
            assert unfinished(ant.folder, name, virtual=True).words == ("2 of 8" if step is zeros else "2 of 12")
        ant.folder.update({"motors.knee_rr.zero_offset_rad": 3.0}, provenance=Provenance("measured", "a test"))
        moved = {}
        for step in (zeros, bounds):
            builder = ant.builder(before=leave_at(Hands, "Move the front right knee"))
            with pytest.raises(KeyboardInterrupt):
                ant.do(step(ant.bench), builder)
            of = 8 if step is zeros else 12
            assert f"it goes on at 3 of {of}: hip_rr, knee_rr were done before" in builder.said
            asked = [event.joint for event in builder.events if isinstance(event, Hands) and event.task == "turn"]
            moved[step.__name__] = list(dict.fromkeys(asked))
        assert moved == {"zeros": ["hip_fr", "knee_fr"], "bounds": ["knee_rr", "hip_fr", "knee_fr"]}
        assert "knee_rr has another zero than when it was moved; it is done again" in builder.said


def test_bounds_that_were_left_after_the_sweep_do_not_sweep_again(tmp_path, brisk, sweeping):
    with robot(tmp_path / "ant") as ant:
        with pytest.raises(KeyboardInterrupt):
            ant.do(bounds(ant.bench), ant.builder(before=leave_at(Progress, "trot")))
        assert not any(ant.torque())
        assert unfinished(ant.folder, "bounds", virtual=True).next == "motions on the stand"
        builder = ant.builder(before=leave_at(Hands, "Put it back"))
        with pytest.raises(KeyboardInterrupt):
            ant.do(bounds(ant.bench), builder)
        assert not [event for event in builder.events if isinstance(event, Hands) and event.task == "turn"]
        assert "then sweep" not in builder.said
        assert "goal_pwm" not in builder.said  # which the sweep had lowered
        assert shares(builder.events)[-1] > 0.6
        assert unfinished(ant.folder, "bounds", virtual=True).next == "back on its stand"
        finding, builder = ant.do(bounds(ant.bench))
        assert is_dated(ant, "observation.pos.hip_rr")
        assert is_dated(ant, "motors.hip_rr.max_rad")
        assert finding.ok, finding.problems
        moving = [event.words for event in builder.events if isinstance(event, Intent) and event.moves]
        assert (moving, [e for e in builder.events if isinstance(e, Ask)]) == ([], [])
        assert unfinished(ant.folder, "bounds", virtual=True) is None
        kept = ant.recorded()
        named = {name.removeprefix("recordings/") for name in finding.data["recordings"].split(", ")}
        assert len(named) == 3
        assert named <= set(kept), "and what was left in the middle stands beside them"
        with pytest.raises(KeyboardInterrupt):
            ant.do(bounds(ant.bench), ant.builder(before=leave_at(Progress, "slow sweep")))
        assert ant.recorded().items() > kept.items(), "a repeat that was cut short takes the place of nothing"


def test_an_imu_whose_poses_were_left_goes_on_with_the_next_and_another_board_begins_anew(tmp_path):
    with robot(tmp_path / "ant") as ant:
        with pytest.raises(KeyboardInterrupt):
            ant.do(imu(ant.bench), ant.builder(before=leave_at(Hands, "left side straight down")))
        left = unfinished(ant.folder, "imu", virtual=True)
        assert (left.words, left.next) == ("2 of 4", "left side straight down")
        builder = ant.builder(before=leave_at(Hands, "Within 3 s"))
        with pytest.raises(KeyboardInterrupt):
            ant.do(imu(ant.bench), builder)
        held = [event.words for event in builder.events if isinstance(event, Hands) and "keep still" in event.words]
        assert held == ["Hold the robot left side straight down and keep still."]
        assert unfinished(ant.folder, "imu", virtual=True).next == "turns"
        note = ant.folder.path / "unfinished" / "imu.virtual.json"
        of_this_board = note.read_text()
        finding, builder = ant.do(imu(ant.bench))
        assert finding.ok, finding
        assert "keep still" not in builder.said
        assert unfinished(ant.folder, "imu", virtual=True) is None
        uid = finding.data["uid"]
        note.write_text(of_this_board.replace(str(uid), "another"))
        builder = ant.builder(before=leave_at(Hands, "nose straight down"))
        with pytest.raises(KeyboardInterrupt):
            ant.do(imu(ant.bench), builder)
        assert "it is another flight controller than when it was left: every pose is held again" in builder.said


class Late(SimulatedBuilder):
    """Hands that read first: a task that is watched begins only once it has been watched for a while."""

    waiting: Hands | None = None
    looks = 0

    def do(self, hands: Hands) -> None:
        if hands.while_watching and hands.task == "turn":
            self.waiting, self.looks = hands, 0
        else:
            super().do(hands)

    def look(self, event: Event) -> None:
        if isinstance(event, Live) and self.waiting is not None:
            self.looks += 1
            if self.looks > 100:
                super().do(self.waiting)
                self.waiting = None


def test_hands_lift_a_robot_that_a_step_left_on_the_floor_before_they_tilt_it(tmp_path):
    with robot(tmp_path / "ant", robot={"setup": "floor"}) as ant:
        ant.builder().hands.do(Hands("Hold it level.", "tilt", path_rad=(0.0, 0.0, 0.0)))
        assert VirtualControl(ant.control).ask("state")["setup"] == "stand"


def test_a_leg_is_watched_until_hands_have_moved_it(tmp_path):
    with robot(tmp_path / "ant") as ant:
        builder = ant.builder()
        builder.hands = late = Late(ant.control)
        builder.before = late.look
        finding, _ = ant.do(legs(replace(ant.bench, joints=("hip_fl",))), builder)
        assert finding.ok, builder.said


def test_a_leg_is_told_from_one_zero_before_and_while_its_motor_nudges_it(tmp_path):
    """Half a turn lay between what hands and what the motor showed."""
    by_hand, by_motor = dict[str, float](), dict[str, float]()

    def look(event: Event) -> None:
        if isinstance(event, Live) and event.angles_rad:
            by_hand.update(event.angles_rad)
        elif isinstance(event, Live):
            (engine,) = EngineProcess.running
            rows = engine.telemetry()
            by_motor.update({joint: float(rows[0, engine.columns.index(f"pos.{joint}")]) for joint in event.values})

    with robot(tmp_path / "ant") as ant:
        finding, _ = ant.do(legs(replace(ant.bench, joints=("hip_fl",))), ant.builder(before=look))
    assert finding.ok
    assert by_motor == pytest.approx(by_hand, abs=0.2)


def test_legs_are_proven_one_by_one_and_a_bad_cable_is_named(tmp_path):
    fault = [{"cause": "bad_cable", "where": "knee_fr", "fraction": 0.2}]
    with robot(tmp_path / "ant", fault=fault) as ant:
        finding, _ = ant.do(legs(replace(ant.bench, joints=("hip_fr", "hip_fl"))))
        assert finding.data["proven"] == ["fl"]
        assert "front right leg" in finding.problems[0]
        assert "look at the cable" in finding.problems[0]


# ---- inventory --------------------------------------------------------------------------------------------------------


def test_what_differs_is_shown_mended_and_can_be_undone(tmp_path):
    odd = [{"joint": "knee_fl", "drive_mode": 1, "shutdown": 0x3D, "return_delay_time": 250}]
    with robot(tmp_path / "ant", servo=odd) as ant:
        finding, builder = ant.do(inventory(ant.bench))
        assert finding.ok
        assert "knee_fl: drive_mode 1 → 0" in builder.granted
        assert (ant.register("knee_fl", "drive_mode"), ant.register("knee_fl", "pwm_limit")) == (0, 442)
        assert ant.folder.config().bus.return_delay_s == 0.0
        finding, _ = ant.do(undo(ant.bench))
        assert finding.ok
        assert ant.register("knee_fl", "drive_mode") == 1


def test_a_servo_that_was_told_not_to_answer_writes_is_named_and_mended_in_the_journal(tmp_path):
    with robot(tmp_path / "ant", servo=[{"joint": "knee_fl", "status_return_level": 1}]) as ant:
        finding, builder = ant.do(inventory(ant.bench))
        assert finding.ok
        assert "knee_fl (id 31) has Status Return Level 1: it answers pings and reads, and no writes" in builder.said
        assert "knee_fl: status_return_level 1 → 2" in builder.granted
        assert ant.register("knee_fl", "status_return_level") == 2
        writes = [entry.write for entry in Journal(ant.folder.journal).entries()]
        assert ("knee_fl", "status_return_level", 1, 2) in [(w.joint, w.register, w.old, w.new) for w in writes]
        finding, _ = ant.do(undo(ant.bench, everything=True))
        assert finding.ok
        assert ant.register("knee_fl", "status_return_level") == 2  # power-off takes it back, undo has no part in it


def test_undo_lowers_no_protection_on_a_value_that_was_read_once(tmp_path):
    with robot(tmp_path / "ant") as ant:
        # A line as an older version left it, and what a late answer made of it: a Shutdown that never was 0.
        lie = EepromWrite("knee_fl", 31, "shutdown", 0, 0x34, 1_000_000)
        higher = EepromWrite("hip_rr", 10, "temperature_limit", 100, 80, 1_000_000)
        lower = EepromWrite("hip_fr", 20, "temperature_limit", 70, 80, 1_000_000)
        for write in (lie, higher, lower):
            Journal(ant.folder.journal).append(write, "calib inventory")
        finding, _ = ant.do(undo(ant.bench))
        assert not finding.ok
        assert [ant.register("knee_fl", "shutdown"), ant.register("hip_rr", "temperature_limit")] == [0x34, 80]
        assert ant.register("hip_fr", "temperature_limit") == 70, "more protection needs no proof"
        assert "shutdown would go from 52 to 0, less protection" in finding.problems[-1]
        # What was read twice is taken back, whatever it protects.
        Journal(ant.folder.journal).append(replace(higher, confirmed=True), "calib inventory")
        ant.do(undo(replace(ant.bench, joints=("hip_rr",))))
        assert ant.register("hip_rr", "temperature_limit") == 100


def test_what_is_accepted_stays_and_is_kept(tmp_path):
    with robot(tmp_path / "ant", servo=[{"joint": "knee_fl", "shutdown": 0x3D}]) as ant:
        finding, _ = ant.do(inventory(ant.bench), ant.builder(answers={"What to do": "accept"}))
        assert ant.register("knee_fl", "shutdown") == 0x3D
        assert ant.register("hip_rr", "pwm_limit") == 885
        assert any("knee_fl: shutdown is 61, expected 52 → accepted" in problem for problem in finding.problems)


def test_a_baud_rate_left_behind_is_named_and_mended(tmp_path):
    with robot(tmp_path / "ant", servo=[{"joint": "knee_fl", "baud": 4_500_000}]) as ant:
        finding, builder = ant.do(inventory(ant.bench))
        assert finding.ok
        assert ant.register("knee_fl", "baud_rate") == 3
        assert "knee_fl (id 31) answers at 4500000 baud: its rate was left there" in builder.said


def test_a_hip_and_a_knee_that_are_swapped_are_named_together(tmp_path):
    swapped = [
        {"joint": "hip_rr", "id": 11},
        {"joint": "knee_rr", "id": 10},
    ]
    with robot(tmp_path / "ant", servo=swapped) as ant:
        finding, _ = ant.do(inventory(ant.bench))
        assert not finding.ok
        assert any("hip_rr and knee_rr are swapped" in problem for problem in finding.problems)


def test_a_silent_knee_names_the_cable_behind_its_hip(tmp_path):
    with robot(tmp_path / "ant") as ant:
        ant.server.world.plug(1, False)
        finding, _ = ant.do(inventory(ant.bench))
        assert not finding.ok
        assert "look at the cable between hip_rr and knee_rr" in finding.problems[0]


def test_old_firmware_is_said_with_what_it_lacks(tmp_path):
    with robot(tmp_path / "ant", servo=[{"joint": "hip_rr", "firmware": 41}]) as ant:
        _, builder = ant.do(inventory(ant.bench))
        assert "hip_rr has firmware 41, without clearing of turns" in builder.said


# ---- zeros ------------------------------------------------------------------------------------------------------------

FAST = ("hip_rr", "knee_rr", "hip_fr")


def is_dated(ant, path: str) -> bool:
    """Whether robot.toml says that the value there was measured a moment ago."""
    told = ant.folder.config().provenance_of(path)
    age = datetime.datetime.now(datetime.UTC) - told.date
    return told.how == "measured" and datetime.timedelta(0) <= age < datetime.timedelta(minutes=20)


def test_a_well_built_robot_has_its_zeros_on_the_grid(tmp_path):
    zero = [{"effect": "zero_offset", "joints": ["knee_rr"], "parameters": {"angle_rad": 0.03}}]
    with robot(tmp_path / "ant", effect=zero) as ant:
        finding, builder = ant.do(zeros(replace(ant.bench, joints=FAST)))
        assert (finding.ok, finding.problems) == (True, ())
        assert "the stand holds the torso so still that its gyro does not see the nudges" in builder.said
        assert ant.folder.config().motors["knee_rr"].zero_offset_rad == pytest.approx(math.pi + 0.03, abs=0.004)
        assert is_dated(ant, "motors.knee_rr.zero_offset_rad")
        assert not any(ant.torque())


class Slow(SimulatedBuilder):
    """Hands that leave every joint where they moved it."""

    def do(self, hands: Hands) -> None:
        if hands.path_rad != (0.0,):
            super().do(hands)


def test_zeros_ask_once_a_joint_and_what_was_not_put_back_is_not_what_moved_next(tmp_path):
    with robot(tmp_path / "ant") as ant:
        builder = ant.builder()
        builder.hands = Slow(ant.control)
        finding, _ = ant.do(zeros(replace(ant.bench, joints=FAST)), builder)
        asked = [event.words for event in builder.events if isinstance(event, Hands) and not event.while_watching]
        assert [words.split(" about")[0] for words in asked] == [
            "Put every leg straight out and hold still; torque is off.",
            "Move the rear right hip", "Move the rear right knee", "Move the front right hip",
        ]  # fmt: skip
        assert finding.data["swapped"] == {}
        assert set(finding.data["direction"].values()) == {1}


def test_a_wrong_spline_a_mirrored_leg_and_exchanged_ids_are_all_named(tmp_path):
    built = [
        {"joint": "knee_rr", "spline_offset": 1},
        {"joint": "hip_rr", "id": 20},
        {"joint": "hip_fr", "id": 10, "reversed": True},
    ]
    with robot(tmp_path / "ant", servo=built) as ant:
        finding, builder = ant.do(zeros(replace(ant.bench, joints=FAST)))
        problems = "\n".join(finding.problems)
        assert "hip_fr and hip_rr are swapped" in problems
        assert "knee_rr: its horn is on the wrong spline, 1 × 45° beyond" in problems
        assert "hip_fr: reversed" in problems
        motors = ant.folder.config().motors
        assert (motors["hip_rr"].id, motors["hip_fr"].id, motors["hip_fr"].direction) == (20, 10, -1)
        assert finding.ok, builder.said  # robot.toml follows how it is built, and every nudge went the right way


def test_a_leg_that_is_not_straight_is_named(tmp_path):
    crooked = [{"effect": "zero_offset", "joints": ["knee_rr"], "parameters": {"angle_rad": 0.3}}]
    with robot(tmp_path / "ant", effect=crooked) as ant:
        finding, _ = ant.do(zeros(replace(ant.bench, joints=("knee_rr",))))
        assert not finding.ok
        assert "knee_rr: +17.2° beside the grid" in finding.problems[0]


def test_ctrl_c_in_the_midst_of_nudges_leaves_torque_off(tmp_path):
    with robot(tmp_path / "ant") as ant:

        def interrupt(event: Event) -> None:
            if isinstance(event, Progress) and "nudging" in event.words:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            ant.do(zeros(replace(ant.bench, joints=HIP)), ant.builder(before=interrupt))
        assert not any(ant.torque())


@pytest.mark.parametrize(
    ("moved", "way", "verdict"),
    [
        ("hip_fl", 1, "confirmed"),
        ("knee_rr", 1, "confirmed"),
        ("hip_fl", -1, "contradicted"),
        ("knee_fr", 1, "another"),
    ],
)
def test_a_torso_that_answers_a_nudge_tells_which_leg_moved_and_which_way(moved, way, verdict):
    """On a soft stand the torso turns against the leg; `moved` really moved, and the joint named did as its encoder says."""
    named = "knee_rr" if moved == "knee_fr" else moved
    t = np.arange(0, 1.0, 0.01)
    rate = 0.4 * np.sin(2 * np.pi * 1.5 * t)
    axis = np.asarray(JOINTS[moved].axis, float) / np.linalg.norm(JOINTS[moved].axis)
    noise = np.random.default_rng(0).normal(0.0, 0.004, (len(t), 3))
    assert torso_answer(named, -0.05 * way * np.outer(rate, axis) + noise + 0.01, rate).verdict == verdict
    assert torso_answer(named, noise, rate).verdict == "unseen"


@given(eighths=st.integers(-3, 3), off=st.floats(-0.35, 0.35))
def test_the_grid_of_horns_finds_spline_and_residual(eighths, off):
    seen = straight(math.pi + eighths * math.pi / 4 + off)
    assert seen.eighths == eighths
    assert seen.residual_rad == pytest.approx(off, abs=1e-9)


@given(start=st.floats(-3, 3), turns=st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=20))
def test_an_encoder_is_followed_over_its_seam(start, turns):
    track, angle = Unwrapped(), start
    first = track.add(start % (2 * math.pi))
    for turn in turns:
        angle += turn
        last = track.add(angle % (2 * math.pi))
    assert last - first == pytest.approx(angle - start, abs=1e-6)


# ---- IMU --------------------------------------------------------------------------------------------------------------


def test_a_board_mounted_a_quarter_turn_round_is_found_and_taken_into_account(tmp_path):
    with robot(tmp_path / "ant", imu={"mount_rpy": [0.0, 0.0, math.pi / 2]}) as ant:
        finding, _ = ant.do(imu(ant.bench))
        assert finding.ok, finding
        assert any("mounted rotated by 90° about z (up)" in problem for problem in finding.problems)
        assert ant.folder.config().imu.mounting_rad == pytest.approx((0, 0, math.pi / 2), abs=0.02)


def test_a_wrong_scale_of_the_accelerometer_is_said(tmp_path):
    with robot(tmp_path / "ant", imu={"acc_scale": [1.15, 1.15, 1.15]}) as ant:
        finding, _ = ant.do(imu(ant.bench))
        assert not finding.ok
        assert "IMU scale: |acc| at rest is 11.28 m/s² instead of 9.81" in finding.problems[0]
        assert ant.folder.config().imu.acc_counts_per_g == 0.0


def test_a_scale_that_the_firmware_does_not_promise_is_named(tmp_path):
    with robot(tmp_path / "ant", imu={"api_minor": 46, "acc_scale": [0.25] * 3, "acc_noise": 0.005}) as ant:
        finding, _ = ant.do(imu(ant.bench))
        assert "Gravity says 512 LSB/g where API 1.46 promises" in "\n".join(finding.problems)


def test_poses_that_were_not_held_give_low_confidence_and_write_nothing(tmp_path):
    with robot(tmp_path / "ant") as ant:
        builder = ant.builder(answers={"low confidence": "no"})
        whole = builder.hands.do
        builder.hands.do = lambda hands: whole(replace(hands, path_rad=tuple(0.6 * x for x in hands.path_rad)))  # type: ignore
        finding, _ = ant.do(imu(ant.bench), builder)
        assert not finding.ok
        assert "low confidence in the mounting" in "\n".join(finding.problems)
        assert ant.folder.config().imu.acc_counts_per_g == 0.0


#: gyro of 70 mdps a step (ST's LSM6DSO) where most have 61.035: what its counts are the share of
ST_SENSOR = 32768 / 2000 * 0.07
ST = {"gyro_scale": [1 / ST_SENSOR] * 3}


def test_a_gyro_of_another_step_is_found_by_turns_kept_and_used(tmp_path):
    with robot(tmp_path / "ant", imu={**ST, "gyro_bias": [0.0, 0.0, 0.02]}) as ant:
        finding, builder = ant.do(imu(ant.bench))
        assert finding.ok, finding
        assert "the quarter turn reads 78°: a sensor of 70 mdps a step, or a turn that was not 90°?" in builder.said
        assert "14.29 counts for 1 °/s (a sensor of 70 mdps a step), not 16.38" in finding.problems[0]
        assert "recorded before stay as they are, 12.8 % low" in finding.problems[0]
        kept = ant.folder.config()
        assert kept.imu.gyro_counts_per_dps == pytest.approx(1000 / 70, abs=1e-4)
        told = kept.provenance_of("imu.gyro_counts_per_dps")
        assert told is not None
        assert (told.how, told.command) == ("measured", "openant calib imu")
        assert told.low < 1000 / 70 < told.high
        assert is_dated(ant, "imu.gyro_counts_per_dps")
        assert is_dated(ant, "imu.mounting_rad")
        # The bias is in the new scale, too.
        assert kept.imu.gyro_bias_rad_s[2] == pytest.approx(0.02 * ST_SENSOR, abs=0.003)


def rates_at_rest(ant) -> list[float]:
    """Mean of the gyro's columns, rad/s, of a recording that the engine makes while nothing moves."""
    path = ant.folder.recordings / "rest.mcap"
    with EngineProcess(engine_config(ant.bench)) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Record(str(path), Facts(joints=JOINT_NAMES, setup="stand", protocol="rest")))
        engine.ask(messages.Hold(0.5))
        engine.ask(messages.StopRecording())
    columns = read_recording(path).imu.columns
    return [float(np.mean(columns[f"gyro.{axis}"])) for axis in "xyz"]


def test_a_scale_by_hand_in_robot_toml_acts(tmp_path):
    with robot(tmp_path / "ant", imu={"gyro_bias": [0.0, 0.0, 0.4]}) as ant:
        ant.folder.update({"imu.gyro_counts_per_dps": 32.768})
        with opened_imu(ant.bench) as (driver, _):
            assert driver.info.gyro_lsb_per_dps == 32.768
        # In the engine, too, and with it in what is shown, recorded and given to agents: at rest it reads its bias.
        assert rates_at_rest(ant) == pytest.approx([0.0, 0.0, 0.2], abs=0.03)
        finding, _ = ant.do(imu(ant.bench))
        assert finding.ok
        assert "16.38 counts for 1 °/s (a sensor of 61.035 mdps a step), not 32.77" in finding.problems[0]


def test_a_hand_that_stops_early_is_no_other_sensor(tmp_path):
    with robot(tmp_path / "ant") as ant:
        builder = ant.builder()
        whole, turned = builder.hands.do, list[float]()

        def lazy(hands: Hands) -> None:
            turn = hands.path_rad[2] if hands.task == "tilt" else 0.0
            if turn:
                turned.append(turn)
                # 78° once, as a gyro of another step would read it, and as it should be from then on.
                hands = replace(hands, path_rad=(0.0, 0.0, turn - math.radians(12) * (len(turned) == 1)))
            whole(hands)

        builder.hands.do = lazy  # type: ignore[method-assign]
        finding, _ = ant.do(imu(ant.bench), builder)
        assert finding.ok, finding
        assert len(turned) == 3
        assert ant.folder.config().imu.gyro_counts_per_dps == pytest.approx(16.384)


def test_turns_that_fit_no_sensor_are_asked_for_again_and_not_judged(tmp_path, monkeypatch):
    monkeypatch.setattr("openant_tools.calib.imu.TRIES", 1)
    with robot(tmp_path / "ant", imu={"gyro_scale": [1.252] * 3}) as ant:
        finding, builder = ant.do(imu(ant.bench))
        assert finding.verdict == "cannot judge"
        assert "turns of 90° and 180° read 113°, 225°, which fits neither gyro type" in finding.unsure[0]
        assert "turn the robot half a turn" in builder.said
        kept = ant.folder.config()
        assert kept.provenance_of("imu.gyro_counts_per_dps") is None
        assert kept.imu.acc_counts_per_g == pytest.approx(512, rel=0.01), "what was measured is kept"
        assert finding.serves, "and the next step can use it"


@given(
    step=st.sampled_from(list(KNOWN)), now=st.sampled_from(list(KNOWN)), quarters=st.integers(1, 4),
    off=st.floats(-math.radians(5), math.radians(5)),
)  # fmt: skip
def test_no_hand_makes_one_sensor_of_another(step, now, quarters, off):
    read = (quarters * math.pi / 2 + off) * KNOWN[step] / KNOWN[now]
    found = by_hand([read], KNOWN[now])
    assert found is None or found.step == step
    assert found is not None or abs(off) > math.radians(3)


@pytest.mark.parametrize(
    ("scale", "step"), [(ST_SENSOR, "70 mdps"), (1.0, "61.035 mdps"), (1.012, "61.035 mdps"), (1.3, "")]
)
def test_the_camera_tells_a_sensors_step_and_measures_what_has_none(scale, step):
    found = by_camera(scale, 0.002, 16.384)
    assert found.step == step
    assert found.counts_per_dps == pytest.approx(16.384 / scale, rel=0.02)


def test_an_accelerometer_a_little_off_is_measured_and_used(tmp_path):
    with robot(tmp_path / "ant", imu={"acc_scale": [1.04] * 3}) as ant:
        finding, _ = ant.do(imu(ant.bench))
        assert finding.ok
        assert ant.folder.config().imu.acc_counts_per_g == pytest.approx(1.04 * 512, rel=0.003)
        with opened_imu(ant.bench) as (driver, _):
            assert driver.info.gravity == pytest.approx(9.807, abs=0.03)
        ant.folder.update({"imu.acc_counts_per_g": 2048.0})
        with opened_imu(ant.bench) as (driver, _):
            assert driver.info.acc_lsb_per_g == 512
            assert "2048 had been measured (other firmware, another board?); gravity decides" in driver.info.notes[0]


@given(vector=st.tuples(*[st.floats(-1.8, 1.8)] * 3))
def test_three_poses_give_back_any_mounting(vector):
    known = np.array([pose.up for pose in POSES])
    found = mounting(known @ rotation(vector), known)
    assert np.allclose(found.rotation, rotation(vector), atol=1e-6)
    assert np.allclose(rotation(found.vector_rad), found.rotation, atol=1e-6)
    assert found.confidence == "high"


# ---- arena ------------------------------------------------------------------------------------------------------------


def heights(body: float = 1.0, origin: float = 1.0) -> tuple[str, float | None]:
    """What is judged where the declared sizes are this many times the true ones."""
    setup, camera, tag = CameraSection(), 2.0, 0.085

    def seen(true_m: float) -> float:
        return origin * camera - body * (camera - true_m - tag) - tag

    found = judge_sizes(seen(LYING_M), seen(STANDING_M), origin * camera, tag, setup)
    return found.wrong, found.size_m


def test_sizes_that_agree_are_right():
    assert heights() == ("", None)


@given(factor=st.floats(1.3, 2.0) | st.floats(0.4, 0.75))
def test_the_tag_whose_size_is_wrong_is_told_from_the_other(factor):
    wrong, size = heights(body=factor)
    assert wrong == "body"
    assert size == pytest.approx(0.045 / factor, rel=0.01)
    wrong, size = heights(origin=factor)
    assert wrong == "origin"
    assert size == pytest.approx(0.10 / factor, rel=0.05)


def test_without_a_camera_the_arena_says_what_is_missing(tmp_path):
    with robot(tmp_path / "ant") as ant:
        finding, _ = ant.do(arena(replace(ant.bench, camera=None)))
        assert finding.ok
        assert "no camera → floor experiments on the robot need one" in finding.problems


class ShownBoard:
    """A camera before which somebody turns a printed board, each view for several pictures."""

    views: ClassVar[list[np.ndarray]] = []

    def __init__(self, settings: object, clock: object) -> None:
        self.shown = 0

    def open(self) -> CameraInfo:
        height, width = self.views[0].shape
        return SimpleNamespace(width=width, height=height, notes=())  # type: ignore[return-value]

    def wait(self, deadline: float) -> SimpleNamespace:
        self.shown += 1
        return SimpleNamespace(image=self.views[self.shown // 2 % len(self.views)])

    def close(self) -> None:
        pass


def test_a_board_before_the_camera_gives_the_lens_in_the_arena_step(tmp_path, monkeypatch):
    truth, ticks = Intrinsics(800, 600, 780, 776, 405, 296), itertools.count()
    monkeypatch.setattr(arena_step, "Camera", ShownBoard)
    monkeypatch.setattr(arena_step, "clock_of", lambda bench: SimpleNamespace(now=lambda: 0.1 * next(ticks)))
    bench = Bench(create_robot(tmp_path / "ant"), camera="0")

    class Shower:
        """Calibrates, and has printed the board."""

        def answer(self, event: Event):
            return "yes" if isinstance(event, Ask) else True if isinstance(event, Hands) else None

    ShownBoard.views = board_views(truth, CharucoBoard(), TILTS)
    parts = Parts(bench, "arena", (arena_step.LENS, arena_step.MOTION))
    _, lens, _, odd = drive(arena_step._look(bench, bench.folder.config(), "0", parts), Shower())
    assert odd == []
    again = Parts(bench, "arena", (arena_step.LENS, arena_step.MOTION))
    _, kept, _, _ = drive(arena_step._look(bench, bench.folder.config(), "0", again), Shower())
    assert kept == lens, "nobody shows the board a second time"
    assert (lens.source, lens.fx) == ("ChArUco board", pytest.approx(780, rel=0.01))
    assert (bench.folder.path / "charuco-board.png").is_file()
    monkeypatch.setattr(arena_step, "VIEW_S", 1.0)
    ShownBoard.views = board_views(truth, CharucoBoard(), [(0.0, 0.0)])
    _, lens, _, odd = drive(arena_step._look(bench, bench.folder.config(), "0", parts), Shower())
    assert "only 1 different views of the board were seen; the declared field of view is used" in odd[0]
    assert lens.source != "ChArUco board"


#: pictures that a test need not wait for
SMALL = {"width": 640, "height": 480, "fps": 15.0}


@pytest.mark.slow
def test_the_arena_is_measured_by_the_robot_itself_which_moves_once_however_often_it_was_left(tmp_path, brisk):
    with robot(tmp_path / "ant", sees=True, camera={**SMALL, "body": {"yaw": 0.3}}, imu=ST) as ant:
        for left_at in (leave_at(Intent, "stand up"), leave_at(Ask, "Radius"), leave_at(Hands, "Put it back")):
            with pytest.raises(KeyboardInterrupt):
                ant.do(arena(ant.bench), ant.builder(before=left_at, answers={"Radius": 0.6}))
        assert unfinished(ant.folder, "arena", virtual=True).words == "3 of 4"
        finding, builder = ant.do(arena(ant.bench))
        assert [event.words for event in builder.events if isinstance(event, Hands)] == ["Put it back on its stand."]
        assert not [event for event in builder.events if isinstance(event, Ask | Intent)]
        assert ant.folder.config().arena.radius_m == 0.6
        assert is_dated(ant, "arena.radius_m")
        assert finding.ok, finding
        assert finding.data["centre_m"] == pytest.approx([0.75, -0.30], abs=0.02)
        camera = ant.folder.config().camera
        assert camera.body_tag_id == 12
        assert camera.body_tag_yaw_rad == pytest.approx(0.3, abs=0.05)
        assert "glued" in finding.problems[0]
        # Hands have not told the gyro's scale yet: the tag does. What was recorded says which scale it has, so that nobody
        # applies the new one to it once more.
        assert (
            "14.29 counts for 1 °/s (a sensor of 70 mdps a step), not 16.38: the tag turned by +14"
            in finding.problems[1]
        )
        assert ant.folder.config().imu.gyro_counts_per_dps == pytest.approx(1000 / 70, abs=1e-4)
        recorded = read_recording(ant.folder.path / finding.data["recordings"])
        assert recorded.run.facts.extra["imu"]["gyro_counts_per_dps"] == pytest.approx(16.384)
        kept = ant.recorded()
        with pytest.raises(KeyboardInterrupt):
            ant.do(arena(ant.bench), ant.builder(before=leave_at(Progress, arena_step.MOTION)))
        assert ant.recorded().items() > kept.items(), "a repeat that was cut short takes the place of nothing"


# ---- bus health -------------------------------------------------------------------------------------------------------


def test_a_servo_that_loses_answers_is_named(tmp_path):
    with robot(tmp_path / "ant", fault=[{"cause": "bad_servo", "where": "hip_fl", "fraction": 0.05}]) as ant:
        finding, _ = ant.do(comms_health(ant.bench))
        assert not finding.ok
        assert finding.problems[0].startswith("hip_fl:")


def test_a_bus_that_loses_answers_of_all_servos_alike_blames_no_cable_of_one(tmp_path, brisk, sweeping):
    with robot(tmp_path / "ant", fault=[{"cause": "line_noise", "byte_error": 0.001}]) as ant:
        for step in (comms_health, bounds):
            finding, _ = ant.do(step(ant.bench))
            lost = [line for line in finding.problems if "answers" in line]
            assert len(lost) == 1, finding.problems
            assert "the power plug and the supply, the adapter and its first cable, or a busy computer" in lost[0]
