"""Curves of several seeds, reward drops, and whether a simulation ranks policies as the robot does."""

from __future__ import annotations

import itertools
import json
import math
import re

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("torch")

import openant_env  # noqa: F401
from openant_agents.curves import band, group_runs, read_run_curve
from openant_agents.drops import DropWatch, find_drops, preceding
from openant_agents.exploits import Late, Lossy, Smoothed, TwitchCounter, flag
from openant_agents.interventions import Intervention, read_interventions
from openant_agents.places import simulated_options
from openant_agents.ranking import PlaceResult, agreement, kendall, rank_violation, read_measured, regret, spearman
from openant_agents.runs import CurvePoint
from openant_agents.sac import SacSettings, train
from openant_agents.training import TrainingProgress
from openant_tools.cli import main
from openant_tools.errors import BadInput

SMALL = SacSettings(learning_start=60, batch=16, hidden=16)


def run_command(*arguments) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Four runs: three seeds of one, and one with another setting."""
    folder = tmp_path_factory.mktemp("runs")
    facts = {"id": "openant/Ant-v0", "options": {"kit": "standard", "dt": 0.02}}
    for name, seed, chosen in (
        ("one", 0, SMALL), ("two", 1, SMALL), ("three", 2, SMALL), ("bare", 0, SacSettings(**{**SMALL.as_dict(), "layer_norm": False})),
    ):  # fmt: skip
        env = gymnasium.make("openant/Ant-v0", kit="standard", dt=0.02)
        train(env, folder=folder / name, steps=220, seed=seed, settings=chosen, env_facts=facts)
    return folder


# ------------------------------------------------------------------------------------------------------------ curves


def test_runs_that_differ_in_the_seed_alone_are_drawn_together(runs, tmp_path, capsys):
    curves = [read_run_curve(runs / name) for name in ("one", "two", "three", "bare")]
    groups = group_runs(curves)
    assert list(groups) == ["sac, layer norm true", "sac, layer norm false"]
    together = band(groups["sac, layer norm true"])
    values = np.array([curve.speed for curve in curves[:3]])
    assert together.runs == 3
    assert together.mean == pytest.approx(values.mean(axis=0))
    assert together.error == pytest.approx(values.std(axis=0, ddof=1) / math.sqrt(3))
    (runs / "one" / "interventions.csv").write_text("step,seconds,reason\n150,3.0,a knot\n200,4")
    out = tmp_path / "curves.png"
    assert (
        run_command("plot", *(runs / name for name in ("one", "two", "three", "bare")), "--out", out, "--singly") == 0
    )
    printed = capsys.readouterr().out
    assert "(3 standard errors) cm/s after 0 min, 3 seeds, 1 intervention" in printed
    assert out.stat().st_size > 10_000
    assert read_interventions(runs / "one") == [Intervention(150, 3.0, "a knot")]
    (runs / "one" / "interventions.csv").unlink()
    assert run_command("plot", tmp_path) == 2
    assert "there is no learning curve here" in capsys.readouterr().err
    assert run_command("plot", runs / "one", "--out", tmp_path / "curves.doc") == 2
    assert "pictures of the kind .doc cannot be written" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------------------------- drops


def curve_of(*parts):
    """Average rewards (m/s) held for so many minutes each, a point every 10 s of 0.12 s steps."""
    values = [value for value, minutes in parts for _ in range(round(6 * minutes))]
    return [CurvePoint(round(10 * k / 0.12), 10.0 * k, value) for k, value in enumerate(values, start=1)]


def test_drops_are_found_and_learning_is_none():
    assert find_drops(curve_of((0.0, 10), (0.02, 2), (0.0, 5), (0.1, 30))) == []  # not yet walking steadily
    assert find_drops(curve_of((0.001, 10), (0.0, 30))) == []
    points = curve_of((0.0, 5), (0.12, 20), (0.005, 10), (0.1, 10), (0.01, 5))
    first, second = find_drops(points)
    assert first.from_s == pytest.approx(25 * 60 + 10)
    assert first.until_s == pytest.approx(35 * 60 + 10)
    assert (first.best_m_s, first.lowest_m_s) == (0.12, 0.005)
    assert second.until_s is None


def test_the_checkpoint_before_a_drop_is_kept(tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"as it was")
    watch = DropWatch(tmp_path)
    found = [
        watch.see(TrainingProgress(point.step, 10**6, point.seconds, point.average_reward_m_s, True, {}))
        for point in curve_of((0.1, 10), (0.0, 5))
    ]
    watch.finish()
    (drop,) = [one for one in found if one is not None]
    assert (tmp_path / "drops" / f"{drop.step}.pt").read_bytes() == b"as it was"


def test_what_preceded_a_drop_is_told(runs):
    # The log of this run is 6 s long: a drop at its end, seen through windows of the same length.
    from openant_agents import drops

    drop = drops.Drop(300, 6.0, None, 0.1, 0.0)
    drops_window, drops.WINDOW_S = drops.WINDOW_S, 3.0
    try:
        told = preceding(runs / "one", drop)
    finally:
        drops.WINDOW_S = drops_window
    # exploring evenly until step 60, then a policy that has hardly learned
    assert told["walking"]["action_size"] > 0.2
    assert set(told["walking"]) >= {"reward_m_s", "actions_at_their_ends", "joint_speed_rad_s", "pos.knee_fl", "acc.z"}
    assert len(told["changed_most"]) == 5
    assert told["falling"]["interventions"] == []


# ----------------------------------------------------------------------------------------------------------- ranking


def test_figures_of_a_case_done_by_hand():
    simulated, real = np.array([5.0, 4.0, 3.0]), np.array([1.0, 3.0, 2.0])
    # 0 ≻ 1 and 0 ≻ 2 in the simulation, the other way round on the robot; 1 ≻ 2 in both
    assert rank_violation(simulated, real) == pytest.approx((2 + 2 + 1) / 3)
    assert regret(simulated, real) == 2.0
    found = agreement([PlaceResult.of([v]) for v in simulated], [PlaceResult.of([v]) for v in real])
    assert found.spearman.value == pytest.approx(-0.5)
    assert found.kendall.value == pytest.approx(-1 / 3)
    assert found.regret_share == pytest.approx(2 / 3)
    assert found.best_is == 3
    with pytest.raises(BadInput, match="2 policies cannot be ranked"):
        agreement([PlaceResult.of([1.0])] * 2, [PlaceResult.of([1.0])] * 2)


@settings(max_examples=30)
@given(st.lists(st.floats(-1, 1, allow_nan=False), min_size=3, max_size=8, unique=True), st.integers(0, 100))
def test_rank_violation_is_what_its_definition_says(real, seed):
    simulated = np.random.default_rng(seed).normal(size=len(real))
    worst = [
        max(abs(real[i] - real[j]) * ((simulated[i] > simulated[j]) != (real[i] > real[j])) for j in range(len(real)))
        for i in range(len(real))
    ]
    assert rank_violation(simulated, np.array(real)) == pytest.approx(sum(worst) / len(worst))
    assert rank_violation(np.array(real), np.array(real)) == 0.0


def test_correlations_are_scipys_ties_included():
    from scipy.stats import kendalltau, spearmanr

    random = np.random.default_rng(0)
    for _ in range(20):
        a, b = random.integers(0, 5, 9).astype(float), random.normal(size=9)
        assert spearman(a, b) == pytest.approx(spearmanr(a, b).statistic)
        assert kendall(a, b) == pytest.approx(kendalltau(a, b).statistic)
    assert math.isnan(spearman(np.ones(4), np.arange(4.0)))


def test_intervals_grow_with_what_is_not_known():
    random = np.random.default_rng(0)
    truth = np.linspace(0.0, 0.2, 12)
    sure = [PlaceResult.of(v + random.normal(0, 0.001, 3)) for v in truth]
    unsure = [PlaceResult.of(v + random.normal(0, 0.1, 3)) for v in truth]
    known, unknown = agreement(sure, sure), agreement(sure, unsure)
    assert known.spearman.low > 0.9
    assert unknown.spearman.high - unknown.spearman.low > known.spearman.high - known.spearman.low


# ---------------------------------------------------------------------------------------------------------- exploits


class Echo(gymnasium.Env):
    """Does what it is told and tells it back; each step takes 0.1 s."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    dt = 0.12

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.array(action, np.float32), 0.0, False, False, {"dt": 0.1}


