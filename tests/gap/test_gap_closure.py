"""What is left of the gap once the model is re-fitted: within tolerance, within bounds, and honest where a simulation falls apart."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import joblib
import mujoco
import numpy as np
import pytest
from plants import BENCH, ENCODER_RAD, SERVO, drive, pendulum, run_of, sweep, write

import openant_tools.gap.descent as descent
import openant_tools.gap.fitting as fitting
import openant_tools.gap.prediction as prediction
from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Robot
from openant_tools.gap.closure import Closure, calibration_of, closures, heat_loss_of
from openant_tools.gap.decide import Anomaly
from openant_tools.gap.fitting import Fits
from openant_tools.gap.hypothesis import Part, Refit
from openant_tools.gap.innovations import RATIOS, Irregular
from openant_tools.gap.prediction import Predictions
from openant_tools.gap.protocol import Played, RunSet, rollouts_of
from openant_tools.gap.simulation import Log, simulate
from openant_tools.gap.trials import Trials
from openant_tools.model.plant import load_plant
from openant_tools.model.rollout import Rollouts

T = 2.0 + np.arange(100) / 50


def beyond_one_build(one: Closure, plain: Closure) -> float:
    """nats by which a cause is likelier than a little of it, and than none."""
    return one.likelihood - max(plain.likelihood, one.within)


def protocol(folder: Path, *, kp: float, dry: float) -> RunSet:
    """Two sweeps of a robot with another stiffness and friction than its model's 8 N·m/rad and 0.03 N·m."""
    robot = mujoco.MjModel.from_xml_string(
        pendulum(
            f'<position {SERVO} kp="{kp}" forcerange="-4 4"/>',
            joint=f'damping="0.12" armature="0.006" frictionloss="{dry}"',
        ).replace(BENCH, "")
    )
    robot.opt.timestep = 0.0005
    runs = []
    for seed in (1, 2):
        columns = drive(robot, ["joint"], T, seed * 0.4 * sweep(T, 1), noise=3e-4, quantum=ENCODER_RAD)
        runs.append(run_of(columns, T, ["joint"], f"sweep-{seed}"))
    model = pendulum(
        f'<position {SERVO} kp="8" forcerange="-4 4"/>', joint='damping="0.12" armature="0.006" frictionloss="0.03"'
    )
    return RunSet.of(runs, write(folder / "given.xml", model), ["joint"], [None, None])


def test_a_refit_stays_within_tolerance_and_is_the_best_there(tmp_path: Path) -> None:
    """Stiffness is half as large again, far beyond its 15 %: some end at their bounds, the others where they then serve best."""
    fits = Fits(predictions := Predictions(protocol(tmp_path, kp=12.0, dry=0.05)))
    found = fits.refit([fits.nothing()], [0, 1], ())[0].whole
    assert np.abs(found.nuisance).max() == pytest.approx(1.0)

    def cost(u: np.ndarray[Any, np.dtype[np.float64]]) -> float:
        """Minus twice the logarithm of how likely it is, of 2 · 30 independent errors as large as it leaves them."""
        refits = [dataclasses.replace(found, nuisance=u)]
        left = sum(float(np.nansum(predictions.errors(k, refits) ** 2)) for k in (0, 1))
        return 60 * math.log(left) + float(np.sum((u / descent.SPREAD) ** 2))

    least = cost(found.nuisance)
    assert least < cost(np.zeros(len(predictions.names))) - 60
    for k in range(len(predictions.names)):
        for step in (-0.3, 0.3):
            moved = found.nuisance.copy()
            moved[k] = np.clip(moved[k] + step, -1.0, 1.0)
            assert least < cost(moved) + 12


