"""How a policy is measured: from several starts, sampled and as its likeliest action, and what stands still is said so."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
import gymnasium
from killing import FLOOR

from openant_agents.evaluate import LIKELIEST, SAMPLED, evaluate, film, stands_still
from openant_agents.policies import Policy
from openant_env.rendering import VIDEO_BYTES, NoOpenGL, write_mp4, write_video
from openant_tools.cli import main
from openant_tools.errors import BadInput
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import create_robot


class Line(gymnasium.Env):
    """A point on a line that goes where its action says, 0.1 m/s at most; from even starts it sticks to the ground unless pushed."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.stuck = 0.0, seed is not None and seed % 2 == 0
        return np.zeros(1, np.float32), self._info()

    def step(self, action):
        push = float(action[0])
        moved = 0.0 if self.stuck and abs(push) < 0.6 else 0.01 * push
        self.x += moved
        return np.zeros(1, np.float32), moved, False, False, self._info()

    def _info(self):
        return {"dt": 0.1, "position": np.array([self.x, 0.0]), "reward_direction": np.array([1.0, 0.0])}


def pusher() -> Policy:
    """Half of what is needed on average, and with chance enough of it now and then."""
    random = [np.random.default_rng(0)]

    def seed(n):
        random[0] = np.random.default_rng(n)

    return Policy(
        lambda _: np.array([0.5 + random[0].normal(0.0, 0.3)]), lambda _: np.array([0.5]), lambda: None, seed, 7, "sac"
    )


def test_a_gait_that_lives_on_chance_walks_sampled_and_stands_still_as_its_likeliest_action():
    told = []
    sampled, likeliest = (
        evaluate(Line(), pusher(), way=way, seconds=20.0, starts=5, progress=lambda *done: told.append(done))
        for way in (SAMPLED, LIKELIEST)
    )
    assert [play.stood_still for play in likeliest.plays] == [True, False, True, False, True]
    assert likeliest.as_dict() == {"median": 0.0, "low": 0.0, "high": pytest.approx(0.05), "stood_still": 3}
    assert sampled.stood_still == 0
    assert set(sampled.as_dict()) == {"median", "low", "high"}
    assert 0.0 < sampled.low < sampled.median < sampled.high < 0.06
    assert sampled.mean == pytest.approx(np.mean([play.progress_m / 20.0 for play in sampled.plays]))
    assert told[-1][0] == pytest.approx(1.0)
    assert re.fullmatch(r"start 5 of 5, likeliest \S+ cm/s", told[-1][1])


def test_the_play_that_is_filmed_is_the_play_that_was_measured():
    env = Line()
    policy = pusher()
    typical = evaluate(env, policy, way=SAMPLED, seconds=10.0, starts=4).typical
    env.render = lambda: np.full((2, 2, 3), env.x)  # type: ignore[method-assign]
    frames = film(env, policy, way=SAMPLED, seconds=10.0, seed=typical.seed)
    assert len(frames) == 100
    assert frames[-1][0, 0, 0] == pytest.approx(typical.progress_m)


def test_standing_still_is_judged_by_the_end_and_not_where_the_place_is_unknown():
    t = np.arange(0.0, 20.0, 0.1)
    walks = np.column_stack([0.05 * t, np.zeros_like(t)])
    stops = np.column_stack([0.05 * np.minimum(t, 12.0), np.zeros_like(t)])
    trembles = stops + 0.002 * np.sin(40 * t)[:, None]
    slow = np.column_stack([0.004 * t, np.zeros_like(t)])
    assert [stands_still(t, xy) for xy in (walks, stops, trembles, slow)] == [False, True, True, False]
    assert not stands_still(t, np.where(t[:, None] > 12.0, np.nan, stops))
    with pytest.raises(BadInput, match="nothing to evaluate"):
        evaluate(Line(), pusher(), way=SAMPLED, seconds=0.0, starts=3)


