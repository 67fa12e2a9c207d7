"""What the calibration found acts in the environment as the diagnosis has simulated it, and can be left out by name."""

from __future__ import annotations

import dataclasses
import math
import pickle
from collections.abc import Callable

import gymnasium
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import openant_env  # noqa: F401
from openant_tools.effects.commands import CommandEffects, CommandPath
from openant_tools.effects.robot import Robot
from openant_tools.errors import BadInput
from openant_tools.gap import simulation
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.config import EffectEntry, Provenance
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES

STEPS, SENDS, PERIOD_S = 12, 12, 0.01
KNEE = JOINT_NAMES.index("knee_fl")


@pytest.fixture
def robot(tmp_path) -> RobotFolder:
    return create_robot(tmp_path / "my-ant")


class Forward:
    """Chance of which jitter is never negative: an environment cannot act before its agent has decided."""

    def __init__(self, seed: object) -> None:
        self._chance = np.random.Generator(np.random.PCG64(seed))

    def normal(self, mean: float, std: float, count: int):
        return np.abs(self._chance.normal(mean, std, count))


def heated(robot: Robot) -> None:
    robot.derating[KNEE], robot.derating_s = 0.03, 1.5


def biased(robot: Robot) -> None:
    robot.gyro_bias[:] = (0.01, -0.02, 0.03)


def tracked(robot: Robot) -> None:
    robot.base_scale, robot.base_yaw, robot.log_delay["base"] = 1.2, 0.1, 0.15


def late(robot: Robot) -> None:
    robot.jitter_s = 0.012


def lossy(robot: Robot) -> None:
    robot.dropout[:], robot.longest_s = 0.3, 0.1


