"""Beside the platform's OpenCV: one cv2, with windows, and one opens under Xvfb; our command says which."""

import subprocess
import sys

from openant_tools.optional import opencv

found = opencv()
assert found.windows, found.words
assert len(found.brought_by) == 1, found.words
show = "import cv2, numpy as np; cv2.imshow('w', np.zeros((9, 9), np.uint8)); cv2.waitKey(50); cv2.destroyAllWindows()"
subprocess.run(["xvfb-run", "-a", sys.executable, "-c", show], check=True, timeout=60)
print(f"{found.brought_by[0]}, with windows: cv2.imshow opened one")
