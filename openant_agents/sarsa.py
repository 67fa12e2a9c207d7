"""SARSA(λ) with tile coding and motion primitives as the Open Ant paper uses it, to be read from top to bottom.

Every half second the agent looks at the robot once and chooses one of eight motion primitives, which then runs blindly.
The value of primitive a where the robot's state falls into tiles φ is linear in them, with weights of its own,

    Q(s, a) = Σ_{k ∈ φ(s)} w_a[k],    w ← w + α δ z,    z ← (γλ)^(Δ/h) z + φ(s, a),
    δ = c Σ_i γ^(i) r_{i+1} + γ^(Δ/h) Q(s', a') − Q(s, a)

(Sutton and Barto 2018, section 12.7). γ and λ are those of a robot step of h = 0.05 s, so that a primitive of Δ = 0.5 s
discounts by their tenth power, as in the platform's software; c scales rewards, which are metres.

The task has no episodes and the traces z are never cleared: where someone had to help the robot, the last transition
bootstraps from what was seen last, and the next begins from where the robot was set down. A trace needs no table:
the tiles of the last few decisions and how far each has faded are all there is to it. Nor need an update touch the weights at
once: each of these decisions has an amount that its tiles are owed, which is paid when its trace has faded, and until then
counts wherever the robot is in a tile of it. That is the same, and twenty times less to write.

What a run leaves behind is the log of its decisions: what was seen, chosen and rewarded. The weights are computed from it
again, a few seconds for an hour of robot time, so that nothing large is ever written while the robot moves, and what is
written is written by another thread.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_agents.compiled import compiled
from openant_agents.primitives import PrimitiveGait
from openant_agents.runs import has_checkpoint, load_checkpoint, making_sense, read_facts
from openant_agents.tile_coding import Rows, TileCoder
from openant_agents.training import (
    Training,
    TrainingProgress,
    check_trained_on,
    described,
    finite_or_raise,
    in_time_with,
    reset_or_stop,
    run_facts,
    training_run,
)
from openant_tools.errors import BadInput, HardwareFault

__all__ = ["Sarsa", "SarsaPolicy", "SarsaSettings", "load_policy", "train"]

Array = NDArray[np.float32]

#: s, the robot step that γ and λ belong to (the paper's).
STEP_S = 0.05
#: share of its first strength below which a decision's trace is forgotten
FADED = 1e-4
#: decisions for whose traces there is room at first
TRACES = 256


@dataclass(frozen=True)
class SarsaSettings:
    """The paper's parameters of SARSA(λ).

    Attributes:
        gamma: discount of a robot step of 0.05 s.
        trace: λ, of a robot step of 0.05 s.
        epsilon: share of decisions that are drawn evenly from all primitives.
        step_size: α, of each weight; with n tilings a value moves by n α of its error.
        tiles: boxes of a tiling along each observation's range.
        tilings: how many.
        table: rows of weights; boxes beyond share rows, which is counted.
        reward_scale: factor on rewards, which are metres. The paper searches 1 to 10 and does not say what it chose;
            5 is what the platform's software uses.
        bounds_from_s: s of robot time with primitives drawn evenly at the start of a run, from which the bounds of
            observations are taken that were not measured on the robot before.
    """

    gamma: float = 0.998
    trace: float = 0.964
    epsilon: float = 0.255
    step_size: float = 1e-4
    tiles: int = 4
    tilings: int = 192
    table: int = 2**25
    reward_scale: float = 5.0
    bounds_from_s: float = 60.0

    def as_dict(self) -> dict[str, float | int]:
        return asdict(self)


# ------------------------------------------------------------------------------------------------------------ agent


class Sarsa:
    """Weights, traces and the update; primitives are numbers from 0.

    Args:
        coder: from observations to rows of weights.
        actions: how many primitives there are.
        settings: parameters of the algorithm.
        seed: of exploration.
    """

    def __init__(self, coder: TileCoder, actions: int, settings: SarsaSettings, *, seed: int) -> None:
        self.coder, self.actions, self.settings = coder, actions, settings
        self.random = np.random.default_rng(seed)
        # Rows by tile, so that all actions of a tile lie together; the system gives memory only as rows are written. The
        # last row is that of all boxes without one: it stays 0.
        self.weights = np.zeros((coder.rows + 1, actions), np.float32)
        # The decisions that still have a trace: those from first to end, oldest first.
        self._first = self._end = 0
        self._tiles = np.empty((TRACES, coder.tilings), np.int64)
        self._actions = np.empty(TRACES, np.int64)
        self._strengths, self._owed = np.empty(TRACES), np.empty(TRACES)
        self._fading = 0.0  # γλ over the transition that the newest trace began
        self._seen: deque[tuple[bytes, Rows]] = deque(maxlen=2)  # where a transition began and ended
        self._valued: tuple[Rows, NDArray[np.float64]] | None = None  # what was last asked for since weights changed
        self.decisions = 0
        self.moved = 0.0  # sum of how far the weights were ever moved

    def rows_of(self, observation: Array) -> Rows:
        """The coder's rows of an observation (float32); those of the last two are remembered.

        A decision needs them three times: to choose, and as the end of one transition and the beginning of the next.
        """
        name = observation.tobytes()
        for known, rows in self._seen:
            if known == name:
                return rows
        rows = self.coder.rows_of(observation)
        self._seen.append((name, rows))
        return rows

    def values(self, rows: Rows) -> NDArray[np.float64]:
        """(actions,): Q of each primitive where the tiles have these rows."""
        if self._valued is not None and self._valued[0] is rows:
            return self._valued[1]
        mine = slice(self._first, self._end)
        values = _values(self.weights, rows, self._tiles[mine], self._actions[mine], self._owed[mine])
        self._valued = rows, values
        return values

    def settle(self) -> None:
        """Pay what is owed and forget all traces: an agent that only plays needs none."""
        while self._first < self._end:
            self._pay()

    def _pay(self) -> None:
        """Forget the oldest trace; what its tiles are owed becomes theirs."""
        oldest = self._first
        _pay(self.weights, self._tiles[oldest], self._actions[oldest], self._owed[oldest])
        self._first += 1

    def choose(self, rows: Rows) -> int:
        """A primitive, ε-greedily; ties are broken by chance."""
        if self.random.random() < self.settings.epsilon:
            return int(self.random.integers(self.actions))
        return self.best(rows)

    def best(self, rows: Rows) -> int:
        """The primitive of the highest value; one of them by chance where several are."""
        values = self.values(rows)
        best = np.flatnonzero(values == values.max())
        return int(best[0] if len(best) == 1 else self.random.choice(best))

    def learn(
        self,
        rows: Rows,
        action: int,
        reward: float,
        seconds: float,
        next_rows: Rows,
        next_action: int,
        *,
        terminated: bool = False,
    ) -> float:
        """One update of all weights with a trace.

        Args:
            rows, action: where the robot was, and the primitive chosen there.
            reward: m, the discounted sum of rewards since.
            seconds: s, how long it took.
            next_rows, next_action: where it then was, and the primitive chosen there.
            terminated: whether nothing follows.

        Returns:
            The error δ.
        """
        settings = self.settings
        steps = seconds / STEP_S
        discount = math.exp(steps * math.log(settings.gamma)) if settings.gamma > 0.0 else 0.0
        # Where the robot is now was looked at to choose.
        following = 0.0 if terminated else self.values(next_rows)[next_action]
        value = self.values(rows)[action]
        error = float(settings.reward_scale * reward + discount * following - value)

        self._strengths[self._first : self._end] *= self._fading
        while self._first < self._end and self._strengths[self._first] < FADED:
            self._pay()
        if self._end == len(self._tiles):
            self._make_room()
        self._tiles[self._end], self._actions[self._end] = rows, action
        self._strengths[self._end], self._owed[self._end] = 1.0, 0.0
        self._end += 1
        self._fading = discount * settings.trace**steps
        step = settings.step_size * error * self._strengths[self._first : self._end]
        self._owed[self._first : self._end] += step
        self._valued = None
        self.moved += abs(float(step.sum())) * len(rows)
        self.decisions += 1
        return error

    def _make_room(self) -> None:
        """Move the decisions that have a trace to the front of twice the room that they need, or more."""
        mine, count = slice(self._first, self._end), self._end - self._first
        for name in ("_tiles", "_actions", "_strengths", "_owed"):
            old = getattr(self, name)
            new = np.empty((max(TRACES, 2 * count), *old.shape[1:]), old.dtype)
            new[:count] = old[mine]
            setattr(self, name, new)
        self._first, self._end = 0, count


@compiled
def _values(
    weights: Array, rows: Rows, tiles: Rows, actions: NDArray[np.int64], owed: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(actions,) Q where the tiles have these rows: what their weights are, and what traces (traces, tilings) owe them."""
    out = np.zeros(weights.shape[1])
    for row in rows:
        for a in range(len(out)):
            out[a] += weights[row, a]
    for n in range(len(tiles)):
        shared = 0
        # A box is of one tiling, so that only rows at the same place can be the same box.
        for k in range(len(rows)):
            shared += tiles[n, k] == rows[k]
        out[actions[n]] += shared * owed[n]
    return out


