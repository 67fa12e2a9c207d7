"""Two processes share a study in a PostgreSQL server of Debian's, which runs as its own user."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PORT = "54329"
programs = sorted(Path("/usr/lib/postgresql").glob("*/bin"))[-1]


def as_postgres(*words: object) -> None:
    command = ["runuser", "-u", "postgres", "--", *map(str, words)] if os.geteuid() == 0 else list(map(str, words))
    subprocess.run(command, check=True, capture_output=True, cwd="/", timeout=60)


place = Path(tempfile.mkdtemp(prefix="openant-postgresql-"))
place.chmod(0o777)
try:
    as_postgres(programs / "initdb", "-D", place / "data", "-A", "trust")
    options = f"-p {PORT} -k {place} -c listen_addresses=127.0.0.1"
    as_postgres(programs / "pg_ctl", "-D", place / "data", "-w", "-l", place / "log", "-o", options, "start")
    try:
        url = f"postgresql+psycopg2://postgres@127.0.0.1:{PORT}/postgres"
        ask = [
            "-m",
            "openant_tools",
            "tune",
            "sarsa",
            "--kit",
            "standard",
            "--storage",
            url,
            "--trials",
            "4",
            "--seeds",
            "1",
            "--steps",
            "40",
        ]
        both = [subprocess.Popen([sys.executable, *ask], stderr=subprocess.PIPE, text=True) for _ in range(2)]
        said = [one.communicate(timeout=150)[1] for one in both]
        assert [one.returncode for one in both] == [0, 0], said[0][-500:]
        import optuna

        study = optuna.load_study(study_name="sarsa", storage=url)
        print(f"two processes shared {len(study.trials)} trials of one study")
    finally:
        as_postgres(programs / "pg_ctl", "-D", place / "data", "-m", "fast", "stop")
finally:
    shutil.rmtree(place, ignore_errors=True)
