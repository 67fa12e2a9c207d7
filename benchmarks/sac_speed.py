"""SAC updates a second, and the time of one action: python benchmarks/sac_speed.py

The yardstick is the same update (LayerNorm, float32, one thread, same sizes) in the usual structure: one optimiser step
and one target copy a tensor, critic gradients in the actor's step too, log π computed anew for the entropy. Both run by
turns in one process and are timed by the thread's own clock, so that a busy machine slows both alike.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from torch.nn import functional as F

from openant_agents.sac import Actor, Critics, Sac, Settings

OBSERVATIONS, ACTIONS = 24, 8
ROUNDS, UPDATES = 12, 20
TARGET = 1.5


class Usual(Sac):
    """The same equations without any of the means that make them quick."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(OBSERVATIONS, ACTIONS, settings, seed=0)
        self.actor = Actor(OBSERVATIONS, ACTIONS, settings)
        self.critics, self.targets = (Critics(OBSERVATIONS, ACTIONS, settings) for _ in range(2))
        self.targets.requires_grad_(False)
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), lr=settings.actor_step)
        self.critic_optimiser = torch.optim.Adam(self.critics.parameters(), lr=settings.critic_step)
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
        self.critic_optimiser.zero_grad()
        loss.backward()
        self.critic_optimiser.step()
        self.updates += 1
        if self.updates % settings.policy_every == 0:
            for _ in range(settings.policy_every):
                new, log_pi = self.actor(observation, self._normal(settings.batch))
                value = torch.min(*self.critics(torch.cat([observation, new], 1)))
                actor_loss = (self.log_alpha.exp().detach() * log_pi - value).mean()
                self.actor_optimiser.zero_grad()
                actor_loss.backward()
                self.actor_optimiser.step()
                with torch.no_grad():
                    _, log_pi = self.actor(observation, self._normal(settings.batch))
                entropy_loss = (-self.log_alpha.exp() * (log_pi + self.target_entropy)).mean()
                self.entropy_optimiser.zero_grad()
                entropy_loss.backward()
                self.entropy_optimiser.step()
        with torch.no_grad():
            for weight, target_weight in zip(self.critics.parameters(), self.targets.parameters(), strict=True):
                target_weight.copy_(settings.tau * weight + (1 - settings.tau) * target_weight)


def timed(work: Callable[[], object], times: int) -> float:
    began = time.thread_time()
    for _ in range(times):
        work()
    return (time.thread_time() - began) / times


def main() -> None:
    torch.set_num_threads(1)
    settings = Settings(buffer=4096)
    random = np.random.default_rng(0)
    ours, usual = Sac(OBSERVATIONS, ACTIONS, settings, seed=0), Usual(settings)
    ours.replay.restore(random.normal(size=(4096, ours.replay.width)).astype(np.float32), 4096)
    times: dict[str, list[float]] = {"ours": [], "usual": []}
    for _ in range(ROUNDS):
        times["ours"].append(timed(ours.update, UPDATES))
        times["usual"].append(timed(usual.update, UPDATES))
    ratio = statistics.median(u / o for u, o in zip(times["usual"], times["ours"], strict=True))
    print(f"updates/s: ours {1 / min(times['ours']):.0f}, usual structure {1 / min(times['usual']):.0f}")
    print(f"ratio {ratio:.2f} (target {TARGET})")
    observation = random.normal(size=OBSERVATIONS).astype(np.float32)
    one = sorted(timed(lambda: ours.act(observation), 1) for _ in range(2000))
    print(f"one action: median {1e6 * one[1000]:.0f} µs, p99 {1e6 * one[1980]:.0f} µs")


if __name__ == "__main__":
    main()
