"""SAC's updates in a process of their own, so that computing does not eat the time from observation to action.

Run as `python -m openant_agents.learner`, by `openant_agents.async_training`. What it learns from is the run's own file of
transitions, which the acting process appends to; what it gives back are the actor's weights, in shared memory. It alone
writes checkpoints. When the acting process dies, its last transitions are in the file: they are learned from, saved,
and nothing is lost.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from openant_agents.runs import has_checkpoint, load_checkpoint, save_checkpoint
from openant_agents.sac import Sac, SacSettings
from openant_agents.training import CHECKPOINT_EVERY_S
from openant_tools.errors import OpenAntError
from openant_tools.files import shared_memory

__all__ = ["Job", "SharedWeights", "main"]

Array = NDArray[np.float32]

#: what the engine, the acting process and a virtual robot need comes first
NICE = 10
#: s between two looks at the file while there is nothing to learn
IDLE_S = 0.01
_HEADER = 64


@dataclass(frozen=True)
class Job:
    """What is to be learned.

    Attributes:
        folder: the run's.
        settings, observations, actions, seed, device: of the agent.
        updates_per_step: at most so many for each transition, on average.
        source: the run whose agent it begins with; None: with nothing.
    """

    folder: Path
    settings: SacSettings
    observations: int
    actions: int
    seed: int
    device: str
    updates_per_step: float
    source: Path | None = None


class SharedWeights:
    """The actor's weights between two processes: one writes, the other takes the newest whole set.

    There are two places; the writer fills the one that is not the newest, then says so. A reader that was overtaken while
    copying copies again.

    Attributes:
        fd: the file descriptor to hand to the other process.
    """

    def __init__(self, count: int, fd: int | None = None) -> None:
        self.fd, self._map = shared_memory(_HEADER + 2 * 4 * count, fd)
        self._numbers = np.frombuffer(self._map, np.uint64, 2)  # version, updates
        self._places = np.frombuffer(self._map, np.float32, 2 * count, _HEADER).reshape(2, count)

    @property
    def version(self) -> int:
        """How often weights were published; 0 for never."""
        return int(self._numbers[0])

    @property
    def updates(self) -> int:
        """Updates behind the newest weights."""
        return int(self._numbers[1])

    def publish(self, weights: Array, updates: int) -> None:
        """Make (count,) weights the newest."""
        version = self.version + 1
        self._places[version % 2] = weights
        self._numbers[1] = updates
        self._numbers[0] = version

    def take(self, out: Array) -> int:
        """Copy the newest into `out`; their version."""
        while True:
            version = self.version
            out[:] = self._places[version % 2]
            if self.version == version:
                return version

    def close(self) -> None:
        del self._numbers, self._places
        self._map.close()
        os.close(self.fd)


class _Stopped(Exception):
    """The acting process has ended, or said so."""


class Learner:
    """Reads transitions, updates, publishes, saves.

    Args:
        job: what to learn.
        connection: to the acting process.
        weights: where it looks for new ones.
    """

    def __init__(self, job: Job, connection: Connection, weights: SharedWeights) -> None:
        self._job, self._connection, self._weights = job, connection, weights
        self._agent = Sac(job.observations, job.actions, job.settings, seed=job.seed, device=job.device)
        self._state: Mapping[str, Any] = {}
        self._log = (job.folder / "transitions.f32").open("rb", buffering=0)
        self._saved_at = time.monotonic()
        if job.source is not None:
            self._agent.begin_with(load_checkpoint(job.source)["agent"])
        if has_checkpoint(job.folder):
            checkpoint = load_checkpoint(job.folder)
            self._agent.set_state(checkpoint["agent"])
            self._state = {name: checkpoint[name] for name in ("step", "seconds", "helped") if name in checkpoint}

    def run(self) -> None:
        """Until the acting process says so or is gone."""
        agent, settings, job = self._agent, self._job.settings, self._job
        self._read()
        self._publish()
        try:
            self._say("ready", agent.updates)
            os.nice(NICE)
            _share(NICE)
            while True:
                self._read()
                due = job.updates_per_step * (agent.replay.added - settings.learning_start)
                behind = agent.updates < due
                self._listen(0.0 if behind else IDLE_S)
                if behind:
                    agent.update()
                    if agent.updates % settings.policy_every == 0:
                        self._publish()
                if time.monotonic() - self._saved_at > CHECKPOINT_EVERY_S:
                    self._save()
        except _Stopped:
            _share(0)  # nobody walks any more, but someone waits
            self._read()
            self._save()
            with contextlib.suppress(_Stopped):
                self._say("saved", agent.updates)

    def _read(self) -> None:
        """Take in the whole rows that were appended since the last look."""
        replay = self._agent.replay
        size = os.fstat(self._log.fileno()).st_size
        new = size // (4 * replay.width) - replay.added
        while new > 0:
            count = min(new, replay.capacity)
            data = os.pread(self._log.fileno(), count * 4 * replay.width, replay.added * 4 * replay.width)
            rows = np.frombuffer(data, np.float32).reshape(-1, replay.width)
            replay.extend(rows)
            new -= len(rows)

    def _say(self, what: str, value: Any) -> None:
        try:
            self._connection.send((what, value))
        except OSError:
            raise _Stopped from None

    def _listen(self, wait_s: float) -> None:
        try:
            while self._connection.poll(wait_s):
                what, state = self._connection.recv()
                self._state = state
                if what == "end":
                    raise _Stopped
                wait_s = 0.0
        except (EOFError, ConnectionError):
            raise _Stopped from None

    def _publish(self) -> None:
        self._agent.sound_or_raise(self._job.folder)
        self._weights.publish(self._agent.policy.detach().cpu().numpy(), self._agent.updates)

    def _save(self) -> None:
        agent, folder = self._agent, self._job.folder
        agent.sound_or_raise(folder)
        os.fsync(self._log.fileno())
        curve = folder / "learning_curve.csv"
        state = {
            "step": agent.replay.added, "seconds": 0.0, "helped": {}, **self._state, "agent": agent.get_state(),
        }  # fmt: skip
        save_checkpoint(
            folder, state, agent.replay.added, agent.replay.width, curve.stat().st_size if curve.is_file() else 0
        )
        self._saved_at = time.monotonic()


def _share(nice: int) -> None:
    """Where Linux shares processors between sessions first (autogroups), have ours come before or after others.

    This process is the only one of its session; its own priority alone counts for nothing beside other sessions.
    """
    with contextlib.suppress(OSError):  # another system, or one that shares between processes
        Path("/proc/self/autogroup").write_text(str(nice), encoding="ascii")


def main() -> None:
    """Arguments: file descriptors of the connection and of the weights. The job comes first over the connection."""
    # Ctrl-C at the terminal is for the acting process, which then tells us.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection = Connection(int(sys.argv[1]))
    job, count = connection.recv()
    torch.set_num_threads(1)
    weights = SharedWeights(count, int(sys.argv[2]))
    try:
        Learner(job, connection, weights).run()
        return
    except OpenAntError as error:
        kind, words = "error", (error.what, error.where, error.remedy)
    except OSError as error:
        kind, words = "disk", (f"the run cannot be saved: {error.strerror}", str(job.folder), "make room there")
    with contextlib.suppress(OSError):  # nobody is there to be told
        connection.send((kind, words))


if __name__ == "__main__":
    main()
