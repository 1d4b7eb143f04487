"""Messages between calmwalk and the server: lines of JSON (docs/python-protocol.md)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Optional

from .errors import InputError

VERSION = 1
"""Version of the protocol. Both sides refuse another one."""


class Connection:
    """Lines of JSON in both directions."""

    def __init__(self, incoming: BinaryIO, outgoing: BinaryIO) -> None:
        self._incoming, self._outgoing = incoming, outgoing

    def lines(self) -> Iterator[bytes]:
        """Messages until the other side closes its end."""
        return iter(self._incoming.readline, b"")

    def reply(self, message: Mapping[str, Any]) -> None:
        """Sends one message at once."""
        self._outgoing.write(json.dumps(message, allow_nan=False).encode() + b"\n")
        self._outgoing.flush()


def parse(line: bytes) -> dict[str, Any]:
    """One message. InputError if the line is not an object of JSON with the key `call`."""
    try:
        message = json.loads(line)
    except ValueError as error:
        raise InputError(f"expected a line of JSON, found {line[:60]!r} ({error})") from None
    if not isinstance(message, dict) or not isinstance(message.get("call"), str):
        raise InputError(f"expected an object with the key 'call', found {line[:60]!r}")
    return message


def get(message: Mapping[str, Any], key: str, kind: type) -> Any:
    """A value of a message. InputError if it is missing or of another type."""
    value = message.get(key)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise InputError(f"{key} is {value!r}, expected {kind.__name__}")
    return value


def as_path(value: Any, key: str) -> Optional[Path]:
    """A path or null of a message."""
    if value is None:
        return None
    if not isinstance(value, str):
        raise InputError(f"{key} is {value!r}, expected a path or null")
    return Path(value)
