"""SAC that learns beside acting: what either half leaves behind when it is killed, and what a robot's troubles do to it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openant_agents import async_training  # noqa: E402
from openant_agents.async_training import train_async  # noqa: E402
from openant_agents.interventions import read_interventions  # noqa: E402
from openant_agents.learner import SharedWeights  # noqa: E402
from openant_agents.runs import load_checkpoint, read_curve  # noqa: E402
from openant_agents.sac import Replay, SacSettings, load_policy, train  # noqa: E402
from openant_tools.errors import BadInput, HardwareFault  # noqa: E402

torch.set_num_threads(1)
SMALL = SacSettings(learning_start=20, batch=16, hidden=16)
WIDTH = Replay(1, 1, 1).width


class Robot(gymnasium.Env):
    """A point that takes its time, is stopped at some steps, and then needs help."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, step_s: float = 2e-3, stopped_at: tuple[int, ...] = (), nan_at: int = -1) -> None:
        self.x, self.taken, self.step_s, self.stopped_at, self.nan_at = 0.0, 0, step_s, stopped_at, nan_at

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([self.x], np.float32), {}

    def step(self, action):
        time.sleep(self.step_s)
        self.taken += 1
        stopped = self.taken in self.stopped_at
        before = abs(self.x - 0.5)
        self.x = self.x if stopped else float(np.clip(self.x + 0.3 * action[0], -2.0, 2.0))
        info = {"dt": 0.1, "overruns": 3} | ({"reason": "the cable came off", "void": True} if stopped else {})
        seen = np.nan if self.taken == self.nan_at else self.x
        return np.array([seen], np.float32), before - abs(self.x - 0.5), False, stopped, info


def rows(folder: Path) -> np.ndarray:
    return np.fromfile(folder / "transitions.f32", np.float32).reshape(-1, WIDTH)


def test_it_learns_beside_acting_and_goes_on_with_every_transition(tmp_path):
    said = []
    done = train_async(Robot(stopped_at=(31,)), folder=tmp_path, steps=120, seed=0, settings=SMALL, report=said.append)
    assert done.step == 120
    assert done.robot_seconds == pytest.approx(12.0)
    assert done.helped == {"the cable came off": 1}
    assert done.late == 3
    assert done.updates is not None
    assert done.updates > 0
    assert said[-1] == done
    assert len(rows(tmp_path)) == 120  # the step that was stopped is none of them
    assert [(one.step, one.reason) for one in read_interventions(tmp_path)] == [(30, "the cable came off")]
    assert [point.step for point in read_curve(tmp_path)] == [100]
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint["transitions"] == 120
    assert checkpoint["agent"]["updates"] <= 100  # one for each transition after the start

    before = rows(tmp_path)
    with (tmp_path / "transitions.f32").open("ab") as stream:
        stream.write(b"half a row")
    more = train_async(Robot(), folder=tmp_path, steps=150, seed=0, settings=SMALL)
    assert more.step == 150
    assert more.robot_seconds == pytest.approx(15.0)
    assert more.helped == {"the cable came off": 1}
    np.testing.assert_array_equal(rows(tmp_path)[:120], before)
    assert more.updates >= checkpoint["agent"]["updates"]
    agent, step = load_policy(tmp_path, Robot())
    assert step == 150
    assert np.isfinite(agent.act(np.zeros(1, np.float32))).all()
    with pytest.raises(BadInput, match="this folder holds another run: it differs in learning"):
        train(Robot(), folder=tmp_path, steps=200, seed=0, settings=SMALL)

    train_async(Robot(), folder=tmp_path / "more", steps=20, seed=1, settings=SMALL, source=tmp_path)
    begun, _ = load_policy(tmp_path / "more", Robot())
    seen = np.full(1, 0.3, np.float32)
    np.testing.assert_array_equal(
        begun.act(seen, explore=False), agent.act(seen, explore=False)
    )  # nothing is learned from so few


