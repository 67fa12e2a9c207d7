"""A model and the effects that were fitted with it: one mark that both carry, so that neither is taken for part of another pair.

What plain MuJoCo cannot play of a robot (friction that follows the load) a plain fit books as what it can (dry friction); with the
effect beside it that would count twice. So a model that was fitted has a text `openant_effects` in its `<custom>`, and every
`[[effect]]` that was fitted with it has the same word as its `pair`; both move, are edited and renamed as they may. Effects without
one were written by hand, or by a program older than this: they go with any model.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
from lxml import etree

from openant_tools.robot.config import EffectEntry

__all__ = ["OTHER_REMEDY", "PLAIN", "TEXT", "mark", "mark_of", "stranger_words", "strangers"]

OTHER_REMEDY = (
    "name the model that was written with it (`calibrated.xml` beside its `calibrated.effects.toml`), or leave it out: "
    "enabled = false, effects=False, `--no-effects`"
)
TEXT = "openant_effects"
#: of a model that was fitted without effects
PLAIN = "none"


def mark_of(model: mujoco.MjModel) -> str | None:
    """The mark that a compiled model carries: that of its pair, PLAIN, or None where nobody fitted it."""
    k = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, TEXT)
    if k < 0:
        return None
    first, size = int(model.text_adr[k]), int(model.text_size[k])
    return bytes(model.text_data[first : first + size]).decode("utf-8", "replace").rstrip("\0")


def mark(root: etree._Element, word: str) -> None:
    """Write the mark into the document of a model, in the place of one that it has."""
    for text in [text for text in root.iter("text") if text.get("name") == TEXT]:
        text.set("data", word)
        return
    custom = etree.SubElement(root, "custom")
    previous = custom.getprevious()
    if previous is not None:
        previous.tail = "\n  "
    custom.text, custom.tail = "\n    ", "\n"
    etree.SubElement(custom, "text", name=TEXT, data=word).tail = "\n  "


def strangers(effects: Sequence[EffectEntry], model: mujoco.MjModel) -> list[EffectEntry]:
    """The enabled effects that were fitted with another model than this."""
    own = mark_of(model)
    return [one for one in effects if one.enabled and one.pair is not None and one.pair != own]


def stranger_words(effects: Sequence[EffectEntry], model: Path) -> str:
    """What is wrong with these beside a model."""
    names = ", ".join(dict.fromkeys(one.effect for one in effects))
    return f"{names} was fitted with another model than {model}: beside this one it would count twice"
