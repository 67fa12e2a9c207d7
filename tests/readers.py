"""Every file that we read: how a good one is made, and what reads it. A new reader belongs into this table.

`mutations` makes bad ones of a good one. A reader survives where it returns, or raises OpenAntError or OSError, in bounded time.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import random
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot_data import calibrate
from lerobot_data import make as make_dataset
from plants import pendulum

from openant_tools.arrays import read_arrays, write_arrays
from openant_tools.recording.run import Facts, Run

__all__ = ["READERS", "Reader", "mutations"]


@dataclass(frozen=True)
class Reader:
    """One kind of file.

    Attributes:
        name: of the file to spoil, in its folder.
        make: puts a good one, with whatever belongs to it, into a folder.
        read: reads it there, as commands do.
        tries: how often tests spoil it.
    """

    name: str
    make: Callable[[Path], object]
    read: Callable[[Path], Any]
    tries: int = 300


def _run() -> Run:
    t = 0.01 * np.arange(12, dtype=np.float64)
    columns: dict[str, Any] = {
        "cmd.hinge": np.sin(t), "pos.hinge": np.sin(t), "torque.hinge": np.ones(12), "gyro.x": t, "wake": t,
        "err.hinge": np.array(["timeout", *[""] * 11], object),
    }  # fmt: skip
    return Run(
        "run",
        Facts(("hinge",), {"hinge": "XL430-W250-T"}, "stand", registers={"hinge": {"pwm_limit": 885}}),
        t,
        columns,
    )


def _table(folder: Path, suffix: str) -> None:
    from openant_tools.recording.tables import write_table

    write_table(_run(), folder / f"run{suffix}")


def _recording(folder: Path) -> None:
    from openant_tools.recording.convert import import_run

    import_run(_run(), folder / "run.mcap")


def _read_run(path: Path) -> Any:
    from openant_tools.recording.tables import read_run

    return read_run(path, need=())


def _robot(folder: Path) -> None:
    from openant_tools.robot.folder import create_robot

    create_robot(folder)


def _check_robot(path: Path) -> Any:
    from openant_tools.robot.folder import RobotFolder

    return RobotFolder(path.parent).check(simulate=False)


def _platform(folder: Path) -> None:
    from openant_tools.robot.folder import create_robot
    from openant_tools.robot.platform_config import export_platform_config

    config = create_robot(folder).config()
    (folder / "ant12.json").write_text(json.dumps(export_platform_config(config, None), indent=1))


def _read_platform(path: Path) -> Any:
    from openant_tools.robot.platform_config import read_platform_config

    return read_platform_config(path)


def _journal(folder: Path) -> None:
    from openant_tools.procedure.journal import EepromWrite, Journal

    for new in range(3):
        Journal(folder / "journal.jsonl").append(EepromWrite("hip_rr", 10, "id", 1, new), "calib ids")


def _entries(path: Path) -> Any:
    from openant_tools.procedure.journal import Journal

    return Journal(path).open_entries()


def _model(path: Path) -> Any:
    from openant_tools.model.plant import load_plant

    return load_plant(path)


SCENARIO = """seed = 3
[robot]
kit = "standard"
setup = "stand"
[bus]
latency_timer_ms = 1
[[servo]]
joint = "knee_fl"
firmware = 45
[[effect]]
effect = "load_friction"
joints = ["knee_fl"]
parameters = { coefficient = 0.12 }
[[fault]]
cause = "bad_cable"
where = "knee_fl"
from_s = 1.0
to_s = 2.0
"""


def _scenario(path: Path) -> Any:
    from openant_tools.virtual.scenario import load_scenario

    return load_scenario(path)


def _seal(folder: Path) -> None:
    from openant_tools.virtual.seal import make_key, seal

    seal(SCENARIO, make_key(folder / "key"), folder / "sealed.toml")


def _open_sealed(path: Path) -> Any:
    from openant_tools.virtual.scenario import load_scenario

    return load_scenario(path, path.parent / "key")


def _plan(folder: Path) -> None:
    segment = '[[recording.segment]]\nkind = "Rest"\nseconds = 5.0\n'
    (folder / "plan.toml").write_text(f'schema = "openant.plan/1"\n[[recording]]\nsetup = "stand"\n{segment}')


def _read_plan(path: Path) -> Any:
    from openant_tools.sysid.plan_file import read_plan

    return read_plan(path)


def _declared(folder: Path) -> None:
    entry = 'name = "arm"\nelement = "geom"\nattribute = "mass"\nmatch = "arm.*"\nstd = 0.1\n'
    (folder / "declared.toml").write_text(f"[[parameter]]\n{entry}")


def _read_declared(path: Path) -> Any:
    from openant_tools.sysid.declared import read_declarations

    return read_declarations(path)


def _diagnosis(folder: Path) -> None:
    effect = {
        "effect": "backlash", "joints": ["hinge"], "parameters": {"width": {"value": 0.02, "low": 0.01, "high": 0.03}},
        "probability": 0.9, "gap_closed": 0.5, "gap_closed_low": 0.4, "gap_closed_high": 0.6, "native": True,
    }  # fmt: skip
    found = {
        "schema": "openant.gap/1", "model": "m.xml", "runs": ["a"], "held_out": [], "verdict": "backlash", "confidence": 0.9,
        "effects": [effect], "selected": ["backlash"], "ambiguous_with": [], "sensors": [], "next_experiment": None,
        "gap": {"before": 0.1, "after": 0.05, "floor": 0.01}, "where": [],
    }  # fmt: skip
    (folder / "out.json").write_text(json.dumps(found, indent=1))


def _read_diagnosis(path: Path) -> Any:
    from openant_tools.gap.diagnosis import read_diagnosis

    return read_diagnosis(path)


def _finding(folder: Path) -> None:
    from openant_tools.procedure.finding import Evidence, Finding, keep
    from openant_tools.robot.folder import create_robot

    made = Finding("tilt", True, "it stands", (Evidence("angle", 0.1, "rad", "run"),), "", "openant sysid tilt")
    path = keep(made, create_robot(folder / "ant"))
    path.rename(folder / "ant" / "findings" / "tilt-20260101T000000Z.json")


def _latest(path: Path) -> Any:
    from openant_tools.procedure.finding import latest
    from openant_tools.robot.folder import RobotFolder

    return latest(RobotFolder(path.parent.parent), "tilt")


def _fit(folder: Path) -> None:
    entry = {"value": 1.0, "low": 0.9, "high": 1.1, "unit": "1", "verdict": "identified", "joints": ["hinge"]}
    (folder / "fit.json").write_text(json.dumps({"parameters": {"stiffness.hinge": entry}, "runs": ["a"]}))


def _compare(path: Path) -> Any:
    from openant_tools.sysid.compare_sources import snapshot

    return snapshot(str(path))


def _typed(path: Path) -> Any:
    from openant_tools.sysid.bench.readings import reading_rows

    return list(reading_rows(path, "volts, grams"))


def _ready(path: Path) -> Any:
    from openant_tools.virtual.process import virtual_robot

    with virtual_robot(str(path)) as found:
        return found


def _set(folder: Path) -> None:
    (folder / "set.toml").write_text('schema = "openant.blind/1"\nrobots = 1\nseed = 3\ncommitment = "ab"\n')


def _committed(path: Path) -> Any:
    from openant_tools.blind.answers import committed

    return committed(path.parent, {"schema": "openant.blind/1"})


def _dataset(folder: Path) -> None:
    make_dataset(folder, lengths=(8, 12), files=((0,), (1,)))


def _read_dataset(path: Path) -> Any:
    from openant_tools.exchange.lerobot_import import convert, read_conversion

    return list(convert(read_conversion(path.parents[2])))


def _open_dataset(path: Path) -> Any:
    from openant_tools.exchange.lerobot_dataset import open_dataset

    return open_dataset(next(folder for folder in path.parents if (folder / "data").is_dir()))


def _ranges(path: Path) -> Any:
    from openant_tools.exchange.lerobot_units import read_calibration

    return read_calibration(path)


def _verdict(folder: Path) -> None:
    (folder / "verdicts").mkdir()
    effect = {"effect": "backlash", "joints": ["knee_fl"], "probability": 0.9}
    said = {
        "verdict": "backlash", "effects": [effect], "selected": ["backlash"], "ambiguous_with": [["backlash", "payload"]],
        "gap": {"before": 0.1, "after": 0.05, "floor": 0.01}, "blind": {"robot": "robot-00", "seconds": 3.0, "first": False},
    }  # fmt: skip
    (folder / "verdicts" / "robot-00.json").write_text(json.dumps(said))


def _scored(path: Path) -> Any:
    from openant_tools.blind.draw import Answer
    from openant_tools.blind.score import Case, score
    from openant_tools.files import read_json

    said = read_json(path)
    drawn = {"effect": "backlash", "joints": ["knee_fl"], "parameters": {"width_rad": 0.1}, "size": "large"}
    truth = Answer.of({"group": "single", "effect": [drawn], "seed": 1, "maker": "a", "tracker": True})
    return score([{}], [Case("robot-00", truth, said)])


def _eeprom(folder: Path) -> None:
    from openant_tools.virtual.eeprom import EepromFile

    EepromFile(folder / "eeprom.json").write(_world())


def _read_eeprom(path: Path) -> Any:
    from openant_tools.virtual.eeprom import EepromFile

    return EepromFile(path)._read(_world())


@functools.cache
def _world() -> Any:
    from openant_tools.virtual.scenario import parse_scenario
    from openant_tools.virtual.start import assemble

    server = assemble(parse_scenario({}), clock="stepped", camera=False)
    world = server.world
    server.close()
    return world


def _effects(folder: Path) -> None:
    from openant_tools.robot.folder import create_robot

    path = create_robot(folder).config_file
    entry = '[[effect]]\neffect = "load_friction"\njoints = ["knee_fl"]\nparameters = { coefficient = 0.12 }\n'
    path.write_text(f"{path.read_text()}\n{entry}")


def _entries_of(path: Path) -> Any:
    from openant_tools.effects.entries import commands_of, sensing_of, values_of
    from openant_tools.robot.folder import RobotFolder
    from openant_tools.robot.joints import JOINT_NAMES

    effects = RobotFolder(path.parent).config().effects
    return values_of(effects, JOINT_NAMES, path), commands_of(effects, JOINT_NAMES, path), sensing_of(effects, path)


def _heat(folder: Path) -> None:
    known = {
        "joints": ["knee_fl"], "models": ["XM430-W350-T"], "names": [["loss", "knee_fl"], ["gain", ""]], "theta": [1.0, 2.0],
        "covariance": [[1.0, 0.0], [0.0, 1.0]],
    }  # fmt: skip
    (folder / "fit.json").write_text(json.dumps({"known": known}))


def _known(path: Path) -> Any:
    from openant_tools.thermal.fit import Known

    return Known.read(path)


def _text(name: str, text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(text)


READERS = {
    "recording": Reader("run.mcap", _recording, _read_run),
    "table as CSV": Reader("run.csv", lambda folder: _table(folder, ".csv"), _read_run),
    "table as Parquet": Reader("run.parquet", lambda folder: _table(folder, ".parquet"), _read_run),
    "facts of a table": Reader(
        "run.json", lambda folder: _table(folder, ".csv"), lambda path: _read_run(path.with_suffix(".csv"))
    ),
    "robot.toml": Reader("robot.toml", _robot, _check_robot),
    "antNN.json": Reader("ant12.json", _platform, _read_platform),
    "journal": Reader("journal.jsonl", _journal, _entries),
    "finding": Reader("ant/findings/tilt-20260101T000000Z.json", _finding, _latest),
    "MJCF": Reader("model.xml", lambda folder: (folder / "model.xml").write_text(pendulum()), _model),
    "scenario": Reader("ant.toml", _text("ant.toml", SCENARIO), _scenario),
    "sealed scenario": Reader("sealed.toml", _seal, _open_sealed),
    "plan": Reader("plan.toml", _plan, _read_plan),
    "declared parameters": Reader("declared.toml", _declared, _read_declared),
    "diagnosis": Reader("out.json", _diagnosis, _read_diagnosis),
    "fit.json": Reader("fit.json", _fit, _compare),
    "typed readings": Reader("typed.csv", _text("typed.csv", "volts,grams\n1.0,2.0\n# no\n2.0,4.5\n"), _typed),
    "ready file": Reader("ready.json", _text("ready.json", '{"bus": "/dev/pts/1", "imu": null, "pid": 3}'), _ready),
    "blind set": Reader("set.toml", _set, _committed),
    "blind verdict": Reader("verdicts/robot-00.json", _verdict, _scored),
    "EEPROM of a virtual robot": Reader("eeprom.json", _eeprom, _read_eeprom),
    "effects of robot.toml": Reader("robot.toml", _effects, _entries_of),
    "fit of heat": Reader("fit.json", _heat, _known),
    "LeRobot dataset": Reader("meta/info.json", _dataset, _open_dataset),
    "LeRobot episodes": Reader("meta/episodes/chunk-000/file-000.parquet", _dataset, _open_dataset),
    "LeRobot rows": Reader("data/chunk-000/file-001.parquet", _dataset, _read_dataset),
    "LeRobot calibration": Reader("arm.json", calibrate, _ranges),
    "cache": Reader(
        "part.npz", lambda folder: write_arrays(folder / "part.npz", {"run0": np.ones((4, 3), np.float16)}), read_arrays
    ),
}


def _trained(folder: Path) -> None:
    from openant_agents.runs import CurvePoint, TrainingRun

    run = TrainingRun(folder, {"agent": "sac", "observations": 2, "actions": 1, "settings": {}, "seed": 1})
    run.resume()
    run.add_curve_point(CurvePoint(1, 0.1, 0.2))
    run.add_curve_point(CurvePoint(2, 0.2, 0.2))
    run.add_intervention(1, 0.1, "fell")
    run.save({"step": 2, "agent": {"actor": np.ones(3)}}, np.ones((2, 3), np.float32))
    run.close()


def _checkpoint(path: Path) -> Any:
    from openant_agents.runs import load_checkpoint

    return load_checkpoint(path.parent)


def _facts(path: Path) -> Any:
    from openant_agents.runs import read_facts

    return read_facts(path.parent)


def _curve(path: Path) -> Any:
    from openant_agents.runs import read_curve

    return read_curve(path.parent)


def _interventions(path: Path) -> Any:
    from openant_agents.interventions import read_interventions

    return read_interventions(path.parent)


def _settings(path: Path) -> Any:
    from openant_agents.sac import SacSettings
    from openant_tools.cli.learning import settings_of

    return settings_of(SacSettings, path, "sac", {})


def _study(folder: Path) -> None:
    import optuna

    from openant_agents.tuning import open_study

    study = open_study(f"sqlite:///{folder / 'tune.db'}", "ant", {"agent": "sac"})
    trial = optuna.trial.create_trial(value=0.1, user_attrs={"settings": {"batch": 64}})
    study.add_trial(trial)


def _best(path: Path) -> Any:
    from openant_agents.tuning import best_settings, open_study

    return best_settings(open_study(f"sqlite:///{path}", "ant", {"agent": "sac"}))


def _measured(path: Path) -> Any:
    from openant_agents.ranking import read_measured

    return read_measured(path)


if importlib.util.find_spec("torch") is not None:
    READERS |= {
        "checkpoint": Reader("checkpoint.pt", _trained, _checkpoint),
        "run.json": Reader("run.json", _trained, _facts),
        "learning curve": Reader("learning_curve.csv", _trained, _curve),
        "interventions": Reader("interventions.csv", _trained, _interventions),
        "Optuna's storage": Reader("tune.db", _study, _best, 30),
        "tuned settings": Reader(
            "best.json", _text("best.json", '{"agent": "sac", "settings": {"batch": 64, "tau": 0.01}}'), _settings
        ),
        "measured policies": Reader(
            "measured.json",
            _text("measured.json", '{"policies": {"a": {"average_reward_m_s": 0.1, "plays": [0.1]}}}'),
            _measured,
        ),
    }

#: what people and other software put where something else belongs
_ODD = (
    b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\r", b"\n\n", b'"', b"'", b"[", b"]]", b"{", b"}", b"<", b"&#0;", b",", b";", b"=", b"nan",
    b"-inf", b"1e999", b"-1", b"0", b"true", b"null", b"[]", b"{}", b'""', b"9" * 400, b"1" * 5000, b"[" * 3000, b"\xc3\x28",
    "π".encode(), b"../../../etc/passwd", b"1979-05-27T07:32:00Z", b"\x1b[31m",
)  # fmt: skip

#: a value of TOML, JSON, CSV or XML, and what may stand there instead: what is well-formed, and of another kind
_VALUE = re.compile(rb"""(?<=[=:,\[\n])\s*("[^"\n]*"|'[^'\n]*'|[^\s=:,\[\]{}"']+)""")
_KINDS = (
    b"3", b"-1", b"0", b"1.5", b"1e300", b"nan", b"true", b"null", b'""', b'"x"', b"[]", b"[3]", b'["x"]', b"[[1, 2], [3]]", b"{}",
    b'{"x": 3}', b"1979-05-27T07:32:00Z",
)  # fmt: skip


def mutations(good: bytes, seed: int) -> Iterator[bytes]:
    """Endless bad files made of a good one."""
    rng = random.Random(seed)
    while True:
        data = bytearray(good)
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            at = rng.randrange(len(data) + 1)
            length = rng.choice((1, 2, 4, 8, 64, 512))
            match rng.randrange(8):
                case 0:
                    data[at : at + 1] = bytes((rng.randrange(256),))
                case 1 if data:
                    data[at % len(data)] ^= 1 << rng.randrange(8)
                case 2:
                    del data[at : at + length]
                case 3:
                    del data[at:]
                case 4:
                    data[at:at] = rng.choice(_ODD)
                case 5:
                    data[at : at + length] = rng.choice(_ODD)
                case 6:
                    other = rng.randrange(len(data) + 1)
                    data[at:at] = data[other : other + length]
                case 7:
                    values = [found.span(1) for found in _VALUE.finditer(data)]
                    if values:
                        begin, end = rng.choice(values)
                        data[begin:end] = rng.choice(_KINDS)
        yield bytes(data)