def test_a_warm_motor_is_weaker_and_the_refit_says_by_how_much(tmp_path: Path) -> None:
    """Three runs, each 25 °C warmer than the one before, of a servo that loses 0.6 % a degree: more than copper alone."""
    loss, warmth = 0.006, (0.0, 25.0, 50.0)
    runs = []
    for n, warm in enumerate(warmth):
        kp = 8 / (1 + loss * warm)
        robot = load_plant(write(tmp_path / f"{n}.xml", pendulum(f'<position {SERVO} kp="{kp}" forcerange="-4 4"/>')))
        columns = drive(robot.model, ["joint"], T, (0.5 + 0.1 * n) * sweep(T, 1), noise=3e-4)
        columns["temp.joint"] = np.full(len(T), 30.0 + warm)
        runs.append(run_of(columns, T, ["joint"], f"sweep-{n}"))
    model = write(tmp_path / "given.xml", pendulum(f'<position {SERVO} kp="8" forcerange="-4 4"/>'))
    fits = Fits(predictions := Predictions(RunSet.of(runs, model, ["joint"], [None] * 3)))
    (left,) = closures(fits, [fits.nothing()], [(2,)], [0, 1])
    assert left.closed > 0.8
    warmest = calibration_of(predictions, left.refit, [2])["stiffness"]["joint"]
    assert warmest == pytest.approx(1 / (1 + loss * 50), rel=0.03)
    assert calibration_of(predictions, left.refit, [0])["stiffness"]["joint"] == pytest.approx(1.0, rel=0.03)
    assert heat_loss_of(predictions, left.refit) == pytest.approx(loss, rel=0.15)
    # One model for the warmest run alone is as good as knowing how warm it was; one for all three is not.
    assert predictions.written(left.refit, [2]) == pytest.approx(left.after, rel=0.01)
    assert predictions.written(left.refit, [0, 1, 2]) > 2 * left.after
    unmeasured = [
        dataclasses.replace(run, columns={k: v for k, v in run.columns.items() if k != "temp.joint"}) for run in runs
    ]
    assert "heat_loss" not in [
        one.name for one in Predictions(RunSet.of(unmeasured, model, ["joint"], [None] * 3)).names
    ]


def test_torque_that_goes_a_little_later_than_its_row_is_no_late_sensor(tmp_path: Path) -> None:
    """A host reads, then tells the servo to let go: the row says so, and the pendulum begins to fall half a row later."""
    later, text = 0.6, pendulum(joint='damping="0.02" armature="0.004" frictionloss="0.004"')
    robot = mujoco.MjModel.from_xml_string(text.replace(BENCH, ""))
    robot.opt.timestep = 0.0002
    data, runs = mujoco.MjData(robot), []
    for seed, held in ((1, 0.9), (2, -0.7)):
        mujoco.mj_resetData(robot, data)
        row, let_go, pos = 0, 1.1, np.empty(len(T))
        cmd = held * np.minimum(1.0, (T - T[0]) / 0.6)
        while row < len(T):
            if data.time >= T[row] - T[0] - 1e-9:
                pos[row] = data.qpos[0]
                row += 1
            data.ctrl[0] = cmd[row - 1]
            robot.opt.disableactuator = int(data.time >= let_go + later * 0.02)
            mujoco.mj_step(robot, data)
        noise = 3e-4 * np.random.default_rng(seed).standard_normal(len(T))
        columns = {"pos.joint": pos + noise, "cmd.joint": cmd, "torque.joint": 1.0 - (T - T[0] > let_go - 1e-6)}
        runs.append(run_of(columns, T, ["joint"], f"let-go-{seed}"))
    fits = Fits(predictions := Predictions(RunSet.of(runs, write(tmp_path / "given.xml", text), ["joint"], [None] * 2)))
    start = catalogue()["sensor_delay"].starts(0.2)[0]
    plain, late = closures(fits, [fits.nothing(), fits.of([Part("sensor_delay", (0,))], [start])], [(0,), (1,)], [0, 1])
    u = dict(zip((one.name for one in predictions.names), plain.refit.nuisance, strict=True))
    assert u["switching"] == pytest.approx(later, abs=0.1)
    assert beyond_one_build(late, plain) < descent.LEAST_GAIN
    assert "switching" not in calibration_of(predictions, plain.refit, [0]), "it is none of the robot"


@pytest.mark.parametrize("limit", [-0.2, -0.3, -0.4])
def test_a_cause_is_found_from_a_size_that_does_nothing(limit: float, tmp_path: Path) -> None:
    """It gives 0.6 N·m of the model's 4: with a little less than 4 none of the motion is another, and no slope says where to go."""
    robot = mujoco.MjModel.from_xml_string(
        pendulum(f'<position {SERVO} kp="8" forcerange="-0.6 0.6"/>').replace(BENCH, "")
    )
    robot.opt.timestep = 0.0005
    t, runs = 2.0 + np.arange(150) / 50, []
    for amplitude in (0.4, 0.7):
        columns = drive(robot, ["joint"], t, amplitude * sweep(t, 1), noise=3e-4, quantum=ENCODER_RAD)
        runs.append(run_of(columns, t, ["joint"], f"sweep-{amplitude}"))
    model = write(tmp_path / "given.xml", pendulum(f'<position {SERVO} kp="8" forcerange="-4 4"/>'))
    fits = Fits(Predictions(RunSet.of(runs, model, ["joint"], [None, None])))
    start = fits.of([Part("torque_limit", (0,))], [{"limit": limit}])
    plain, found = closures(fits, [fits.nothing(), start], [(0,), (1,)], [0, 1])
    assert plain.after > 0.03
    assert found.after < 0.006
    assert found.refit.x[0]["limit"] == pytest.approx(math.log(0.6 / 4), abs=0.4)


