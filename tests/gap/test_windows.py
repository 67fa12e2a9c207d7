"""What of a recording is used: a builder hands in what the robot recorded as it walked, was helped and swung."""

from __future__ import annotations

import itertools
from dataclasses import replace

import mujoco
import numpy as np
import plain
import plants
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.effects.robot import Robot
from openant_tools.errors import BadInput
from openant_tools.gap.folds import Part
from openant_tools.gap.simulation import simulate
from openant_tools.gap.usable import Reason, Usable, usable
from openant_tools.gap.windows import AT_MOST_S, cut, select
from openant_tools.model.body import lowest
from openant_tools.model.gap import gap
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.kit import home_angles
from openant_tools.robot.mjcf import nominal_model_path

Array = plants.Array
HOME = np.array(home_angles())
FOUND = np.zeros(8)  # as the robot lay before it stood up


@pytest.fixture(scope="module")
def floor() -> Plant:
    return load_plant(nominal_model_path("standard"), JOINT_NAMES, Setup.FLOOR)


@pytest.fixture(scope="module")
def stand() -> Plant:
    return load_plant(nominal_model_path("standard"), JOINT_NAMES)


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Plant:
    return load_plant(plants.write(tmp_path_factory.mktemp("model") / "pendulum.xml", plants.pendulum()))


def minimum_jerk(share: Array) -> Array:
    s = np.clip(share, 0, 1)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


class Log:
    """What an engine writes at 100 Hz, piece by piece; joints follow their commands with a lag."""

    def __init__(self, found: Array = FOUND) -> None:
        self.cmd: list[Array] = []
        self.on: list[bool] = []
        self.now = self.found = found
        self.marks: dict[str, float] = {}

    def _rows(self, commands: Array, on: bool = True) -> Log:
        self.cmd += list(commands)
        self.on += [on] * len(commands)
        if on:
            self.now = commands[-1]
        return self

    def mark(self, name: str) -> Log:
        self.marks[name] = len(self.cmd) / 100
        return self

    def limp(self, seconds: float) -> Log:
        return self._rows(np.full((round(100 * seconds), 8), np.nan), on=False)

    def ramp(self, pose: Array, seconds: float = 1.5) -> Log:
        share = minimum_jerk(np.arange(1, round(100 * seconds) + 1) / round(100 * seconds))
        return self._rows(np.round((self.now + share[:, None] * (pose - self.now)) / 0.00153) * 0.00153)

    def hold(self, seconds: float) -> Log:
        return self._rows(np.repeat(self.now[None], round(100 * seconds), axis=0))

    def policy(self, seconds: float, seed: int = 0) -> Log:
        """An action every 0.12 s."""
        actions = HOME + np.random.default_rng(seed).uniform(-0.5, 0.5, (round(seconds / 0.12), 8))
        return self._rows(actions.repeat(12, axis=0))

    def run(self, name: str = "walk", **more: Array) -> Run:
        cmd, on = np.array(self.cmd), np.array(self.on)
        t = np.arange(len(cmd)) / 100
        pos = np.empty_like(cmd)
        at = self.found.copy()
        for k, row in enumerate(cmd):
            at = at + 0.15 * (np.where(np.isfinite(row), row, self.found) - at)
            pos[k] = at
        columns: dict[str, Array] = {}
        for j, joint in enumerate(JOINT_NAMES):
            columns |= {f"cmd.{joint}": cmd[:, j], f"pos.{joint}": pos[:, j], f"torque.{joint}": on.astype(float)}
        return plants.run_of(columns | more, t, JOINT_NAMES, name, setup="floor")


def with_columns(run: Run, **columns: Array) -> Run:
    return replace(run, columns={**run.columns, **{name.replace("__", "."): c for name, c in columns.items()}})


def lost(found: Usable) -> dict[Reason, float]:
    out: dict[Reason, float] = {}
    for one in found.excluded:
        out[one.reason] = out.get(one.reason, 0.0) + one.seconds
    return out


