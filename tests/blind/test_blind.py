"""The blind benchmark: robots that nobody chose, verdicts before answers, and a table that hides nothing."""

from __future__ import annotations

import importlib.util
import json
import shlex
import shutil
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SHARED

from openant_tools.blind import commands
from openant_tools.blind import make as make_module
from openant_tools.blind.answers import read_answers
from openant_tools.blind.by_command import is_made
from openant_tools.blind.commands import Motion
from openant_tools.blind.draw import ELSEWHERE, OUTSIDE, Answer, Drawn, Mix, draw_answers
from openant_tools.blind.log import logged
from openant_tools.blind.make import make_set, seed_of_commit
from openant_tools.blind.robot import true_robot
from openant_tools.blind.run import run_set, verdict_path
from openant_tools.blind.score import Case, read, score
from openant_tools.blind.score_report import score_report, write_docs
from openant_tools.blind.simulate import simulate
from openant_tools.blind.sizes import KINDS, SIZES, STANDARD, size_table
from openant_tools.blind.through_bus import record_through_bus, scenario_of
from openant_tools.cli.gap import gap
from openant_tools.errors import BadInput
from openant_tools.procedure.intervals import wilson
from openant_tools.recording.tables import read_run
from openant_tools.robot.joints import JOINTS
from openant_tools.virtual.scenario import parse_scenario
from openant_tools.virtual.seal import make_key, read_key

HEALTHY = Answer("none", (), 5, "batch", True)


def ill(effect: str, joints: tuple[str, ...] | str, size: str = "large", **parameters: Any) -> Answer:
    return replace(HEALTHY, group="single", effects=(Drawn(effect, joints, parameters, size),))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def short() -> Iterator[tuple[Motion, ...]]:
    """Two short runs in place of seven: a piece of the first on the stand, and of the first on the floor."""
    whole = commands.motions(3)
    first = [next(one for one in whole if one.setup == setup) for setup in ("stand", "floor")]
    cut = tuple(
        replace(one, commands=one.commands[40:100], limp=one.limp[40:100], held_out=one.setup == "floor")
        for one in first
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(make_module, "motions", lambda seed: cut)
        yield cut


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, short: tuple[Motion, ...]) -> tuple[Path, Path, bytes]:
    """Three robots in a folder, their key file, and the key."""
    place = tmp_path_factory.mktemp("blind")
    key = make_key(place / "key")
    long_leg = replace(HEALTHY, group="outside", outside="long_leg", parameters={"joint": "knee_fr", "strength": 1.0})
    answers = [HEALTHY, ill("action_delay", ("knee_fl",), delay_s=0.04), long_leg]
    make_set(place / "set", 3, 3, answers=answers, key=key)
    return place / "set", place / "key", key


@pytest.fixture
def sealed_set(made: tuple[Path, Path, bytes], tmp_path: Path) -> tuple[Path, Path, bytes]:
    """The same robots, for one test."""
    return Path(shutil.copytree(made[0], tmp_path / "set")), made[1], made[2]


def says(robot: Path, model: Path) -> dict[str, Any]:
    """A judge that finds whatever robot 1 has."""
    name = "action_delay" if robot.name == "robot-001" else "none"
    size = {"delay_s": {"value": 0.02, "low": 0.0, "high": 1.0}, "other_s": {"value": 0.0, "low": None, "high": None}}
    found = {"effect": "action_delay", "joints": ["knee_fl"], "probability": 0.9 if name != "none" else 0.05}
    found["parameters"] = size
    return {
        "verdict": name, "effects": [found], "selected": [name] if name != "none" else [],
        "gap": {"before": 0.02, "after": 0.002, "floor": 0.001}, "ambiguous_with": [],
    }  # fmt: skip


# ---- what is drawn ----


def test_every_effect_comes_before_any_comes_twice_and_all_kinds_of_robots_are_there() -> None:
    answers = draw_answers(120, 7, Mix(virtual=0.0))
    assert Counter(answer.group for answer in answers) == {"none": 42, "two": 18, "outside": 14, "single": 46}
    singles = Counter(answer.effects[0].effect for answer in answers if answer.group == "single")
    assert set(singles) == set(KINDS)
    assert max(singles.values()) == 2
    assert {answer.outside for answer in answers if answer.outside} == set(OUTSIDE)
    assert draw_answers(120, 7, Mix(virtual=0.0)) == answers
    assert draw_answers(120, 8, Mix(virtual=0.0)) != answers