def test_kill_9_loses_no_transition(tmp_path):
    code = f"""
        import sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from pathlib import Path
        from test_async_training import Robot, SMALL, train_async
        train_async(Robot(5e-3), folder=Path({str(tmp_path)!r}), steps=100_000, seed=0, settings=SMALL)
    """
    with subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)]) as process:
        while not (tmp_path / "transitions.f32").is_file() or len(rows_so_far(tmp_path)) < 60:
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.wait()
    made = len(rows_so_far(tmp_path))
    wait_for_the_learner(tmp_path)  # it finds nobody there, saves and goes
    assert load_checkpoint(tmp_path)["transitions"] == made
    done = train_async(Robot(), folder=tmp_path, steps=made + 5, seed=0, settings=SMALL)
    assert done.step == made + 5
    assert done.robot_seconds == pytest.approx(0.1 * (made + 5))


def test_a_step_that_was_not_carried_out_counts_for_nothing_between_actions_too(tmp_path):
    done = train(Robot(0.0, stopped_at=(31, 101)), folder=tmp_path, steps=120, seed=0, settings=SMALL)
    assert done.step == 120
    assert done.robot_seconds == pytest.approx(12.0)
    assert done.helped == {"the cable came off": 2}
    assert done.late == 3
    assert len(rows(tmp_path)) == 120
    assert [one.step for one in read_interventions(tmp_path)] == [30, 99]
    assert [point.step for point in read_curve(tmp_path)] == [100]
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint["seconds"] == pytest.approx(12.0)
    assert checkpoint["agent"]["updates"] == 120 - SMALL.learning_start


@pytest.mark.parametrize("learn", [train, train_async])
def test_one_wish_to_stop_ends_waiting_for_a_robot(tmp_path, learn):
    class Lost(Robot):
        def reset(self, *, seed=None, options=None):
            if self.taken:
                signal.raise_signal(signal.SIGINT)
                raise AssertionError("it waits for ever")
            return super().reset(seed=seed)

    with pytest.raises(KeyboardInterrupt):
        learn(Lost(0.0, stopped_at=(31,)), folder=tmp_path, steps=120, seed=0, settings=SMALL)
    assert len(rows(tmp_path)) == 30
    assert load_checkpoint(tmp_path)["transitions"] == 30


class NoLearner:
    """Stands for the learner where there is nothing to learn: a process that loads torch takes three seconds to begin."""

    updates = 0

    def __init__(self, job, agent) -> None: ...
    def follow(self) -> None: ...
    def tell(self, state) -> None: ...
    def end(self, state) -> None: ...
    def close(self) -> None: ...


@pytest.mark.parametrize("learn", [train, train_async])
def test_a_circle_stays_where_the_robot_stood_first_when_its_run_goes_on(tmp_path, monkeypatch, learn):
    # The acting process alone has to do with circles.
    monkeypatch.setattr(async_training, "LearnerProcess", NoLearner)

    class Placed(Robot):
        """One whose circle nobody chose."""

        def __init__(self, x, origin=None):
            super().__init__(0.0)
            self.x, self.origin = x, origin

        def reset(self, *, seed=None, options=None):
            self.origin = self.origin or (self.x, -0.3)
            return super().reset(seed=seed)

    def walked(folder, robot, steps):
        learn(robot, folder=folder, steps=steps, seed=0, settings=SMALL)
        return robot.origin

    assert walked(tmp_path / "a", Placed(0.75), 5) == (0.75, -0.3)
    assert walked(tmp_path / "a", Placed(0.2), 10) == (0.75, -0.3)
    assert walked(tmp_path / "b", Placed(0.2), 5) == (0.2, -0.3), "another run has its own"
    # Whoever has chosen is asked for nothing.
    assert walked(tmp_path / "c", Placed(0.2, (0.1, 0.1)), 5) == (0.1, 0.1)
    assert not (tmp_path / "c" / "circle.json").exists()
    (tmp_path / "a" / "circle.json").write_text('{"origin_m": [1]}')
    with pytest.raises(BadInput, match=r"circle.json.*no circle's centre.*delete it"):
        walked(tmp_path / "a", Placed(0.2), 15)


