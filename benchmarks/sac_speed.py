"""SAC updates a second, and the time of one action: python benchmarks/sac_speed.py

The yardstick is the same update (LayerNorm, float32, one thread, same sizes) in the usual structure: one optimiser step
and one target copy a tensor, critic gradients in the actor's step too, log π computed anew for the entropy. Both run by
turns in one process and are timed by the thread's own clock, so that a busy machine slows both alike. Without LayerNorm the
other side is Stable-Baselines3's SAC itself.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional as F

from openant_agents.sac import Actor, Critics, Sac, SacSettings

OBSERVATIONS, ACTIONS = 24, 8
ROUNDS, UPDATES = 12, 20
#: facts of the project: ratios with LayerNorm and without, µs of an action at the median and the 99th of a hundred
TARGET, TARGET_PLAIN, ACTION_US = 1.5, 1.4, (60, 120)


class Usual(Sac):
    """The same equations without any of the means that make them quick."""

    def __init__(self, settings: SacSettings) -> None:
        super().__init__(OBSERVATIONS, ACTIONS, settings, seed=0)
        self.actor = Actor(OBSERVATIONS, ACTIONS, settings)
        self.critics, self.targets = (Critics(OBSERVATIONS, ACTIONS, settings) for _ in range(2))
        self.targets.requires_grad_(False)
        self.usual_actor = torch.optim.Adam(self.actor.parameters(), lr=settings.actor_step)
        self.usual_critic = torch.optim.Adam(self.critics.parameters(), lr=settings.critic_step)
        self.entropy_optimiser = torch.optim.Adam([self.log_alpha], lr=settings.entropy_step)
        random = np.random.default_rng(0)
        widths = (OBSERVATIONS, ACTIONS, 1, 1, 1, OBSERVATIONS)
        self.columns = [random.normal(size=(4096, width)).astype(np.float32) for width in widths]

    def update(self) -> None:
        settings = self.settings
        rows = self.random.integers(0, len(self.columns[0]), settings.batch)
        parts = [torch.from_numpy(column[rows]) for column in self.columns]
        observation, action, reward, dt, terminated, next_observation = parts
        with torch.no_grad():
            next_action, next_log_pi = self.actor(next_observation, self._normal(settings.batch))
            value = torch.min(*self.targets(torch.cat([next_observation, next_action], 1)))
            value = value - self.log_alpha.exp() * next_log_pi
            discount = settings.gamma_per_s ** dt.flatten() * (1 - terminated.flatten())
            target = settings.reward_scale * reward.flatten() * dt.flatten() + discount * value
        first, second = self.critics(torch.cat([observation, action], 1))
        loss = F.mse_loss(first, target) + F.mse_loss(second, target)
        self.usual_critic.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.usual_critic.step()
        self.updates += 1
        if self.updates % settings.policy_every == 0:
            for _ in range(settings.policy_every):
                new, log_pi = self.actor(observation, self._normal(settings.batch))
                value = torch.min(*self.critics(torch.cat([observation, new], 1)))
                actor_loss = (self.log_alpha.exp().detach() * log_pi - value).mean()
                self.usual_actor.zero_grad()
                actor_loss.backward()
                self.usual_actor.step()
                with torch.no_grad():
                    _, log_pi = self.actor(observation, self._normal(settings.batch))
                entropy_loss = (-self.log_alpha.exp() * (log_pi + self.target_entropy)).mean()
                self.entropy_optimiser.zero_grad()
                entropy_loss.backward()
                self.entropy_optimiser.step()
        with torch.no_grad():
            for weight, target_weight in zip(self.critics.parameters(), self.targets.parameters(), strict=True):
                target_weight.copy_(settings.tau * weight + (1 - settings.tau) * target_weight)


def learner(settings: SacSettings) -> Sac:
    """Ours, with something to learn from."""
    agent = Sac(OBSERVATIONS, ACTIONS, settings, seed=0)
    agent.replay.restore(np.random.default_rng(0).normal(size=(4096, agent.replay.width)).astype(np.float32), 4096)
    return agent


def stable_baselines() -> Callable[[], object]:
    """One update of Stable-Baselines3's SAC, of the same sizes; it has no LayerNorm."""
    import gymnasium
    from stable_baselines3 import SAC
    from stable_baselines3.common.logger import Logger

    class Nothing(gymnasium.Env):  # type: ignore[misc]
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATIONS,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)

    model = SAC(
        "MlpPolicy", Nothing(), buffer_size=4096, batch_size=256, device="cpu", policy_kwargs={"net_arch": [256, 256]}
    )
    model.set_logger(Logger(None, []))
    random = np.random.default_rng(0)
    assert model.replay_buffer is not None
    for _ in range(4096):
        seen, then = random.normal(size=(2, 1, OBSERVATIONS)).astype(np.float32)
        action = random.uniform(-1, 1, (1, ACTIONS)).astype(np.float32)
        model.replay_buffer.add(seen, then, action, np.zeros(1, np.float32), np.zeros(1, bool), [{}])
    return lambda: model.train(gradient_steps=1, batch_size=256)


def timed(work: Callable[[], object], times: int) -> float:
    """s of the processor that one call takes."""
    began = time.thread_time()
    for _ in range(times):
        work()
    return (time.thread_time() - began) / times


def compared(
    ours: Callable[[], object], theirs: Callable[[], object], rounds: int = ROUNDS
) -> tuple[float, float, float]:
    """Calls a second of ours and theirs at best, by turns, and the median of the turns' ratios."""
    pairs = [(timed(ours, UPDATES), timed(theirs, UPDATES)) for _ in range(rounds)]
    best = [1.0 / min(each) for each in zip(*pairs, strict=True)]
    return best[0], best[1], statistics.median(their / our for our, their in pairs)


def action_us(agent: Sac) -> tuple[float, float]:
    """µs of one action from one observation, median and 99th of a hundred."""
    observation = np.random.default_rng(0).normal(size=OBSERVATIONS).astype(np.float32)
    taken = [1e6 * timed(lambda: agent.act(observation), 1) for _ in range(3000)]
    return float(np.median(taken)), float(np.percentile(taken, 99))


def main() -> None:
    torch.set_num_threads(1)
    settings = SacSettings(buffer=4096)
    ours = learner(settings)
    mine, theirs, ratio = compared(ours.update, Usual(settings).update)
    print(f"updates/s: ours {mine:.0f}, usual structure {theirs:.0f}, ratio {ratio:.2f} (target {TARGET})")
    plain = learner(replace(settings, layer_norm=False))
    mine, theirs, ratio = compared(plain.update, stable_baselines())
    print(
        f"without LayerNorm: ours {mine:.0f}, Stable-Baselines3 {theirs:.0f}, ratio {ratio:.2f} (target {TARGET_PLAIN})"
    )
    median, p99 = action_us(ours)
    print(f"one action: median {median:.0f} µs, p99 {p99:.0f} µs (target {ACTION_US[0]} and {ACTION_US[1]})")


if __name__ == "__main__":
    main()