def test_causes_that_are_not_there_end_at_nothing_and_not_beyond(tmp_path: Path) -> None:
    fits = Fits(Predictions(protocol(tmp_path, kp=8.0, dry=0.03)))
    names = ("actuator_lag", "action_delay", "load_friction", "backlash")
    starts = [catalogue()[name].starts(0.2)[0] for name in names]
    asked = [fits.of([Part(name, (0,))], [start]) for name, start in zip(names, starts, strict=True)]
    plain, *every = closures(fits, [fits.nothing(), *asked], [(0,), (1,)], [0, 1])
    for name, start, found in zip(names, starts, every, strict=True):
        size = catalogue()[name].quantities[0].name
        assert 0 <= found.refit.x[0][size] < start[size], name
        assert found.support(plain) < 0.2, f"held-out data do not speak for {name}"
        assert np.isfinite([found.before, found.floor, found.after, found.low, found.high, found.foretold]).all(), name


def test_none_begins_anew_where_a_little_of_a_cause_has_led_out_of_a_hollow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else every cause of a healthy robot would seem to be what it has."""
    fits = Fits(predictions := Predictions(protocol(tmp_path, kp=9.0, dry=0.03)))
    best = fits.refit([fits.nothing()], [0, 1], ())[0]
    # Slopes are not followed, so that all stay where they begin.
    monkeypatch.setattr(fitting, "ITERATIONS", 1)
    fits, part = Fits(predictions), Part("backlash", (0,))
    hollow = Refit((), (), -0.9 * np.sign(best.whole.nuisance))
    little = Refit((part,), (catalogue()["backlash"].starts(0.2)[0] | {"gap_rad": 1e-4},), best.whole.nuisance)
    alone = fits.refit([hollow], [0, 1], ())[0]
    none, some = fits.refit([hollow, little], [0, 1], ())
    assert none.likelihood > alone.likelihood + 50
    assert none.whole.nuisance == pytest.approx(best.whole.nuisance, abs=0.1)
    assert some.likelihood - none.likelihood < 2 * descent.LEAST_GAIN


@pytest.mark.parametrize(("gap_rad", "beyond"), [(0.005, False), (0.02, True)])
def test_a_cause_no_larger_than_robots_of_one_build_differ_by_is_none(
    gap_rad: float, beyond: bool, tmp_path: Path
) -> None:
    """A little play is in every gear: it explains what was measured, and says nothing against the robot."""
    given = protocol(tmp_path, kp=8.0, dry=0.03)
    robot, rng = Robot(1), np.random.default_rng(0)
    robot.play[:] = gap_rad
    runs = []
    for one in given.runs:
        log = simulate(rollouts_of([one]), [robot], signals=("pos",)).signals["pos"][0, :, :]
        pos = np.where(np.isfinite(log[:, 0]), log[:, 0], one.run.columns["pos.joint"])
        columns = one.run.columns | {"pos.joint": pos + rng.normal(0.0, 3e-4, len(pos))}
        runs.append(dataclasses.replace(one.run, columns=columns))
    fits = Fits(Predictions(RunSet.of(runs, tmp_path / "given.xml", ["joint"], [None, None])))
    start = catalogue()["backlash"].starts(0.2)[0]
    plain, found = closures(fits, [fits.nothing(), fits.of([Part("backlash", (0,))], [start])], [(0,), (1,)], [0, 1])
    assert found.refit.x[0]["gap_rad"] == pytest.approx(gap_rad, abs=0.002)
    assert found.likelihood > plain.likelihood + 10
    assert (beyond_one_build(found, plain) > 10) == beyond
    # First steps begin at the best of several sizes.
    half = fits.of([Part("backlash", (0,))], [start | {"gap_rad": gap_rad / 2}])
    ((first, likelihood),) = fits.begun([half], [0, 1])
    assert first.x[0]["gap_rad"] == pytest.approx(gap_rad, rel=0.3)
    assert plain.likelihood + 10 < likelihood < found.likelihood + 2 * descent.LEAST_GAIN


def test_what_leaves_nothing_at_all_and_a_fold_without_rows_say_nothing() -> None:
    """Of a log without noise: no sensor has a floor there."""
    none = Closure(
        before=0, after=0, floor=0, closed=1, low=1, high=1, likelihood=0.0, within=0.0, joints=1, squares=np.zeros((2, 1)),
            apart=np.zeros((2, 1)),
        counts=np.array([[0.0], [50.0]]), refit=Refit((), (), np.zeros(0)), std=(),
        irregular=Irregular(*np.zeros((6, 2)), squares=np.zeros(1), gone=np.zeros((2, 1)), moved=np.zeros(1)),
    )  # fmt: skip
    some = dataclasses.replace(none, squares=np.array([[0.0], [0.5]]) / 4e-8)
    assert none.support(none) == none.foretold == none.uneven == 0.0
    # Of three joints one is left at ten times its sensor's error on the fold that has rows; what sensors of the body keep is none of a joint.
    kept, rows = np.array([[0.0] * 4, [1.0, 99.0, 1.0, 1e4]]), np.array([[0.0], [50.0]]).repeat(4, axis=1)
    one = dataclasses.replace(none, joints=3, squares=kept * rows, counts=rows)
    assert one.uneven == pytest.approx(math.log(10 / math.sqrt(2)))
    assert 0 < none.support(some) == -some.support(none) < 10


def test_commands_that_scatter_explain_the_squares_that_they_account_for() -> None:
    """Three quarters of them: of the gap half is left, and nothing unknown need have made the rest of it."""
    jitter, punctual = catalogue()["clock_jitter"], np.zeros(len(RATIOS))
    punctual[-1] = 20.0
    said = Irregular(
        *np.zeros((4, 2)), scattered=punctual, scatter_s=np.sqrt(RATIOS), squares=np.ones(1), gone=np.zeros((2, 1)), moved=np.zeros(1)
    )  # fmt: skip
    (std_s,), _ = said.sizes(jitter)
    none = Closure(
        before=0, after=0, floor=0, closed=0, low=0, high=0, likelihood=0.0, within=0.0, joints=1, squares=np.full((2, 1), 1e6),
        apart=np.zeros((2, 1)), counts=np.ones((2, 1)), refit=Refit((), (), np.zeros(0)), std=(), irregular=said,
    )  # fmt: skip
    some = dataclasses.replace(none, irregular=dataclasses.replace(said, moved=np.array([0.75 / std_s**2])))
    assert none.explained(jitter) == 0.0
    assert some.explained(jitter) == pytest.approx(math.log(2), abs=1e-3)

    def left(closure: Closure) -> float:
        known: Any = SimpleNamespace(fit={"clock_jitter": 1.0}, evidence=SimpleNamespace(anomaly=Anomaly(1.8, 1.7)))
        anything: Any = None
        return Trials(anything, known, anything, {(): closure}).anomaly.left

    assert left(none) == 1.7
    assert left(some) == pytest.approx(0.9, abs=1e-3)
    unheard = dataclasses.replace(some.irregular, scattered=np.zeros(len(RATIOS)))
    assert left(dataclasses.replace(some, irregular=unheard)) == 1.7


#: a box on a floor, and a weight on an arm on it that shakes it
BOX = f"""\
<mujoco model="box">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="torso" pos="0 0 0.05">
      <freejoint name="base"/>
      <geom name="box" type="box" size="0.08 0.08 0.05" mass="0.8"/>
      <site name="imu" euler="IMU"/>
      <body name="arm" pos="0 0 0.06">
        <joint name="joint" axis="0 1 0" damping="0.12" armature="0.006" frictionloss="0.03"/>
        <geom name="rod" type="capsule" fromto="0 0 0 0 0 0.1" size="0.01" mass="0.02"/>
        <geom name="bob" type="sphere" pos="0 0 0.1" size="0.02" mass="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator><position {SERVO} kp="8" forcerange="-4 4"/></actuator>
  <sensor><gyro name="gyro" site="imu"/><accelerometer name="acc" site="imu"/></sensor>