# --- what is left out ----------------------------------------------------------------------------------------------------


def test_of_a_policys_run_stays_what_the_policy_did(floor: Plant) -> None:
    """It lies limp, stands up, walks, is reset, walks, loses its bus for a while, walks, lies down."""
    log = Log().limp(1).ramp(HOME).hold(0.3).mark("walks").policy(6, seed=1).mark("reset").ramp(HOME).hold(0.3)
    log.mark("again").policy(6, seed=2).mark("lies down").ramp(FOUND).limp(1)
    run = log.run()
    pause = (run.t < 13) | (run.t > 13.8)  # the cable came off: no rows
    run = replace(run, t=run.t[pause], columns={name: values[pause] for name, values in run.columns.items()})
    found = usable(run, floor)
    first, second, third = found.stretches
    assert first == pytest.approx((log.marks["walks"] - 0.3, log.marks["reset"]), abs=0.13)
    assert second == pytest.approx((log.marks["again"] - 0.3, 13.0), abs=0.13)
    assert third == pytest.approx((13.8, log.marks["lies down"]), abs=0.13)
    assert lost(found)[Reason.RAMP] == pytest.approx(4.5, abs=0.8)
    assert lost(found)[Reason.GAP] == pytest.approx(0.8, abs=0.05)
    assert lost(found)[Reason.LIMP] > 1.9
    assert found.usable_s + sum(lost(found).values()) == pytest.approx(run.duration_s)
    assert "a ramp to a pose" in str(found)
    assert f"({100 * found.share:.0f} %)" in str(found)


@pytest.mark.parametrize("where", [Setup.STAND, Setup.FLOOR])
def test_a_motion_for_its_own_sake_is_no_ramp(where: Setup, stand: Plant, floor: Plant) -> None:
    """Leaning over and back, all joints by one measure, as push-ups or a pose before a sweep do."""
    t = np.arange(800) / 100
    share = minimum_jerk((t - 2) / 0.8) - minimum_jerk((t - 4) / 0.8) + 0.2 * np.sin(7 * t) * (t > 5) * (t < 7)
    command = HOME + share[:, None] * np.linspace(0.2, 0.4, 8)
    columns = {f"{signal}.{joint}": command[:, j] for j, joint in enumerate(JOINT_NAMES) for signal in ("cmd", "pos")}
    assert usable(plants.run_of(columns, t, JOINT_NAMES), {Setup.STAND: stand, Setup.FLOOR: floor}[where]).share == 1.0


@pytest.fixture(scope="module")
def walked(floor: Plant) -> Run:
    """On its feet, its pose by a camera at 28 Hz that says how high its legs hold it."""
    run = Log(HOME).hold(0.5).policy(11).hold(1.0).run()
    base = {axis: np.full(len(run.t), np.nan) for axis in ("x", "y", "z", "qw", "qx", "qy", "qz", "yaw")}
    data = mujoco.MjData(floor.model)
    for row in np.unique(np.round(np.arange(0, run.t[-1], 1 / 28) * 100).astype(int)):
        data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
        data.qpos[floor.qpos] = run.signal("pos")[row]
        mujoco.mj_kinematics(floor.model, data)
        pose = (0.05 * run.t[row], 0, -lowest(floor, data), 1, 0, 0, 0, 0)
        for column, value in zip(base.values(), pose, strict=True):
            column[row] = value
    return with_columns(run, **{f"base__{axis}": values for axis, values in base.items()})


def test_a_carried_robot_is_left_out_until_it_stands_again(floor: Plant, walked: Run) -> None:
    run = walked
    assert usable(run, floor).share == 1.0
    up = np.interp(run.t, [3, 3.4, 5, 5.4], [0, 0.12, 0.12, 0])
    found = usable(with_columns(run, base__z=run.column("base.z") + up), floor)
    [carried] = found.excluded
    assert carried.reason is Reason.LIFTED
    assert 2.7 < carried.start < 3.4
    assert 5.2 < carried.stop < 6.2


