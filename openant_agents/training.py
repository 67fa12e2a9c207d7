"""What training loops share: their run's facts and checkpoint, how far they are, how they get help, wait and stop.

A step that a stop came in the way of (`info["void"]`) counts for nothing in all of them: nobody learns from it, and it is
neither a step nor time.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_agents.runs import CurvePoint, TrainingRun
from openant_env.metrics import AverageReward
from openant_tools.errors import BadInput
from openant_tools.files import json_text, read_json, reading, write_text
from openant_tools.numbers import stored
from openant_tools.scheduling import ACTS, in_time

__all__ = [
    "CHECKPOINT_EVERY_S",
    "Training",
    "TrainingProgress",
    "check_trained_on",
    "described",
    "event_writer",
    "finite_or_raise",
    "in_time_with",
    "place_circle",
    "reset_or_stop",
    "run_facts",
    "stop_on_signal",
    "training_run",
]  # fmt: skip

Array = NDArray[np.float32]

#: s of wall-clock time between checkpoints: a crash loses at most this much.
CHECKPOINT_EVERY_S = 30.0
#: of a run's folder, the centre of a circle that nobody chose
CIRCLE = "circle.json"
#: s of wall-clock time between calls of the progress report
REPORT_EVERY_S = 0.25


@dataclass(frozen=True)
class TrainingProgress:
    """How far a training run is.

    Attributes:
        step, steps: environment steps done, and wanted.
        robot_seconds: s, the time that the robot has walked.
        average_reward_m_s: m/s, over the last 120 s of it.
        learning: whether updates have begun.
        helped: why and how often the robot had to be set up again.
        late: steps that began later than they should, of a robot in real time.
        updates: how often the agent has learned; None where that follows from the steps.
    """

    step: int
    steps: int
    robot_seconds: float
    average_reward_m_s: float
    learning: bool
    helped: Mapping[str, int]
    late: int = 0
    updates: int | None = None


# ------------------------------------------------------------------------------------------------- what a run says


def described(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """What an environment says of itself; nothing where it says nothing."""
    describe = getattr(env.unwrapped, "describe", None)
    return {} if describe is None else dict(describe())


def run_facts(
    agent: str,
    env: gymnasium.Env[Any, Any],
    settings: Mapping[str, Any],
    seed: int,
    env_facts: Mapping[str, Any] | None,
    sizes: tuple[int, int],
    versions: Mapping[str, str],
    source: Path | None = None,
) -> dict[str, Any]:
    """What `run.json` says of a run.

    Args:
        env_facts: how to make the environment again. sizes: how many observations and actions there are.
        versions: of what computes the agent. source: the run whose agent it begins with.
    """
    begun = {} if source is None else {"from": str(source.resolve())}
    return begun | {
        "agent": agent, "seed": seed, "settings": dict(settings), "env": dict(env_facts or {}),
        "trained_on": described(env), "observations": sizes[0], "actions": sizes[1],
        "versions": {**versions, "numpy": np.__version__, "gymnasium": gymnasium.__version__},
    }  # fmt: skip


def check_trained_on(facts: Mapping[str, Any], here: Mapping[str, Any], what: tuple[str, ...], folder: Path) -> None:
    """Refuse to play a policy where it was not trained.

    Args:
        facts: of the run. here: what the environment says of itself. what: has to be the same.

    Raises:
        BadInput: it is not.
    """
    for name in what:
        if name in here and facts["trained_on"].get(name) != here[name]:
            raise BadInput(
                f"its policy was trained with other {name.replace('_', ' ')} than this environment has",
                where=folder,
                remedy="make the environment as run.json says",
            )


# ---------------------------------------------------------------------------------------------- while it goes on


@contextmanager
def training_run(
    folder: Path, facts: Mapping[str, Any], tensorboard: bool
) -> Iterator[tuple[TrainingRun, Any, threading.Event]]:
    """A run's folder, held; its TensorBoard events (None: not asked for); the wish to stop.

    Raises:
        BadInput: the folder holds another run, or TensorBoard is not installed.
    """
    run = TrainingRun(folder, facts)
    events = None
    try:
        events = event_writer(folder) if tensorboard else None
        with stop_on_signal() as stop:
            yield run, events, stop
    finally:
        run.close()
        if events is not None:
            events.close()


def _at_once(what: Callable[..., None], *arguments: Any) -> None:
    what(*arguments)


class Training:
    """What a training loop counts, its part of the checkpoint, and how its robot is set up again.

    Args:
        steps: environment steps until the run is long enough.
        report: called a few times a second.
        stop: set once someone wants it to end.
        write: how something is written to the run's folder: at once, or by another thread.

    Raises:
        BadInput: the run's folder says of no place that the robot's circle is there.

    Attributes:
        step, seconds: environment steps so far, and how long they took, s.
        late: of a robot in real time, steps that began later than they should.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        run: TrainingRun,
        steps: int,
        report: Callable[[TrainingProgress], None] | None,
        stop: threading.Event,
        write: Callable[..., None] = _at_once,
    ) -> None:
        self.env, self.run, self.steps, self.stop = env, run, steps, stop
        self._unplaced = place_circle(env, run.folder)
        self._report, self._write = report, write
        self.step, self.seconds, self.late = 0, 0.0, 0
        self.average = AverageReward()
        self.helped: Counter[str] = Counter()
        self.saved_at = self._reported_at = time.monotonic()

    @property
    def going(self) -> bool:
        return self.step < self.steps and not self.stop.is_set()

    def set_up(self, seed: int) -> Array | None:
        """The first observation, or None where someone wants to stop before there is one.

        A robot whose circle lies where it stood first keeps it there where its run goes on, wherever it stands then.
        """
        observation: Array | None = reset_or_stop(self.env, seed, self.stop)
        if self._unplaced and self.env.unwrapped.origin is not None:
            centre = {"origin_m": [stored(value) for value in self.env.unwrapped.origin]}
            self._write(write_text, self.run.folder / CIRCLE, json_text(centre))
        return observation

    def begin(self, seed: int) -> Array:
        """The first observation; raises KeyboardInterrupt where someone wants to stop before there is one."""
        observation = self.set_up(seed)
        if observation is None:
            raise KeyboardInterrupt
        return observation

    def state(self, observation: Array) -> dict[str, Any]:
        """For the checkpoint: counters, and the environment as far as it can be put back."""
        get_state = getattr(self.env.unwrapped, "get_state", None)
        return {
            "step": self.step, "seconds": self.seconds, "average": self.average.get_state(), "helped": dict(self.helped),
            "observation": observation, "env": None if get_state is None else get_state(),
        }  # fmt: skip

    def restore(self, checkpoint: Mapping[str, Any]) -> Array | None:
        """Go on where a checkpoint was made: its observation, or None where the environment could not be put back."""
        self.step, self.seconds = int(checkpoint["step"]), float(checkpoint["seconds"])
        self.average.set_state(checkpoint["average"])
        self.helped.update(checkpoint["helped"])
        if checkpoint["env"] is None:
            return None
        self.env.unwrapped.set_state(checkpoint["env"])
        observation: Array = checkpoint["observation"].numpy()
        return observation

    def add(self, reward: float, dt: float) -> None:
        """A step of `dt` s was done."""
        self.average.add(reward, dt)
        self.step += 1
        self.seconds += dt

    def curve_point(self) -> None:
        """Add where we are to the learning curve."""
        self._write(self.run.add_curve_point, CurvePoint(self.step, self.seconds, self.average.value))

    def note_help(self, info: Mapping[str, Any]) -> None:
        """Someone has to help the robot, or something; why is in what its last step told."""
        reason = str(info.get("reason", "the episode ended"))
        self.helped[reason] += 1
        self._write(self.run.add_intervention, self.step, self.seconds, reason)

    @property
    def save_is_due(self) -> bool:
        return time.monotonic() - self.saved_at > CHECKPOINT_EVERY_S

    def progress(self, learning: bool, updates: int | None = None) -> TrainingProgress:
        return TrainingProgress(
            self.step, self.steps, self.seconds, self.average.value, learning, dict(self.helped), self.late, updates
        )

    def tell(self, learning: bool, updates: int | None = None) -> None:
        """Report how far it is, unless that was done just now."""
        now = time.monotonic()
        if self._report is not None and now - self._reported_at > REPORT_EVERY_S:
            self._reported_at = now
            self._report(self.progress(learning, updates))

    def end(self, learning: bool, updates: int | None = None) -> TrainingProgress:
        """Report for the last time; raises KeyboardInterrupt where someone wanted to stop before the run was long enough."""
        progress = self.progress(learning, updates)
        if self._report is not None:
            self._report(progress)
        if self.stop.is_set() and self.step < self.steps:
            raise KeyboardInterrupt
        return progress


