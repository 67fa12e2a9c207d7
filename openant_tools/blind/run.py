"""Let the diagnosis judge every robot of a set: one JSON file a robot, and nothing done twice.

Robots fan out over cores, or over machines, through joblib: `loky` for processes of this machine, `dask` for a cluster (with its
address, or a local one), `ray`. Every machine of a cluster must see the set's folder under the same path.
"""

from __future__ import annotations

import contextlib
import json
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

from joblib import Parallel, delayed, parallel_config

from openant_tools.blind.by_command import is_made, tables_of
from openant_tools.blind.draw import BATCH
from openant_tools.errors import BadInput, OpenAntError
from openant_tools.files import read_json, read_toml, write_text
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run
from openant_tools.workers import tied

__all__ = ["Backend", "Diagnose", "folders_of", "recorded_of", "run_set", "verdict_path"]

Backend = Literal["loky", "dask", "ray"]
#: a robot's folder and the model → a diagnosis as JSON
Diagnose = Callable[[Path, Path], dict[str, Any]]


def folders_of(folder: Path) -> list[Path]:
    """The robots of a set.

    Raises:
        BadInput: this is no set.
    """
    if not (folder / "set.toml").is_file():
        raise BadInput(
            "there is no set.toml here", where=folder, remedy="name a set that `openant gap blind make` made"
        )
    return sorted(path for path in folder.glob("robot-*") if path.is_dir())


def verdict_path(folder: Path, robot: str) -> Path:
    return folder / "verdicts" / f"{robot}.json"


def diagnose_robot(robot: Path, model: Path) -> dict[str, Any]:
    """The diagnosis of one robot from its tables alone, as JSON (formats, section 2)."""
    from openant_tools.gap.diagnose import diagnose

    runs, held_out, named = recorded_of(robot, model)
    found: dict[str, Any] = diagnose(runs, named, hold_out=held_out).as_json()
    return found


def recorded_of(robot: Path, model: Path) -> tuple[list[Run], list[Run], Path]:
    """The runs of one robot, those that its maker held out, and the model that they name; else the set's."""
    runs = [read_run(path) for path in tables_of(robot)]
    # A robot of another program may come with a nominal model of its own.
    named = next((path for run in runs if (path := run.model_path) is not None and path.is_file()), model)
    held_out = [run for run in runs if run.facts.extra.get("held_out")]
    return [run for run in runs if not run.facts.extra.get("held_out")], held_out, named


def run_set(
    folder: Path,
    *,
    jobs: int = 1,
    backend: Backend = "loky",
    scheduler: str | None = None,
    diagnose: Diagnose = diagnose_robot,
    progress: Callable[[float, str], None] = lambda share, words: None,
) -> int:
    """Diagnose what has no verdict yet; how many that were.

    A robot whose diagnosis is refused gets a verdict with `error`, which counts against it and is tried again next time.

    Args:
        scheduler: address of a Dask cluster; None starts `jobs` workers here.

    Raises:
        BadInput: no set, or the backend is not installed.
    """
    todo = [robot for robot in _whole(folder) if not _judged(verdict_path(folder, robot.name))]
    if not todo:
        return 0
    with _fan_out(backend, jobs, scheduler), warnings.catch_warnings():
        # That a process which has grown is replaced is no one's concern.
        warnings.filterwarnings("ignore", "A worker stopped", UserWarning)
        judge = tied(_judge) if backend == "loky" else _judge  # the others' workers may be on other machines
        work = (delayed(judge)(folder, robot, diagnose) for robot in todo)
        for done, name in enumerate(Parallel(return_as="generator_unordered")(work), 1):
            progress(done / len(todo), name)
    return len(todo)


def _whole(folder: Path) -> list[Path]:
    """Robots that have every run: one whose making was stopped lacks some until the set is made further."""
    robots = folders_of(folder)
    if read_toml(folder / "set.toml").get("maker", BATCH) not in (BATCH, "bus"):
        return [robot for robot in robots if is_made(robot)]
    runs = {robot: len(list(robot.glob("*.json"))) for robot in robots}
    return [robot for robot in robots if runs[robot] == max(runs.values())]


def _judged(path: Path) -> bool:
    try:
        return "error" not in read_json(path)
    except (OSError, BadInput, TypeError):
        return False


def _judge(folder: Path, robot: Path, diagnose: Diagnose) -> str:
    """Diagnose one robot, and say how long it took."""
    began = time.monotonic()
    try:
        found = diagnose(robot, folder / "model.xml")
    except OpenAntError as error:
        found = {"verdict": None, "error": str(error)}
    found["blind"] = {"robot": robot.name, "seconds": round(time.monotonic() - began, 2)}
    write_text(verdict_path(folder, robot.name), json.dumps(found, indent=1) + "\n")
    return robot.name


@contextlib.contextmanager
def _fan_out(backend: Backend, jobs: int, scheduler: str | None) -> Iterator[None]:
    """Where joblib sends its work."""
    if backend == "loky":
        # One thread each: what is inside must not fight over the same cores.
        with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
            yield
        return
    if backend == "ray":
        try:
            from ray.util.joblib import register_ray
        except ImportError:
            raise BadInput("Ray is not installed", remedy="pip install 'ray[default]', or use --backend dask") from None
        register_ray()
        with parallel_config(backend="ray", n_jobs=jobs):
            yield
        return
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise BadInput("Dask is not installed", remedy="pip install 'openant-tools[dask]'") from None
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            # Nothing but work goes over it: no dashboard, no port that anybody else could meet.
            cluster = stack.enter_context(LocalCluster(n_workers=jobs, threads_per_worker=1, dashboard_address=None))
            client = stack.enter_context(Client(cluster))
        else:
            try:
                client = stack.enter_context(Client(scheduler, timeout="10s"))
            except (OSError, TimeoutError, ValueError):
                raise BadInput(
                    f"no Dask scheduler answers at {scheduler}",
                    remedy="start one by `dask scheduler`, and name its address",
                ) from None
        stack.enter_context(parallel_config(backend="dask", client=client))
        yield
