"""Soft actor-critic: its formulas, that it learns, and that no kill, crash or full disk costs more than a minute."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

import openant_env  # noqa: E402, F401
from openant_agents import adam, runs, sac, training  # noqa: E402
from openant_agents.curves import plot_curves  # noqa: E402
from openant_agents.runs import CurvePoint, load_checkpoint, read_curve  # noqa: E402
from openant_agents.sac import Actor, Replay, Sac, SacSettings, load_policy, train  # noqa: E402
from openant_tools.cli import main  # noqa: E402
from openant_tools.errors import BadInput  # noqa: E402
from openant_tools.robot.config import EffectEntry  # noqa: E402
from openant_tools.robot.folder import create_robot  # noqa: E402

# As `train` does; two threads on a busy machine wait for each other most of the time.
torch.set_num_threads(1)

#: small enough for a test, otherwise the real thing
SMALL = SacSettings(learning_start=60, batch=32, hidden=32)


class Reach(gymnasium.Env):
    """A point of one coordinate that is pushed by the action and rewarded for coming near 0.5, in steps of 0.1 s."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1.0, 1.0)
        return np.array([self.x], np.float32), {}

    def step(self, action):
        before = abs(self.x - 0.5)
        self.x = float(np.clip(self.x + 0.3 * action[0], -2.0, 2.0))
        return np.array([self.x], np.float32), before - abs(self.x - 0.5), False, False, {"dt": 0.1}


def ant(**options):
    return gymnasium.make("openant/Ant-v0", dt=0.02, **options)


def run_command(*arguments) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code


# --------------------------------------------------------------------------------------------------------- formulas


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_log_pi_is_that_of_a_squashed_gaussian(seed):
    torch.manual_seed(seed)
    actor = Actor(5, 3, SacSettings(hidden=16)).double()
    observation, noise = torch.randn(7, 5).double(), torch.randn(7, 3).double()
    action, log_pi = actor(observation, noise)
    mean, log_std = actor._gaussian(observation)
    squashed = torch.distributions.TransformedDistribution(
        torch.distributions.Normal(mean, log_std.exp()), [torch.distributions.TanhTransform()]
    )
    assert torch.allclose(log_pi, squashed.log_prob(action).sum(-1), atol=1e-5)


def test_log_pi_does_not_cancel_where_tanh_saturates():
    # In single precision tanh(12) is 1, and log(1 − tanh²) the logarithm of nothing; the exact value is −22.6.
    actor = Actor(1, 1, SacSettings(hidden=4))
    with torch.no_grad():
        actor.network[-1].weight.zero_()
        actor.network[-1].bias.copy_(torch.tensor([12.0, -100.0]))
    _, log_pi = actor(torch.zeros(1, 1), torch.zeros(1, 1))
    exact = -0.5 * math.log(2 * math.pi) - sac.LOG_STD_MIN - 2 * (math.log(2) - 12 - math.log1p(math.exp(-24)))
    assert log_pi.item() == pytest.approx(exact, rel=1e-5)


def test_the_settings_are_the_papers():
    paper = SacSettings()
    assert paper.gamma_per_s**0.12 == pytest.approx(0.99, abs=5e-4)
    assert (paper.tau, paper.batch, paper.buffer, paper.learning_start) == (0.005, 256, 1_000_000, 2_000)
    assert (paper.reward_scale, paper.actor_step, paper.critic_step, paper.entropy_step) == (100.0, 3e-4, 1e-3, 1e-3)


def test_critics_learn_the_return_with_each_step_weighed_by_its_time():
    # One state and a reward that collects 1 a second: in steps of Δt the value is Σ_k Δt·Δt·γ^(kΔt) = Δt²/(1 − γ^Δt),
    # as the platform's agent has it.
    for dt in (0.1, 0.2):
        chosen = SacSettings(
            batch=64, hidden=32, gamma_per_s=0.02, reward_scale=1.0, tau=0.1, entropy_start=1e-9, policy_every=10_000
        )
        agent = Sac(1, 1, chosen, seed=0)
        for _ in range(64):
            agent.replay.add(np.zeros(1), agent.random_action(), dt, dt, False, np.zeros(1))
        for _ in range(400):
            agent.update()
        q, _ = agent.critics(torch.zeros(1, 2))
        assert q.item() == pytest.approx(dt * dt / (1 - 0.02**dt), rel=0.1)