def test_widest_effects_are_at_one_joint_only_where_they_cannot_be_at_more() -> None:
    drawn = [
        one
        for answer in draw_answers(40, 7, Mix(none=0.0, two=0.8, outside=0.0, widest=True))
        for one in answer.effects
    ]
    at_one = [one.effect for one in drawn if isinstance(one.joints, tuple) and len(one.joints) == 1]
    assert at_one
    assert all(KINDS[name].scopes == "j" for name in at_one)
    assert {one.joints for one in drawn if one.effect == "action_delay"} == {"all"}


@settings(max_examples=20)
@given(st.integers(0, 2**31))
def test_an_answer_survives_its_file_and_describes_a_robot(seed: int) -> None:
    for answer in draw_answers(6, seed, Mix(none=0.1, two=0.3, outside=0.3)):
        assert Answer.of(tomllib.loads(tomlkit.dumps(answer.as_table()))) == answer
        robot = true_robot(answer)
        assert np.isfinite(robot.servos.kt).all()
        if answer.maker == "virtual":
            for setup in ("stand", "floor"):
                parse_scenario(tomllib.loads(scenario_of(answer, setup, 0.0)))


def test_the_catalogue_is_whole_and_sizes_grow() -> None:
    names = SHARED / "effects.md"
    if names.exists():
        rows = [line.split("|")[2].strip(" `") for line in names.read_text().splitlines() if line.startswith("| ")]
        assert set(rows[1:]) - {"effect"} == set(KINDS)
    chance = np.random.default_rng(0)
    delays = [KINDS["action_delay"].draw(k, chance, ("knee_fl",), STANDARD)["delay_s"] for k in range(len(SIZES))]
    assert delays == sorted(delays)
    assert size_table().count("\n") == len(KINDS) + 1


def test_a_seed_from_a_commit_is_its_hash(tmp_path: Path) -> None:
    seed, full = seed_of_commit("HEAD", Path(__file__).parent)
    assert seed == int(full[:8], 16)
    with pytest.raises(BadInput, match="no commit"):
        seed_of_commit("nothing-like-it", Path(__file__).parent)


# ---- what is simulated ----


def test_a_late_robot_is_late_and_only_where_it_is(short: tuple[Motion, ...]) -> None:
    late = ill("action_delay", ("knee_fl",), delay_s=0.06)
    robots = [true_robot(answer) for answer in (HEALTHY, late)]
    healthy, slow = (
        logged(robot, short[0], 0, trace) for robot, trace in zip(robots, simulate(robots, short[0], 0), strict=True)
    )
    off = np.sqrt(np.mean((healthy.signal("pos") - slow.signal("pos")) ** 2, axis=0))
    at = list(JOINTS).index("knee_fl")
    assert off[at] > 0.02
    assert np.delete(off, at).max() < 0.003
    command, position = healthy.signal("cmd"), healthy.signal("pos")
    assert np.sqrt(np.mean((command - position) ** 2)) < 0.15
    assert {
        "cur.knee_fl",
        "load.hip_fl",
        "pwm.knee_fl",
        "volt.hip_rr",
        "temp.hip_rr",
        "gyro.z",
        "acc.z",
        "cmd_t",
    } <= set(healthy.columns)
    # The same robot in other company is the same robot.
    alone = simulate(robots[1:], short[0], 0)[0]
    np.testing.assert_allclose(logged(robots[1], short[0], 0, alone).signal("pos"), slow.signal("pos"))


def test_the_virtual_robots_bus_gives_the_same_robot_within_what_two_simulators_differ(
    short: tuple[Motion, ...],
) -> None:
    late = ill("action_delay", ("knee_fl",), delay_s=0.06)
    healthy, slow = (record_through_bus(answer, short[:1])[0] for answer in (HEALTHY, late))
    at = list(JOINTS).index("knee_fl")
    off = np.sqrt(np.mean((healthy.signal("pos") - slow.signal("pos")) ** 2, axis=0))
    assert off[at] > 0.02
    assert np.delete(off, at).max() < 0.003
    robot = true_robot(HEALTHY)
    other = logged(robot, short[0], 0, simulate([robot], short[0], 0)[0])
    assert set(healthy.columns) == set(other.columns)
    assert np.sqrt(np.mean((healthy.signal("pos") - other.signal("pos")) ** 2)) < 0.012
    assert (healthy.column("cmd_t") < healthy.t).all()


