"""Which engines carry a written model: each feature of MuJoCo that we write, and what each engine was seen to do with it.

`engines.json` is made by running each engine (`benchmarks/engines.py`): a pendulum with the feature is played there and in
MuJoCo 4. An engine *carries* it where both move alike, *refuses* where it says that it cannot, and *drops* it where it
moves as if it were not there, or otherwise, without a word.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from lxml import etree

from openant_tools.model.servo import GIVES_WAY

__all__ = ["EFFECTS", "FEATURES", "carries", "elsewhere", "engines", "features_of", "lacking", "sentence", "state"]

MARK = "Engines: "
TABLE = Path(__file__).with_name("engines.json")
_DYN, _BIAS = mujoco.mjtDyn, mujoco.mjtBias


#: feature → whether a compiled model has it
FEATURES: Mapping[str, Callable[[mujoco.MjModel], bool]] = {
    "delayed commands": lambda m: bool((m.actuator_delay > 0).any()),
    "filtered setpoint": lambda m: bool(np.isin(m.actuator_dyntype, (_DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT)).any()),
    "rate-limited setpoint": lambda m: bool((m.actuator_dyntype == _DYN.mjDYN_PID).any()),
    "motor": lambda m: bool((m.actuator_biastype == _BIAS.mjBIAS_DCMOTOR).any()),
    "damping with the square of speed": lambda m: bool(m.dof_dampingpoly.any()),
    "dry friction that holds": lambda m: bool((m.dof_solimp[:, :2] > GIVES_WAY)[m.dof_frictionloss > 0].any()),
    "adhesion": lambda m: bool(m.geom_adhesion.any()),
    "delayed sensors": lambda m: bool((m.sensor_delay > 0).any()),
}

#: effect of the catalogue → the feature that it is written by; others are written by what every engine has
EFFECTS: Mapping[str, str] = {
    "action_delay": "delayed commands", "actuator_lag": "filtered setpoint", "slew_limit": "rate-limited setpoint",
    "speed_limit": "motor", "electrical_damping": "motor", "cogging": "motor", "stribeck_friction": "motor",
    "viscous_nonlinear": "damping with the square of speed", "foot_adhesion": "adhesion", "sensor_delay": "delayed sensors",
}  # fmt: skip


@cache
def engines() -> Mapping[str, Mapping[str, str]]:
    """Engine with its version → feature → `carries`, `drops`, `refuses`, as measured; the first one is MuJoCo 4."""
    found: Mapping[str, Mapping[str, str]] = json.loads(TABLE.read_text(encoding="utf-8"))["engines"]
    return found


def features_of(model: mujoco.MjModel) -> list[str]:
    """Those of `FEATURES` that a compiled model has."""
    return [name for name, there in FEATURES.items() if there(model)]


def lacking(engine: str, model: mujoco.MjModel) -> dict[str, str]:
    """Feature of the model → what this engine does instead of carrying it."""
    table = engines()[engine]
    return {name: table[name] for name in features_of(model) if table[name] != "carries"}


def carries(engine: str, effect: str) -> bool:
    """Whether an engine, by the first word of its name in any case (`mjx`), carries what an effect is written by."""
    table = next(table for name, table in engines().items() if name.lower().startswith(engine.lower()))
    return effect not in EFFECTS or table[EFFECTS[effect]] == "carries"


def elsewhere(effect: str) -> str:
    """Of what an effect is written by: what engines do with it that do not carry it, to be said behind the file's name."""
    found = {} if effect not in EFFECTS else {name: table[EFFECTS[effect]] for name, table in engines().items()}
    words = [f"{name} {verdict} it" for name, verdict in found.items() if verdict != "carries"]
    return f" ({', '.join(words)})" if words else ""


def sentence(model: mujoco.MjModel) -> list[str]:
    """A line an engine: whether it carries the model as written, else what becomes of what."""
    lines = []
    for engine in engines():
        missing = lacking(engine, model)
        words = "; ".join(
            f"{verdict} {', '.join(name for name, found in missing.items() if found == verdict)}"
            for verdict in dict.fromkeys(missing.values())
        )
        lines.append(f"{engine} {words or 'carries it as written'}")
    return lines


def state(root: etree._Element, model: mujoco.MjModel) -> None:
    """Say in the document's first comment which engines carry it, in the place of an earlier word on that."""
    for comment in root.iterchildren(etree.Comment):
        comment.text = str(comment.text).partition(MARK)[0]
    first = root[0] if len(root) and isinstance(root[0], etree._Comment) else None
    if first is None:
        first = etree.Comment("")
        first.tail = root.text or "\n  "
        root.insert(0, first)
    said = str(first.text or "").strip().rstrip(".")
    text = f" {said}{'. ' if said else ''}{MARK}{'. '.join(sentence(model))} "
    first.text = text.replace("--", "−−")