</mujoco>
"""


def test_a_board_that_sits_askew_is_told_by_what_it_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It moves no joint: what an IMU says names it, how far it is turned is found, and the gap of joints stays what it was."""
    robot, turned = mujoco.MjModel.from_xml_string(BOX.replace("IMU", "0 0.12 0")), []
    data, chance, t = mujoco.MjData(robot), np.random.default_rng(4), np.arange(125) / 50
    for seed in (1, 2):
        command, rows = 0.4 * sweep(t, 1, high_hz=1.5 + 0.3 * seed), []
        mujoco.mj_resetData(robot, data)
        for k in range(len(t)):
            data.ctrl[0] = command[k, 0]
            mujoco.mj_forward(robot, data)
            rows.append([data.joint("joint").qpos[0], *data.sensordata])
            mujoco.mj_step(robot, data, 10)
        seen = np.array(rows) + np.array([3e-4, *[0.01] * 3, *[0.05] * 3]) * chance.standard_normal((len(t), 7))
        names = ("pos.joint", *(f"{name}.{axis}" for name in ("gyro", "acc") for axis in "xyz"))
        columns = {"cmd.joint": command[:, 0], **dict(zip(names, seen.T, strict=True))}
        turned.append(run_of(columns, t, ["joint"], f"sweep-{seed}", setup="floor"))
    predictions = Predictions(
        RunSet.of(turned, write(tmp_path / "box.xml", BOX.replace("IMU", "0 0 0")), ["joint"], [None] * 2)
    )
    assert predictions.sensed == ("gyro", "acc")
    parts = [Part("imu_misalignment", (0,)), Part("payload", (0,))]
    starts = [{"x_rad": 0.0, "y_rad": 0.07, "z_rad": 0.0}, catalogue()["payload"].starts(0.3)[0]]
    fits = Fits(predictions)
    asked = [fits.nothing(), *(fits.of([part], [x]) for part, x in zip(parts, starts, strict=True))]
    plain, askew, loaded = closures(fits, asked, [(0,), (1,)], [0, 1])
    assert askew.refit.x[0]["y_rad"] == pytest.approx(0.12, abs=0.025)
    assert askew.support(plain) > max(0.2, loaded.support(plain) + 0.2)
    assert beyond_one_build(askew, plain) > max(10, beyond_one_build(loaded, plain) + 10)
    assert askew.after == pytest.approx(plain.after, rel=0.05)
    # On a floor what leaves least goes on by slopes that are measured where it has come to.
    monkeypatch.setattr(fitting, "FINISHED", 0)
    fits = Fits(predictions)
    fits.refit([fits.nothing()], [0, 1], [])
    before = fits.refit([fits.nothing(), fits.of([parts[0]], [starts[0]])], [0, 1], [])[1]
    assert before.likelihood <= askew.likelihood
    without = Predictions(predictions.protocol, without=("gyro", "acc"))
    assert without.sensed == ()
    assert without.measured[0].shape == (len(t), 1)