@pytest.mark.parametrize("name", ["mount_resonance", "rubber_band", "loose_battery", "uneven_floor", "slipping_horn"])
def test_what_the_catalogue_has_no_name_for_runs(name: str, short: tuple[Motion, ...]) -> None:
    strange = replace(HEALTHY, group="outside", outside=name, parameters={"joint": "knee_fr", "strength": 1.4})
    robot = true_robot(strange)
    (trace,) = simulate([robot], replace(short[1], commands=short[1].commands[:8], limp=short[1].limp[:8]), 3)
    assert np.isfinite(trace.position).all()
    assert trace.base is not None
    assert 0.1 < trace.base[-1, 2] < 0.2


# ---- seal, run, score ----


def test_a_sealed_set_tells_nothing_and_opens_only_after_the_verdicts(sealed_set: tuple[Path, Path, bytes]) -> None:
    folder, _, key = sealed_set
    assert not list(folder.rglob("truth.toml"))
    assert "action_delay" not in "".join(path.read_text() for path in folder.rglob("*.toml"))
    run = read_run(folder / "robot-001" / "stand-1.parquet")
    assert run.facts.setup == "stand"
    with pytest.raises(BadInput, match="3 of 3 robots have no verdict"):
        read(folder, key)
    assert run_set(folder, diagnose=says) == 3
    with pytest.raises(BadInput, match="sealed"):
        read(folder, None)
    with pytest.raises(BadInput, match="does not open"):
        read(folder, bytes(32))
    facts, cases = read(folder, key)
    assert [case.answer.group for case in cases] == ["none", "single", "outside"]
    with pytest.raises(BadInput, match="not those that the set committed to"):
        read_answers(folder, key, "0" * 64)
    assert facts["commitment"] == tomllib.loads((folder / "answers.sealed.toml").read_text())["sealed"]["commitment"]


def test_a_robot_done_is_not_done_again_and_one_refused_is_tried_again(sealed_set: tuple[Path, Path, bytes]) -> None:
    folder = sealed_set[0]
    asked: list[str] = []

    def judge(robot: Path, model: Path) -> dict[str, Any]:
        asked.append(robot.name)
        if robot.name == "robot-002" and len(asked) < 4:
            raise BadInput("this robot is strange", remedy="look again")
        return says(robot, model)

    assert run_set(folder, diagnose=judge) == 3
    assert "strange" in json.loads(verdict_path(folder, "robot-002").read_text())["error"]
    assert run_set(folder, diagnose=judge) == 1
    assert run_set(folder, diagnose=judge) == 0
    assert asked == ["robot-000", "robot-001", "robot-002", "robot-002"]


def test_a_robot_that_is_not_wholly_made_yet_is_not_judged(sealed_set: tuple[Path, Path, bytes]) -> None:
    folder = sealed_set[0]
    for path in (folder / "robot-001").glob("stand-1.*"):
        path.unlink()
    assert run_set(folder, diagnose=says) == 2
    assert not verdict_path(folder, "robot-001").exists()


def test_two_workers_of_a_dask_cluster_share_the_robots(sealed_set: tuple[Path, Path, bytes]) -> None:
    distributed = pytest.importorskip("distributed")
    import cloudpickle

    # Workers cannot import a test: it goes to them as it is.
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    try:
        # Threads in place of processes, which take long to start; what is said goes over TCP all the same.
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
        ) as cluster:
            address = cluster.scheduler_address
            assert run_set(sealed_set[0], backend="dask", scheduler=address, diagnose=says) == 3
    finally:
        cloudpickle.unregister_pickle_by_value(sys.modules[__name__])
    assert read(sealed_set[0], sealed_set[2])[1][1].verdict == "action_delay"