def test_disturbances_do_what_they_say():
    late = Late(Echo())
    late.reset()
    assert late.step(np.array([1.0, 0.5]))[0].tolist() == [0.0, 0.0]
    assert late.step(np.zeros(2))[0].tolist() == [1.0, 0.5]
    smoothed = Smoothed(Echo())
    smoothed.reset()
    assert smoothed.step(np.ones(2))[0] == pytest.approx([1 - math.exp(-1)] * 2)
    lossy = Lossy(Echo())
    lossy.reset()
    seen = [lossy.step(np.full(2, k / 1000))[0][0] for k in range(1, 1001)]
    assert np.mean(np.diff(seen) == 0.0) == pytest.approx(0.2, abs=0.05)


def test_twitching_is_counted_and_flagged():
    for actions, hz in (
        (itertools.cycle([-1.0, 1.0]), 10.0),
        (iter(np.sin(np.arange(0, 40, 0.2))), 2 / (2 * np.pi / 0.2 * 0.1)),
        (itertools.repeat(0.3), 0.0),
    ):
        twitch = TwitchCounter(Echo())
        twitch.reset()
        for _ in range(200):
            twitch.step(np.full(2, next(actions)))
        assert twitch.reversals_hz == pytest.approx(hz, rel=0.1, abs=0.01)
    found = flag("jitter", 0.2, {"smoothed commands": 0.01, "late commands": 0.15}, 8.0)
    assert found is not None
    assert found.words == "jitter does not stand smoothed commands (keeps 5 %); its joints turn back 8.0 times a second"
    assert flag("walks", 0.2, {"smoothed commands": 0.15}, 1.0) is None
    assert flag("stands", 0.001, {"smoothed commands": 0.0}, 1.0) is None


