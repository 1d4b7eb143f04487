"""Row checksums of the store (store/src/checksum.rs): a CRC-32 of a row's columns, each with its type and length."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from .store_errors import DamagedError

INTEGER, REAL, TEXT, BYTES = "integer", "real", "text", "bytes"

Row = Mapping[str, Any]


@dataclass(frozen=True)
class CheckedTable:
    """A table with row checksums: the column that names a row, and the columns covered by the checksum, in its order."""

    name: str
    key: str
    columns: tuple[tuple[str, str], ...]

    def selected(self) -> str:
        """The columns of the table and its checksum for a query with joins, under the names ``table__column``."""
        names = [name for name, _ in self.columns]
        if self.key not in names:
            names.append(self.key)
        return ", ".join(f"{self.name}.{name} AS {self.name}__{name}" for name in [*names, "checksum"])

    def verify(self, row: Row, joined: bool = False) -> None:
        """Verify a row with the table's own column names, or with those of :meth:`selected`.

        Raises :class:`DamagedError` if the row differs from what was written.
        """
        prefix = f"{self.name}__" if joined else ""
        computed = checksum((kind, row[prefix + name]) for name, kind in self.columns)
        found = row[prefix + "checksum"]
        _compare(found, computed, f"{self.name.replace('_', ' ')} {row[prefix + self.key]}")


def verify_column(what: str, number: int, data: bytes | None, found: int | None) -> None:
    """Verify a long column that has a checksum of its own, in the row with this number."""
    _compare(found, checksum([(INTEGER, number), (BYTES, data)]), f"{what} {number}")


def checksum(values: Iterable[tuple[str, Any]]) -> int:
    """CRC-32 of typed values; None is NULL."""
    return zlib.crc32(b"".join(_encoded(kind, value) for kind, value in values))


def _encoded(kind: str, value: Any) -> bytes:
    if kind == INTEGER:
        return struct.pack("<cBq", b"i", value is not None, value or 0)
    if kind == REAL:
        # Databases drop the sign of zero; NaN is stored as NULL.
        return struct.pack("<cBd", b"r", value is not None, (value or 0.0) + 0.0)
    data = value.encode() if isinstance(value, str) else bytes(value or b"")
    return struct.pack("<cBQ", b"b", value is not None, len(data)) + data


def _compare(found: int | None, computed: int, what: str) -> None:
    if found is None:
        raise DamagedError(f"damaged database: {what}: its checksum is missing")
    if found != computed:
        raise DamagedError(
            f"damaged database: {what}: its content has the checksum {computed:08x}, and {found:08x} was stored with it"
        )


def _table(name: str, key: str, columns: str) -> CheckedTable:
    """A table from a text such as ``number:i name:t``."""
    kinds = {"i": INTEGER, "r": REAL, "t": TEXT, "b": BYTES}
    split = (column.split(":") for column in columns.split())
    return CheckedTable(name, key, tuple((column, kinds[kind]) for column, kind in split))


CAMPAIGN = _table("campaign", "key", "key:t value:t")
STRUCTURE = _table("structure", "number", "hash:b atoms:i formula:t data:b")
SEED_STRUCTURE = _table("seed_structure", "seed", "seed:i name:t source:t structure:i")
PROTOCOL = _table("protocol", "name", "hash:b name:t settings:t")
DECISION = _table(
    "decision", "sequence", "sequence:i round:i kind:t walk:i candidate:t mixture_version:i detail:t"
)
CANDIDATE = _table(
    "candidate",
    "decision",
    """decision:i id:t content:b walk:i segment:i step:i seed_structure:i origin:t fate:t reason:t mixture_version:i
    atoms:i formula:t temperature:r relative_volume:r energy:r walker_gamma:r walker_gamma_nbr:r walker_above:i
    selector_gamma:r selector_gamma_nbr:r selector_above:i original_gamma:r original_gamma_nbr:r original_above:i""",
)
COMPONENT = _table("component", "element", "element:i slot:i bytes:b")
WALK = _table(
    "walk",
    "walk",
    """walk:i origin:t partner:i seed_structure:i state:t reason:t assignments:i accepted:i step:i segment:i tau:r
    temperature:r relative_volume:r gamma_max:r rejected:i rollbacks:i selector_state:t""",
)
WALK_CONDITIONS = _table("walk_conditions", "walk", "walk:i conditions:t")
WALK_TRACE = _table("walk_trace", "walk", "walk:i points:i data:b")
REFERENCE_VOLUME = _table("reference_volume", "walk", "walk:i volume:r")
VERSION = _table(
    "version",
    "number",
    """number:i parent:i state:t reason:t method:t structures:i last_decision:i labels:i model_hash:t mixture_hash:t
    figures:t seconds:r core_hours:r time:i""",
)
LABEL = _table(
    "label",
    "number",
    "structure:i protocol:i energy:r forces:b stress:b job:i attempt:i file:t frame:i received:i details:t",
)
IMPORT = _table("import", "structure", "structure:i file:t frame:i")
