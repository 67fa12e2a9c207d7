"""The simulated environment as a researcher meets it: through gymnasium.make, with wrong arguments, over many steps."""

from __future__ import annotations

import copy
import math
import pickle
import re
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

import openant_env  # noqa: F401
from openant_env import rendering
from openant_env.metrics import AverageReward
from openant_env.observations import layout
from openant_env.rendering import NoOpenGL, write_strip
from openant_env.tasks import BackAndForth
from openant_env.wrappers import NormaliseByBounds
from openant_tools.errors import BadInput
from openant_tools.opengl import CHOSEN_GL
from openant_tools.robot.config import EffectEntry
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_mjcf, nominal_model_path


def make(**options):
    return gymnasium.make("openant/Ant-v0", **options)


@pytest.fixture(scope="module")
def ant():
    env = make()
    yield env
    env.close()


@pytest.fixture
def robot(tmp_path) -> RobotFolder:
    return create_robot(tmp_path / "my-ant")


def random_actions(count: int, seed: int = 0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 8)).astype(np.float32)


# ---------------------------------------------------------------------------------------------- spaces, order, checks


@pytest.mark.filterwarnings("ignore:.*Box observation space.*:UserWarning")
@pytest.mark.parametrize("options", [{}, {"kit": "lite", "task": "forward", "observation_order": "paper", "dt": 0.05}])
def test_gymnasium_finds_nothing_wrong(options):
    check_env(make(**options).unwrapped, skip_render_check=True)


def test_a_standing_robot_sees_itself_standing(ant):
    observation, info = ant.reset(seed=3)
    seen = dict(zip(ant.unwrapped.observation_names, observation, strict=True))
    assert len(seen) == 24
    assert all(seen[f"pos.{joint}"] == pytest.approx(0.0, abs=0.02) for joint in JOINT_NAMES if "hip" in joint)
    assert all(seen[f"pos.{joint}"] == pytest.approx(math.radians(-50), abs=0.05) for joint in JOINT_NAMES[1::2])
    assert all(abs(seen[f"vel.{joint}"]) < 0.02 for joint in JOINT_NAMES)
    assert seen["acc.z"] == pytest.approx(9.81, abs=0.05)
    (hx, hy), (ux, uy) = info["heading"], info["reward_direction"]
    assert seen["direction.along"] == pytest.approx(ux * hx + uy * hy)
    assert seen["direction.left"] == pytest.approx(uy * hx - ux * hy)


def test_the_papers_order_holds_the_same_numbers():
    platform, paper = make(), make(observation_order="paper")
    assert platform.unwrapped.observation_names[16:] == (
        "direction.along", "direction.left", "acc.x", "acc.y", "acc.z", "gyro.x", "gyro.y", "gyro.z",
    )  # fmt: skip
    assert paper.unwrapped.observation_names[16] == "gyro.x"
    assert paper.unwrapped.observation_names[-1] == "direction.left"
    for env in (platform, paper):
        env.reset(seed=1)
    for action in random_actions(5):
        one, other = platform.step(action)[0], paper.step(action)[0]
        by_name = dict(zip(platform.unwrapped.observation_names, one, strict=True))
        assert [by_name[name] for name in paper.unwrapped.observation_names] == other.tolist()


def test_the_same_seed_gives_the_same_walk_and_another_seed_another_heading(ant):
    walks = []
    for seed in (5, 5, 6):
        first, info = ant.reset(seed=seed)
        walks.append((np.concatenate([first, *(ant.step(a)[0] for a in random_actions(10))]), info["heading"]))
    assert (walks[0][0] == walks[1][0]).all()
    assert not np.allclose(walks[0][1], walks[2][1])


def test_reset_puts_the_robot_where_it_is_told(ant):
    _, info = ant.reset(seed=0, options={"heading_rad": 1.0, "position": (0.1, -0.2), "direction_rad": -2.0})
    assert info["heading"] == pytest.approx([math.cos(1.0), math.sin(1.0)], abs=1e-3)
    assert info["position"] == pytest.approx([0.1, -0.2], abs=1e-6)
    assert info["reward_direction"] == pytest.approx([math.cos(-2.0), math.sin(-2.0)])
    with pytest.raises(BadInput, match="no such reset option: heading"):
        ant.reset(options={"heading": 1.0})


