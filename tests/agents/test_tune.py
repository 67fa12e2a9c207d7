"""Searching settings: the paper's spaces, studies that several processes share and that a kill does not undo."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import gymnasium
import pytest

pytest.importorskip("torch")
optuna = pytest.importorskip("optuna")

import openant_env  # noqa: E402, F401
from openant_agents.tuning import SPACES, best_settings, open_study, search  # noqa: E402
from openant_tools.cli import main  # noqa: E402
from openant_tools.errors import BadInput  # noqa: E402


def run_command(*arguments) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code


def make_env():
    return gymnasium.make("openant/Ant-v0", dt=0.05, action_range="sarsa")


def test_the_spaces_are_the_papers():
    study = optuna.create_study()
    for _ in range(60):
        trial = study.ask()
        chosen = SPACES["sarsa"](trial)
        assert 0.01 <= chosen.epsilon <= 0.3
        assert 0.9 <= chosen.gamma <= 0.999
        assert 0.0 <= chosen.trace <= 0.99
        assert chosen.tiles in range(4, 17)
        assert chosen.tilings in {24 * k for k in range(2, 9)}
        assert 0.01 <= chosen.step_size * chosen.tilings <= 0.5
        assert 1.0 <= chosen.reward_scale <= 10.0
    study = optuna.create_study()
    seen = set()
    for _ in range(200):
        chosen = SPACES["sac"](study.ask())
        assert chosen.batch == 128
        assert chosen.learning_start == 2_000
        assert (chosen.entropy_start, chosen.entropy_step) in {(1.0, 1e-3), (0.2, 0.0)}
        seen.add((chosen.gamma_per_s, chosen.tau, chosen.actor_step, chosen.critic_step, chosen.policy_every))
    assert {one[0] for one in seen} == {0.98, 0.92}
    assert {one[2] for one in seen} == {3e-3, 1e-3, 3e-4, 1e-4}


def test_a_study_goes_on_and_is_shared(tmp_path):
    url, facts = f"sqlite:///{tmp_path}/tune.db", {"agent": "sarsa", "steps": 100}
    told = []
    study = open_study(url, "sarsa", facts)
    with pytest.raises(BadInput, match="no trial is complete yet"):
        best_settings(study)
    search(study, "sarsa", make_env, trials=1, steps=100, seeds=[0, 1], done=lambda _, trial: told.append(trial.value))
    # another process, for all that it knows
    other = open_study(url, "sarsa", facts)
    search(other, "sarsa", make_env, trials=2, steps=100, seeds=[0, 1])
    search(other, "sarsa", make_env, trials=2, steps=100, seeds=[0, 1])  # has enough
    assert len(study.trials) == 2
    trial = study.trials[0]
    assert told == [trial.value]
    assert trial.value == pytest.approx(sum(trial.user_attrs["average_reward_m_s"]) / 2)
    settings, value = best_settings(study)
    assert value == max(one.value for one in study.trials)
    assert settings["tilings"] % 24 == 0
    with pytest.raises(BadInput, match="searches something else: it differs in steps"):
        open_study(url, "sarsa", {"agent": "sarsa", "steps": 7})


def test_settings_that_come_to_nothing_are_an_answer_too(tmp_path, monkeypatch):
    from openant_agents import sarsa

    def diverge(*arguments, **options):
        raise BadInput("the values grew without bound")

    monkeypatch.setattr(sarsa, "train", diverge)
    study = open_study(f"sqlite:///{tmp_path}/tune.db", "sarsa", {})
    search(study, "sarsa", make_env, trials=2, steps=10, seeds=[0])
    assert [trial.state.name for trial in study.trials] == ["PRUNED", "PRUNED"]
    assert "grew without bound" in study.trials[0].user_attrs["failed"]


def test_processes_that_begin_a_study_together_all_work_on_it(tmp_path):
    opening = (
        "import pathlib, sys, time\n"
        "from openant_agents.tuning import open_study\n"
        "pathlib.Path(f'ready{sys.argv[1]}').touch()\n"
        "while len(list(pathlib.Path().glob('ready*'))) < 2: time.sleep(0.001)\n"
        "open_study('sqlite:///together.db', 'sarsa', {'agent': 'sarsa'})\n"
    )
    together = [subprocess.Popen([sys.executable, "-c", opening, str(i)], cwd=tmp_path) for i in range(2)]
    assert [process.wait() for process in together] == [0, 0]


def test_from_the_command_line_with_a_kill_between(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["tune", "sarsa", "--kit", "standard", "--seeds", "1", "--storage", "sqlite:///t.db", "--trials", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "openant_tools.cli", *words, "--steps", "100"],
        stderr=subprocess.DEVNULL, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    try:
        while not (tmp_path / "t.db").exists() or not _trials(tmp_path):
            assert process.poll() is None, "it ended before its first trial"
            time.sleep(0.1)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert run_command(*words, "--steps", "100", "--json", "best.json") == 0
    found = json.loads((tmp_path / "best.json").read_text())
    assert found["agent"] == "sarsa"
    assert "cm/s while learning" in capsys.readouterr().out
    # What was found can be trained with.
    train = ("train", "sarsa", "--kit", "standard", "--steps", 20)
    assert run_command(*train, "--settings", "best.json", "--out", "tuned") == 0
    kept = json.loads((tmp_path / "tuned" / "run.json").read_text())["settings"]
    assert kept == found["settings"]
    (tmp_path / "other.json").write_text(json.dumps({**found, "agent": "sac"}))
    (tmp_path / "odd.json").write_text(json.dumps({**found, "settings": {"speed": 3}}))
    (tmp_path / "no.json").write_text("[]")
    refused = [
        ((*words, "--steps", "7"), "searches something else: it differs in steps"),
        (("tune", "sarsa", "--kit", "standard", "--storage", "nowhere"), "the storage cannot be opened"),
        (
            ("tune", "sarsa", "--kit", "standard", "--storage", "redis://lab"),
            "Optuna keeps no studies in Redis any more",
        ),
        (("tune", "sarsa"), "there is no robot.toml here"),
        ((*train, "--out", "x", "--settings", "other.json"), "these are settings of sac, not of sarsa"),
        ((*train, "--out", "x", "--settings", "odd.json"), "sarsa has no such setting"),
        ((*train, "--out", "x", "--settings", "no.json"), "it holds no settings of an agent"),
    ]
    for command, message in refused:
        assert run_command(*command) == 2, command
        printed = capsys.readouterr().err
        assert message in printed
        assert "Traceback" not in printed


def _trials(folder) -> bool:
    try:
        return bool(optuna.study.get_all_study_summaries(f"sqlite:///{folder}/t.db")[0].n_trials)
    except Exception:  # tables that are only being made
        return False
