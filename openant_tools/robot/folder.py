"""A robot is a folder: finding its parts, reading `robot.toml`, and changing it without touching what is not ours."""

from __future__ import annotations

import contextlib
import datetime
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import tomlkit
from tomlkit.items import AoT, InlineTable, Table

from openant_tools.errors import BadInput
from openant_tools.files import parse_toml, write_bytes, write_text
from openant_tools.lock import Claim, Holder, held, holder
from openant_tools.robot.config import (
    CONFIG_NAME,
    ConfigProblem,
    EffectEntry,
    Provenance,
    RobotConfig,
    covers,
    editable_document,
    parse_config,
    read_document,
)
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import ANGLE_LIMIT_RAD, NOMINAL_ZERO_RAD, Kit
from openant_tools.robot.kit import kit as kit_by_name
from openant_tools.robot.mjcf import nominal_mjcf
from openant_tools.trust import follows

__all__ = ["Located", "RobotFolder", "create_robot"]

NOMINAL_MODEL = "nominal.xml"
#: s for which a change of `robot.toml` waits for another's to be done
CHANGE_PATIENCE_S = 30.0
HELD = "this robot is held by {}"
WAIT = "wait for it, or stop it; its findings and recordings can be read meanwhile"

Document = TypeVar("Document", bound=Mapping[str, Any])


@dataclass(frozen=True)
class Located:
    """A problem and the line of `robot.toml` that it stands in, if it stands anywhere."""

    problem: ConfigProblem
    line: int | None
    file: Path

    @property
    def where(self) -> str:
        line = f", line {self.line}" if self.line else ""
        return ", ".join(part for part in (f"{self.file}{line}", self.problem.place) if part)

    def __str__(self) -> str:
        text = f"{self.where}: {self.problem.what}"
        return f"{text} → {self.problem.remedy}" if self.problem.remedy else text