def test_helpers_that_are_not_there_are_said_so_before_any_work(sealed_set: tuple[Path, Path, bytes]) -> None:
    asked: list[Path] = []

    def judge(robot: Path, model: Path) -> dict[str, Any]:
        asked.append(robot)
        return says(robot, model)

    if importlib.util.find_spec("ray") is None:
        with pytest.raises(BadInput, match="Ray is not installed"):
            run_set(sealed_set[0], backend="ray", diagnose=judge)
    pytest.importorskip("distributed")
    with pytest.raises(BadInput, match="no Dask scheduler answers"):
        run_set(sealed_set[0], backend="dask", scheduler="no-scheme://x", diagnose=judge)
    assert not asked


def test_the_score_counts_what_is_right_and_shows_what_is_not(
    sealed_set: tuple[Path, Path, bytes], tmp_path: Path
) -> None:
    folder, key_file, _ = sealed_set
    run_set(folder, diagnose=says)
    out, docs = tmp_path / "score.json", tmp_path / "docs" / "blind.md"
    done = CliRunner().invoke(
        gap, ["blind", "score", str(folder), "--key-file", str(key_file), "--json", str(out), "--docs", str(docs)]
    )
    assert done.exit_code == 0, done.output
    assert "| false alarms on robots without effect | 0 % (0 to 79 %) of 1 |" in done.output
    rows = {row["what"]: row for row in json.loads(out.read_text())["rows"]}
    assert rows["right name first, medium and large, joint, servo, bus"]["k"] == 1
    assert rows["outside the catalogue: not given a name"]["k"] == 1
    sizes = rows["sizes of causes rightly named within their 95 % interval"]
    assert (sizes["k"], sizes["n"]) == (1, 1)
    assert rows["excess gap closed on held-out runs, median, right name given"]["value"] == pytest.approx(
        0.913, abs=1e-3
    )
    page = docs.read_text()
    assert "commitment of the answers" in page
    assert (docs.parent / "pictures" / "blind-confusion.png").read_bytes().startswith(b"\x89PNG")


def test_several_sets_are_scored_together(sealed_set: tuple[Path, Path, bytes], tmp_path: Path) -> None:
    folder, key_file, _ = sealed_set
    run_set(folder, diagnose=says)
    other = shutil.copytree(folder, tmp_path / "other")
    out, docs = tmp_path / "score.json", tmp_path / "blind.md"
    asked = ["blind", "score", str(folder), str(other), "--json", str(out), "--docs", str(docs)]
    done = CliRunner().invoke(gap, [*asked, "--key-file", str(key_file), "--key-file", str(key_file)])
    assert done.exit_code == 0, done.output
    told = json.loads(out.read_text())
    assert (told["robots"], told["missing"], len(told["sets"])) == (6, 0, 2)
    assert "| false alarms on robots without effect | 0 % (0 to 66 %) of 2 |" in done.output
    assert docs.read_text().count("commitment of the answers") == 2
    refused = CliRunner().invoke(gap, [*asked, "--key-file", str(key_file)])
    assert "1 keys for 2 sets" in str(refused.exception)
    twice = ["blind", "score", str(folder), str(folder), "--key-file", str(key_file), "--key-file", str(key_file)]
    assert "the same set twice" in str(CliRunner().invoke(gap, twice).exception)


def test_a_set_that_is_judged_in_part_can_be_scored_so_far(
    sealed_set: tuple[Path, Path, bytes], tmp_path: Path
) -> None:
    folder, key_file, key = sealed_set
    with pytest.raises(BadInput, match="3 of 3 robots have no verdict"):
        read(folder, key, so_far=True)
    run_set(folder, diagnose=says)
    verdict_path(folder, "robot-001").unlink()
    asked = ["blind", "score", str(folder), "--key-file", str(key_file)]
    refused = CliRunner().invoke(gap, asked)
    assert isinstance(refused.exception, BadInput)
    assert "1 of 3 robots have no verdict" in str(refused.exception)
    out, docs = tmp_path / "score.json", tmp_path / "blind.md"
    done = CliRunner().invoke(gap, [*asked, "--so-far", "--json", str(out), "--docs", str(docs)])
    assert done.exit_code == 0, done.output
    assert "1 of 3 robots have no verdict yet and are left out" in done.output
    assert "| right name first, medium and large, joint, servo, bus | – |" in done.output
    assert {name: json.loads(out.read_text())[name] for name in ("robots", "missing")} == {"robots": 2, "missing": 1}
    assert "2 robots, those judged so far of 3, seed 3" in docs.read_text()