def test_what_a_step_returns_is_the_callers_to_keep(ant):
    observation, info = ant.reset(seed=0)
    kept = observation.copy(), {key: np.copy(value) for key, value in info.items()}
    for action in random_actions(5):
        ant.step(action)
    assert (observation == kept[0]).all()
    assert all((np.asarray(info[key]) == kept[1][key]).all() for key in info)


def test_it_runs_as_a_vector_of_environments():
    envs = gymnasium.make_vec("openant/Ant-v0", num_envs=2, vectorization_mode="sync", vector_kwargs={}, dt=0.05)
    observations, _ = envs.reset(seed=0)
    assert observations.shape == (2, 24)
    assert not np.allclose(observations[0, 16:18], observations[1, 16:18])
    observations, rewards, *_ = envs.step(random_actions(2))
    assert rewards.shape == (2,)
    envs.close()


# -------------------------------------------------------------------------------------------------------- the reward


def test_reward_is_scored_against_the_direction_in_force_and_turns_beyond_the_circle():
    random = np.random.default_rng(0)
    paper, platform = BackAndForth(), BackAndForth(scored="platform")
    for task in (paper, platform):
        task.reset(0.25, 0.1, random, direction_rad=0.0)
    assert paper.reward(0.27, 0.1) == platform.reward(0.27, 0.1) == pytest.approx(0.02)
    # The step that crosses R = 0.3 m: the paper scores it against the old direction, the platform against the new one.
    crossing = paper.reward(0.35, 0.12), platform.reward(0.35, 0.12)
    back = -np.array([0.35, 0.12]) / np.hypot(0.35, 0.12)
    assert crossing == (pytest.approx(0.08), pytest.approx(np.dot([0.08, 0.02], back)))
    assert (paper.ux, paper.uy) == (pytest.approx(back[0]), pytest.approx(back[1]))
    # Still outside, but already heading home: the direction stays, so the robot is not turned about on the spot.
    paper.reward(0.36, 0.12)
    assert (paper.ux, paper.uy) == (pytest.approx(back[0]), pytest.approx(back[1]))


def test_rewards_of_a_walk_are_its_displacement_along_the_direction(ant):
    _, before = ant.reset(seed=2)
    for action in random_actions(60):
        _, reward, _, _, info = ant.step(action)
        assert reward == pytest.approx(
            np.dot(info["position"] - before["position"], before["reward_direction"]), abs=1e-9
        )
        before = info
    assert info["time_s"] == pytest.approx(60 * 0.12)


def test_the_forward_task_rewards_the_way_along_x():
    env = make(task="forward")
    observation, before = env.reset(seed=2)
    assert observation[16:18] == pytest.approx(before["heading"], abs=1e-6)
    _, reward, _, _, info = env.step(np.ones(8))
    assert reward == pytest.approx(info["position"][0] - before["position"][0])


@given(
    st.lists(st.tuples(st.floats(-1, 1), st.floats(0.01, 2.0)), min_size=1, max_size=400),
    st.floats(1.0, 50.0),
    st.integers(0, 400),
)
def test_average_reward_is_that_of_the_window_even_when_saved_on_the_way(steps, window, saved_at):
    average = AverageReward(window)
    for k, step in enumerate(steps):
        if k == saved_at:
            state = average.get_state()
            average = AverageReward(window)
            average.set_state(state)
        average.add(*step)
    rewards, durations = np.array(steps).T
    longest = max(
        (k for k in range(len(steps)) if durations[k:].sum() <= window + 0.5 * durations[k] + 1e-9), default=0
    )
    first = (
        min(k for k in range(len(steps)) if durations[k:].sum() <= window + 0.5 * durations[k] + 1e-9) if longest else 0
    )
    assert average.seconds <= window + 0.5 * durations.max() + 1e-6
    assert average.value == pytest.approx(rewards[first:].sum() / durations[first:].sum(), abs=1e-6)


def test_a_step_as_long_as_two_windows_stays_whatever_rounding_left_of_those_before():
    average = AverageReward(1.0)
    for duration in (0.3, 0.3, 2.0):
        average.add(0.5 * duration, duration)
    assert average.seconds == pytest.approx(2.0)
    assert average.value == pytest.approx(0.5)


def test_average_reward_over_120_seconds_of_equal_steps_is_the_papers_mean(ant):
    average = AverageReward()
    rewards = np.random.default_rng(0).normal(size=2500)
    for reward in rewards:
        average.add(float(reward), 0.12)
    assert average.value == pytest.approx(np.mean(rewards[-1000:] / 0.12))


