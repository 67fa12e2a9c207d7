"""Scripts written for other toolkits train on our environments unchanged: Stable-Baselines3's, and CleanRL's way of a loop."""

from __future__ import annotations

import runpy
import sys

import gymnasium
import numpy as np
import pytest
from places import ROOT

torch = pytest.importorskip("torch")

import openant_env  # noqa: E402, F401

torch.set_num_threads(1)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_example_for_stable_baselines3_learns_evaluates_and_is_kept(tmp_path, capsys, monkeypatch):
    toolkit = pytest.importorskip("stable_baselines3")
    monkeypatch.setattr(sys, "argv", ["sb3.py", "200"])
    played = runpy.run_path(str(ROOT / "examples" / "sb3.py"), run_name="__main__")
    assert "after 200 steps: " in capsys.readouterr().out
    model, env = played["model"], played["env"]
    assert model.num_timesteps == 200
    assert len(model.ep_info_buffer) == 2  # SB3's own monitor saw our time limits
    model.save(tmp_path / "walker.zip")
    again = toolkit.SAC.load(tmp_path / "walker.zip")
    observation, _ = env.reset(seed=0)
    action, _ = again.predict(observation, deterministic=True)
    assert env.action_space.contains(action)


def test_a_loop_in_the_manner_of_cleanrl_learns_from_a_vector_of_environments():
    """Vectorised, episodes recorded, final observations taken from where Gymnasium puts them, one-file actor-critic."""

    def make(seed: int):
        def thunk():
            env = gymnasium.make("openant/Ant-v0", dt=0.02, time_limit_s=0.2)
            env = gymnasium.wrappers.RecordEpisodeStatistics(env)
            env.action_space.seed(seed)
            return env

        return thunk

    envs = gymnasium.vector.SyncVectorEnv([make(0), make(1)], autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP)
    assert isinstance(envs.single_action_space, gymnasium.spaces.Box)
    inputs, outputs = np.prod(envs.single_observation_space.shape), np.prod(envs.single_action_space.shape)
    actor = torch.nn.Sequential(torch.nn.Linear(int(inputs), 16), torch.nn.ReLU(), torch.nn.Linear(16, int(outputs)))
    critic = torch.nn.Linear(int(inputs + outputs), 1)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3)
    observations, _ = envs.reset(seed=0)
    episodes, losses = [], []
    for _ in range(40):
        seen = torch.as_tensor(observations)
        with torch.no_grad():
            actions = torch.tanh(actor(seen) + 0.1 * torch.randn(2, int(outputs))).numpy()
        following, rewards, terminations, truncations, infos = envs.step(actions)
        real = following.copy()
        if "final_obs" in infos:
            for index, ended in enumerate(infos["_final_obs"]):
                if ended:
                    real[index] = infos["final_obs"][index]
        if "final_info" in infos:
            episodes += [int(length) for length in infos["final_info"]["episode"]["l"] if length]
        with torch.no_grad():
            ahead = torch.as_tensor(real)
            target = torch.as_tensor(rewards, dtype=torch.float32) + 0.99 * (
                1.0 - torch.as_tensor(terminations, dtype=torch.float32)
            ) * critic(torch.cat([ahead, torch.tanh(actor(ahead))], 1)).squeeze(1)
        value = critic(torch.cat([seen, torch.as_tensor(actions)], 1)).squeeze(1)
        loss = ((value - target) ** 2).mean() - 0.01 * critic(torch.cat([seen, torch.tanh(actor(seen))], 1)).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
        assert not truncations.any() or "final_obs" in infos
        observations = following
    envs.close()
    assert np.isfinite(losses).all()
    assert set(episodes) == {10}