#: how robot.toml says it, and how the diagnosis simulates it
SAME: dict[str, tuple[EffectEntry, Callable[[Robot], None]]] = {
    "thermal_derating": (
        EffectEntry("thermal_derating", ("knee_fl",), {"loss_per_c": 0.03, "time_constant_s": 1.5}), heated
    ),
    "imu_bias": (EffectEntry("imu_bias", "body", {"gyro_x": 0.01, "gyro_y": -0.02, "gyro_z": 0.03}), biased),
    "tracker_scale": (EffectEntry("tracker_scale", "body", {"scale": 1.2, "yaw_rad": 0.1, "latency_s": 0.15}), tracked),
    "clock_jitter": (EffectEntry("clock_jitter", "all", {"std_s": 0.012}), late),
    "command_dropout": (EffectEntry("command_dropout", "all", {"fraction": 0.3, "longest_s": 0.1}), lossy),
    "voltage_sag": (
        EffectEntry("voltage_sag", "all", {"resistance_ohm": 1.5}),
        lambda robot: robot.law("voltage_sag", "resistance_ohm").__setitem__(slice(None), 1.5),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SAME)
def test_a_walk_of_the_environment_is_that_of_the_diagnosis(name, robot, monkeypatch):
    entry, change = SAME[name]
    robot.update(effects=[entry])
    env = gymnasium.make("openant/Ant-v0", robot=robot.path).unwrapped
    env.reset(seed=0, options={"heading_rad": 0.0})
    random = np.random.default_rng(1)
    mask = random.random(STEPS * SENDS + 1) < 0.3
    mask[0] = False
    lost = iter(mask.tolist())
    env.np_random = Forward((0, 0))
    monkeypatch.setattr(CommandPath, "_lost", lambda self, chance: np.full(8, next(lost)))
    monkeypatch.setattr(simulation._Batch, "_lost", lambda self, robot, times, j: mask)

    start = np.empty(mujoco.mj_stateSize(env.model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(env.model, env.data, start, mujoco.mjtState.mjSTATE_INTEGRATION)
    began = float(env.data.time)
    actions = random.uniform(-1.0, 1.0, (STEPS, 8)).astype(np.float32)
    actions[0] = 0.0  # a recording knows nothing of what was commanded before it
    seen = [env.step(action) for action in actions]

    t = PERIOD_S * np.arange(STEPS * SENDS + 1)
    command = np.repeat(env.actions.centre + env.actions.half * actions, SENDS, axis=0)
    command = np.concatenate([command, command[-1:]])
    columns = {f"cmd.{joint}": command[:, j] for j, joint in enumerate(JOINT_NAMES)}
    columns |= {f"pos.{joint}": np.full(len(t), start[1 + env._plant.qpos[j]]) for j, joint in enumerate(JOINT_NAMES)}
    run = Run("walk", Facts(joints=JOINT_NAMES, setup="floor"), t, columns)
    plant = load_plant(env.robot.model_path, JOINT_NAMES, Setup.FLOOR)
    rollouts = Rollouts(plant, [run])
    start[0] = rollouts.segments[0].state[0]
    rollouts._segments = [dataclasses.replace(rollouts.segments[0], state=start)]
    theirs = Robot(8, creeps=True)
    change(theirs)
    for signal in ("pos", "vel", "imu", "base"):
        # MuJoCo's sensors read at the beginning of the last step, and so does the environment.
        theirs.log_delay[signal] = theirs.log_delay.get(signal, 0.0) + plant.timestep
    monkeypatch.setattr(simulation.np.random, "default_rng", Forward)
    log = simulation.simulate(rollouts, [theirs]).signals

    assert began == pytest.approx(env.data.time - STEPS * SENDS * PERIOD_S)
    slices = env.layout.slices
    for k, (observation, _, _, _, info) in enumerate(seen):
        row = (k + 1) * SENDS
        np.testing.assert_allclose(observation[slices["pos"]], log["pos"][0, row], atol=2e-6)
        np.testing.assert_allclose(observation[slices["vel"]], log["vel"][0, row], atol=2e-4)
        np.testing.assert_allclose(observation[slices["gyro"]], log["gyro"][0, row], atol=2e-4)
        np.testing.assert_allclose(info["position"], log["base"][0, row, :2], atol=2e-5)
        hx, hy = info["heading"]
        assert math.remainder(math.atan2(hy, hx) - log["yaw"][0, row, 0], 2 * math.pi) == pytest.approx(0, abs=0.02)

    plain = gymnasium.make("openant/Ant-v0", robot=robot.path, effects=False).unwrapped
    plain.reset(seed=0, options={"heading_rad": 0.0})
    without = [plain.step(action) for action in actions]
    apart = max(
        np.abs(mine[0] - other[0])[[*range(16), 21, 22, 23]].max()
        + np.abs(mine[4]["position"] - other[4]["position"]).max()
        for mine, other in zip(seen, without, strict=True)
    )
    assert apart > 1e-3, "the effect does not show"


@pytest.mark.parametrize("name", SAME)
def test_effects_are_the_same_for_the_same_seed_and_go_on_from_a_saved_state(name, robot):
    robot.update(effects=[SAME[name][0]])
    env = gymnasium.make("openant/Ant-v0", robot=robot.path).unwrapped
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 8)).astype(np.float32)

    def walk(of):
        return np.array([np.append(observation, reward) for observation, reward, *_ in map(of.step, actions)])

    env.reset(seed=4)
    first = walk(env)
    copied = pickle.loads(pickle.dumps(env))
    second = walk(env)
    np.testing.assert_array_equal(walk(copied), second)
    env.reset(seed=4)
    np.testing.assert_array_equal(walk(env), first)


def test_each_effect_can_be_left_out_by_name(robot):
    robot.update(effects=[entry for entry, _ in SAME.values()])
    only = gymnasium.make("openant/Ant-v0", robot=robot.path, effects=["imu_bias"]).unwrapped
    both = gymnasium.make("openant/Ant-v0", robot=robot.path, effects=["imu_bias", "clock_jitter"]).unwrapped
    assert only._path is None
    assert only._acting is None
    assert only._tracker is None
    assert only._bias is not None
    assert both._path is not None


@settings(max_examples=8)
@given(st.floats(0.02, 0.6), st.floats(0.0, 0.3), st.booleans(), st.integers(0, 1000))
def test_as_much_is_lost_as_the_entry_says(fraction, longest_s, shared, seed):
    effects = CommandEffects(0.0, np.full(3, fraction), longest_s, shared)
    path, random = CommandPath(effects, 0.001), np.random.default_rng(seed)
    lost = np.array([path._lost(random) for _ in range(20_000)])
    assert lost.mean() == pytest.approx(fraction, abs=0.06)
    if shared:
        assert (lost == lost[:, :1]).all()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost[:, 0].astype(int), [0]])))
    assert np.median(edges[1::2] - edges[::2]) <= max(1, round(longest_s / 0.01)) * 2


