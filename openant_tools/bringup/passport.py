"""The passport: one page with everything known about a robot, as HTML and Markdown."""

from __future__ import annotations

import math
from pathlib import Path

from openant_tools.bringup.walk import WALK, standing
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Bench, Procedure, Progress
from openant_tools.report import KeyFigure, Mark, Report
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.joints import JOINTS

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
    paths = write_passport(bench.folder)
    states = standing(bench.folder)
    done = [name for name, now in states.items() if now.state == "ok"]
    missing = [
        WALK[name].title
        for name, now in states.items()
        if now.state in ("todo", "failed", "unsure") and name != "passport"
    ]
    return Finding(
        "passport",
        True,
        f"{paths[0].name} and {paths[1].name}: {len(done)} of {len(WALK) - 1} steps say yes",
        (Evidence("steps that say yes", float(len(done)), "", "findings/"),),
        f"openant train sac --robot {bench.folder.path} --out {bench.folder.runs / 'sac-1'}"
        if not missing
        else f"still to do: {', '.join(missing)}",
        COMMAND,
        data={"files": [bench.folder.relative(path) for path in paths]},
    )


def write_passport(folder: RobotFolder) -> tuple[Path, Path]:
    """Write passport.html and passport.md; both paths."""
    report = passport(folder)
    return report.write(folder.passport), report.write_markdown(folder.passport.with_suffix(".md"))


def passport(folder: RobotFolder) -> Report:
    """The passport as a report."""
    config = folder.config()
    states = standing(folder)
    report = Report(f"Passport of {config.name}", f"{config.kit} kit, in {folder.path.resolve()}", made_by=COMMAND)
    report.section("How it stands")
    figures = [
        KeyFigure(
            "steps done", f"{sum(now.state == 'ok' for n, now in states.items() if n != 'passport')} of {len(WALK) - 1}"
        )
    ]
    gap = states["gap"].finding
    if gap is not None:
        values = {evidence.name: evidence.value for evidence in gap.evidence}
        after = values.get("position gap, calibrated")
        if after is not None:
            figures.append(KeyFigure("simulation is off by", f"{1e3 * after:.1f} mrad", "joint positions, 0.5 s ahead"))
    comms = states["comms"].finding
    if comms is not None and "rate_hz" in comms.data:
        figures.append(KeyFigure("bus", f"{comms.data['rate_hz']:.0f} cycles/s", "write and read of all servos"))
    report.key_figures(*figures)
    report.table(
        ["step", "stands", "when (UTC)", "what was found"],
        [
            [
                now.step.title,
                _STATES[now.state],
                now.finding.date.strftime("%Y-%m-%d %H:%M") if now.finding else "",
                now.finding.what if now.finding else "",
            ]
            for name, now in states.items()
            if name != "passport"
        ],
    )
    problems = [f"- {now.step.title}: {line}" for now in states.values() if now.finding for line in now.finding.lines]
    if problems:
        report.section("What to look at").text("\n".join(problems))
    _motors(report, folder)
    _sensors(report, folder)
    _observations(report, folder)
    report.section("What it is good for").text(
        f"Simulated and real robot read this folder: `{config.model}` is the model, `robot.toml` the rest."
    )
    report.code(
        f"openant train sac --robot {folder.path} --out {folder.runs / 'sac-1'}\n"
        f"openant check --robot {folder.path}        # before every session\n"
        f"openant config export --robot {folder.path}   # for the platform's own software"
    )
    report.section("Where values came from").table(
        ["value", "how", "command", "recording", "date"],
        [
            [
                name,
                entry.how,
                entry.command or "",
                entry.recording or "",
                entry.date.strftime("%Y-%m-%d") if entry.date else "",
            ]
            for name, entry in config.provenance.items()
        ],
    )
    return report


def _motors(report: Report, folder: RobotFolder) -> None:
    config, states = folder.config(), standing(folder)
    inventory, bounds = states["inventory"].finding, states["bounds"].finding
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
                f"{math.degrees(motor.zero_offset_rad):.1f}",
                f"{math.degrees(motor.min_rad):.0f} … {math.degrees(motor.max_rad):.0f}",
                "" if sweep.get("friction_nm") is None else f"{sweep['friction_nm']:.3f}",
            ]
        )
    report.section("Joints").table(
        ["joint", "where", "id", "servo", "firmware", "way", "zero (°)", "limits (°)", "friction (N·m)"], rows
    )


def _sensors(report: Report, folder: RobotFolder) -> None:
    config = folder.config()
    imu, camera = config.imu, config.camera
    mounted = math.degrees(math.sqrt(sum(x * x for x in imu.mounting_rad)))
    report.section("Sensors").table(
        ["what", "value", "unit"],
        [
            ["IMU: counts per g", f"{imu.acc_counts_per_g:.0f}" if imu.acc_counts_per_g else "not measured", ""],
            ["IMU: counts per °/s", f"{imu.gyro_counts_per_dps:.4g}", ""],
            ["IMU: mounted at", f"{mounted:.1f}", "°"],
            ["IMU: gyro bias", " ".join(f"{x:+.4f}" for x in imu.gyro_bias_rad_s), "rad/s"],
            ["camera: diagonal field of view", f"{math.degrees(camera.fov_diagonal_rad):.1f}", "°"],
            ["camera: latency", "not measured" if camera.latency_s is None else f"{1e3 * camera.latency_s:.0f}", "ms"],
            ["tags: origin, body", f"{camera.origin_tag_id}, {camera.body_tag_id}", ""],
            [
                "tags: edge of origin, body",
                f"{1e3 * camera.origin_tag_size_m:.1f}, {1e3 * camera.body_tag_size_m:.1f}",
                "mm",
            ],
        ],
    )


def _observations(report: Report, folder: RobotFolder) -> None:
    config = folder.config()
    if not config.observation:
        return
    report.section("Observations").table(
        ["observation", "lowest", "highest"], [[name, low, high] for name, (low, high) in config.observation.items()]
    )
    bounds = standing(folder)["bounds"].finding
    picture = folder.path / str(bounds.data.get("picture", "")) if bounds else folder.path
    if picture.is_file():
        report.picture(picture, "What the motions for the bounds covered.")