@dataclass(frozen=True)
class RobotFolder:
    """The parts of one robot's folder (formats, section 4).

    Attributes:
        path: the folder.
    """

    path: Path

    @classmethod
    def at(cls, path: str | Path) -> RobotFolder:
        """The folder at a path, which may also name its `robot.toml`; raises BadInput where there is none."""
        path = Path(path)
        folder = cls(path.parent if path.suffix == ".toml" else path)
        if not folder.config_file.is_file():
            raise BadInput(
                f"there is no {CONFIG_NAME} here",
                where=folder.path,
                remedy="make one with `openant config new --kit standard --robot DIR` or `openant config import`",
            )
        return folder

    @property
    def config_file(self) -> Path:
        return self.path / CONFIG_NAME

    @property
    def recordings(self) -> Path:
        return self.path / "recordings"

    def new_recording(self, what: str) -> Path:
        """Where a step records `what` this time, `recordings/WHAT-20261130T120000Z.mcap`: a name that nothing has, so that what it
        finds keeps naming the recording that it was found in.
        """
        stem, n = f"{what}-{datetime.datetime.now(datetime.UTC):%Y%m%dT%H%M%SZ}", 1
        while os.path.lexists(path := self.recordings / (f"{stem}.mcap" if n == 1 else f"{stem}-{n}.mcap")):
            n += 1
        return path

    @property
    def findings(self) -> Path:
        return self.path / "findings"

    @property
    def runs(self) -> Path:
        return self.path / "runs"

    @property
    def diagnoses(self) -> Path:
        """Of the gap between the robot and its simulation."""
        return self.path / "gap"

    @property
    def backups(self) -> Path:
        return self.path / "backups"

    @property
    def journal(self) -> Path:
        return self.path / "journal.jsonl"

    @property
    def passport(self) -> Path:
        return self.path / "passport.html"

    @contextlib.contextmanager
    def hold(self) -> Iterator[None]:
        """Work on the robot itself for a block: no other program moves it, nor writes into its folder, meanwhile.

        Raises:
            BadInput: another program does; it is named.
        """
        with held(self._lock, HELD, remedy=WAIT):
            yield

    @property
    def holder(self) -> Holder | None:
        """The other program that works on the robot itself, if one does: to us the folder is then read only."""
        return holder(self._lock)

    def refuse_if_held(self) -> None:
        """Raise BadInput, which names it, where another program works on the robot itself: for who will write."""
        who = self.holder
        if who is not None:
            raise BadInput(f"{HELD.format(who)}; nothing was written", where=self.path, remedy=WAIT)

    @property
    def _lock(self) -> Path:
        return self.path / ".robot.lock"

    @contextlib.contextmanager
    def _changing(self) -> Iterator[None]:
        """One change of the folder's files at a time, and none while another program holds the robot."""
        claim = Claim(
            self.path / ".change.lock", "its files are being changed by {}", remedy=WAIT, wait_s=CHANGE_PATIENCE_S
        )
        try:
            self.refuse_if_held()
            yield
        finally:
            claim.release()

    def effects_beside(self, models: Iterable[Path]) -> tuple[tuple[EffectEntry, ...], Path | None]:
        """The robot's `[[effect]]` entries and where they stand, if all these models are its own; else none.

        Raises:
            BadInput: as `config`.
        """
        config = self.config()
        own = self.model_path(config).resolve()
        theirs = all(model.resolve() == own for model in models)
        return (config.effects, self.config_file) if theirs else ((), None)

    def model_path(self, config: RobotConfig | None = None) -> Path:
        """The MJCF that simulates this robot."""
        named = (config or self.config()).model
        path = follows(named, self.config_file)
        if path is None:
            raise BadInput(
                f"its model {named} lies elsewhere and is not followed",
                where=self.config_file,
                remedy="put it into the robot's folder, or add --trust-paths",
            )
        return self.path / named

    def relative(self, path: str | Path) -> str:
        """A path as the folder's files name it: relative to the folder where it lies inside, with forward slashes."""
        absolute = Path(path).resolve()
        root = self.path.resolve()
        return absolute.relative_to(root).as_posix() if absolute.is_relative_to(root) else str(absolute)

    def check(self, *, simulate: bool = True) -> tuple[RobotConfig | None, list[Located]]:
        """Everything in the configuration that cannot be, or (notes) is probably not meant.

        Args:
            simulate: also load the model with MuJoCo and look for the robot's joints and actuators in it.

        Returns:
            The configuration (None where there are errors in it) and the problems by line.

        Raises:
            BadInput: the file is missing, cut, or no TOML.
        """
        data = self._bytes()
        document = self._read(read_document, data)
        config, problems = parse_config(document)
        model = document.get("model")
        if isinstance(model, str):
            problems += self._model_problems(self.path / model, simulate, () if config is None else config.effects)
        text = data.decode("utf-8")
        if not text.endswith("\n"):
            what = "the last line has no end: is the file cut short?"
            problems.append(ConfigProblem("", what, "compare it with the newest file in backups/", "note"))
        located = [Located(problem, _line_of(text, problem.key), self.config_file) for problem in problems]
        located.sort(key=lambda entry: entry.line or math.inf)
        return config, located

    def config(self) -> RobotConfig:
        """What `robot.toml` says.

        Raises:
            BadInput: the file is missing, cut, or says something that cannot be; the first such place is named.
        """
        config, located = self.check(simulate=False)
        errors = [entry for entry in located if entry.problem.severity == "error"]
        if errors or config is None:
            first, rest = errors[0], len(errors) - 1
            more = f"`openant config check` lists {rest} more" if rest else None
            remedy = "; ".join(part for part in (first.problem.remedy, more) if part)
            raise BadInput(first.problem.what, where=first.where, remedy=remedy or None)
        return config

    def update(
        self,
        values: Mapping[str, Any] | None = None,
        *,
        provenance: Provenance | Mapping[str, Provenance] | None = None,
        effects: Sequence[EffectEntry] | None = None,
    ) -> RobotConfig:
        """Change values in `robot.toml`; comments, order, unknown keys and everything else stay byte for byte.

        What stood there before is kept in `backups/` under its date. Nothing is written where nothing changes. Of several
        programs that do this at once one waits for the other, so that no change is lost.

        Args:
            values: dotted path → value, such as {"motors.hip_rr.zero_offset_rad": 0.79}.
            provenance: where these values came from: one for all of them, or path → provenance (whose paths may also
                be fronts of paths, with * for any key). Older entries about the same values give way.
            effects: the new list of `[[effect]]`, if it is to be replaced.

        Returns:
            The configuration as it now stands.

        Raises:
            BadInput: the file cannot be read, or would hold something that cannot be, or another program holds the robot;
                it is left as it was.
        """
        values = dict(values or {})
        if isinstance(provenance, Provenance):
            provenance = dict.fromkeys(values, provenance)
        self._bytes()  # a folder that is none gets no lock
        with self._changing():
            before = self._bytes()
            try:
                after, config = _edited(
                    self._read(editable_document, before), self.config_file, values, provenance or {}, effects
                )
            except BadInput as error:
                raise BadInput(
                    f"{error.what}; the file was left as it is", where=error.where, remedy=error.remedy
                ) from None
            if "model" in values and not (self.path / config.model).is_file():
                raise BadInput(f"there is no model {config.model} to name", where=self.path)
            if after is not None:
                self._back_up(before)
                # A link to a configuration kept elsewhere stays a link.
                write_bytes(self.config_file.resolve(), after)
            return config

    def _bytes(self) -> bytes:
        try:
            return self.config_file.read_bytes()
        except FileNotFoundError:
            return RobotFolder.at(self.path)._bytes()

    def _back_up(self, data: bytes) -> Path:
        # To the microsecond, so that two changes in a second keep both their files, in order of name and time.
        stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        path = self.backups / f"robot-{stamp}.toml"
        write_bytes(path, data)
        return path

    @property
    def newest_backup(self) -> Path | None:
        return max(self.backups.glob("robot-*.toml"), default=None)

    def _read(self, reader: Callable[[bytes, Path], Document], data: bytes) -> Document:
        try:
            return reader(data, self.config_file)
        except BadInput as error:
            backup = self.newest_backup
            remedy = f"mend it by hand, or bring back {backup}" if backup else "mend it by hand"
            raise BadInput(error.what, where=error.where, remedy=remedy) from None

    def _model_problems(self, path: Path, simulate: bool, effects: Sequence[EffectEntry]) -> list[ConfigProblem]:
        if not path.is_file():
            return [ConfigProblem("model", f"there is no file {path}", "name the MJCF relative to the robot's folder")]
        if not simulate:
            return []
        import mujoco

        from openant_tools.robot.model_file import check_model_file
        from openant_tools.robot.pair import OTHER_REMEDY, stranger_words, strangers

        try:
            check_model_file(path)
            model = mujoco.MjModel.from_xml_path(str(path))
        except BadInput as error:
            return [ConfigProblem("model", f"{error.where}: {error.what}", error.remedy)]
        except (ValueError, mujoco.FatalError) as error:
            return [ConfigProblem("model", f"MuJoCo cannot load {path}: {' '.join(str(error).split())}")]
        driven = {int(model.actuator_trnid[k, 0]) for k in range(model.nu)}
        problems = []
        for joint in JOINTS:
            index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
            if index < 0:
                problems.append(ConfigProblem("model", f"{path} has no joint {joint}"))
            elif index not in driven:
                problems.append(ConfigProblem("model", f"no actuator of {path} drives {joint}"))
        others = strangers(effects, model)
        problems += [
            ConfigProblem(f"effect[{n}]", stranger_words([one], path), OTHER_REMEDY)
            for n, one in enumerate(effects, 1)
            if one in others
        ]
        return problems