@compiled
def _pay(weights: Array, rows: Rows, action: np.int64, owed: np.float64) -> None:
    for row in rows:
        weights[row, action] += owed


def _compile() -> None:
    """Have the machine code of all that a decision does: an agent may be made while its robot moves."""
    agent = Sarsa(TileCoder(np.zeros(1), np.ones(1), tiles=1, tilings=1, rows=2), 1, SarsaSettings(), seed=0)
    rows = agent.rows_of(np.zeros(1, np.float32))
    agent.learn(rows, 0, 0.0, STEP_S, rows, 0)
    agent.settle()


# ------------------------------------------------------------------------------------------------ a run's decisions


@dataclass(frozen=True)
class _Columns:
    """Where each part of a decision stands in a row of the log: what was seen, the primitive, its discounted reward (m),
    its time (s), whether the task ended, what was seen then, the primitive chosen there."""

    observations: int

    @property
    def width(self) -> int:
        return 2 * self.observations + 5

    def row(
        self,
        observation: Array,
        action: int,
        reward: float,
        seconds: float,
        terminated: bool,
        next_observation: Array,
        next_action: int,
    ) -> Array:
        o, row = self.observations, np.empty(self.width, np.float32)
        row[:o] = observation
        row[o : o + 4] = action, reward, seconds, terminated
        row[o + 4 : -1] = next_observation
        row[-1] = next_action
        return row

    def learn(self, agent: Sarsa, row: Array) -> float:
        """Learn from a row; the same row gives the same update, now and when the log is read again."""
        o = self.observations
        action, reward, seconds, terminated = row[o : o + 4].tolist()
        rows, next_rows = agent.rows_of(row[:o]), agent.rows_of(row[o + 4 : -1])
        return agent.learn(
            rows, int(action), reward, seconds, next_rows, int(row[-1]), terminated=bool(terminated)
        )  # fmt: skip