@settings(max_examples=50)
@given(st.integers(1, 20), st.integers(0, 60))
def test_a_restored_replay_holds_every_row_where_it_was(capacity, count):
    replay, again = Replay(2, 1, capacity), Replay(2, 1, capacity)
    for k in range(count):
        replay.add(np.full(2, k), np.full(1, -k), k, 0.12, k % 2, np.full(2, k + 1))
    kept = replay.between(max(0, count - capacity), count)
    again.restore(kept, count)
    assert len(again) == len(replay) == min(count, capacity)
    assert (again.rows[: len(again)] == replay.rows[: len(replay)]).all()
    assert kept[:, 0].tolist() == list(range(max(0, count - capacity), count))


@pytest.mark.parametrize("fused", [True, False])
def test_steps_are_those_of_torchs_adam_whose_checkpoints_go_on(fused, monkeypatch):
    monkeypatch.setattr(adam, "FUSED", fused)
    ours, theirs = (
        [torch.linspace(-1, 1, 50).requires_grad_(), torch.tensor(0.3, requires_grad=True)] for _ in range(2)
    )
    steps, random = (1e-3, 3e-4), torch.Generator().manual_seed(1)
    mine = adam.Adam(*zip(ours, steps, strict=True))
    model = torch.optim.Adam([{"params": [w], "lr": s} for w, s in zip(theirs, steps, strict=True)], fused=True)
    for k in range(40):
        for one, other in zip(ours, theirs, strict=True):
            one.grad = other.grad = torch.randn(one.shape, generator=random)
        if k == 20:
            mine = adam.Adam(*zip(ours, steps, strict=True))
            mine.load_state_dict(model.state_dict())
        model.step()
        with torch.inference_mode():
            mine.step()
        for one, other in zip(ours, theirs, strict=True):
            torch.testing.assert_close(one, other, rtol=0 if fused else 1e-5, atol=0 if fused else 1e-6)


def test_a_checkpoint_of_other_networks_or_versions_is_refused():
    agent = Sac(2, 1, SMALL, seed=0)
    state = agent.get_state()
    for broken in (
        {name: value for name, value in state.items() if name != "critics"},
        {**state, "actor_optimiser": {"state": {}, "param_groups": []}},
        Sac(3, 1, SMALL, seed=0).get_state(),
    ):
        with pytest.raises(
            BadInput, match=r"an agent with other networks, or an earlier version .* → train into another folder"
        ):
            agent.set_state(broken)


def test_it_learns_to_reach(tmp_path):
    chosen = SacSettings(learning_start=100, batch=64, hidden=32, entropy_start=0.1, actor_step=3e-3, gamma_per_s=0.01)
    train(Reach(), folder=tmp_path, steps=600, seed=0, settings=chosen)
    agent, _ = load_policy(tmp_path, Reach())
    for start in (-1.0, 1.5):
        x = start
        for _ in range(12):
            x += 0.3 * float(agent.act(np.array([x], np.float32), explore=False)[0])
        assert abs(x - 0.5) < 0.2


# ----------------------------------------------------------------------------------------------- going on where it was


def everything(folder: Path) -> dict[str, object]:
    """All that a run left behind, as far as it must not depend on where it was interrupted."""
    found: dict[str, object] = {
        "curve": (folder / "learning_curve.csv").read_bytes(),
        "transitions": (folder / "transitions.f32").read_bytes(),
    }

    def walk(prefix: str, value) -> None:
        if isinstance(value, dict):
            for key, item in value.items():
                walk(f"{prefix}.{key}", item)
        elif isinstance(value, list):
            for k, item in enumerate(value):
                walk(f"{prefix}.{k}", item)
        else:
            found[prefix] = value.numpy().tobytes() if hasattr(value, "numpy") else value

    walk("checkpoint", load_checkpoint(folder))
    return found


@pytest.fixture(scope="module")
def straight(tmp_path_factory) -> dict[str, object]:
    folder = tmp_path_factory.mktemp("straight")
    train(ant(), folder=folder, steps=230, seed=3, settings=SMALL)
    return everything(folder)


