"""`make ecosystem`: every peer in a throw-away environment of its own, one row each, and what became of it in docs/ecosystem.md.

    python benchmarks/ecosystem.py                 rows that have no result of this day yet
    python benchmarks/ecosystem.py sb3 minari      these, anew

Each row installs this project and a peer the way a user would, runs one command against the peer's own code, and keeps what it said in
the page itself: a run that was stopped goes on where it was. What cannot be installed here says so. With `uv`
on the path it installs, in a third of pip's time; ECOSYSTEM_INSTALL holds further arguments for either.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import shlex
import shutil
import subprocess
import time
import venv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from peers.their_files import NOT_RUN

ROOT = Path(__file__).parents[1]
BUILD = ROOT / "build" / "ecosystem"
PAGE = ROOT / "docs" / "ecosystem.md"
#: s for an installation, and for the command
PATIENCE_S = int(os.environ.get("ECOSYSTEM_PATIENCE_S", "180"))
PYTEST = ("pytest>=8,<9", "pytest-timeout", "hypothesis")
#: what the platform's requirements.txt asks for
PLATFORM = (
    "dynamixel-sdk", "pyserial", "numpy", "opencv-python", "pyapriltags", "gymnasium", "mujoco", "imageio", "scipy", "torch",
    "matplotlib", "skrl", "tyro", "pandas", "mediapy", "wandb",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """A peer.

    Attributes:
        what: is shown by it.
        steps: installations in order; each a tuple of requirements, `.` being this project; after `-` of what is taken out again.
        command: after `python`, in the root of this project.
        versions: of these distributions the table says the version.
        needs: a program without which it cannot be run.
    """

    what: str
    steps: tuple[tuple[str, ...], ...]
    command: tuple[str, ...]
    versions: tuple[str, ...]
    needs: str | None = None


def peer(name: str) -> tuple[str, ...]:
    return (f"benchmarks/peers/{name}.py",)


def tests(*names: str) -> tuple[str, ...]:
    return ("-m", "pytest", "-p", "no:cacheprovider", *names)


ROWS = {
    "platform-first": Row(
        "the platform's requirements, then ours: windows stay", (PLATFORM, (".",)), peer("opencv"),
        ("opencv-python", "mujoco", "torch"), "xvfb-run",
    ),
    "ours-first": Row(
        "ours, then the platform's requirements: windows come", ((".",), PLATFORM), peer("opencv"),
        ("opencv-python", "mujoco", "torch"), "xvfb-run",
    ),
    "platform": Row(
        "the platform's own environment and agent on the virtual robot", (PLATFORM, (".",)), peer("open_ant"),
        ("dynamixel-sdk", "opencv-python", "gymnasium"), "xvfb-run",
    ),
    "sb3": Row(
        "Stable-Baselines3 trains and evaluates", ((".", "stable-baselines3"),), ("examples/sb3.py",),
        ("stable-baselines3", "torch", "gymnasium"),
    ),
    "torchrl": Row("TorchRL collects and checks specs", ((".", "torchrl"),), ("examples/torchrl_ant.py",), ("torchrl", "torch")),
    "cleanrl": Row(
        "CleanRL's own file learns, nothing changed but the id", ((".", "torch", "tyro", "tensorboard"),), peer("cleanrl"),
        ("torch", "tyro", "gymnasium"), "git",
    ),
    "gymnasium": Row(
        "Gymnasium's own checker on every id", ((".",),), peer("gymnasium_checker"), ("gymnasium", "mujoco-core")
    ),
    "minari": Row(
        "Minari reads what `rec export --to minari` wrote", ((".[parquet]", "minari[arrow]", "pillow"),),
        peer("minari_reads"), ("minari", "pyarrow"),
    ),
    "lerobot": Row(
        "LeRobot's own dataset class reads what `--to lerobot` wrote", ((".[parquet]", "lerobot"),), peer("lerobot_reads"),
        ("lerobot", "datasets", "torch"),
    ),
    "viewers": Row(
        "Rerun and Foxglove read back what was exported", ((".", "rerun-sdk", "foxglove-sdk", *PYTEST),),
        tests("tests/exchange/test_viewers.py"), ("rerun-sdk", "foxglove-sdk", "mcap"),
    ),
    "dynamixel-sdk": Row(
        "the vendor's SDK on the virtual bus", ((".", *PYTEST),), tests("tests/comms/test_vendor_sdk.py"), ("dynamixel-sdk",)
    ),
    "dask": Row(
        "a Dask cluster of two workers diagnoses a blind set", ((".[dask,parquet]", *PYTEST),),
        tests("tests/blind/test_blind.py", "-k", "dask"), ("dask", "distributed"),
    ),
    "notebooks": Row(
        "the notebooks of `examples/`, cell by cell", ((".[agents]",),), peer("notebooks"), ("torch", "mujoco-core", "matplotlib")
    ),
    "postgresql": Row(
        "`openant tune` over a PostgreSQL server of Debian's", ((".[agents]", "psycopg2-binary"),), peer("postgresql"),
        ("optuna", "psycopg2-binary"), "pg_lsclusters",
    ),
    "mujoco-3.17": Row(
        "the oldest MuJoCo with `mujoco.batch`", ((".[camera,parquet]", *PYTEST), ("-", "mujoco-core", "mujoco"), ("--no-deps", "mujoco==3.17.0")),
        tests("tests/model/test_rollout.py", "tests/model/test_plant.py", "tests/model/test_write_model.py", "tests/model/test_plain_mujoco.py"),
        ("mujoco", "mujoco-core"),
    ),
}  # fmt: skip


def run(name: str) -> dict[str, Any]:
    """Make a row's environment, run its command, throw the environment away."""
    row, place = ROWS[name], BUILD / name
    shown = "python " + " ".join(row.command)
    told: dict[str, Any] = {"date": datetime.date.today().isoformat(), "command": shown, "versions": ""}
    if row.needs and shutil.which(row.needs) is None:
        return told | {"result": f"not run: there is no `{row.needs}` here", "ok": None}
    shutil.rmtree(place, ignore_errors=True)
    uv = shutil.which("uv")
    venv.create(place, with_pip=uv is None)
    python = str(place / "bin" / "python")
    install = (
        [uv, "pip", "install", "-q", "--python", python]
        if uv
        else [python, "-m", "pip", "install", "-q", "--no-compile"]
    )
    install += shlex.split(os.environ.get("ECOSYSTEM_INSTALL", ""))
    # Nothing of this checkout but what was installed; paths that a test starts commands from are the environment's.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    environment["PATH"] = f"{place / 'bin'}{os.pathsep}{environment['PATH']}"
    begun = time.monotonic()
    try:
        for step in row.steps:
            words = [str(ROOT) + one[1:] if one == "." or one.startswith(".[") else one for one in step]
            if step[0] == "-":
                out = [uv, "pip", "uninstall", "--python", python] if uv else [python, "-m", "pip", "uninstall", "-y"]
                words = [name for name in step[1:] if _versions(python, (name,))]
                done = _run([*out, *words], environment, place)
            else:
                done = _run([*install, *words], environment, place)
            if done.returncode:
                return told | {"result": f"cannot be installed: {_last(done.stderr)}", "ok": None}
        told["versions"] = _versions(python, row.versions)
        done = _run([python, *row.command], environment, place)
        said = _last(done.stdout if done.returncode in (0, NOT_RUN) else done.stderr) or _last(done.stdout)
        if done.returncode == NOT_RUN:
            return told | {"result": f"not run: {said}", "ok": None}
        return told | {
            "result": said if done.returncode == 0 else f"{said} (exit code {done.returncode})",
            "ok": done.returncode == 0,
        }
    except subprocess.TimeoutExpired as late:
        what = "its installation" if "install" in late.cmd else "the command"
        return told | {"result": f"not run: {what} took longer than {PATIENCE_S} s here", "ok": None}
    finally:
        told["seconds"] = round(time.monotonic() - begun)
        shutil.rmtree(place, ignore_errors=True)


