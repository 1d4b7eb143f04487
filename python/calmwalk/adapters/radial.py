"""A complete potential in plain numpy, for tests: smooth radial symmetry functions and energies that depend smoothly
on them.

Features of atom i, for each function k and each element t of a neighbour:

    G_i,tk = Σ_(j of t) φ_k(r_ij),   φ_k(r) = exp(−((r − c_k) / w_k)²) (1 − (r / r_c)²)³  below the cutoff r_c, 0 beyond

and the energy of an atom of element s, as of Finnis and Sinclair with the symmetry functions as a basis:

    E_i = E⁰_s + Σ_tk a_stk G_i,tk − √(Σ_tk b_stk G_i,tk + δ_s) + √δ_s,   b ≥ 0, δ > 0

The model is a file of JSON with `elements`, `cutoff` (Å), `blocks` (lists of functions, each {"centre": c, "width":
w} in Å; a block stands for a layer of a larger model), and for each element `shift` E⁰ (eV), `linear` a (eV),
`embedding` b (eV²) and `floor` δ (eV²); a and b have a number for each column of the features. Columns are sorted by
block, then by the neighbour's element, then by function.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Optional

import numpy as np

from ..adapter import (
    Energies,
    Evaluation,
    Features,
    Gradients,
    ModelInfo,
    check_options,
    identity,
    model_path,
    same_cutoff,
)
from ..batch import Batch, scatter
from ..errors import InputError


@dataclass(frozen=True)
class Parameters:
    """A model file in arrays: E elements, K functions, D = E·K features."""

    elements: list[str]
    cutoff: float
    blocks: list[int]
    """Number of functions of each block."""
    centres: np.ndarray
    """[K], Å."""
    widths: np.ndarray
    """[K], Å."""
    column: np.ndarray
    """[E, K]: column of a neighbour's element and a function."""
    shift: np.ndarray
    """[E], eV."""
    linear: np.ndarray
    """[E, D], eV."""
    embedding: np.ndarray
    """[E, D], eV²."""
    floor: np.ndarray
    """[E], eV²."""


@dataclass(frozen=True)
class _Near:
    """The bonds below the cutoff."""

    index: np.ndarray
    """i64[b]: into the bonds of the batch."""
    directions: np.ndarray
    """[b, 3]: unit vectors."""
    columns: np.ndarray
    """[b, K]: columns of the features to which a bond contributes."""
    values: np.ndarray
    """[b, K]: φ."""
    slopes: np.ndarray
    """[b, K]: dφ/dr, 1/Å."""