def test_a_false_alarm_and_a_wrong_name_are_shown() -> None:
    wrong = {"verdict": "actuator_lag", "effects": [{"effect": "actuator_lag", "probability": 0.8, "joints": "all"}]}
    cases = [
        Case("robot-000", HEALTHY, wrong),
        Case("robot-001", ill("action_delay", ("knee_fl",), delay_s=0.04), wrong),
        Case("robot-002", ill("action_delay", "all", delay_s=0.006, size="small"),
             {"verdict": "ambiguous", "ambiguous_with": [["action_delay", "sensor_delay"]], "effects": []}),
        Case("robot-003", ill("stiffness_error", "all", scale=1.25, size="small"), {"verdict": "none", "effects": []}),
        Case("robot-004", ill("backlash", ("knee_fl",), gap_rad=0.007, size="small"), {"verdict": "none", "effects": []}),
    ]  # fmt: skip
    found = score([{"seed": 1, "commitment": "x"}], cases)
    assert [case.robot for case in found.failures] == ["robot-000", "robot-001", "robot-004"]
    alarms = next(row for row in found.makers["batch"] if row.words.startswith("false alarms"))
    assert (alarms.k, alarms.n, alarms.reached) == (1, 1, "below")
    assert found.confusions[("action_delay", "actuator_lag")] == 1
    page = score_report(found).html()
    assert "large action_delay at knee_fl" in page


