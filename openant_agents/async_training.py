"""SAC on a robot that does not wait: this process acts, another one learns (`openant_agents.learner`).

Between an observation and its action lies nothing but the policy; the transition goes into the run's file, which is all
that the learner needs. So a run can be killed at any instant, either half of it, and goes on with every transition that
was made. What chance decides (exploration, batches) differs from run to run: `sac.train` is the exact form.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_agents.learner import Job, SharedWeights
from openant_agents.runs import has_checkpoint, making_sense
from openant_agents.sac import CURVE_EVERY, Sac, SacSettings, device_of, learned_by, one_thread, run_facts_of, sizes
from openant_agents.training import (
    Training,
    TrainingProgress,
    finite_or_raise,
    in_time_with,
    reset_or_stop,
    training_run,
)
from openant_tools.errors import BadInput, HardwareFault, StorageFault

__all__ = ["LearnerProcess", "train_async"]

Array = NDArray[np.float32]

#: torch takes seconds to load on a busy machine, and an hour's transitions to be read
START_TIMEOUT_S = 120.0
#: the learner finishes an update, saves and goes
END_TIMEOUT_S = 60.0
#: s between two words to the learner about how far the robot is
STATE_EVERY_S = 1.0


class LearnerProcess:
    """The learner from outside.

    Args:
        agent: whose actor's weights follow the learner's, newest first.

    Attributes:
        updates: behind the weights that were taken last.
    """

    def __init__(self, job: Job, agent: Sac) -> None:
        self._policy = agent.policy.detach().numpy()
        count = len(self._policy)
        self._shared = SharedWeights(count)
        self._version = 0
        self.updates = 0
        self._folder = job.folder
        ours, theirs = socket.socketpair()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "openant_agents.learner", str(theirs.fileno()), str(self._shared.fd)],
            pass_fds=(theirs.fileno(), self._shared.fd),
            start_new_session=True,
        )
        theirs.close()
        self._connection = Connection(ours.detach())
        self._connection.send((job, count))
        self._expect("ready", START_TIMEOUT_S)
        self.follow()

    def follow(self) -> None:
        """Take the newest weights, if there are newer ones; refuse to go on where nobody learns any more."""
        if self._connection.poll(0):
            self._hear()
        if self._shared.version == self._version:
            return
        self._version, self.updates = self._shared.take(self._policy), self._shared.updates

    def tell(self, state: Mapping[str, Any]) -> None:
        """How far the robot is, for the next checkpoint."""
        with contextlib.suppress(OSError):  # `follow` finds out why
            self._connection.send(("state", dict(state)))

    def end(self, state: Mapping[str, Any]) -> None:
        """Have it save and go."""
        with contextlib.suppress(OSError):
            self._connection.send(("end", dict(state)))
        try:
            self._expect("saved", END_TIMEOUT_S)
        finally:
            self.close()

    def close(self) -> None:
        """End it; it saves once it finds nobody there. May be called again."""
        if self._connection.closed:
            return
        self._connection.close()
        try:
            self._process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._shared.close()

    def _expect(self, what: str, timeout_s: float) -> None:
        give_up = time.monotonic() + timeout_s
        while time.monotonic() < give_up:
            if self._connection.poll(0.1) and self._hear() == what:
                return
        raise HardwareFault("the learner does not answer", where=self._folder, remedy="repeat the command: it goes on")

    def _hear(self) -> str:
        try:
            what, value = self._connection.recv()
        except (EOFError, OSError):
            code = self._process.wait(END_TIMEOUT_S)
            raise HardwareFault(
                f"the learner has died (exit status {code})",
                where=self._folder,
                remedy="repeat the command: every transition is kept",
            ) from None
        if what in ("error", "disk"):
            words, where, remedy = value
            raise (StorageFault if what == "disk" else BadInput)(words, where=where, remedy=remedy)
        self.updates = int(value)
        return str(what)


def train_async(
    env: gymnasium.Env[Any, Any],
    *,
    folder: Path,
    steps: int,
    seed: int,
    settings: SacSettings | None = None,
    updates_per_step: float = 1.0,
    env_facts: Mapping[str, Any] | None = None,
    source: Path | None = None,
    device: str = "cpu",
    tensorboard: bool = False,
    report: Callable[[TrainingProgress], None] | None = None,
) -> TrainingProgress:
    """As `sac.train`, with the updates in a process of their own.

    Args:
        updates_per_step: updates for each transition at most; a slow computer does fewer.

    Raises:
        BadInput: as `sac.train`.
        HardwareFault: the robot cannot go on, or the learner has died; the same call goes on from there.
        KeyboardInterrupt: asked for by SIGINT or SIGTERM; the run is saved.
    """
    settings = settings or SacSettings()
    observations, actions = sizes(env)
    # Its replay stays empty and its critics are not used: the learner has both.
    agent = Sac(observations, actions, replace(settings, buffer=1), seed=seed)
    facts = run_facts_of(env, settings, seed, env_facts, source) | {"learning": {"updates_per_step": updates_per_step}}
    device_of(device)
    source = None if has_checkpoint(folder) else source
    if source is not None:
        learned_by(source, env)  # refuses what does not suit, while nothing is begun
    with one_thread(), training_run(folder, facts, tensorboard) as (run, events, stop):
        # All that may be wrong in the folder shows before a learner starts.
        training = Training(env, run, steps, report, stop)
        checkpoint, rows = run.go_on(agent.replay.width)
        _remember(training, agent, checkpoint, rows)
        learner = LearnerProcess(
            Job(folder, settings, observations, actions, seed, device, updates_per_step, source), agent
        )
        try:
            acting = _Acting(training, agent, settings, learner, events)
            with in_time_with(env):
                acting.go(seed)
            learner.end(acting.state)
            return training.end(acting.learning, learner.updates)
        finally:
            learner.close()  # it saves what it has


def _remember(training: Training, agent: Sac, checkpoint: Mapping[str, Any] | None, rows: NDArray[np.float32]) -> None:
    """Go on behind every transition that was made."""
    at = agent.replay.observations + agent.replay.actions
    for reward, dt in rows[-20_000:, at : at + 2].tolist():  # more than a window holds
        training.average.add(reward, dt)
    training.seconds, training.step = float(rows[:, at + 1].sum(dtype=np.float64)), len(rows)
    if checkpoint is not None:
        with making_sense(training.run.folder):
            agent.begin_with(checkpoint["agent"])  # refuses other networks; chance is the learner's
            training.helped.update(checkpoint.get("helped", {}))
    # Chance goes on elsewhere than it began, or every resumed stretch would explore alike.
    agent.random = np.random.default_rng((agent.noise.initial_seed(), len(rows)))
    agent.noise.manual_seed(agent.noise.initial_seed() + len(rows))


class _Acting:
    """The acting half: observation, action, transition, again and again."""

    def __init__(
        self, training: Training, agent: Sac, settings: SacSettings, learner: LearnerProcess, events: Any
    ) -> None:
        self.training, self._agent, self._settings, self._learner = training, agent, settings, learner
        self._events = events
        self._row = np.empty(agent.replay.width, np.float32)

    @property
    def state(self) -> dict[str, Any]:
        """For the checkpoint."""
        training = self.training
        return {"step": training.step, "seconds": training.seconds, "helped": dict(training.helped)}

    @property
    def learning(self) -> bool:
        return self.training.step > self._settings.learning_start

    def go(self, seed: int) -> None:
        """Until the run is long enough, or someone wants it to stop."""
        training, agent, learner, settings = self.training, self._agent, self._learner, self._settings
        observation = training.set_up(seed)
        told = time.monotonic()
        while observation is not None and training.going:
            learner.follow()
            random = training.step < settings.learning_start and "from" not in training.run.facts
            action = agent.random_action() if random else agent.act(observation)
            seen, reward, terminated, truncated, info = training.env.step(action)
            finite_or_raise(seen, float(reward), training.step, training.run.folder)
            if not info.get("void", False):
                self._keep(observation, action, float(reward), float(info.get("dt", 1.0)), terminated, seen)
            training.late = int(info.get("overruns", 0))
            observation = seen
            if terminated or truncated:
                training.note_help(info)
                learner.tell(self.state)
                observation = reset_or_stop(training.env, None, training.stop)
            now = time.monotonic()
            if now - told > STATE_EVERY_S:
                told = now
                learner.tell(self.state)
            training.tell(self.learning, learner.updates)

    def _keep(self, observation: Array, action: Array, reward: float, dt: float, terminated: bool, seen: Array) -> None:
        training, row = self.training, self._row
        o, a = self._agent.replay.observations, self._agent.replay.actions
        row[:o], row[o : o + a], row[o + a + 3 :] = observation, action, seen
        row[o + a : o + a + 3] = reward, dt, terminated
        training.run.append(row)
        training.add(reward, dt)
        if training.step % CURVE_EVERY == 0:
            training.curve_point()
            if self._events is not None:
                self._events.add_scalar("average_reward_m_s", training.average.value, training.step)
                self._events.add_scalar("updates", self._learner.updates, training.step)
