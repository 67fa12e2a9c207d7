"""Simulated robots of the diagnosis: the same physics as rollouts, and every cause of the catalogue shows."""

from __future__ import annotations

import dataclasses
import itertools
import os
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Form, Robot
from openant_tools.errors import BadInput
from openant_tools.gap.features import COLUMNS
from openant_tools.gap.judge import Judge, metric_of, train
from openant_tools.gap.kept import judge_of
from openant_tools.gap.population import Case, draw, play, robot_of, templates
from openant_tools.gap.prepare import CACHE_VARIABLE, Kept, Prepared, cache_folder, prepare
from openant_tools.gap.protocol import Protocol, same
from openant_tools.gap.simulation import simulate
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path

RATE_HZ = 50


def commanded(setup: str, seconds: float = 2.0, seed: int = 0) -> Run:
    """A run that has commands, and positions only at its start."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    columns = {}
    for joint in JOINT_NAMES:
        home = 0.0 if joint.startswith("hip") else 0.5
        swing = 0.25 if setup == "stand" else 0.08
        command = home + swing * np.sin(2 * np.pi * rng.uniform(0.4, 1.2) * t + rng.uniform(0, 6))
        command[t < 0.3] = command[0]
        columns[f"cmd.{joint}"] = columns[f"pos.{joint}"] = command
    return Run(setup, Facts(joints=tuple(JOINT_NAMES), setup=setup, heading_rad=0.0), t, columns)


@pytest.fixture(scope="module")
def protocol() -> Protocol:
    runs = [commanded("stand"), commanded("floor", 1.6)]
    return Protocol.of(runs, MODEL, JOINT_NAMES, [None, None]).coarse()


MODEL = nominal_model_path()


@pytest.mark.parametrize("setup", list(Setup))
def test_a_robot_as_the_model_says_moves_as_its_rollout(setup: Setup) -> None:
    plant = load_plant(MODEL, JOINT_NAMES, setup)
    rollouts = Rollouts(plant, [commanded(str(setup), 1.0)])
    found = simulate(rollouts, [Robot(8)]).signals
    assert np.allclose(found["pos"][0], rollouts().pos[0], atol=1e-5)
    assert np.allclose(found["vel"][0], rollouts().vel[0], atol=1e-4)
    assert set(found) == {"pos", "vel", "torque", "volt", *(COLUMNS if setup is Setup.FLOOR else ())}


def test_commands_that_come_by_chance_come_so_to_no_other_robot() -> None:
    rollouts = Rollouts(load_plant(MODEL, JOINT_NAMES, Setup.STAND), [commanded("stand", 1.0)])
    late, losing = Robot(8), Robot(8)
    late.jitter_s = 0.03
    losing.dropout[:], losing.longest_s = 0.3, 0.1
    plain, scattered, lost, again = simulate(rollouts, [Robot(8), late, losing, Robot(8)]).signals["pos"]
    assert np.abs(scattered - plain).max() > 1e-3
    assert np.abs(lost - plain).max() > 1e-3
    assert np.array_equal(again, plain)


def test_every_cause_of_the_catalogue_shows(protocol: Protocol) -> None:
    strongest: dict[str, Case] = {}
    for case in templates(protocol):
        ((name, (joints, _)),) = case.causes.items()
        if catalogue()[name].of_body or len(joints) == 8 or name not in strongest:
            strongest[name] = case
    assert set(strongest) == set(catalogue())
    features = play(protocol, [Case({}, -1), *strongest.values()], 0)
    moved = {name: max(float(np.abs(x[row] - x[0]).max()) for x in features) for row, name in enumerate(strongest, 1)}
    assert all(np.isfinite(x).all() for x in features)
    silent = [name for name, size in moved.items() if size < 1e-3]
    # What breaks only under heavy load or in long runs may stay silent in these two seconds.
    assert set(silent) <= {"thermal_derating", "blocked_joint"}


def test_a_run_that_was_warmer_begins_warmer() -> None:
    cool, warm = commanded("stand", 1.0), commanded("stand", 1.0, seed=1)
    columns = dict(warm.columns)
    for joint in JOINT_NAMES:
        cool.columns[f"temp.{joint}"] = np.full(len(cool.t), 28.0)
        columns[f"temp.{joint}"] = np.full(len(warm.t), 40.0 if joint == "knee_fl" else 28.0)
    columns["temp.hip_rr"][3] = 127.0  # a glitch
    warm = dataclasses.replace(warm, columns=columns)
    protocol = Protocol.of([cool, warm, commanded("stand", 1.0, seed=2)], MODEL, JOINT_NAMES, [None] * 3)
    knee = JOINT_NAMES.index("knee_fl")
    assert [one.warm_c.tolist() for one in protocol.runs] == [
        [0.0] * 8,
        [12.0 * (j == knee) for j in range(8)],
        [0.0] * 8,
    ]
    weakening = Robot(8)
    weakening.derating[:] = 0.03
    heated = weakening.copy()
    heated.heat_c = 12.0
    rollouts = Rollouts(protocol.runs[1].plant, [warm])
    known = simulate(rollouts, [weakening], signals=("pos",), warm_c=[protocol.runs[1].warm_c]).signals["pos"][0]
    cold, hot = simulate(rollouts, [weakening, heated], signals=("pos",)).signals["pos"]
    assert np.abs(known[:, knee] - hot[:, knee]).max() < 1e-3 < np.abs(known[:, knee] - cold[:, knee]).max()


def test_the_same_seed_draws_the_same_robot(protocol: Protocol) -> None:
    assert draw(protocol, 5) == draw(protocol, 5)
    one, other = robot_of(protocol, draw(protocol, 5)), robot_of(protocol, draw(protocol, 5))
    assert np.array_equal(one.factor("stiffness"), other.factor("stiffness"))


def test_jitter_of_time_stamps_is_no_other_protocol(protocol: Protocol) -> None:
    run = commanded("stand")
    rng = np.random.default_rng(3)
    jittered = dataclasses.replace(run, t=run.t + rng.uniform(-0.002, 0.002, len(run.t)))
    other = commanded("stand", seed=9)
    first, again, different = (
        Protocol.of([r], MODEL, JOINT_NAMES, [None]).commands()[0] for r in (run, jittered, other)
    )
    assert same(first, again)
    assert not same(first, different)


@pytest.fixture
def prepare_few(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Protocol, int, list[Case]], Prepared]:
    """Prepare a protocol by so many robots and this bank, in a cache of its own."""

    def few(protocol: Protocol, robots: int, bank: list[Case]) -> Prepared:
        monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
        monkeypatch.setattr("openant_tools.gap.prepare.PART", robots)
        monkeypatch.setattr("openant_tools.gap.prepare.LEAST", robots)
        monkeypatch.setattr("openant_tools.gap.prepare.templates", lambda protocol: bank)
        return prepare(protocol, seconds=0.0)

    return few


def test_what_was_prepared_in_full_serves_a_part_of_it(
    protocol: Protocol, prepare_few: Callable[[Protocol, int, list[Case]], Prepared]
) -> None:
    whole = prepare_few(protocol, 4, templates(protocol)[:4])
    assert 4 <= len(whole.cases) < 2400, "the time was over at once"
    backwards = dataclasses.replace(protocol, runs=protocol.runs[::-1])
    assert len(prepare(backwards).cases) == len(whole.cases), "and stays over"
    part = prepare(dataclasses.replace(protocol, runs=protocol.runs[1:]))
    assert part.folder == whole.folder
    assert np.array_equal(part.features[0], whole.features[1])
    assert len(list(cache_folder().iterdir())) == 1


def test_a_judge_is_taught_once_in_a_process_and_written_nowhere(
    protocol: Protocol,
    prepare_few: Callable[[Protocol, int, list[Case]], Prepared],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taught: list[int] = []

    def train(prepared: Prepared, which: Sequence[int], columns: Sequence[NDArray[np.bool_]]) -> Judge:
        taught.append(sum(int(mine.sum()) for mine in columns))
        return object.__new__(Judge)

    def seeing(*signals: str) -> Protocol:
        known = dict.fromkeys(signals, np.zeros((1, 1, 1), np.float32))
        runs = [dataclasses.replace(one, seen={**one.seen, **known}) for one in protocol.runs]
        return dataclasses.replace(protocol, runs=tuple(runs))

    monkeypatch.setattr("openant_tools.gap.kept.train", train)
    few, told = prepare_few(protocol, 4, templates(protocol)[:4]), lambda share, words: None
    for signals, judges in [((), 1), ((), 1), (("base", "yaw"), 2), (("gyro",), 3), (("base", "yaw"), 3)]:
        judge_of(few, seeing(*signals), progress=told)
        assert len(taught) == judges, f"with {signals}"
    assert len(set(taught)) == len(taught)
    assert taught[0] == min(taught), "what saw positions alone"
    assert {path.suffix for path in few.folder.iterdir()} <= {".npz", ".json", ""}


def test_what_was_altered_in_the_cache_is_made_anew_and_runs_no_code(
    protocol: Protocol,
    prepare_few: Callable[[Protocol, int, list[Case]], Prepared],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def simulate(kept: Kept, coarse: Protocol, parts: Sequence[int], *_: object) -> None:
        for part in parts:  # four robots of two features, of each of two runs
            name = f"part-{part:04d}.npz" if part >= 0 else f"bank-{-part:04d}.npz"
            if not (kept.folder / name).exists():
                np.savez(kept.folder / name, run0=np.full((4, 2), part, np.float16), run1=np.ones((4, 2), np.float16))

    monkeypatch.setattr("openant_tools.gap.prepare._simulate", simulate)
    monkeypatch.setattr("openant_tools.gap.prepare.ROBOTS", 8)
    bank = templates(protocol)[:4]
    whole = prepare_few(protocol, 4, bank)
    before = [x.copy() for x in whole.features]
    assert whole.folder.stat().st_mode & 0o777 == whole.folder.parent.stat().st_mode & 0o777 == 0o700
    ran = whole.folder.parent / "code ran"
    attacks: dict[str, Callable[[Path], object]] = {
        "cut": lambda path: os.truncate(path, path.stat().st_size // 2),
        "emptied": lambda path: os.truncate(path, 0),
        "an array of objects": lambda path: np.savez(path, run0=np.array([Touches(ran)], object)),
        "a pickle": lambda path: path.write_bytes(pickle.dumps(Touches(ran))),
        "compressed a thousandfold": lambda path: np.savez_compressed(path, run0=np.zeros((999_000, 2))),
        "of another width": lambda path: np.savez(path, run0=np.zeros((4, 3), np.float16)),
    }
    files = itertools.cycle(("part-0001.npz", "first.npz", "bank-0001.npz", "protocol.npz"))
    for (attack, spoil), name in zip(attacks.items(), files, strict=False):
        spoil(whole.folder / name)
        caplog.clear()
        again = prepare_few(protocol, 4, bank)
        assert all(np.array_equal(x, y) for x, y in zip(again.features, before, strict=True)), (name, attack)
        assert len(caplog.records) == 1, (name, attack)
        assert name in caplog.text
        assert "anew" in caplog.text
    assert not ran.exists()


class Touches:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def test_the_cache_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    (tmp_path / "gap").mkdir(mode=0o777)
    assert cache_folder().stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(
        BadInput, match=r"the cache belongs to another user .* → name a folder of your own by OPENANT_CACHE"
    ):
        cache_folder()


def test_a_judge_says_how_strange_robots_are(
    protocol: Protocol, prepare_few: Callable[[Protocol, int, list[Case]], Prepared]
) -> None:
    bank = templates(protocol)[:64]
    whole = prepare_few(protocol, 128, bank)
    judge = train(whole, [0, 1], [np.ones(x.shape[1], bool) for x in whole.features])
    x = np.concatenate(whole.features, axis=1)
    energy = judge.energy(x)
    assert np.isfinite(energy).all()
    assert np.median(energy[whole.healthy()]) < 1
    said = judge.say(x[0])
    assert set(said.probability) == {name for case in bank for name in case.causes}
    assert said.energy == pytest.approx(energy[0])


def test_what_no_simulated_robot_showed_is_not_strange(
    protocol: Protocol, prepare_few: Callable[[Protocol, int, list[Case]], Prepared]
) -> None:
    one = dataclasses.replace(protocol, runs=protocol.runs[:1])
    whole = prepare_few(one, 40, [case for case in templates(one) if "stiffness_error" in case.causes][:40])
    x, unseen, seen = whole.features[0], 100, 101
    x[:, unseen] = 0.0  # a block that lay around a switch of torque in whose run came first
    metric = metric_of(whole, [0], [np.ones(x.shape[1], bool)])
    for feature, strange in ((unseen, False), (seen, True)):
        other = x[:1].copy()
        other[0, feature] += 0.1
        assert (float(np.abs(metric(other) - metric(x[:1])).max()) > 1) is strange


def test_a_robot_at_hand_is_simulated_from_where_the_first_one_began(protocol: Protocol) -> None:
    first = protocol.runs[0].run
    joint = JOINT_NAMES[0]
    for off, taken in ((0.004, True), (0.3, False)):
        columns = dict(first.columns)
        columns[f"pos.{joint}"] = first.column(f"pos.{joint}") + off
        at_hand = dataclasses.replace(
            protocol, runs=(dataclasses.replace(protocol.runs[0], run=dataclasses.replace(first, columns=columns)),)
        )
        begun = at_hand.started_as(dataclasses.replace(protocol, runs=protocol.runs[:1])).runs[0].run
        apart = abs(begun.column(f"pos.{joint}")[0] - first.column(f"pos.{joint}")[0])
        assert bool(apart < 1e-9) is taken


def test_a_protocol_begins_where_the_model_rests_and_not_where_the_first_robot_did(protocol: Protocol) -> None:
    """Its feet held a hip twisted as it came down, which says nothing of the robots that come after it."""
    for played in protocol.runs:
        rest = played.rest()
        assert rest == pytest.approx(played.run.signal("cmd", JOINT_NAMES)[0], abs=0.05), "where it was told to be"
        for off, own in ((0.03, False), (0.2, True)):
            columns = {
                **played.run.columns,
                **{f"pos.{name}": np.full(len(played.run.t), at) for name, at in zip(JOINT_NAMES, rest, strict=True)},
            }
            columns["pos.hip_rr"] = columns["pos.hip_rr"] + off
            twisted = dataclasses.replace(played, run=dataclasses.replace(played.run, columns=columns))
            begun = dataclasses.replace(protocol, runs=(twisted,)).at_rest().runs[0].run
            assert begun.column("pos.hip_rr")[0] == pytest.approx(rest[0] + own * off, abs=1e-6)
            assert begun.column("pos.hip_rr")[-1] == pytest.approx(rest[0] + off)


def test_a_servo_may_tell_what_it_asks_of_a_motor_that_gives_less() -> None:
    rollouts = Rollouts(load_plant(MODEL, JOINT_NAMES, Setup.STAND), [commanded("stand", 1.0)])
    given, asked = Robot(8), Robot(8)
    for robot, tells in ((given, False), (asked, True)):
        robot.form = Form(tells_asked=tells)
        for kind in ("stiffness", "torque_limit"):
            robot.weaken(kind, np.array([0]), 0.4)
    found = simulate(rollouts, [given, asked])
    moves, torque = found.signals["pos"], found.signals["torque"]
    assert np.array_equal(moves[0], moves[1]), "what is told moves nothing"
    assert torque[1, 5:, 0] == pytest.approx(torque[0, 5:, 0] / 0.4, rel=1e-3)
    assert np.array_equal(torque[0, :, 1:], torque[1, :, 1:])
