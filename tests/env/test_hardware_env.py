"""The robot itself as an environment, played by a virtual one behind its ports: in stepped time, as it stands on a floor."""

from __future__ import annotations

import contextlib
import json
import math
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from builder import COARSE
from gymnasium.utils.env_checker import check_env
from killing import FLOOR

import openant_env  # noqa: F401
from openant_env import hardware, link
from openant_env.link import engine_rate
from openant_tools.cli import main
from openant_tools.comms import messages
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.restart import MotionStopped, StopCause
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.gap.usable import Reason, usable
from openant_tools.model.plant import Setup, load_plant
from openant_tools.recording.reader import read_recording
from openant_tools.robot.config import Provenance
from openant_tools.robot.derating import derating_of
from openant_tools.robot.folder import RobotFolder, create_robot

#: fewer pictures and longer steps of its mechanics than it has by itself: it walks no better or worse
SCENARIO = FLOOR.replace("[robot]\n", COARSE).replace("fps = 12.0", "fps = 8.0") + '[clock]\nmode = "stepped"\n'
STILL = np.zeros(8, np.float32)
RULE = {"start_c": 62.0, "stop_c": 70.0, "least": 0.4}


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenario") / "floor.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> RobotFolder:
    """A robot whose zeros someone has measured, and whose tag is known."""
    return create_robot(
        tmp_path_factory.mktemp("robot") / "my-ant",
        values={"camera.body_tag_id": 12, "arena.centre_m": [0.1, -0.05], "arena.radius_m": 0.4},
        provenance={"motors": Provenance("measured", "openant calib zeros")},
    )


class Walker:
    """An environment on a running virtual robot, with all that was said, and a hand on the robot's faults."""

    def __init__(self, ready: Path, folder: RobotFolder, **options: object) -> None:
        self.said: list[str] = []
        self.env = gymnasium.make(
            "openant/AntHardware-v0", robot=folder.path, virtual=str(ready), notice=self.said.append, **options
        ).unwrapped
        self._control = VirtualControl(self.env.link.config.control)

    @contextlib.contextmanager
    def fault(self, cause: str, **more: object) -> Iterator[None]:
        self._control.ask("fault", cause=cause, on=True, **more)
        try:
            yield
        finally:
            self._control.ask("fault", cause=cause, on=False, **more)

    def torque(self) -> int:
        """How many servos have it on."""
        return sum(self._control.ask("state")["torque_enable"].values())

    def until_it_ends(self, steps: int = 20) -> dict[str, object]:
        for _ in range(steps):
            _, reward, _, truncated, info = self.env.step(STILL)
            assert math.isfinite(reward)
            if truncated:
                return info
        raise AssertionError("nothing ended it")

    def close(self) -> None:
        self.env.close()
        self._control.close()


