"""Reading campaigns: ``calmwalk.open("campaign")`` gives their structures, labels, mixtures and walks (docs/campaigns-in-python.md).

Everything comes straight from the store, is verified by the checksums that stand in it, and is read in pages: iterators take little
memory, and a campaign may run meanwhile.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

from blake3 import blake3

from . import checksums, frames, tables
from .blocks import Component, Structure, decode_component, decode_structure
from .candidates import LABEL_COLUMNS, CandidateFilter, CandidateReader, decode_label
from .checksums import Row
from .records import (
    Candidate,
    ConstantPressure,
    Decision,
    Imported,
    Label,
    LabelProtocol,
    SeedStructure,
    Version,
    Walk,
    WalkConditions,
)
from .store import Store, open_store, pages
from .store_errors import DamagedError, StoreError
from .traces import Trace, decode_trace, empty_trace

_FILTERS = {field.name for field in fields(CandidateFilter)}


def open_campaign(location: str | os.PathLike[str]) -> Campaign:
    """Open a campaign for reading: its directory, the directory of its configuration, or its ``postgres://`` URL.

    Raises :class:`~calmwalk.store_errors.MissingCampaign` if there is none, and
    :class:`~calmwalk.store_errors.SchemaError` if this package does not read its tables.
    """
    return Campaign(open_store(location))


class Campaign:
    """A campaign that is read. Also a context manager, which closes it."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def __enter__(self) -> Campaign:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<campaign {self.id[:8]} in {self.location}>"

    def close(self) -> None:
        """Close the store."""
        self._store.close()

    @property
    def location(self) -> str:
        """Its directory, or its URL without the password."""
        return self._store.location

    @property
    def schema(self) -> int:
        """Version of its tables."""
        return self._store.schema

    @cached_property
    def id(self) -> str:
        """Hash of everything that must not change during the campaign."""
        return self._value("id")

    @property
    def mode(self) -> str:
        """`reproducible` or `live`."""
        return self._value("mode")

    @property
    def program_version(self) -> str:
        """Version of the program that created it."""
        return self._value("program_version")

    @property
    def configuration(self) -> dict[str, Any]:
        """The configuration in force, with every default filled in."""
        return dict(json.loads(self._value("configuration_in_force")))

    def candidates(
        self, *, protocol: str | None = None, features: bool = False, **filters: Any
    ) -> Iterator[Candidate]:
        """Candidates in decision order: :class:`~calmwalk.candidates.CandidateFilter` has the filters.

        Each has its label by ``protocol``, which must be named if there are labels of several. ``features`` also reads the
        feature vectors.
        """
        wanted = _filter(filters)
        return self._reader(protocol).candidates(wanted, features)

    def candidate(self, name: str, *, protocol: str | None = None) -> Candidate:
        """The candidate with this id, with its features if they were kept."""
        rows = self._store.rows("SELECT decision FROM candidate WHERE id = ?", [name])
        if not rows:
            raise KeyError(f"{self.location} has no candidate {name}")
        decision = rows[0]["decision"]
        return next(
            self.candidates(protocol=protocol, features=True, after=decision - 1, before=decision + 1)
        )

    def atoms(self, *, protocol: str | None = None, **filters: Any) -> Iterator[Any]:
        """Candidates as :class:`ase.Atoms`, with the names of an export (docs/export.md) and, in addition, ``decision``,
        ``fate``, ``reason``, ``model_energy``, ``model_virial`` and ``model_forces``."""
        has_versions = self._has_versions()
        for candidate in self.candidates(protocol=protocol, **filters):
            yield frames.candidate_atoms(candidate, self.id, has_versions)

    def dataset(
        self, *, protocol: str | None = None, control: bool = False, imported: bool = False
    ) -> Iterator[Any]:
        """The labelled structures that ``calmwalk export`` writes, in its order, as :class:`ase.Atoms`."""
        origin = None if control else "biased"
        yield from self.atoms(protocol=protocol, origin=origin, fate="accepted", labelled=True)
        if imported:
            for structure in self.imports(protocol=protocol, found_by_walks=False):
                if structure.label:
                    yield frames.imported_atoms(structure, self.id)

    def imports(self, *, protocol: str | None = None, found_by_walks: bool = True) -> Iterator[Imported]:
        """Imported structures in the order of their import. ``found_by_walks=False`` leaves out those that are candidates
        too."""
        chosen = self._protocol(protocol)
        others = (
            ""
            if found_by_walks
            else "AND NOT EXISTS (SELECT 1 FROM candidate WHERE candidate.structure = import.structure)"
        )
        sql = f"""SELECT import.number AS place, {checksums.IMPORT.selected()}, {checksums.STRUCTURE.selected()}, {LABEL_COLUMNS}
            FROM import JOIN structure ON structure.number = import.structure
            LEFT JOIN label ON label.structure = import.structure AND label.protocol = ? AND label.status = 'label'
                AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = import.structure AND job.protocol = label.protocol
                                AND job.state = 'dropped')
            WHERE 1 = 1 {others} AND import.number > ? ORDER BY import.number LIMIT ?"""
        for row in pages(self._store, sql, "place", [chosen.number if chosen else -1]):
            checksums.IMPORT.verify(row, joined=True)
            has_label = chosen is not None and row["label__number"] is not None
            if has_label:
                checksums.LABEL.verify(row, joined=True)
            yield Imported(
                number=row["place"],
                structure=_structure(row),
                file=row["import__file"],
                frame=row["import__frame"],
                label=decode_label(row, chosen) if has_label and chosen else None,
            )

    def labels(self, *, protocol: str | None = None, status: str | None = "label") -> Iterator[Label]:
        """Results of calculations in the order of their arrival; ``status=None`` gives checks, superseded and excluded ones
        too."""
        by_number = {found.number: found for found in self.protocols() if protocol in (None, found.name)}
        if protocol is not None and not by_number:
            raise _unknown_protocol(protocol, self.protocols())
        sql = f"SELECT {LABEL_COLUMNS} FROM label WHERE label.number > ? ORDER BY label.number LIMIT ?"
        for row in pages(self._store, sql, "label__number"):
            if row["label__protocol"] in by_number and status in (None, row["label__status"]):
                checksums.LABEL.verify(row, joined=True)
                yield decode_label(row, by_number[row["label__protocol"]])

    def structure(self, number: int) -> Structure:
        """The structure with this number: that of a label, for example."""
        sql = f"SELECT {checksums.STRUCTURE.selected()} FROM structure WHERE number = ?"
        rows = self._store.rows(sql, [number])
        if not rows:
            raise KeyError(f"{self.location} has no structure {number}")
        return _structure(rows[0])

    def walks(self) -> Iterator[Walk]:
        """The walks, by number."""
        names, conditions, volumes = self._seed_names, self._walk_conditions(), self._reference_volumes()
        columns = [name for name, _ in checksums.WALK.columns] + ["checksum"]
        sql = f"SELECT {', '.join(columns)} FROM walk WHERE walk > ? ORDER BY walk LIMIT ?"
        kept = {field.name for field in fields(Walk)}
        for row in pages(self._store, sql, "walk"):
            checksums.WALK.verify(row)
            values = {name: row[name] for name in columns if name in kept}
            yield Walk(
                **values,
                seed_structure_name=names.get(row["seed_structure"], ""),
                conditions=conditions.get(row["walk"]),
                reference_volume=volumes.get(row["walk"]),
            )

    def walk_trace(self, walk: int) -> Trace:
        """The trace of a walk: a numpy array for each quantity, from the first point to the last. What a point does not have
        is NaN (docs/walk-diagnostics.md)."""
        if not self._store.rows("SELECT walk FROM walk WHERE walk = ?", [walk]):
            raise KeyError(f"{self.location} has no walk {walk}")
        if self.schema < 19:
            return empty_trace()
        rows = self._store.rows("SELECT * FROM walk_trace WHERE walk = ?", [walk])
        if not rows:
            return empty_trace()
        checksums.WALK_TRACE.verify(rows[0])
        return decode_trace(walk, rows[0]["points"], bytes(rows[0]["data"]))

    def seed_structures(self) -> Iterator[SeedStructure]:
        """The structures where walks start, by index."""
        sql = f"""SELECT {checksums.SEED_STRUCTURE.selected()}, {checksums.STRUCTURE.selected()}
            FROM seed_structure JOIN structure ON structure.number = seed_structure.structure
            WHERE seed > ? ORDER BY seed LIMIT ?"""
        for row in pages(self._store, sql, "seed_structure__seed"):
            checksums.SEED_STRUCTURE.verify(row, joined=True)
            name, source = row["seed_structure__name"], row["seed_structure__source"]
            yield SeedStructure(row["seed_structure__seed"], name, source, _structure(row))

    def protocols(self) -> list[LabelProtocol]:
        """The label protocols, in the order in which they came."""
        found = []
        for row in self._store.rows("SELECT * FROM protocol ORDER BY number"):
            checksums.PROTOCOL.verify(row)
            found.append(
                LabelProtocol(
                    row["number"], bytes(row["hash"]).hex(), row["name"], json.loads(row["settings"])
                )
            )
        return found

    def decisions(self, *, kind: str | None = None, after: int = 0) -> Iterator[Decision]:
        """The decision log (docs/files.md)."""
        sql = "SELECT * FROM decision WHERE sequence > ? AND sequence > ? ORDER BY sequence LIMIT ?"
        for row in pages(self._store, sql, "sequence", [after]):
            checksums.DECISION.verify(row)
            if kind in (None, row["kind"]):
                values = {name: row[name] for name in ("sequence", "round", "kind", "walk", "candidate")}
                yield Decision(
                    **values, mixture_version=row["mixture_version"], detail=json.loads(row["detail"])
                )

    def mixture_updates(self) -> Iterator[Decision]:
        """The decisions that made a new version of the mixture; ``detail["update"]`` has the numbers of an update."""
        version = 0
        for decision in self.decisions():
            if decision.mixture_version != version:
                yield decision
            version = decision.mixture_version

    def components(self) -> Iterator[Component]:
        """The components of the newest mixture that differ from the artifact with which the campaign, or its newest version
        of the potential, began."""
        for row in self._store.rows("SELECT * FROM component ORDER BY element, slot"):
            checksums.COMPONENT.verify(row)
            yield decode_component(row["element"], row["slot"], bytes(row["bytes"]))

    def mixture(self, version: int | None = None, *, program: str = "calmwalk") -> dict[str, Any]:
        """The whole mixture at a version (None: the newest) as the arrays of a CALM artifact.

        The store has the newest version alone; ``calmwalk calm export`` computes others from the accepted candidates, so the
        program must be on the path, or be given by ``program``.
        """
        import numpy as np

        found = shutil.which(program)
        if found is None:
            raise StoreError(
                f"a mixture needs the program '{program}', which is not on the path: give it by program=…"
            )
        with tempfile.TemporaryDirectory() as directory:
            output = str(Path(directory) / "mixture.npz")
            command = [found, "calm", "export", self.location, "--output", output]
            command += [] if version is None else ["--version", str(version)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise StoreError(f"{' '.join(command[:3])} failed: {done.stderr.strip()}")
            with np.load(output) as arrays:
                return {name: arrays[name] for name in arrays.files}

    def versions(self) -> list[Version]:
        """Versions of the potential and refused attempts, by number. Version 0, that of the configuration, is not in it."""
        if self.schema < 17:
            return []
        found = []
        for row in self._store.rows("SELECT * FROM version ORDER BY number"):
            checksums.VERSION.verify(row)
            values = {field.name: row[field.name] for field in fields(Version)}
            found.append(Version(**values | {"figures": json.loads(row["figures"])}))
        return found

    def version_file(self, number: int, name: str) -> bytes:
        """The ``model`` or the ``mixture`` of a registered version, an ``.npz`` file, verified against its BLAKE3 hash."""
        record = next((version for version in self.versions() if version.number == number), None)
        if record is None or record.state != "registered" or name not in ("model", "mixture"):
            raise KeyError(f"{self.location} has no {name} of a registered version {number}")
        rows = self._store.rows(
            "SELECT data FROM version_file WHERE version = ? AND name = ?", [number, name]
        )
        data = bytes(rows[0]["data"]) if rows else b""
        expected, found = getattr(record, f"{name}_hash"), blake3(data).hexdigest()
        if found != expected:
            raise DamagedError(
                f"damaged database: the {name} of version {number}: its BLAKE3 hash is {found}, and {expected} was stored with it"
            )
        return data

    def pandas(self, table: str, **options: Any) -> Any:
        """A table as :class:`pandas.DataFrame`: :data:`~calmwalk.tables.TABLES` has their names and columns."""
        return tables.to_pandas(self, table, options)

    def arrow(self, table: str, **options: Any) -> Any:
        """A table as :class:`pyarrow.Table`."""
        return tables.to_arrow(self, table, options)

    def arrow_batches(self, table: str, size: int = 10_000, **options: Any) -> Iterator[Any]:
        """A table as :class:`pyarrow.RecordBatch` with ``size`` rows each, one after the other."""
        return tables.arrow_batches(self, table, size, options)

    def to_ase_db(self, path: str | os.PathLike[str], **filters: Any) -> int:
        """Write candidates into a new ASE database and return their number. Filters are those of :meth:`atoms`."""
        from .ase_db import write_ase_db

        return write_ase_db(path, self.atoms(**filters))

    def candidate_rows(
        self, *, protocol: str | None = None, **filters: Any
    ) -> tuple[CandidateReader, Iterator[Row]]:
        """Rows of candidates without their blocks, for tables."""
        reader = self._reader(protocol)
        return reader, reader.rows(_filter(filters))

    def rows(self, sql: str, parameters: tuple[Any, ...] = ()) -> list[Row]:
        """Rows of a query of your own, in which ``?`` stands for parameters. Nothing is verified."""
        return self._store.rows(sql, parameters)

    def _value(self, key: str) -> str:
        rows = self._store.rows("SELECT * FROM campaign WHERE key = ?", [key])
        if not rows:
            raise DamagedError(f"damaged database: the campaign has no {key}")
        checksums.CAMPAIGN.verify(rows[0])
        return str(rows[0]["value"])

    def _reader(self, protocol: str | None) -> CandidateReader:
        return CandidateReader(
            self._store, self._seed_names, self._walk_conditions(), self._protocol(protocol)
        )

    def _protocol(self, name: str | None) -> LabelProtocol | None:
        """The protocol with this name, or the only one with labels; None without labels."""
        known = self.protocols()
        if name is not None:
            chosen = [protocol for protocol in known if protocol.name == name]
            if not chosen:
                raise _unknown_protocol(name, known)
            return chosen[0]
        sql = "SELECT 1 AS one FROM label WHERE protocol = ? AND status = 'label' LIMIT 1"
        labelled = [protocol for protocol in known if self._store.rows(sql, [protocol.number])]
        if len(labelled) > 1:
            names = ", ".join(f"'{protocol.name}'" for protocol in labelled)
            raise StoreError(
                f"{self.location} has labels of several protocols: choose one of {names} with protocol=…"
            )
        return labelled[0] if labelled else None

    @cached_property
    def _seed_names(self) -> dict[int, str]:
        rows = self._store.rows("SELECT * FROM seed_structure ORDER BY seed")
        for row in rows:
            checksums.SEED_STRUCTURE.verify(row)
        return {row["seed"]: row["name"] for row in rows}

    def _reference_volumes(self) -> dict[int, float]:
        """V₀ of the walks that have one; tables of earlier versions have none."""
        found = {}
        if self._store.schema >= 20:
            for row in self._store.rows("SELECT * FROM reference_volume ORDER BY walk"):
                checksums.REFERENCE_VOLUME.verify(row)
                found[row["walk"]] = row["volume"]
        return found

    def _walk_conditions(self) -> dict[int, WalkConditions]:
        """Those of all walks, which are added while a campaign runs."""
        found = {}
        for row in self._store.rows("SELECT * FROM walk_conditions ORDER BY walk"):
            checksums.WALK_CONDITIONS.verify(row)
            values = json.loads(row["conditions"])
            ramp = values.get("volume_ramp")
            constant = values.get("constant_pressure")
            values |= {
                "volume_ramp": ramp and tuple(ramp),
                "constant_pressure": constant and ConstantPressure(**constant),
                "version": values.get("version", 0),
            }
            found[row["walk"]] = WalkConditions(
                **{field.name: values[field.name] for field in fields(WalkConditions)}
            )
        return found

    def _has_versions(self) -> bool:
        """Whether walks of later versions of the potential exist: frames then tell theirs, as in an export."""
        return any(conditions.version > 0 for conditions in self._walk_conditions().values())


def _filter(filters: dict[str, Any]) -> CandidateFilter:
    unknown = sorted(set(filters) - _FILTERS)
    if unknown:
        raise TypeError(f"unknown filter '{unknown[0]}', expected one of {', '.join(sorted(_FILTERS))}")
    return CandidateFilter(**filters)


def _structure(row: Row) -> Structure:
    checksums.STRUCTURE.verify(row, joined=True)
    return decode_structure(bytes(row["structure__data"]))


def _unknown_protocol(name: str, known: list[LabelProtocol]) -> StoreError:
    names = ", ".join(f"'{protocol.name}'" for protocol in known) or "none"
    return StoreError(f"there is no label protocol '{name}', the campaign has {names}")
