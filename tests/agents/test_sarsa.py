"""SARSA(λ): the tile coder against a plain one, the update against its equations, primitives that never jump, and runs
that no kill undoes."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

import openant_env  # noqa: E402, F401
from openant_agents import sarsa, tile_coding, training  # noqa: E402
from openant_agents.interventions import read_interventions  # noqa: E402
from openant_agents.policies import load_policy  # noqa: E402
from openant_agents.primitives import LEGS, PRIMITIVES, PrimitiveGait  # noqa: E402
from openant_agents.runs import load_checkpoint, read_curve  # noqa: E402
from openant_agents.sarsa import Sarsa, SarsaSettings, train  # noqa: E402
from openant_agents.tile_coding import TileCoder  # noqa: E402
from openant_tools.cli import main  # noqa: E402
from openant_tools.errors import BadInput, HardwareFault  # noqa: E402
from openant_tools.robot.folder import create_robot  # noqa: E402

JOINTS = tuple(f"{part}_{leg}" for leg in LEGS for part in ("hip", "knee"))
#: bounds are known after five decisions; a small table, otherwise the real thing
QUICK = SarsaSettings(bounds_from_s=2.5, table=2**17, tilings=24)


def ant(**options):
    return gymnasium.make("openant/Ant-v0", **{"dt": 0.05, "action_range": "sarsa", **options})


def run_command(*arguments) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code


# ------------------------------------------------------------------------------------------------------- tile coding


def plain_tiles(values, tilings):
    """The boxes of a point whose unit is one tile, as the literature has them: no arrays, no tricks."""
    boxes = []
    for tiling in range(tilings):
        box = [tiling]
        for i, value in enumerate(values):
            in_steps = int(np.floor(value * tilings))  # a tile is `tilings` steps of displacement wide
            displacement = tiling * (1 + 2 * i)
            box.append((in_steps + displacement) // tilings)
        boxes.append(tuple(box))
    return boxes


@settings(max_examples=30)
@given(st.data(), st.integers(1, 6), st.integers(1, 16), st.sampled_from([1, 3, 8, 24]))
def test_the_tile_coder_is_exact(data, inputs, tiles, tilings):
    # Sixteenths: what a division cannot round to the other side of a tile's edge.
    point = st.lists(st.integers(0, 16 * tiles).map(lambda k: k / 16), min_size=inputs, max_size=inputs)
    points = data.draw(st.lists(point, min_size=1, max_size=12))
    low = np.full(inputs, -3.0)
    coder = TileCoder(low, low + tiles, tiles=tiles, tilings=tilings, rows=2**15)
    row_of: dict[tuple, int] = {}
    for values in points:
        rows = coder.rows_of(np.array(values) - 3.0)
        # rows are given in the order in which boxes appear
        assert rows.tolist() == [row_of.setdefault(box, len(row_of)) for box in plain_tiles(values, tilings)]
    assert coder.used == len(row_of)
    assert coder.shared == 0


def test_what_lies_beyond_the_bounds_counts_as_their_end():
    coder = TileCoder(np.zeros(2), np.ones(2), tiles=4, tilings=8, rows=1000)
    inside = coder.rows_of(np.array([1.0, 0.0]))
    assert (coder.rows_of(np.array([1e9, -1e9])) == inside).all()
    assert coder.used == 8


def test_a_full_table_shares_rows_and_counts_it():
    random = np.random.default_rng(0)
    coder = TileCoder(np.zeros(4), np.ones(4), tiles=8, tilings=16, rows=64)
    points = random.uniform(size=(50, 4))
    row_of: dict[tuple, int] = {}
    shared = 0
    for point in points:
        rows = coder.rows_of(point)
        for box, row in zip(plain_tiles((point * 8).tolist(), 16), rows, strict=True):
            if box in row_of or len(row_of) < 64:
                assert row == row_of.setdefault(box, len(row_of))
            else:
                shared += 1
                assert 0 <= row < 64
    assert coder.used == 64
    assert coder.shared == shared > 100
    # Playing alone gives no rows away and counts nothing that is not there.
    fresh = TileCoder(np.zeros(4), np.ones(4), tiles=8, tilings=16, rows=64)
    assert (fresh.rows_of(points[0], learn=False) == 64).all()
    assert fresh.used == 0


def test_boxes_keep_their_rows_when_there_is_room_for_more(monkeypatch):
    monkeypatch.setattr(tile_coding, "PLACES", 64)
    points = np.random.default_rng(1).uniform(size=(300, 3))
    coder = TileCoder(np.zeros(3), np.ones(3), tiles=8, tilings=16, rows=2**15)
    seen = [coder.rows_of(point) for point in points]
    assert coder.used > 1000
    assert coder.used == len(np.unique(np.concatenate(seen)))
    assert all((coder.rows_of(point) == rows).all() for point, rows in zip(points, seen, strict=True))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"high": np.array([1.0, 0.0])}, "the bounds of observation 1 leave no room for tiles: 0 to 0"),
        ({"high": np.array([np.inf, 1.0])}, "the bounds of observation 0 leave no room"),
        ({"tiles": 0}, "0 tiles along a range"),
        ({"tilings": 0}, "0 tilings in a table of 100 rows"),
    ],
)
def test_bounds_that_leave_no_room_are_refused(change, words):
    with pytest.raises(BadInput, match=words):
        TileCoder(**{"low": np.zeros(2), "high": np.ones(2), "tiles": 4, "tilings": 8, "rows": 100, **change})


# -------------------------------------------------------------------------------------------------------- primitives


def test_no_joint_ever_jumps_and_idle_joints_hold():
    gait = PrimitiveGait(JOINTS, 0.05)
    random = np.random.default_rng(0)
    hip = np.array([joint.startswith("hip") for joint in JOINTS])
    last = np.zeros(8)
    for primitive in [4, 6, 5, 7, *random.integers(0, 8, 60).tolist()]:
        words = [word for word in PRIMITIVES[primitive].split() for _ in range(2)]
        sequence = gait.actions(primitive)
        assert sequence.shape == (10, 8)
        steps = np.diff(np.vstack((last, sequence)), axis=0)
        assert np.abs(steps[:, hip]).max() <= 0.2 + 1e-12  # from end to end in ten steps
        assert np.abs(steps[:, ~hip]).max() <= np.sin(np.pi / 10) + 1e-12
        for k, word in enumerate(words):
            if word == ".":
                assert (sequence[:, k] == last[k]).all()
            elif hip[k]:
                assert sequence[-1, k] == (1.0 if word[0] == "+" else -1.0)
            else:
                assert sequence[4, k] == pytest.approx(1.0 if "up" in word else -1.0)
                assert sequence[-1, k] == 0.0
        last = sequence[-1]
        gait.sent(last)
    gait.rest()
    assert (gait.last == 0.0).all()


def test_primitives_follow_the_order_of_the_joints_and_refuse_others():
    reordered = tuple(reversed(JOINTS))
    assert (PrimitiveGait(reordered, 0.1).actions(3) == PrimitiveGait(JOINTS, 0.1).actions(3)[:, ::-1]).all()
    with pytest.raises(BadInput, match="not pole"):
        PrimitiveGait(("pole",), 0.05)
    with pytest.raises(BadInput, match=r"steps of 0\.12 s do not divide a motion primitive of 0\.5 s"):
        PrimitiveGait(JOINTS, 0.12)


# ------------------------------------------------------------------------------------------------------------ update


def plain_sarsa(transitions, rows, actions, settings):
    """SARSA(λ) with a full table of traces, as the book has it."""
    w, z = np.zeros((rows, actions)), np.zeros((rows, actions))
    for tiles, action, reward, seconds, next_tiles, next_action, terminated in transitions:
        gamma = settings.gamma ** (seconds / 0.05)
        lam = settings.trace ** (seconds / 0.05)
        for tile in tiles:
            z[tile, action] += 1.0
        following = 0.0 if terminated else w[next_tiles, next_action].sum()
        delta = settings.reward_scale * reward + gamma * following - w[tiles, action].sum()
        w += settings.step_size * delta * z
        z *= gamma * lam
    return w


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_the_update_is_that_of_the_book(seed):
    random = np.random.default_rng(seed)
    chosen = SarsaSettings(step_size=0.01, trace=0.9, gamma=0.99)
    coder = TileCoder(np.zeros(1), np.ones(1), tiles=4, tilings=6, rows=50)
    agent = Sarsa(coder, 3, chosen, seed=0)

    def somewhere():  # of each tiling one of eight boxes
        return np.arange(6) * 8 + random.integers(0, 8, 6)

    transitions = [
        (
            somewhere(), int(random.integers(3)), float(random.normal()),
            float(random.choice([0.5, 0.3])), somewhere(), int(random.integers(3)),
            bool(random.random() < 0.05),
        )
        for _ in range(60)
    ]  # fmt: skip
    for tiles, action, reward, seconds, next_tiles, next_action, terminated in transitions:
        agent.learn(tiles, action, reward, seconds, next_tiles, next_action, terminated=terminated)
    # Forgotten traces were below 1e-4 of their first strength.
    plain, rows = plain_sarsa(transitions, 50, 3, chosen), somewhere()
    assert agent.values(rows) == pytest.approx(plain[rows].sum(axis=0), abs=1e-2)
    agent.settle()
    assert agent.weights[:50] == pytest.approx(plain, abs=2e-3)
    assert agent.values(rows) == pytest.approx(plain[rows].sum(axis=0), abs=1e-2)
    assert agent.decisions == 60


def test_no_decision_waits_for_a_compiler(monkeypatch):
    made = [tile_coding._look_up, tile_coding._enter_all, sarsa._values, sarsa._pay]
    sarsa._compile()
    before = [len(function.signatures) for function in made]
    monkeypatch.setattr(tile_coding, "PLACES", 64)  # so that names need more room on the way
    agent = Sarsa(TileCoder(np.full(3, -1.0), np.ones(3), tiles=4, tilings=24, rows=2**12), 8, SarsaSettings(), seed=0)
    seen = np.random.default_rng(0).uniform(-1, 1, (60, 3)).astype(np.float32)
    for here, there in itertools.pairwise(seen):
        rows, following = agent.rows_of(here), agent.rows_of(there)
        agent.learn(rows, agent.choose(rows), 0.01, 0.5, following, agent.choose(following))
    agent.coder.rows_of(seen[0], learn=False)
    assert agent.coder.used > 64
    assert [len(function.signatures) for function in made] == before


def test_chance_and_ties():
    coder = TileCoder(np.zeros(1), np.ones(1), tiles=1, tilings=4, rows=10)
    agent = Sarsa(coder, 8, SarsaSettings(epsilon=0.0), seed=0)
    rows = np.arange(4)
    assert {agent.choose(rows) for _ in range(200)} == set(range(8))
    better = Sarsa(coder, 8, SarsaSettings(epsilon=0.0), seed=0)
    better.weights[0, 5] = 1e-6
    assert {better.choose(rows) for _ in range(50)} == {5}
    often = Sarsa(coder, 8, SarsaSettings(epsilon=0.255), seed=0)
    often.weights[0, 5] = 1.0
    picks = np.array([often.choose(rows) for _ in range(4000)])
    assert np.mean(picks != 5) == pytest.approx(0.255 * 7 / 8, abs=0.03)


def test_the_settings_are_the_papers():
    paper = SarsaSettings()
    assert (paper.gamma, paper.trace, paper.epsilon, paper.step_size) == (0.998, 0.964, 0.255, 1e-4)
    assert (paper.tiles, paper.tilings, paper.table) == (4, 192, 2**25)


# ------------------------------------------------------------------------------------------------------------- runs


def test_a_stopped_run_goes_on_bit_for_bit(tmp_path):
    whole = train(ant(), folder=tmp_path / "whole", steps=400, seed=1, settings=QUICK)
    for steps in (30, 200, 400):  # the first within the minute that measures the bounds
        train(ant(), folder=tmp_path / "parts", steps=steps, seed=1, settings=QUICK)
    assert whole.step == 400
    assert whole.robot_seconds == pytest.approx(20.0)
    one, two = load_checkpoint(tmp_path / "whole"), load_checkpoint(tmp_path / "parts")
    assert one["agent"] == two["agent"]
    assert one["agent"]["decisions"] == 35
    assert torch.equal(one["env"]["physics"], two["env"]["physics"])
    for name in ("transitions.f32", "learning_curve.csv"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()
    assert [point.step for point in read_curve(tmp_path / "whole")] == [200, 400]


def test_kill_minus_nine_costs_no_more_than_since_the_last_save(tmp_path):
    script = (
        "import gymnasium, pathlib, openant_env\n"
        "from openant_agents import sarsa, training\n"
        "training.CHECKPOINT_EVERY_S = 0.05\n"
        "env = gymnasium.make('openant/Ant-v0', dt=0.05, action_range='sarsa')\n"
        f"chosen = sarsa.SarsaSettings(bounds_from_s={QUICK.bounds_from_s}, table={QUICK.table}, tilings={QUICK.tilings})\n"
        f"sarsa.train(env, folder=pathlib.Path({str(tmp_path)!r}), steps=10**6, seed=1, settings=chosen)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "OMP_NUM_THREADS": "1"})
    log = tmp_path / "transitions.f32"

    def saved() -> int:
        return int(load_checkpoint(tmp_path)["step"]) if (tmp_path / "checkpoint.pt").exists() else 0

    try:
        deadline = time.monotonic() + 120
        while saved() <= 400:  # the log runs ahead of the checkpoint, so its length says nothing
            assert time.monotonic() < deadline, "it never saved"
            time.sleep(0.05)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    step = saved()
    assert step > 400
    result = train(ant(), folder=tmp_path, steps=step + 50, seed=1, settings=QUICK)
    assert result.step == step + 50
    # What the killed process had written beyond its last checkpoint is gone; what came after is what it would have been.
    train(ant(), folder=tmp_path.parent / "whole", steps=step + 50, seed=1, settings=QUICK)
    assert (tmp_path.parent / "whole" / "transitions.f32").read_bytes() == log.read_bytes()


class Falls(gymnasium.Wrapper):
    """The robot is set up again after every 1.2 s, in the middle of a primitive."""

    def __init__(self, env):
        super().__init__(env)
        self.since = 0

    def reset(self, **options):
        self.since = 0
        return self.env.reset(**options)

    def step(self, action):
        observation, reward, terminated, _, info = self.env.step(action)
        self.since += 1
        return observation, reward, terminated, self.since == 24, {**info, "reason": "a knot in the cable"}


def test_a_robot_that_is_set_up_again_cuts_its_primitive_and_starts_from_rest(tmp_path):
    result = train(Falls(ant()), folder=tmp_path, steps=240, seed=0, settings=QUICK)
    assert result.helped == {"a knot in the cable": 10}
    rows = np.fromfile(tmp_path / "transitions.f32", np.float32).reshape(-1, 53)
    # two primitives of 0.5 s and one cut after 0.2 s, again and again
    first = int(np.argmin(rows[:, 26]))
    assert rows[first : first + 4, 26].tolist() == pytest.approx([0.2, 0.5, 0.5, 0.2])
    # the cut one leads to what was seen last, the next begins where the robot was set down
    assert not np.array_equal(rows[first, 28:52], rows[first + 1, :24])
    assert np.array_equal(rows[first + 1, 28:52], rows[first + 2, :24])


def test_measured_bounds_are_used_and_only_the_others_are_measured(tmp_path):
    robot = create_robot(tmp_path / "my-ant")
    with ant(robot=robot.path) as env:
        names = env.unwrapped.observation_names
    directions = ("direction.along", "direction.left")
    everything = {f"observation.{name}": (-2.0, 2.5) for name in names if name not in directions}
    robot.update(everything)
    train(ant(robot=robot.path), folder=tmp_path / "known", steps=10, seed=0, settings=QUICK)
    checkpoint = load_checkpoint(tmp_path / "known")
    assert checkpoint["agent"]["decisions"] == 1  # no minute of chance before it learns
    low = dict(zip(names, checkpoint["bounds"][0].tolist(), strict=True))
    assert low["acc.z"] == -2.0
    assert low["direction.left"] == pytest.approx(-1.0, abs=1e-5)
    train(ant(), folder=tmp_path / "unknown", steps=60, seed=0, settings=QUICK)
    low = dict(zip(names, load_checkpoint(tmp_path / "unknown")["bounds"][0].tolist(), strict=True))
    assert -1.3 < low["pos.knee_rr"] < -0.9
    assert low["direction.left"] == pytest.approx(-1.0, abs=1e-5)


def test_numbers_that_are_none_stop_the_training(tmp_path):
    class Broken(gymnasium.Wrapper):
        def step(self, action):
            observation, *rest = self.env.step(action)
            return np.full_like(observation, np.nan), *rest

    with pytest.raises(BadInput, match="step 0 gave a reward or an observation that is no number"):
        train(Broken(ant()), folder=tmp_path, steps=100, seed=0, settings=QUICK)


def test_a_policy_plays_what_it_learned_and_only_where_it_fits(tmp_path):
    train(ant(), folder=tmp_path / "run", steps=300, seed=2, settings=QUICK)
    env = ant()
    policy = load_policy(tmp_path / "run", env)
    assert (policy.agent, policy.step) == ("sarsa", 300)
    observation, _ = env.reset(seed=0)
    policy.begin()
    actions = np.array([policy.likeliest(observation) for _ in range(10)])
    assert (np.abs(np.diff(actions, axis=0)) <= np.sin(np.pi / 10) + 1e-6).all()
    policy.begin()
    assert np.abs(policy.likeliest(observation)).max() < 0.32  # from rest again, not from where the joints were
    with pytest.raises(BadInput, match="trained with other dt"):
        load_policy(tmp_path / "run", ant(dt=0.1))
    train(ant(), folder=tmp_path / "young", steps=10, seed=2, settings=QUICK)
    with pytest.raises(BadInput, match="it had not begun to learn"):
        load_policy(tmp_path / "young", env)
    rows = np.fromfile(tmp_path / "run" / "transitions.f32", np.float32)
    rows[24 + 1 :: 53] *= 3.0  # other rewards than it had
    rows.tofile(tmp_path / "run" / "transitions.f32")
    with pytest.raises(BadInput, match="lead to other weights than they did"):
        load_policy(tmp_path / "run", env)
    rows[: 53 * 5].tofile(tmp_path / "run" / "transitions.f32")
    with pytest.raises(BadInput, match="its log has 5 of 25 decisions"):
        load_policy(tmp_path / "run", env)


def test_a_run_begins_with_the_agent_of_another_and_needs_it_no_more(tmp_path):
    source, again = tmp_path / "source", tmp_path / "again"
    train(ant(), folder=source, steps=300, seed=2, settings=QUICK)
    learned = load_checkpoint(source)["agent"]["decisions"]
    with pytest.raises(BadInput, match="another step size"):
        train(ant(), folder=again, steps=30, seed=5, settings=dataclasses.replace(QUICK, step_size=1e-3), source=source)
    train(ant(), folder=again, steps=100, seed=5, settings=QUICK, source=source)
    assert load_checkpoint(again)["agent"]["decisions"] == learned + 10, "it learns from the first decision on"
    log = (source / "transitions.f32").read_bytes()
    assert (again / "transitions.f32").read_bytes().startswith(log)
    shutil.rmtree(source)
    done = train(ant(), folder=again, steps=200, seed=5, settings=QUICK, source=source)
    assert done.step == 200
    assert load_policy(again, ant()).step == 200


def test_a_decision_never_waits_for_the_disk(tmp_path, monkeypatch):
    # A disk that hangs until the loop itself, 200 steps on, lets it go: whoever waited for it would wait for ever.
    from openant_agents import runs

    released, saves = threading.Event(), []
    real = runs.TrainingRun.save

    def hanging(self, *arguments):
        saves.append(self)
        assert released.wait(60)
        real(self, *arguments)

    class Counted(gymnasium.Wrapper):
        steps = 0

        def step(self, action):
            self.steps += 1
            if self.steps == 200:
                released.set()
            return self.env.step(action)

    monkeypatch.setattr(runs.TrainingRun, "save", hanging)
    monkeypatch.setattr(training, "CHECKPOINT_EVERY_S", 0.0)
    train(Counted(ant()), folder=tmp_path, steps=250, seed=0, settings=QUICK)
    assert len(saves) == 26  # one after each primitive, and the last
    assert load_checkpoint(tmp_path)["step"] == 250


def test_a_full_disk_is_told_and_not_passed_over(tmp_path, monkeypatch):
    from openant_agents import runs

    def full(self, *arguments):
        raise OSError(28, "No space left on device", str(tmp_path))

    monkeypatch.setattr(runs.TrainingRun, "save", full)
    with pytest.raises(OSError, match="No space left"):
        train(ant(), folder=tmp_path, steps=30, seed=0, settings=QUICK)


# -------------------------------------------------------------------------------------------------- the command line


def test_train_and_eval_from_the_command_line(tmp_path, capsys):
    out, answer = tmp_path / "run", tmp_path / "train.json"
    arguments = ("train", "sarsa", "--kit", "standard", "--seed", 1, "--out", out)
    assert run_command(*arguments, "--steps", 30) == 0
    assert "next: the same with more --steps" in capsys.readouterr().out, "what only explored cannot be evaluated"
    assert run_command(*arguments, "--steps", 1400, "--json", answer) == 0
    result = json.loads(answer.read_text())
    assert result["seconds"] == pytest.approx(70.0)
    assert result["decisions"] == 20
    assert result["collisions"] == 0
    assert (out / "learning_curve.png").stat().st_size > 5_000
    assert re.search(r"20 decisions; \d+ tiles seen, 0\.\d % of the table; no collision", capsys.readouterr().out)
    assert run_command("eval", out, "--seconds", 2, "--starts", 2, "--json", tmp_path / "eval.json") == 0
    assert json.loads((tmp_path / "eval.json").read_text())["step"] == 1400
    refused = [
        ((*arguments, "--epsilon", 0.1), "this folder holds another run: it differs in settings.epsilon"),
        (("train", "sarsa", "--kit", "lite", "--dt", 0.12, "--out", "x"), "do not divide a motion primitive"),
        (("train", "sac", "--kit", "standard", "--out", out), "this folder holds another run"),
    ]
    for words, message in refused:
        assert run_command(*words) == 2
        assert message in capsys.readouterr().err


def test_a_robot_that_cannot_go_on_leaves_a_run_that_can(tmp_path):
    class Breaks(gymnasium.Wrapper):
        steps = 0

        def step(self, action):
            self.steps += 1
            if self.steps == 155:
                raise HardwareFault("the bus is gone", remedy="plug it in")
            return self.env.step(action)

    with pytest.raises(HardwareFault, match="the bus is gone"):
        train(Breaks(ant()), folder=tmp_path, steps=300, seed=0, settings=QUICK)
    assert load_checkpoint(tmp_path)["agent"]["decisions"] == 10  # and five before the bounds were known
    assert train(ant(), folder=tmp_path, steps=300, seed=0, settings=QUICK).step >= 300


def test_a_step_that_was_not_carried_out_teaches_nothing(tmp_path):
    class Stopped(gymnasium.Wrapper):
        steps = 0

        def step(self, action):
            observation, reward, terminated, truncated, info = self.env.step(action)
            self.steps += 1
            if self.steps % 50 == 3:
                return observation, 0.0, False, True, {**info, "void": True, "reason": "the pause key"}
            return observation, reward, terminated, truncated, {**info, "overruns": 7}

    result = train(Stopped(ant()), folder=tmp_path, steps=200, seed=0, settings=QUICK)
    assert result.helped == {"the pause key": 5}
    assert result.late == 7
    rows = np.fromfile(tmp_path / "transitions.f32", np.float32).reshape(-1, 53)
    assert rows[:, 26].tolist() == pytest.approx([0.5] * len(rows))
    assert [event.reason for event in read_interventions(tmp_path)] == ["the pause key"] * 5