def test_hands_that_turn_or_move_a_robot_that_stands_still_are_seen(floor: Plant) -> None:
    run = Log(HOME).hold(0.5).policy(3).hold(4).policy(3).run()
    turned = np.where((run.t > 4.5) & (run.t < 5.5), 1.6, 0.0)
    still = 0 * run.t
    gyro = {"gyro__x": still, "gyro__y": still, "gyro__z": turned}
    assert set(lost(usable(with_columns(run, **gyro), floor))) == {Reason.LIFTED}
    slid = {"base__x": np.interp(run.t, [4.5, 5.5], [0, 0.5]), "base__y": still}
    [moved] = usable(with_columns(run, **slid), floor).excluded
    assert moved.reason is Reason.LIFTED
    assert 4.0 < moved.start < 5 < moved.stop < 6.5


@pytest.mark.parametrize("by", ["the tracker", "the accelerometer"])
def test_a_robot_on_its_back_is_left_out(by: str, floor: Plant) -> None:
    run = Log(HOME).hold(0.5).policy(9).run()
    angle = np.interp(run.t, [3, 3.5, 6, 6.5], [0, np.pi, np.pi, 0])
    still = 0 * run.t
    if by == "the tracker":
        log = {"base__qw": np.cos(angle / 2), "base__qx": np.sin(angle / 2), "base__qy": still, "base__qz": still}
    else:
        log = {"acc__x": still, "acc__y": 9.81 * np.sin(angle), "acc__z": 9.81 * np.cos(angle)}
    [back] = usable(with_columns(run, **log), floor).excluded
    assert back.reason is Reason.LYING
    assert 2.9 < back.start < 3.4
    assert 6 < back.stop < 7.2


def test_a_tenth_of_late_answers_costs_nothing_and_a_silent_servo_its_silence(floor: Plant, walked: Run) -> None:
    run = walked
    chance = np.random.default_rng(4)
    late = {
        f"pos__{joint}": np.where(chance.random(len(run.t)) < 0.1, np.nan, run.column(f"pos.{joint}"))
        for joint in JOINT_NAMES
    }
    found = usable(with_columns(run, **late), floor)
    assert found.share > 0.99
    late["pos__knee_fl"] = np.where((run.t > 4) & (run.t < 6), np.nan, late["pos__knee_fl"])
    found = usable(with_columns(run, **late), floor)
    [silent] = [one for one in found.excluded if one.reason is Reason.UNHEARD]
    assert (silent.start, silent.stop) == pytest.approx((4, 6), abs=0.6)
    assert {Reason.UNHEARD, Reason.UNMEASURED} >= set(lost(found))


def test_nothing_counts_before_every_joint_was_measured_and_commanded(floor: Plant, walked: Run) -> None:
    run = walked
    late = with_columns(
        run, pos__hip_rl=np.where(run.t < 1, np.nan, run.column("pos.hip_rl")),
        cmd__knee_rl=np.where(run.t < 2, np.nan, run.column("cmd.knee_rl")),
    )  # fmt: skip
    before, told = usable(late, floor).excluded
    assert (before.reason, told.reason) == (Reason.UNMEASURED, Reason.UNCOMMANDED)
    assert (before.stop, told.stop) == pytest.approx((1, 2), abs=0.02)


def test_what_a_servo_was_told_before_a_run_began_is_still_carried_out(pendulum: Plant) -> None:
    """A run that begins with a step: nobody knows what a servo that acts late does first."""
    t = np.arange(300) / 100
    columns = {"cmd.joint": 0.6 + 0 * t, "pos.joint": 0.6 * minimum_jerk(t / 0.3)}
    [begun] = usable(plants.run_of(columns, t, ["joint"]), pendulum).excluded
    assert begun.reason is Reason.BEGUN
    assert (begun.start, begun.stop) == pytest.approx((0, 0.15), abs=0.02)
    assert usable(plants.run_of({**columns, "pos.joint": 0.58 + 0 * t}, t, ["joint"]), pendulum).share == 1.0


