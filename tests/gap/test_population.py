"""Simulated robots of the diagnosis: the same physics as rollouts, and every cause of the catalogue shows."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Form, Robot
from openant_tools.gap.ensemble import templates_at, templates_of
from openant_tools.gap.features import COLUMNS
from openant_tools.gap.population import Case, robot_of
from openant_tools.gap.protocol import RunSet
from openant_tools.gap.simulation import simulate
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path

RATE_HZ = 50


def commanded(setup: str, seconds: float = 2.0, seed: int = 0) -> Run:
    """A run that has commands, and positions only at its start."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    columns = {}
    for joint in JOINT_NAMES:
        home = 0.0 if joint.startswith("hip") else 0.5
        swing = 0.25 if setup == "stand" else 0.08
        command = home + swing * np.sin(2 * np.pi * rng.uniform(0.4, 1.2) * t + rng.uniform(0, 6))
        command[t < 0.3] = command[0]
        columns[f"cmd.{joint}"] = columns[f"pos.{joint}"] = command
    return Run(setup, Facts(joints=tuple(JOINT_NAMES), setup=setup, heading_rad=0.0), t, columns)


@pytest.fixture(scope="module")
def protocol() -> RunSet:
    runs = [commanded("stand"), commanded("floor", 1.6)]
    return RunSet.of(runs, MODEL, JOINT_NAMES, [None, None]).coarse()


MODEL = nominal_model_path()


@pytest.mark.parametrize("setup", list(Setup))
def test_a_robot_as_the_model_says_moves_as_its_rollout(setup: Setup) -> None:
    plant = load_plant(MODEL, JOINT_NAMES, setup)
    rollouts = Rollouts(plant, [commanded(str(setup), 1.0)])
    found = simulate(rollouts, [Robot(8, creeps=True)]).signals
    assert np.allclose(found["pos"][0], rollouts().pos[0], atol=1e-5)
    assert np.allclose(found["vel"][0], rollouts().vel[0], atol=1e-4)
    assert set(found) == {"pos", "vel", "torque", "volt", *(COLUMNS if setup is Setup.FLOOR else ())}


def test_a_joint_that_dry_friction_holds_stays_where_it_is() -> None:
    """Under less than what would break it loose a joint of MuJoCo creeps by default; a gear does not."""
    plant = load_plant(MODEL, JOINT_NAMES, Setup.STAND)
    run = commanded("stand", 1.0)
    still = {name: np.full_like(run.t, 0.05) if name.startswith("cmd.") else 0 * run.t for name in run.columns}
    rollouts = Rollouts(plant, [dataclasses.replace(run, columns=still)])
    robots = [Robot(8, creeps=True), Robot(8)]
    for robot in robots:
        robot.more("coulomb_friction")[:] = 1.5
    creeping, held = np.abs(simulate(rollouts, robots, signals=["pos"]).signals["pos"]).max(axis=(1, 2))
    assert held < 1e-3 < creeping


def test_commands_that_come_by_chance_come_so_to_no_other_robot() -> None:
    rollouts = Rollouts(load_plant(MODEL, JOINT_NAMES, Setup.STAND), [commanded("stand", 1.0)])
    late, losing = Robot(8), Robot(8)
    late.jitter_s = 0.03
    losing.dropout[:], losing.longest_s = 0.3, 0.1
    plain, scattered, lost, again = simulate(rollouts, [Robot(8), late, losing, Robot(8)]).signals["pos"]
    assert np.abs(scattered - plain).max() > 1e-3
    assert np.abs(lost - plain).max() > 1e-3
    assert np.array_equal(again, plain)


def test_every_cause_of_the_catalogue_shows(protocol: RunSet) -> None:
    strongest: dict[str, Case] = {}
    for case in templates_of(protocol):
        ((name, (joints, _)),) = case.causes.items()
        if catalogue()[name].of_body or len(joints) == 8 or name not in strongest:
            strongest[name] = case
    assert set(strongest) == set(catalogue())
    features = templates_at(protocol, list(strongest.values()))
    moved = {name: max(float(np.abs(x[row]).max()) for x in features) for row, name in enumerate(strongest)}
    assert all(np.isfinite(x).all() for x in features)
    silent = [name for name, size in moved.items() if size < 1e-3]
    # What breaks only under heavy load or in long runs may stay silent in these two seconds.
    assert set(silent) <= {"thermal_derating", "blocked_joint"}


def test_a_run_that_was_warmer_begins_warmer() -> None:
    cool, warm = commanded("stand", 1.0), commanded("stand", 1.0, seed=1)
    columns = dict(warm.columns)
    for joint in JOINT_NAMES:
        cool.columns[f"temp.{joint}"] = np.full(len(cool.t), 28.0)
        columns[f"temp.{joint}"] = np.full(len(warm.t), 40.0 if joint == "knee_fl" else 28.0)
    columns["temp.hip_rr"][3] = 127.0  # a glitch
    warm = dataclasses.replace(warm, columns=columns)
    protocol = RunSet.of([cool, warm, commanded("stand", 1.0, seed=2)], MODEL, JOINT_NAMES, [None] * 3)
    knee = JOINT_NAMES.index("knee_fl")
    assert [one.warm_c.tolist() for one in protocol.runs] == [
        [0.0] * 8,
        [12.0 * (j == knee) for j in range(8)],
        [0.0] * 8,
    ]
    weakening = Robot(8)
    weakening.derating[:] = 0.03
    heated = weakening.copy()
    heated.heat_c = 12.0
    rollouts = Rollouts(protocol.runs[1].plant, [warm])
    known = simulate(rollouts, [weakening], signals=("pos",), warm_c=[protocol.runs[1].warm_c]).signals["pos"][0]
    cold, hot = simulate(rollouts, [weakening, heated], signals=("pos",)).signals["pos"]
    assert np.abs(known[:, knee] - hot[:, knee]).max() < 1e-3 < np.abs(known[:, knee] - cold[:, knee]).max()


def test_the_same_seed_draws_the_same_robot(protocol: RunSet) -> None:
    one, other, third = (robot_of(protocol, Case({}, seed)) for seed in (5, 5, 6))
    assert np.array_equal(one.factor("stiffness"), other.factor("stiffness"))
    assert not np.array_equal(one.factor("stiffness"), third.factor("stiffness"))


def test_a_servo_may_tell_what_it_asks_of_a_motor_that_gives_less() -> None:
    rollouts = Rollouts(load_plant(MODEL, JOINT_NAMES, Setup.STAND), [commanded("stand", 1.0)])
    given, asked = Robot(8), Robot(8)
    for robot, tells in ((given, False), (asked, True)):
        robot.form = Form(tells_asked=tells)
        for kind in ("stiffness", "torque_limit"):
            robot.weaken(kind, np.array([0]), 0.4)
    found = simulate(rollouts, [given, asked])
    moves, torque = found.signals["pos"], found.signals["torque"]
    assert np.array_equal(moves[0], moves[1]), "what is told moves nothing"
    assert torque[1, 5:, 0] == pytest.approx(torque[0, 5:, 0] / 0.4, rel=1e-3)
    assert np.array_equal(torque[0, :, 1:], torque[1, :, 1:])