@dataclass
class _Bounds:
    """The range of each observation: known before where the robot was measured, else what the first minute showed."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    known: NDArray[np.bool_]

    @classmethod
    def of(cls, env: gymnasium.Env[Any, Any]) -> _Bounds:
        space = env.observation_space
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        names = getattr(env.unwrapped, "observation_names", ())
        measured = getattr(env.unwrapped, "measured_bounds", {})
        for at, name in enumerate(names):
            if name in measured:
                low[at], high[at] = measured[name]
        known = np.isfinite(low) & np.isfinite(high)
        return cls(np.where(known, low, np.inf), np.where(known, high, -np.inf), known)

    @property
    def complete(self) -> bool:
        return bool(self.known.all())

    def see(self, observation: Array) -> None:
        """Widen those that are still open."""
        self.low = np.where(self.known, self.low, np.minimum(self.low, observation))
        self.high = np.where(self.known, self.high, np.maximum(self.high, observation))


def _agent(bounds: _Bounds, actions: int, settings: SarsaSettings, seed: int) -> Sarsa:
    coder = TileCoder(
        bounds.low, bounds.high, tiles=settings.tiles, tilings=settings.tilings, rows=settings.table
    )  # fmt: skip
    return Sarsa(coder, actions, settings, seed=seed)


# ---------------------------------------------------------------------------------------------------------- training

#: environment steps between points of the learning curve: 10 s of 0.05 s
CURVE_EVERY = 200


class _Scribe:
    """Writes to the disk on a thread of its own, in order, so that a slow disk never holds up a decision."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "scribe")
        self._last: Future[None] | None = None

    def write(self, what: Callable[..., None], *arguments: Any) -> None:
        """Have it written soon.

        Raises:
            OSError: an earlier write failed.
        """
        if self._last is not None and self._last.done():
            self._last.result()
        before = self._last

        def next_write() -> None:
            if before is not None:
                before.result()  # has ended: one thread; its failure is this one's, too
            what(*arguments)

        self._last = self._thread.submit(next_write)

    def finish(self) -> None:
        """Wait until everything is written."""
        if self._last is not None:
            self._last.result()

    def close(self) -> None:
        self._thread.shutdown()


