"""Candidates of a campaign: which ones, page by page, and their decoding."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

from .blocks import Block, Floats, decode_block, decode_matrix, decode_numbers, decode_vectors
from .checksums import CANDIDATE, DECISION, LABEL, Row, verify_column
from .records import Candidate, Label, LabelProtocol, WalkConditions
from .store import Store, pages
from .store_errors import DamagedError

# Rows with blocks that are read at a time: a block of 1,000 atoms has 72 kB, its features a few MB.
_BLOCKS = 50
_SYMBOL = re.compile("[A-Z][a-z]?")

LABEL_COLUMNS = (
    LABEL.selected()
    + ", label.status AS label__status, label.reason AS label__reason, label.exclusion AS label__exclusion"
)

# The label that an export would have: that of the protocol, unless somebody dropped the structure.
_LABEL_JOIN = """LEFT JOIN label ON label.structure = candidate.structure AND label.protocol = ? AND label.status = 'label'
    AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = candidate.structure AND job.protocol = label.protocol
                    AND job.state = 'dropped')"""

_LONG_COLUMNS = (("selector_grades", "selector_checksum"), ("original_grades", "original_checksum"))
_FEATURES = ("features", "features_checksum")


@dataclass(frozen=True)
class CandidateFilter:
    """Which candidates. What is None does not matter; several values of `walk` or `seed_structure` may be given as a list."""

    fate: str | None = None
    """`accepted` or `declined`."""
    reason: str | None = None
    """Why it was declined: `covered`, `duplicate`, `too_close` …"""
    origin: str | None = None
    """`biased` or `control`."""
    walk: int | Iterable[int] | None = None
    seed_structure: int | str | Iterable[int | str] | None = None
    """Index or name."""
    min_gamma: float | None = None
    """The largest γ of an atom under the original mixture is at least this."""
    max_gamma: float | None = None
    element: str | None = None
    """One of the atoms is of this element."""
    group: str | None = None
    """Group of its walk."""
    temperature: float | None = None
    """Of its walk, K."""
    potential_version: int | None = None
    """Version of the potential that drove its walk."""
    labelled: bool | None = None
    after: int = 0
    """Only decisions after this one."""
    before: int | None = None
    """Only decisions before this one."""
    limit: int | None = None
    """At most so many."""


class CandidateReader:
    """Reads candidates with what belongs to them: seed structure, conditions of the walk, label of one protocol."""

    def __init__(
        self,
        store: Store,
        seed_names: Mapping[int, str],
        conditions: Mapping[int, WalkConditions],
        protocol: LabelProtocol | None,
    ) -> None:
        self._store, self._seed_names, self._conditions, self._protocol = (
            store,
            seed_names,
            conditions,
            protocol,
        )

    def rows(self, wanted: CandidateFilter) -> Iterator[Row]:
        """Verified rows without blocks, in decision order, under the names `table__column`."""
        where, parameters = self._conditions_of(wanted)
        sql = f"""SELECT {CANDIDATE.selected()}, {DECISION.selected()}, {LABEL_COLUMNS},
            candidate.features_checksum AS features_checksum, candidate.selector_checksum AS selector_checksum,
            candidate.original_checksum AS original_checksum
            FROM candidate JOIN decision ON decision.sequence = candidate.decision {_LABEL_JOIN}
            WHERE {where} AND candidate.decision > ? ORDER BY candidate.decision LIMIT ?"""
        number = self._protocol.number if self._protocol else -1
        found = pages(self._store, sql, "candidate__decision", [number, *parameters])
        return islice(filter(lambda row: self._matches(row, wanted), map(_verified, found)), wanted.limit)

    def candidates(self, wanted: CandidateFilter, features: bool) -> Iterator[Candidate]:
        """Complete candidates in decision order."""
        rows = self.rows(wanted)
        while batch := list(islice(rows, _BLOCKS)):
            data = self._data([row["candidate__decision"] for row in batch], features)
            for row in batch:
                yield self._candidate(row, data[row["candidate__decision"]], features)

    def walk_conditions(self, row: Row) -> WalkConditions | None:
        """Those of the walk of a row."""
        return self._conditions.get(row["candidate__walk"])

    def seed_name(self, row: Row) -> str:
        """Name of the seed structure of a row."""
        return self._seed_names.get(row["candidate__seed_structure"], "")

    def _conditions_of(self, wanted: CandidateFilter) -> tuple[str, list[Any]]:
        """What SQL decides."""
        terms = {
            "fate = ?": wanted.fate,
            "candidate.reason = ?": wanted.reason,
            "origin = ?": wanted.origin,
            "original_gamma >= ?": wanted.min_gamma,
            "original_gamma <= ?": wanted.max_gamma,
            "candidate.decision > ?": wanted.after or None,
            "candidate.decision < ?": wanted.before,
        }
        used = {term: value for term, value in terms.items() if value is not None}
        conditions, parameters = ["1 = 1", *used], list(used.values())
        if wanted.labelled is not None:
            conditions.append(f"label.number IS {'NOT' if wanted.labelled else ''} NULL")
        chosen = {
            "candidate.walk": _integers(wanted.walk),
            "seed_structure": self._seeds(wanted.seed_structure),
        }
        for column, numbers in chosen.items():
            if numbers is not None:
                # An empty list matches nothing in both databases only in this form.
                conditions.append(f"{column} IN ({', '.join('?' * len(numbers)) or 'NULL'})")
                parameters += numbers
        return " AND ".join(conditions), parameters

    def _seeds(self, wanted: int | str | Iterable[int | str] | None) -> list[int] | None:
        if wanted is None:
            return None
        values = [wanted] if isinstance(wanted, (int, str)) else list(wanted)
        unknown = [name for name in values if isinstance(name, str) and name not in self._seed_names.values()]
        if unknown:
            raise ValueError(f"there is no seed structure '{unknown[0]}'")
        return [seed for seed, name in self._seed_names.items() if seed in values or name in values]

    def _matches(self, row: Row, wanted: CandidateFilter) -> bool:
        """What SQL does not decide: the conditions of the walk, and elements."""
        if wanted.element is not None and wanted.element not in _SYMBOL.findall(row["candidate__formula"]):
            return False
        of_walk = {
            "group": wanted.group,
            "temperature": wanted.temperature,
            "version": wanted.potential_version,
        }
        asked = {name: value for name, value in of_walk.items() if value is not None}
        conditions = self.walk_conditions(row)
        return not asked or (
            conditions is not None
            and all(getattr(conditions, name) == value for name, value in asked.items())
        )

    def _data(self, decisions: list[int], features: bool) -> dict[int, Row]:
        places = ", ".join("?" * len(decisions))
        columns = "decision, block, selector_grades, original_grades" + (", features" if features else "")
        rows = self._store.rows(
            f"SELECT {columns} FROM candidate_data WHERE decision IN ({places})", decisions
        )
        found = {row["decision"]: row for row in rows}
        for decision in decisions:
            if decision not in found:
                raise DamagedError(
                    f"damaged database: candidate of decision {decision}: its block is missing"
                )
        return found

    def _candidate(self, row: Row, data: Row, features: bool) -> Candidate:
        decision, name = row["candidate__decision"], row["candidate__id"]
        for column, checksum in [*_LONG_COLUMNS, *([_FEATURES] if features else [])]:
            what = f"the {column.replace('_', ' ')} of the candidate of decision"
            verify_column(what, decision, data[column], row[checksum])
        block = _block(row, data)
        selector, original = _grades(data["selector_grades"]), _grades(data["original_grades"])
        return Candidate(
            decision=decision,
            id=name,
            fate=row["candidate__fate"],
            reason=row["candidate__reason"],
            origin=row["candidate__origin"],
            walk=block.walk,
            segment=block.segment,
            step=block.step,
            seed_structure=row["candidate__seed_structure"],
            seed_structure_name=self.seed_name(row),
            conditions=self.walk_conditions(row),
            mixture_version_seen=block.mixture_version,
            mixture_version=row["decision__mixture_version"],
            temperature=block.temperature,
            relative_volume=block.relative_volume,
            energy=block.energy,
            virial=block.virial,
            structure=block.structure,
            forces=block.forces,
            walker_gamma=block.gamma,
            walker_gamma_nbr=block.gamma_nbr,
            selector_gamma=selector[0],
            selector_gamma_nbr=selector[1],
            original_gamma=original[0],
            original_gamma_nbr=original[1],
            features=_features(data["features"], len(block.gamma)) if features else None,
            label=decode_label(row, self._protocol) if self._protocol and row["label__number"] else None,
        )


def decode_label(row: Row, protocol: LabelProtocol) -> Label:
    """The label of a verified row with :data:`LABEL_COLUMNS`."""
    stress, details = row["label__stress"], row["label__details"]
    return Label(
        number=row["label__number"],
        structure=row["label__structure"],
        protocol=protocol.name,
        protocol_hash=protocol.hash,
        status=row["label__status"],
        energy=row["label__energy"],
        forces=decode_vectors(row["label__forces"]),
        stress=None if stress is None else decode_matrix(stress),
        details=json.loads(details) if details else {},
        job=row["label__job"],
        attempt=row["label__attempt"],
        file=row["label__file"],
        frame=row["label__frame"],
        received=row["label__received"],
        reason=row["label__reason"] or row["label__exclusion"],
    )


def _verified(row: Row) -> Row:
    CANDIDATE.verify(row, joined=True)
    DECISION.verify(row, joined=True)
    if row["label__number"] is not None:
        LABEL.verify(row, joined=True)
    return row


def _block(row: Row, data: Row) -> Block:
    """The block of a row, which must be that of its candidate."""
    name = row["candidate__id"]
    try:
        block = decode_block(data["block"])
    except DamagedError as error:
        raise DamagedError(f"damaged database: candidate {name}: {error}") from None
    if block.id != name or block.content != bytes(row["candidate__content"]):
        raise DamagedError(f"damaged database: candidate {name}: its block is that of {block.id}")
    return block


def _grades(data: bytes | None) -> tuple[Floats, Floats] | tuple[None, None]:
    """γ and γ_nbr, one after the other in the column."""
    if data is None:
        return None, None
    numbers = decode_numbers(data)
    return numbers[: len(numbers) // 2], numbers[len(numbers) // 2 :]


def _features(data: bytes | None, atoms: int) -> Floats | None:
    return None if data is None else decode_numbers(data).reshape(atoms, -1)


def _integers(wanted: int | Iterable[int] | None) -> list[int] | None:
    if wanted is None:
        return None
    return [wanted] if isinstance(wanted, int) else list(wanted)