def _line_of(text: str, key: str) -> int | None:
    """The line of a dotted key in TOML text, as well as headers and plain keys tell; else that of its nearest table."""
    if not key:
        return None
    match = re.fullmatch(r"effect\[(\d+)\](?:\.(.*))?", key)
    if match:
        headers = [n for n, line in enumerate(text.splitlines(), 1) if re.match(r"\s*\[\[\s*effect\s*\]\]", line)]
        index = int(match[1]) - 1
        return headers[index] if index < len(headers) else None
    provenance = re.match(r'provenance\."(.*?)"', key)
    parts = ["provenance", provenance[1]] if provenance else key.split(".")
    best: tuple[int, int] | None = None
    table: list[str] = []
    for n, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*\[{1,2}\s*([^\[\]]+?)\s*\]{1,2}", line)
        assignment = re.match(r"\s*([^=#\[\]]+?)\s*=", line)
        if header:
            table = _split_key(header[1])
            here = table
        elif assignment:
            here = [*table, *_split_key(assignment[1])]
        else:
            continue
        if here == parts[: len(here)] and (best is None or len(here) > best[0]):
            best = (len(here), n)
    return best[1] if best else None


def _split_key(key: str) -> list[str]:
    return [
        double or single or bare for double, single, bare in re.findall(r'"([^"]*)"|\'([^\']*)\'|([A-Za-z0-9_-]+)', key)
    ]


