"""Several causes at once: sets of them are fitted together, and judged on motions and settings that were left out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from plants import BENCH, ENCODER_RAD, SERVO, drive, pendulum, run_of, sweep, write

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.closure import Windows
from openant_tools.gap.explain import Part
from openant_tools.gap.late import late_velocity
from openant_tools.gap.next import suggestion
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.sets import SetFits, choose, folds_of, motions_of
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run

RATE_HZ = 50
REAL = Path(__file__).parents[2] / "shared" / "realdata" / "bam-xl330"
#: the given model has all of its damping in the joint and no friction; the robot's is back-EMF, and it rubs
GIVEN = pendulum(f'<position {SERVO} kp="8" forcerange="-4 4"/>', joint='damping="0.12" armature="0.006"')
ROBOT = pendulum(
    f'<position {SERVO} kp="8" kv="0.11" forcerange="-4 4"/>',
    joint='damping="0.01" armature="0.006" frictionloss="0.12"',
).replace(BENCH, "")


def recorded(**facts: str) -> list[Run]:
    """A sweep, and two lifts after which torque is off."""
    robot = mujoco.MjModel.from_xml_string(ROBOT)
    robot.opt.timestep = 0.0005
    t = 3.0 + np.arange(3 * RATE_HZ) / RATE_HZ
    lift = 0.8 * np.minimum((t - t[0]) / 0.8, 1.0)[:, None]
    other = -1.0 * np.minimum((t - t[0]) / 1.2, 1.0)[:, None]
    held = [(t - t[0] < end).astype(float)[:, None] for end in (4.0, 1.3, 1.7)]
    runs = []
    for name, command, torque in zip(("sweep", "lift", "other"), (sweep(t, 1), lift, other), held, strict=True):
        columns = drive(robot, ["joint"], t, command, noise=5e-4, quantum=ENCODER_RAD, torque=torque)
        runs.append(run_of(columns, t, ["joint"], name, **facts))
    return runs


def protocol_of(runs: list[Run], model: Path) -> Protocol:
    return Protocol.of(runs, model, ["joint"], [None] * len(runs))


def test_two_causes_are_found_together_and_a_third_is_spared(tmp_path: Path) -> None:
    runs = recorded()
    protocol = protocol_of(runs, write(tmp_path / "given.xml", GIVEN))
    names = ["coulomb_friction", "electrical_damping", "dead_zone"]
    fits = SetFits(Windows(protocol), [0, 1, 2], [])
    choice = choose(
        fits, [Part(name, (0,)) for name in names], [catalogue()[name].starts(0.4)[0] for name in names],
        dict.fromkeys(names, 0.4),
    )  # fmt: skip
    assert set(choice.chosen.names) == {"coulomb_friction", "electrical_damping"}
    assert choice.chosen.closed > 0.6
    assert choice.chosen.worst > 0.4
    # Either alone is bent to make up for the other, and shows on the motion that was left out.
    assert all(choice.alone[name].closed < choice.chosen.closed - 0.1 for name in names)
    assert min(choice.removal.values()) > 0.1
    assert not choice.open
    assert choice.chosen.point("coulomb_friction")["torque_nm"] > 0
    assert set(choice.chosen.spread("electrical_damping")) == {"share"}


def test_folds_leave_out_motions_and_settings(tmp_path: Path) -> None:
    model, other = write(tmp_path / "a.xml", GIVEN), write(tmp_path / "b.xml", GIVEN)
    first, second, _ = recorded()
    one = Protocol.of([first, second], model, ["joint"], [None, None])
    assert [fold.out for fold in folds_of(one, [0, 1])] == [(0,), (1,)]
    small = dataclasses.replace(
        first, columns={**first.columns, "cmd.joint": 0.7 * first.column("cmd.joint")}, name="smaller"
    )
    # The same motion in another size and at another gain is no other motion.
    four = Protocol.of([first, second, small, second], model, ["joint"], [model, model, other, other])
    assert motions_of(four, range(4)) == [[0, 2], [1, 3]]
    assert [(fold.name, fold.out) for fold in folds_of(four, range(4))][2:] == [("a", (0, 1)), ("b", (2, 3))]


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
        protocol = protocol_of([run], model)
        smooth = Rollouts(protocol.runs[0].plant, [run])()
        velocity = np.interp(run.t - late_s, run.t, smooth.vel[0, :, 0])
        runs.append(dataclasses.replace(run, columns={**run.columns, "pos.joint": smooth.pos[0, :, 0], "vel.joint": velocity}))  # fmt: skip
    late = late_velocity(runs, ["joint"])
    assert late is not None
    assert late.delay_s == pytest.approx(late_s, abs=0.002)
    assert late.beyond(0.02) == pytest.approx(float(late_s > 0.02), abs=0.01)


def test_without_velocities_a_log_tells_nothing_of_them() -> None:
    assert late_velocity(recorded(), ["joint"]) is None


@pytest.mark.skipif(not REAL.is_dir(), reason="shared/ is not here")
def test_a_real_velocity_register_lags_by_what_is_documented() -> None:
    late = late_velocity([read_run(path) for path in sorted(REAL.glob("*.parquet"))], ["joint"])
    assert late is not None
    assert late.delay_s == pytest.approx(0.021, abs=0.002)