def test_a_hand_on_a_leg_that_holds_still_is_no_motion_of_the_robot(stand: Plant) -> None:
    """Pushed away and let go; what sinks with its own weight and stays down is the servo's own doing."""
    t = np.arange(1000) / 100
    pushed, sunk = np.interp(t, [4, 4.5, 5, 5.2], [0, 0.3, 0.3, 0]), np.interp(t, [4, 8], [0, 0.3])
    columns = {f"{signal}.{joint}": HOME[j] + 0 * t for j, joint in enumerate(JOINT_NAMES) for signal in ("cmd", "pos")}
    run = plants.run_of(columns, t, JOINT_NAMES)
    [hand] = usable(with_columns(run, pos__knee_fl=run.column("pos.knee_fl") + pushed), stand).excluded
    assert hand.reason is Reason.PUSHED
    assert (hand.start, hand.stop) == pytest.approx((4.05, 5.2), abs=0.1)
    data = mujoco.MjData(stand.model)
    data.qpos[stand.qpos] = HOME
    mujoco.mj_forward(stand.model, data)
    down = -np.sign(data.qfrc_bias[stand.dof[JOINT_NAMES.index("knee_fl")]])
    sinks, rises = (
        usable(with_columns(run, pos__knee_fl=run.column("pos.knee_fl") + way * sunk), stand) for way in (down, -down)
    )
    assert sinks.share == 1.0
    assert set(lost(rises)) == {Reason.PUSHED}


def test_a_pendulum_that_is_let_go_falls_and_one_that_hangs_on_tells_no_more(pendulum: Plant) -> None:
    t = np.arange(1500) / 100
    lift = 1.2 * minimum_jerk(t / 2)
    columns = {
        "cmd.joint": lift,
        "pos.joint": np.where(t < 3, lift, 1.2 * np.exp(-3 * (t - 3))),
        "torque.joint": (t < 3) * 1.0,
    }
    found = usable(plants.run_of(columns, t, ["joint"]), pendulum)
    [falls] = found.stretches
    assert falls == pytest.approx((0, 7), abs=0.02)
    assert set(lost(found)) == {Reason.LIMP}


# --- folds ---------------------------------------------------------------------------------------------------------------


def test_a_single_run_is_cut_into_folds_a_second_apart(pendulum: Plant) -> None:
    t = 7e4 + np.arange(3000) / 100
    command = plants.sweep(t, 1)[:, 0]
    run = plants.run_of({"cmd.joint": command, "pos.joint": command}, t, ["joint"], "swing")
    chosen = select([run], [pendulum])
    assert len(chosen.folds) == 4
    assert all(b.start - a.stop >= 1.0 - 1e-9 for a, b in zip(chosen.folds[:-1], chosen.folds[1:], strict=True))
    assert [Part.parse(str(part)) for part in chosen.folds] == list(chosen.folds)
    for (start, stop), fold in zip(chosen.windows[0], chosen.fold[0], strict=True):
        assert chosen.folds[fold].start <= start < stop <= chosen.folds[fold].stop
    assert set(chosen.fold[0]) == {0, 1, 2, 3}
    with pytest.raises(BadInput, match=r"swing: 2\.99 s of the one run.*or a second run"):
        select([run.between(7e4, 7e4 + 3)], [pendulum])


def test_a_pause_between_two_folds_costs_nothing(floor: Plant) -> None:
    log = Log(HOME).hold(0.5)
    for seed in range(4):
        log.policy(6, seed=seed).ramp(HOME, 2.5).hold(0.3)
    log.policy(0.6).ramp(FOUND).limp(1)
    run = log.run()
    folds = select([run], [floor]).folds
    able = usable(run, floor)
    within = sum(max(0, min(b, part.stop) - max(a, part.start)) for part in folds for a, b in able.stretches)
    assert within > able.usable_s - 1.5