def _plain(value: Any) -> Any:
    """A value as TOML has it: NumPy scalars and arrays, tuples and mappings become plain."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, tuple | list):
        return [_plain(entry) for entry in value]
    return value


def _edited(
    document: tomlkit.TOMLDocument,
    where: Path,
    values: Mapping[str, Any],
    provenance: Mapping[str, Provenance],
    effects: Sequence[EffectEntry] | None = None,
) -> tuple[bytes | None, RobotConfig]:
    """A document's bytes after a change, None where nothing changes, and what they then say.

    Raises:
        BadInput: they would say something that cannot be.
    """
    said = document.unwrap()
    for path, value in values.items():
        _set(document, _keys(document, path), _plain(value))
    for path, entry in provenance.items():
        _set_provenance(document, path, entry)
    if effects is not None:
        _set_effects(document, effects)
    after = tomlkit.dumps(document)
    says = parse_toml(after, where)
    config, problems = parse_config(says)
    errors = [problem for problem in problems if problem.severity == "error"]
    if errors or config is None:
        raise BadInput(errors[0].what, where=f"{where}, {errors[0].place}", remedy=errors[0].remedy)
    return (after.encode("utf-8") if says != said else None), config


def _keys(document: Mapping[str, Any], path: str) -> list[str]:
    """The keys of a dotted path. Bounds of observations stand under the whole name of their signal, on one line each,
    unless their owner has given them tables."""
    keys = path.split(".")
    if keys[0] == "observation" and not isinstance(document.get("observation", {}).get(keys[1]), Mapping):
        return [keys[0], ".".join(keys[1:])]
    return keys


def _set(container: Any, keys: Sequence[str], value: Any) -> None:
    *path, last = keys
    for key in path:
        if key not in container:
            container[key] = tomlkit.table()
        container = container[key]
        if not isinstance(container, Mapping):
            raise BadInput(f"{key} is no table, so that {'.'.join(keys)} cannot be set")
    present = container.get(last)
    if present is not None and _same(present, value):
        return
    container[last] = value


def _same(present: Any, value: Any) -> bool:
    """Whether a TOML item already says this value; 1 and 1.0 are one number, 1 and true are not."""
    plain = present.unwrap() if hasattr(present, "unwrap") else present
    wanted = value.unwrap() if hasattr(value, "unwrap") else value
    if isinstance(plain, bool) != isinstance(wanted, bool):
        return False
    return bool(plain == wanted)


def _set_provenance(document: tomlkit.TOMLDocument, path: str, entry: Provenance) -> None:
    present = document.get("provenance", {})
    for stale in [key for key in present if key != path and covers(path, str(key))]:
        del present[stale]
    _set(document, ["provenance", path], _provenance_item(entry))


def _provenance_item(entry: Provenance) -> InlineTable:
    item = tomlkit.inline_table()
    for key in ("how", "command", "recording", "date", "low", "high"):
        value = getattr(entry, key)
        if value is not None:
            item.append(key, _plain(value))
    return item


def _effect_table(effect: EffectEntry) -> Table:
    table = tomlkit.table()
    table.append("effect", effect.effect)
    table.append("joints", _plain(effect.joints))
    parameters = tomlkit.inline_table()
    parameters.update(_plain(effect.parameters))
    table.append("parameters", parameters)
    table.append("enabled", effect.enabled)
    if effect.pair is not None:
        table.append("pair", effect.pair)
    return table


def _set_effects(document: tomlkit.TOMLDocument, effects: Sequence[EffectEntry]) -> None:
    _, problems = parse_config(document.unwrap())
    if any(problem.key.startswith("effect") and problem.severity == "error" for problem in problems):
        raise BadInput("the effects that stand in it cannot be read", where=CONFIG_NAME, remedy="mend them first")
    present = document.get("effect")
    kept: dict[tuple[str, str | tuple[str, ...]], Table] = {}
    if isinstance(present, AoT):
        for table in present:
            joints = table.get("joints", "all")
            plain = joints if isinstance(joints, str) else tuple(str(joint) for joint in joints)
            kept[(str(table["effect"]), str(plain) if isinstance(plain, str) else plain)] = table
    tables = tomlkit.aot()
    for effect in effects:
        table = kept.get((effect.effect, effect.joints))
        if table is None:
            tables.append(_effect_table(effect))
            continue
        for name, value in effect.parameters.items():
            _set(table, ["parameters", name], _plain(value))
        for name in [name for name in table.get("parameters", {}) if name not in effect.parameters]:
            del table["parameters"][name]
        if bool(table.get("enabled", True)) != effect.enabled:
            table["enabled"] = effect.enabled
        if effect.pair is None:
            table.pop("pair", None)
        else:
            _set(table, ["pair"], effect.pair)
        tables.append(table)
    if isinstance(present, AoT) and list(map(id, present)) == [id(kept.get((e.effect, e.joints))) for e in effects]:
        return  # the tables were changed in place, where they stand
    if not effects:
        document.pop("effect", None)
    else:
        document["effect"] = tables


def _template(name: str, kit: Kit, date: datetime.datetime) -> str:
    """The text of a new `robot.toml`."""
    motors: list[str] = []
    for joint in JOINTS.values():
        limit = ANGLE_LIMIT_RAD[joint.kind]
        motors.append(
            f"[motors.{joint.name}]  # {joint.words}\n"
            f"id = {joint.id}\n"
            f'model = "{kit.servo(joint.kind).name}"\n'
            f"direction = 1\n"
            f"zero_offset_rad = {NOMINAL_ZERO_RAD!r}\n"
            f"min_rad = {-limit!r}\n"
            f"max_rad = {limit!r}\n"
        )
    stamp = date.strftime("%Y-%m-%dT%H:%M:%SZ")
    nominal = f'{{how = "nominal", command = "openant config new", date = {stamp}}}'
    return f"""\