def train(
    env: gymnasium.Env[Any, Any],
    *,
    folder: Path,
    steps: int,
    seed: int,
    settings: SarsaSettings | None = None,
    env_facts: Mapping[str, Any] | None = None,
    source: Path | None = None,
    tensorboard: bool = False,
    report: Callable[[TrainingProgress], None] | None = None,
) -> TrainingProgress:
    """Train on one environment, or go on with the run that the folder holds.

    Args:
        env: an Open Ant whose step divides half a second. Where it has `get_state` and `set_state`, a resumed run is
            equal to one that was never stopped, bit for bit; else a resumed run begins with a reset.
        folder: for everything the run leaves behind (`openant_agents.runs`); `transitions.f32` is the log of decisions.
        steps: environment steps until the run is long enough, those of earlier calls included; a primitive that has
            begun is finished.
        seed: of the agent and of the first reset.
        settings: the paper's by default.
        env_facts: how to make the environment again, for `run.json`.
        source: another run of the same settings, whose agent acts from the first step on and learns on from there: its decisions
            are the first of this run's log.
        tensorboard: also write the learning curve and the errors as TensorBoard events into the folder.
        report: called a few times a second.

    Raises:
        BadInput: the folder holds another run, the environment does not suit, or a number that is none came up.
        HardwareFault: the robot cannot go on; the run is saved and goes on with the same call.
        KeyboardInterrupt: asked for by SIGINT or SIGTERM; the run is saved and goes on with the same call.
    """
    settings = settings or SarsaSettings()
    gait = _gait(env, described(env))
    _compile()
    bounds = _Bounds.of(env)
    facts = run_facts("sarsa", env, settings.as_dict(), seed, env_facts, (len(bounds.low), len(gait)), {}, source)
    begun = None if source is None or has_checkpoint(folder) else _begun(source, env, settings, seed)
    with training_run(folder, facts, tensorboard) as (run, events, stop):
        scribe = _Scribe()
        try:
            training = Training(env, run, steps, report, stop, scribe.write)
            with in_time_with(env):
                return _train(training, gait, bounds, scribe, settings, seed, events, begun)
        finally:
            scribe.close()