def test_stopping_and_going_on_changes_nothing(tmp_path, straight):
    env = ant()
    for steps in (40, 130, 230):  # before learning, while learning, to the end
        train(env, folder=tmp_path, steps=steps, seed=3, settings=SMALL)
    assert everything(tmp_path) == straight
    again = train(env, folder=tmp_path, steps=230, seed=3, settings=SMALL)
    assert again.step == 230
    assert everything(tmp_path) == straight


def test_a_run_begins_with_the_agent_of_another_and_needs_it_no_more(tmp_path, monkeypatch):
    source, again = tmp_path / "source", tmp_path / "again"
    train(ant(), folder=source, steps=230, seed=3, settings=SMALL)
    policy, _ = load_policy(source, ant())
    wide = dataclasses.replace(SMALL, hidden=16)
    with pytest.raises(BadInput, match="other networks"):
        train(ant(), folder=tmp_path / "wide", steps=10, seed=4, settings=wide, source=source)
    monkeypatch.setattr(Sac, "random_action", None)  # its policy acts, not chance
    train(ant(), folder=again, steps=40, seed=4, settings=SMALL, source=source)  # nothing is learned from so few
    begun, _ = load_policy(again, ant())
    observation = np.zeros(policy.replay.observations, np.float32)
    np.testing.assert_array_equal(begun.act(observation, explore=False), policy.act(observation, explore=False))
    assert json.loads((again / "run.json").read_text())["from"] == str(source)
    shutil.rmtree(source)
    done = train(ant(), folder=again, steps=120, seed=4, settings=SMALL, source=source)
    assert done.step == 120
    with pytest.raises(BadInput, match="differs in from"):
        train(ant(), folder=again, steps=130, seed=4, settings=SMALL)


def test_ctrl_c_saves_and_the_same_call_goes_on(tmp_path, straight, monkeypatch):
    monkeypatch.setattr(training, "REPORT_EVERY_S", 0.0)

    def interrupt(progress):
        if progress.step == 150:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(ant(), folder=tmp_path, steps=230, seed=3, settings=SMALL, report=interrupt)
    assert load_checkpoint(tmp_path)["step"] in (150, 151)
    train(ant(), folder=tmp_path, steps=230, seed=3, settings=SMALL)
    assert everything(tmp_path) == straight


def test_a_full_disk_leaves_the_checkpoint_before_it_whole(tmp_path, straight, monkeypatch):
    train(ant(), folder=tmp_path, steps=100, seed=3, settings=SMALL)

    def full(path, data):
        raise OSError(28, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        # The transitions of the new checkpoint are written already when the checkpoint itself fails.
        patch.setattr(runs, "write_bytes", full)
        with pytest.raises(OSError, match="No space left"):
            train(ant(), folder=tmp_path, steps=200, seed=3, settings=SMALL)
    assert load_checkpoint(tmp_path)["step"] == 100
    assert (tmp_path / "transitions.f32").stat().st_size > load_checkpoint(tmp_path)["transitions"] * 59 * 4
    train(ant(), folder=tmp_path, steps=230, seed=3, settings=SMALL)
    assert everything(tmp_path) == straight


def test_kill_9_loses_only_what_came_after_the_last_checkpoint(tmp_path, straight):
    program = f"""
import gymnasium, openant_env
from openant_agents import sac, training
training.CHECKPOINT_EVERY_S = 0.05
env = gymnasium.make("openant/Ant-v0", dt=0.02)
sac.train(env, folder=__import__("pathlib").Path({str(tmp_path)!r}), steps=100_000, seed=3,
          settings=sac.SacSettings(**{dataclasses.asdict(SMALL)!r}))
"""
    process = subprocess.Popen([sys.executable, "-c", program])
    try:
        deadline = time.monotonic() + 120
        while not (tmp_path / "checkpoint.pt").exists():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.005)
    finally:
        process.kill()
        process.wait()
    at = load_checkpoint(tmp_path)["step"]
    if at > 230:
        pytest.skip(f"this machine was at step {at} before it could be killed")
    train(ant(), folder=tmp_path, steps=230, seed=3, settings=SMALL)
    assert everything(tmp_path) == straight