def finite_or_raise(observation: NDArray[Any], reward: float, step: int, folder: Path) -> None:
    """Refuse what nothing can be learned from.

    Raises:
        BadInput: the reward or a number of the observation is none.
    """
    if not math.isfinite(reward + float(observation.sum())):
        raise BadInput(
            f"step {step} gave a reward or an observation that is no number",
            where=folder,
            remedy="look at the environment; what was saved until then is sound",
        )


def event_writer(folder: Path) -> Any:
    """TensorBoard events in a run's folder.

    Raises:
        BadInput: TensorBoard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise BadInput(
            "TensorBoard is not installed", remedy="pip install 'openant-tools[agents]', or train without --tensorboard"
        ) from error
    return SummaryWriter(str(folder / "tensorboard"))


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Turn the first SIGINT or SIGTERM into a wish, so that no update is cut in half; the second interrupts at once."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def handle(signum: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def place_circle(env: gymnasium.Env[Any, Any], folder: Path) -> bool:
    """Put a robot's circle where its run had it, unless somebody has chosen where; whether nobody knows that yet.

    Raises:
        BadInput: the run's file says no place.
    """
    path = folder / CIRCLE
    if getattr(env.unwrapped, "origin", path) is not None:
        return False
    if not path.is_file():
        return True
    remedy = "delete it: the circle is where the robot stands then"
    with reading(path, "this is no circle's centre", remedy):
        x, y = map(float, read_json(path, remedy)["origin_m"])
        if not math.isfinite(x + y):
            raise ValueError
    env.unwrapped.origin = x, y
    return False


def in_time_with(env: gymnasium.Env[Any, Any]) -> AbstractContextManager[None]:
    """While this thread chooses actions, it does so in time where the robot does not wait for it."""
    return in_time(ACTS) if getattr(env.unwrapped, "real_time", False) else nullcontext()


def reset_or_stop(env: gymnasium.Env[Any, Any], seed: int | None, stop: threading.Event) -> Any | None:
    """The first observation, or None where someone wants to stop.

    A robot that needs help keeps a reset waiting, and one wish ends that. A simulation is reset whole: half of it could not
    be saved.
    """
    if stop.is_set():
        return None
    if hasattr(env.unwrapped, "get_state"):
        return env.reset(seed=seed)[0]
    with _interruptible():
        try:
            return env.reset(seed=seed)[0]
        except KeyboardInterrupt:
            stop.set()
            return None


@contextmanager
def _interruptible() -> Iterator[None]:
    """Signals raise here, as nothing can be cut in half."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(signum: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
