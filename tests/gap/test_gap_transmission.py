"""Play and springs of simulated robots against another simulator of them, which steps five times as finely."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from openant_tools.blind.commands import RATE_HZ, motions
from openant_tools.blind.draw import Answer, Drawn
from openant_tools.blind.log import logged
from openant_tools.blind.robot import true_robot
from openant_tools.blind.simulate import simulate as simulate_truth
from openant_tools.effects.catalogue import catalogue, enter
from openant_tools.effects.robot import Form, Robot
from openant_tools.gap.features import TAKES_UP_S, around_switching
from openant_tools.gap.protocol import Players, RunSet, rollouts_of
from openant_tools.gap.simulation import simulate
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path

Array = np.ndarray

SECONDS, SEED = 2.5, 5


def moved_by(
    effect: str, joint: str, run: str, seconds: float = 3.5, **parameters: float
) -> tuple[np.ndarray, np.ndarray]:
    """(rows,) rad, what an effect changes of a joint's motion: as the other simulator has it, and as ours does."""
    motion = next(one for one in motions(4242) if one.name == run)
    rows = round(RATE_HZ * seconds)
    motion = replace(motion, commands=motion.commands[:rows], limp=motion.limp[:rows])
    drawn = Drawn(effect, (joint,), parameters, "medium")
    robots = [
        true_robot(Answer("single", effects, SEED, "batch", False)) for effects in ((), (drawn,))
    ]  # fmt: skip
    healthy, ill = (
        logged(robot, motion, 0, trace) for robot, trace in zip(robots, simulate_truth(robots, motion, 0), strict=True)
    )
    protocol = RunSet.of([healthy], nominal_model_path(), JOINT_NAMES, [None]).coarse()
    at = np.array([JOINT_NAMES.index(joint)])
    cause = catalogue()[effect]
    x = {q.name: q.back(parameters[q.name], q.scale(protocol.reference, at)) for q in cause.quantities}
    robot = Robot(8, protocol.reference.low, protocol.reference.high)
    enter(robot, protocol.reference, [(effect, [int(at[0])], x)])
    (ours,) = Players.of(protocol.runs).play([Robot(8), robot])
    true = ill.column(f"pos.{joint}") - healthy.column(f"pos.{joint}")
    return true[10:], (ours["pos"][1] - ours["pos"][0])[10:, at[0]].astype(float)


@pytest.mark.parametrize(
    ("effect", "parameters"), [("backlash", {"gap_rad": 0.03}), ("joint_compliance", {"stiffness_nm_rad": 4.0})]
)
def test_play_and_springs_move_a_joint_as_two_inertias_do(effect: str, parameters: dict[str, float]) -> None:
    true, ours = moved_by(effect, "knee_fl", "stand-1", **parameters)
    assert np.corrcoef(true, ours)[0, 1] > 0.7
    assert 0.5 < np.std(ours) / np.std(true) < 2


def test_a_knee_that_is_loaded_one_way_does_not_rattle_in_its_play() -> None:
    true, ours = moved_by("backlash", "knee_rr", "floor-1", 5.0, gap_rad=0.02)
    assert np.std(true) < math.radians(0.3)
    assert np.std(ours) < math.radians(0.5)


def played(run: str, seconds: float) -> RunSet:
    """A healthy robot of the other simulator at work, as a diagnosis plays it again."""
    motion = next(one for one in motions(4242) if one.name == run)
    rows = round(RATE_HZ * seconds)
    motion = replace(motion, commands=motion.commands[:rows], limp=motion.limp[:rows])
    robot = true_robot(Answer("single", (), SEED, "batch", False))
    (trace,) = simulate_truth([robot], motion, 0)
    return RunSet.of([logged(robot, motion, 0, trace)], nominal_model_path(), JOINT_NAMES, [None])


@pytest.mark.parametrize(("run", "within_rad"), [("stand-1", 1.5e-4), ("floor-1", 4.5e-4)])
def test_teeth_without_play_carry_a_rotor_as_no_teeth_do(run: str, within_rad: float) -> None:
    """Else a play is judged by what its simulation does, not by what it does."""
    protocol = played(run, SECONDS).coarse()
    option = protocol.runs[0].plant.model.opt
    form = Form(option.integrator, True, option.impratio, bristle=5e-4)
    rigid, geared = Robot(8, form=form), Robot(8, form=form)
    geared.play[:] = 1e-9
    pos = simulate(rollouts_of(protocol.runs), [rigid, geared], signals=["pos"]).signals["pos"].astype(float)
    assert float(np.sqrt(np.nanmean((pos[1] - pos[0]) ** 2))) < within_rad


@pytest.mark.parametrize("run", ["stand-1", "floor-1"])
def test_commands_are_as_late_in_large_steps_as_in_small_ones(run: str) -> None:
    protocol = played(run, SECONDS)
    (one,), (coarse,) = protocol.runs, protocol.coarse().runs
    assert coarse.plant.timestep > 2 * one.plant.timestep
    early = replace(coarse, plant=replace(coarse.plant, step_s=None))
    fine, held_back, as_it_is = (
        simulate(rollouts_of([of]), [Robot(8)], signals=["pos"]).signals["pos"][0].astype(float)
        for of in (one, coarse, early)
    )

    def off(large: Array) -> float:
        return float(np.sqrt(np.nanmean((large - fine) ** 2)))

    assert off(held_back) < 0.7 * off(as_it_is)


def test_torque_goes_amid_a_step_not_with_one() -> None:
    """So that fits find when: in steps of 2.5 ms a third of one would else be nothing, or a whole one."""
    (coarse,) = played("stand-2", 9.0).coarse().runs
    assert coarse.switches
    later = np.linspace(-1.0, 1.0, 6)
    pos = simulate(rollouts_of([coarse]), [Robot(8, switching=by) for by in later], signals=["pos"]).signals["pos"]
    moved = np.sqrt(np.nanmean(np.square(pos[1:] - pos[0], dtype=float), axis=(1, 2)))
    assert moved / moved[0] == pytest.approx(np.arange(1, 6), rel=0.15)


def test_what_follows_a_switch_of_torque_is_unsure_for_a_while() -> None:
    t = np.arange(100) / 50
    on = np.ones(100)
    on[30:50] = 0
    run = Run("r", Facts(joints=("a",)), t, {"pos.a": t, "cmd.a": t, "torque.a": on})
    rows = np.flatnonzero(around_switching(run, ["a"])[:, 0])
    assert set(range(30, 32)) | set(range(50, 60)) <= set(rows)
    assert rows[-1] == pytest.approx(50 + TAKES_UP_S * 50, abs=1)
    assert not set(rows) & set(range(35, 50))