def test_another_run_does_not_write_into_this_folder(tmp_path):
    train(ant(), folder=tmp_path, steps=5, seed=3, settings=SMALL)
    with pytest.raises(BadInput, match=r"holds another run: it differs in seed \(3, not 4\) → name another --out"):
        train(ant(), folder=tmp_path, steps=10, seed=4, settings=SMALL)
    with pytest.raises(BadInput, match=r"it differs in trained_on.kit|it differs in trained_on.model_sha256"):
        train(ant(kit="lite"), folder=tmp_path, steps=10, seed=3, settings=SMALL)
    with pytest.raises(BadInput, match=r"settings\.batch"):
        train(ant(), folder=tmp_path, steps=10, seed=3, settings=dataclasses.replace(SMALL, batch=64))


def test_one_process_at_a_time_trains_in_a_folder(tmp_path):
    train(ant(), folder=tmp_path, steps=5, seed=3, settings=SMALL)
    there = runs.TrainingRun(tmp_path, {k: v for k, v in runs.read_facts(tmp_path).items() if k != "schema"})
    with pytest.raises(
        BadInput,
        match=r"another process trains in this folder: .*\(process \d+\) → wait for it, stop it, or name another --out",
    ):
        train(ant(), folder=tmp_path, steps=10, seed=3, settings=SMALL)
    there.close()
    assert train(ant(), folder=tmp_path, steps=10, seed=3, settings=SMALL).step == 10


def test_numbers_that_are_none_stop_the_training(tmp_path):
    class Broken(Reach):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            self.steps = getattr(self, "steps", 0) + 1
            return observation * (np.nan if self.steps > 20 else 1.0), reward, *rest

    with pytest.raises(BadInput, match="step 20 gave a reward or an observation that is no number"):
        train(Broken(), folder=tmp_path, steps=100, seed=0, settings=SMALL)


# -------------------------------------------------------------------------------------------------- the command line


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A robot's folder, and in it a run of the real command."""
    robot = create_robot(tmp_path_factory.mktemp("robots") / "my-ant")
    out = robot.path / "runs" / "sac"
    result = robot.path / "train.json"
    code = run_command(
        "train", "sac", "--robot", robot.path, "--steps", 220, "--learning-start", 200, "--dt", 0.02, "--seed", 1,
        "--out", out, "--json", result,
    )  # fmt: skip
    assert code == 0
    return robot, out, json.loads(result.read_text())


def test_train_and_eval_from_the_command_line(trained, tmp_path, capsys):
    robot, out, result = trained
    assert result["steps"] == 220
    assert result["seconds"] == pytest.approx(4.4)
    assert result["updates"] == 20
    assert (out / "learning_curve.csv").read_text().splitlines()[0] == "step,seconds,average_reward_m_s"
    assert [point.step for point in read_curve(out)] == [100, 200]
    assert (out / "learning_curve.png").stat().st_size > 5_000
    assert run_command("eval", out, "--seconds", 3, "--starts", 1, "--json", tmp_path / "eval.json") == 0
    measured = json.loads((tmp_path / "eval.json").read_text())
    assert measured["seconds"] == pytest.approx(3.0)
    assert measured["average_reward_m_s"] == pytest.approx(measured["plays"]["sampled"][0]["progress_m"] / 3.0)
    printed = capsys.readouterr()
    assert re.search(r"(?s)cm/s over 3 s.*policy of step 220", printed.out)
    assert "was never identified: this is the kit's nominal model" in printed.err
    # The same robot under another name: the policy's model is a file in it, its folder can move.
    assert run_command("eval", out, "--seconds", 1, "--starts", 1, "--robot", robot.path) == 0


def test_a_policy_does_not_play_where_its_numbers_mean_something_else(trained):
    robot, out, _ = trained
    for options, what in (
        ({"observation_order": "paper"}, "observation names"),
        ({"action_range": "sac"}, "action range"),
    ):
        with pytest.raises(BadInput, match=f"trained with other {what} than this environment has"):
            load_policy(out, gymnasium.make("openant/Ant-v0", robot=robot.path, **options))
    with pytest.raises(BadInput, match="its policy takes 24 observations and gives 8 actions, this robot has 1 and 1"):
        load_policy(out, Reach())


