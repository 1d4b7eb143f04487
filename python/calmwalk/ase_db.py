"""ASE databases from structures of a campaign."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .store_errors import MissingPackage


def write_ase_db(path: str | os.PathLike[str], structures: Iterable[Any]) -> int:
    """Write structures into a new ASE database (its kind follows from the name, such as ``.db``) and return their number.

    What ASE can select by (``db.select("fate=accepted,walk=3")``) becomes key–value pairs; arrays, and values that ASE does
    not take as pairs, are in the ``data`` of a row. A failure leaves no file.
    """
    try:
        from ase.db import connect
    except ImportError:
        raise MissingPackage("an ASE database needs ase: pip install ase") from None
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path} exists already: choose another name, or remove it")
    count = 0
    try:
        with connect(path) as database:
            for atoms in structures:
                pairs, data = _pairs(atoms)
                database.write(atoms, key_value_pairs=pairs, data=data)
                count += 1
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return count


def _pairs(atoms: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """The info of a frame as key–value pairs and as data, and its own arrays as data."""
    from ase.db.core import check

    pairs: dict[str, Any] = {}
    data = {name: array for name, array in atoms.arrays.items() if name not in ("numbers", "positions")}
    for name, value in atoms.info.items():
        try:
            if not isinstance(value, (int, float, str, np.number)):
                raise ValueError(f"{name} is a {type(value)}")
            check({name: value})
            pairs[name] = value
        except ValueError:
            data[name] = value
    return pairs, data