def test_a_video_fits_into_a_report_and_plays_in_real_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from PIL import Image

    random = np.random.default_rng(0)
    noise = [random.integers(0, 255, (240, 320, 3), np.uint8) for _ in range(60)]  # nothing is harder to make small
    write_video(noise, tmp_path / "walk.webp", seconds_apart=0.12)
    assert (tmp_path / "walk.webp").stat().st_size <= VIDEO_BYTES
    with Image.open(tmp_path / "walk.webp") as picture:
        picture.load()
        assert picture.n_frames * picture.info["duration"] == pytest.approx(60 * 120, rel=0.05)

    monkeypatch.setenv("PATH", str(tmp_path))
    assert not write_mp4(noise, tmp_path / "walk.mp4", seconds_apart=0.12)
    ffmpeg = tmp_path / "ffmpeg"
    ffmpeg.write_text(f"#!{sys.executable}\nimport sys\nopen(sys.argv[-1], 'wb').write(sys.stdin.buffer.read()[:9])\n")
    ffmpeg.chmod(0o755)
    assert write_mp4(noise, tmp_path / "walk.mp4", seconds_apart=0.12)
    ffmpeg.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('no encoder')\n")
    assert not write_mp4(noise, tmp_path / "none.mp4", seconds_apart=0.12)
    assert [path.name for path in tmp_path.glob("*.mp4")] == ["walk.mp4"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("eval") / "run"
    words = ("train", "sac", "--kit", "standard", "--steps", "60", "--learning-start", "50", "--out", str(out))
    assert run(*words) == 0
    return out


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    return int(end.value.code or 0)


def test_the_command_labels_both_ways_and_writes_what_was_promised(trained, tmp_path, capsys):
    answer = tmp_path / "eval.json"
    assert run("eval", trained, "--seconds", 2.4, "--starts", 3, "--json", answer) == 0
    measured = json.loads(answer.read_text())
    assert measured["starts"] == 3
    for way in ("sampled", "likeliest"):
        assert measured[way]["low"] <= measured[way]["median"] <= measured[way]["high"]
    assert measured["average_reward_m_s"] == pytest.approx(
        np.mean([play["average_reward_m_s"] for play in measured["plays"]["sampled"]])
    )
    assert 0 <= measured["likeliest"]["stood_still"] <= 3
    said = capsys.readouterr().out
    assert "sampled, as in training: " in said
    assert "likeliest action, without chance: " in said
    assert ("stood still for good in" in said) == ("Chance takes it out of there" in said)


def test_without_opengl_there_are_no_pictures_and_still_a_measurement(trained, tmp_path, capsys, monkeypatch):
    from openant_env import rendering

    def refuse(*_: object) -> None:
        raise NoOpenGL("there is no OpenGL here")

    monkeypatch.setattr(rendering, "_gl_context", refuse)
    pictures = ("--video", tmp_path / "walk.webp", "--strip", tmp_path / "walk.png")
    assert run("eval", trained, "--seconds", 1.2, "--starts", 1, *pictures) == 0
    assert "no pictures of it: there is no OpenGL here" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_on_a_robot_it_starts_once_and_only_sampled(trained, tmp_path):
    scenario = tmp_path / "floor.toml"
    scenario.write_text(FLOOR + '[clock]\nmode = "stepped"\n')
    robot = create_robot(
        tmp_path / "my-ant",
        values={"camera.body_tag_id": 12, "arena.centre_m": [0.1, -0.05], "arena.radius_m": 0.4},
        provenance={"motors": Provenance("measured", "openant calib zeros")},
    )
    words = (
        "eval",
        trained,
        "--env",
        "hardware",
        "--virtual",
        scenario,
        "--robot",
        robot.path,
        "--yes",
        "--seconds",
        1.2,
    )
    assert run(*words, "--json", tmp_path / "once.json") == 0
    once = json.loads((tmp_path / "once.json").read_text())
    assert once["starts"] == 1
    assert "likeliest" not in once
    assert once["sampled"]["median"] == once["average_reward_m_s"]