# ------------------------------------------------------------------------------------------------------ what it drives


@pytest.mark.parametrize(
    ("name", "hip", "knee"),
    [("paper", (-45, 45), (-70, -30)), ("sac", (-30, 30), (-70, -30)), ("sarsa", (-30, 30), (-70, -15)),
     ("limits", (-45, 45), (-70, 70))],
)  # fmt: skip
def test_actions_reach_from_end_to_end_of_their_range_and_no_further(name, hip, knee):
    env = make(action_range=name)
    env.reset(seed=0)
    ends = []
    for action in (-3.0, 3.0):  # beyond −1…1: clipped
        env.step(np.full(8, action))
        ends.append(np.degrees(env.unwrapped.data.ctrl).round(3))
    assert list(zip(ends[0][0::2], ends[1][0::2], strict=True)) == [hip] * 4
    assert list(zip(ends[0][1::2], ends[1][1::2], strict=True)) == [knee] * 4


def test_the_robots_own_limits_timing_range_and_bounds_hold(robot):
    robot.update(
        {
            "motors.knee_fl.min_rad": -1.0, "timing.dt_s": 0.06, "actions.hip_half_range_rad": 0.2,
            "observation.gyro.x": [-2.5, 3.5],
        }
    )  # fmt: skip
    env = make(robot=robot.path)
    assert env.unwrapped.dt == 0.06
    env.reset(seed=0)
    env.step(np.full(8, -1.0))
    ctrl = dict(zip(JOINT_NAMES, env.unwrapped.data.ctrl, strict=True))
    assert ctrl["knee_fl"] == -1.0
    assert ctrl["knee_fr"] == pytest.approx(math.radians(-70))
    assert ctrl["hip_fl"] == pytest.approx(-0.2)
    low, high = env.unwrapped.observation_bounds
    names = env.unwrapped.observation_names
    assert (low[names.index("gyro.x")], high[names.index("gyro.x")]) == (-2.5, 3.5)
    assert low[names.index("pos.knee_fl")] == pytest.approx(-1.0)


def test_normalising_by_bounds_maps_them_to_one(robot):
    robot.update({"observation.gyro.x": [-2.5, 3.5]})
    plain = make(robot=robot.path)
    env, clipped = NormaliseByBounds(plain), NormaliseByBounds(plain, clip=True)
    low, high = plain.unwrapped.observation_bounds
    assert env.observation(low) == pytest.approx(-np.ones(24), abs=1e-5)
    assert env.observation(high) == pytest.approx(np.ones(24), abs=1e-5)
    assert env.observation(2 * high - low) == pytest.approx(3 * np.ones(24), abs=1e-4)
    assert clipped.observation(2 * high - low).max() == 1.0
    observation, _ = clipped.reset(seed=0)
    assert observation in clipped.observation_space
    with pytest.raises(BadInput, match="leave no room"):
        NormaliseByBounds(plain, low=high)


def test_filters_and_delay_buffers_are_full_of_the_pose_at_reset(robot):
    model = nominal_mjcf().replace("<position kp=", '<position timeconst="0.3" delay="0.04" nsample="60" kp=')
    (robot.path / "slow.xml").write_text(model)
    robot.update({"model": "slow.xml"})
    env = make(robot=robot.path)
    for _ in range(2):
        first, _ = env.reset(seed=0)
        for _ in range(3):
            observation, *_ = env.step(np.zeros(8))
        # An empty filter or buffer would pull every knee from −50° towards 0.
        assert observation[:8] == pytest.approx(first[:8], abs=0.01)
        env.step(np.ones(8))


def test_a_model_of_the_platform_without_joint_sensors_gets_them(robot):
    model = re.sub(r"<joint(pos|vel) .*?/>", "", nominal_mjcf())
    (robot.path / "platform.xml").write_text(model)
    robot.update({"model": "platform.xml"})
    env, nominal = make(robot=robot.path), make()
    for each in (env, nominal):
        each.reset(seed=0)
    for action in random_actions(5):
        assert (env.step(action)[0] == nominal.step(action)[0]).all()


# ------------------------------------------------------------------------------------------------------ how it ends