def test_two_long_runs_are_cut_into_folds_and_one_of_which_nothing_is_left_has_none(floor: Plant, walked: Run) -> None:
    limp, short = Log().limp(5).run("limp"), replace(walked.between(2, 9), name="walk-2")
    long = [walked, replace(walked, name="walk-3")]
    chosen = select([long[0], limp, long[1]], [floor] * 3)
    assert [part.run for part in chosen.folds] == ["walk", "walk", "walk-3", "walk-3"]
    assert chosen.windows[1] == ()
    whole = select([long[0], short], [floor] * 2, at_most_s=1e3)
    assert [str(part) for part in whole.folds] == ["walk", "walk-2"]
    assert whole.seconds == pytest.approx(sum(one.usable_s for one in whole.usable)), "short runs are taken whole"
    with pytest.raises(BadInput, match=r"nothing of these recordings can be simulated: limp: 0 s of 4\.99 s"):
        select([limp], [floor])


@given(
    st.text(st.characters(blacklist_categories=["Cs", "Cc"]), min_size=1),
    st.tuples(st.integers(0, 10**9), st.integers(1, 10**6)),
)
def test_a_part_is_read_as_it_is_printed(run: str, at: tuple[int, int]) -> None:
    part = Part(run, at[0] / 1e3, (at[0] + at[1]) / 1e3)
    assert Part.parse(str(part)) == part
    assert Part.parse(run, [run]) == Part(run)


def test_a_part_in_the_words_of_the_format() -> None:
    assert str(Part("RUN", 12.0, 31.5)) == "RUN[12.0,31.5]"
    assert Part.parse("RUN") == Part("RUN")
    with pytest.raises(BadInput, match="ends before it starts"):
        Part.parse("RUN[3,2]")


# --- windows -------------------------------------------------------------------------------------------------------------


def swung(seconds: float, seed: int = 0, jitter_s: float = 0.0, quiet: tuple[float, float] = (0, 0)) -> Run:
    """A pendulum on a bench, at rest for a while."""
    t = np.arange(0, seconds, 0.01)
    chance = np.random.default_rng(seed)
    at = np.interp(t, np.arange(0, seconds + 2, 0.5), chance.uniform(-1, 1, len(np.arange(0, seconds + 2, 0.5))))
    command = np.where((t >= quiet[0]) & (t < quiet[1]), 0.0, at)
    stamps = t + np.random.default_rng(seed + 1).uniform(-jitter_s, jitter_s, len(t)) if jitter_s else t
    return plants.run_of({"cmd.joint": command, "pos.joint": 0.9 * command}, stamps, ["joint"])


@given(st.floats(6, 90), st.floats(0.3, 4), st.floats(4, 30), st.integers(0, 5))
@settings(max_examples=12)
def test_windows_lie_in_what_can_be_simulated_and_take_no_more_time_than_they_may(
    pendulum: Plant, seconds: float, length_s: float, at_most_s: float, seed: int
) -> None:
    run = swung(seconds, seed)
    chosen = select([run], [pendulum], length_s, at_most_s)
    assert chosen == select([run], [pendulum], length_s, at_most_s)
    windows = chosen.windows[0]
    assert list(windows) == sorted(windows)
    assert chosen.seconds <= at_most_s + 1e-6
    assert all(a[1] <= b[0] for a, b in itertools.pairwise(windows))
    for start, stop in windows:
        assert any(a <= start and stop <= b for a, b in chosen.usable[0].stretches)
        assert stop - start <= max(1.3 * length_s, 0.5)


def test_a_few_runs_on_the_floor_beside_many_on_a_stand_are_looked_at(floor: Plant, stand: Plant, walked: Run) -> None:
    """Windows of a floor are longer than what each of so many runs may use; what pulls at the body shows there alone."""
    on_stand = replace(walked, facts=replace(walked.facts, setup="stand"))
    runs = [replace(on_stand if k % 2 else walked, name=f"run-{k}") for k in range(8)]
    found = select(runs, [stand if k % 2 else floor for k in range(8)])
    assert all(found.windows)
    seconds = [sum(stop - start for start, stop in own) for own in found.windows]
    assert sum(seconds[::2]) > sum(seconds[1::2])
    assert sum(seconds) <= AT_MOST_S + 1e-6