@given(st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_holds_the_proportion(counts: tuple[int, int]) -> None:
    k, n = counts
    low, high = wilson(k, n)
    assert 0 <= low <= k / n <= high <= 1 or k in (0, n)
    assert wilson(0, 120)[1] == pytest.approx(0.031, abs=1e-3)


# ---- robots of other programs ----

#: A program of somebody's own: a pendulum that follows late, or not, by what its answer says; its log is a CSV.
OTHERS = """
import json, math, sys
from pathlib import Path
answer, folder = json.loads(Path(sys.argv[-2]).read_text()), Path(sys.argv[-1])
assert not list(folder.iterdir()), "the folder is not empty"
assert Path(answer["model"]).is_file()
say, stop_at = sys.argv[1], folder.parents[2] / "stop-at"
if stop_at.exists() and answer["robot"] == stop_at.read_text():
    print("reading the answer\\nthe spring \\x1b[31msnapped", file=sys.stderr)
    sys.exit(7)
if say == "cannot" and answer["group"] == "outside":
    sys.exit(3)
late = 0.1 if answer["effects"] else 0.0
rows = ["t,cmd.swing,pos.swing"]
for k in range(150):
    t = k / 50
    rows.append(f"{t},{math.sin(3 * t)},{math.sin(3 * (t - late))}")
if say == "garbage":
    rows[40] = "0.78,nonsense,0.1"
(folder / "swing_1.csv").write_text("\\n".join(rows) + "\\n")
facts = {"joints": ["swing"], "setup": "stand"}
if say != "nameless":
    facts["answer_joints"] = {f"{p}_{s}": "swing" for p in ("hip", "knee") for s in ("rr", "fr", "fl", "rl")}
(folder / "swing_1.json").write_text(json.dumps(facts))
with open(folder.parents[2] / "made", "a") as done:
    done.write(answer["robot"] + " ")
"""


@pytest.fixture
def others(tmp_path: Path) -> Callable[..., Any]:
    """Make a set of five robots by that program, told one word."""
    program = tmp_path / "their generator.py"
    program.write_text(OTHERS)

    def make(word: str, *more: str) -> Any:
        command = f"{shlex.quote(sys.executable)} {shlex.quote(str(program))} {word}"
        shares = ["--none", "0.4", "--two", "0", "--outside", "0.2"]
        asked = ["blind", "make", "--out", str(tmp_path / "theirs"), "--robots", "5", "--seed", "11", *shares]
        return CliRunner().invoke(gap, [*asked, "--maker", command, *more])

    return make


def says_of_others(robot: Path, model: Path) -> dict[str, Any]:
    """A judge that looks whether the swing is late."""
    (run,) = [read_run(path) for path in sorted(robot.glob("*.csv"))]
    late = float(np.max(np.abs(run.signal("cmd") - run.signal("pos")))) > 0.1
    found = {"effect": "action_delay", "joints": ["swing"], "probability": 0.9}
    return {"verdict": "action_delay" if late else "none", "effects": [found] if late else [], "selected": []}


def test_another_program_makes_the_robots_and_each_maker_has_a_column(
    others: Callable[..., Any], sealed_set: tuple[Path, Path, bytes], tmp_path: Path
) -> None:
    key = str(tmp_path / "their.key")
    done = others("fine", "--key-file", key)
    assert done.exit_code == 0, done.output
    folder = tmp_path / "theirs"
    facts = tomllib.loads((folder / "set.toml").read_text())
    assert sorted(path.name for path in (folder / "robot-000").iterdir()) == ["swing_1.csv", "swing_1.json"]
    answers = read_answers(folder, read_key(Path(key)), facts["commitment"])
    assert Counter(answer.group for answer in answers.values()) == {"none": 2, "single": 2, "outside": 1}
    # Judged, and scored beside robots of the batch.
    assert run_set(folder, diagnose=says_of_others) == 5
    run_set(sealed_set[0], diagnose=says)
    out = tmp_path / "score.json"
    asked = ["blind", "score", str(sealed_set[0]), str(folder), "--json", str(out)]
    told = CliRunner().invoke(gap, [*asked, "--key-file", str(sealed_set[1]), "--key-file", key])
    assert "| what | batch | their generator.py fine | first | then | reached by all |" in told.output
    assert (
        "| false alarms on robots without effect | 0 % (0 to 79 %) of 1 | 0 % (0 to 66 %) of 2 | ≤ 3 % |" in told.output
    )
    makers = {row["maker"] for row in json.loads(out.read_text())["rows"]}
    assert makers == {"batch", "their generator.py fine"}
    # The answer's joints are told as the tables name them.
    _, cases = read(folder, read_key(Path(key)))
    at = {case.answer.effects[0].joints for case in cases if case.answer.effects}
    assert at <= {("swing",), "all", "body"}


def test_a_program_that_fails_is_named_with_its_last_words_and_the_set_goes_on_there(
    others: Callable[..., Any], tmp_path: Path
) -> None:
    folder = tmp_path / "theirs"
    # What stands in its way on the first call, away on the second.
    (tmp_path / "stop-at").write_text("robot-003")
    failed = others("fine", "--open")
    assert isinstance(failed.exception, BadInput)
    line = str(failed.exception)
    assert line.startswith("robot-003, made by their generator.py fine: the maker failed (exit code 7): ")
    assert "snapped" in line
    assert "reading the answer" not in line
    assert line.isprintable()
    assert (tmp_path / "made").read_text().split() == ["robot-000", "robot-001", "robot-002"]
    # It is not judged until it is whole.
    assert run_set(folder, diagnose=says_of_others) == 3
    (tmp_path / "stop-at").unlink()
    (folder / "robot-003" / "left-by-the-first-try.csv").write_text("t\n")
    done = others("fine", "--open")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "made").read_text().split() == [f"robot-00{k}" for k in range(5)]
    assert sorted(path.name for path in (folder / "robot-003").iterdir()) == [
        "swing_1.csv",
        "swing_1.json",
        "truth.toml",
    ]
    another = others("garbage", "--open")
    assert "another set is here already" in str(another.exception)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("garbage", "the maker's swing_1.csv cannot be used"),
        ("nameless", "does not have the joints that answers name"),
    ],
)
def test_runs_that_cannot_be_used_are_said_before_they_are_taken_over(
    word: str, message: str, others: Callable[..., Any], tmp_path: Path
) -> None:
    failed = others(word, "--open")
    assert isinstance(failed.exception, BadInput)
    assert message in str(failed.exception)
    assert str(failed.exception).startswith("robot-00")
    assert not is_made(tmp_path / "theirs" / "robot-004")


def test_robots_that_a_program_cannot_have_are_left_out_and_counted(others: Callable[..., Any], tmp_path: Path) -> None:
    done = others("cannot", "--open")
    assert "4 robots in" in done.output
    assert "1 left out that their maker cannot have" in done.output
    folder = tmp_path / "theirs"
    assert others("cannot", "--open").exit_code == 0
    assert run_set(folder, diagnose=says_of_others) == 4
    docs = tmp_path / "blind.md"
    CliRunner().invoke(gap, ["blind", "score", str(folder), "--docs", str(docs)])
    page = docs.read_text()
    assert "seed 11 without 1 that their maker cannot have" in page
    assert '"schema": "openant.blind-answer/1"' in page