# One Open Ant: what it is built from, how it is plugged in, and what was measured on it.
# Edit it freely. The `openant` commands change single values and leave comments, order and keys of your own alone;
# each change leaves the file before it in backups/. Units are SI: m, kg, s, rad. `openant config check` reads it over.

schema = "openant.robot/1"
name = {tomlkit.string(name).as_string()}
kit = "{kit.name}"  # {kit.words}
model = "{NOMINAL_MODEL}"  # the MJCF that simulates this robot; `openant sysid fit` puts a calibrated one here

[ports]  # empty while unknown; names below /dev/serial/by-id/ survive replugging
bus = ""  # the servos' USB adapter (U2D2)
imu = ""  # the flight controller
camera = ""  # number or device of the overhead camera

[bus]
baud = 1_000_000
return_delay_s = 0.0  # the factory's 500 µs cost 4 ms a read of eight servos
write_read_gap_s = 0.0002  # from the end of a write to the next read
pwm_limit = 0.5  # share of full duty; it bounds torque and speed alike
watchdog_s = 0.2  # the servos stop by themselves after this long without a word from us

# joint angle = direction * (servo angle - zero_offset_rad). Positive turns a hip counter-clockwise seen from above and
# lifts the tip of a leg; zero is the leg straight out. min_rad and max_rad bound commands.

