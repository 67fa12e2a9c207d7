"""The notebooks of examples/, run as a reader does: every cell in order, in a folder of their own."""

import json
import os
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("agg")
examples = Path(__file__).resolve().parents[2] / "examples"
run = sys.argv[1:] or [path.name for path in sorted(examples.glob("*.ipynb"))]
for name in run:
    cells = json.loads((examples / name).read_text(encoding="utf-8"))["cells"]
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        seen: dict[str, object] = {}
        for cell in cells:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), f"{name}, cell {cell['id']}", "exec"), seen)
        os.chdir(examples)
print(f"{', '.join(run)} ran through")
