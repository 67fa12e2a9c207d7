"""A simulation that begins amid a run knows what the robot remembers of it: heat, setpoints under way, rotors behind springs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plants import SERVO, pendulum, run_of, sweep, write

import openant_tools.gap.simulation as simulation
from openant_tools.effects.catalogue import catalogue, enter
from openant_tools.effects.robot import Robot
from openant_tools.effects.step import Step
from openant_tools.effects.thermal_derating import FULL_HEAT_C
from openant_tools.gap.initial_state import heats, setpoints
from openant_tools.gap.protocol import RunSet
from openant_tools.gap.simulation import simulate
from openant_tools.model.rollout import Measured, Rollouts, Staircase

T = 2.0 + np.arange(200) / 50


@pytest.fixture(scope="module")
def protocol(tmp_path_factory: pytest.TempPathFactory) -> RunSet:
    model = write(
        tmp_path_factory.mktemp("memory") / "given.xml", pendulum(f'<position {SERVO} kp="8" forcerange="-1 1"/>')
    )
    command = sweep(T, 1)[:, 0]
    run = run_of({"cmd.joint": command, "pos.joint": 0.9 * command}, T, ["joint"])
    return RunSet.of([run], model, ["joint"], [None])


def anew(protocol: RunSet, robot: Robot) -> float:
    """rad: by how much a robot that begins anew every half second, where it was itself, differs from itself."""
    one = protocol.runs[0]
    whole = simulate(Rollouts(one.plant, [one.run]), [robot], signals=["pos"]).signals["pos"][0, :, 0].astype(float)
    run = dataclasses.replace(one.run, columns={**one.run.columns, "pos.joint": whole})
    again = simulate(Rollouts(one.plant, [run], 0.5), [robot], signals=["pos"]).signals["pos"][0, :, 0]
    return float(np.sqrt(np.mean((again - whole) ** 2)))


@pytest.mark.parametrize(
    ("cause", "values"),
    [
        ("thermal_derating", {"loss_per_c": 0.02, "time_constant_s": 3.0, "start_c": 1.0}),
        ("slew_limit", {"rate_rad_s": 0.6}),
        ("joint_compliance", {"stiffness_nm_rad": 6.0}),
    ],
)
def test_a_robot_that_begins_anew_amid_its_run_goes_on_as_it_did(
    cause: str, values: dict[str, float], protocol: RunSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    at, definition = np.array([0]), catalogue()[cause]
    x = {q.name: q.back(values[q.name], q.scale(protocol.reference, at)) for q in definition.quantities}
    robot = Robot(1, protocol.reference.low, protocol.reference.high)
    enter(robot, protocol.reference, [(cause, [0], x)])
    knowing = anew(protocol, robot)
    monkeypatch.setattr(simulation, "LED_S", 0.0)
    monkeypatch.setattr(simulation, "heats", lambda *args: np.broadcast_to(args[4], (len(args[2]), 1, 1)))
    monkeypatch.setattr(simulation, "setpoints", lambda commands, starts, robots: np.full((len(starts), 1, 1), np.nan))
    assert knowing < 0.4 * anew(protocol, robot)


@pytest.mark.parametrize(
    ("cause", "x"), [("joint_compliance", {"stiffness_nm_rad": 2.0}), ("backlash", {"gap_rad": 0.02})]
)
def test_a_joint_that_rests_stays_where_it_is_however_its_zero_is_off(
    cause: str, x: dict[str, float], protocol: RunSet
) -> None:
    """What the servo asks for at rest says little of the spring behind it: its friction takes any part."""
    given = protocol.runs[0]
    still = run_of({"cmd.joint": np.full(len(T), 0.5), "pos.joint": np.full(len(T), 0.46)}, T, ["joint"])
    robot = Robot(1, protocol.reference.low, protocol.reference.high)
    enter(robot, protocol.reference, [(cause, [0], x)])
    robot.more("coulomb_friction")[:] = 0.15
    (whole,) = simulate(Rollouts(given.plant, [still]), [robot], signals=["pos"]).signals["pos"][..., 0].astype(float)
    rests = still.columns | {"pos.joint": np.full(len(T), whole[-1] + 0.008)}
    rollouts = Rollouts(given.plant, [dataclasses.replace(still, columns=rests)], 0.5)
    (again,) = simulate(rollouts, [robot], signals=["pos"]).signals["pos"][..., 0]
    assert np.abs(again - rests["pos.joint"]).max() < 0.006


def test_a_setpoint_of_limited_rate_is_under_way() -> None:
    robot = Robot(1)
    robot.slew[:] = 0.5
    step = Staircase(np.array([0.0, 1.0]), np.array([[0.0], [1.0]]))
    begun = setpoints(step, [0.5, 1.0, 2.0, 2.5, 9.0], [robot, Robot(1)])
    assert begun[:, 0, 0] == pytest.approx([0.0, 0.0, 0.5, 0.75, 1.0], abs=0.01)
    assert np.isnan(begun[:, 1]).all()


def test_a_servo_that_gives_all_it_has_warms_up_with_its_time_constant(protocol: RunSet) -> None:
    one = protocol.runs[0]
    robot = Robot(1)
    robot.derating[:], robot.derating_s = 1e-6, 2.0
    rollouts = Rollouts(one.plant, [one.run], 0.5)
    servos = simulation._Batch(rollouts, [robot], np.random.default_rng(0), None)._servos
    far = Staircase(T[:1], np.array([[3.0]]))

    def found(dt: float, state: tuple[np.ndarray, np.ndarray], setpoint: np.ndarray) -> Step:
        return servos.view(dt, np.zeros(1), state, setpoint, rows=slice(0, 1))

    still = Measured.of(T, np.zeros((len(T), 1)))
    warm = heats(still, far, [2.0, 4.0, 7.0], [robot], np.array([[5.0]]), found)[:, 0, 0]
    assert warm == pytest.approx(5 + (FULL_HEAT_C - 5) * (1 - np.exp(-np.array([0.0, 1.0, 2.5]))), rel=0.02)


def test_what_was_measured_is_bridged_and_at_rest_beyond_its_ends() -> None:
    t = np.arange(50) / 50
    pos = np.stack([np.sin(3 * t), t], axis=1)
    pos[10:12, 0] = np.nan
    where, speed = Measured.of(t, pos).at(np.array([-1.0, t[10], 0.5, 9.0]))
    assert where[:, 0] == pytest.approx([0.0, np.sin(3 * t[10]), np.sin(1.5), np.sin(3 * t[-1])], abs=2e-3)
    assert speed[:, 1] == pytest.approx([0.0, 1.0, 1.0, 0.0], abs=1e-6)
