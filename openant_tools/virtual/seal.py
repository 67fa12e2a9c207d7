"""Sealed scenarios: what is wrong with a robot, readable only by the virtual robot that is opened with the key.

A sealed file is TOML too. It shows what whoever brings the robot up knows anyway (kit, setup, clock); all else, the
whole plain file, stands encrypted in `[sealed]` by AES-256-GCM, which also covers the part that is shown: a changed
file does not open. `commitment` is the SHA-256 of a random salt, kept inside the seal, and the plain text: published
before a trial, it proves afterwards that nobody changed the riddle, and the salt keeps anyone from guessing it.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import os
import secrets
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit

from openant_tools.errors import BadInput
from openant_tools.files import write_text

__all__ = ["KEY_VARIABLE", "commitment_of", "is_sealed", "make_key", "open_sealed", "read_key", "seal"]

#: names the key file where no option does
KEY_VARIABLE = "OPENANT_SCENARIO_KEY"
CIPHER = "AES-256-GCM"
#: bytes; NIST SP 800-38D recommends 96 bits for the nonce
KEY_BYTES, NONCE_BYTES, SALT_BYTES = 32, 12, 32
#: what stays readable: section → keys
_SHOWN: Mapping[str, tuple[str, ...]] = {"robot": ("kit", "setup"), "clock": ("mode", "doze")}


def make_key(path: Path) -> bytes:
    """A new random key, kept in a file that only its owner may read; raises BadInput where one stands there."""
    key = secrets.token_bytes(KEY_BYTES)
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise BadInput("there is a key already", where=path, remedy="use it, or name another file") from None
    except OSError as error:
        raise BadInput(error.strerror or str(error), where=path, remedy="name a file in a folder of yours") from None
    with os.fdopen(descriptor, "wb") as file:
        file.write(base64.b64encode(key) + b"\n")
    return key


def read_key(path: Path) -> bytes:
    """The key in a file; raises BadInput."""
    try:
        key = base64.b64decode(path.read_bytes().strip(), validate=True)
    except OSError as error:
        raise BadInput(error.strerror or str(error), where=path, remedy="name the key file of this scenario") from None
    except binascii.Error:
        key = b""
    if len(key) != KEY_BYTES:
        raise BadInput("this is no key of a sealed scenario", where=path, remedy="`openant virtual seal` makes one")
    return key


def is_sealed(table: Mapping[str, Any]) -> bool:
    return "sealed" in table


def commitment_of(salt: bytes, plain: str) -> str:
    return hashlib.sha256(salt + plain.encode()).hexdigest()


def seal(plain: str, key: bytes, out: Path) -> str:
    """Write the sealed form of a scenario's text; its commitment.

    Args:
        plain: TOML that has been read and found good.
    """
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    shown = _shown(tomllib.loads(plain))
    salt, nonce = secrets.token_bytes(SALT_BYTES), secrets.token_bytes(NONCE_BYTES)
    commitment = commitment_of(salt, plain)
    data = nonce + AESGCM(key).encrypt(nonce, salt + plain.encode(), _bound(shown, commitment))
    document = tomlkit.document()
    document.add(tomlkit.comment("A sealed scenario: `openant virtual start --scenario FILE --key-file KEY` opens it."))
    for section, values in shown.items():
        document[section] = values
    document["sealed"] = {
        "cipher": CIPHER,
        "commitment": commitment,
        "data": base64.b64encode(data).decode(),
    }
    write_text(out, tomlkit.dumps(document))
    return commitment


def open_sealed(table: Mapping[str, Any], key: bytes, where: Path | str) -> str:
    """The plain text of a sealed scenario, proven unchanged; raises BadInput."""
    from cryptography.exceptions import InvalidTag
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    part = table["sealed"]
    if not isinstance(part, Mapping) or part.get("cipher") != CIPHER:
        raise BadInput(
            f"[sealed] is not of the kind {CIPHER}", where=where, remedy="take a file that `openant virtual seal` wrote"
        )
    commitment = str(part.get("commitment"))
    try:
        data = base64.b64decode(str(part.get("data")), validate=True)
        shown = {section: dict(values) for section, values in table.items() if section != "sealed"}
        opened = AESGCM(key).decrypt(data[:NONCE_BYTES], data[NONCE_BYTES:], _bound(shown, commitment))
    except (InvalidTag, ValueError, TypeError):
        raise BadInput(
            "the seal does not open: another key, or the file was changed", where=where, remedy="take the key it was "
            "sealed with"
        ) from None  # fmt: skip
    salt, plain = opened[:SALT_BYTES], opened[SALT_BYTES:].decode()
    if commitment_of(salt, plain) != commitment:
        raise BadInput(
            "what is inside is not what was committed to",
            where=where,
            remedy="ask whoever sealed it for the file again",
        )
    return plain


def _shown(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    parts = {
        section: {key: table[section][key] for key in keys if key in table.get(section, {})}
        for section, keys in _SHOWN.items()
    }
    return {section: values for section, values in parts.items() if values}


def _bound(shown: Mapping[str, Any], commitment: str) -> bytes:
    """What is not secret but must not change."""
    return json.dumps([shown, commitment], sort_keys=True).encode()
