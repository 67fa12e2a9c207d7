"""The passport: one page with everything known about a robot, as HTML and Markdown."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from openant_tools.bringup.robot_picture import robot_picture
from openant_tools.bringup.tracking import Moment, draw_moment, worst_moment
from openant_tools.bringup.walk import WALK, Standing, standing
from openant_tools.errors import BadInput
from openant_tools.numbers import column, number, span
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Bench, Procedure, Progress
from openant_tools.recording.tables import read_run
from openant_tools.report import Figure, KeyFigure, Mark, Part, Picture, Report, ReportSummary, plots
from openant_tools.robot.config import RobotConfig
from openant_tools.robot.folder import NOMINAL_MODEL, RobotFolder
from openant_tools.robot.joints import JOINTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["passport", "passport_step", "write_passport"]

COMMAND = "openant passport"
_STATES = {
    "ok": Mark("ok", "good"),
    "failed": Mark("no", "bad"),
    "unsure": Mark("cannot judge", "warn"),
    "stale": Mark("older than its needs", "warn"),
    "todo": Mark("not done"),
}


def passport_step(bench: Bench) -> Procedure:
    """Write the passport of the robot as it stands."""
    yield Progress(None, "writing the passport")
    paths = write_passport(bench.folder, real=not bench.virtual)
    states = standing(bench.folder, real=not bench.virtual)
    done = _done(states)
    missing = [
        WALK[name].title
        for name, now in states.items()
        if now.state in ("todo", "failed", "unsure") and name != "passport"
    ]
    return Finding(
        "passport",
        True,
        f"{paths[0].name} and {paths[1].name}: {done} of {len(WALK)} steps say yes, this one included",
        (Evidence("steps that say yes", float(done), "", "findings/, and this passport"),),
        f"openant train sac --robot {bench.folder.path} --out {bench.folder.runs / 'sac-1'}"
        if not missing
        else f"still to do: {', '.join(missing)}",
        COMMAND,
        data={"files": [bench.folder.relative(path) for path in paths]},
    )


def _done(states: Mapping[str, Standing]) -> int:
    """How many steps say yes, as the walk counts them once there is the passport that is being written."""
    return sum(now.state == "ok" or name == "passport" for name, now in states.items())


def write_passport(folder: RobotFolder, *, real: bool = True) -> tuple[Path, Path]:
    """Write passport.html and passport.md; both paths.

    Args:
        real: whether steps that were done on a virtual robot count for nothing.
    """
    report = passport(folder, real=real)
    return report.write(folder.passport), report.write_markdown(folder.passport.with_suffix(".md"))


def passport(folder: RobotFolder, *, real: bool = True) -> Report:
    """The passport as a report.

    Args:
        real: whether steps that were done on a virtual robot count for nothing.
    """
    config = folder.config()
    states = standing(folder, real=real)
    found = {name: now.finding for name, now in states.items()}
    done = _done(states)
    open_ = [now.step.title for name, now in states.items() if now.state != "ok" and name != "passport"]
    failed = any(now.state == "failed" for now in states.values())
    problems = [
        f"- {line if line.startswith(now.step.title) else f'{now.step.title}: {line}'}"
        for now in states.values()
        if now.finding
        for line in now.finding.lines
    ]
    left = ", ".join(open_[:4]) + (f" and {len(open_) - 4} more" if len(open_) > 4 else "")
    train = f"openant train sac --robot {folder.path} --out {folder.runs / 'sac-1'}"
    answer = ReportSummary(
        f"{config.name} is measured and calibrated: all {done} steps say yes."
        if not open_
        else f"{done} of {len(WALK)} steps of {config.name} say yes; left: {left}.",
        _portrait(folder, found["identify"]),
        f"Simulated and real robot read this folder: `{config.model}` is the model, `robot.toml` the rest."
        + ("\n\n" + "\n".join(problems) if problems else ""),
        f"Do {open_[0]}: `openant bringup --robot {folder.path}`."
        if open_
        else f"Train: `{train}`. Before every session: `openant check --robot {folder.path}`.",
        "good" if not open_ else "bad" if failed else "warn",
        _figures(found["gap"], found["comms"]),
    )
    report = Report(
        f"Passport of {config.name}", f"{config.kit} kit, in {folder.path.resolve()}", answer,
        made_by=f"{COMMAND} --robot {folder.path}",
        recordings=_recordings(folder),
    )  # fmt: skip
    report.section("Step by step").table(
        ["step", "stands", "when (UTC)", "what was found"],
        [
            [
                now.step.title,
                Mark("done on a virtual robot") if now.virtual else _STATES[now.state],
                f"{now.finding.date:%Y-%m-%d %H:%M}{', virtual robot' if now.finding.virtual else ''}"
                if now.finding
                else "",
                now.finding.what if now.finding else "",
            ]
            for name, now in states.items()
            if name != "passport"
        ],
    )
    _motors(report, config, found["inventory"], found["bounds"])
    _sensors(report, config, found["arena"])
    _observations(report, folder, found["bounds"])
    report.section("Commands").code(
        f"{train}\n"
        f"openant check --robot {folder.path}        # before every session\n"
        f"openant config export --robot {folder.path}   # for the platform's own software"
    )
    report.section("Where values came from").table(["value", "how", "command", "recording", "date"], _origins(config))
    return report


def _origins(config: RobotConfig) -> list[list[str]]:
    """Where each value came from; what several joints have from the same is told once."""
    told: dict[tuple[str, ...], list[str]] = {}
    for name, entry in config.provenance.items():
        joint = next((part for part in name.split(".") if part in JOINTS), "")
        day = entry.date.strftime("%Y-%m-%d") if entry.date else ""
        alike = name.replace(joint, "*") if joint else name
        told.setdefault((alike, entry.how, entry.command or "", entry.recording or "", day), []).append(joint)
    return [
        [alike.replace("*", joints[0]) if len(joints) == 1 else f"{alike} ({len(joints)} joints)", *rest]
        for (alike, *rest), joints in told.items()
    ]


def _figures(gap: Finding | None, comms: Finding | None) -> list[KeyFigure]:
    figures = []
    after = next((e for e in gap.evidence if e.name == "position gap, calibrated"), None) if gap else None
    if after is not None:
        figures.append(KeyFigure("simulation is off by", after.words, "joint positions, 0.5 s ahead"))
    if comms is not None and "rate_hz" in comms.data:
        rate = number(comms.data["rate_hz"], decimals=0)
        figures.append(KeyFigure("bus", f"{rate} cycles/s", "write and read of all servos"))
    return figures


def _recordings(folder: RobotFolder) -> list[Path]:
    """Of which its values were made, each once."""
    origins = folder.config().provenance.values()
    named = dict.fromkeys(name for entry in origins if entry.recording for name in entry.recording.split(", "))
    return [folder.path / name for name in named]


def _portrait(folder: RobotFolder, identified: Finding | None) -> Part | None:
    """The robot, and how it and its models move where that was recorded."""
    from matplotlib.image import imread

    moment = _tracking(folder, identified)
    picture, how = robot_picture(folder.model_path())
    if moment is None:
        return None if picture is None else Picture(picture, f"The robot's model at its home pose, {how}.")
    figure: MatplotlibFigure
    figure, axes = plots.figure(2, 2, height=2.0, width_ratios=[2, 3])
    for place in axes[:, 0]:
        place.axis("off")
    if picture is not None:
        whole = figure.add_subplot(axes[0, 0].get_gridspec()[:, 0])
        whole.imshow(imread(io.BytesIO(picture)))
        whole.axis("off")
    axes[0, 1].sharex(axes[1, 1])
    axes[0, 1].tick_params(labelbottom=False)
    draw_moment(axes[0, 1], axes[1, 1], moment)
    plots.legend(axes[0, 1], ncols=2)
    return Figure(
        figure,
        f"The robot's model at its home pose, {how}; and {moment.joint} on a motion that the fit did not see, where the data sheets' "
        "model is worst.",
    )


def _tracking(folder: RobotFolder, identified: Finding | None) -> Moment | None:
    held_out = identified.data.get("held_out", []) if identified else []
    if not held_out:
        return None
    try:
        return worst_moment(read_run(folder.path / held_out[0]), folder.path / NOMINAL_MODEL, folder.model_path())
    except BadInput:  # a recording or model that was moved away costs the picture, not the passport
        return None


def _motors(report: Report, config: RobotConfig, inventory: Finding | None, bounds: Finding | None) -> None:
    eeprom = inventory.data.get("eeprom", {}) if inventory else {}
    swept = bounds.data.get("sweep", {}) if bounds else {}
    rows = []
    for joint, motor in config.motors.items():
        sweep = swept.get(joint, {})
        rows.append(
            [
                joint,
                JOINTS[joint].words,
                str(motor.id),
                motor.model,
                str(eeprom.get(joint, {}).get("firmware_version", "")),
                "+" if motor.direction > 0 else "−",
                number(motor.zero_offset_rad, "rad", decimals=1),
                span(motor.min_rad, motor.max_rad, "rad"),
                "" if sweep.get("friction_nm") is None else number(sweep["friction_nm"], "N·m", decimals=3),
            ]
        )
    report.section("Joints").table(
        ["joint", "where", "id", "servo", "firmware", "way", "zero", "limits", "friction"], rows
    )


def _sensors(report: Report, config: RobotConfig, arena: Finding | None) -> None:
    imu, camera = config.imu, config.camera
    mounted = math.sqrt(sum(x * x for x in imu.mounting_rad))
    late = camera.latency_s if camera.latency_s is not None else arena.data.get("latency_s") if arena else None
    missing = "not measured"
    report.section("Sensors").table(
        ["what", "value"],
        [
            ["IMU: counts per g", number(imu.acc_counts_per_g) if imu.acc_counts_per_g else missing],
            ["IMU: counts per °/s", number(imu.gyro_counts_per_dps)],
            ["IMU: mounted at", number(mounted, "rad", decimals=1)],
            ["IMU: gyro bias", " ".join(number(x, "rad/s", sign=True, decimals=2) for x in imu.gyro_bias_rad_s)],
            ["camera: diagonal field of view", number(camera.fov_diagonal_rad, "rad")],
            ["camera: latency", missing if late is None else number(late, "s")],
            ["tags: origin, body", f"{camera.origin_tag_id}, {camera.body_tag_id}"],
            [
                "tags: edge of origin, body",
                " and ".join(column((camera.origin_tag_size_m, camera.body_tag_size_m), "m")),
            ],
        ],
    )


def _observations(report: Report, folder: RobotFolder, bounds: Finding | None) -> None:
    config = folder.config()
    if not config.observation:
        return
    report.section("Observations").table(
        ["observation", "lowest to highest"],
        [[name, span(low, high, plots.signal_unit(name))] for name, (low, high) in config.observation.items()],
    )
    picture = folder.path / str(bounds.data.get("picture", "")) if bounds else folder.path
    if picture.is_file():
        report.picture(picture, "What the motions for the bounds covered.")
