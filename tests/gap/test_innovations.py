"""Which commands were lost, or came at random times, by what a fit leaves of a simulated Ant."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Form, Robot
from openant_tools.gap.innovations import Irregular, irregular
from openant_tools.gap.protocol import Played
from openant_tools.gap.simulation import simulate
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.mjcf import nominal_mjcf

ROWS, PERIOD_S = 300, 0.02


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Plant:
    path = tmp_path_factory.mktemp("model") / "ant.xml"
    path.write_text(nominal_mjcf("standard"), encoding="utf-8")
    return load_plant(path, tuple(JOINTS), Setup.STAND)


@pytest.fixture(scope="module")
def run(plant: Plant) -> Run:
    return motion(plant, PERIOD_S, ROWS)


def motion(plant: Plant, period_s: float, rows: int) -> Run:
    """Eight joints that follow motions of their own about where the model rests."""
    rng, t = np.random.default_rng(4), period_s * np.arange(rows, dtype=np.float64)
    ramp = np.clip(t / 0.5, 0, 1)
    columns = {}
    for j, joint in enumerate(JOINTS):
        middle = 0.0 if j % 2 == 0 else plant.model.jnt_range[plant.model.dof_jntid[plant.dof[j]]].mean()
        waves = [0.12 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in rng.uniform(0.4, 1.6, 3)]
        columns[f"cmd.{joint}"] = columns[f"pos.{joint}"] = middle + ramp * np.sum(waves, axis=0)
    return Run("motion", Facts(tuple(JOINTS), setup="stand"), t, columns)


def late(std_s: float, *, one_packet: bool = True) -> Robot:
    robot = Robot(len(JOINTS))
    robot.jitter_s, robot.form = std_s, Form(one_packet=one_packet)
    return robot


def losing(fraction: float) -> Robot:
    robot = Robot(len(JOINTS))
    robot.dropout, robot.longest_s, robot.shared_dropout = np.full(len(JOINTS), fraction), 0.04, True
    return robot


LOST, SCATTERED = catalogue()["command_dropout"], catalogue()["clock_jitter"]


def left(run: Run, plant: Plant, robot: Robot, noise: float = 3e-4) -> Irregular:
    """What is said of commands by what the model leaves of a robot."""
    pos = simulate(Rollouts(plant, [run]), [Robot(len(JOINTS)), robot], seed=3, signals=("pos",)).signals["pos"]
    errors = (pos[1] - pos[0]).astype(float) + noise * np.random.default_rng(8).standard_normal(pos[0].shape)
    still = np.zeros(len(JOINTS))
    return irregular([Played.of(run, plant, still)], [errors], [plant], [still])


def test_commands_that_are_lost_are_found_one_by_one(run: Run, plant: Plant) -> None:
    found = left(run, plant, losing(0.1))
    assert found.nats(LOST) > max(100, found.nats(SCATTERED))
    assert found.joints(LOST) == tuple(range(len(JOINTS)))
    assert np.median(found.explained(LOST)) > 0.4 > 2 * np.median(found.explained(SCATTERED))
    share, longest_s = found.sizes(LOST)[0]
    assert share == pytest.approx(0.1, abs=0.04)
    assert longest_s == pytest.approx(0.04, abs=0.025)


def test_the_joint_whose_commands_are_lost_is_found(run: Run, plant: Plant) -> None:
    robot = losing(0.0)
    robot.dropout, robot.shared_dropout = np.where(np.arange(len(JOINTS)) == 5, 0.15, 0.0), False
    found = left(run, plant, robot)
    assert found.nats(LOST) > 15
    assert found.joints(LOST) == (5,)


@pytest.mark.parametrize("std_s", [0.004, 0.008])
def test_commands_that_scatter_are_not_lost(run: Run, plant: Plant, std_s: float) -> None:
    found = left(run, plant, late(std_s))
    assert found.nats(SCATTERED) > max(100, 3 * found.nats(LOST))
    (size,), (deviation,) = found.sizes(SCATTERED)
    assert abs(size - std_s) < 2 * deviation < 0.8 * std_s
    assert np.median(found.explained(SCATTERED)) > 0.5


def test_what_a_model_does_wrong_is_no_lost_command(run: Run, plant: Plant) -> None:
    robot = Robot(len(JOINTS))
    robot.scale["stiffness"], robot.scale["damping"] = np.full(len(JOINTS), 0.7), np.full(len(JOINTS), 1.6)
    robot.delay = np.full(len(JOINTS), 0.01)
    found = left(run, plant, robot)
    assert found.nats(LOST) < 10
    assert found.nats(SCATTERED) < 10
    assert max(found.explained(LOST).max(), found.explained(SCATTERED).max()) < 0.1
    assert left(run, plant, late(0.001)).nats(SCATTERED) < 3


def test_a_lateness_that_comes_and_goes_with_the_motion_is_none_of_each_command(plant: Plant) -> None:
    """What a model does wrong looks so, and at 200 commands a second it changes little from one to the next."""
    run, still = motion(plant, 0.005, 600), np.zeros(len(JOINTS))
    acted = run.t - 0.004 * np.sin(2 * np.pi * 0.7 * run.t)
    commands = {f"cmd.{joint}": np.interp(acted, run.t, run.column(f"cmd.{joint}")) for joint in JOINTS}
    late_now_and_then = dataclasses.replace(run, columns={**run.columns, **commands})
    pos = [Rollouts(plant, [one])([plant.model]).pos[0] for one in (late_now_and_then, run)]
    errors = pos[0] - pos[1] + 1e-4 * np.random.default_rng(1).standard_normal(pos[0].shape)
    found = irregular([Played.of(run, plant, still)], [errors], [plant], [still])
    assert found.nats(SCATTERED) < 3
    assert found.nats(LOST) < 10


def test_a_few_rows_say_nothing_of_commands(run: Run, plant: Plant) -> None:
    short, still = run.between(0.0, 2.5 * PERIOD_S), np.zeros(len(JOINTS))
    found = irregular([Played.of(short, plant, still)], [np.zeros((3, len(JOINTS)))], [plant], [still])
    assert found.nats(LOST) == found.nats(SCATTERED) == 0.0