def _train(
    training: Training,
    gait: PrimitiveGait,
    bounds: _Bounds,
    scribe: _Scribe,
    settings: SarsaSettings,
    seed: int,
    events: Any,
    begun: tuple[_Bounds, Sarsa, Array] | None,
) -> TrainingProgress:
    env, run = training.env, training.run
    columns = _Columns(len(bounds.low))
    random = np.random.default_rng(seed)
    agent = _agent(bounds, len(gait), settings, seed) if bounds.complete else None
    observation = training.begin(seed)
    action: int | None = None
    checkpoint = run.resume()
    log: list[Array] = []  # decisions not yet handed to the scribe
    if begun is not None:
        bounds, agent, decisions = begun
        log.extend(decisions)
    if checkpoint is not None:
        with making_sense(run.folder):
            random.bit_generator.state = checkpoint["random"]
            bounds, agent = _learned(run.folder, checkpoint, len(gait), settings, seed)
            before = training.restore(checkpoint)
            if before is not None:
                observation, action = before, int(checkpoint["action"])
                gait.sent(checkpoint["last"].numpy())

    def choose(observed: Array) -> int:
        if agent is None:
            return int(random.integers(len(gait)))
        return agent.choose(agent.rows_of(np.asarray(observed, np.float32)))

    def save() -> None:
        state = training.state(observation) | {
            "random": random.bit_generator.state, "bounds": [bounds.low, bounds.high, bounds.known],
            "agent": None if agent is None else _summary(agent), "action": action, "last": gait.last,
        }  # fmt: skip
        rows = np.stack(log) if log else np.empty((0, columns.width), np.float32)
        log.clear()
        training.saved_at = time.monotonic()
        scribe.write(run.save, state, rows)

    if action is None:
        action = choose(observation)
    try:
        while training.going:
            reward = took = 0.0
            terminated = truncated = void = False
            for command in gait.actions(action):
                seen, r, terminated, truncated, info = env.step(command.astype(np.float32))
                r = float(r)
                finite_or_raise(seen, r, training.step, run.folder)
                void = bool(info.get("void", False))
                training.late = int(info.get("overruns", 0))
                if void:
                    break
                dt = float(info["dt"])
                gait.sent(command)
                reward += settings.gamma ** (took / STEP_S) * r
                took += dt
                training.add(r, dt)
                if agent is None:
                    bounds.see(seen)
                if training.step % CURVE_EVERY == 0:
                    training.curve_point()
                if terminated or truncated:
                    break
            next_action = choose(seen)
            if void:
                pass
            elif agent is None:
                if training.seconds > settings.bounds_from_s - 0.5 * STEP_S:
                    agent = _agent(bounds, len(gait), settings, seed)
            else:
                log.append(columns.row(observation, action, reward, took, terminated, seen, next_action))
                error = columns.learn(agent, log[-1])
                if not math.isfinite(error):
                    raise BadInput(
                        f"the values grew without bound after {agent.decisions} decisions",
                        where=run.folder,
                        remedy="use a smaller step size",
                    )
                if events is not None and agent.decisions % 20 == 0:
                    scribe.write(events.add_scalar, "average_reward_m_s", training.average.value, training.step)
                    scribe.write(events.add_scalar, "error", error, training.step)
            observation, action = seen, next_action
            if terminated or truncated:
                training.note_help(info)
                set_up = reset_or_stop(env, None, training.stop)
                if set_up is not None:
                    observation = set_up
                    gait.rest()
                    action = choose(observation)
            if training.save_is_due:
                save()
            training.tell(agent is not None)
    except HardwareFault:
        save()  # what was learned until the robot could not go on
        scribe.finish()
        raise
    save()
    scribe.finish()
    return training.end(agent is not None)


def _summary(agent: Sarsa) -> dict[str, Any]:
    """What the log does not hold, and what the weights computed from it must agree with."""
    return {
        "random": agent.random.bit_generator.state, "decisions": agent.decisions, "moved": agent.moved,
        "tiles": agent.coder.used, "shared": agent.coder.shared,
    }  # fmt: skip


def _learned(
    folder: Path, checkpoint: Mapping[str, Any], actions: int, settings: SarsaSettings, seed: int
) -> tuple[_Bounds, Sarsa | None]:
    """Bounds and agent as they were at a checkpoint: its decisions learned again, one after the other.

    Raises:
        BadInput: the log has fewer decisions than it should, or they lead elsewhere than they did.
    """
    low, high, known = (part.numpy() for part in checkpoint["bounds"])
    bounds = _Bounds(low, high, known)
    summary = checkpoint["agent"]
    if summary is None:
        return bounds, None
    agent = _agent(bounds, actions, settings, seed)
    columns = _Columns(len(low))
    rows = np.fromfile(folder / "transitions.f32", np.float32) if summary["decisions"] else np.empty(0, np.float32)
    rows = rows[: summary["decisions"] * columns.width].reshape(-1, columns.width)
    if len(rows) < summary["decisions"]:
        raise BadInput(
            f"its log has {len(rows)} of {summary['decisions']} decisions",
            where=folder,
            remedy="train into another folder; this one has lost data",
        )
    for row in rows:
        columns.learn(agent, row)
    agent.random.bit_generator.state = summary["random"]
    # Other processors and versions round sums otherwise; other rules of learning lead elsewhere altogether.
    if not math.isclose(agent.moved, summary["moved"], rel_tol=1e-2, abs_tol=1e-6):
        raise BadInput(
            "its decisions, learned again, lead to other weights than they did",
            where=folder,
            remedy="use the version of the software that trained it, or train again",
        )
    return bounds, agent


