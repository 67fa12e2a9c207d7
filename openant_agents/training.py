"""What training loops share: how far they are, how they wait and stop, where their events go.

A step that a stop came in the way of (`info["void"]`) counts for nothing in all of them: nobody learns from it, and it is
neither a step nor time.
"""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import gymnasium
from numpy.typing import NDArray

from openant_tools.errors import BadInput

__all__ = [
    "CHECKPOINT_EVERY_S", "REPORT_EVERY_S", "Progress", "event_writer", "finite_or_raise", "reset_or_stop", "stop_on_signal",
]  # fmt: skip

#: s of wall-clock time between checkpoints: a crash loses at most this much.
CHECKPOINT_EVERY_S = 30.0
#: s of wall-clock time between calls of the progress report
REPORT_EVERY_S = 0.25


@dataclass(frozen=True)
class Progress:
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
