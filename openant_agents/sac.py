"""Soft actor-critic as the Open Ant paper uses it, in one file to be read from top to bottom.

What the paper adds to the common form (Haarnoja et al. 2018, automatic entropy; CleanRL's structure): LayerNorm before
every ReLU, rewards scaled by 100, learning that starts after 2,000 random steps, and a return that does not depend on
the length of a step (De Asis and Sutton 2024, arXiv 2406.14951):

    target = scale · r · Δt + γ_s^Δt · (min Q'(s', a') − α log π(a'|s')),    a' ~ π(s'),

with γ_s = 0.92 per second, which at Δt = 0.12 s is the paper's 0.99 a step. The paper cites the idea without a formula;
this form, reward times Δt included, is that of the platform's published agent. Each transition carries its own Δt.

The task has no episodes. A termination cuts the bootstrap, a truncation (someone had to help the robot) does not.

Updates are plain torch on one thread: the matrices are too small for two. What makes them quick: all weights of a network
in one vector, so that Adam (fused) and the targets take one call each; no gradients for the critics' weights while the actor
learns; log π computed once for actor and entropy; and transitions kept as rows of one array, so that a batch is one gather.
The losses stand here as autograd takes them (`Autograd`); on a processor `openant_agents.by_hand` has the same derivatives
written out, a tenth quicker.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from openant_agents.adam import Adam
from openant_agents.by_hand import Gradients, acting, flatten, squashed
from openant_agents.runs import has_checkpoint, load_checkpoint, making_sense, read_facts
from openant_agents.training import (
    Training,
    TrainingProgress,
    check_trained_on,
    described,
    finite_or_raise,
    reset_or_stop,
    run_facts,
    training_run,
)
from openant_tools.errors import BadInput, HardwareFault

__all__ = [
    "Actor", "Critics", "Replay", "Sac", "SacSettings", "device_of", "load_policy", "one_thread",
    "run_facts_of", "sizes", "train",
]  # fmt: skip

Array = NDArray[np.float32]


@dataclass(frozen=True)
class SacSettings:
    """The paper's parameters of SAC (its table of parameters, and CleanRL's defaults where it names none).

    Attributes:
        gamma_per_s: discount of a second; of a step of Δt seconds γ_s^Δt.
        tau: share of the critics that goes into the targets with every update.
        batch: transitions in an update.
        buffer: transitions kept.
        learning_start: steps with random actions before the first update.
        reward_scale: factor on rewards, which are metres.
        actor_step, critic_step, entropy_step: step sizes of Adam.
        entropy_start: the entropy's weight α before it is learned. From 1 it takes some 4,000 updates to where the
            rewards of walking count; from 0.1 an agent explores less widely and walks sooner.
        policy_every: critic updates between visits to the actor, which is then updated as many times.
        hidden: width of both hidden layers.
        layer_norm: whether layers are normalised before each ReLU.
    """

    gamma_per_s: float = 0.92
    tau: float = 0.005
    batch: int = 256
    buffer: int = 1_000_000
    learning_start: int = 2_000
    reward_scale: float = 100.0
    actor_step: float = 3e-4
    critic_step: float = 1e-3
    entropy_step: float = 1e-3
    entropy_start: float = 1.0
    policy_every: int = 2
    hidden: int = 256
    layer_norm: bool = True

    def as_dict(self) -> dict[str, float | int | bool]:
        return asdict(self)


# --------------------------------------------------------------------------------------------------------- networks

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0


def _network(inputs: int, outputs: int, settings: SacSettings) -> nn.Sequential:
    """Two hidden layers, each normalised before its ReLU."""
    layers: list[nn.Module] = []
    for size in (inputs, settings.hidden):
        layers.append(nn.Linear(size, settings.hidden))
        if settings.layer_norm:
            layers.append(nn.LayerNorm(settings.hidden))
        layers.append(nn.ReLU(inplace=True))
    return nn.Sequential(*layers, nn.Linear(settings.hidden, outputs))


class Actor(nn.Module):
    """A tanh-squashed Gaussian policy: mean and standard deviation of each action from an observation."""

    def __init__(self, observations: int, actions: int, settings: SacSettings) -> None:
        super().__init__()
        self.network = _network(observations, 2 * actions, settings)

    def forward(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Sample by reparametrisation.

        Args:
            observation: (batch, observations).
            noise: (batch, actions), standard normal.

        Returns:
            Actions in −1…1, (batch, actions), and their log π, (batch,).
        """
        mean, log_std = self._gaussian(observation)
        u = mean + log_std.exp() * noise
        log_gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
        # log(1 − tanh²u) = 2 (log 2 − u − softplus(−2u)), which does not cancel where tanh saturates.
        log_slope = 2.0 * (math.log(2.0) - u - F.softplus(-2.0 * u))
        return torch.tanh(u), (log_gaussian - log_slope).sum(-1)

    def mode(self, observation: Tensor) -> Tensor:
        """The action in the middle of the distribution, (batch, actions)."""
        return torch.tanh(self._gaussian(observation)[0])

    def _gaussian(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        mean, spread = self.network(observation).chunk(2, dim=-1)
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (torch.tanh(spread) + 1.0)
        return mean, log_std


class Critics(nn.Module):
    """Two action-value functions of their own; the smaller estimate counts."""

    def __init__(self, observations: int, actions: int, settings: SacSettings) -> None:
        super().__init__()
        self.first = _network(observations + actions, 1, settings)
        self.second = _network(observations + actions, 1, settings)

    def forward(self, observation_action: Tensor) -> tuple[Tensor, Tensor]:
        """Both values, each (batch,), of rows that hold an observation followed by an action."""
        return self.first(observation_action).squeeze(-1), self.second(observation_action).squeeze(-1)


# ----------------------------------------------------------------------------------------------------------- replay


class Replay:
    """Transitions as rows of one array: observation, action, reward, Δt, terminated, next observation.

    The array is a ring of `capacity` rows; its memory is claimed by the operating system only as rows are written.
    """

    def __init__(self, observations: int, actions: int, capacity: int) -> None:
        self.observations, self.actions, self.capacity = observations, actions, capacity
        self.width = 2 * observations + actions + 3
        self.rows = np.empty((capacity, self.width), np.float32)
        self.added = 0  # ever; row k stands at k modulo capacity
        self._tensor = torch.from_numpy(self.rows)

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def add(
        self, observation: Array, action: Array, reward: float, dt: float, terminated: bool, next_observation: Array
    ) -> None:
        row = self.rows[self.added % self.capacity]
        o, a = self.observations, self.actions
        row[:o] = observation
        row[o : o + a] = action
        row[o + a] = reward
        row[o + a + 1] = dt
        row[o + a + 2] = terminated
        row[o + a + 3 :] = next_observation
        self.added += 1

    def extend(self, rows: Array) -> None:
        """Add whole rows, (n, width), oldest first; n is at most the capacity."""
        self.rows[np.arange(self.added, self.added + len(rows)) % self.capacity] = rows
        self.added += len(rows)

    def sample(self, size: int, random: np.random.Generator) -> Tensor:
        """(size, width), drawn with replacement."""
        return self._tensor.index_select(0, torch.from_numpy(random.integers(0, len(self), size)))

    def between(self, start: int, stop: int) -> Array:
        """The rows added as number `start` up to `stop`, oldest first; only the last `capacity` can be had."""
        return self.rows[np.arange(start, stop) % self.capacity]

    def restore(self, rows: Array, added: int) -> None:
        """Fill with the last rows of `added` ever added, so that each stands where it stood."""
        self.rows[np.arange(added - len(rows), added) % self.capacity] = rows
        self.added = added


# ------------------------------------------------------------------------------------------------------------ agent


class Autograd:
    """The gradients of both losses, by torch; `by_hand.Gradients` has the same derivatives written out."""

    def __init__(self, actor: Actor, critics: Critics, targets: Critics) -> None:
        self._actor, self._critics, self._targets = actor, critics, targets
        self._actor_weights: list[Tensor] = list(actor.parameters())

    def sample(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (batch, actions) and their log π (batch,)."""
        sampled: tuple[Tensor, Tensor] = self._actor(observation, noise)
        return sampled

    def value(self, observation: Tensor, action: Tensor) -> Tensor:
        """(batch,), the smaller of the targets' values."""
        return torch.minimum(*self._targets(torch.cat((observation, action), dim=1)))

    @torch.enable_grad()
    def critics(self, observation_action: Tensor, target: Tensor) -> Tensor:
        """Gradients of the mean squared errors of both critics; their sum."""
        first, second = self._critics(observation_action)
        loss = F.mse_loss(first, target) + F.mse_loss(second, target)
        self._critics.zero_grad(set_to_none=False)
        loss.backward()  # type: ignore[no-untyped-call]
        return loss.detach()

    @torch.enable_grad()
    def actor(self, observation: Tensor, noise: Tensor, alpha: Tensor) -> Tensor:
        """Gradients of the mean of α log π − min Q; log π (batch,)."""
        action, log_pi = self._actor(observation, noise)
        value = torch.minimum(*self._critics(torch.cat((observation, action), dim=1)))
        loss: Tensor = (alpha * log_pi - value).mean()
        self._actor.zero_grad(set_to_none=False)
        # Only the actor's weights: the critics' would cost a third more and be thrown away.
        loss.backward(inputs=self._actor_weights)  # type: ignore[no-untyped-call]
        result: Tensor = log_pi.detach()
        return result


class Sac:
    """Actor, critics, their targets and the entropy's weight, with the update that ties them.

    Args:
        observations, actions: how many numbers each has.
        settings: parameters of the algorithm.
        seed: of initial weights, random actions, exploration noise and batches.
        device: where networks live.
        by_hand: whether gradients are computed as written out, where networks live on a processor, or by autograd.

    Attributes:
        policy: (weights,) of the actor, one vector of which its layers' are views.
    """

    def __init__(
        self,
        observations: int,
        actions: int,
        settings: SacSettings,
        *,
        seed: int,
        device: str | torch.device = "cpu",
        by_hand: bool = True,
    ) -> None:
        self.settings = settings
        self.device = torch.device(device)
        self.random = np.random.default_rng(seed)
        self.noise = torch.Generator(self.device)
        self.noise.manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            # torch's layers draw their weights from its global generator, which is left as it was found.
            torch.manual_seed(seed)
            self.actor = Actor(observations, actions, settings).to(self.device)
            self.critics = Critics(observations, actions, settings).to(self.device)
            self.targets = Critics(observations, actions, settings).to(self.device)
        self.targets.load_state_dict(self.critics.state_dict())
        self.targets.requires_grad_(False)
        self.log_alpha = torch.tensor(math.log(settings.entropy_start), device=self.device, requires_grad=True)
        self.target_entropy = -float(actions)
        self.policy, self._critic_weights = flatten(self.actor), flatten(self.critics)
        self._target_weights = flatten(self.targets)
        self.critic_optimiser = Adam((self._critic_weights, settings.critic_step))
        self.actor_optimiser = Adam((self.policy, settings.actor_step), (self.log_alpha, settings.entropy_step))
        self.replay = Replay(observations, actions, settings.buffer)
        self.updates = 0
        self._critic_loss = torch.zeros(())
        on_processor = self.device.type == "cpu"
        self._by_hand = by_hand and on_processor
        self._gradients: Autograd | Gradients | None = None  # their memory is for those who learn
        self._think = acting(self.actor.network) if on_processor else None
        if self._think is not None:
            self.act(np.zeros(observations, np.float32))  # compiles, before a robot waits
            self.noise.manual_seed(seed)

    def random_action(self) -> Array:
        """(actions,), uniform in −1…1."""
        return self.random.uniform(-1.0, 1.0, self.replay.actions).astype(np.float32)

    def begin_chance(self, seed: int) -> None:
        """Draw exploration noise from its beginning by this seed."""
        self.noise.manual_seed(seed)

    def act(self, observation: Array, *, explore: bool = True) -> Array:
        """(actions,): a sample of the policy, or its mode."""
        if self._think is not None:
            thought = self._think(np.asarray(observation, np.float32))
            if explore:
                return squashed(thought, self._normal(1)[0].numpy(), LOG_STD_MIN, LOG_STD_MAX)
            return np.tanh(thought[: self.replay.actions])
        with torch.inference_mode():
            seen = torch.from_numpy(observation).to(self.device).unsqueeze(0)
            action = self.actor(seen, self._normal(1))[0] if explore else self.actor.mode(seen)
            result: Array = action.squeeze(0).cpu().numpy()
        return result

    def update(self) -> None:
        """One update of the critics and their targets; every `policy_every` times as many of actor and entropy."""
        # Inference mode spares torch keeping count of changes; autograd cannot work within it.
        with torch.inference_mode() if self._by_hand else torch.no_grad():
            self._update()

    def _update(self) -> None:
        settings, replay = self.settings, self.replay
        o, a = replay.observations, replay.actions
        batch = replay.sample(settings.batch, self.random).to(self.device)
        observation, next_observation = batch[:, :o], batch[:, o + a + 3 :]
        reward, dt, terminated = batch[:, o + a], batch[:, o + a + 1], batch[:, o + a + 2]
        gradients = self._gradients = self._gradients or self._make_gradients()

        next_action, next_log_pi = gradients.sample(next_observation, self._normal(settings.batch))
        value = gradients.value(next_observation, next_action) - self.log_alpha.exp() * next_log_pi
        discount = torch.pow(settings.gamma_per_s, dt) * (1.0 - terminated)
        target = settings.reward_scale * reward * dt + discount * value
        self._critic_loss = gradients.critics(batch[:, : o + a], target)
        self.critic_optimiser.step()
        self.updates += 1

        if self.updates % settings.policy_every == 0:
            for _ in range(settings.policy_every):
                alpha = self.log_alpha.exp()
                log_pi = gradients.actor(observation, self._normal(settings.batch), alpha)
                # The entropy's loss is −α (log π + H) on average, α = exp(log α).
                self.log_alpha.grad = -alpha * (log_pi.mean() + self.target_entropy)
                self.actor_optimiser.step()

        self._target_weights.lerp_(self._critic_weights, settings.tau)

    def _make_gradients(self) -> Autograd | Gradients:
        if not self._by_hand:
            return Autograd(self.actor, self.critics, self.targets)
        return Gradients(
            self.actor.network, (self.critics.first, self.critics.second), (self.targets.first, self.targets.second),
            batch=self.settings.batch, observations=self.replay.observations, log_std=(LOG_STD_MIN, LOG_STD_MAX),
        )  # fmt: skip

    def sound_or_raise(self, folder: Path) -> None:
        """Refuse to go on with what has come apart; the last checkpoint has not.

        Raises:
            BadInput: weights or the critics' loss are no finite numbers any more.
        """
        with torch.no_grad():
            total = sum(weight.square().sum() for weight in self.actor.parameters()) + self.log_alpha.exp()
        if not torch.isfinite(total + self._critic_loss.to(self.device)):
            raise BadInput(
                f"weights or losses are no finite numbers any more after {self.updates} updates",
                where=folder,
                remedy="the last checkpoint is sound; look at rewards and observations in transitions.f32",
            )

    def _normal(self, rows: int) -> Tensor:
        return torch.randn(rows, self.replay.actions, generator=self.noise, device=self.device)

    # ------------------------------------------------------------------------------------------------- going on

    def get_state(self) -> dict[str, Any]:
        """Everything but the replay's rows, as tensors and plain values."""
        return {
            "actor": self.actor.state_dict(),
            "critics": self.critics.state_dict(),
            "targets": self.targets.state_dict(),
            "log_alpha": self.log_alpha.detach(),
            "actor_optimiser": self.actor_optimiser.state_dict(),
            "critic_optimiser": self.critic_optimiser.state_dict(),
            "noise": self.noise.get_state(),
            "random": self.random.bit_generator.state,
            "updates": self.updates,
        }

    def begin_with(self, state: Mapping[str, Any]) -> None:
        """Take over what another agent has learned; chance, updates and transitions are this one's own.

        Raises:
            BadInput: it is of other networks, or of an earlier version of this software.
        """
        try:
            for name in ("actor", "critics", "targets", "actor_optimiser", "critic_optimiser"):
                getattr(self, name).load_state_dict(state[name])
        except (KeyError, RuntimeError, ValueError) as error:
            raise BadInput(
                "what was saved is of an agent with other networks, or an earlier version wrote it",
                remedy="train into another folder, with the settings of the run that it begins with",
            ) from error
        with torch.no_grad():
            self.log_alpha.copy_(state["log_alpha"])

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on where `get_state` was called; the replay is restored apart from this.

        Raises:
            BadInput: it is of other networks, or of an earlier version of this software.
        """
        self.begin_with(state)
        self.noise.set_state(state["noise"].cpu())
        self.random.bit_generator.state = state["random"]
        self.updates = int(state["updates"])


# ---------------------------------------------------------------------------------------------------------- training

#: steps between points of the learning curve
CURVE_EVERY = 100


def run_facts_of(
    env: gymnasium.Env[Any, Any],
    settings: SacSettings,
    seed: int,
    env_facts: Mapping[str, Any] | None,
    source: Path | None = None,
) -> dict[str, Any]:
    """What `run.json` says of a run of SAC."""
    versions = {"torch": torch.__version__}
    return run_facts("sac", env, settings.as_dict(), seed, env_facts, sizes(env), versions, source)


@contextmanager
def one_thread() -> Iterator[None]:
    """Have torch compute on one thread: the matrices are too small for two."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def train(
    env: gymnasium.Env[Any, Any],
    *,
    folder: Path,
    steps: int,
    seed: int,
    settings: SacSettings | None = None,
    env_facts: Mapping[str, Any] | None = None,
    source: Path | None = None,
    device: str = "cpu",
    tensorboard: bool = False,
    report: Callable[[TrainingProgress], None] | None = None,
) -> TrainingProgress:
    """Train on one environment, or go on with the run that the folder holds.

    Args:
        env: observations a vector, actions a vector in −1…1. Where it has `get_state` and `set_state`, a resumed run is
            equal to one that was never stopped, bit for bit; else a resumed run begins with a reset.
        folder: for everything the run leaves behind (`openant_agents.runs`).
        steps: until the run is this long, steps of earlier calls included.
        seed: of the agent and of the first reset.
        settings: the paper's by default.
        env_facts: how to make the environment again, for `run.json`.
        source: another run, whose policy acts from the first step on, in place of chance, and learns on from there.
        device: where torch computes; acting and learning on `"cpu"` take one thread.
        tensorboard: also write the learning curve and α as TensorBoard events into the folder.
        report: called a few times a second.

    Raises:
        BadInput: the folder holds another run, the environment does not suit, or a number that is none came up.
        HardwareFault: the robot cannot go on; the run is saved.
        KeyboardInterrupt: asked for by SIGINT or SIGTERM; the run is saved and goes on with the same call.
    """
    settings = settings or SacSettings()
    observations, actions = sizes(env)
    agent = Sac(observations, actions, settings, seed=seed, device=device_of(device))
    facts = run_facts_of(env, settings, seed, env_facts, source)
    learned = None if source is None or has_checkpoint(folder) else learned_by(source, env)
    with one_thread(), training_run(folder, facts, tensorboard) as (run, events, stop):
        return _train(Training(env, run, steps, report, stop), agent, seed, events, learned)


def _train(
    training: Training, agent: Sac, seed: int, events: Any, learned: Mapping[str, Any] | None
) -> TrainingProgress:
    env, run, settings, replay = training.env, training.run, agent.settings, agent.replay
    observation = training.begin(seed)
    checkpoint = run.resume()
    if learned is not None:
        agent.begin_with(learned)
    if checkpoint is not None:
        with making_sense(run.folder):
            agent.set_state(checkpoint["agent"])
            replay.restore(run.transitions(replay.width, replay.capacity), int(checkpoint["transitions"]))
            before = training.restore(checkpoint)
            observation = observation if before is None else before
    saved = replay.added

    def save() -> None:
        nonlocal saved
        agent.sound_or_raise(run.folder)
        run.save(training.state(observation) | {"agent": agent.get_state()}, replay.between(saved, replay.added))
        saved, training.saved_at = replay.added, time.monotonic()

    while training.going:
        random = training.step < settings.learning_start and "from" not in run.facts
        action = agent.random_action() if random else agent.act(observation)
        try:
            next_observation, reward, terminated, truncated, info = env.step(action)
        except HardwareFault:
            save()  # what was learned until the robot could not go on
            raise
        reward = float(reward)
        finite_or_raise(next_observation, reward, training.step, run.folder)
        dt = float(info.get("dt", 1.0))
        void = bool(info.get("void", False))
        if not void:
            replay.add(observation, action, reward, dt, terminated, next_observation)
            training.add(reward, dt)
        training.late = int(info.get("overruns", 0))
        observation = next_observation
        if terminated or truncated:
            training.note_help(info)
            try:
                begun = reset_or_stop(env, None, training.stop)
            except HardwareFault:
                save()
                raise
            observation = observation if begun is None else begun
        learning = training.step > settings.learning_start
        if not void and learning:
            agent.update()
        if not void and training.step % CURVE_EVERY == 0:
            agent.sound_or_raise(run.folder)
            training.curve_point()
            if events is not None:
                events.add_scalar("average_reward_m_s", training.average.value, training.step)
                events.add_scalar("alpha", agent.log_alpha.exp().item(), training.step)
        # Rows of a full ring are overwritten by and by: save them before that, however little time has passed.
        if training.save_is_due or replay.added - saved >= replay.capacity:
            save()
        training.tell(learning, agent.updates)
    save()
    return training.end(training.step > settings.learning_start, agent.updates)


def load_policy(folder: Path, env: gymnasium.Env[Any, Any]) -> tuple[Sac, int]:
    """The agent of a run, ready to act in an environment, and the step it was saved at.

    Raises:
        BadInput: no such run, or one whose observations or actions are not the environment's.
    """
    facts, checkpoint = _of_run(folder, env)
    with making_sense(folder):
        settings = SacSettings(**{**facts["settings"], "buffer": 1})
        agent = Sac(facts["observations"], facts["actions"], settings, seed=int(facts["seed"]))
        agent.actor.load_state_dict(checkpoint["agent"]["actor"])
        return agent, int(checkpoint["step"])


def learned_by(folder: Path, env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """What the agent of a run has learned, as `Sac.begin_with` takes it.

    Raises:
        BadInput: no such run, or one whose observations or actions are not the environment's.
    """
    state: dict[str, Any] = _of_run(folder, env)[1]["agent"]
    return state


def _of_run(folder: Path, env: gymnasium.Env[Any, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Facts and checkpoint of a run of SAC that suits an environment."""
    with making_sense(folder):
        facts = read_facts(folder)
        if facts["agent"] != "sac":
            raise BadInput(
                f"it is a run of {facts['agent']}, not of sac", where=folder, remedy="name a run of `openant train sac`"
            )
        observations, actions = sizes(env)
        if (facts["observations"], facts["actions"]) != (observations, actions):
            raise BadInput(
                f"its policy takes {facts['observations']} observations and gives {facts['actions']} actions, "
                f"this robot has {observations} and {actions}",
                where=folder,
                remedy="play it on a robot like the one it was trained on",
            )
        check_trained_on(facts, described(env), ("observation_names", "action_names", "action_range"), folder)
        return facts, load_checkpoint(folder)


def device_of(name: str) -> torch.device:
    """Where torch is to compute.

    Raises:
        BadInput: it cannot.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0][:120]
        raise BadInput(f"torch cannot compute on {name}: {reason}", remedy="use --device cpu") from error
    return device


def sizes(env: gymnasium.Env[Any, Any]) -> tuple[int, int]:
    """How many numbers an observation and an action have.

    Raises:
        BadInput: they are no vectors, or actions do not go from −1 to 1.
    """
    observation, action = env.observation_space, env.action_space
    box = gymnasium.spaces.Box
    if not (isinstance(observation, box) and len(observation.shape) == 1):
        raise BadInput(f"observations are {observation}, not a vector", remedy="wrap it in FlattenObservation")
    if not (
        isinstance(action, box) and len(action.shape) == 1 and (action.low == -1).all() and (action.high == 1).all()
    ):
        raise BadInput(f"actions are {action}, not a vector in −1…1", remedy="wrap it in RescaleAction")
    return observation.shape[0], action.shape[0]