def test_a_simulation_that_falls_apart_is_wrong_and_not_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    predictions = Predictions(protocol(tmp_path, kp=8.0, dry=0.03))
    sound = prediction.simulate

    def falls_apart(*args: Any, **options: Any) -> Log:
        found = sound(*args, **options).signals["pos"]
        found[1, len(T) // 2 :] = np.nan
        return Log({"pos": found})

    monkeypatch.setattr(prediction, "simulate", falls_apart)
    right, wrong = predictions.errors(0, [None, None])
    assert np.nanmax(np.abs(right)) < 0.1
    assert np.nanmin(np.abs(wrong[len(T) // 2 :])) == pytest.approx(prediction.LOST_RAD)


def falls_apart(folder: Path, one: Played) -> float:
    """rad, by which a servo that no step can hold ends beside a sound one, simulated in a folder."""
    os.chdir(folder)
    wild = Robot(1)
    wild.factor("armature")[:] = 1e-12
    wild.factor("stiffness")[:] = 1e15
    wild.factor("torque_limit")[:] = 1e15
    sound, found = simulate(Rollouts(one.plant, [one.run]), [Robot(1), wild], signals=["pos"]).signals["pos"]
    return float(np.abs(found - sound).max())


@pytest.mark.parametrize("elsewhere", [False, True], ids=["here", "in another process"])
def test_what_falls_apart_leaves_no_word_of_it(
    elsewhere: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """MuJoCo would write MUJOCO_LOG.TXT wherever a builder happens to be."""
    monkeypatch.chdir(tmp_path)
    one = protocol(tmp_path, kp=8.0, dry=0.03).runs[0]
    if elsewhere:
        (apart,) = joblib.Parallel(n_jobs=2)([joblib.delayed(falls_apart)(tmp_path, one)])
    else:
        apart = falls_apart(tmp_path, one)
    assert apart > 0.1  # MuJoCo begins such a one anew, again and again
    assert not list(tmp_path.glob("MUJOCO*"))
    assert "WARNING" not in "".join(capfd.readouterr())