class Radial:
    """The adapter. Takes no options."""

    def __init__(
        self,
        model: Optional[Path],
        options: dict[str, Any],
        device: str = "cpu",
        precision: str = "double",
        threads: int = 1,
        cache: Optional[Path] = None,
    ) -> None:
        check_options(options, ())
        path = model_path(model, "a file of JSON with the parameters of a radial model")
        self._p = read_parameters(path)
        self._type = np.float32 if precision == "single" else np.float64
        self.info = ModelInfo(
            elements=self._p.elements,
            cutoffs=same_cutoff(self._p.elements, self._p.cutoff),
            features=Features("raw", [len(self._p.elements) * functions for functions in self._p.blocks]),
            identity=identity([path], Radial, "sums by block, element, function"),
            precision=precision,
        )

    def evaluate(self, batch: Batch, features: bool) -> Evaluation:
        near, values, energies, slopes = self._forward(batch)
        batch.kept = near, slopes
        gradients, strain = self._scatter(batch, near, slopes)
        return Evaluation(energies, values if features else None, -gradients, -strain)

    def evaluate_without_forces(self, batch: Batch) -> Energies:
        near, values, energies, slopes = self._forward(batch)
        batch.kept = near, slopes
        return Energies(energies, values)

    def pull_back(
        self, batch: Batch, feature_cotangents: np.ndarray, energy_cotangents: Optional[np.ndarray] = None
    ) -> Gradients:
        if batch.kept is None:
            near, _, _, slopes = self._forward(batch)
        else:
            near, slopes = batch.kept
        cotangents = feature_cotangents.astype(self._type)
        if energy_cotangents is not None:
            cotangents = cotangents + energy_cotangents.astype(self._type)[:, None] * slopes
        return Gradients(*self._scatter(batch, near, cotangents))

    def _forward(self, batch: Batch) -> tuple[_Near, np.ndarray, np.ndarray, np.ndarray]:
        """Bonds, features [A, D], energies [A], ∂E_i/∂(features of i) [A, D]."""
        near = self._near(batch)
        features = self._features(batch, near)
        species, p = batch.species, self._p
        linear, embedding = p.linear[species].astype(self._type), p.embedding[species].astype(self._type)
        floor = p.floor[species].astype(self._type)
        root = np.sqrt(np.einsum("ad,ad->a", embedding, features) + floor)
        energies = p.shift[species].astype(self._type) + np.einsum("ad,ad->a", linear, features) - root + np.sqrt(floor)
        return near, features, energies, linear - embedding / (2 * root[:, None])

    def _near(self, batch: Batch) -> _Near:
        p = self._p
        lengths = np.sqrt(np.einsum("bx,bx->b", batch.bonds, batch.bonds))
        index = np.flatnonzero(lengths < p.cutoff)
        r = lengths[index].astype(self._type)
        directions = batch.bonds[index].astype(self._type) / r[:, None]
        scaled = (r[:, None] - p.centres.astype(self._type)) / p.widths.astype(self._type)
        gauss = np.exp(-(scaled**2))
        inside = (1 - (r / p.cutoff) ** 2)[:, None]
        slopes = -gauss * inside**2 * (2 * scaled / p.widths.astype(self._type) * inside + 6 * r[:, None] / p.cutoff**2)
        columns = p.column[batch.species[batch.neighbours[index]]]
        return _Near(index, directions, columns, gauss * inside**3, slopes.astype(self._type))

    def _features(self, batch: Batch, near: _Near) -> np.ndarray:
        dimension = self.info.features.dimension
        place = batch.centres[near.index].astype(np.int64)[:, None] * dimension + near.columns
        sums = np.bincount(place.ravel(), near.values.ravel(), batch.n_atoms * dimension)
        return sums.reshape(batch.n_atoms, dimension).astype(self._type)

    def _scatter(self, batch: Batch, near: _Near, cotangents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """∂/∂r and ∂/∂ε of Σ cotangents·features."""
        centres = batch.centres[near.index]
        weights = np.take_along_axis(cotangents[centres], near.columns, axis=1)
        bond_gradients = np.zeros((batch.n_bonds, 3), self._type)
        bond_gradients[near.index] = np.einsum("bk,bk->b", weights, near.slopes)[:, None] * near.directions
        return scatter(batch, bond_gradients)


def read_parameters(path: Path) -> Parameters:
    """Reads a model file. InputError names the file and the key."""
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise InputError(f"{path}: not a file of JSON ({error})") from None
    elements = [str(element) for element in _key(path, content, "elements", list)]
    blocks = _key(path, content, "blocks", list)
    functions = [function for block in blocks for function in block]
    dimension = len(elements) * len(functions)
    tables = {name: _table(path, content, name, elements, dimension) for name in ("linear", "embedding")}
    numbers = {name: _table(path, content, name, elements, None) for name in ("shift", "floor")}
    cutoff = float(_key(path, content, "cutoff", (int, float)))
    if not (cutoff > 0 and (tables["embedding"] >= 0).all() and (numbers["floor"] > 0).all()):
        raise InputError(f"{path}: expected cutoff > 0, embedding ≥ 0 and floor > 0")
    return Parameters(
        elements=elements,
        cutoff=cutoff,
        blocks=[len(block) for block in blocks],
        centres=np.array([float(_key(path, function, "centre", (int, float))) for function in functions]),
        widths=np.array([float(_key(path, function, "width", (int, float))) for function in functions]),
        column=_columns(len(elements), [len(block) for block in blocks]),
        **tables,
        **numbers,
    )


def _columns(elements: int, blocks: list[int]) -> np.ndarray:
    parts, start = [], 0
    for functions in blocks:
        parts.append(start + np.arange(elements * functions).reshape(elements, functions))
        start += elements * functions
    return np.concatenate(parts, axis=1)


def _key(path: Path, content: Any, key: str, kind: Any) -> Any:
    value = content.get(key) if isinstance(content, Mapping) else None
    if not isinstance(value, kind):
        raise InputError(f"{path}: '{key}' is {value!r}, expected {getattr(kind, '__name__', 'a number')}")
    return value


def _table(path: Path, content: Any, key: str, elements: list[str], columns: Optional[int]) -> np.ndarray:
    """[elements] or [elements, columns] from an object with the elements as keys."""
    rows = _key(path, content, key, dict)
    try:
        table = np.array([rows[element] for element in elements], dtype=float)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: '{key}' has no numbers for each of {elements} ({error!r})") from None
    expected = (len(elements),) if columns is None else (len(elements), columns)
    if table.shape != expected:
        raise InputError(f"{path}: '{key}' has the shape {table.shape}, expected {expected}")
    return table