def test_it_never_ends_by_itself_but_for_a_time_limit_that_someone_wants():
    env = make(dt=0.01, time_limit_s=0.05)
    env.reset(seed=0)
    ends = [env.step(np.zeros(8))[2:] for _ in range(5)]
    assert [end[:2] for end in ends] == [(False, False)] * 4 + [(False, True)]
    assert ends[-1][2]["reason"] == "time limit"


@pytest.mark.parametrize(
    ("on_fall", "expected"), [("truncate", (False, True)), ("terminate", (True, False)), ("ignore", (False, False))]
)
def test_a_robot_on_its_back_needs_help(on_fall, expected):
    env = make(on_fall=on_fall)
    env.reset(seed=0)
    data = env.unwrapped.data
    data.qpos[2:7] = (0.3, 0.0, 1.0, 0.0, 0.0)
    _, _, terminated, truncated, info = env.step(np.zeros(8))
    assert (terminated, truncated) == expected
    assert info.get("reason") == (None if on_fall == "ignore" else "the robot lies on its back")


def test_physics_that_comes_apart_ends_with_a_reason_and_no_nan():
    env = make()
    env.reset(seed=0)
    last, *_ = env.step(np.zeros(8))
    env.unwrapped.data.qvel[3] = np.nan
    observation, reward, terminated, truncated, info = env.step(np.zeros(8))
    assert (terminated, truncated, info["reason"]) == (False, True, "the physics has come apart")
    assert (reward, observation.tolist()) == (0.0, last.tolist())
    observation, _ = env.reset()
    assert np.isfinite(env.step(np.zeros(8))[0]).all()


def test_a_saved_state_goes_on_bit_for_bit_here_and_in_a_pickled_copy():
    env = make().unwrapped
    env.reset(seed=4)
    for action in random_actions(20):
        env.step(action)
    state, others = env.get_state(), [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    straight = [env.step(action) for action in random_actions(10, seed=1)]
    straight_reset = env.reset()[0]
    env.set_state(state)
    for other in [env, *others]:
        for action, expected in zip(random_actions(10, seed=1), straight, strict=True):
            observation, reward, _, _, info = other.step(action)
            assert (observation == expected[0]).all()
            assert (reward, info["average_reward_m_s"]) == (expected[1], expected[4]["average_reward_m_s"])
        assert (other.reset()[0] == straight_reset).all()


# ------------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"dt": 0.0125},
            "dt = 0.0125 s is no whole number of the model's timestep of 0.001 s → use dt = 0.012 or 0.013",
        ),
        ({"dt": 0.0}, "dt = 0 s is no whole number"),
        ({"task": "sideways"}, "no such task: 'sideways' → choose one of back-and-forth, forward"),
        ({"task_options": {"radius": 1}}, "does not take the options radius"),
        ({"task_options": {"radius_m": 0}}, "the circle's radius is 0 m"),
        ({"task_options": {"scored": "twice"}}, "no such way of scoring"),
        ({"action_range": "wide"}, "no such action range: 'wide'"),
        ({"observation_order": "random"}, "no such order of observations"),
        ({"kit": "deluxe"}, "there is no kit 'deluxe'"),
        ({"on_fall": "cry"}, "on_fall is 'cry'"),
        ({"time_limit_s": -1}, "the time limit is −1 s"),
        ({"effects": ["load_friction"]}, "the nominal robot has no effects"),
        ({"robot": "/nowhere"}, "/nowhere: there is no robot.toml here"),
    ],
)
def test_an_argument_that_cannot_be_is_refused_in_one_line(options, words):
    with pytest.raises(BadInput) as refusal:
        make(**options)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_effects_that_the_model_carries_are_refused_by_name_unless_left_out(robot):
    robot.update(
        effects=[EffectEntry("action_delay", ("knee_fl",), {"delay_s": 0.1}), EffectEntry("voltage_sag", enabled=False)]
    )
    with pytest.raises(
        BadInput, match=r"robot\.toml: the effect action_delay does not act as an entry.* `--no-effects`"
    ):
        make(robot=robot.path)
    with pytest.raises(BadInput, match="the effect action_delay does not act as an entry"):
        make(robot=robot.path, effects=["action_delay"])
    with pytest.raises(BadInput, match="no enabled effect is called voltage_sag → it has action_delay"):
        make(robot=robot.path, effects=["voltage_sag"])
    make(robot=robot.path, effects=False)
    make(robot=robot.path, effects=[])


