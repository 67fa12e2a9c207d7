"""What is left of the gap once the model is re-fitted: within tolerance, within bounds, and honest where a simulation falls apart."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from plants import BENCH, ENCODER_RAD, SERVO, drive, pendulum, run_of, sweep, write

import openant_tools.gap.closure as closure
from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Robot
from openant_tools.gap.closure import Refit, Windows, calibration_of, closures, heat_loss_of, nothing
from openant_tools.gap.explain import Part
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.simulation import Log, simulate
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.mjcf import nominal_mjcf

T = 2.0 + np.arange(150) / 50


def protocol(folder: Path, *, kp: float, dry: float) -> Protocol:
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
    return Protocol.of(runs, write(folder / "given.xml", model), ["joint"], [None, None])


def test_a_refit_stays_within_tolerance_and_is_the_best_there(tmp_path: Path) -> None:
    """Stiffness is half as large again, far beyond its 15 %: some end at their bounds, the others where they then serve best."""
    windows = Windows(protocol(tmp_path, kp=12.0, dry=0.05))
    ((found, _),) = windows.refit([nothing(windows)], [0, 1], ())
    assert np.abs(found.nuisance).max() == pytest.approx(1.0)

    def left(u: np.ndarray[Any, np.dtype[np.float64]]) -> float:
        refits = [dataclasses.replace(found, nuisance=u)]
        return sum(float(np.nansum(windows.errors(k, refits) ** 2)) for k in (0, 1))

    least = left(found.nuisance)
    assert least < 0.1 * left(np.zeros(len(windows.names)))
    for k in range(len(windows.names)):
        for step in (-0.3, 0.3):
            moved = found.nuisance.copy()
            moved[k] = np.clip(moved[k] + step, -1.0, 1.0)
            assert least < 1.25 * left(moved)


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
    windows = Windows(Protocol.of(runs, model, ["joint"], [None] * 3))
    *_, (left,) = closures(windows, [nothing(windows)], [2], [0, 1])
    assert left.closed > 0.8
    warmest = calibration_of(windows, left.refit, [2])["stiffness"]["joint"]
    assert warmest == pytest.approx(1 / (1 + loss * 50), rel=0.03)
    assert calibration_of(windows, left.refit, [0])["stiffness"]["joint"] == pytest.approx(1.0, rel=0.03)
    assert heat_loss_of(windows, left.refit) == pytest.approx(loss, rel=0.15)
    # One model for the warmest run alone is as good as knowing how warm it was; one for all three is not.
    assert windows.written(left.refit, [2]) == pytest.approx(left.after, rel=1e-6)
    assert windows.written(left.refit, [0, 1, 2]) > 2 * left.after
    unmeasured = [
        dataclasses.replace(run, columns={k: v for k, v in run.columns.items() if k != "temp.joint"}) for run in runs
    ]
    assert "heat_loss" not in [one.name for one in Windows(Protocol.of(unmeasured, model, ["joint"], [None] * 3)).names]


def test_slopes_learnt_where_a_cause_was_found_leave_less(tmp_path: Path) -> None:
    """What tolerances do was learnt without any cause: of a servo half as strong again that is not what they do with it."""
    windows = Windows(protocol(tmp_path, kp=16.0, dry=0.05))
    closures(windows, [nothing(windows)], [1], [0])
    stiff = Refit((Part("stiffness_error", (0,)),), (catalogue()["stiffness_error"].starts(0.5)[0],), windows.contacts)
    _, _, (found,) = closures(windows, [stiff], [1], [0])
    before, _, (again,) = closures(windows, [found.refit], [1], [0], anew=True)
    assert again.after < found.after
    assert before == float(np.sqrt(np.nanmean(np.square(windows.before(1)))))


@pytest.mark.parametrize("name", ["actuator_lag", "action_delay", "load_friction", "backlash"])
def test_a_cause_that_is_not_there_ends_at_nothing_and_not_beyond(name: str, tmp_path: Path) -> None:
    windows = Windows(protocol(tmp_path, kp=8.0, dry=0.03))
    start = catalogue()[name].starts(0.2)[0]
    cause = Refit((Part(name, (0,)),), (start,), np.zeros(len(windows.names)))
    before, floor, (_, found) = closures(windows, [nothing(windows), cause], (), [0, 1])
    size = catalogue()[name].quantities[0].name
    assert 0 <= found.refit.x[0][size] < start[size]
    assert np.isfinite([before, floor, found.after, found.low, found.high]).all()


def test_a_simulation_that_falls_apart_is_wrong_and_not_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    windows = Windows(protocol(tmp_path, kp=8.0, dry=0.03))
    sound = closure.simulate

    def falls_apart(*args: Any, **options: Any) -> Log:
        found = sound(*args, **options).signals["pos"]
        found[1, len(T) // 2 :] = np.nan
        return Log({"pos": found})

    monkeypatch.setattr(closure, "simulate", falls_apart)
    right, wrong = windows.errors(0, [None, None])
    assert np.nanmax(np.abs(right)) < 0.1
    assert np.nanmin(np.abs(wrong[len(T) // 2 :])) == pytest.approx(closure.LOST_RAD)


def walks(folder: Path, robot: Robot) -> Protocol:
    """Three runs of 3 s of a robot that scrubs its feet over the floor and lifts them, without a measured base."""
    plant = load_plant(write(folder / "given.xml", nominal_mjcf("standard")), None, Setup.FLOOR)
    home = np.array([0.0 if joint.startswith("hip") else -0.6 for joint in plant.joints])
    t = np.arange(150) / 50
    runs = []
    for n, speed in enumerate((1.1, 1.4, 1.25)):
        phase = np.arange(8) * (1.3 + 0.7 * n)
        reach = np.array([0.35 if joint.startswith("hip") else 0.25 for joint in plant.joints])
        commands = home + np.minimum(1.0, 2 * t)[:, None] * reach * np.sin(2 * np.pi * speed * t[:, None] + phase)
        columns = {f"cmd.{joint}": commands[:, j] for j, joint in enumerate(plant.joints)}
        columns |= {f"pos.{joint}": np.full(len(t), home[j]) for j, joint in enumerate(plant.joints)}
        run = Run(f"walk-{n}", Facts(joints=plant.joints, setup="floor"), t, columns)
        seen = simulate(Rollouts(plant, [run]), [robot], signals=["pos"]).signals["pos"][0].astype(float)
        columns = {**columns, **{f"pos.{joint}": seen[:, j] for j, joint in enumerate(plant.joints)}}
        runs.append(dataclasses.replace(run, columns=columns))
    return Protocol.of(runs, plant.path, plant.joints, [None] * 3)


def left_of(windows: Windows) -> float:
    """rad, of the last run, after a re-fit on the others."""
    *_, (left,) = closures(windows, [nothing(windows)], [2], [0, 1])
    return left.after


@pytest.mark.parametrize("cone", [None, int(mujoco.mjtCone.mjCONE_PYRAMIDAL)])
def test_feet_meet_the_floor_as_the_runs_say(cone: int | None, tmp_path: Path) -> None:
    """Contacts are found, and which of MuJoCo's cones they slip by; bases that nobody measured are led by what was found."""
    robot = Robot(8)
    robot.contact_give, robot.softness, robot.floor_friction, robot.contact_damping = 0.6, 0.85, 0.9, 0.8
    robot.cone, robot.impratio = cone, 1.0 if cone is None else 0.15
    windows = Windows(walks(tmp_path, robot))
    windows.refit([nothing(windows)], [0, 1], ())
    before = left_of(windows)
    windows.settle(nothing(windows), [0, 1])
    after = left_of(windows)
    assert windows.cone == cone
    assert after < 0.8 * before
    stated = calibration_of(windows, nothing(windows), [2])
    assert ("pyramidal_cones" in stated) == (cone is not None)
    assert stated["floor_friction"]["body"] == pytest.approx(0.9, rel=0.05)


def test_what_falls_apart_leaves_no_word_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """MuJoCo would write MUJOCO_LOG.TXT wherever a builder happens to be."""
    monkeypatch.chdir(tmp_path)
    one = protocol(tmp_path, kp=8.0, dry=0.03).runs[0]
    wild = Robot(1)
    wild.factor("armature")[:] = 1e-12
    wild.factor("stiffness")[:] = 1e15
    wild.factor("torque_limit")[:] = 1e15
    sound, found = simulate(Rollouts(one.plant, [one.run]), [Robot(1), wild], signals=["pos"]).signals["pos"]
    assert np.abs(found - sound).max() > 0.1  # MuJoCo begins such a one anew, again and again
    assert not list(tmp_path.glob("MUJOCO*"))
    assert "WARNING" not in "".join(capfd.readouterr())