def _run(command: list[str], environment: dict[str, str], place: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )  # fmt: skip


def _last(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip() and "WARNING" not in line]
    return lines[-1][:160].replace("|", "/") if lines else ""


def _versions(python: str, names: tuple[str, ...]) -> str:
    ask = (
        "import importlib.metadata as m, sys\n"
        "for n in sys.argv[1:]:\n"
        "    try: print(n, m.version(n))\n"
        "    except m.PackageNotFoundError: pass"
    )
    done = subprocess.run([python, "-c", ask, *names], capture_output=True, text=True, check=False)
    return ", ".join(done.stdout.split("\n")).strip(", ")


SIGNS = {True: "✓", False: "✗", None: "–"}


def page(told: dict[str, str]) -> str:
    """The page: of each row what was told of it, or that it was not run."""
    lines = [
        "# Beside other software",
        "",
        "`make ecosystem` makes a throw-away environment for each peer, installs both the way a user would, and runs one command. What",
        f"cannot be installed or run where it was made says so. Made on Python {platform.python_version()}, {platform.system()}.",
        "",
        "| what | version | command | result | date |",
        "|---|---|---|---|---|",
    ]
    for name, row in ROWS.items():
        unknown = f"| {row.what} | | `python {' '.join(row.command)}` | – not run yet | |"
        lines.append(told.get(name, unknown))
    return "\n".join([*lines, ""])


def kept() -> dict[str, str]:
    """Row → its line on the page, where the page has one with a result."""
    lines = PAGE.read_text(encoding="utf-8").splitlines() if PAGE.is_file() else []
    return {
        name: line
        for name, row in ROWS.items()
        for line in lines
        if line.startswith(f"| {row.what} |") and "not run yet" not in line
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("rows", nargs="*", help=f"of {', '.join(ROWS)}; default: all that were not made today")
    asked = parser.parse_args().rows
    if unknown := [name for name in asked if name not in ROWS]:
        parser.error(f"no such row: {', '.join(unknown)}")
    BUILD.mkdir(parents=True, exist_ok=True)
    told = kept()
    today = datetime.date.today().isoformat()
    for name in asked or [name for name in ROWS if not told.get(name, "").endswith(f"| {today} |")]:
        found = run(name)
        print(name, found, flush=True)
        told[name] = (
            f"| {ROWS[name].what} | {found['versions']} | `{found['command']}` | "
            f"{SIGNS[found['ok']]} {found['result']} | {found['date']} |"
        )
        PAGE.write_text(page(told), encoding="utf-8")


if __name__ == "__main__":
    main()