# -------------------------------------------------------------------------------------------------- the command line


def test_policies_are_played_and_ranked_from_the_command_line(runs, tmp_path, capsys):
    played = tmp_path / "nominal.json"
    words = (
        "policies",
        "play",
        "--policies",
        runs,
        "--on",
        "nominal",
        "--seconds",
        0.4,
        "--starts",
        2,
        "--json",
        played,
    )
    assert run_command(*words) == 0
    measured = read_measured(played)
    assert set(measured) == {"one", "two", "three", "bare"}
    assert len(measured["one"].plays) == 2
    assert set(measured["one"].likeliest) == {"median", "low", "high", "stood_still"}
    assert re.search(r"one +sampled .* in 2 starts\), likeliest ", capsys.readouterr().out)
    before = played.read_bytes()
    assert run_command(*words) == 0  # nothing left to play
    assert played.read_bytes() == before
    real = tmp_path / "real.json"
    real.write_text(json.dumps({"policies": {"one": 0.01, "two": 0.05, "three": 0.03, "bare": 0.0}}))
    capsys.readouterr()
    assert run_command(
        "policies", "rank", "--policies", runs, "--real", real, "--sim", f"nominal={played}", "--sim", "lite=nominal:lite",
        "--seconds", 0.2, "--starts", 1, "--report", tmp_path / "report", "--json", tmp_path / "rank.json",
    ) == 0  # fmt: skip
    printed = capsys.readouterr().out
    assert printed.splitlines()[1].startswith("two ")  # the best on the robot first
    assert "nominal: Spearman" in printed
    answer = json.loads((tmp_path / "rank.json").read_text())
    assert answer["agreement"]["lite"]["policies"] == 4
    assert answer["policies"]["two"]["real_m_s"] == 0.05
    page = (tmp_path / "report" / "report.html").read_text()
    assert "<svg" in page
    assert "Regret: by how much the simulation" in page, "what its columns are is said beside them"


def test_what_was_learned_on_a_robot_walks_in_its_simulation_without_the_robots_own_options(tmp_path):
    on_robot = {"robot": "/ant", "dt": 0.12, "virtual": "default", "clock": "stepped", "record_pictures": True}
    assert simulated_options(on_robot, None) == {"robot": "/ant", "dt": 0.12}
    assert simulated_options({"kit": "lite"}, tmp_path) == {"robot": str(tmp_path)}


def test_what_cannot_be_ranked_is_refused_in_one_line(runs, tmp_path, capsys):
    good = tmp_path / "good.json"
    good.write_text(json.dumps({"policies": {"one": 0.01, "two": 0.05, "three": 0.03}}))
    (tmp_path / "odd.json").write_text('{"policies": 3}')
    (tmp_path / "nan.json").write_text('{"policies": {"one": NaN}}')
    (tmp_path / "few.json").write_text('{"policies": {"one": 0.1}}')
    rank = ("policies", "rank", "--policies", runs, "--real", good)
    refused = [
        ((*rank, "--sim", "nominal"), "--sim nominal is not NAME=PLACE"),
        ((*rank, "--sim", "a=nominal", "--sim", "a=nominal"), "two simulations are called a"),
        ((*rank, "--sim", "real=nominal"), "a simulation is called real, which is the robot"),
        ((*rank, "--sim", f"a={tmp_path}/odd.json"), "it does not say what policies achieved"),
        ((*rank, "--sim", f"a={tmp_path}/nan.json"), "a reward in it is no number"),
        ((*rank, "--sim", f"a={tmp_path}/few.json"), "a has no reward of three"),
        ((*rank, "--sim", "a=mars"), "there is no such place: mars"),
        ((*rank, "--sim", f"a=hardware:{tmp_path}"), "would walk and nobody"),
        ((*rank, "--sim", f"a={good}", "--flag-by", "b"), "no simulation is called b"),
        (("policies", "play", "--policies", tmp_path, "--on", "nominal", "--json", "x"), "there are no policies here"),
        (("policies", "play", "--policies", runs, "--on", f"hardware:{tmp_path}", "--json", "x"), "would walk and nobody"),
    ]  # fmt: skip
    for words, message in refused:
        assert run_command(*words) == 2, words
        printed = capsys.readouterr().err
        assert message in printed, words
        assert "Traceback" not in printed