def test_what_is_wrong_in_a_run_shows_in_one_line_before_a_learner_starts(tmp_path, monkeypatch):
    class Unplaced(Robot):
        """One whose circle nobody chose."""

        origin = None

    def refused(spoil, words):
        run = shutil.copytree(tmp_path / "good", tmp_path / str(len(list(tmp_path.iterdir()))))
        spoil(run)
        with pytest.raises(BadInput, match=words) as caught:
            train_async(Unplaced(), folder=run, steps=60, seed=0, settings=SMALL)
        assert "\n" not in str(caught.value)

    def damaged(**changes):
        def spoil(run):
            checkpoint = {**load_checkpoint(run), **changes}
            torch.save({name: value for name, value in checkpoint.items() if value is not None}, run / "checkpoint.pt")

        return spoil

    train_async(Robot(), folder=tmp_path / "good", steps=40, seed=0, settings=SMALL)

    def started(*arguments):
        raise AssertionError("a learner was started")

    monkeypatch.setattr(async_training, "LearnerProcess", started)
    refused(lambda run: (run / "circle.json").write_text("{"), "circle.json.*delete it")
    refused(lambda run: (run / "circle.json").write_text('{"origin_m": ["x", 1]}'), "no circle's centre.*delete it")
    refused(lambda run: (run / "checkpoint.pt").write_bytes(b"x"), "damaged or none of ours")
    refused(damaged(agent={}), "of an agent with other networks")
    refused(damaged(agent=None), "not as its run.json and this program have it")
    refused(damaged(helped=3), "run.json and this program have it")
    refused(lambda run: os.truncate(run / "transitions.f32", 8), "bytes of the .* that its checkpoint speaks of")


def rows_so_far(folder: Path) -> np.ndarray:
    data = (folder / "transitions.f32").read_bytes()
    return np.frombuffer(data[: len(data) // (4 * WIDTH) * 4 * WIDTH], np.float32).reshape(-1, WIDTH)


def wait_for_the_learner(folder: Path) -> None:
    while not (folder / "checkpoint.pt").is_file():
        time.sleep(0.05)


def test_a_learner_that_dies_is_told_and_the_same_call_goes_on(tmp_path, monkeypatch):
    class Fatal(Robot):
        def step(self, action):
            if self.taken == 40:
                [process] = started
                os.kill(process.pid, signal.SIGKILL)
                process.wait()
            return super().step(action)

    started = []
    popen = subprocess.Popen

    def remember(*arguments, **options):
        started.append(popen(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(async_training.subprocess, "Popen", remember)
    with pytest.raises(HardwareFault, match=r"the learner has died \(exit status -9\) → repeat the command"):
        train_async(Fatal(), folder=tmp_path, steps=200, seed=0, settings=SMALL)
    assert len(rows(tmp_path)) >= 40
    monkeypatch.undo()
    assert train_async(Robot(), folder=tmp_path, steps=60, seed=0, settings=SMALL).step == 60


def test_nothing_is_learned_from_what_is_no_number(tmp_path):
    with pytest.raises(BadInput, match="step 24 gave a reward or an observation that is no number"):
        train_async(Robot(nan_at=25), folder=tmp_path / "a", steps=60, seed=0, settings=SMALL)
    assert np.isfinite(rows(tmp_path / "a")).all()
    assert load_checkpoint(tmp_path / "a")["transitions"] == 24
    huge = SacSettings(learning_start=20, batch=16, hidden=16, reward_scale=1e38)
    with pytest.raises(BadInput, match="weights or losses are no finite numbers any more"):
        train_async(Robot(2e-2), folder=tmp_path / "b", steps=3000, seed=0, settings=huge)
    with pytest.raises(BadInput, match="weights or losses are no finite numbers any more"):
        train(Robot(0.0), folder=tmp_path / "c", steps=200, seed=0, settings=huge)


def test_shared_weights_come_whole():
    ours = SharedWeights(1000)
    theirs = SharedWeights(1000, os.dup(ours.fd))
    out = np.zeros(1000, np.float32)
    for k in range(1, 5):
        ours.publish(np.full(1000, k, np.float32), updates=10 * k)
        assert theirs.take(out) == k
        assert (out == k).all()
        assert theirs.updates == 10 * k
    ours.close()
    theirs.close()