@contextmanager
def started(scenario: Path, path: Path) -> Iterator[Path]:
    """The ready file of a virtual robot in stepped time."""
    with subprocess.Popen(
        [sys.executable, "-m", "openant_tools.cli", "virtual", "start", "--scenario", scenario, "--ready-file", path]
    ) as process:
        try:
            give_up = time.monotonic() + 100
            while not path.is_file():
                assert process.poll() is None
                assert time.monotonic() < give_up
                time.sleep(0.05)
            yield path
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def ready(scenario: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with started(scenario, tmp_path_factory.mktemp("ready") / "ready.json") as path:
        yield path


@pytest.fixture(scope="module")
def on_the_floor(ready: Path, folder: RobotFolder) -> Iterator[Walker]:
    with pytest.MonkeyPatch.context() as patch:  # a quarter of the packets; what is recorded below has them all
        patch.setattr(link, "ENGINE_HZ", 25.0)
        one = Walker(ready, folder, tag_patience_s=0.4)
    try:
        yield one
    finally:
        one.close()


@pytest.fixture
def walker(on_the_floor: Walker, monkeypatch: pytest.MonkeyPatch) -> Walker:
    """Standing; one for all tests, since getting up takes the robot its time. The virtual hands come soon.

    It stands where it began: from where some tests leave it, its legs hide the origin tag.
    """
    monkeypatch.setattr(hardware, "HELP_S", 1.0)
    on_the_floor.env._patience_s = 20.0
    on_the_floor.env.resume()
    if np.hypot(*on_the_floor._control.ask("state")["base"]["position"][:2]) > 0.1:
        on_the_floor.env.link.let_down()
        on_the_floor._control.ask("put")
    on_the_floor.env.reset(seed=0)
    on_the_floor.said.clear()
    return on_the_floor


# ------------------------------------------------------------------------------------------------- spaces and timing


def test_it_has_the_spaces_and_words_of_the_simulation(walker: Walker, folder: RobotFolder) -> None:
    simulated = gymnasium.make("openant/Ant-v0", robot=folder.path).unwrapped
    real = walker.env
    assert real.observation_space == simulated.observation_space
    assert real.action_space == simulated.action_space
    assert real.describe() == simulated.describe()
    assert (real.task.ox, real.task.oy, real.task.radius_m) == (*real.origin, 0.4) == (0.1, -0.05, 0.4)
    assert (simulated.task.ox, simulated.task.oy, simulated.task.radius_m) == (0.0, 0.0, 0.4)
    (first, before), (theirs, info) = real.reset(seed=3), simulated.reset(seed=3)
    assert before.keys() >= info.keys()
    seen = dict(zip(real.observation_names, zip(first, theirs, strict=True), strict=True))
    for name, (mine, other) in seen.items():
        if not name.startswith("direction"):  # its heading is another one
            assert mine == pytest.approx(other, abs=0.3 if name.startswith("acc") else 0.06), name
    for _ in range(4):
        observation, reward, _, _, info = real.step(STILL)
    assert observation.dtype == np.float32
    assert abs(reward) < 0.01
    assert info["period_s"] == pytest.approx(0.12, abs=1e-6)
    assert info["dt"] == pytest.approx(0.12, abs=1e-6)
    assert info["overruns"] == 0
    assert 0.0 <= info["observation_age_s"]["imu"] < 0.03
    assert 0.05 < info["observation_age_s"]["position"] < 0.25
    assert info["supply_v"] == pytest.approx(12.0, abs=0.3)
    assert (info["joint_temperatures"] > 15).all()
    simulated.close()


def test_its_picture_is_what_the_overhead_camera_sees(walker: Walker, monkeypatch: pytest.MonkeyPatch) -> None:
    assert walker.env.render() is None
    monkeypatch.setattr(walker.env, "render_mode", "rgb_array")
    picture = walker.env.render()
    assert picture.dtype == np.uint8
    assert picture.shape[1] <= 640
    assert picture.shape[2] == 3
    assert picture.std() > 10, "a floor with a robot on it is not one colour"


@pytest.mark.filterwarnings("ignore:.*Box observation space.*:UserWarning")
def test_gymnasium_finds_nothing_wrong(walker: Walker) -> None:
    check_env(walker.env, skip_render_check=True, skip_close_check=True)


def test_a_step_is_a_whole_number_of_cycles_of_the_engine() -> None:
    assert engine_rate(0.12) == pytest.approx(100.0)
    assert engine_rate(0.05) == pytest.approx(100.0)
    assert engine_rate(0.025) * 0.025 == pytest.approx(round(engine_rate(0.025) * 0.025))
    for dt in (0.0, 0.003, float("nan"), -1.0):
        with pytest.raises((BadInput, ValueError)):
            engine_rate(dt)


# ------------------------------------------------------------------------------------------ what befalls a real robot


def test_a_lost_tag_holds_the_position_and_then_truncates(walker: Walker) -> None:
    before = walker.env.step(STILL)[4]
    with walker.fault("camera_stalled"):
        info = walker.until_it_ends()
    assert str(info["reason"]).startswith("the camera has not seen the robot for 0.")
    assert "void" not in info
    assert info["position"] == pytest.approx(before["position"], abs=5e-3)


def test_a_silent_imu_truncates_and_no_number_is_made_up(walker: Walker) -> None:
    with walker.fault("imu_silent"):
        info = walker.until_it_ends()
    assert "the IMU has sent nothing for 0." in str(info["reason"])
    assert "void" not in info


def test_a_cable_that_comes_off_ends_the_step_and_walking_goes_on_once_it_is_back(walker: Walker) -> None:
    with walker.fault("broken_wire", where="knee_fl"):
        info = walker.until_it_ends()
        assert "knee_fl" in str(info["reason"])
        assert info["void"]
        with pytest.raises(BadInput, match="reset the environment first"):
            walker.env.step(STILL)
        walker.env._patience_s = 0.3
        with pytest.raises(HardwareFault, match="the robot cannot go on"):
            walker.env.reset()
    assert any(words.startswith("waiting: ") for words in walker.said)
    walker.env._patience_s = 20.0
    observation, _ = walker.env.reset()
    assert np.isfinite(observation).all()
    assert not walker.env.step(STILL)[3]


def test_pause_ends_the_step_and_reset_waits_for_resume(walker: Walker) -> None:
    walker.env.pause()
    info = walker.until_it_ends(1)
    assert info["reason"] == "paused by hand"
    walker.env._patience_s = 0.3
    with pytest.raises(HardwareFault, match="the robot cannot go on: paused by hand"):
        walker.env.reset()
    assert not walker.env.link.standing  # nobody wants knees to bear it for hours


def test_a_cable_wound_up_and_a_fall_need_someone(walker: Walker) -> None:
    walker.env._wound_rad = 2.1 * 2 * math.pi
    assert "the cable is wound up by 2.1 turns to the left" in str(walker.until_it_ends(1)["reason"])
    walker.env._patience_s = 0.3
    with pytest.raises(HardwareFault, match="turn the robot back by hand"):
        walker.env.reset()
    up, info = walker.env.layout.slices["acc"].start + 2, dict[str, object]()
    walker.env.resume()  # someone has looked
    walker.env._patience_s = 20.0
    walker.env.reset()
    walker.env._observation[up] = -9.8
    endings = [walker.env._judge(0.12, info) for _ in range(9)]
    assert endings[:8] == [(False, False)] * 8
    assert endings[8] == (False, True)
    assert info["reason"] == "the robot lies on its back"


def test_a_cable_that_winds_up_is_turned_back_before_it_is_too_late(
    walker: Walker, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, turn = walker.env, 2.0 * math.pi
    env.link.let_down()
    walker._control.ask("put", position_m=[-0.35, 0.2])  # amid the small picture
    env.link.look(0.5)
    env.reset()
    monkeypatch.setattr(hardware, "WINDING_TURNS", 0.4)
    env._wound_rad = -0.52 * turn
    info = walker.until_it_ends(1)
    assert info["reason"] == "the cable is wound up by 0.5 turns to the right, and is turned back"
    assert info["stop_cause"] == "winding"
    before = env._pose[2]
    env.reset()
    assert "the virtual robot is put back where it began" not in walker.said, "it fell over its lifted legs"
    assert abs(env._wound_rad) < 0.4 * turn
    assert math.remainder(env._pose[2] - before - 0.52 * turn, turn) == pytest.approx(env._wound_rad, abs=0.05)
    assert any(words.startswith("turned back in ") for words in walker.said)
    assert "motion begins again by itself after winding, 1 of 30" in walker.said
    assert env.step(STILL)[4].get("reason") is None

    # A robot that is held fast, or whose floor is too slippery, does not turn: that is for a person.
    monkeypatch.setattr(hardware, "TURN_BACK_S", 0.2)
    monkeypatch.setattr(env, "_unattended", True)
    env._wound_rad = 0.52 * turn
    walker.until_it_ends(1)
    with pytest.raises(MotionStopped, match=r"wound up by 0\.5 turns, and turning back left 0\.\d") as no:
        env.reset()
    assert no.value.cause is StopCause.CABLE
    assert walker.torque() == 0


def test_unattended_nobody_puts_a_robot_back_and_a_wait_has_an_end(
    walker: Walker, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = walker.env
    monkeypatch.setattr(env, "_unattended", True)
    with walker.fault("camera_stalled"):
        assert walker.until_it_ends()["stop_cause"] == "tag"
    env.reset()  # it is seen again: that was announced
    assert "motion begins again by itself after tag, 1 of 20" in walker.said
    with walker.fault("camera_stalled"), monkeypatch.context() as patch:
        patch.setattr(hardware, "longest_wait_s", {StopCause.TAG: 1.5}.__getitem__)
        walker.until_it_ends()
        with pytest.raises(MotionStopped, match=r"the camera does not see the robot: look at light.*nobody is there"):
            env.reset()
        assert walker.torque() == 0
    env.resume()
    env.reset()
    env.link.let_down()
    walker._control.ask("put", rotation_rad=[math.pi, 0.0, 0.0])
    env.link.look(1.0)
    with pytest.raises(MotionStopped, match="the robot lies on its back or side: put it on its feet"):
        env.reset()
    assert "the virtual robot is put back where it began" not in walker.said
    assert walker.torque() == 0
    with pytest.raises(BadInput, match="attended or unattended"):
        gymnasium.make("openant/AntHardware-v0", virtual="default", attended=True, unattended=True)
    walker._control.ask("put")


def test_a_robot_that_is_shaken_while_it_is_waited_for_does_not_lie(
    walker: Walker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Put back by hands it falls a little: that is no fall, after which a run that nobody attends would end."""
    env, look, looks = walker.env, walker.env.link.look, list[float]()

    def shaken(seconds: float) -> Any:
        rows = look(seconds)
        if rows is not None and len(looks) < 3:
            looks.append(seconds)
            rows = rows.copy()
            rows[-3:, env.link.columns["acc.z"]] = 0.0
        return rows

    monkeypatch.setattr(env, "_unattended", True)
    monkeypatch.setattr(env.link, "look", shaken)
    env.link.let_down()
    env.reset(seed=0)
    assert looks
    assert not any("lies on its back" in words for words in walker.said)


@pytest.mark.parametrize(
    ("where", "why"),
    [
        ({"position_m": [1.5, 0.0]}, "the camera does not see the robot"),
        ({"rotation_rad": [math.pi, 0.0, 0.0]}, "the robot lies on its back or side"),
    ],
)
def test_a_virtual_robot_that_needs_hands_is_put_back(walker: Walker, where: dict[str, object], why: str) -> None:
    """Nobody else could: a run on a virtual robot would wait for ever."""
    walker.env.link.let_down()
    walker._control.ask("put", **where)
    walker.env.link.look(1.0)
    walker.env.reset(seed=0)
    assert walker.said[0].startswith(f"waiting: {why}")
    assert "the virtual robot is put back where it began" in walker.said
    assert not walker.env.step(STILL)[3]
    assert np.hypot(*walker._control.ask("state")["base"]["position"][:2]) < 0.05


def test_a_warm_servo_goes_less_far_by_the_rule_of_robot_toml(walker: Walker, monkeypatch: pytest.MonkeyPatch) -> None:
    env, knee = walker.env, walker.env.robot.joints.index("knee_fl")
    monkeypatch.setattr(env, "_derating", derating_of({"derating": {"knee_fl": RULE}}))
    outwards = np.full(8, 0.2, np.float32)
    info = env.step(outwards)[4]
    assert info["derating"].tolist() == [1.0] * 8
    env._temps[knee] = 66.0
    info = env.step(outwards)[4]
    assert info["derating"][knee] == pytest.approx(0.7)
    assert (np.delete(info["derating"], knee) == 1.0).all()
    full = env.actions.centre + 0.2 * env.actions.half
    rest = env.actions.rest
    assert env._command == pytest.approx(rest + info["derating"] * (full - rest), abs=1e-6)
    assert any("knee_fl is at 66 °C: it goes 70 % of the way" in words for words in walker.said)


# ----------------------------------------------------------------------------- what begins again by the builder's word


@pytest.mark.skipif(not hasattr(resource, "prlimit"), reason="limits of another process are Linux'")
def test_a_full_disk_ends_walking_until_the_builder_says_otherwise(
    walker: Walker, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = walker.env
    # In these small pictures a bit of the tag is misread for seconds at times.
    monkeypatch.setattr(env, "_tag_patience_s", 20.0)
    limits = resource.prlimit(env.link._engine.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(env.link._engine.pid, resource.RLIMIT_FSIZE, (1, limits[1]))
    info = walker.until_it_ends(200)
    assert info["stop_cause"] == "storage"
    assert info["void"]
    for _ in range(2):
        with pytest.raises(
            MotionStopped, match=r"motion has ended for good: .*the recording stopped.* → .*resume"
        ) as no:
            env.reset()
        assert (no.value.cause, no.value.exit_code) == (StopCause.STORAGE, 1)
        assert walker.torque() == 0
    recorded = list(env.link.recorded)
    env.reset(options={"resume": True})
    assert walker.torque() == 8
    assert not env.step(STILL)[3]
    assert "motion begins again by the builder's word" in walker.said
    assert len(env.link.recorded) == len(recorded) + 1
    with pytest.raises(BadInput, match="the reset option resume is 1"):
        env.reset(options={"resume": 1})


def test_a_stop_while_it_lies_down_is_counted_as_one(walker: Walker, monkeypatch: pytest.MonkeyPatch) -> None:
    """It once ended motion for good, since torque was to come on again without a reason."""
    env, ask = walker.env, walker.env.link._engine.ask

    def stopped(command: object, *rest: object) -> object:
        if isinstance(command, messages.Ramp):
            ask(messages.Torque(False))
            raise MotionStopped("knee_fl is silent", cause=StopCause.SILENCE)
        return ask(command, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(env.link._engine, "ask", stopped)
        env._let_down()
    assert env._restart.cause is StopCause.SILENCE
    assert not env.link.standing
    env.reset()
    assert "motion begins again by itself after silence, 1 of 12" in walker.said


def test_hands_that_moved_the_robot_after_a_stop_keep_it_down(walker: Walker) -> None:
    with walker.fault("broken_wire", where="knee_fl"):
        info = walker.until_it_ends()
    assert info["stop_cause"] == "silence"
    sunk = walker.env.link._sunk
    assert {"hip_fl", "knee_rr"} < set(sunk)
    sunk["hip_fl"] += 0.6  # what it will find is not where it was
    with pytest.raises(MotionStopped, match=r"hip_fl was moved by \d+\.\d° since the stop"):
        walker.env.reset()
    assert walker.torque() == 0
    walker.env.resume()
    walker.env.reset()


def test_a_servo_that_shuts_down_again_after_its_reboot_ends_walking(
    walker: Walker, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, rebooted = walker.env.link, list[str]()
    walker.env.pause()
    walker.until_it_ends(1)
    walker.env._paused.clear()
    link.let_down()
    monkeypatch.setattr(link, "errors", lambda: {"knee_rl": 32})
    monkeypatch.setattr(link, "reboot", rebooted.extend)
    with pytest.raises(MotionStopped, match=r"knee_rl has shut itself down again .*the second time") as no:
        walker.env.reset()
    assert no.value.cause is StopCause.HARDWARE_ERROR
    assert rebooted == ["knee_rl"]
    monkeypatch.undo()
    with pytest.raises(MotionStopped):
        walker.env.reset()
    walker.env.reset(options={"resume": True})


def test_a_robot_that_fell_stands_up_only_once_somebody_has_looked(
    walker: Walker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A real one: nobody may have his hands in it when it stands up. Attended, reset waits for the word."""
    env = walker.env
    monkeypatch.setattr(env.link, "virtual", False)
    env.link.let_down()
    walker._control.ask("put", rotation_rad=[math.pi, 0.0, 0.0])
    env.link.look(1.0)
    with pytest.raises(MotionStopped, match="the robot lies on its back or side: put it on its feet"):
        env.reset()
    walker._control.ask("put")
    with pytest.raises(MotionStopped, match="the robot lies on its back or side"):
        env.reset()  # it is on its feet again, in somebody's hands
    assert walker.torque() == 0
    monkeypatch.setattr(env, "_attended", True)
    env._patience_s = 0.3
    with pytest.raises(HardwareFault, match=r"the robot cannot go on: motion has ended for good: .* then resume"):
        env.reset()
    env._patience_s = 20.0
    threading.Timer(0.3, env.resume).start()
    env.reset()
    assert walker.torque() == 8


# ---------------------------------------------------------------------------------------------------- what is refused


def test_what_cannot_walk_is_refused_in_one_line(scenario: Path, folder: RobotFolder, tmp_path: Path) -> None:
    uncalibrated = create_robot(tmp_path / "new", values={"camera.body_tag_id": 12})
    measured = {"motors": Provenance("measured", "openant calib zeros")}
    blind = create_robot(tmp_path / "blind", provenance=measured)
    cases: list[tuple[dict[str, object], str]] = [
        ({}, "no robot is named"),
        ({"robot": tmp_path / "nowhere", "virtual": str(scenario)}, "there is no robot.toml here"),
        ({"robot": uncalibrated.path, "bus": "/dev/null"}, "the zeros of hip_rr, knee_rr … were never measured"),
        ({"robot": blind.path, "bus": "/dev/null"}, "the robot has no flight controller yet"),
        ({"robot": folder.path, "bus": "/dev/null", "imu": "/dev/null"}, "the robot has no overhead camera yet"),
        ({"virtual": "default", "dt": 0.003}, "dt = 0.003 s is too short for the bus"),
        ({"virtual": "default", "task": "swim"}, "no such task"),
        ({"virtual": str(tmp_path / "no.toml")}, "there is no such scenario"),
    ]
    for options, words in cases:
        with pytest.raises((BadInput, HardwareFault), match=words.replace("(", r"\(")):
            gymnasium.make("openant/AntHardware-v0", **options)


def test_actions_that_are_none_are_refused(walker: Walker) -> None:
    up, down = np.zeros(8, np.float32), np.zeros(8)
    up[2], down[7] = np.inf, -np.inf
    cases = [
        (np.full(8, np.nan), "an action is not finite: nan for hip_rr"), (np.zeros(7), "an action has shape"),
        (up, "an action is not finite: inf for hip_fr"), (down, "an action is not finite: -inf for knee_rl"),
        (np.float32(0.0), "an action has shape"), (np.zeros((1, 8)), "an action has shape"),
        (np.array(["0"] * 8), "no numbers"), (np.array([None] * 8), "no numbers"),
    ]  # fmt: skip
    before = walker.env.command
    for action, words in cases:
        with pytest.raises(BadInput, match=words):
            walker.env.step(action)
    assert walker.torque() == 8
    assert (walker.env.command == before).all()
    assert not walker.env.step(np.full(8, 1e30))[3], "what is finite is clipped to -1…1"
    assert walker.env.command == pytest.approx(walker.env.actions.centre + walker.env.actions.half, abs=1e-5)
    with pytest.raises(BadInput, match="no such reset option on a robot: heading_rad"):
        walker.env.reset(options={"heading_rad": 1.0})


def test_sac_learns_on_the_robot_beside_acting_with_a_cable_that_comes_off_in_the_middle(
    walker: Walker, tmp_path: Path
) -> None:
    pytest.importorskip("torch")
    from openant_agents.async_training import train_async
    from openant_agents.interventions import read_interventions
    from openant_agents.sac import SacSettings

    class Tripping(gymnasium.Wrapper):
        """The cable is off from the tenth step until someone has looked."""

        taken = 0

        def step(self, action):
            self.taken += 1
            if self.taken == 10:
                walker._control.ask("fault", cause="broken_wire", on=True, where="hip_rl")
            return super().step(action)

        def reset(self, **options):
            walker._control.ask("fault", cause="broken_wire", on=False, where="hip_rl")
            return super().reset(**options)

    small = SacSettings(learning_start=5, batch=8, hidden=8)
    done = train_async(Tripping(walker.env), folder=tmp_path, steps=18, seed=0, settings=small)
    assert done.step == 18
    assert done.updates is not None
    # What it then learns in a dozen steps may well throw it on its back, where the camera loses it.
    tripped, *later = read_interventions(tmp_path)
    assert "hip_rl" in tripped.reason
    assert all("hip_rl" not in one.reason for one in later)
    assert 8 <= tripped.step <= 14
    rows = np.fromfile(tmp_path / "transitions.f32", np.float32).reshape(18, -1)
    assert np.isfinite(rows).all()
    assert rows[:, 33] == pytest.approx(np.full(18, 0.12), abs=0.03)


def test_what_walks_is_recorded_and_the_gap_reads_it(scenario: Path, folder: RobotFolder, tmp_path: Path) -> None:
    with started(scenario, tmp_path / "ready.json") as ready:
        one = Walker(ready, folder, recordings=tmp_path)
        one.env.reset(seed=0)
        commands = np.random.default_rng(0).uniform(-1, 1, (6, 8)).astype(np.float32)
        for action in commands:
            one.env.step(action)
        one.close()
    [path] = one.env.link.recorded
    run = read_recording(path).run
    assert run.facts.setup == "floor"
    assert run.facts.extra["dt_s"] == 0.12
    played = run.signal("cmd")[np.isfinite(run.signal("cmd")).all(axis=1)]
    wanted = one.env.actions.centre + one.env.actions.half * commands[4]
    assert np.abs(played - wanted).max(axis=1).min() < 2e-3
    able = usable(run, load_plant(one.env.robot.model_path, run.joints, Setup.FLOOR))
    [(start, stop)] = able.stretches
    assert 0.7 < stop - start < 0.72 + hardware.SETTLE_S + 0.3, (
        "what was walked and waited for; not how it stood up and lay down"
    )
    assert Reason.RAMP in {one.reason for one in able.excluded}
    out = tmp_path / "gap.json"
    with pytest.raises(SystemExit) as end:
        main(["gap", "measure", str(path), "--model", str(one.env.robot.model_path), "--json", str(out)])
    assert end.value.code == 0
    assert "pos" in json.dumps(json.loads(out.read_text()))