# --------------------------------------------------------------------------------------------------------- playing


class SarsaPolicy:
    """An agent that acts and no longer learns: the action of every environment step."""

    def __init__(self, agent: Sarsa, gait: PrimitiveGait) -> None:
        self._agent, self._gait = agent, gait
        self._commands: deque[Array] = deque()

    def begin(self) -> None:
        """The robot was set up anew."""
        self._gait.rest()
        self._commands.clear()

    def seed(self, seed: int) -> None:
        """Begin its chance anew."""
        self._agent.random = np.random.default_rng(seed)

    def sample(self, observation: Array) -> Array:
        """(joints,): of a primitive chosen as in training, ε-greedily."""
        return self._act(observation, self._agent.choose)

    def greedy(self, observation: Array) -> Array:
        """(joints,): of the primitive of the highest value."""
        return self._act(observation, self._agent.best)

    def _act(self, observation: Array, choose: Callable[[Rows], int]) -> Array:
        if not self._commands:
            rows = self._agent.coder.rows_of(observation, learn=False)
            self._commands.extend(self._gait.actions(choose(rows)).astype(np.float32))
        command = self._commands.popleft()
        self._gait.sent(command)
        return command


def _begun(
    folder: Path, env: gymnasium.Env[Any, Any], settings: SarsaSettings, seed: int
) -> tuple[_Bounds, Sarsa, Array]:
    """Bounds, agent and decisions of a run that another begins with; its chance is the other's own."""
    with making_sense(folder):
        if (theirs := read_facts(folder)["settings"]) != settings.as_dict():
            other = next(name for name, value in settings.as_dict().items() if theirs.get(name) != value)
            raise BadInput(
                f"it was trained with another {other.replace('_', ' ')}: {theirs.get(other)}", where=folder,
                remedy="give the settings that it was trained with",
            )  # fmt: skip
        bounds, agent, _ = _of_run(folder, env)
        agent.random = np.random.default_rng((seed, agent.decisions))
        width = _Columns(len(bounds.low)).width
        decisions = np.fromfile(folder / "transitions.f32", np.float32, agent.decisions * width).reshape(-1, width)
        return bounds, agent, decisions


def load_policy(folder: Path, env: gymnasium.Env[Any, Any]) -> tuple[SarsaPolicy, int]:
    """The agent of a run, ready to act in an environment, and the step it was saved at.

    Raises:
        BadInput: no such run, or one whose observations or actions are not the environment's.
    """
    with making_sense(folder):
        _, agent, checkpoint = _of_run(folder, env)
        agent.settle()
        return SarsaPolicy(agent, _gait(env, described(env))), int(checkpoint["step"])


def _of_run(folder: Path, env: gymnasium.Env[Any, Any]) -> tuple[_Bounds, Sarsa, dict[str, Any]]:
    """Bounds, agent and checkpoint of a run of SARSA(λ) that suits an environment."""
    facts = read_facts(folder)
    if facts["agent"] != "sarsa":
        raise BadInput(
            f"it is a run of {facts['agent']}, not of sarsa", where=folder, remedy="name a run of `openant train sarsa`"
        )
    here = described(env)
    gait = _gait(env, here)
    check_trained_on(facts, here, ("observation_names", "action_names", "action_range", "dt"), folder)
    checkpoint = load_checkpoint(folder)
    _compile()
    settings, seed = SarsaSettings(**facts["settings"]), int(facts["seed"])
    bounds, agent = _learned(folder, checkpoint, len(gait), settings, seed)
    if agent is None:
        raise BadInput(
            "it had not begun to learn when it was saved: its first minute measures the bounds of observations",
            where=folder,
            remedy="train a little longer",
        )
    return bounds, agent, checkpoint


def _gait(env: gymnasium.Env[Any, Any], described: Mapping[str, Any]) -> PrimitiveGait:
    space = env.observation_space
    if not (isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1):
        raise BadInput(f"observations are {space}, not a vector", remedy="wrap it in FlattenObservation")
    return PrimitiveGait(described.get("action_names", ()), float(described.get("dt", 0.0)))