def test_the_windows_of_a_long_run_are_those_in_which_something_happens(pendulum: Plant) -> None:
    run = swung(120, quiet=(20, 45))
    chosen = select([run], [pendulum])
    assert 0.9 * AT_MOST_S <= chosen.seconds <= AT_MOST_S
    assert sum(start > 20 and stop < 45 for start, stop in chosen.windows[0]) <= 2
    assert {int(start // 30) for start, _ in chosen.windows[0]} == {0, 1, 2, 3}, "spread over the recording"


def test_jittering_stamps_choose_the_same_windows(pendulum: Plant) -> None:
    even, off = (select([swung(100, jitter_s=jitter)], [pendulum]).windows[0] for jitter in (0.0, 0.002))
    alike = sum(any(abs(a[0] - b[0]) < 0.02 for b in off) for a in even)
    assert alike >= 0.8 * len(even)


def test_windows_are_about_as_long_as_asked_and_one_after_another() -> None:
    windows = cut([(0.0, 3.4), (5.0, 5.3), (6.0, 6.7)], Part("run"), 1.0)
    assert [round(stop - start, 3) for start, stop in windows] == [0.85, 0.85, 0.85, 0.85, 0.7]
    assert windows[0][1] == windows[1][0]
    assert cut([(0.0, 3.4)], Part("run", 1.0, 2.0), 1.0) == [(1.0, 2.0)]


# --- and simulated -------------------------------------------------------------------------------------------------------


def test_rollouts_of_windows_begin_at_their_first_complete_rows_and_leave_out_the_rest(pendulum: Plant) -> None:
    """A servo whose commands hold for 0.12 s, one answer in ten late."""
    t = 4.0 + np.arange(600) / 100
    command = plants.sweep(t, 1)[np.arange(600) // 12 * 12, 0]
    made = plants.drive(plain.on_stand(pendulum.path), ["joint"], t, command[:, None])
    made["pos.joint"][np.random.default_rng(0).random(600) < 0.1] = np.nan
    made["pos.joint"][100] = np.nan
    run = plants.run_of(made, t, ["joint"])
    windows = [(5.0, 6.0), (6.0, 7.0), (8.5, 9.5)]
    rollouts = Rollouts(pendulum, [run], windows=[windows])
    simulated = rollouts().pos[0, :, 0]
    assert rollouts.horizon == 1.0, "restarts amid a run"
    assert sorted(segment.first for segment in rollouts.segments)[0] == 101
    inside = np.zeros(600, bool)
    for segment in rollouts.segments:
        inside[segment.row] = True
    assert np.isfinite(simulated[inside]).all()
    assert np.isnan(simulated[~inside]).all()
    assert not inside[(t < 5) | ((t > 7) & (t < 8.5)) | (t > 9.5)].any()
    assert gap(run.signal("pos"), simulated[:, None]) < 2e-3
    assert np.abs(rollouts.finer(2)().pos[0, :, 0] - simulated)[inside].max() < 4e-3
    robot = Robot(1, creeps=True)
    robot.play[:] = 0.02
    log = simulate(rollouts, [Robot(1, creeps=True), robot], signals=["pos"]).signals["pos"]
    assert np.abs(log[0, inside, 0] - simulated[inside]).max() < 1e-4
    assert np.isfinite(log[1, inside]).all()
    with pytest.raises(ValueError, match="overlaps"):
        Rollouts(pendulum, [run], windows=[[(5.0, 6.0), (5.5, 6.5)]])


def test_a_run_without_windows_is_not_simulated(pendulum: Plant) -> None:
    runs = [swung(8), swung(8, seed=1)]
    rollouts = Rollouts(pendulum, runs, windows=[[], [(2.0, 3.0)]])
    log = simulate(rollouts, [Robot(1)], signals=["pos"]).signals["pos"][0, :, 0]
    assert np.isnan(log[rollouts.rows[0]]).all()
    assert np.isfinite(log[rollouts.rows[1]]).sum() == 100
    with pytest.raises(ValueError, match="no window"):
        Rollouts(pendulum, runs, windows=[[], []])


@pytest.fixture(scope="module")
def swaying(floor: Plant) -> Run:
    """An Ant that sways on its feet, as the model does it, seen by a perfect tracker."""
    model = plain.on_floor(floor.path)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_step(model, data, 1500)
    t = 3.0 + np.arange(400) / 100
    command = HOME + np.sin(8 * (t - 3.0))[:, None] * np.array([0.15, 0.1, -0.15, 0.1, 0.15, -0.1, -0.15, -0.1])
    place = np.empty((len(t), 7))
    columns = {f"cmd.{joint}": command[:, j] for j, joint in enumerate(JOINT_NAMES)}
    columns |= {f"pos.{joint}": np.empty(len(t)) for joint in JOINT_NAMES}
    for k in range(len(t)):
        place[k] = data.qpos[:7]
        for joint in JOINT_NAMES:
            columns[f"pos.{joint}"][k] = data.joint(joint).qpos[0]
        data.ctrl[:] = command[k]
        mujoco.mj_step(model, data, 10)
    columns |= {f"base.{name}": place[:, k] for k, name in enumerate(("x", "y", "z", "qw", "qx", "qy", "qz"))}
    return plants.run_of(columns, t, JOINT_NAMES, "sway", setup="floor")


def test_a_window_amid_a_gait_begins_with_the_base_in_motion_whoever_measured_it(floor: Plant, swaying: Run) -> None:
    windows = [[(4.0, 5.0), (6.0, 7.0)]]
    bare = replace(swaying, columns={name: c for name, c in swaying.columns.items() if not name.startswith("base.")})
    seldom = {}  # a camera at 28 Hz that is a degree and a few millimetres off
    seen = np.isin(np.arange(400), np.round(np.arange(0, 400, 100 / 28)))
    for name in ("x", "y", "z", "qw", "qx", "qy", "qz"):
        value = swaying.column(f"base.{name}") + {"z": 0.005, "qx": 0.01}.get(name, 0.0) + 0.3 * (name == "x")
        seldom[f"base__{name}"] = np.where(seen, value, np.nan)
    measured = swaying.signal("pos")
    settled = Rollouts(floor, [bare], windows=[[(4.0, 5.0)]])
    for run in (bare, with_columns(bare, **seldom)):
        rollouts = Rollouts(floor, [run], windows=windows)
        assert gap(measured, rollouts().pos[0]) < 2e-3
    place = simulate(rollouts, [Robot(8)], signals=["base"]).signals["base"][0]
    inside = np.isfinite(place[:, 0])
    assert np.abs(place[inside, 0] - 0.3 - swaying.column("base.x")[inside]).max() < 5e-3, "where the camera says"
    assert settled.horizon == 1.0


def test_a_window_heads_as_tracked_where_it_begins_however_feet_slipped_on_the_way(floor: Plant, swaying: Run) -> None:
    turned = np.linspace(0.0, 3.0, 400)  # which nothing but another floor explains
    yaw = {f"base.{axis}": c for axis, c in (("x", np.zeros(400)), ("y", np.zeros(400)), ("yaw", turned))}
    bare = {name: c for name, c in swaying.columns.items() if not name.startswith("base.")}
    run = replace(swaying, columns=bare | yaw)
    rollouts = Rollouts(floor, [run], windows=[[(4.0, 5.0), (6.0, 7.0)]])
    heads = simulate(rollouts, [Robot(8)], signals=["yaw"]).signals["yaw"][0, :, 0]
    for row in (100, 300):
        assert heads[row] == pytest.approx(turned[row], abs=0.02)
