"""What an installation weighs: `pip install .` and each extra in an environment of its own, MB on disk; the table of
docs/install.md.

    python benchmarks/install_size.py [EXTRA ...]

Each is made in a temporary folder, weighed (what pip itself and the empty environment weigh is taken off), and deleted.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXTRAS = ("", "camera", "camera-gui", "parquet", "view", "agents", "all")


def weight(folder: Path) -> float:
    """MB of the files of a folder, as `du` counts them."""
    return sum(file.lstat().st_blocks * 512 for file in folder.rglob("*")) / 1e6


def main() -> None:
    print("| what is installed | MB |")
    print("|---|---|")
    for extra in sys.argv[1:] or EXTRAS:
        with tempfile.TemporaryDirectory() as place:
            environment = Path(place, "env")
            venv.create(environment, with_pip=True)
            empty = weight(environment)
            wanted = f"{ROOT}[{extra}]" if extra else str(ROOT)
            python, uv = str(environment / "bin" / "python"), shutil.which("uv")
            install = [python, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
            if uv:  # a third of the time, the same files
                install = [uv, "pip", "install", "-q", "--compile-bytecode", "--link-mode", "copy", "--python", python]
            install += shlex.split(os.environ.get("ECOSYSTEM_INSTALL", ""))
            subprocess.run([*install, "-c", str(ROOT / "constraints.txt"), wanted], check=True)
            print(f"| `pip install '.[{extra}]'` |" if extra else "| `pip install .` |", end=" ")
            print(f"{weight(environment) - empty:.0f} |", flush=True)


if __name__ == "__main__":
    main()
