"""Tables of a campaign for pandas and Arrow."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from .blocks import decode_vectors
from .records import WalkConditions
from .store_errors import MissingPackage
from .traces import QUANTITIES, WHOLE

if TYPE_CHECKING:
    from .campaign import Campaign

Record = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """Columns with their types (`int`, `float`, `text`, `bool`), and the rows of a campaign. Any value may be None."""

    columns: dict[str, str]
    rows: Callable[..., Iterable[Record]]


def _columns(text: str) -> dict[str, str]:
    """Columns from a text such as ``walk:int origin:text``."""
    return {name: kind for name, _, kind in (column.partition(":") for column in text.split())}


_OF_WALK = "group:text walk_temperature:float walk_tau:float potential_version:int"


def _of_walk(conditions: WalkConditions | None) -> Record:
    if conditions is None:
        return dict.fromkeys(("group", "walk_temperature", "walk_tau", "potential_version"))
    return {
        "group": conditions.group,
        "walk_temperature": conditions.temperature,
        "walk_tau": conditions.tau,
        "potential_version": conditions.version,
    }


# Columns of a candidate that are called as they are in the database.
_CANDIDATE = """id:text origin:text fate:text reason:text walk:int segment:int step:int seed_structure:int atoms:int
    formula:text temperature:float relative_volume:float energy:float walker_gamma:float walker_gamma_nbr:float
    walker_above:int selector_gamma:float selector_gamma_nbr:float selector_above:int original_gamma:float
    original_gamma_nbr:float original_above:int"""


def _candidates(campaign: Campaign, **filters: Any) -> Iterator[Record]:
    reader, rows = campaign.candidate_rows(**filters)
    for row in rows:
        forces = row["label__forces"]
        yield {
            "decision": row["candidate__decision"],
            **{name: row[f"candidate__{name}"] for name in _columns(_CANDIDATE)},
            "seed_structure_name": reader.seed_name(row),
            **_of_walk(reader.walk_conditions(row)),
            "mixture_version_seen": row["candidate__mixture_version"],
            "mixture_version": row["decision__mixture_version"],
            "labelled": row["label__number"] is not None,
            "label_energy": row["label__energy"],
            "label_max_force": None if forces is None else _max_norm(decode_vectors(forces)),
        }


def _max_norm(vectors: Any) -> float:
    return float(np.linalg.norm(vectors, axis=1).max(initial=0.0))


def _labels(campaign: Campaign, **filters: Any) -> Iterator[Record]:
    for label in campaign.labels(**filters):
        details = label.details
        yield {
            "number": label.number,
            "structure": label.structure,
            "protocol": label.protocol,
            "status": label.status,
            "atoms": len(label.forces),
            "energy": label.energy,
            "energy_per_atom": label.energy / len(label.forces),
            "max_force": _max_norm(label.forces),
            # Of the trace; tension is positive, so pressure is negative under it.
            "pressure": None if label.stress is None else -float(np.trace(label.stress)) / 3,
            "magnetisation": details.get("magnetisation"),
            "retry_adjustments": ",".join(details.get("retry_adjustments", [])),
            "job": label.job,
            "attempt": label.attempt,
            "file": label.file,
            "frame": label.frame,
            "received": label.received,
            "reason": label.reason,
        }


_WALK = """walk:int origin:text partner:int seed_structure:int seed_structure_name:text state:text reason:text
    assignments:int accepted:int step:int segment:int tau:float temperature:float relative_volume:float gamma_max:float
    rejected:int rollbacks:int"""


def _walks(campaign: Campaign) -> Iterator[Record]:
    for walk in campaign.walks():
        ramp = (walk.conditions and walk.conditions.volume_ramp) or (None, None)
        constant = walk.conditions and walk.conditions.constant_pressure
        yield {
            **{name: getattr(walk, name) for name in _columns(_WALK)},
            **_of_walk(walk.conditions),
            "volume_from": ramp[0],
            "volume_to": ramp[1],
            "pressure": constant and constant.pressure,
            "start_volume": constant and constant.start_volume,
            "cell_bias": constant and constant.cell_bias,
            "repeat": walk.conditions.repeat if walk.conditions else None,
        }


def _traces(campaign: Campaign, walk: int | None = None) -> Iterator[Record]:
    walks = [one.walk for one in campaign.walks()] if walk is None else [walk]
    for number in walks:
        columns = {name: values.tolist() for name, values in campaign.walk_trace(number).items()}
        for values in zip(*columns.values(), strict=True):
            point = {name: None if value != value else value for name, value in zip(columns, values, strict=True)}
            yield {"walk": number} | point


def _mixtures(campaign: Campaign) -> Iterator[Record]:
    for decision in campaign.mixture_updates():
        update = decision.detail.get("update") or {}
        selector = decision.detail.get("selector") or {}
        yield {
            "mixture_version": decision.mixture_version,
            "decision": decision.sequence,
            "kind": decision.kind,
            "candidate": decision.candidate,
            "walk": decision.walk,
            "alpha": update.get("alpha"),
            "components": len(update["components"]) if "components" in update else None,
            "ended_by": update.get("ended_by"),
            "gamma_max_before": selector.get("gamma_max"),
            "gamma_max_after": update.get("gamma_max_after"),
        }


_VERSION = """number:int parent:int state:text reason:text method:text structures:int last_decision:int labels:int
    model_hash:text mixture_hash:text seconds:float core_hours:float time:int"""


def _versions(campaign: Campaign) -> Iterator[Record]:
    for version in campaign.versions():
        record = {name: getattr(version, name) for name in _columns(_VERSION)}
        yield record | {"figures": json.dumps(version.figures)}


_DECISION = "sequence:int round:int kind:text walk:int candidate:text mixture_version:int"


def _decisions(campaign: Campaign, **filters: Any) -> Iterator[Record]:
    for decision in campaign.decisions(**filters):
        record = {name: getattr(decision, name) for name in _columns(_DECISION)}
        yield record | {"detail": json.dumps(decision.detail)}


TABLES: dict[str, Table] = {
    "candidates": Table(
        _columns(
            f"""decision:int {_CANDIDATE} seed_structure_name:text {_OF_WALK} mixture_version_seen:int mixture_version:int
            labelled:bool label_energy:float label_max_force:float"""
        ),
        _candidates,
    ),
    "labels": Table(
        _columns(
            """number:int structure:int protocol:text status:text atoms:int energy:float energy_per_atom:float
            max_force:float pressure:float magnetisation:float retry_adjustments:text job:int attempt:int file:text
            frame:int received:int reason:text"""
        ),
        _labels,
    ),
    "walks": Table(
        _columns(
            f"""{_WALK} {_OF_WALK} volume_from:float volume_to:float pressure:float start_volume:float
            cell_bias:bool repeat:int"""
        ),
        _walks,
    ),
    "traces": Table(
        {"walk": "int"} | {name: "int" if name in WHOLE else "float" for name in QUANTITIES}, _traces
    ),
    "mixtures": Table(
        _columns(
            """mixture_version:int decision:int kind:text candidate:text walk:int alpha:float components:int
            ended_by:text gamma_max_before:float gamma_max_after:float"""
        ),
        _mixtures,
    ),
    "versions": Table(_columns(f"{_VERSION} figures:text"), _versions),
    "decisions": Table(_columns(f"{_DECISION} detail:text"), _decisions),
}

_PANDAS = {"int": "Int64", "float": "float64", "text": "object", "bool": "bool"}


def _table(name: str) -> Table:
    if name not in TABLES:
        raise KeyError(f"there is no table '{name}', expected one of {', '.join(TABLES)}")
    return TABLES[name]


def to_pandas(campaign: Campaign, name: str, options: Record) -> Any:
    """The table as :class:`pandas.DataFrame`. Whole numbers that may be missing have pandas' type Int64."""
    try:
        import pandas
    except ImportError:
        raise MissingPackage("tables for pandas need pandas: pip install pandas") from None
    table = _table(name)
    columns: dict[str, list[Any]] = {column: [] for column in table.columns}
    for record in table.rows(campaign, **options):
        for column, values in columns.items():
            values.append(record[column])
    series = {
        column: pandas.Series(columns[column], dtype=_PANDAS[kind]) for column, kind in table.columns.items()
    }
    return pandas.DataFrame(series)


def arrow_batches(campaign: Campaign, name: str, size: int, options: Record) -> Iterator[Any]:
    """The table as record batches of ``size`` rows."""
    arrow = _arrow()
    table = _table(name)
    schema, rows = _arrow_schema(arrow, table), iter(table.rows(campaign, **options))
    while batch := list(islice(rows, size)):
        yield arrow.RecordBatch.from_pylist(batch, schema=schema)


def to_arrow(campaign: Campaign, name: str, options: Record) -> Any:
    """The table as :class:`pyarrow.Table`."""
    arrow = _arrow()
    batches = list(arrow_batches(campaign, name, 10_000, options))
    return arrow.Table.from_batches(batches, schema=_arrow_schema(arrow, _table(name)))


def _arrow() -> Any:
    try:
        import pyarrow
    except ImportError:
        raise MissingPackage("Arrow tables need pyarrow: pip install pyarrow") from None
    return pyarrow


def _arrow_schema(arrow: Any, table: Table) -> Any:
    types = {"int": arrow.int64(), "float": arrow.float64(), "text": arrow.string(), "bool": arrow.bool_()}
    return arrow.schema([(column, types[kind]) for column, kind in table.columns.items()])