def test_a_model_that_does_not_fit_the_robot_is_refused(robot):
    path = robot.path / "other.xml"
    for text, words in (
        (nominal_mjcf().replace("knee_fl", "knee_front_left"), "no position-controlled joint 'knee_fl'"),
        (nominal_mjcf().replace('<freejoint name="root"/>', ""), "0 free joints"),
        (re.sub(r"<gyro .*?/>", "", nominal_mjcf()), "no sensor gyro of 3 numbers"),
        (
            nominal_mjcf().replace('integrator="implicitfast"', 'integrator="Euler" gravity="0 0 9"'),
            "does not come to stand",
        ),
        ("<mujoco", "MuJoCo cannot load it"),
    ):
        path.write_text(re.sub(r"<keyframe>.*?</keyframe>", "", text, flags=re.DOTALL))
        robot.update({"model": "other.xml"})
        with pytest.raises(BadInput) as refusal:
            make(robot=robot.path)
        assert words in str(refusal.value)
        assert "other.xml" in str(refusal.value)
    with pytest.raises(BadInput, match="a robot's folder says itself which kit it is"):
        make(robot=robot.path, kit="lite")


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (np.zeros(7), "shape (7,)"),
        (np.full(8, np.nan), "not finite: nan for hip_rr"),
        (0.5, "shape ()"),
        (np.full(8, np.inf), "not finite: inf"),
        (np.full(8, -np.inf), "not finite: -inf"),
        (["a"] * 8, "no numbers"),
    ],
)
def test_an_action_that_is_none_is_refused(ant, action, words):
    ant.reset(seed=0)
    with pytest.raises(BadInput) as refusal:
        ant.step(action)
    assert words in str(refusal.value)


# -------------------------------------------------------------------------------------------------------- pictures


def test_pictures_show_something_and_make_a_strip(tmp_path):
    env = make(render_mode="rgb_array", width=160, height=120)
    env.reset(seed=0)
    try:
        first = env.render()
    except NoOpenGL as absent:
        pytest.skip(str(absent))
    assert first.shape == (120, 160, 3)
    assert first.std() > 5.0
    env.step(np.ones(8))
    assert (env.render() != first).any()
    write_strip([first, first, first], tmp_path / "strip.png", seconds_apart=0.12)
    assert (tmp_path / "strip.png").stat().st_size > 1000
    env.close()


def test_without_opengl_only_the_picture_fails_and_says_why(monkeypatch):
    monkeypatch.setattr(rendering, "_backends", lambda: ["no_such_backend"])
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(NoOpenGL, match=r"no picture .* there is no OpenGL here .*no_such_backend.* → pip install"):
        env.render()
    env.step(np.zeros(8))
    env.close()
    assert make().unwrapped.render() is None


@pytest.mark.parametrize(("named", "why"), [("glfw", "glfw: "), ("off", "MUJOCO_GL says so"), ("mesa", "mesa: ")])
def test_a_backend_that_has_no_display_or_none_at_all_is_no_opengl(monkeypatch, named, why):
    monkeypatch.setenv(CHOSEN_GL, named)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(NoOpenGL, match=why):
        env.render()
    env.close()


def test_names_of_an_observation_are_those_of_run_tables():
    names = layout(JOINT_NAMES).names
    assert names[:2] == ("pos.hip_rr", "pos.knee_rr")
    assert {"gyro.x", "acc.z"} <= set(names)
    model = mujoco.MjModel.from_xml_path(str(nominal_model_path()))
    assert all(model.sensor(name).id >= 0 for name in names[:16])
    assert Path(nominal_model_path()).is_file()


def test_effects_of_the_robots_file_act(robot):
    """Loaded gears move another way; knees that are not named, and a robot without the entry, as before."""

    def walk() -> np.ndarray:
        env = make(robot=robot.path)
        env.reset(seed=3)
        rng = np.random.default_rng(0)
        return np.array([env.step(rng.uniform(-1, 1, 8))[0] for _ in range(20)])

    before = walk()
    robot.update(effects=[EffectEntry("load_friction", ("knee_fl",), {"coefficient": 0.3})])
    rubbed = walk()
    assert np.abs(rubbed - before).max() > 0.01
    np.testing.assert_array_equal(rubbed, walk())
    robot.update(effects=[])
    np.testing.assert_array_equal(before, walk())