def test_a_command_acts_in_the_end_however_it_is_delayed():
    path = CommandPath(CommandEffects(0.02, np.full(2, 0.3), 0.05, True), 0.001)
    random = np.random.default_rng(0)
    path.reset(np.array([1.0, 2.0]))
    for _ in range(5):
        acting = path.play(np.array([3.0, -1.0]), 120, random)
    assert acting.shape == (120, 2)
    assert acting[-1] == pytest.approx([3.0, -1.0])
    again = CommandPath(CommandEffects(0.02, np.full(2, 0.3), 0.05, True), 0.001)
    again.set_state(path.get_state())
    np.testing.assert_array_equal(
        again.play(np.zeros(2), 120, np.random.default_rng(3)), path.play(np.zeros(2), 120, np.random.default_rng(3))
    )


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (EffectEntry("clock_jitter", "all", {"std": 0.1}), "clock_jitter has no parameter 'std' → it has std_s"),
        (EffectEntry("command_dropout", "all", {"fraction": 1.5}), "command_dropout.fraction = 1.5 is not physical"),
        (EffectEntry("imu_bias", "body", {"rad_s": [0.1, 0.2]}), "imu_bias.rad_s is no vector of three"),
        (EffectEntry("imu_bias", "body", {"m_s2": "much"}), "imu_bias.m_s2 is no number: 'much'"),
        (EffectEntry("tracker_scale", "body", {"scale": 0.0}), "tracker_scale.scale = 0 is not physical"),
        (EffectEntry("thermal_derating", "all", {"gain": 0.1}), "thermal_derating has no parameter 'gain'"),
    ],
)
def test_entries_that_cannot_be_are_refused_in_one_line(entry, words, robot):
    robot.update(effects=[entry])
    with pytest.raises(BadInput, match=words):
        gymnasium.make("openant/Ant-v0", robot=robot.path)


# ------------------------------------------------------------------------------------------------ domain randomisation


def test_robots_are_drawn_from_the_intervals_of_the_identification_and_nothing_else_varies(robot):
    nominal = gymnasium.make("openant/Ant-v0", robot=robot.path).unwrapped
    knee = int(nominal._plant.actuator[KNEE])
    stiffness = float(-nominal.model.actuator_biasprm[knee, 1])
    effect = EffectEntry("load_friction", ("knee_fl",), {"coefficient": 0.1})
    fitted = Provenance("fitted", "openant sysid fit", low=0.9 * stiffness, high=1.05 * stiffness)
    robot.update(
        {
            "identified.stiffness.knee_fl": stiffness,
            "identified.load_friction.knee_fl": 0.1,
            "identified.damping.knee_fl": 0.5,
            "identified.armature.knee_rr": 0.01,
        },
        provenance={
            "identified.stiffness.knee_fl": fitted,
            "identified.load_friction.knee_fl": Provenance("fitted", low=0.05, high=0.2),
            "identified.damping.knee_fl": Provenance("as given"),
            # an older fit's: this model has another armature
            "identified.armature.knee_rr": Provenance("fitted", low=0.0, high=0.02),
        },
        effects=[effect],
    )
    env = gymnasium.make("openant/Ant-v0", robot=robot.path, randomise=True).unwrapped
    assert env._randomiser.fixed == ("armature.knee_rr",)
    drawn = []
    for seed in range(12):
        env.reset(seed=seed)
        drawn.append(
            (-env.model.actuator_biasprm[knee, 1], env._randomiser.effects["load_friction", "coefficient"][KNEE])
        )
        env.step(np.zeros(8, np.float32))
    stiff, rubbing = np.array(drawn).T
    assert 0.9 * stiffness <= stiff.min() < stiffness < stiff.max() <= 1.05 * stiffness
    assert 0.05 <= rubbing.min() < 0.1 < rubbing.max() <= 0.2
    env.model.actuator_biasprm[knee], env.model.actuator_gainprm[knee] = (
        nominal.model.actuator_biasprm[knee],
        nominal.model.actuator_gainprm[knee],
    )
    for field in ("body_mass", "dof_damping", "dof_armature", "actuator_biasprm", "actuator_gainprm", "geom_friction"):
        np.testing.assert_array_equal(getattr(env.model, field), getattr(nominal.model, field))


def test_a_drawn_robot_is_the_same_for_the_same_seed_and_goes_on_in_a_pickled_copy(robot):
    robot.update(
        {"identified.damping.knee_fl": 0.852, "identified.torso_mass.robot": 0.324},
        provenance={
            "identified.damping.knee_fl": Provenance("fitted", low=0.7, high=1.0),
            "identified.torso_mass.robot": Provenance("fitted", low=0.3, high=0.35),
        },
    )
    env = gymnasium.make("openant/Ant-v0", robot=robot.path, randomise=True).unwrapped
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 8)).astype(np.float32)

    def walk(of):
        return np.array([of.step(action)[0] for action in actions])

    env.reset(seed=4)
    first = walk(env)
    copied = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(walk(copied), walk(env))
    env.reset(seed=4)
    np.testing.assert_array_equal(walk(env), first)


def test_what_was_never_identified_is_not_drawn_from_guesses(robot):
    with pytest.raises(BadInput, match="nothing was identified yet whose interval could be drawn from"):
        gymnasium.make("openant/Ant-v0", robot=robot.path, randomise=True)
    with pytest.raises(BadInput, match="the nominal robot was not identified"):
        gymnasium.make("openant/Ant-v0", randomise=True)