def test_commands_refuse_in_one_line(trained, tmp_path, capsys, monkeypatch):
    robot, out, _ = trained
    monkeypatch.chdir(tmp_path)
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    (damaged / "run.json").write_text((out / "run.json").read_text())
    other = create_robot(tmp_path / "other")
    other.update(effects=[EffectEntry("action_delay", ("knee_fl",), {"delay_s": 0.1})])
    cases = [
        (("train", "sac", "--out", "x"), "there is no robot.toml here"),
        (("train", "sac", "--robot", robot.path, "--env", "hardware", "--out", "x"), "nobody is there to ask"),
        (("train", "sac", "--robot", robot.path, "--env", "hardware", "--yes", "--out", "x"), "were never measured"),
        (("train", "sac", "--kit", "lite", "--env", "hardware", "--yes", "--out", "x"), "--kit is a simulated robot"),
        (("train", "sac", "--virtual", "--out", "x"), "--virtual is a robot behind its ports"),
        (("train", "sac", "--robot", robot.path, "--kit", "lite", "--out", "x"), "--robot and --kit name two robots"),
        (("train", "sac", "--kit", "lite", "--dt", 0.0005, "--out", "x"), "dt = 0.0005 s is no whole number"),
        (("train", "sac", "--robot", other.path, "--out", "x"), "the effect action_delay does not act as an entry"),
        (("train", "sac", "--robot", robot.path, "--seed", 2, "--out", out), "this folder holds another run"),
        (("train", "sac", "--robot", robot.path, "--env", "hardware", "--yes", "--out", out), "holds another run"),
        (("train", "sac", "--kit", "lite", "--device", "abacus", "--out", "x"), "torch cannot compute on abacus"),
        (("eval", tmp_path), "there is no training run here"),
        (("eval", out, "--seconds", 0), "Invalid value for '--seconds': 0.0 is not in the range"),
        (("eval", damaged), "there is no checkpoint yet"),
    ]
    for arguments, words in cases:
        assert run_command(*arguments) == 2, arguments
        printed = capsys.readouterr().err
        assert words in printed, arguments
        assert "Traceback" not in printed
    assert not (tmp_path / "x").exists()
    assert not (out / "log.csv").exists(), "what was refused is none of that run's"
    (damaged / "checkpoint.pt").write_bytes((out / "checkpoint.pt").read_bytes()[:1000])
    assert run_command("eval", damaged) == 2
    assert "the checkpoint cannot be read" in capsys.readouterr().err
    (damaged / "run.json").write_text("{")
    assert run_command("eval", damaged) == 2
    assert "this is not JSON" in capsys.readouterr().err


def test_tensorboard_events_are_written_when_asked_for(tmp_path):
    pytest.importorskip("tensorboard")
    train(Reach(), folder=tmp_path, steps=100, seed=0, settings=SMALL, tensorboard=True)
    assert list((tmp_path / "tensorboard").glob("events.out.tfevents.*"))


def test_without_torch_the_commands_say_what_to_install(monkeypatch, capsys):
    import importlib.util

    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "torch" else real(name, *rest))
    assert run_command("train", "sac", "--kit", "lite", "--out", "x") == 2
    assert "agents need torch, which is not installed → pip install 'openant-tools[agents]'" in capsys.readouterr().err


def test_a_curve_cut_by_a_crash_is_read_as_far_as_it_goes_and_drawn(tmp_path):
    text = "step,seconds,average_reward_m_s\n100,12.000,0.001\n200,24.000,0.002\n30"
    (tmp_path / "learning_curve.csv").write_text(text)
    points = read_curve(tmp_path)
    assert points == [CurvePoint(100, 12.0, 0.001), CurvePoint(200, 24.0, 0.002)]
    plot_curves({"one": points, "two": points}, tmp_path / "curve.png", learning_from_s=12.0)
    assert (tmp_path / "curve.png").stat().st_size > 5_000
    (tmp_path / "learning_curve.csv").write_text(text.replace("200,", "many,") + "0,36.0,0.003\n")
    with pytest.raises(BadInput, match="row 3 is not step, seconds, average_reward_m_s"):
        read_curve(tmp_path)
    with pytest.raises(BadInput, match="no points yet"):
        plot_curves({"none": []}, tmp_path / "none.png")
