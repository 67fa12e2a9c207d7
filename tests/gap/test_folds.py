"""Several causes at once: sets of them are fitted together, and judged on motions and settings that were left out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from places import SHARED
from plants import BENCH, COARSE, ENCODER_RAD, SERVO, drive, pendulum, run_of, sweep, write

from openant_tools.gap.assess import assess
from openant_tools.gap.experiment import Experiment
from openant_tools.gap.next import suggestion
from openant_tools.gap.trials import Trials
from openant_tools.gap.velocity_delay import velocity_delay
from openant_tools.model.plant import load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run

RATE_HZ = 50
REAL = SHARED / "realdata" / "bam-xl330"
#: the given model has all of its damping in the joint and no friction; the robot's is back-EMF, and it rubs
GIVEN = pendulum(
    f'<position {SERVO} kp="8" forcerange="-4 4"/>', joint='damping="0.12" armature="0.006"', option=COARSE
)
ROBOT = pendulum(
    f'<position {SERVO} kp="8" kv="0.11" forcerange="-4 4"/>',
    joint='damping="0.01" armature="0.006" frictionloss="0.12"',
).replace(BENCH, "")


def recorded(**facts: str) -> list[Run]:
    """A sweep, and two lifts after which torque is off."""
    robot = mujoco.MjModel.from_xml_string(ROBOT)
    robot.opt.timestep = 0.0005
    t = 3.0 + np.arange(round(2.3 * RATE_HZ)) / RATE_HZ
    lift = 0.8 * np.minimum((t - t[0]) / 0.8, 1.0)[:, None]
    other = -1.0 * np.minimum((t - t[0]) / 1.2, 1.0)[:, None]
    held = [(t - t[0] < end).astype(float)[:, None] for end in (4.0, 1.3, 1.7)]
    runs = []
    for name, command, torque in zip(("sweep", "lift", "other"), (sweep(t, 1), lift, other), held, strict=True):
        columns = drive(robot, ["joint"], t, command, noise=5e-4, quantum=ENCODER_RAD, torque=torque)
        runs.append(run_of(columns, t, ["joint"], name, **facts))
    return runs


@pytest.mark.slow
def test_two_causes_that_act_beside_each_other_are_both_found(tmp_path: Path) -> None:
    """Either alone is bent to make up for the other, and that shows on the motion that was left out."""
    runs = recorded()
    model = write(tmp_path / "given.xml", GIVEN)
    experiment = Experiment.of(runs, model, ["joint"])
    trials = Trials.of(experiment, assess(experiment.protocol))
    both = ("coulomb_friction", "electrical_damping")
    trials.fit([(), both[:1], both[1:], both])
    closed = {causes: one.closed for causes, one in trials.closures.items()}
    assert closed[both] > 0.6
    assert all(closed[one] < closed[both] - 0.1 for one in (both[:1], both[1:]))
    trials.further(both[:1])
    row = trials.row(both)
    assert row.support is not None
    assert row.support > 0, "what it closes on held-out parts speaks for the second"
    assert min(trials.removal(both).values()) > 0.1


def test_what_a_large_cause_leaves_once_it_is_fitted_is_none_of_its_like(tmp_path: Path) -> None:
    """Tolerances do something else to a robot with so much more damping: that must not pass for a second cause."""
    robot = load_plant(
        write(tmp_path / "robot.xml", pendulum(joint='damping="0.3" armature="0.007" frictionloss="0.035"'))
    )
    t, runs = 2.0 + np.arange(125) / 50, []
    for name, cmd in (("sweep", 0.8 * sweep(t, 1)), ("other", 0.5 * sweep(t, 1)[::-1])):
        runs.append(run_of(drive(robot.model, ["joint"], t, cmd, noise=3e-4), t, ["joint"], name))
    experiment = Experiment.of(runs, write(tmp_path / "given.xml", pendulum(option=COARSE)), ["joint"])
    trials = Trials.of(experiment, assess(experiment.protocol))
    damping = ("damping_error",)
    trials.fit([(), damping])
    assert trials.assessment.fit["damping_error"] > 50
    assert max(fit for _, _, fit in trials.left(damping)) < 5


def test_folds_leave_out_motions_and_settings(tmp_path: Path) -> None:
    first, second, _ = recorded()
    two = Experiment.of([first, second], write(tmp_path / "a.xml", GIVEN), ["joint"])
    assert two.folds == ((0,), (1,)), "they are too short to be cut"
    small = dataclasses.replace(
        first, columns={**first.columns, "cmd.joint": 0.7 * first.column("cmd.joint")}, name="smaller"
    )
    other = str(write(tmp_path / "b.xml", GIVEN))
    at_other = [dataclasses.replace(one, facts=dataclasses.replace(one.facts, model=other)) for one in (small, second)]
    # The same motion in another size and at another gain is no other motion.
    four = Experiment.of([first, second, *at_other], tmp_path / "a.xml", ["joint"])
    assert four.folds == ((0, 2), (1, 3), (0, 1), (2, 3))


def test_held_out_runs_alone_are_judged(tmp_path: Path) -> None:
    runs = recorded()
    made = Experiment.of(runs[:2], write(tmp_path / "given.xml", GIVEN), ["joint"], hold_out=runs[2:])
    names = [made.parts.runs[k].run.name for fold in made.folds for k in fold]
    assert all(name.startswith("other") for name in names)
    assert {made.parts.runs[k].run.name.split("[")[0] for k in made.training} == {"sweep", "lift"}
    assert [one.run.name for one in made.protocol.runs] == ["sweep", "lift"]


def test_a_diagnosis_of_one_motion_asks_for_more() -> None:
    assert suggestion("load_friction", (), 1) is None
    assert "3 kinds of motion" in (suggestion("ambiguous", (("load_friction", "cogging"),), 1) or "")
    assert "warm it up" in (suggestion("ambiguous", (("thermal_derating", "torque_limit"),), 3) or "")
    assert "repeat the runs" in (suggestion("unexplained", (), 4) or "")


@pytest.mark.parametrize("late_s", [0.0, 0.013, 0.03])
def test_a_log_tells_how_late_its_velocities_are(late_s: float, tmp_path: Path) -> None:
    runs = []
    model = write(tmp_path / "given.xml", GIVEN)
    for run in recorded():
        smooth = Rollouts(load_plant(model, ["joint"]), [run])()
        velocity = np.interp(run.t - late_s, run.t, smooth.vel[0, :, 0])
        runs.append(dataclasses.replace(run, columns={**run.columns, "pos.joint": smooth.pos[0, :, 0], "vel.joint": velocity}))  # fmt: skip
    late = velocity_delay(runs, ["joint"])
    assert late is not None
    assert late.delay_s == pytest.approx(late_s, abs=0.002)
    assert late.beyond(0.02) == pytest.approx(float(late_s > 0.02), abs=0.01)


def test_without_velocities_a_log_tells_nothing_of_them() -> None:
    assert velocity_delay(recorded(), ["joint"]) is None


@pytest.mark.skipif(not REAL.is_dir(), reason="shared/ is not here")
def test_a_real_velocity_register_lags_by_what_is_documented() -> None:
    late = velocity_delay([read_run(path) for path in sorted(REAL.glob("*.parquet"))], ["joint"])
    assert late is not None
    assert late.delay_s == pytest.approx(0.021, abs=0.002)