{chr(10).join(motors)}
[imu]
mounting_rad = [0.0, 0.0, 0.0]  # rotation vector from the sensor's frame to the body's
gyro_bias_rad_s = [0.0, 0.0, 0.0]
acc_bias_m_s2 = [0.0, 0.0, 0.0]
gyro_counts_per_dps = 16.384  # raw counts for 1 °/s; 14.286 of sensors of 70 mdps a step; `openant calib imu` measures it

[camera]
fov_diagonal_rad = 1.0471975511965976  # 60 degrees
origin_tag_id = 0
origin_tag_size_m = 0.1  # edge of the tag on the floor; a wrong size scales every distance
body_tag_id = -1  # the tag on the torso; -1 while unknown
body_tag_size_m = 0.045
tag_family = "tagCircle21h7"  # or tag36h11, tag25h9, tag16h5
body_tag_position_m = [0.0, 0.0, 0.085]  # its centre in the torso's frame
body_tag_yaw_rad = 0.0  # its up-direction against the torso's x axis (forward)

[arena]  # the circle to learn in; centre_m, in the frame of the origin's tag, once it is measured
radius_m = 0.3

[timing]
dt_s = 0.12  # from one action to the next

[actions]
preset = "platform"  # range of actions: platform, sac or sarsa; hip_centre_rad, knee_half_range_rad … override it

[observation]  # measured bounds, such as "pos.hip_rr" = [-0.8, 0.8] or "gyro.x" = [-3.1, 2.9]

[provenance]  # where a value, or all values below a name, came from
motors = {nominal}
bus = {nominal}
camera = {nominal}
"""


def create_robot(
    path: str | Path,
    kit: str = "standard",
    name: str | None = None,
    *,
    values: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Provenance] | None = None,
) -> RobotFolder:
    """Make a robot's folder: `robot.toml`, `nominal.xml`, `recordings/` and `findings/`, with the kit's nominal values.

    Args:
        path: the folder; it may exist, but must not hold a robot already.
        kit: "standard" or "lite".
        name: what to call the robot; default the folder's name.
        values: dotted path → value, where it is to differ from the nominal one.
        provenance: dotted path → where these values came from.

    Raises:
        BadInput: there is a robot already, there is no such kit, or a value cannot be; nothing is written then.
    """
    parts = kit_by_name(kit)
    folder = RobotFolder(Path(path))
    if folder.path.exists() and not folder.path.is_dir():
        raise BadInput("is a file, but a robot is a folder", where=folder.path, remedy="name another one")
    there = BadInput(
        f"there is a {CONFIG_NAME} already",
        where=folder.path,
        remedy="choose another folder, or edit what stands there",
    )
    if folder.config_file.exists():
        raise there
    date = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    text = _template(name or folder.path.resolve().name, parts, date).encode("utf-8")
    changed, _ = _edited(tomlkit.parse(text.decode("utf-8")), folder.config_file, values or {}, provenance or {})
    with folder._changing():
        if folder.config_file.exists():
            raise there
        for part in (folder.recordings, folder.findings):
            part.mkdir(parents=True, exist_ok=True)
        write_text(folder.path / NOMINAL_MODEL, nominal_mjcf(parts.name))
        # Last, because it is what makes the folder a robot's.
        write_bytes(folder.config_file, text if changed is None else changed)
    return folder