def test_one_maker_makes_all_and_is_asked_only_for_what_it_can_have() -> None:
    assert {answer.maker for answer in draw_answers(40, 5, maker="batch")} == {"batch"}
    of_the_bus = draw_answers(120, 5, Mix(none=0.1, two=0.4), maker="virtual")
    assert {answer.maker for answer in of_the_bus} == {"virtual"}
    assert not [answer for answer in of_the_bus if answer.outside]
    names = {drawn.effect for answer in of_the_bus for drawn in answer.effects}
    assert not names & {"speed_limit", "viscous_nonlinear", "tracker_scale"}
    # Who makes them changes nothing else of what is drawn.
    mixed, alone = draw_answers(40, 5), draw_answers(40, 5, Mix(virtual=0.0))
    assert [replace(answer, maker="batch") for answer in draw_answers(40, 5, maker="batch")] == alone
    assert {answer.maker for answer in mixed} == {"batch", "virtual"}
    elsewhere = draw_answers(60, 5, Mix(outside=1.0, none=0.0, two=0.0), maker="their generator")
    assert {answer.outside for answer in elsewhere} == {*OUTSIDE, *ELSEWHERE}


# ---- bad input ----


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["make", "--out", "S", "--open"], "a set needs a seed"),
        (["make", "--out", "S", "--seed", "1"], "sealed or open"),
        (["make", "--out", "S", "--seed", "1", "--seed-from", "HEAD", "--open"], "one seed"),
        (["make", "--out", "S", "--seed", "1", "--key-file", "S/key"], "beside what it seals"),
        (["make", "--out", ".", "--seed", "1", "--open"], "not empty"),
        (["make", "--out", "S", "--seed", "1", "--open", "--none", "0.9", "--two", "0.4"], "together at most"),
        (
            ["make", "--out", "S", "--seed", "1", "--open", "--maker", "no-such-program x"],
            "there is no program 'no-such-program'",
        ),
        (["make", "--out", "S", "--seed", "1", "--open", "--maker", "python 'x"], "does not read as a command"),
        (
            ["make", "--out", "S", "--seed", "1", "--open", "--maker", "batch", "--virtual", "0.2"],
            "leave it out beside --maker",
        ),
        (
            ["make", "--out", "S", "--seed", "1", "--open", "--maker", "bus", "--outside", "0.2"],
            "outside the catalogue",
        ),
        (["run", "."], "no set.toml"),
        (["score", "."], "no set.toml"),
    ],
)
def test_bad_input_gets_one_clear_line(
    given: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("something").write_text("here")
    done = CliRunner().invoke(gap, ["blind", *given])
    assert isinstance(done.exception, BadInput), done.output
    assert message in str(done.exception)
    assert not list(tmp_path.rglob("*.parquet"))


def test_a_set_goes_on_where_it_was_and_another_is_not_written_over(sealed_set: tuple[Path, Path, bytes]) -> None:
    folder, _, key = sealed_set
    answers = list(read_answers(folder, key, tomllib.loads((folder / "set.toml").read_text())["commitment"]).values())
    (folder / "robot-001" / "floor-1.json").unlink()
    untouched, again = folder / "robot-000" / "stand-1.parquet", folder / "robot-001" / "floor-1.json"
    before = untouched.stat().st_mtime_ns
    make_set(folder, 3, 3, answers=answers, key=key)
    assert untouched.stat().st_mtime_ns == before
    assert again.exists()
    with pytest.raises(BadInput, match="another set"):
        make_set(folder, 3, 4, answers=answers, key=key)


def test_docs_name_the_commonest_confusions(tmp_path: Path) -> None:
    wrong = {"verdict": "actuator_lag", "effects": []}
    cases = [Case(f"robot-{k}", ill("action_delay", "all", delay_s=0.04), wrong) for k in range(2)]
    write_docs(score([{"seed": 1, "commitment": "x", "seed_from_commit": "abc"}], cases), tmp_path / "blind.md")
    assert "action_delay taken for actuator_lag (2)" in (tmp_path / "blind.md").read_text()
